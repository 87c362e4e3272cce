"""`Plan`: a planned path of an agent; `PlanningScene`: what happens around it; trivial plans."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from deepaccident_devkit.collisions.recorded import Accident, accident_of, try_scenario
from deepaccident_devkit.collisions.replay import braking_plans, motion_of, replay
from deepaccident_devkit.collisions.twins import twin_of
from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import EvaluationError, GeometryError
from deepaccident_devkit.evaluation.drawing import Drawing, DrawnPath
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

# Paths are extended straight on after their end by this many seconds.
_EXTRAPOLATION_S = 1000.0
# A step shorter than this keeps the heading of the previous step, metres.
_MIN_TURNING_STEP_M = 0.1
# Deceleration of full braking, m/s².
BRAKING: Final = 8.0
# The trivial plans look at least this many seconds ahead.
_MIN_PLAN_S = 3.0
# A decimal time may differ from its step by this fraction of a step.
_STEP_TOLERANCE = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Plan(FrozenArrays):
    """A path that the sample's agent plans to drive; arrays are read-only.

    Attributes:
        times: (T,) seconds after the current frame, ascending.
        path: (T, 2) planned origins of the agent's ego frame, x forward, y left, metres in the
            current ego frame.
        score: How good the plan is; higher is better.
        yaw: (T,) headings, radians, counter-clockwise; None takes the directions of the steps.
    """

    times: FloatArray
    path: FloatArray
    score: float = 1.0
    yaw: FloatArray | None = None

    def __post_init__(self) -> None:
        """Check and freeze the arrays.

        Raises:
            GeometryError: If the plan ends before t = 0, or a shape or a value is invalid.
        """
        times = ascending_times(self.times)
        path = checked("path", self.path, (len(times), 2)).copy()
        yaw = self.yaw
        if yaw is not None:
            yaw = checked("yaw", yaw, (len(times),)).copy()
        if not times[-1] > 0:
            raise GeometryError(
                "times: expected at least one time after the present, found only the present"
            )
        if not np.isfinite(path).all() or (yaw is not None and not np.isfinite(yaw).all()):
            raise GeometryError("path: not all numbers are finite; remove the times without a plan")
        score = checked_number("score", self.score)
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "path", path)
        object.__setattr__(self, "yaw", yaw)
        object.__setattr__(self, "score", score)
        FrozenArrays.__post_init__(self)

    def drawing(self, width: float = 0.0) -> Drawing:
        """Describe the plan for a picture, from the present on.

        Args:
            width: Width of the vehicle, metres; 0 draws a line.
        """
        times = self.times
        path = self.path
        if times[0] > 0:
            times = np.append(0.0, times)
            path = np.vstack([np.zeros(2), path])
        plan = DrawnPath(xy=path, times=times, role="predicted", width=width, label="plan")
        return Drawing(paths=(plan,))

    def poses(self, times: FloatArray) -> FloatArray:
        """Interpolate the plan's poses at times (N,), shape (N, 3: x, y, yaw), metres and radians.

        A plan that begins later than t = 0 starts at the origin with yaw 0. After its last pose it
        goes straight on. If the plan has no yaw, it is the direction of the step; a step shorter
        than 0.1 m keeps the previous yaw.
        """
        plan_times = self.times
        path = self.path
        yaw = self.yaw
        if plan_times[0] > 0:
            # the plan begins at t = 0, at the origin
            plan_times = np.append(0.0, plan_times)
            path = np.vstack([np.zeros(2), path])
            if yaw is not None:
                yaw = np.append(0.0, yaw)
        steps = np.diff(path, axis=0)
        if yaw is None:
            yaw = _directions(steps)
        poses = np.column_stack([path, np.unwrap(yaw)])
        if len(poses) > 1:
            last_period = plan_times[-1] - plan_times[-2]
            extension = steps[-1] * (_EXTRAPOLATION_S / last_period)
            plan_times = np.append(plan_times, plan_times[-1] + _EXTRAPOLATION_S)
            poses = np.vstack([poses, poses[-1]])
            poses[-1, :2] += extension
        return np.column_stack([np.interp(times, plan_times, column) for column in poses.T])


def _directions(steps: FloatArray) -> FloatArray:
    """Derive the yaw of a path's poses from its steps, shape (N + 1,), radians.

    Args:
        steps: (N, 2) steps between the poses, metres.
    """
    dx, dy = steps.T
    # no step leads to the first pose, so its yaw is 0
    yaw = np.append(0.0, np.arctan2(dy, dx))
    turns = np.append(True, np.hypot(dx, dy) >= _MIN_TURNING_STEP_M)
    last_turn = np.maximum.accumulate(np.where(turns, np.arange(len(yaw)), 0))
    return np.asarray(yaw[last_turn])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlanningScene(FrozenArrays):
    """What happens around a plan from a sample's frame on, in the current ego frame.

    Units are metres, seconds and radians; arrays are read-only. There are F frames at 10 Hz, from
    the current one to the recording's end, and A other actors.

    Attributes:
        scenario: Token of the scenario.
        recorded: (F, 3) recorded x, y, yaw of the ego frame.
        before: (2,) velocity of the ego from the previous to the current frame, m/s; in the
            recording's first frame, from the current to the next one.
        size: (2,) length and width of the ego's box.
        offset: (2,) centre of the ego's box in the ego frame.
        actor_id: (A,) ids of the other actors.
        footprint: (F, A, 5) x, y, length, width, yaw of the other actors; NaN where no agent
            annotated them.
        is_pedestrian: (A,) bool, True for pedestrians.
        seen: (A,) bool, True for actors that the agent sees in the current frame (section
            "Visibility and attributes" of docs/released_code.md).
        is_twin: Whether there is no collision here, but there is one in the scenario's twin.
        is_collider: Whether the agent is one of the colliding pair; for a twin, of the pair that
            collides in its accident.
        partner: (A,) bool, True for the actor that the agent collides with; False for all if the
            agent does not collide here.
        to_end: Seconds to the last frame of the accident, or for a twin, of its accident; NaN if
            there is no accident.
        to_contact: Seconds to the frame in which the pair begins to touch
            (`Contact.contact_frame`); NaN if there is no such frame.
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
        """Seconds from the current to the last frame."""
        return float((len(self.recorded) - 1) * FRAME_PERIOD)


def planning_scene(dataset: Dataset, sample: RowArgument, *, cut: bool = True) -> PlanningScene:
    """Collect what happens around a sample's agent, from the labels of all agents.

    Args:
        dataset: Release with the sample.
        sample: Token or record of the sample.
        cut: Whether to cut recordings: a twin where its accident ends, and an accident after the
            last frame that shows the pair.

    Raises:
        TokenError: If the release does not have the sample.
        EvaluationError: If the label has no row for the agent itself, as for the infrastructure.
        NotAvailableError: If the sample has no label, or the scenario has no meta file.
    """
    record = labelled_sample(dataset, sample)
    token = record["token"]
    agent = dataset.get("agent", record["agent_token"])
    boxes = dataset.boxes(token, "ego")
    own_rows = np.flatnonzero(boxes.actor_id == OWN_ACTOR_ID)
    if not len(own_rows):
        raise EvaluationError(
            f"{token}: its label has no row of the agent itself (id {OWN_ACTOR_ID}); labels of "
            "the infrastructure never have one. Leave out samples of the infrastructure "
            "(--agents vehicles)"
        )
    scenario = dataset.scenario.get(record["scenario_token"])
    present_frame = int(token.rsplit("/", 1)[1])
    last_frame = scenario["num_frames"]
    accident = _accident_of_scenario_or_twin(dataset, scenario)
    if accident is not None and cut:
        last_frame = max(present_frame, min(last_frame, accident.last_frame))
    truth = box_truth(dataset, token, (last_frame - present_frame) * FRAME_PERIOD)
    is_other = truth.actor_id != agent["actor_id"]
    actor_ids = truth.actor_id[is_other]
    tracks = scenario_tracks(dataset, scenario)
    is_pedestrian = tracks.boxes.category == CATEGORIES.index("pedestrian")
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
        to_end = (accident.last_frame - present_frame) * FRAME_PERIOD
        if accident.touching is not None:
            to_contact = to_end - accident.touching
    poses = _ego_poses(dataset, token, present_frame, last_frame)
    visible_ids = visible_actors(dataset, token, agents=[agent["name"]])
    return PlanningScene(
        scenario=scenario["token"],
        recorded=poses[1:],
        before=(poses[1] - poses[0])[:2] / FRAME_PERIOD,
        size=boxes.size[own_rows[0], :2].copy(),
        offset=boxes.center[own_rows[0], :2].copy(),
        actor_id=actor_ids,
        footprint=truth.footprint[:, is_other],
        is_pedestrian=np.isin(actor_ids, tracks.actor_id[is_pedestrian]),
        seen=np.isin(actor_ids, visible_ids),
        is_twin=is_twin,
        is_collider=is_collider,
        partner=np.isin(actor_ids, pair),
        to_end=to_end,
        to_contact=to_contact,
    )


def _accident_of_scenario_or_twin(dataset: Dataset, scenario: ScenarioRecord) -> Accident | None:
    """Return the recorded accident of a scenario or else of its twin; None if there is neither."""
    outcome = try_scenario(accident_of, dataset, scenario)
    if isinstance(outcome, Accident):
        return outcome
    twin = twin_of(dataset, scenario)
    if twin is None:
        return None
    outcome = try_scenario(accident_of, dataset, twin)
    return outcome if isinstance(outcome, Accident) else None


def _ego_poses(dataset: Dataset, token: str, present_frame: int, last_frame: int) -> FloatArray:
    """Return x, y, yaw of the ego frame from the previous frame on, shape (1 + F, 3).

    In the recording's first frame, which has the number 1, the previous pose is extrapolated from
    the current and the next one.
    """
    frames_before = 1 if present_frame > 1 else 0
    offsets = np.arange(-frames_before, last_frame - present_frame + 1)
    rows = dataset.getind("sample", token) + offsets
    world_from_ego = stored_transforms(dataset.columns("ego_pose")["matrix"][rows])
    present_from_world = inverses(world_from_ego[[frames_before]])
    matrices = present_from_world @ world_from_ego
    yaw = np.unwrap(np.arctan2(matrices[:, 1, 0], matrices[:, 0, 0]))
    poses = np.column_stack([matrices[:, :2, 3], yaw])
    if frames_before:
        return poses
    later_pose = poses[min(1, len(poses) - 1)]
    return np.vstack([2 * poses[0] - later_pose, poses])


def trivial_plans(scene: PlanningScene) -> Mapping[str, Plan]:
    """Build the trivial plans, which need no planner and are evaluated for comparison.

    `recorded` repeats the rest of the recording. `full braking` brakes with 8 m/s² on the recorded
    path, and is never faster than recorded. `standing` stands from t = 0 on. `constant velocity`
    keeps the velocity. The first two have steps of 0.1 s, the others of 0.5 s. All look at least
    3 s ahead.
    """
    fine_times = steps_of(FRAME_PERIOD, max(_MIN_PLAN_S, scene.duration))
    coarse_times = steps_of(0.5, _MIN_PLAN_S)
    displacement = np.append(scene.before, 0.0)
    return {
        "recorded": _plan(fine_times, recorded_poses(scene, fine_times)),
        "standing": _plan(coarse_times, np.zeros((len(coarse_times), 3))),
        "constant velocity": _plan(coarse_times, coarse_times[:, None] * displacement),
        "full braking": _plan(fine_times, recorded_poses(scene, fine_times, braking_from=0.0)),
    }


def _plan(times: FloatArray, poses: FloatArray) -> Plan:
    """Build a plan from poses (N, 3: x, y, yaw) at times (N,)."""
    path = poses[:, :2]
    yaw = poses[:, 2]
    return Plan(times=times, path=path, yaw=yaw)


def steps_of(step: float, duration: float) -> FloatArray:
    """Return the times (N,) of steps up to a duration, seconds; t = 0 is not included.

    Args:
        step: Seconds from one step to the next.
        duration: Time of the last step at the latest, seconds.
    """
    count = math.floor(duration / step + _STEP_TOLERANCE)
    return np.arange(1, count + 1, dtype=np.float64) * step


def recorded_poses(
    scene: PlanningScene, times: FloatArray, braking_from: float = np.inf
) -> FloatArray:
    """Interpolate the recorded poses of the ego frame at times (N,), shape (N, 3: x, y, yaw).

    After the recording's end the path goes straight on.

    Args:
        scene: Scene with the recording.
        times: (N,) seconds after the current frame.
        braking_from: Seconds after the current frame at which the ego begins full braking; inf for
            no braking.
    """
    if len(scene.recorded) < 2:
        return np.zeros((len(times), 3))
    motion = motion_of(scene.recorded, horizon=_EXTRAPOLATION_S)
    plans = braking_plans(motion, [braking_from], BRAKING)
    plan_index = np.zeros(len(times), dtype=np.int64)
    return replay(motion, plans, plan_index, times).poses
