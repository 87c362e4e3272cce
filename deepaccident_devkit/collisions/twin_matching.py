"""Which frames and actors of a recording correspond to which of its twin.

The two recordings may start at different times, and give the same actor different ids.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np

from deepaccident_devkit.collisions.recorded import Accident, accident_of
from deepaccident_devkit.collisions.twins import twin_of
from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.support.arrays import AnyArray, FloatArray, FrozenArrays, IntArray
from deepaccident_devkit.taxonomy import AgentName
from deepaccident_devkit.v2x.agents import agents_of
from deepaccident_devkit.v2x.tracks import scenario_tracks

MatchedBy = Literal["agent", "id", "start"]
# Actors of one class can only be the same actor if they are at most this many metres apart in
# the first frame that shows both.
START_DISTANCE: Final = 2.0
# Largest number of frames by which one recording may start later than the other.
MAX_SHIFT: Final = 20
# Number of frames at the start that determine the shift.
_COMPARED_FRAMES = 20
# Distance in metres at which an agent's cost is capped; beyond it, the agent takes another path.
_DISTANCE_CAP_M = 2.0
# Reduction of the mean distance that a larger shift must achieve.
_MIN_IMPROVEMENT_M = 0.01
# Fewest agents with equal ids from which equal ids are taken to mean equal actors.
_MIN_COMMON_AGENTS = 2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TwinRecording(FrozenArrays):
    """The N actors of a scenario over its F frames, from the labels of all agents.

    Poses are in the world frame, in metres and radians.

    Attributes:
        scenario: Token of the scenario.
        actor_id: CARLA ids, shape (N,), ascending.
        category: Indices in `taxonomy.CATEGORIES`, shape (N,).
        size: Length, width and height from the actor's last label, shape (N, 3).
        poses: x, y, yaw, shape (N, F, 3); NaN in frames in which no agent annotated the actor.
        speeds: Speeds over the ground in m/s, shape (N, F); NaN likewise.
        agents: Name of each recording vehicle → its id, where the meta file states it.
    """

    scenario: str
    actor_id: IntArray
    category: AnyArray
    size: FloatArray
    poses: FloatArray
    speeds: FloatArray
    agents: Mapping[AgentName, int]


def twin_recording(dataset: Dataset, scenario: str) -> TwinRecording:
    """Collect the actors of a scenario as arrays.

    Raises:
        TokenError: If the release has no such scenario.
        NotAvailableError: If the scenario has no labels.
    """
    tracks = scenario_tracks(dataset, scenario)
    if not len(tracks.index):
        raise NotAvailableError(
            f"{scenario} has no labels (the test split has none), which say where actors are"
        )
    frames = dataset.scenario.get(scenario)["num_frames"]
    ids, first_rows, rows = np.unique(tracks.actor_id, return_index=True, return_inverse=True)
    boxes = tracks.boxes
    columns = tracks.index - 1
    poses = np.full((len(ids), frames, 3), np.nan)
    poses[rows, columns] = np.column_stack([boxes.center[:, :2], boxes.yaw])
    speeds = np.full((len(ids), frames), np.nan)
    speeds[rows, columns] = np.linalg.norm(boxes.velocity[:, :2], axis=1)
    size = np.zeros((len(ids), 3))
    size[rows] = boxes.size
    agents = {}
    for name in agents_of(dataset, scenario):
        actor_id = dataset.agent.get(f"{scenario}/{name}")["actor_id"]
        if actor_id is not None:
            agents[name] = actor_id
    return TwinRecording(
        scenario=scenario,
        actor_id=ids,
        category=boxes.category[first_rows],
        size=size,
        poses=poses,
        speeds=speeds,
        agents=agents,
    )


def twin_recordings(
    dataset: Dataset, scenario: RowArgument
) -> tuple[Accident, TwinRecording, TwinRecording]:
    """Return the accident, its recording, and the recording of its twin.

    Args:
        dataset: The release.
        scenario: Token or record of the accident or of its twin.

    Raises:
        TokenError: If the release has no such scenario.
        NotAvailableError: If the release does not contain the scenario's twin, neither of the two
            ends in an accident, one of them has no labels, or `accident_of` raises it.
    """
    record = dataset.scenario[dataset.getind("scenario", scenario)]
    twin = twin_of(dataset, record)
    if twin is None:
        raise NotAvailableError(
            f"{record['token']}: this release has no twin of it, with the same name and subtype"
        )
    if record["collision"] is None and twin["collision"] is not None:
        twin, record = record, twin
    accident = accident_of(dataset, record)
    if accident is None:
        raise NotAvailableError(f"{record['token']}: neither it nor its twin ends in an accident")
    recording = twin_recording(dataset, record["token"])
    return accident, recording, twin_recording(dataset, twin["token"])


def shift_of(recording: TwinRecording, twin: TwinRecording) -> int:
    """Return how much higher the frame numbers are in the twin than in the recording.

    Twins may start at slightly different times. The shift is chosen so that the mean distance
    between each agent and the same agent in the twin is smallest over the first two seconds.
    Distances are capped at `_DISTANCE_CAP_M`. Without a clear minimum, the shift is 0.
    """
    pairs = _agent_rows(recording, twin)
    if not pairs:
        return 0
    num_frames = recording.poses.shape[1]
    twin_frames = twin.poses.shape[1]
    compared = min(_COMPARED_FRAMES, num_frames, twin_frames)
    best_shift = 0
    lowest_cost = np.inf
    for shift in sorted(range(-MAX_SHIFT, MAX_SHIFT + 1), key=abs):
        begin = max(0, -shift)
        end = min(begin + compared, num_frames, twin_frames - shift)
        if end - begin < compared:
            continue
        twin_poses = twin.poses[list(pairs.values()), begin + shift : end + shift]
        offset = twin_poses - recording.poses[list(pairs), begin:end]
        distance = np.minimum(np.hypot(offset[..., 0], offset[..., 1]), _DISTANCE_CAP_M)
        if np.isnan(distance).all():
            continue
        cost = float(np.nanmean(distance))
        if cost < lowest_cost - _MIN_IMPROVEMENT_M:
            best_shift = shift
            lowest_cost = cost
    return best_shift


def shifted_recording(recording: TwinRecording, shift: int) -> TwinRecording:
    """Delay the recording by `shift` frames; values before its start are NaN."""
    if not shift:
        return recording
    begin = max(shift, 0)
    poses = recording.poses[:, begin:]
    speeds = recording.speeds[:, begin:]
    padding = ((0, 0), (max(-shift, 0), 0))
    return replace(
        recording,
        poses=np.pad(poses, (*padding, (0, 0)), constant_values=np.nan),
        speeds=np.pad(speeds, padding, constant_values=np.nan),
    )


def matched_rows(recording: TwinRecording, twin: TwinRecording) -> dict[int, tuple[int, MatchedBy]]:
    """Match the actors of a recording to the actors of its twin.

    Agents are matched by name. If at least two agents are in both recordings, and the ids of all of
    these are equal, then actors with equal ids and classes are matched too. The others are matched
    by their first positions, in the first frame that shows both: actors of one class that are at
    most `START_DISTANCE` apart are matched one to one, so that the sum of distances is smallest.

    Returns:
        Index of an actor in the recording → its index in the twin, and how they were matched.
    """
    matches: dict[int, tuple[int, MatchedBy]] = {}
    for row, twin_row in _agent_rows(recording, twin).items():
        matches[row] = (twin_row, "agent")
    if _shares_ids(recording, twin):
        twin_row_by_id = _rows_by_id(twin)
        for actor, row in _rows_by_id(recording).items():
            if row in matches or actor not in twin_row_by_id:
                continue
            twin_row = twin_row_by_id[actor]
            if recording.category[row] == twin.category[twin_row]:
                matches[row] = (twin_row, "id")
    for row, twin_row in _match_by_start(recording, twin, matches):
        matches[row] = (twin_row, "start")
    return matches


def _shares_ids(recording: TwinRecording, twin: TwinRecording) -> bool:
    """Return whether enough agents are in both recordings, and the ids of all of them agree."""
    common_agents = recording.agents.keys() & twin.agents.keys()
    has_equal_ids = [recording.agents[name] == twin.agents[name] for name in common_agents]
    return len(common_agents) >= _MIN_COMMON_AGENTS and all(has_equal_ids)


def _agent_rows(recording: TwinRecording, twin: TwinRecording) -> dict[int, int]:
    """Map the index of each vehicle that records in both recordings to its index in the twin."""
    row_by_id = _rows_by_id(recording)
    twin_row_by_id = _rows_by_id(twin)
    rows = {}
    for name, actor in recording.agents.items():
        twin_actor = twin.agents.get(name)
        if actor in row_by_id and twin_actor in twin_row_by_id:
            row = row_by_id[actor]
            rows[row] = twin_row_by_id[twin_actor]
    return rows


def _rows_by_id(recording: TwinRecording) -> dict[int | None, int]:
    """Return the index of each actor by its id."""
    rows = range(len(recording.actor_id))
    return dict(zip(recording.actor_id.tolist(), rows, strict=True))


def _match_by_start(
    recording: TwinRecording, twin: TwinRecording, matches: Mapping[int, tuple[int, MatchedBy]]
) -> list[tuple[int, int]]:
    """Match the remaining actors that start near each other; return their pairs of indices."""
    from scipy.optimize import linear_sum_assignment

    matched_twin_rows = [twin_row for twin_row, _ in matches.values()]
    rows = np.setdiff1d(np.arange(len(recording.actor_id)), list(matches))
    twin_rows = np.setdiff1d(np.arange(len(twin.actor_id)), matched_twin_rows)
    distance = _start_distances(recording, twin)[np.ix_(rows, twin_rows)]
    is_near = distance <= START_DISTANCE
    cost = np.where(is_near, distance, 1e3 * START_DISTANCE)
    indices, twin_indices = linear_sum_assignment(cost)
    is_match = is_near[indices, twin_indices]
    start_rows = rows[indices[is_match]].tolist()
    twin_start_rows = twin_rows[twin_indices[is_match]].tolist()
    return list(zip(start_rows, twin_start_rows, strict=True))


def _start_distances(recording: TwinRecording, twin: TwinRecording) -> FloatArray:
    """Return the distances in metres in the first frame that shows both actors, shape (N, M).

    They are infinite for actors of different classes, and if no frame shows both.
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
