"""Recordings that stand on two sides, whole or in part and by whatever names: found by who was where at one moment."""

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

# Number of moving road users that two recordings must have at the same places at one moment to be the same.
MIN_SHARED_ROAD_USERS: Final = 3
# Size of a place. Agents agree within 0.1 mm on where an actor is in the real release, within 1 cm here.
_CELL_M: Final = 0.05
# Speed from which on a road user moves.
_MIN_SPEED_MPS: Final = 0.5
# Number of frames, the present included, for which a road user's place is predicted: of two sides, one may go on where
# the other one ends, or lack some frames in between.
_PREDICTED_FRAMES: Final = 4
# Number of cells along an axis, from which on they are counted from 0 again.
_CELLS: Final = 1_000_003


def places_in(scenario: ScenarioFolder) -> IntArray:
    """Read where moving road users and parked cars are in a recording, and where they will be soon.

    Returns:
        (N, 2) a number of an actor and a cell of the world, each once, and the frame at which the actor is there.

    Raises:
        DatarootError: a folder cannot be listed.
        ReleaseError: a label cannot be read, or the calib file of its frame.
    """
    parts = [np.empty((0, 2), dtype=np.int64)]
    for agent in AGENTS:
        frames = frame_numbers(scenario.kind_folder(agent, "label"), "txt")[0]
        labels = read_labels([scenario.label_path(agent, frame) for frame in frames])
        if not len(labels):
            continue
        calibs = read_calibs([scenario.calib_path(agent, frame) for frame in frames])
        pose = np.repeat(calibs.world_from_ego @ calibs.ego_from_lidar, labels.num_boxes, axis=0)[
            :, :2
        ]
        center = np.einsum("nij,nj->ni", pose[..., :3], labels.center) + pose[..., 3]
        velocity = np.nan_to_num(world_from_label_velocity(labels.velocity, labels.yaw))
        is_used = (np.hypot(*velocity.T) > _MIN_SPEED_MPS) | (labels.actor_id >= STATIC_ACTOR_ID)
        for later in range(_PREDICTED_FRAMES):
            x, y = ((center + later * FRAME_PERIOD * velocity)[is_used] // _CELL_M).astype(
                np.int64
            ).T % _CELLS
            place = (labels.actor_id[is_used] * _CELLS + x) * _CELLS + y
            parts.append(
                np.column_stack([place, np.repeat(frames, labels.num_boxes)[is_used] + later])
            )
    places = np.concatenate(parts)
    return places[np.unique(places[:, 0], return_index=True)[1]]


def shared_moments(
    mine: Sequence[IntArray], theirs: Sequence[IntArray]
) -> dict[tuple[int, int], int]:
    """Return which of two releases' recordings have a road user at the same place.

    Args:
        mine: `places_in` each recording of the first.
        theirs: likewise, of the second.

    Returns:
        Positions of two recordings → the largest number of moving road users at the same places at one moment; 0 where
        only parked cars are.
    """
    own = np.unique(np.concatenate(mine)[:, 0])
    moments = defaultdict(list)
    for other, places in enumerate(theirs):
        for place, frame in places[np.isin(places[:, 0], own)].tolist():
            moments[place].append((other, frame))
    together = defaultdict(set)
    for row, places in enumerate(mine):
        for place, frame in places.tolist():
            for other, other_frame in moments.get(place, ()):
                together[row, other, frame, other_frame].add(place // _CELLS**2)
    most: dict[tuple[int, int], int] = defaultdict(int)
    for (row, other, *_), actors in together.items():
        most[row, other] = max(most[row, other], sum(actor < STATIC_ACTOR_ID for actor in actors))
    return most
