"""Matching of a recording to its twin: which frames and actors correspond.

The clocks and the ids of the two recordings may differ.
"""

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
# Largest distance in metres, at the first frame that shows both, of two actors of one class that
# may be the same actor.
START_DISTANCE: Final = 2.0
# Largest number of frames by which one recording may begin later than the other.
MAX_SHIFT: Final = 20
# Number of frames at the beginning that decide the shift.
_COMPARED_FRAMES: Final = 20
# Distance in metres at which the cost of an agent is capped: farther away, it goes its own way.
_DISTANCE_CAP_M: Final = 2.0
# Improvement of the mean distance in metres that a larger shift must bring.
_MIN_IMPROVEMENT_M: Final = 0.01
# Smallest number of agents with equal ids for which equal ids mean the same actors.
_MIN_COMMON_AGENTS: Final = 2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TwinRecording(FrozenArrays):
    """The N actors of a scenario over its F frames, from all agents' labels.

    Poses are in the world frame, metres, radians.

    Attributes:
        scenario: Token of the scenario.
        actor_id: CARLA ids, shape (N,), ascending.
        category: Indices in `taxonomy.CATEGORIES`, shape (N,).
        size: Length, width, height by the last label, shape (N, 3).
        poses: x, y, yaw, shape (N, F, 3); NaN at frames at which nobody annotated the actor.
        speeds: Speeds over the ground in m/s, shape (N, F); NaN likewise.
        agents: Vehicles that record → their ids, as far as meta names them.
    """

    scenario: str
    actor_id: IntArray
    category: AnyArray
    size: FloatArray
    poses: FloatArray
    speeds: FloatArray
    agents: Mapping[AgentName, int]


def twin_recording(dataset: Dataset, scenario: str) -> TwinRecording:
    """Return a scenario's actors as arrays.

    Raises:
        TokenError: There is no such scenario.
        NotAvailableError: The scenario has no labels.
    """
    tracks = scenario_tracks(dataset, scenario)
    if not len(tracks.index):
        raise NotAvailableError(
            f"{scenario} has no labels (the test split ships without), which say where actors are"
        )
    frames = dataset.scenario.get(scenario)["num_frames"]
    ids, first_rows, rows = np.unique(tracks.actor_id, return_index=True, return_inverse=True)
    boxes, columns = tracks.boxes, tracks.index - 1
    poses, speeds = np.full((len(ids), frames, 3), np.nan), np.full((len(ids), frames), np.nan)
    poses[rows, columns] = np.column_stack([boxes.center[:, :2], boxes.yaw])
    speeds[rows, columns] = np.linalg.norm(boxes.velocity[:, :2], axis=1)
    size = np.zeros((len(ids), 3))
    size[rows] = boxes.size
    actors = {
        name: dataset.agent.get(f"{scenario}/{name}")["actor_id"]
        for name in agents_of(dataset, scenario)
    }
    return TwinRecording(
        scenario=scenario,
        actor_id=ids,
        category=boxes.category[first_rows],
        size=size,
        poses=poses,
        speeds=speeds,
        agents={name: actor for name, actor in actors.items() if actor is not None},
    )


def shift_of(recording: TwinRecording, twin: TwinRecording) -> int:
    """Return how much higher the frame number of a moment is in the twin than in the recording.

    Twins may begin at slightly different moments. The shift is the one with the smallest mean
    distance between each agent and itself in the twin over the first two seconds, with distances
    capped at `_DISTANCE_CAP_M`. Without a clear answer it is 0.
    """
    pairs = _agent_rows(recording, twin)
    num_frames, twin_frames = recording.poses.shape[1], twin.poses.shape[1]
    compared = min(_COMPARED_FRAMES, num_frames, twin_frames)
    best_shift, lowest_cost = 0, np.inf
    for shift in sorted(range(-MAX_SHIFT, MAX_SHIFT + 1), key=abs):
        begin = max(0, -shift)
        end = min(begin + compared, num_frames, twin_frames - shift)
        if not pairs or end - begin < compared:
            continue
        twin_poses = twin.poses[list(pairs.values()), begin + shift : end + shift]
        offset = twin_poses - recording.poses[list(pairs), begin:end]
        distance = np.minimum(np.hypot(offset[..., 0], offset[..., 1]), _DISTANCE_CAP_M)
        if np.isnan(distance).all():
            continue
        cost = float(np.nanmean(distance))
        if cost < lowest_cost - _MIN_IMPROVEMENT_M:
            best_shift, lowest_cost = shift, cost
    return best_shift


def shifted_recording(recording: TwinRecording, shift: int) -> TwinRecording:
    """Return the recording on a clock that starts `shift` frames later; NaN before its start."""
    if not shift:
        return recording
    poses, speeds = recording.poses[:, max(shift, 0) :], recording.speeds[:, max(shift, 0) :]
    before = ((0, 0), (max(-shift, 0), 0))
    return replace(
        recording,
        poses=np.pad(poses, (*before, (0, 0)), constant_values=np.nan),
        speeds=np.pad(speeds, before, constant_values=np.nan),
    )


def matched_rows(recording: TwinRecording, twin: TwinRecording) -> dict[int, tuple[int, MatchedBy]]:
    """Match the actors of a recording to the actors of its twin, which begins alike.

    Agents are matched by their names. If at least two agents are in both recordings, and all of
    these have equal ids, then actors of equal ids and classes are the same. The others are matched
    by where they start: at the first frame that shows both, actors of one class that are at most
    `START_DISTANCE` apart, one to one, so that the sum of the distances is smallest.

    Returns:
        Row of the recording → row of the twin, and what they were matched by.
    """
    matches: dict[int, tuple[int, MatchedBy]] = {
        row: (twin_row, "agent") for row, twin_row in _agent_rows(recording, twin).items()
    }
    rows, twin_rows = _rows_by_id(recording), _rows_by_id(twin)
    common = [name for name in recording.agents if name in twin.agents]
    if len(common) >= _MIN_COMMON_AGENTS and all(
        recording.agents[name] == twin.agents[name] for name in common
    ):
        for actor, row in rows.items():
            twin_row = twin_rows.get(actor)
            if (
                row not in matches
                and twin_row is not None
                and recording.category[row] == twin.category[twin_row]
            ):
                matches[row] = (twin_row, "id")
    for row, twin_row in _match_by_start(recording, twin, matches):
        matches[row] = (twin_row, "start")
    return matches


def _agent_rows(recording: TwinRecording, twin: TwinRecording) -> dict[int, int]:
    """Return row → row of the twin for the vehicles that record in both."""
    rows, twin_rows = _rows_by_id(recording), _rows_by_id(twin)
    actor_pairs = [(actor, twin.agents.get(name)) for name, actor in recording.agents.items()]
    return {
        rows[actor]: twin_rows[twin_actor]
        for actor, twin_actor in actor_pairs
        if actor in rows and twin_actor in twin_rows
    }


def _rows_by_id(recording: TwinRecording) -> dict[int | None, int]:
    return {actor: row for row, actor in enumerate(recording.actor_id.tolist())}


def _match_by_start(
    recording: TwinRecording, twin: TwinRecording, matches: Mapping[int, tuple[int, MatchedBy]]
) -> list[tuple[int, int]]:
    """Match unmatched actors that start near each other; return their rows and the twin's rows."""
    from scipy.optimize import linear_sum_assignment

    matched_twin_rows = [twin_row for twin_row, _ in matches.values()]
    rows = np.setdiff1d(np.arange(len(recording.actor_id)), list(matches))
    twin_rows = np.setdiff1d(np.arange(len(twin.actor_id)), matched_twin_rows)
    distance = _start_distances(recording, twin)[np.ix_(rows, twin_rows)]
    is_near = distance <= START_DISTANCE
    cost = np.where(is_near, distance, 1e3 * START_DISTANCE)
    assignment = zip(*linear_sum_assignment(cost), strict=True)
    return [
        (int(rows[index]), int(twin_rows[twin_index]))
        for index, twin_index in assignment
        if is_near[index, twin_index]
    ]


def _start_distances(recording: TwinRecording, twin: TwinRecording) -> FloatArray:
    """Return the distances in metres at the first frame that shows both actors, shape (N, M).

    Infinite for actors of different classes, and without such a frame.
    """
    start = np.argmax(~np.isnan(recording.poses[..., 0]), axis=1)
    twin_start = np.argmax(~np.isnan(twin.poses[..., 0]), axis=1)
    frame = np.maximum(start[:, None], twin_start)
    is_recorded = frame < min(recording.poses.shape[1], twin.poses.shape[1])
    frame = np.where(is_recorded, frame, 0)
    position = recording.poses[np.arange(len(start))[:, None], frame, :2]
    twin_position = twin.poses[np.arange(len(twin_start)), frame, :2]
    offset = position - twin_position
    distance = np.hypot(offset[..., 0], offset[..., 1])
    is_same_class = recording.category[:, None] == twin.category
    is_comparable = is_recorded & is_same_class & ~np.isnan(distance)
    return np.where(is_comparable, distance, np.inf)
