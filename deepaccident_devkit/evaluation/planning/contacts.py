"""When a planned path first touches others, exactly and in continuous time, by the search of `accidents.contact`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from deepaccident_devkit.collisions.contact import contact_times, impacts, pair_of
from deepaccident_devkit.geometry.box_arrays import gaps_of_pairs
from deepaccident_devkit.support.arrays import BoolArray, FloatArray, FrozenArrays
from deepaccident_devkit.taxonomy import FRAME_PERIOD

# m/s up to which the ego stands.
_STANDS: Final = 0.05
_NO_BRAKING: Final = [[np.inf, np.inf]]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Contacts(FrozenArrays):
    """How a path first touches each of A others; NaN, and False, where it does not. Arrays are read-only.

    Attributes:
        time: (A,) seconds after the present; inf for no contact.
        speed: (A,) of the ego, m/s.
        relative_speed: (A,) m/s.
        struck: (A,) whether the ego is struck: it stands, or the other's centre is behind its rear edge.
        overlapping: (A,) whether the two touch at the present already; such contacts are left out.
    """

    time: FloatArray
    speed: FloatArray
    relative_speed: FloatArray
    struck: BoolArray
    overlapping: BoolArray


def first_contacts(
    path: FloatArray, size: FloatArray, others: FloatArray, margins: FloatArray, until: FloatArray
) -> Contacts:
    """The first contacts of a box with others up to some times.

    Args:
        path: (L, 3) x, y, yaw of the centre of the ego's box at 10 Hz, from the present on.
        size: (2,) its length and width.
        others: (L, A, 5) x, y, length, width, yaw; NaN where one is not there. Between frames poses are linear, and
            whoever is missing in between goes straight.
        margins: (A,) metres of a gap that counts as contact.
        until: (A,) seconds.
    """
    others = without_gaps(others)
    own = np.concatenate([path[:, :2], np.broadcast_to(size, (len(path), 2)), path[:, 2:]], axis=1)
    overlapping = gaps_of_pairs(own[:1], others[0]) <= margins
    found = np.tile([np.inf, np.nan, np.nan, 0.0], (len(margins), 1))
    for actor in np.flatnonzero(_near(own, others, margins, until) & ~overlapping).tolist():
        found[actor] = _contact(
            path, size, others[:, actor], float(margins[actor]), float(until[actor])
        )
    time, speed, relative_speed, struck = found.T
    return Contacts(
        time=time,
        speed=speed,
        relative_speed=relative_speed,
        struck=struck.astype(bool),
        overlapping=overlapping,
    )


def _contact(
    path: FloatArray, size: FloatArray, other: FloatArray, margin: float, until: float
) -> tuple[float, float, float, float]:
    """Return time, speed, relative speed and whether the ego is struck, by another's footprints (L, 5) without gaps."""
    frames = np.flatnonzero(np.isfinite(other[:, 0]))
    first, rows = int(frames[0]), other[frames]
    window = 0.0, min(until, int(frames[-1]) * FRAME_PERIOD) - first * FRAME_PERIOD
    if window[1] <= 0:
        return _NOTHING
    sizes = np.stack([size, np.median(rows[:, 2:4], axis=0)])
    pair = pair_of(np.stack([path[frames], rows[:, [0, 1, 4]]]), sizes, margin=margin)
    time = contact_times(pair, _NO_BRAKING, [1.0], window=window)
    if np.isinf(time[0]):
        return _NOTHING
    impact = impacts(pair, _NO_BRAKING, [1.0], time)
    ego, hit = (
        np.array([np.interp(time[0], each.times, values) for values in each.poses.T])
        for each in pair.motions
    )
    ahead = np.cos(ego[2]) * (hit[0] - ego[0]) + np.sin(ego[2]) * (hit[1] - ego[1])
    speed, relative = float(impact.speeds[0, 0]), float(impact.relative_speeds[0])
    return (
        float(time[0]) + first * FRAME_PERIOD,
        speed,
        relative,
        speed <= _STANDS or ahead < -size[0] / 2,
    )


_NOTHING: Final = (math.inf, math.nan, math.nan, 0.0)


def _near(own: FloatArray, others: FloatArray, margins: FloatArray, until: FloatArray) -> BoolArray:
    """(A,) whether two can come to touch in time, by their distances at the frames and their ways between them."""
    reach = np.hypot(*own[0, 2:4]) / 2 + np.hypot(others[..., 2], others[..., 3]) / 2
    apart = (
        np.hypot(others[..., 0] - own[:, None, 0], others[..., 1] - own[:, None, 1])
        - reach
        - margins
    )
    in_time = np.arange(len(own))[:, None] * FRAME_PERIOD < until + FRAME_PERIOD
    step = np.hypot(*np.diff(own[:, :2], axis=0).T).max()
    steps = np.diff(others[..., :2], axis=0)
    ways = np.fmax.reduce(np.hypot(steps[..., 0], steps[..., 1]), axis=0, initial=0.0)
    near: BoolArray = np.fmin.reduce(np.where(in_time, apart, np.inf), axis=0) <= step + ways
    return near


def without_gaps(others: FloatArray) -> FloatArray:
    """Return footprints (L, A, 5) without jumps of yaw; between two labels actors go straight where they have none."""
    filled, frames = others.copy(), np.arange(len(others))
    for rows in np.moveaxis(filled, 1, 0):
        labelled = np.flatnonzero(np.isfinite(rows[:, 0]))
        if len(labelled):
            rows[labelled, 4] = np.unwrap(rows[labelled, 4])
            columns = rows[labelled].T
            rows[:] = np.column_stack(
                [np.interp(frames, labelled, values, np.nan, np.nan) for values in columns]
            )
    return filled
