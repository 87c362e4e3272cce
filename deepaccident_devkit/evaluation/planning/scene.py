"""`Plan`: a planned path of an agent; `PlanningScene`: what it meets; plans without a planner."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from deepaccident_devkit.collisions.recorded import Accident, accident_of, tried
from deepaccident_devkit.collisions.replay import braking_plans, motion_of, replay
from deepaccident_devkit.collisions.twins import twin_of
from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import EvaluationError, GeometryError
from deepaccident_devkit.evaluation.predictions import ascending_times
from deepaccident_devkit.evaluation.truth import box_truth, labelled_sample
from deepaccident_devkit.geometry.conventions import inverses, stored_transforms
from deepaccident_devkit.support.arrays import (
    BoolArray,
    FloatArray,
    FrozenArrays,
    IntArray,
    checked,
    checked_number,
)
from deepaccident_devkit.tables.records import ScenarioRecord
from deepaccident_devkit.taxonomy import CATEGORIES, FRAME_PERIOD, OWN_ACTOR_ID
from deepaccident_devkit.v2x.cooperation import visible_actors
from deepaccident_devkit.v2x.tracks import scenario_tracks

# Seconds for which paths go straight on after their end.
_EXTRAPOLATION_S: Final = 1000.0
# Metres: a shorter step keeps the heading.
_MIN_TURNING_STEP_M: Final = 0.1
# m/s² of full braking.
BRAKING: Final = 8.0
# Seconds that the trivial plans look ahead, at least.
_MIN_PLAN_S: Final = 3.0
# Share of a step by which a decimal time may miss its step.
_STEP_TOLERANCE: Final = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Plan(FrozenArrays):
    """A path that the sample's agent plans to drive; arrays are read-only.

    Attributes:
        times: (T,) seconds after the present, ascending.
        path: (T, 2) origins of its ego frame, x forward, y left, metres in the present ego frame.
        score: How good the plan is; higher is better.
        yaw: (T,) headings, radians, counter-clockwise; None for the directions of the steps.
    """

    times: FloatArray
    path: FloatArray
    score: float = 1.0
    yaw: FloatArray | None = None

    def __post_init__(self) -> None:
        """Check and freeze; raises GeometryError."""
        times = ascending_times(self.times)
        path = checked("path", self.path, (len(times), 2)).copy()
        yaw = None if self.yaw is None else checked("yaw", self.yaw, (len(times),)).copy()
        if not times[-1] > 0:
            raise GeometryError(
                "times: expected a plan for after the present, found the present alone"
            )
        if not np.isfinite(path).all() or (yaw is not None and not np.isfinite(yaw).all()):
            raise GeometryError("path: not all numbers are finite; leave out what is not planned")
        score = checked_number("score", self.score)
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "path", path)
        object.__setattr__(self, "yaw", yaw)
        object.__setattr__(self, "score", score)
        FrozenArrays.__post_init__(self)

    def poses(self, times: FloatArray) -> FloatArray:
        """Return x, y and yaw at times (N,), shape (N, 3).

        Poses are linear between the stated ones from the present on, and go straight on after the
        last one. Without stated yaw, it is the direction of the step, kept where the step is
        shorter than 0.1 m.
        """
        missing = int(self.times[0] > 0)
        moments = np.append(np.zeros(missing), self.times)
        path = np.vstack([np.zeros((missing, 2)), self.path])
        steps = np.diff(path, axis=0)
        if self.yaw is None:
            # the first pose has no step that turns it
            turns = np.append(True, np.hypot(*steps.T) >= _MIN_TURNING_STEP_M)
            last_turn = np.maximum.accumulate(np.where(turns, np.arange(len(path)), 0))
            yaw = np.append(0.0, np.arctan2(steps[:, 1], steps[:, 0]))[last_turn]
        else:
            yaw = np.append(np.zeros(missing), self.yaw)
        values = np.column_stack([path, np.unwrap(yaw)])
        if len(path) > 1:
            last_period = moments[-1] - moments[-2]
            extension = (*steps[-1] * (_EXTRAPOLATION_S / last_period), 0.0)
            moments = np.append(moments, moments[-1] + _EXTRAPOLATION_S)
            values = np.vstack([values, values[-1] + extension])
        return np.column_stack([np.interp(times, moments, column) for column in values.T])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlanningScene(FrozenArrays):
    """What a plan meets from a sample's present on; present ego frame, metres, seconds, radians.

    Arrays are read-only. F frames at 10 Hz from the present to the recording's end; A other actors.

    Attributes:
        scenario: Token of the scenario.
        recorded: (F, 3) x, y, yaw of the ego frame.
        before: (2,) velocity of the ego over the frame before the present, m/s; at the first frame,
            over the frame after it.
        size: (2,) length and width of the ego's box.
        offset: (2,) centre of the ego's box in the ego frame.
        actor_id: (A,) ids of the others.
        footprint: (F, A, 5) x, y, length, width, yaw of the others; NaN where nobody annotated
            them.
        is_pedestrian: (A,) whether the actor is a pedestrian.
        seen: (A,) whether the agent sees the actor at the present (docs/released_code.md,
            Visibility and attributes).
        is_twin: Whether nobody collides here, but somebody does in the scenario's twin.
        is_collider: Whether the agent is one of the colliding pair, for a twin in its accident.
        partner: (A,) the other actor of the pair; none unless the agent collides here.
        to_end: Seconds to the last frame of the accident, also for a twin; NaN without an accident.
        to_contact: Seconds to the frame at which the pair begins to touch
            (`Contact.contact_frame`); NaN without one.
    """

    scenario: str
    recorded: FloatArray
    before: FloatArray
    size: FloatArray
    offset: FloatArray
    actor_id: IntArray
    footprint: FloatArray
    is_pedestrian: BoolArray
    seen: BoolArray
    is_twin: bool
    is_collider: bool
    partner: BoolArray
    to_end: float
    to_contact: float

    @property
    def duration(self) -> float:
        """Seconds to the last frame."""
        return float((len(self.recorded) - 1) * FRAME_PERIOD)


def planning_scene(dataset: Dataset, sample: RowArgument, *, cut: bool = True) -> PlanningScene:
    """Return what a plan of a sample's agent meets, from the labels of all agents.

    Args:
        dataset: The release.
        sample: Token or record of the sample.
        cut: Whether a twin ends where its accident does, and an accident at the last frame that
            shows the pair.

    Raises:
        TokenError: no such sample.
        EvaluationError: the label has no row of the agent itself, like that of the roadside.
        NotAvailableError: the sample has no label, or the scenario no meta file.
    """
    record = labelled_sample(dataset, sample)
    token = record["token"]
    agent = dataset.get("agent", record["agent_token"])
    boxes = dataset.boxes(token, "ego")
    own = np.flatnonzero(boxes.actor_id == OWN_ACTOR_ID)
    if not len(own):
        raise EvaluationError(
            f"{token}: its label has no row of the agent itself (id {OWN_ACTOR_ID}), as that of "
            "the roadside, which does not drive; leave such samples out (--agents vehicles)"
        )
    scenario = dataset.scenario.get(record["scenario_token"])
    present = int(token.rsplit("/", 1)[1])
    last = scenario["num_frames"]
    accident = _accident_of_story(dataset, scenario)
    if accident is not None and cut:
        last = max(present, min(last, accident.last_frame))
    truth = box_truth(dataset, token, (last - present) * FRAME_PERIOD)
    other_rows = np.flatnonzero(truth.actor_id != agent["actor_id"])
    actors = truth.actor_id[other_rows]
    tracks = scenario_tracks(dataset, scenario)
    is_walker = tracks.boxes.category == CATEGORIES.index("pedestrian")
    is_twin = False
    is_collider = False
    pair: tuple[int, ...] = ()
    to_end = np.nan
    to_contact = np.nan
    if accident is not None:
        is_twin = accident.scenario != scenario["token"]
        is_collider = agent["name"] in accident.agents
        if is_collider and not is_twin:
            pair = accident.actor_ids
        to_end = (accident.last_frame - present) * FRAME_PERIOD
        if accident.touching is not None:
            to_contact = to_end - accident.touching
    poses = _ego_poses(dataset, token, present, last)
    visible = visible_actors(dataset, token, agents=[agent["name"]])
    return PlanningScene(
        scenario=scenario["token"],
        recorded=poses[1:],
        before=(poses[1] - poses[0])[:2] / FRAME_PERIOD,
        size=boxes.size[own[0], :2].copy(),
        offset=boxes.center[own[0], :2].copy(),
        actor_id=actors,
        footprint=truth.footprint[:, other_rows],
        is_pedestrian=np.isin(actors, tracks.actor_id[is_walker]),
        seen=np.isin(actors, visible),
        is_twin=is_twin,
        is_collider=is_collider,
        partner=np.isin(actors, pair),
        to_end=to_end,
        to_contact=to_contact,
    )


def _accident_of_story(dataset: Dataset, scenario: ScenarioRecord) -> Accident | None:
    """Return the recorded accident of a scenario, otherwise that of its twin; None without one."""
    outcomes = [tried(accident_of, dataset, scenario)]
    twin = twin_of(dataset, scenario)
    if twin is not None:
        outcomes.append(tried(accident_of, dataset, twin))
    return next((outcome for outcome in outcomes if isinstance(outcome, Accident)), None)


def _ego_poses(dataset: Dataset, token: str, present: int, last: int) -> FloatArray:
    """Return x, y, yaw of the ego frame from the frame before the present on, shape (1 + F, 3).

    At the recording's first frame, the one before is extrapolated from the one after it.
    """
    row = dataset.getind("sample", token)
    frames = row + np.arange(1 - min(present, 2), last - present + 1)
    world_from_ego = stored_transforms(dataset.columns("ego_pose")["matrix"][frames])
    present_from_world = inverses(world_from_ego[[min(present, 2) - 1]])
    present_from_ego = present_from_world @ world_from_ego
    yaw = np.unwrap(np.arctan2(present_from_ego[:, 1, 0], present_from_ego[:, 0, 0]))
    poses = np.column_stack([present_from_ego[:, 0, 3], present_from_ego[:, 1, 3], yaw])
    if present > 1:
        return poses
    return np.vstack([2 * poses[0] - poses[min(1, len(poses) - 1)], poses])


def trivial_plans(scene: PlanningScene) -> Mapping[str, Plan]:
    """Return the plans that every evaluation is compared with; they need no planner.

    `recorded` (what is left of the recording) and `full braking` (on the recorded path at 8 m/s²,
    never faster than recorded) have steps of 0.1 s, `standing` (at once) and `constant velocity` of
    0.5 s; they look at least 3 s ahead.
    """
    fine = steps_of(FRAME_PERIOD, max(_MIN_PLAN_S, scene.duration))
    coarse = steps_of(0.5, _MIN_PLAN_S)
    return {
        "recorded": _plan_of(fine, recorded_poses(scene, fine)),
        "standing": _plan_of(coarse, np.zeros((len(coarse), 3))),
        "constant velocity": _plan_of(coarse, coarse[:, None] * np.append(scene.before, 0.0)),
        "full braking": _plan_of(fine, recorded_poses(scene, fine, 0.0)),
    }


def _plan_of(times: FloatArray, poses: FloatArray) -> Plan:
    """Return the plan of poses (N, 3) x, y, yaw at times (N,)."""
    return Plan(times=times, path=poses[:, :2], yaw=poses[:, 2])


def steps_of(step: float, duration: float) -> FloatArray:
    """Return the seconds (N,) of steps up to a duration, from the first step on."""
    count = math.floor(duration / step + _STEP_TOLERANCE)
    numbers = np.arange(1, count + 1, dtype=np.float64)
    return np.asarray(numbers * step)


def recorded_poses(
    scene: PlanningScene, times: FloatArray, braking_from: float = np.inf
) -> FloatArray:
    """Return x, y, yaw of the recorded ego frame at times (N,), shape (N, 3).

    After its end the path goes straight on.

    Args:
        scene: Scene with the recording.
        times: (N,) seconds after the present.
        braking_from: Seconds after the present from which on the ego brakes fully.
    """
    if len(scene.recorded) < 2:
        return np.zeros((len(times), 3))
    motion = motion_of(scene.recorded, horizon=_EXTRAPOLATION_S)
    plans = braking_plans(motion, [braking_from], BRAKING)
    return replay(motion, plans, np.zeros(len(times), dtype=np.int64), times).poses
