"""First contacts of a planned path with others in continuous time, by `collisions.contact`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from deepaccident_devkit.collisions.contact import contact_times, impacts, pair_of
from deepaccident_devkit.collisions.replay import Motion
from deepaccident_devkit.geometry.box_arrays import gaps_of_pairs
from deepaccident_devkit.support.arrays import BoolArray, FloatArray, FrozenArrays
from deepaccident_devkit.taxonomy import FRAME_PERIOD

# Largest speed of a standing ego, m/s.
_STANDING_SPEED: Final = 0.05
_NO_BRAKING: Final = [[np.inf, np.inf]]
# Time, speed, relative speed and whether the ego is struck, without a contact.
_NO_CONTACT: Final = (math.inf, math.nan, math.nan, 0.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Contacts(FrozenArrays):
    """First contacts of a path with each of A others; NaN, and False, for no contact. Read-only.

    Attributes:
        time: (A,) seconds after the present; inf for no contact.
        speed: (A,) speed of the ego, m/s.
        relative_speed: (A,) m/s.
        struck: (A,) whether the ego is struck: it stands, or the other's centre is behind its rear
            edge.
        overlapping: (A,) whether the two touch at the present already; such contacts are left out.
    """

    time: FloatArray
    speed: FloatArray
    relative_speed: FloatArray
    struck: BoolArray
    overlapping: BoolArray


def first_contacts(
    path: FloatArray,
    size: FloatArray,
    footprints: FloatArray,
    margins: FloatArray,
    end_times: FloatArray,
) -> Contacts:
    """Return the first contacts of a box with others up to some times.

    Args:
        path: (L, 3) x, y, yaw of the centre of the ego's box at 10 Hz, from the present on.
        size: (2,) its length and width, metres.
        footprints: (L, A, 5) x, y, length, width, yaw of the others; NaN where an actor is missing.
            Between frames poses are linear, and an actor that is missing in between goes straight.
        margins: (A,) gaps that count as contact, metres.
        end_times: (A,) ends of the search, seconds after the present.
    """
    footprints = without_gaps(footprints)
    sizes = np.broadcast_to(size, (len(path), 2))
    own = np.concatenate([path[:, :2], sizes, path[:, 2:]], axis=1)
    overlapping = gaps_of_pairs(own[:1], footprints[0]) <= margins
    contacts = np.tile([np.inf, np.nan, np.nan, 0.0], (len(margins), 1))
    is_candidate = _can_touch(own, footprints, margins, end_times) & ~overlapping
    for actor in np.flatnonzero(is_candidate).tolist():
        margin = float(margins[actor])
        end_time = float(end_times[actor])
        contacts[actor] = _contact(path, size, footprints[:, actor], margin, end_time)
    time, speed, relative_speed, struck = contacts.T
    return Contacts(
        time=time,
        speed=speed,
        relative_speed=relative_speed,
        struck=struck.astype(bool),
        overlapping=overlapping,
    )


def _contact(
    path: FloatArray, size: FloatArray, other: FloatArray, margin: float, end_time: float
) -> tuple[float, float, float, float]:
    """Return time, speed, relative speed and whether the ego is struck, for one other actor.

    Args:
        path: Path of the ego, as in `first_contacts`.
        size: Size of the ego's box.
        other: (L, 5) footprints of the other actor, without gaps.
        margin: Gap that counts as contact, metres.
        end_time: End of the search, seconds after the present.
    """
    frames = np.flatnonzero(np.isfinite(other[:, 0]))
    start = int(frames[0])
    rows = other[frames]
    window = 0.0, min(end_time, int(frames[-1]) * FRAME_PERIOD) - start * FRAME_PERIOD
    if window[1] <= 0:
        return _NO_CONTACT
    sizes = np.stack([size, np.median(rows[:, 2:4], axis=0)])
    pair = pair_of(np.stack([path[frames], rows[:, [0, 1, 4]]]), sizes, margin=margin)
    time = contact_times(pair, _NO_BRAKING, [1.0], window=window)
    if np.isinf(time[0]):
        return _NO_CONTACT
    impact = impacts(pair, _NO_BRAKING, [1.0], time)
    ego_pose, other_pose = (_pose_at(motion, time[0]) for motion in pair.motions)
    dx = other_pose[0] - ego_pose[0]
    dy = other_pose[1] - ego_pose[1]
    ahead = np.cos(ego_pose[2]) * dx + np.sin(ego_pose[2]) * dy
    speed = float(impact.speeds[0, 0])
    relative_speed = float(impact.relative_speeds[0])
    is_struck = speed <= _STANDING_SPEED or ahead < -size[0] / 2
    return float(time[0]) + start * FRAME_PERIOD, speed, relative_speed, is_struck


def _pose_at(motion: Motion, time: float) -> FloatArray:
    """Return x, y and yaw of a motion at a time, linear between its poses."""
    columns = motion.poses.T
    pose = [np.interp(time, motion.times, values) for values in columns]
    return np.array(pose)


def _can_touch(
    own: FloatArray, footprints: FloatArray, margins: FloatArray, end_times: FloatArray
) -> BoolArray:
    """Return whether each other actor can come to touch in time, shape (A,).

    The bound uses the distances at the frames and the lengths of the steps between them.
    """
    own_radius = np.hypot(*own[0, 2:4]) / 2
    radii = own_radius + np.hypot(footprints[..., 2], footprints[..., 3]) / 2
    dx = footprints[..., 0] - own[:, None, 0]
    dy = footprints[..., 1] - own[:, None, 1]
    gap = np.hypot(dx, dy) - radii - margins
    is_in_time = np.arange(len(own))[:, None] * FRAME_PERIOD < end_times + FRAME_PERIOD
    smallest_gap = np.fmin.reduce(np.where(is_in_time, gap, np.inf), axis=0)
    own_step = np.hypot(*np.diff(own[:, :2], axis=0).T).max()
    steps = np.diff(footprints[..., :2], axis=0)
    step_lengths = np.hypot(steps[..., 0], steps[..., 1])
    longest_step = np.fmax.reduce(step_lengths, axis=0, initial=0.0)
    can_touch: BoolArray = smallest_gap <= own_step + longest_step
    return can_touch


def without_gaps(footprints: FloatArray) -> FloatArray:
    """Return footprints (L, A, 5) without jumps of yaw and without gaps.

    Between two labels an actor goes straight where it has none.
    """
    filled = footprints.copy()
    frames = np.arange(len(footprints))
    for rows in np.moveaxis(filled, 1, 0):
        labelled = np.flatnonzero(np.isfinite(rows[:, 0]))
        if not len(labelled):
            continue
        rows[labelled, 4] = np.unwrap(rows[labelled, 4])
        columns = rows[labelled].T
        rows[:] = np.column_stack(
            [np.interp(frames, labelled, values, np.nan, np.nan) for values in columns]
        )
    return filled
