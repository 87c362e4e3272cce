"""Turns by a right angle: clothoid, arc, clothoid, all of the same length."""

from functools import lru_cache

import numpy as np

from deepaccident_devkit.synth.roads.paths import bent

_ANGLE = np.pi / 4
"""Of the arc at radius 1; the two clothoids together turn as much."""
_REFERENCE = 100.0
"""Metres: the radius at which the shape is measured, finely sampled."""

Piece = tuple[float, float, float]
"""As `paths.bent` takes it: length, curvature at the start and at the end."""


def quarter_turn(tangent: float, *, left: bool) -> list[Piece]:
    """Pieces that turn by a right angle between two lines.

    Args:
        tangent: metres from the turn's start to where the lines cross, and from there to its end.
        left: whether it turns to the left.
    """
    radius = tangent / _shape()[0]
    return _pieces(radius, 1.0 if left else -1.0)


def tangent_of_radius(radius: float) -> float:
    """The tangent of a turn whose arc has a radius, metres."""
    return radius * _shape()[0]


def tangent_of_corner(distance: float) -> float:
    """The tangent of a turn whose middle passes the crossing of the lines at a distance, metres."""
    tangent, corner = _shape()
    return distance * tangent / corner


def _pieces(radius: float, sign: float) -> list[Piece]:
    length, curvature = _ANGLE * radius, sign / radius
    return [(length, 0.0, curvature), (length, curvature, curvature), (length, curvature, 0.0)]


@lru_cache(maxsize=1)
def _shape() -> tuple[float, float]:
    """The tangent, and the distance from the lines' crossing to the turn, at radius 1."""
    xy = bent((0.0, 0.0), 0.0, _pieces(_REFERENCE, 1.0)).xy / _REFERENCE
    tangent = float(xy[-1, 0])
    return tangent, float(np.hypot(xy[:, 0] - tangent, xy[:, 1]).min())
