"""Which frame and which actor of a recording is which of its twin's, whose clock and ids may be others."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.support.arrays import AnyArray, FloatArray, FrozenArrays, IntArray
from deepaccident_devkit.taxonomy import AgentName
from deepaccident_devkit.v2x.agents import agents_of
from deepaccident_devkit.v2x.tracks import scenario_tracks

MatchedBy = Literal["agent", "id", "start"]
# Metres between two actors of one class at the first frame that shows both, at most, that may be the same.
START_DISTANCE: Final = 2.0
# Frames by which one recording may begin later than the other, at most.
MOST_SHIFT: Final = 20
# Frames at the beginning by which the shift is found.
_COMPARED: Final = 20
# Metres from which on it does not matter how far an agent is away: it goes its own way.
_CAP: Final = 2.0
# Metres by which a larger shift must be better.
_CLEARLY: Final = 0.01
# Agents with equal ids from which on equal ids are taken to mean the same actors.
_FEWEST_AGENTS: Final = 2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TwinRecording(FrozenArrays):
    """The N actors of a scenario over its F frames, from all agents' labels; world, metres, radians.

    Attributes:
        scenario: token.
        actor_id: (N,) CARLA ids, ascending.
        category: (N,) positions in `taxonomy.CATEGORIES`.
        size: (N, 3) length, width, height by the last label.
        poses: (N, F, 3) x, y, yaw; NaN at frames at which nobody annotated the actor.
        speeds: (N, F) m/s over the ground, likewise.
        agents: the vehicles that record → their ids, as far as meta names them.
    """

    scenario: str
    actor_id: IntArray
    category: AnyArray
    size: FloatArray
    poses: FloatArray
    speeds: FloatArray
    agents: Mapping[AgentName, int]


def twin_recording(dataset: Dataset, scenario: str) -> TwinRecording:
    """A scenario's actors as arrays.

    Raises:
        TokenError: no such scenario.
        NotAvailableError: it has no labels.
    """
    tracks = scenario_tracks(dataset, scenario)
    if not len(tracks.index):
        raise NotAvailableError(
            f"{scenario} has no labels (the test split ships without), which say where actors are"
        )
    frames = dataset.scenario.get(scenario)["num_frames"]
    ids, first, which = np.unique(tracks.actor_id, return_index=True, return_inverse=True)
    poses, speeds = np.full((len(ids), frames, 3), np.nan), np.full((len(ids), frames), np.nan)
    poses[which, tracks.index - 1] = np.column_stack([tracks.boxes.center[:, :2], tracks.boxes.yaw])
    speeds[which, tracks.index - 1] = np.linalg.norm(tracks.boxes.velocity[:, :2], axis=1)
    size = np.zeros((len(ids), 3))
    size[which] = tracks.boxes.size
    own = {
        name: dataset.agent.get(f"{scenario}/{name}")["actor_id"]
        for name in agents_of(dataset, scenario)
    }
    return TwinRecording(
        scenario=scenario,
        actor_id=ids,
        category=tracks.boxes.category[first],
        size=size,
        poses=poses,
        speeds=speeds,
        agents={name: actor for name, actor in own.items() if actor is not None},
    )


def shift_of(first: TwinRecording, second: TwinRecording) -> int:
    """By how many frames the same moment has a higher number in the second recording than in the first.

    Twins may begin at slightly different moments. The shift is the one with which the agents of both are nearest to
    each other in the first two seconds; those that are more than `_CAP` metres apart are left out of account by that.
    Without a clear answer it is 0.
    """
    pairs = _agent_rows(first, second)
    frames = min(_COMPARED, first.poses.shape[1], second.poses.shape[1])
    best, least = 0, np.inf
    for shift in sorted(range(-MOST_SHIFT, MOST_SHIFT + 1), key=abs):
        begin = max(0, -shift)
        end = min(begin + frames, first.poses.shape[1], second.poses.shape[1] - shift)
        if not pairs or end - begin < frames:
            continue
        moved = (
            second.poses[list(pairs.values()), begin + shift : end + shift]
            - first.poses[list(pairs), begin:end]
        )
        apart = np.minimum(np.hypot(moved[..., 0], moved[..., 1]), _CAP)
        if np.isnan(apart).all():
            continue
        cost = float(np.nanmean(apart))
        if cost < least - _CLEARLY:
            best, least = shift, cost
    return best


def shifted_recording(recording: TwinRecording, shift: int) -> TwinRecording:
    """The recording on a clock whose frame 1 is its frame 1 + shift; NaN before its own first frame."""
    if not shift:
        return recording
    poses, speeds = recording.poses[:, max(shift, 0) :], recording.speeds[:, max(shift, 0) :]
    before = ((0, 0), (max(-shift, 0), 0))
    return replace(
        recording,
        poses=np.pad(poses, (*before, (0, 0)), constant_values=np.nan),
        speeds=np.pad(speeds, before, constant_values=np.nan),
    )


def matched_rows(first: TwinRecording, second: TwinRecording) -> dict[int, tuple[int, MatchedBy]]:
    """Which actor of one recording is which of another's that begins alike.

    Agents are matched by their names. If at least two agents are in both recordings, and all of these have equal ids,
    then actors of equal ids and classes are the same. The others are matched by where they start: at the first frame
    that shows both, actors of one class that are at most `START_DISTANCE` apart, each with one other, so that the sum
    of the distances is least.

    Returns:
        Row of the first recording → row of the second, and by what.
    """
    result: dict[int, tuple[int, MatchedBy]] = {
        row: (other, "agent") for row, other in _agent_rows(first, second).items()
    }
    rows, other_rows = _rows_by_id(first), _rows_by_id(second)
    common = [name for name in first.agents if name in second.agents]
    if len(common) >= _FEWEST_AGENTS and all(
        first.agents[name] == second.agents[name] for name in common
    ):
        for actor, row in rows.items():
            other = other_rows.get(actor)
            if (
                row not in result
                and other is not None
                and first.category[row] == second.category[other]
            ):
                result[row] = (other, "id")
    return {**result, **{row: (other, "start") for row, other in _by_start(first, second, result)}}


def _agent_rows(first: TwinRecording, second: TwinRecording) -> dict[int, int]:
    """Row → row of the vehicles that record in both."""
    rows, other_rows = _rows_by_id(first), _rows_by_id(second)
    ids = [(actor, second.agents.get(name)) for name, actor in first.agents.items()]
    return {
        rows[mine]: other_rows[theirs]
        for mine, theirs in ids
        if mine in rows and theirs in other_rows
    }


def _rows_by_id(recording: TwinRecording) -> dict[int | None, int]:
    return {actor: row for row, actor in enumerate(recording.actor_id.tolist())}


def _by_start(
    first: TwinRecording, second: TwinRecording, matched: Mapping[int, tuple[int, MatchedBy]]
) -> list[tuple[int, int]]:
    """Further rows that start near each other."""
    from scipy.optimize import linear_sum_assignment

    left = np.setdiff1d(np.arange(len(first.actor_id)), list(matched))
    right = np.setdiff1d(np.arange(len(second.actor_id)), [other for other, _ in matched.values()])
    apart = _start_distances(first, second)[np.ix_(left, right)]
    near = apart <= START_DISTANCE
    chosen = linear_sum_assignment(np.where(near, apart, 1e3 * START_DISTANCE))
    return [
        (int(left[row]), int(right[column]))
        for row, column in zip(*chosen, strict=True)
        if near[row, column]
    ]


def _start_distances(first: TwinRecording, second: TwinRecording) -> FloatArray:
    """(N, M) metres at the first frame that shows both; infinite for other classes, and if there is no such frame."""
    starts = [np.argmax(~np.isnan(each.poses[..., 0]), axis=1) for each in (first, second)]
    frame = np.maximum(starts[0][:, None], starts[1])
    there = frame < min(first.poses.shape[1], second.poses.shape[1])
    frame = np.where(there, frame, 0)
    apart = (
        first.poses[np.arange(len(starts[0]))[:, None], frame, :2]
        - second.poses[np.arange(len(starts[1])), frame, :2]
    )
    distance = np.hypot(apart[..., 0], apart[..., 1])
    same = there & (first.category[:, None] == second.category) & ~np.isnan(distance)
    return np.where(same, distance, np.inf)
