"""Recordings that occur in two parts of a split, completely or partly, under any names.

They are recognised by road users that are at the same places at the same time.
"""

from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from deepaccident_devkit.release import ScenarioFolder, read_labels
from deepaccident_devkit.release.calib import read_calibs
from deepaccident_devkit.release.labels import world_from_label_velocity
from deepaccident_devkit.release.layout import frame_numbers
from deepaccident_devkit.support.arrays import IntArray
from deepaccident_devkit.taxonomy import AGENTS, FRAME_PERIOD, STATIC_ACTOR_ID

# Fewest moving road users at the same places at one time that show that recordings are the same.
MIN_SHARED_ROAD_USERS = 3
# Size of a cell of the world. Agents agree on the position of an actor within 0.1 mm in the real
# release, and within 1 cm in synthetic releases.
_CELL_M = 0.05
# Speed from which a road user counts as moving.
_MIN_SPEED_MPS = 0.5
# Number of frames, including the current one, for which positions are predicted: a part may
# continue where another ends, or lack some frames in between.
_PREDICTED_FRAMES = 4
# Number of cells along an axis after which cell numbers repeat.
_CELL_COUNT = 1_000_003


def places_in(scenario: ScenarioFolder) -> IntArray:
    """Return where a recording's moving road users and parked cars are now and in the near future.

    A place is a number that combines an actor and a cell of the world.

    Returns:
        Distinct places, each with the frame in which the actor is there, shape (N, 2).

    Raises:
        DatarootError: If a folder cannot be listed.
        ReleaseError: If a label or the calib file of its frame cannot be read.
    """
    agent_places = [np.empty((0, 2), dtype=np.int64)]
    for agent in AGENTS:
        frames, _ = frame_numbers(scenario.kind_folder(agent, "label"), "txt")
        labels = read_labels([scenario.label_path(agent, frame) for frame in frames])
        if not len(labels):
            continue
        calibs = read_calibs([scenario.calib_path(agent, frame) for frame in frames])
        world_from_lidar = calibs.world_from_ego @ calibs.ego_from_lidar
        poses = np.repeat(world_from_lidar, labels.num_boxes, axis=0)[:, :2]
        rotations = poses[..., :3]
        translations = poses[..., 3]
        centers = np.einsum("nij,nj->ni", rotations, labels.center) + translations
        velocities = np.nan_to_num(world_from_label_velocity(labels.velocity, labels.yaw))
        is_moving = np.hypot(*velocities.T) > _MIN_SPEED_MPS
        is_used = is_moving | (labels.actor_id >= STATIC_ACTOR_ID)
        actor_ids = labels.actor_id[is_used]
        present_frames = np.repeat(frames, labels.num_boxes)[is_used]
        for frames_ahead in range(_PREDICTED_FRAMES):
            displacements = frames_ahead * FRAME_PERIOD * velocities
            positions = (centers + displacements)[is_used]
            cells = (positions // _CELL_M).astype(np.int64)
            x, y = cells.T % _CELL_COUNT
            places = (actor_ids * _CELL_COUNT + x) * _CELL_COUNT + y
            agent_places.append(np.column_stack([places, present_frames + frames_ahead]))
    all_places = np.concatenate(agent_places)
    _, first_rows = np.unique(all_places[:, 0], return_index=True)
    return all_places[first_rows]


def shared_moments(
    recordings: Sequence[IntArray], other_recordings: Sequence[IntArray]
) -> dict[tuple[int, int], int]:
    """Return the pairs of recordings in two releases that have a road user at the same place.

    Args:
        recordings: Places of each recording in one release, as returned by `places_in`.
        other_recordings: Places of each recording in the other release.

    Returns:
        Indices of the two recordings → the largest number of moving road users at the same places
        at one time; 0 if only parked cars are.
    """
    release_places = np.unique(np.concatenate(recordings)[:, 0])
    moments_by_place = defaultdict(list)
    for other, other_places in enumerate(other_recordings):
        is_shared = np.isin(other_places[:, 0], release_places)
        for place, frame in other_places[is_shared].tolist():
            moments_by_place[place].append((other, frame))
    actors_by_moment = defaultdict(set)
    for row, places in enumerate(recordings):
        for place, frame in places.tolist():
            actor_id = place // _CELL_COUNT**2
            for other, other_frame in moments_by_place.get(place, ()):
                actors_by_moment[row, other, frame, other_frame].add(actor_id)
    max_counts: dict[tuple[int, int], int] = defaultdict(int)
    for (row, other, *_), actors in actors_by_moment.items():
        moving_count = sum(actor < STATIC_ACTOR_ID for actor in actors)
        max_counts[row, other] = max(max_counts[row, other], moving_count)
    return max_counts
