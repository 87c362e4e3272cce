"""`Plan`: a path that an agent plans to drive; `PlanningScene`: all that it meets; plans that need no planner."""

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
from deepaccident_devkit.taxonomy import CATEGORIES, FRAME_PERIOD, OWN_ACTOR_ID
from deepaccident_devkit.v2x.cooperation import visible_actors
from deepaccident_devkit.v2x.tracks import scenario_tracks


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Plan(FrozenArrays):
    """A path that the sample's agent plans to drive; arrays are read-only.

    Attributes:
        times: (T,) seconds after the present, ascending.
        path: (T, 2) where its ego frame is, x forward, y left, metres in the present ego frame.
        score: how good the plan is, the more the higher.
        yaw: (T,) its headings, radians, counter-clockwise; None for the directions of the steps.
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
        checks = {
            "times": times,
            "path": path,
            "yaw": yaw,
            "score": checked_number("score", self.score),
        }
        for name, value in checks.items():
            object.__setattr__(self, name, value)
        FrozenArrays.__post_init__(self)

    def poses(self, times: FloatArray) -> FloatArray:
        """(N, 3) x, y, yaw at times (N,): linear from the present on, straight on after the last stated one.

        Without yaw, it is the direction of the step, kept where that is shorter than 0.1 m.
        """
        missing = int(self.times[0] > 0)
        moments = np.append(np.zeros(missing), self.times)
        path = np.vstack([np.zeros((missing, 2)), self.path])
        steps = np.diff(path, axis=0)
        if self.yaw is None:
            turns = np.append(True, np.hypot(*steps.T) >= _TURNS)  # the first has none
            last = np.maximum.accumulate(np.where(turns, np.arange(len(path)), 0))
            yaw = np.append(0.0, np.arctan2(steps[:, 1], steps[:, 0]))[last]
        else:
            yaw = np.append(np.zeros(missing), self.yaw)
        values = np.column_stack([path, np.unwrap(yaw)])
        if len(path) > 1:
            onward = (*steps[-1] * (_ONWARD / (moments[-1] - moments[-2])), 0.0)
            moments, values = (
                np.append(moments, moments[-1] + _ONWARD),
                np.vstack([values, values[-1] + onward]),
            )
        return np.column_stack([np.interp(times, moments, each) for each in values.T])


# Seconds for which paths go straight on.
_ONWARD: Final = 1000.0
# Metres: a shorter step keeps the heading.
_TURNS: Final = 0.1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlanningScene(FrozenArrays):
    """What a plan meets, from a sample's present on; the present ego frame, metres, seconds, radians.

    Arrays are read-only. F frames at 10 Hz from the present to the recording's end; A other actors.

    Attributes:
        scenario: token.
        recorded: (F, 3) x, y, yaw of the ego frame.
        before: (2,) m/s: the ego's velocity over the frame before the present; of the first frame, after it.
        size: (2,) length and width of the ego's box.
        offset: (2,) its centre in the ego frame.
        actor_id: (A,) of the others.
        footprint: (F, A, 5) x, y, length, width, yaw of the others; NaN where nobody annotated them.
        is_pedestrian: (A,).
        seen: (A,) whether the agent sees it at the present (docs/released_code.md, Visibility and attributes).
        is_twin: whether nobody collides here, but somebody does in the scenario's twin.
        is_collider: whether the agent is one of the pair, of a twin in its accident.
        partner: (A,) which is the other of the pair; none unless the agent collides here.
        to_end: seconds to the last frame of the accident, also of that of a twin; NaN without one.
        to_contact: the same to the frame at which the pair begins to touch (`Contact.contact_frame`); NaN without one.
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
    """What a plan of a sample's agent meets, from the labels of all agents.

    Args:
        dataset: the release.
        sample: token or record.
        cut: whether a twin ends where its accident does, and an accident at the last frame that shows the pair.

    Raises:
        TokenError: no such sample.
        EvaluationError: the label has no row of the agent itself, as that of the roadside.
        NotAvailableError: the sample has no label, or the scenario no meta file.
    """
    there = labelled_sample(dataset, sample)
    token, agent = there["token"], dataset.get("agent", there["agent_token"])
    boxes = dataset.boxes(token, "ego")
    own = np.flatnonzero(boxes.actor_id == OWN_ACTOR_ID)
    if not len(own):
        raise EvaluationError(
            f"{token}: its label has no row of the agent itself (id {OWN_ACTOR_ID}), as that of the roadside, which "
            "does not drive; leave such samples out (--agents vehicles)"
        )
    scenario, present = dataset.scenario.get(there["scenario_token"]), int(token.rsplit("/", 1)[1])
    twin, last = twin_of(dataset, scenario), scenario["num_frames"]
    stories = [tried(accident_of, dataset, each) for each in (scenario, twin) if each is not None]
    accident = next((each for each in stories if isinstance(each, Accident)), None)
    if accident is not None and cut:
        last = max(present, min(last, accident.last_frame))
    truth = box_truth(dataset, token, (last - present) * FRAME_PERIOD)
    others = np.flatnonzero(truth.actor_id != agent["actor_id"])
    actors, tracks = truth.actor_id[others], scenario_tracks(dataset, scenario)
    walkers = tracks.actor_id[tracks.boxes.category == CATEGORIES.index("pedestrian")]
    is_twin = accident is not None and accident.scenario != scenario["token"]
    is_collider = accident is not None and agent["name"] in accident.agents
    pair = accident.actor_ids if accident is not None and is_collider and not is_twin else ()
    end = np.nan if accident is None else (accident.last_frame - present) * FRAME_PERIOD
    touching = None if accident is None else accident.touching
    poses = _ego_poses(dataset, token, present, last)
    return PlanningScene(
        scenario=scenario["token"],
        recorded=poses[1:],
        before=(poses[1] - poses[0])[:2] / FRAME_PERIOD,
        size=boxes.size[own[0], :2].copy(),
        offset=boxes.center[own[0], :2].copy(),
        actor_id=actors,
        footprint=truth.footprint[:, others],
        is_pedestrian=np.isin(actors, walkers),
        seen=np.isin(actors, visible_actors(dataset, token, agents=[agent["name"]])),
        is_twin=is_twin,
        is_collider=is_collider,
        partner=np.isin(actors, pair),
        to_end=end,
        to_contact=np.nan if touching is None else end - touching,
    )


def _ego_poses(dataset: Dataset, token: str, present: int, last: int) -> FloatArray:
    """(1 + F, 3) x, y, yaw of the ego frame from the frame before the present on; of the first one, as if uniform."""
    row = dataset.getind("sample", token)
    frames = row + np.arange(1 - min(present, 2), last - present + 1)
    world_from_ego = stored_transforms(dataset.columns("ego_pose")["matrix"][frames])
    present_from_ego = inverses(world_from_ego[[min(present, 2) - 1]]) @ world_from_ego
    yaw = np.unwrap(np.arctan2(present_from_ego[:, 1, 0], present_from_ego[:, 0, 0]))
    poses = np.column_stack([present_from_ego[:, 0, 3], present_from_ego[:, 1, 3], yaw])
    if present > 1:
        return poses
    return np.vstack([2 * poses[0] - poses[min(1, len(poses) - 1)], poses])


# m/s² of full braking.
BRAKING: Final = 8.0
# Seconds that these plans look ahead, at least.
_REACH: Final = 3.0


def trivial_plans(scene: PlanningScene) -> Mapping[str, Plan]:
    """The plans that every evaluation is compared with: they need no planner, and two of them the recording.

    `recorded` (all that is left of it) and `full braking` (on the recorded path, 8 m/s², nobody is sped up) have steps
    of 0.1 s, `standing` (at once) and `constant velocity` of 0.5 s; they look at least 3 s ahead.
    """
    fine = steps_of(FRAME_PERIOD, max(_REACH, scene.duration))
    coarse = steps_of(0.5, _REACH)
    poses = {
        "recorded": (fine, recorded_poses(scene, fine)),
        "standing": (coarse, np.zeros((len(coarse), 3))),
        "constant velocity": (coarse, coarse[:, None] * np.append(scene.before, 0.0)),
        "full braking": (fine, recorded_poses(scene, fine, 0.0)),
    }
    return {
        name: Plan(times=times, path=each[:, :2], yaw=each[:, 2])
        for name, (times, each) in poses.items()
    }


def steps_of(step: float, until: float) -> FloatArray:
    """(N,) the seconds of steps up to a time."""
    return np.asarray(
        np.arange(1, math.floor(until / step + _SAME_TIME) + 1, dtype=np.float64) * step
    )


# Share of a step by which a time that is meant to be a step's may miss it.
_SAME_TIME: Final = 1e-6


def recorded_poses(
    scene: PlanningScene, times: FloatArray, braking_from: float = np.inf
) -> FloatArray:
    """(N, 3) x, y, yaw of the recorded ego frame at times (N,), after its end straight on; braking from a time on."""
    if len(scene.recorded) < 2:
        return np.zeros((len(times), 3))
    motion = motion_of(scene.recorded, horizon=_ONWARD)
    plans = braking_plans(motion, [braking_from], BRAKING)
    return replay(motion, plans, np.zeros(len(times), dtype=np.int64), times).poses
