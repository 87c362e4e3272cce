"""`Plan`: a path that an agent plans to drive; `PlanningScene`: all that it meets; plans that need no planner."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from deepaccident_devkit.accidents.recorded import Accident, accident_of
from deepaccident_devkit.accidents.replay import braking_plans, motion_of, replay
from deepaccident_devkit.accidents.twins import twin_of
from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import EvaluationError, GeometryError, NotAvailableError
from deepaccident_devkit.evaluation.accident_truth import labelled_sample
from deepaccident_devkit.evaluation.predictions import ascending_times
from deepaccident_devkit.geometry.conventions import inverses, stored_transforms
from deepaccident_devkit.support.arrays import (
    BoolArray,
    FloatArray,
    FrozenArrays,
    IntArray,
    checked,
    checked_number,
)
from deepaccident_devkit.taxonomy import CATEGORIES, FRAME_PERIOD, INFRASTRUCTURE, OWN_ACTOR_ID
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
        if not np.isfinite(path).all() or (yaw is not None and not np.isfinite(yaw).all()):
            raise GeometryError("path: not all numbers are finite; leave out what is not planned")
        checks = {"times": times, "path": path, "yaw": yaw, "score": checked_number("score", self.score)}
        for name, value in checks.items():
            object.__setattr__(self, name, value)
        FrozenArrays.__post_init__(self)

    def poses(self, times: FloatArray) -> FloatArray:
        """(N, 3) x, y, yaw at times (N,): linear from the present on, straight on after the last stated one.

        Without yaw, it is the direction of the step, kept where that is shorter than 0.1 m.
        """
        moments, path = self.times, self.path
        if moments[0] > 0:
            moments, path = np.append(0.0, moments), np.vstack([np.zeros((1, 2)), path])
        steps = np.diff(path, axis=0)
        if self.yaw is None:
            yaw = _directions(steps)
        else:
            yaw = np.unwrap(np.append(np.zeros(len(path) - len(self.yaw)), self.yaw))
        if len(path) > 1:
            onward = steps[-1] / (moments[-1] - moments[-2])
            moments = np.append(moments, moments[-1] + _ONWARD)
            path, yaw = np.vstack([path, path[-1] + onward * _ONWARD]), np.append(yaw, yaw[-1])
        return np.column_stack([np.interp(times, moments, each) for each in (*path.T, yaw)])


_ONWARD: Final = 1000.0
"""Seconds for which paths go straight on."""
_TURNS: Final = 0.1
"""Metres: a shorter step keeps the heading."""


def _directions(steps: FloatArray) -> FloatArray:
    """(T + 1,) headings of a path of T steps, which have those of the steps that lead there; 0 at first."""
    turns = np.hypot(*steps.T) >= _TURNS
    last = np.maximum.accumulate(np.where(turns, np.arange(1, len(steps) + 1), 0))
    directions = np.append(0.0, np.arctan2(steps[:, 1], steps[:, 0]))
    return np.asarray(np.unwrap(directions[np.append(0, last)]))


Kind = Literal["accident", "twin", "other"]
"""Of a recording: somebody collides; somebody does in its twin; neither is known."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlanningScene(FrozenArrays):
    """What a plan meets, from a sample's present on; the present ego frame, metres, seconds, radians.

    Arrays are read-only. F frames at 10 Hz from the present to the recording's end, of a twin at most to the frame at
    which its accident ends; A other actors.

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
        kind: of the recording.
        is_collider: whether the agent is one of the pair, of a twin in its accident.
        partner: actor id of the other of the pair; None unless the agent collides here.
        to_end: seconds to the last frame of the accident, also of that of a twin; NaN for others.
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
    kind: Kind
    is_collider: bool
    partner: int | None
    to_end: float
    to_contact: float

    @property
    def duration(self) -> float:
        """Seconds to the last frame."""
        return float((len(self.recorded) - 1) * FRAME_PERIOD)


def planning_scene(dataset: Dataset, sample: RowArgument) -> PlanningScene:
    """What a plan of a sample's agent meets, from the labels of all agents.

    Raises:
        TokenError: no such sample.
        EvaluationError: the agent is the roadside, which does not drive, or its label has no row of its own.
        NotAvailableError: the sample has no label.
    """
    there = labelled_sample(dataset, sample)
    token, agent = there["token"], dataset.get("agent", there["agent_token"])
    if agent["name"] == INFRASTRUCTURE:
        raise EvaluationError(f"{token}: the roadside does not drive; leave its samples out (--agents vehicles)")
    scenario, present = dataset.get("scenario", there["scenario_token"]), int(token.rsplit("/", 1)[1])
    boxes = dataset.boxes(token, "ego")
    own = np.flatnonzero(boxes.actor_id == OWN_ACTOR_ID)
    if not len(own):
        raise EvaluationError(f"{token}: its label has no row of the agent itself (id {OWN_ACTOR_ID})")
    kind, accident = _story(dataset, scenario["token"])
    last = scenario["num_frames"]
    if accident is not None:
        last = max(present, min(last, accident.last_frame))
    poses = _ego_poses(dataset, token, present, last)
    tracks = scenario_tracks(dataset, scenario)
    inside = (tracks.index >= present) & (tracks.index <= last) & (tracks.actor_id != agent["actor_id"])
    rows = np.flatnonzero(inside)
    moved = tracks.boxes.select(rows).transform(dataset.world_from(token, "ego").inverse(), "ego")
    actors, first, which = np.unique(moved.actor_id, return_index=True, return_inverse=True)
    footprint = np.full((last - present + 1, len(actors), 5), np.nan)
    outlines = np.column_stack([moved.center[:, :2], moved.size[:, :2], moved.yaw])
    footprint[tracks.index[rows] - present, which] = outlines
    is_collider = accident is not None and agent["name"] in accident.agents
    ids = accident.actor_ids if accident is not None and kind == "accident" else ()
    end = np.nan if accident is None else (accident.last_frame - present) * FRAME_PERIOD
    touching = None if accident is None else accident.touching
    return PlanningScene(
        scenario=scenario["token"],
        recorded=poses[1:],
        before=(poses[1] - poses[0])[:2] / FRAME_PERIOD,
        size=boxes.size[own[0], :2].copy(),
        offset=boxes.center[own[0], :2].copy(),
        actor_id=actors,
        footprint=footprint,
        is_pedestrian=moved.category[first] == CATEGORIES.index("pedestrian"),
        seen=np.isin(actors, visible_actors(dataset, token, agents=[agent["name"]])),
        kind=kind,
        is_collider=is_collider,
        partner=next((each for each in ids if is_collider and each != agent["actor_id"]), None),
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


def _story(dataset: Dataset, scenario: str) -> tuple[Kind, Accident | None]:
    """The accident of a scenario, or of its twin; None where there is none, or no label shows the pair."""
    twin = twin_of(dataset, scenario)
    for kind, token in (("accident", scenario), ("twin", None if twin is None else twin["token"])):
        try:
            found = None if token is None else accident_of(dataset, token)
        except NotAvailableError:
            continue
        if found is not None:
            return kind, found  # type: ignore[return-value]  # of the two that are listed
    return "other", None


BRAKING: Final = 8.0
"""m/s² of full braking."""
_REACH: Final = 3.0
_STEP: Final = 0.5
"""Seconds."""


def trivial_plans(scene: PlanningScene) -> Mapping[str, Plan]:
    """The plans that every evaluation is compared with: they need no planner, and two of them the recording.

    `recorded` (all that is left of it) and `full braking` (on the recorded path, 8 m/s², nobody is sped up) have steps
    of 0.1 s, `standing` (at once) and `constant velocity` of 0.5 s; they look at least 3 s ahead.
    """
    fine = steps_of(FRAME_PERIOD, max(_REACH, scene.duration))
    coarse = steps_of(_STEP, _REACH)
    nowhere = np.zeros(len(coarse))
    return {
        "recorded": _plan_of(fine, recorded_poses(scene, fine)),
        "standing": Plan(times=coarse, path=np.zeros((len(coarse), 2)), yaw=nowhere),
        "constant velocity": Plan(times=coarse, path=coarse[:, None] * scene.before, yaw=nowhere),
        "full braking": _plan_of(fine, _braked(scene, fine, 0.0)),
    }


def steps_of(step: float, until: float) -> FloatArray:
    """(N,) the seconds of steps up to a time."""
    return np.asarray(np.arange(1, math.floor(until / step + _SAME_TIME) + 1, dtype=np.float64) * step)


_SAME_TIME: Final = 1e-6
"""Share of a step by which a time that is meant to be a step's may miss it."""


def recorded_poses(scene: PlanningScene, times: FloatArray) -> FloatArray:
    """(N, 3) x, y, yaw of the recorded ego frame at times (N,), after its end straight on."""
    return _braked(scene, times, np.inf)


def _plan_of(times: FloatArray, poses: FloatArray) -> Plan:
    return Plan(times=times, path=poses[:, :2], yaw=poses[:, 2])


def _braked(scene: PlanningScene, times: FloatArray, start: float) -> FloatArray:
    """(N, 3) poses at times on the recorded path, braking from some time on."""
    if len(scene.recorded) < 2:
        return np.zeros((len(times), 3))
    motion = motion_of(scene.recorded, horizon=_ONWARD)
    plans = braking_plans(motion, [start], BRAKING)
    return replay(motion, plans, np.zeros(len(times), dtype=np.int64), times).poses
