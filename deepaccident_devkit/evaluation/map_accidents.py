"""Accidents in instance maps, as the paper defines them: instances that come near each other.

The section "Paper versus code" of docs/released_code.md lists how the released code differs.
Outlines are convex hulls of sets of cells; points and straight lines are hulls, too. Since
coordinates are integers, all compared values are exact, so equal distances are equal floats.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.evaluation.predictions import Accident, MotionOutput, first_frames
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.geometry.bev_grid import Orientation, cells_in
from deepaccident_devkit.motion import LabelProtocol, MotionHeads, predict_instances
from deepaccident_devkit.support.arrays import (
    NO_INDICES,
    AnyArray,
    BoolArray,
    FloatArray,
    FrozenArrays,
    IntArray,
)

# Number of pairs of a corner and an edge in one batch, which limits memory.
_PAIRS_AT_ONCE = 1 << 18
# Lengths that differ by less than this count as equal, metres, since the last bits of means of
# cells are inexact.
TIE: Final = 1e-9
# Number of decimals to which a length in metres is rounded so that it is a multiple of `TIE`.
_TIE_DECIMALS = 9


def convex_hulls(points: IntArray, group: IntArray) -> FloatArray:
    """Return the convex hulls of N groups of points.

    Args:
        points: (P, 2) int64 whole coordinates.
        group: (P,) int64 group of each point: 0 to N − 1, each at least once.

    Returns:
        (N, V, 2) corners in order around each hull, without points on a straight edge; hulls with
        fewer than V corners repeat the last one. A single point has 1 corner, a straight line 2.
    """
    if not len(points):
        return np.zeros((0, 1, 2))
    chain, row, column = _outer_points(points, group)
    is_corner = _lower_envelope(chain, row, column)
    chain = chain[is_corner]
    row = row[is_corner]
    column = column[is_corner]
    group, is_right = np.divmod(chain, 2)
    column = np.where(is_right, -column, column)
    # up the left chain and down the right one
    order = np.lexsort((np.where(is_right, -row, row), is_right, group))
    group = group[order]
    corners = np.stack([row, column], axis=1)[order]
    # the two chains of a group may share their first and last points
    is_same_group = group[1:] == group[:-1]
    is_repeated = np.zeros(len(group), dtype=bool)
    is_repeated[1:] = is_same_group & (corners[1:] == corners[:-1]).all(axis=1)
    ends = np.flatnonzero(np.append(~is_same_group, True))
    starts = np.concatenate([[0], ends[:-1] + 1])
    is_closed = (corners[ends] == corners[starts]).all(axis=1)
    is_repeated[ends] |= is_closed & (starts != ends)
    return _pad_corners(corners[~is_repeated], group[~is_repeated])


def hull_distances(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the shortest distance of each pair of hulls; 0 if they touch or overlap.

    Args:
        first: (P, V, 2) corners of the first hulls.
        second: (P, W, 2) corners of the second hulls, in the same unit.

    Returns:
        (P,) distances, in the unit of the corners.
    """
    distances = np.zeros(len(first))
    batch_size = max(1, _PAIRS_AT_ONCE // max(1, first.shape[1] * second.shape[1]))
    for start in range(0, len(first), batch_size):
        batch = slice(start, start + batch_size)
        distances[batch] = _batch_distances(first[batch], second[batch])
    return distances


def _outer_points(points: IntArray, group: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """Return the leftmost and the rightmost point of each group in each row that it occupies.

    Returns:
        Chains (2 · group for the left side, 2 · group + 1 for the right side), rows and columns,
        ordered by chain and row. The columns of right sides are mirrored.
    """
    low_row, low_column = points.min(axis=0)
    high_row, high_column = points.max(axis=0)
    row_count = high_row - low_row + 1
    column_count = high_column - low_column + 1
    line = group * row_count + points[:, 0] - low_row
    key = np.sort(line * column_count + points[:, 1] - low_column)
    line, column = np.divmod(key, column_count)
    column += low_column
    is_first = np.append(True, line[1:] != line[:-1])
    is_last = np.append(is_first[1:], True)
    group, row = np.divmod(line[is_first], row_count)
    chain = np.concatenate([2 * group, 2 * group + 1])
    rows = np.tile(row + low_row, 2)
    columns = np.concatenate([column[is_first], -column[is_last]])
    order = np.argsort(chain, kind="stable")
    return chain[order], rows[order], columns[order]


def _lower_envelope(chain: IntArray, row: IntArray, column: IntArray) -> IntArray:
    """Return the indices of the points that are corners of the lower convex hull of their chains.

    The ends of a chain are always corners. A point on or above the line between two other points is
    not a corner. So all points above the line between their neighbours are removed at once, and
    this is repeated until there are none.

    Args:
        chain: (P,) chain of each point.
        row: (P,) row of each point, ascending in a chain.
        column: (P,) column of each point.
    """
    corners = np.arange(len(chain))
    while True:
        corner_chain = chain[corners]
        x = row[corners]
        y = column[corners]
        is_same_chain = corner_chain[2:] == corner_chain[:-2]
        rise = (y[1:-1] - y[:-2]) * (x[2:] - x[:-2])
        rise_of_line = (y[2:] - y[:-2]) * (x[1:-1] - x[:-2])
        is_inner = np.zeros(len(corners), dtype=bool)
        is_inner[1:-1] = is_same_chain & (rise >= rise_of_line)
        if not is_inner.any():
            return corners
        corners = corners[~is_inner]


def _pad_corners(corners: IntArray, group: IntArray) -> FloatArray:
    """Return the corners of each group, with the last one repeated, shape (N, V, 2)."""
    counts = np.bincount(group)
    starts = np.cumsum(counts) - counts
    offsets = np.minimum(np.arange(counts.max()), counts[:, None] - 1)
    padded = corners[starts[:, None] + offsets]
    return np.asarray(padded.astype(np.float64))


def _batch_distances(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the shortest distance of each pair of hulls in a batch, shape (P,)."""
    squared_to_second, direction_to_second = _nearest_sides(first, second)
    squared_to_first, direction_to_first = _nearest_sides(second, first)
    is_to_second = (squared_to_second <= squared_to_first)[:, None]
    direction = np.where(is_to_second, direction_to_second, -direction_to_first)
    squared_distance = np.minimum(squared_to_second, squared_to_first)
    is_apart = _is_separating(direction, first, second)
    return np.where(is_apart, np.sqrt(squared_distance), 0.0)


def _nearest_sides(points: FloatArray, hull: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Find the shortest line from the edges of one hull to the corners of another, for each pair.

    Args:
        points: (P, V, 2) corners.
        hull: (P, W, 2) corners of the hulls whose edges are used.

    Returns:
        Squared lengths, (P,), and directions as vectors of arbitrary length, (P, 2).
    """
    side = np.roll(hull, -1, axis=1) - hull
    offset = points[:, :, None] - hull[:, None]
    squared_length = (side * side).sum(axis=-1)[:, None]
    along = (offset * side[:, None]).sum(axis=-1)
    across = side[:, None, :, 0] * offset[..., 1] - side[:, None, :, 1] * offset[..., 0]
    is_beside = (along > 0) & (along < squared_length)
    # a point beyond the ends of an edge is nearest to an end, and each end is the start of an edge
    squared_to_side = across * across / np.where(is_beside, squared_length, 1.0)
    squared_to_start = (offset * offset).sum(axis=-1)
    squared = np.where(is_beside, squared_to_side, squared_to_start).reshape(len(points), -1)
    pair = np.arange(len(points))
    nearest_sides = np.argmin(squared, axis=1)
    corner, edge = np.divmod(nearest_sides, hull.shape[1])
    nearest_side = side[pair, edge]
    normal = np.stack([-nearest_side[:, 1], nearest_side[:, 0]], axis=1)
    normal = normal * across[pair, corner, edge, None]
    is_normal = is_beside[pair, corner, edge, None]
    direction = np.where(is_normal, normal, offset[pair, corner, edge])
    return squared[pair, nearest_sides], direction


def _is_separating(direction: FloatArray, first: FloatArray, second: FloatArray) -> BoolArray:
    """Return whether a line perpendicular to the direction separates the two hulls, shape (P,).

    The direction points from the second hull to the first. If hulls do not touch, the shortest line
    between a corner and an edge is the shortest of all, and a perpendicular line separates them.
    Hulls that overlap cannot be separated.
    """
    lowest_first = np.einsum("pvk,pk->pv", first, direction).min(axis=1)
    highest_second = np.einsum("pvk,pk->pv", second, direction).max(axis=1)
    return np.asarray(lowest_first > highest_second)


@dataclass(frozen=True, slots=True, kw_only=True)
class AccidentReading:
    """The definition of an accident in maps: two instances whose outlines are near each other.

    An outline is the convex hull of cell centres; points and lines are hulls, too. Instances are
    extracted from heads in the same way as for the paper's motion metrics. The current frame
    counts, too. A pair's accident is in the frame in which the two are closest (ties: the
    earliest).

    Attributes:
        danger_distance: Two instances collide if they come nearer to each other than this, metres;
            1 m in the paper.
    """

    danger_distance: float = 1.0

    def __post_init__(self) -> None:
        """Check the field; raise ConfigError if the distance is invalid."""
        if not 0 < self.danger_distance < np.inf:
            raise ConfigError(
                f"danger_distance: expected metres above 0, found {self.danger_distance!r}"
            )


def instances_of_heads(heads: MotionHeads) -> AnyArray:
    """Extract instance maps (T, H, W) from heads, in the same way as for motion metrics.

    The maps have the orientation of the heads.
    """
    return predict_instances(heads, "motion").instance


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class InstanceTracks(FrozenArrays):
    """Positions of instances in T frames; arrays are read-only.

    Attributes:
        identity: (I,) int64 ids of the instances, ascending.
        center: (T, I, 2) float64 means of the instances' cells, x forward, y left, metres; NaN
            where an instance is missing.
    """

    identity: IntArray
    center: FloatArray

    def at(self, frame: int, identities: tuple[int, int]) -> FloatArray:
        """Return the positions of two instances in a frame, (2, 2) metres; NaN if missing."""
        columns = self.identity.searchsorted(identities)
        return np.asarray(self.center[frame, columns])


@dataclass(frozen=True, slots=True, kw_only=True)
class MapContact:
    """A collision of two instances.

    Attributes:
        frame: Index of the frame of the collision.
        ids: Ids of the two instances, ascending.
        distance: Distance between the outlines of the two, metres.
    """

    frame: int
    ids: tuple[int, int]
    distance: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class InstanceAccident:
    """The accident in the instance maps of one prediction or label, if there is one.

    Attributes:
        tracks: Tracks of all instances.
        contact: Colliding pair; None if no pair comes near enough.
    """

    tracks: InstanceTracks
    contact: MapContact | None

    @property
    def positions(self) -> FloatArray:
        """(2, 2) positions of the colliding pair, x forward, y left, metres; NaN for none."""
        if self.contact is None:
            return np.full((2, 2), np.nan)
        return self.tracks.at(self.contact.frame, self.contact.ids)

    def explicit(self, seconds: float) -> Accident | None:
        """Convert to an explicit accident without ids; None if no pair collides.

        Args:
            seconds: Seconds from one frame to the next.
        """
        if self.contact is None:
            return None
        return Accident(positions=self.positions, time=self.contact.frame * seconds)


def even(length: FloatArray) -> FloatArray:
    """Round lengths in metres so that values within `TIE` compare equal."""
    return np.round(length, _TIE_DECIMALS)


def map_accident(
    instance: AnyArray, grid: BevGrid, rules: LabelProtocol | None, reading: AccidentReading
) -> InstanceAccident:
    """Extract the tracks of instances, and the pair of instances that collides, if any.

    If there are several pairs or frames, the one with the smallest distance counts. Ties are broken
    by the earliest frame, then the nearest centres, then the lowest ids.

    Args:
        instance: (T, H, W) ids from 1 that stay the same over the frames, 0 or less elsewhere.
        grid: Cells and orientation of the maps.
        rules: Protocol of the labels that the maps were made from, or that the model was trained
            on. If it shifts maps by half a cell, the shift is undone in positions. None if there
            are no such labels.
        reading: Definition of a collision.
    """
    shapes = _read_shapes(instance, grid.orientation)
    cell_size = np.array([grid.x[2], grid.y[2]])
    tracks = _make_tracks(shapes, len(instance), grid, rules)
    return InstanceAccident(
        tracks=tracks,
        contact=_find_contact(shapes, cell_size, reading.danger_distance),
    )


def _make_tracks(
    shapes: _Shapes, frames: int, grid: BevGrid, rules: LabelProtocol | None
) -> InstanceTracks:
    """Build the tracks of instances from their shapes; see `map_accident` for the arguments."""
    identity, identity_index = np.unique(shapes.identity, return_inverse=True)
    place_in_cell = 0.5 if rules is None else rules.place_in_cell
    low_x, _, cell_length = grid.x
    low_y, _, cell_width = grid.y
    cell_size = np.array([cell_length, cell_width])
    positions = [low_x, low_y] + (shapes.center + place_in_cell) * cell_size
    center = np.full((frames, len(identity), 2), np.nan)
    center[shapes.frame, identity_index] = positions
    return InstanceTracks(identity=identity, center=center)


def predicted_tracks(output: MotionOutput, rules: LabelProtocol | None) -> list[InstanceTracks]:
    """Extract the tracks of each of the K predictions; see `map_accident` for the arguments."""
    tracks = []
    for maps in _instance_maps(output, None):
        shapes = _read_shapes(maps, output.grid.orientation)
        tracks.append(_make_tracks(shapes, len(maps), output.grid, rules))
    return tracks


def _instance_maps(output: MotionOutput, frames: int | None) -> Iterator[AnyArray]:
    """Yield the instance maps of each prediction, cut to a number of frames (None for all)."""
    if output.instances is not None:
        yield from output.instances[:, :frames]
        return
    for heads in output.heads or ():
        yield instances_of_heads(heads if frames is None else first_frames(heads, frames))


def predicted_accidents(
    output: MotionOutput,
    rules: LabelProtocol | None,
    reading: AccidentReading,
    frames: int | None = None,
) -> list[InstanceAccident]:
    """Extract the tracks and the accident of each of the K predictions (see `map_accident`).

    Args:
        output: Predictions of a sample.
        rules: Protocol of the labels, as in `map_accident`.
        reading: Definition of a collision.
        frames: Number of first frames to use; None for all frames.
    """
    accidents = []
    for maps in _instance_maps(output, frames):
        accidents.append(map_accident(maps, output.grid, rules, reading))
    return accidents


def match_tracks(predicted: InstanceTracks, truth: InstanceTracks, gate: float) -> dict[int, int]:
    """Match predicted and true instances that take the same path, one to one.

    The distance of a pair is the distance of its centres, averaged over the frames in which both
    exist. The matching has as many pairs within `gate` as possible; then it takes the smallest sum
    of distances. (So a distant pair cannot use up an instance that another pair needs, unlike in
    the released code.)

    Args:
        predicted: Tracks over T frames.
        truth: Tracks over the same frames.
        gate: Pairs that are farther apart than this, in metres, or never exist in the same frame,
            do not match.

    Returns:
        Predicted id → true id.
    """
    from scipy.optimize import linear_sum_assignment

    offset = predicted.center[:, :, None] - truth.center[:, None]
    distances = np.linalg.norm(offset, axis=-1)
    is_common = np.isfinite(distances)
    sums = np.where(is_common, distances, 0).sum(axis=0)
    means = even(sums / np.maximum(is_common.sum(axis=0), 1))
    distance = np.where(is_common.any(axis=0), means, np.inf)
    is_allowed = distance <= gate + TIE
    # one more pair within the gate outweighs any sum of distances
    refusal_cost = (gate + 1) * (min(distance.shape) + 1)
    rows, columns = linear_sum_assignment(np.where(is_allowed, distance, refusal_cost))
    matches = {}
    for row, column in zip(rows.tolist(), columns.tolist(), strict=True):
        if is_allowed[row, column]:
            matches[int(predicted.identity[row])] = int(truth.identity[column])
    return matches


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Shapes:
    """Cells of N shapes, ordered by frame and id; a shape is one instance in one frame.

    Cells have indices along x (forward) and y (left).

    Attributes:
        frame: (N,) int64 frame of each shape.
        identity: (N,) int64 id of each shape's instance.
        center: (N, 2) float64 mean cell of each shape.
        low: (N, 2) int64 lowest cells of each shape.
        high: (N, 2) int64 highest cells of each shape.
        cells: (P, 2) int64 all cells.
        group: (P,) int64 shape of each cell, from 0 to N − 1.
    """

    frame: IntArray
    identity: IntArray
    center: FloatArray
    low: IntArray
    high: IntArray
    cells: IntArray
    group: IntArray

    def hulls(self, rows: IntArray) -> FloatArray:
        """Return the outlines of the shapes with indices `rows`, in cells, (len(rows), V, 2)."""
        number = np.full(len(self.frame), -1)
        number[rows] = np.arange(len(rows))
        group = number[self.group]
        is_selected = group >= 0
        return convex_hulls(self.cells[is_selected], group[is_selected])


def _read_shapes(instance: AnyArray, orientation: Orientation) -> _Shapes:
    """Extract the shapes of the instances in maps (T, H, W)."""
    rows, columns = instance.shape[1:]
    flat = np.flatnonzero(instance > 0)  # much faster for a mask than for integers
    frame, cell = np.divmod(flat, rows * columns)
    row, column = np.divmod(cell, columns)
    y, x = cells_in(row, column, (rows, columns), orientation, "devkit")
    identity = instance.reshape(-1)[flat].astype(np.int64)
    keys = frame * (identity.max(initial=0) + 1) + identity
    key, group = np.unique(keys, return_inverse=True)
    counts = np.bincount(group, minlength=len(key))
    order = np.argsort(group, kind="stable")
    starts = np.cumsum(counts) - counts
    cells = np.stack([x, y], axis=1)
    sums = np.stack([np.bincount(group, values, len(key)) for values in cells.T], axis=1)
    low = cells
    high = cells
    if len(key):
        sorted_cells = cells[order]
        low = np.minimum.reduceat(sorted_cells, starts)
        high = np.maximum.reduceat(sorted_cells, starts)
    return _Shapes(
        frame=frame[order][starts],
        identity=identity[order][starts],
        center=sums / counts[:, None],
        low=low,
        high=high,
        cells=cells,
        group=group,
    )


def _find_contact(
    shapes: _Shapes, cell_size: FloatArray, danger_distance: float
) -> MapContact | None:
    """Return the colliding pair of instances; None if no pair comes near enough.

    Args:
        shapes: Shapes of the instances.
        cell_size: (2,) size of a cell along x and y, metres.
        danger_distance: The pair comes nearer to each other than this, metres.
    """
    first, second = _near_pairs(shapes, cell_size, danger_distance)
    if not len(first):
        return None
    rows, row_index = np.unique(np.concatenate([first, second]), return_inverse=True)
    scale = cell_size.min()  # so that coordinates of square cells stay integers
    hulls = shapes.hulls(rows) * (cell_size / scale)
    first_hulls = hulls[row_index[: len(first)]]
    second_hulls = hulls[row_index[len(first) :]]
    distance = even(hull_distances(first_hulls, second_hulls) * scale)
    is_contact = distance < danger_distance
    if not is_contact.any():
        return None
    first = first[is_contact]
    second = second[is_contact]
    distance = distance[is_contact]
    offset = (shapes.center[first] - shapes.center[second]) * cell_size
    center_distance = even(np.linalg.norm(offset, axis=1))
    frame = shapes.frame[first]
    identity = shapes.identity
    keys = (identity[second], identity[first], center_distance, frame, distance)
    best_row = np.lexsort(keys)[0]  # the last key counts first
    return MapContact(
        frame=int(frame[best_row]),
        ids=(int(identity[first[best_row]]), int(identity[second[best_row]])),
        distance=float(distance[best_row]),
    )


def _near_pairs(
    shapes: _Shapes, cell_size: FloatArray, danger_distance: float
) -> tuple[IntArray, IntArray]:
    """Return pairs of shapes in the same frame with bounding boxes nearer than the distance."""
    first_rows = [NO_INDICES]
    second_rows = [NO_INDICES]
    frame_starts = np.flatnonzero(np.diff(shapes.frame, prepend=-1)).tolist()
    for start, end in pairwise([*frame_starts, len(shapes.frame)]):
        low = shapes.low[start:end]
        high = shapes.high[start:end]
        gap = np.maximum(low[:, None] - high, low - high[:, None])
        gap_m = np.maximum(gap, 0) * cell_size
        distance = np.hypot(gap_m[..., 0], gap_m[..., 1])
        first, second = np.nonzero(np.triu(distance < danger_distance, 1))
        first_rows.append(first + start)
        second_rows.append(second + start)
    return np.concatenate(first_rows), np.concatenate(second_rows)
