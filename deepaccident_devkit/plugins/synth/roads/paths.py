"""Smooth paths to drive or walk on, as dense samples: how they bend, and where two of them meet.

A turn by a right angle is a clothoid, an arc and a clothoid, all of the same length.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.support.arrays import (
    BoolArray,
    FloatArray,
    FrozenArrays,
    IntArray,
    checked,
    readonly,
)

# The largest distance between samples, metres.
SPACING = 0.1
# The search for the nearest sample looks first at one of so many samples.
_COARSE = 10
# The comparison of two paths looks first at one of so many samples.
_STRIDE = 4
# Metres: paths that stay nearer than this join.
_MEETING = 0.5
# The smallest factor by which steps are shorter on the inner side of a path's bends.
_LEAST_SHRINK = 0.2
_GAUSS = np.polynomial.legendre.leggauss(3)


class Meeting(NamedTuple):
    """Where two paths first meet: distances along each, metres."""

    s_a: float
    s_b: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Path(FrozenArrays):
    """N samples of a path in the ground frame, with equal distances of at most `SPACING`; arrays are read-only.

    Attributes:
        xy: (N, 2) float64, metres.
        yaw: (N,) float64, direction of travel, radians; without jumps of 2π.
        curvature: (N,) float64, 1/m, positive to the left.
        s: (N,) float64, metres along the path, from 0.
    """

    xy: FloatArray
    yaw: FloatArray
    curvature: FloatArray
    s: FloatArray

    def __post_init__(self) -> None:
        """Check the shapes; raises GeometryError."""
        xy = checked("Path.xy", self.xy, (None, 2))
        if len(xy) < 2:
            raise GeometryError(
                f"Path.xy: expected two samples or more, found {len(xy)}; sample the path more densely"
            )
        object.__setattr__(self, "xy", readonly(xy))
        for name in ("yaw", "curvature", "s"):
            object.__setattr__(
                self, name, readonly(checked(f"Path.{name}", getattr(self, name), (len(xy),)))
            )

    @property
    def length(self) -> float:
        """Metres."""
        return float(self.s[-1])

    def at(self, s: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """x, y (metres), yaw (radians), curvature (1/m) at distances along the path, each of the shape of `s`.

        Before its start and beyond its end the path goes straight on.
        """
        wanted = np.asarray(s, dtype=np.float64)
        inside = np.clip(wanted, 0.0, self.length)
        beyond = wanted - inside
        yaw = np.interp(inside, self.s, self.yaw)
        x = np.interp(inside, self.s, self.xy[:, 0]) + np.cos(yaw) * beyond
        y = np.interp(inside, self.s, self.xy[:, 1]) + np.sin(yaw) * beyond
        curvature = np.where(beyond == 0, np.interp(inside, self.s, self.curvature), 0.0)
        return x, y, yaw, curvature

    def project(self, xy: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """The nearest places on the path to points (N, 2): distance along it and to its left, (N,) metres each.

        For points beyond its ends the path goes straight on.
        """
        points = np.atleast_2d(np.asarray(xy, dtype=np.float64))
        sample = self._nearest(points)
        delta, curvature = points - self.xy[sample], self.curvature[sample]
        cos, sin = np.cos(self.yaw[sample]), np.sin(self.yaw[sample])
        ahead, left = cos * delta[:, 0] + sin * delta[:, 1], cos * delta[:, 1] - sin * delta[:, 0]
        beyond = ((sample == 0) & (ahead < 0)) | ((sample == len(self.s) - 1) & (ahead > 0))
        bend = np.where(beyond, 0.0, curvature)
        left = left - bend * ahead**2 / 2
        return self.s[sample] + ahead / np.maximum(1 - bend * left, _LEAST_SHRINK), left

    def reversed(self) -> "Path":
        """The same path in the other direction."""
        return Path(
            xy=self.xy[::-1],
            yaw=self.yaw[::-1] + np.pi,
            curvature=-self.curvature[::-1],
            s=self.length - self.s[::-1],
        )

    def _nearest(self, points: FloatArray) -> IntArray:
        """Index (N,) of the sample nearest to each point: first the nearest of a few, then the nearest around it."""
        around = _COARSE * _squares(points, self.xy[::_COARSE]).argmin(axis=1)
        window = np.clip(around[:, None] + np.arange(-_COARSE, _COARSE + 1), 0, len(self.xy) - 1)
        best = ((points[:, None] - self.xy[window]) ** 2).sum(axis=2).argmin(axis=1)
        return np.asarray(window[np.arange(len(points)), best])


def crossing(path_a: Path, path_b: Path, *, within: float = _MEETING) -> Meeting | None:
    """Where two paths first meet; None if they never meet.

    Paths that cross meet at their common point. Paths that join meet where their distance becomes less than `within`,
    metres.
    """
    s_a = _first_near(path_a, path_b, within)
    s_b = _first_near(path_b, path_a, within)
    return None if s_a is None or s_b is None else Meeting(s_a, s_b)


def straight(start: tuple[float, float], yaw: float, length: float) -> Path:
    """A straight path from a point, metres and radians."""
    return bent(start, yaw, [(length, 0.0, 0.0)])


def bent(start: tuple[float, float], yaw: float, pieces: list[tuple[float, float, float]]) -> Path:
    """A path of pieces, each with a length (metres) and the curvature (1/m) at its start and at its end.

    The curvature changes evenly along each piece: lines, arcs and clothoids. Position and yaw have no jumps.
    """
    lengths = np.array([piece[0] for piece in pieces])
    joints = np.concatenate([[0.0], np.cumsum(lengths)])
    s = even_steps(joints[-1])
    start_curvature, end_curvature = (np.array([piece[k] for piece in pieces]) for k in (1, 2))
    slope = (end_curvature - start_curvature) / lengths
    turned = np.concatenate([[0.0], np.cumsum(lengths * (start_curvature + end_curvature) / 2)])

    def bend(at: FloatArray) -> tuple[FloatArray, FloatArray]:
        piece = np.clip(np.searchsorted(joints, at, side="right") - 1, 0, len(pieces) - 1)
        into = at - joints[piece]
        curvature = start_curvature[piece] + slope[piece] * into
        return yaw + turned[piece] + into * (start_curvature[piece] + curvature) / 2, curvature

    nodes, weights = _GAUSS
    step = s[1] - s[0]
    middle_yaw, _ = bend(s[:-1, None] + step * (nodes + 1) / 2)
    moves = (
        np.stack([np.cos(middle_yaw) @ weights, np.sin(middle_yaw) @ weights], axis=1) * step / 2
    )
    xy = np.array(start) + np.concatenate([np.zeros((1, 2)), np.cumsum(moves, axis=0)])
    at_yaw, curvature = bend(s)
    return Path(xy=xy, yaw=at_yaw, curvature=curvature, s=s)


def lane_change(path: Path, start: float, length: float, offset: float) -> Path:
    """The path shifted sideways by `offset` (metres, positive to the left) from `start + length` on, without jumps."""
    share = np.clip((path.s - start) / length, 0.0, 1.0)
    shift = offset * share**3 * (10 - 15 * share + 6 * share**2)
    left = np.column_stack([-np.sin(path.yaw), np.cos(path.yaw)])
    return through(path.xy + shift[:, None] * left)


def through(points: ArrayLike) -> Path:
    """A path through dense points (N, 2), metres; they must be smooth: yaw and curvature are their differences."""
    raw = checked("points", points, (None, 2))
    if len(raw) < 3:
        raise GeometryError(
            f"points: expected three points or more, found {len(raw)}; sample the way more densely"
        )
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(raw, axis=0).T))])
    direction = np.gradient(raw, along, axis=0, edge_order=2)
    yaw = np.unwrap(np.arctan2(direction[:, 1], direction[:, 0]))
    columns = (raw[:, 0], raw[:, 1], yaw, np.gradient(yaw, along, edge_order=2))
    s = even_steps(along[-1])
    x, y, at_yaw, curvature = (np.interp(s, along, column) for column in columns)
    return Path(xy=np.column_stack([x, y]), yaw=at_yaw, curvature=curvature, s=s)


def even_steps(length: float) -> FloatArray:
    """Distances from 0 to `length` (metres), in equal steps of at most `SPACING`."""
    return np.linspace(0.0, length, max(int(np.ceil(length / SPACING - 1e-9)), 1) + 1)


def _first_near(path: Path, other: Path, within: float) -> float | None:
    """Where `path` first meets `other`: their common point if they part again, if not, where `path` comes near."""
    some = np.append(np.arange(0, len(path.s) - 1, _STRIDE), len(path.s) - 1)
    rows = some[_near(path.xy[some], other, within)]
    if not len(rows):
        return None
    gaps = np.flatnonzero(np.diff(rows) > _STRIDE)
    first, last = int(rows[0]), int(rows[gaps[0]] if len(gaps) else rows[-1])
    around = np.arange(max(first - _STRIDE, 0), min(last + _STRIDE, len(path.s) - 1) + 1)
    if last == len(path.s) - 1:
        around = around[: 2 * _STRIDE + 1]
        return float(path.s[around[_near(path.xy[around], other, within)][0]])
    _, left = other.project(path.xy[around])
    change = np.flatnonzero(left[:-1] * left[1:] < 0)
    if not len(change):
        return float(path.s[around[np.abs(left).argmin()]])
    before = int(change[0])
    share = left[before] / (left[before] - left[before + 1])
    return float(path.s[around[before]] + share * (path.s[1] - path.s[0]))


def _near(points: FloatArray, path: Path, within: float) -> BoolArray:
    """Which of the points (N, 2) are nearer to the path than `within`."""
    reach = within + _COARSE * SPACING
    near = np.asarray(_squares(points, path.xy[::_COARSE]).min(axis=1) < reach**2)
    near[near] = np.abs(path.project(points[near])[1]) <= within
    return near


def _squares(points: FloatArray, others: FloatArray) -> FloatArray:
    """Squared distances (N, M) from each of the points (N, 2) to each of the others (M, 2)."""
    return np.asarray(
        (points[:, None, 0] - others[:, 0]) ** 2 + (points[:, None, 1] - others[:, 1]) ** 2
    )


# The angle that the arc turns, radians; the two clothoids together turn as much.
_ANGLE = np.pi / 4
# Metres: the radius at which the shape is measured, finely sampled.
_REFERENCE = 100.0

# A piece for `bent`: length, curvature at the start and at the end.
Piece = tuple[float, float, float]


def quarter_turn(tangent: float, *, left: bool) -> list[Piece]:
    """Pieces that turn by a right angle, over `tangent` metres before and after where the two lines cross."""
    return _pieces(tangent / _shape()[0], 1.0 if left else -1.0)


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
