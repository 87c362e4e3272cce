"""Recordings that occur on two sides of a split, completely or partly and under any names.

They are found by road users that are at the same places at the same moment.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import Final

import numpy as np

from deepaccident_devkit.release import ScenarioFolder, read_labels
from deepaccident_devkit.release.calib import read_calibs
from deepaccident_devkit.release.labels import world_from_label_velocity
from deepaccident_devkit.release.layout import frame_numbers
from deepaccident_devkit.support.arrays import IntArray
from deepaccident_devkit.taxonomy import AGENTS, FRAME_PERIOD, STATIC_ACTOR_ID

# Number of moving road users that two recordings must have at the same places at one moment to be
# the same.
MIN_SHARED_ROAD_USERS: Final = 3
# Size of a cell. Agents agree on the position of an actor within 0.1 mm in the real release, and
# within 1 cm in synthetic ones.
_CELL_M: Final = 0.05
# Smallest speed of a moving road user.
_MIN_SPEED_MPS: Final = 0.5
# Number of frames, including the present, for which a road user's position is predicted: one side
# may continue where the other one ends, or lack some frames in between.
_PREDICTED_FRAMES: Final = 4
# Number of cells along an axis, after which the numbers of cells repeat.
_CELL_COUNT: Final = 1_000_003


def places_in(scenario: ScenarioFolder) -> IntArray:
    """Return where moving road users and parked cars of a recording are, and will be soon.

    Returns:
        Numbers of an actor and a cell of the world, without repetition, and the frame at which the
        actor is there, shape (N, 2).

    Raises:
        DatarootError: A folder cannot be listed.
        ReleaseError: A label cannot be read, or the calib file of its frame.
    """
    parts = [np.empty((0, 2), dtype=np.int64)]
    for agent in AGENTS:
        frames = frame_numbers(scenario.kind_folder(agent, "label"), "txt")[0]
        labels = read_labels([scenario.label_path(agent, frame) for frame in frames])
        if not len(labels):
            continue
        calibs = read_calibs([scenario.calib_path(agent, frame) for frame in frames])
        world_from_lidar = calibs.world_from_ego @ calibs.ego_from_lidar
        poses = np.repeat(world_from_lidar, labels.num_boxes, axis=0)[:, :2]
        centers = np.einsum("nij,nj->ni", poses[..., :3], labels.center) + poses[..., 3]
        velocities = np.nan_to_num(world_from_label_velocity(labels.velocity, labels.yaw))
        is_moving = np.hypot(*velocities.T) > _MIN_SPEED_MPS
        is_used = is_moving | (labels.actor_id >= STATIC_ACTOR_ID)
        actor_ids = labels.actor_id[is_used]
        present_frames = np.repeat(frames, labels.num_boxes)[is_used]
        for frames_ahead in range(_PREDICTED_FRAMES):
            positions = (centers + frames_ahead * FRAME_PERIOD * velocities)[is_used]
            x, y = (positions // _CELL_M).astype(np.int64).T % _CELL_COUNT
            places = (actor_ids * _CELL_COUNT + x) * _CELL_COUNT + y
            parts.append(np.column_stack([places, present_frames + frames_ahead]))
    all_places = np.concatenate(parts)
    return all_places[np.unique(all_places[:, 0], return_index=True)[1]]


def shared_moments(
    recordings: Sequence[IntArray], other_recordings: Sequence[IntArray]
) -> dict[tuple[int, int], int]:
    """Return the pairs of two releases' recordings that have a road user at the same place.

    Args:
        recordings: The array of `places_in` for each recording of a release.
        other_recordings: Likewise, for the other release.

    Returns:
        Indices of two recordings → the largest number of moving road users at the same places at
        one moment; 0 if only parked cars are.
    """
    release_places = np.unique(np.concatenate(recordings)[:, 0])
    moments = defaultdict(list)
    for other, other_places in enumerate(other_recordings):
        is_shared = np.isin(other_places[:, 0], release_places)
        for place_id, frame in other_places[is_shared].tolist():
            moments[place_id].append((other, frame))
    actors_by_moment = defaultdict(set)
    for row, places in enumerate(recordings):
        for place_id, frame in places.tolist():
            actor_id = place_id // _CELL_COUNT**2
            for other, other_frame in moments.get(place_id, ()):
                actors_by_moment[row, other, frame, other_frame].add(actor_id)
    max_counts: dict[tuple[int, int], int] = defaultdict(int)
    for (row, other, *_), actors in actors_by_moment.items():
        moving_count = sum(actor < STATIC_ACTOR_ID for actor in actors)
        max_counts[row, other] = max(max_counts[row, other], moving_count)
    return max_counts
