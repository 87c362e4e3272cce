"""Who touches whom, when, with which sides and how hard."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from deepaccident_devkit.support.arrays import FloatArray
from deepaccident_devkit.synth.collision import gap, separation
from deepaccident_devkit.synth.traffic.simulate import Simulation

_LOOK_STEP = 5
"""Which road users are near each other is computed once in so many steps."""
_NEAR = 2.0
"""How much nearer two can come between these steps, metres."""


def touching_pairs(poses: FloatArray, size: FloatArray, margin: float) -> list[tuple[int, int]]:
    """Pairs of rows, the lower one first, that come nearer to each other than `margin`, along any side's normal.

    Args:
        poses: (S, A, 3) x, y (metres), yaw (radians) of the boxes' centres.
        size: (A, 2) length and width, metres.
        margin: metres.
    """
    found = []
    for i, j in _near_pairs(poses, size, margin):
        if (separation(poses[:, i], size[i], poses[:, j], size[j]) < margin).any():
            found.append((i, j))
    return found


def least_gap(poses: FloatArray, size: FloatArray, rows: list[int], enough: float) -> float:
    """The least distance in metres between any two of `rows`; arguments as in `touching_pairs`.

    Pairs that never come nearer than `enough` do not count; if there are no other pairs, the result is `enough`.
    """
    pairs = _near_pairs(poses[:, rows], size[rows], enough)
    gaps = [float(gap(poses[:, rows[i]], size[rows[i]], poses[:, rows[j]], size[rows[j]]).min()) for i, j in pairs]
    return min([*gaps, enough])


def _near_pairs(poses: FloatArray, size: FloatArray, margin: float) -> list[tuple[int, int]]:
    """Pairs of rows that may come nearer than `margin`."""
    moments = np.concatenate([poses[::_LOOK_STEP], poses[-1:]])
    x, y = moments[..., 0], moments[..., 1]
    square = (x[:, :, None] - x[:, None, :]) ** 2 + (y[:, :, None] - y[:, None, :]) ** 2
    radius = np.hypot(size[:, 0], size[:, 1]) / 2
    near = (square < (radius[:, None] + radius + margin + _NEAR) ** 2).any(axis=0)
    rows, columns = np.nonzero(np.triu(near, 1))
    return list(zip(rows.tolist(), columns.tolist(), strict=True))


ContactSide = Literal["front", "back", "left", "right"]
_AREA_MASS = 60.0
"""Impact for each m² of the first box and m/s; so the numbers are about as large as in the real release."""
_HALVINGS = 40


@dataclass(frozen=True, slots=True)
class Impact:
    """The end of an accident.

    Attributes:
        time: seconds, when the boxes first touch.
        side: the side of the first one's box that is hit.
        strength: the impact in the meta file.
    """

    time: float
    side: ContactSide
    strength: float


def impact_of(simulation: Simulation, pair: tuple[int, int], size: FloatArray) -> Impact:
    """The impact that ends a simulation.

    Args:
        simulation: one with a contact.
        pair: rows of the two who touch.
        size: (2, 2) length and width of the two, metres.
    """
    rows = list(pair)
    last = simulation.poses[-1][rows]
    before = simulation.poses[-2][rows] if len(simulation.time) > 1 else last
    share = _touching_share(before, last, size)
    poses = before + share * (last - before)
    period = float(simulation.time[-1] - simulation.time[-2]) if len(simulation.time) > 1 else 0.0
    velocity = simulation.velocities[-1][rows]
    return Impact(
        time=float(simulation.time[-1]) - (1.0 - share) * period,
        side=contact_side(poses, size),
        strength=float(_AREA_MASS * size[0].prod() * np.hypot(*(velocity[0] - velocity[1]))),
    )


def _touching_share(before: FloatArray, after: FloatArray, size: FloatArray) -> float:
    """The share of a step (2, 3) → (2, 3) that is over when the boxes touch, by halving; at the result they touch."""
    apart, touching = 0.0, 1.0
    for _ in range(_HALVINGS):
        middle = (apart + touching) / 2
        first, second = before + middle * (after - before)
        if separation(first, size[0], second, size[1]) > 0:
            apart = middle
        else:
            touching = middle
    return touching


def contact_side(poses: FloatArray, size: FloatArray) -> ContactSide:
    """The side of the first of two boxes that faces the second across the widest gap along any side's normal.

    Args:
        poses: (2, 3) x, y (metres), yaw (radians) of the boxes' centres.
        size: (2, 2) length and width of the two, metres.
    """
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    axes = np.stack([np.stack([cos, sin], axis=1), np.stack([-sin, cos], axis=1)], axis=1)  # box, axis, xy
    normals = axes.reshape(4, 2)
    reach = np.abs(np.einsum("na,bka->nbk", normals, axes) * size / 2).sum(axis=(1, 2))
    apart = normals @ (poses[1, :2] - poses[0, :2])
    best = int(np.argmax(np.abs(apart) - reach))
    along, across = axes[0] @ (normals[best] * np.sign(apart[best]))
    if abs(along) >= abs(across):
        return "front" if along > 0 else "back"
    return "left" if across > 0 else "right"
