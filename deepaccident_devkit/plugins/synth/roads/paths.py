"""Smooth paths to drive or walk on, as dense samples, and the points where two paths cross.

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

SPACING = 0.1
"""The largest distance between samples, metres."""
# Step from sample to sample in the first search for the nearest sample.
_COARSE_STEP = 10
# Step from sample to sample in the first comparison of two paths.
_STRIDE = 4
# Paths that stay nearer than this join.
_JOINING_DISTANCE_M = 0.5
# The smallest factor by which steps are shorter on the inner side of a path's bends.
_MIN_SHRINK_FACTOR = 0.2
_GAUSS_POINTS = np.polynomial.legendre.leggauss(3)
# The angle that the arc of a turn turns, radians; the two clothoids together turn as much.
_ARC_ANGLE = np.pi / 4
# A turn's shape is measured at this radius, where it has many samples.
_REFERENCE_RADIUS_M = 100.0
Piece = tuple[float, float, float]
"""A piece for `join_pieces`: length (metres), curvature (1/m) at its start and at its end."""


class Meeting(NamedTuple):
    """The point where two paths first meet, as distances along each, metres."""

    s_a: float
    s_b: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Path(FrozenArrays):
    """N samples of a path in the ground frame; arrays are read-only.

    Samples have equal distances of at most `SPACING`.

    Attributes:
        xy: Positions, shape (N, 2), float64, metres.
        yaw: Directions of travel, shape (N,), float64, radians; without jumps of 2π.
        curvature: Curvatures, shape (N,), float64, 1/m, positive to the left.
        s: Distances along the path, shape (N,), float64, metres, from 0.
    """

    xy: FloatArray
    yaw: FloatArray
    curvature: FloatArray
    s: FloatArray

    def __post_init__(self) -> None:
        """Check the shapes; raise GeometryError if one is wrong."""
        xy = checked("Path.xy", self.xy, (None, 2))
        if len(xy) < 2:
            raise GeometryError(
                f"Path.xy: expected at least two samples, found {len(xy)}; "
                "sample the path more densely"
            )
        object.__setattr__(self, "xy", readonly(xy))
        for name in ("yaw", "curvature", "s"):
            column = checked(f"Path.{name}", getattr(self, name), (len(xy),))
            object.__setattr__(self, name, readonly(column))

    @property
    def length(self) -> float:
        """Length of the path, metres."""
        return float(self.s[-1])

    def at(self, s: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return the path at distances along it.

        Before its start and beyond its end the path goes straight on.

        Args:
            s: Distances along the path, metres.

        Returns:
            x, y (metres), yaw (radians), curvature (1/m), each of the shape of `s`.
        """
        distances = np.asarray(s, dtype=np.float64)
        on_path = np.clip(distances, 0.0, self.length)
        overshoot = distances - on_path
        yaw = np.interp(on_path, self.s, self.yaw)
        last_x = np.interp(on_path, self.s, self.xy[:, 0])
        last_y = np.interp(on_path, self.s, self.xy[:, 1])
        x = last_x + np.cos(yaw) * overshoot
        y = last_y + np.sin(yaw) * overshoot
        last_curvature = np.interp(on_path, self.s, self.curvature)
        curvature = np.where(overshoot == 0, last_curvature, 0.0)
        return x, y, yaw, curvature

    def project(self, xy: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Project points (N, 2), metres, onto the path.

        For points beyond its ends the path goes straight on.

        Returns:
            Distances along the path and to its left, shape (N,) each, metres.
        """
        points = np.atleast_2d(np.asarray(xy, dtype=np.float64))
        sample = self._nearest_samples(points)
        offsets = points - self.xy[sample]
        ahead, lateral = ahead_and_left(offsets[:, 0], offsets[:, 1], self.yaw[sample])
        before_start = (sample == 0) & (ahead < 0)
        after_end = (sample == len(self.s) - 1) & (ahead > 0)
        curvature = np.where(before_start | after_end, 0.0, self.curvature[sample])
        lateral = lateral - curvature * ahead**2 / 2
        shrink_factor = np.maximum(1 - curvature * lateral, _MIN_SHRINK_FACTOR)
        return self.s[sample] + ahead / shrink_factor, lateral

    def reversed(self) -> "Path":
        """Return the same path in the opposite direction."""
        return Path(
            xy=self.xy[::-1],
            yaw=self.yaw[::-1] + np.pi,
            curvature=-self.curvature[::-1],
            s=self.length - self.s[::-1],
        )

    def _nearest_samples(self, points: FloatArray) -> IntArray:
        """Return the index (N,) of the sample nearest to each point (N, 2).

        Each is first sought among every tenth sample, then around the nearest of these.
        """
        coarse_distances = _compute_square_distances(points, self.xy[::_COARSE_STEP])
        middle = _COARSE_STEP * coarse_distances.argmin(axis=1)
        steps = np.arange(-_COARSE_STEP, _COARSE_STEP + 1)
        candidates = np.clip(middle[:, None] + steps, 0, len(self.xy) - 1)
        offsets = points[:, None] - self.xy[candidates]
        nearest_rows = (offsets**2).sum(axis=2).argmin(axis=1)
        return np.asarray(candidates[np.arange(len(points)), nearest_rows])


def ahead_and_left(
    dx: FloatArray, dy: FloatArray, yaw: FloatArray | float
) -> tuple[FloatArray, FloatArray]:
    """Split offsets into their parts ahead and to the left of a heading.

    All arguments broadcast.

    Args:
        dx: Offsets in x, metres.
        dy: Offsets in y, metres.
        yaw: Headings, radians.
    """
    cos = np.cos(yaw)
    sin = np.sin(yaw)
    ahead = cos * dx + sin * dy
    lateral = cos * dy - sin * dx
    return ahead, lateral


def crossing(path_a: Path, path_b: Path, *, within: float = _JOINING_DISTANCE_M) -> Meeting | None:
    """Find the point where two paths first meet.

    Paths that cross meet at their common point. Paths that join meet where their distance becomes
    less than `within`, metres.

    Returns:
        None if they never meet.
    """
    s_a = _find_first_meeting(path_a, path_b, within)
    s_b = _find_first_meeting(path_b, path_a, within)
    if s_a is None or s_b is None:
        return None
    return Meeting(s_a, s_b)


def straight(start: tuple[float, float], yaw: float, length: float) -> Path:
    """Return a straight path.

    Args:
        start: x and y of the start, metres.
        yaw: Direction of travel, radians.
        length: Length, metres.
    """
    piece = (length, 0.0, 0.0)
    return join_pieces(start, yaw, [piece])


def join_pieces(start: tuple[float, float], yaw: float, pieces: list[Piece]) -> Path:
    """Return a path made of lines, arcs and clothoids, one after the other.

    The curvature changes evenly along each piece. Position and yaw have no jumps.

    Args:
        start: x and y of the start, metres.
        yaw: Direction at the start, radians.
        pieces: Length (metres) and the curvature (1/m) at the start and at the end of each piece.
    """
    lengths, start_curvature, end_curvature = np.array(pieces).T
    joints = np.concatenate([[0.0], np.cumsum(lengths)])
    s = even_steps(joints[-1])
    curvature_slope = (end_curvature - start_curvature) / lengths
    piece_turns = lengths * (start_curvature + end_curvature) / 2
    turn_before_piece = np.concatenate([[0.0], np.cumsum(piece_turns)])

    def yaw_and_curvature(distances: FloatArray) -> tuple[FloatArray, FloatArray]:
        next_joint = np.searchsorted(joints, distances, side="right")
        piece = np.clip(next_joint - 1, 0, len(pieces) - 1)
        into_piece = distances - joints[piece]
        curvature = start_curvature[piece] + curvature_slope[piece] * into_piece
        turn_in_piece = into_piece * (start_curvature[piece] + curvature) / 2
        return yaw + turn_before_piece[piece] + turn_in_piece, curvature

    nodes, weights = _GAUSS_POINTS
    step = s[1] - s[0]
    node_yaw, _ = yaw_and_curvature(s[:-1, None] + step * (nodes + 1) / 2)
    mean_directions = np.stack([np.cos(node_yaw) @ weights, np.sin(node_yaw) @ weights], axis=1)
    moves = mean_directions * step / 2
    positions = np.concatenate([np.zeros((1, 2)), np.cumsum(moves, axis=0)])
    sample_yaw, curvature = yaw_and_curvature(s)
    return Path(xy=np.array(start) + positions, yaw=sample_yaw, curvature=curvature, s=s)


def lane_change(path: Path, start: float, length: float, offset: float) -> Path:
    """Return a path that changes to another lane, without jumps.

    Args:
        path: The path before the change.
        start: Distance along it at which the change begins, metres.
        length: Length of the change, metres.
        offset: Sideways shift after the change, metres, positive to the left.
    """
    share = np.clip((path.s - start) / length, 0.0, 1.0)
    shift = offset * share**3 * (10 - 15 * share + 6 * share**2)
    return shift_path(path, shift)


def shift_path(path: Path, offset: float | FloatArray) -> Path:
    """Return a path that is shifted to the left.

    Args:
        path: The path.
        offset: Shift, metres; one for all samples, or one for each, shape (N,).
    """
    left = np.column_stack([-np.sin(path.yaw), np.cos(path.yaw)])
    shift = np.reshape(offset, (-1, 1)) * left
    return path_through(path.xy + shift)


def path_through(points: ArrayLike) -> Path:
    """Return the path through dense points (N, 2), metres.

    The points must be smooth, because yaw and curvature come from their differences.
    """
    xy = checked("points", points, (None, 2))
    if len(xy) < 3:
        raise GeometryError(
            f"points: expected at least three points, found {len(xy)}; sample the way more densely"
        )
    step_lengths = np.hypot(*np.diff(xy, axis=0).T)
    along = np.concatenate([[0.0], np.cumsum(step_lengths)])
    direction = np.gradient(xy, along, axis=0, edge_order=2)
    point_yaw = np.unwrap(np.arctan2(direction[:, 1], direction[:, 0]))
    point_curvature = np.gradient(point_yaw, along, edge_order=2)
    s = even_steps(along[-1])
    columns = (xy[:, 0], xy[:, 1], point_yaw, point_curvature)
    x, y, yaw, curvature = (np.interp(s, along, column) for column in columns)
    return Path(xy=np.column_stack([x, y]), yaw=yaw, curvature=curvature, s=s)


def even_steps(length: float) -> FloatArray:
    """Return distances from 0 to `length`, metres, in equal steps of at most `SPACING`."""
    num_steps = int(np.ceil(length / SPACING - 1e-9))
    return np.linspace(0.0, length, max(num_steps, 1) + 1)


def _find_first_meeting(path: Path, other: Path, within: float) -> float | None:
    """Find where `path` first meets `other`, metres along it.

    Returns:
        Their common point if they part again, otherwise the point where `path` comes near; None if
        they never meet.
    """
    last_row = len(path.s) - 1
    coarse_rows = np.append(np.arange(0, last_row, _STRIDE), last_row)
    near_rows = coarse_rows[_mark_near(path.xy[coarse_rows], other, within)]
    if not len(near_rows):
        return None
    gaps = np.flatnonzero(np.diff(near_rows) > _STRIDE)
    first_row = int(near_rows[0])
    end_row = near_rows[gaps[0]] if len(gaps) else near_rows[-1]
    window_start = max(first_row - _STRIDE, 0)
    window = np.arange(window_start, min(end_row + _STRIDE, last_row) + 1)
    if end_row == last_row:
        window = window[: 2 * _STRIDE + 1]
        is_near = _mark_near(path.xy[window], other, within)
        return float(path.s[window[is_near][0]])
    _, lateral = other.project(path.xy[window])
    sign_changes = np.flatnonzero(lateral[:-1] * lateral[1:] < 0)
    if not len(sign_changes):
        nearest_index = np.abs(lateral).argmin()
        return float(path.s[window[nearest_index]])
    before = sign_changes[0]
    share = lateral[before] / (lateral[before] - lateral[before + 1])
    step = path.s[1] - path.s[0]
    return float(path.s[window[before]] + share * step)


def _mark_near(points: FloatArray, path: Path, within: float) -> BoolArray:
    """Mark the points (N, 2) that are nearer to the path than `within`, metres."""
    coarse_distances = _compute_square_distances(points, path.xy[::_COARSE_STEP])
    search_radius = within + _COARSE_STEP * SPACING
    is_near = np.asarray(coarse_distances.min(axis=1) < search_radius**2)
    _, lateral = path.project(points[is_near])
    is_near[is_near] = np.abs(lateral) <= within
    return is_near


def _compute_square_distances(points: FloatArray, others: FloatArray) -> FloatArray:
    """Return the squared distances (N, M) from points (N, 2) to other points (M, 2)."""
    x_offsets = points[:, None, 0] - others[:, 0]
    y_offsets = points[:, None, 1] - others[:, 1]
    return np.asarray(x_offsets**2 + y_offsets**2)


def quarter_turn(tangent: float, *, left: bool) -> list[Piece]:
    """Return the pieces of a turn by a right angle.

    The turn begins `tangent` metres before the crossing of the two lines, and ends as far after it.
    """
    unit_tangent, _ = _measure_unit_turn()
    sign = 1.0 if left else -1.0
    return _make_turn_pieces(tangent / unit_tangent, sign)


def tangent_of_radius(radius: float) -> float:
    """Return the tangent of a turn for the radius of its arc, metres."""
    unit_tangent, _ = _measure_unit_turn()
    return radius * unit_tangent


def tangent_of_corner(distance: float) -> float:
    """Return the tangent of a turn for its distance from the crossing of its lines, metres."""
    unit_tangent, unit_distance = _measure_unit_turn()
    return distance * unit_tangent / unit_distance


def _make_turn_pieces(radius: float, sign: float) -> list[Piece]:
    """Return the pieces of a turn; the sign is positive to the left."""
    length = _ARC_ANGLE * radius
    curvature = sign / radius
    return [(length, 0.0, curvature), (length, curvature, curvature), (length, curvature, 0.0)]


@lru_cache(maxsize=1)
def _measure_unit_turn() -> tuple[float, float]:
    """Return the tangent of a turn of radius 1, and its distance from the crossing of its lines."""
    pieces = _make_turn_pieces(_REFERENCE_RADIUS_M, 1.0)
    turn = join_pieces((0.0, 0.0), 0.0, pieces)
    xy = turn.xy / _REFERENCE_RADIUS_M
    tangent = float(xy[-1, 0])
    distances = np.hypot(xy[:, 0] - tangent, xy[:, 1])
    return tangent, float(distances.min())
