"""First contacts of a planned path with other actors, in continuous time (`collisions.contact`)."""

import math
from dataclasses import dataclass

import numpy as np

from deepaccident_devkit.collisions.contact import contact_times, impacts, pair_of
from deepaccident_devkit.collisions.replay import Motion
from deepaccident_devkit.geometry.box_arrays import gaps_of_pairs
from deepaccident_devkit.support.arrays import BoolArray, FloatArray, FrozenArrays
from deepaccident_devkit.taxonomy import FRAME_PERIOD

# An ego up to this speed counts as standing, m/s.
_STANDING_SPEED = 0.05
# Seconds at which the two actors begin to brake: never.
_NO_BRAKING = [[np.inf, np.inf]]
# Time, speed, relative speed, and whether the ego is struck, if there is no contact.
_NO_CONTACT = (math.inf, math.nan, math.nan, 0.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Contacts(FrozenArrays):
    """First contact of a path with each of A other actors; arrays are read-only.

    Speeds are taken at the contact; they are NaN if there is no contact.

    Attributes:
        time: (A,) seconds after the current frame; inf if there is no contact.
        speed: (A,) speed of the ego, m/s.
        relative_speed: (A,) relative speed of the two actors, m/s.
        struck: (A,) bool, True if the ego is struck, because it stands or the other actor's centre
            is behind the ego's rear edge.
        overlapping: (A,) bool, True if the two already touch at t = 0; such contacts are left out.
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
    """Find the first contact of the ego's box with each other actor.

    Poses are interpolated linearly between frames, also across frames without an actor.

    Args:
        path: (L, 3) x, y, yaw of the centre of the ego's box at 10 Hz, from t = 0 on.
        size: (2,) length and width of the ego's box, metres.
        footprints: (L, A, 5) x, y, length, width, yaw of the other actors, metres and radians; NaN
            where an actor is missing.
        margins: (A,) gaps that count as contact, metres.
        end_times: (A,) time up to which contacts are searched, seconds after t = 0.
    """
    footprints = without_gaps(footprints)
    sizes = np.broadcast_to(size, (len(path), 2))
    ego_footprints = np.concatenate([path[:, :2], sizes, path[:, 2:]], axis=1)
    overlapping = gaps_of_pairs(ego_footprints[:1], footprints[0]) <= margins
    can_touch = _can_touch(ego_footprints, footprints, margins, end_times)
    contacts = np.tile(_NO_CONTACT, (len(margins), 1))
    for actor in np.flatnonzero(can_touch & ~overlapping).tolist():
        margin = float(margins[actor])
        end_time = float(end_times[actor])
        contacts[actor] = _first_contact(path, size, footprints[:, actor], margin, end_time)
    time, speed, relative_speed, struck = contacts.T
    return Contacts(
        time=time,
        speed=speed,
        relative_speed=relative_speed,
        struck=struck.astype(bool),
        overlapping=overlapping,
    )


def _first_contact(
    path: FloatArray, size: FloatArray, footprints: FloatArray, margin: float, end_time: float
) -> tuple[float, float, float, float]:
    """Return time, speed, relative speed and whether the ego is struck, for one other actor.

    Args:
        path: (L, 3) x, y, yaw of the centre of the ego's box at 10 Hz.
        size: (2,) length and width of the ego's box, metres.
        footprints: (L, 5) footprints of the other actor, without gaps.
        margin: Gap that counts as contact, metres.
        end_time: Time up to which contacts are searched, seconds after t = 0.
    """
    frames = np.flatnonzero(np.isfinite(footprints[:, 0]))
    footprints = footprints[frames]
    start_time = int(frames[0]) * FRAME_PERIOD
    last_time = int(frames[-1]) * FRAME_PERIOD
    duration = min(end_time, last_time) - start_time
    if duration <= 0:
        return _NO_CONTACT
    poses = np.stack([path[frames], footprints[:, [0, 1, 4]]])
    other_size = np.median(footprints[:, 2:4], axis=0)
    pair = pair_of(poses, np.stack([size, other_size]), margin=margin)
    time = contact_times(pair, _NO_BRAKING, [1.0], window=(0.0, duration))
    if np.isinf(time[0]):
        return _NO_CONTACT
    impact = impacts(pair, _NO_BRAKING, [1.0], time)
    ego_x, ego_y, ego_yaw = _pose_at(pair.motions[0], time[0])
    other_x, other_y, _ = _pose_at(pair.motions[1], time[0])
    ahead = np.cos(ego_yaw) * (other_x - ego_x) + np.sin(ego_yaw) * (other_y - ego_y)
    speed = float(impact.speeds[0, 0])
    relative_speed = float(impact.relative_speeds[0])
    is_struck = speed <= _STANDING_SPEED or ahead < -size[0] / 2
    return float(time[0]) + start_time, speed, relative_speed, is_struck


def _pose_at(motion: Motion, time: float) -> list[float]:
    """Interpolate x, y and yaw of a motion linearly at a time."""
    pose = []
    for values in motion.poses.T:
        pose.append(float(np.interp(time, motion.times, values)))
    return pose


def _can_touch(
    ego_footprints: FloatArray, footprints: FloatArray, margins: FloatArray, end_times: FloatArray
) -> BoolArray:
    """Find the actors that may touch the ego before their end time, shape (A,) bool.

    The bound uses the gaps at the frames and the lengths of the steps between frames.
    """
    ego_x, ego_y, ego_length, ego_width, _ = ego_footprints.T
    x, y, length, width, _ = np.moveaxis(footprints, -1, 0)
    ego_radius = np.hypot(ego_length[0], ego_width[0]) / 2
    radii = np.hypot(length, width) / 2 + ego_radius
    distances = np.hypot(x - ego_x[:, None], y - ego_y[:, None])
    gaps = distances - radii - margins
    times = np.arange(len(gaps))[:, None] * FRAME_PERIOD
    is_in_time = times < end_times + FRAME_PERIOD
    smallest_gap = np.fmin.reduce(np.where(is_in_time, gaps, np.inf), axis=0)
    longest_ego_step = np.hypot(np.diff(ego_x), np.diff(ego_y)).max()
    step_lengths = np.hypot(np.diff(x, axis=0), np.diff(y, axis=0))
    longest_step = np.fmax.reduce(step_lengths, axis=0, initial=0.0)
    can_touch: BoolArray = smallest_gap <= longest_ego_step + longest_step
    return can_touch


def without_gaps(footprints: FloatArray) -> FloatArray:
    """Fill the gaps between labels in footprints (L, A, 5), and unwrap the yaw angles.

    In a gap, an actor goes straight from one label to the next.
    """
    filled_footprints = footprints.copy()
    frames = np.arange(len(footprints))
    for rows in np.moveaxis(filled_footprints, 1, 0):
        labelled_frames = np.flatnonzero(np.isfinite(rows[:, 0]))
        if not len(labelled_frames):
            continue
        labels = rows[labelled_frames]
        labels[:, 4] = np.unwrap(labels[:, 4])
        for column, values in enumerate(labels.T):
            rows[:, column] = np.interp(frames, labelled_frames, values, np.nan, np.nan)
    return filled_footprints
