"""Accidents in instance maps, as the paper defines them: instances that come near each other.

docs/released_code.md, Paper versus code, lists the differences of the released code. Outlines are
convex hulls of sets of cells; points and straight lines are hulls like any other. With whole
numbers as coordinates all compared values are exact, so that equal distances are equal floats.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.evaluation.predictions import Accident, MotionOutput, first_frames
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.geometry.bev_grid import Orientation, cells_in
from deepaccident_devkit.motion import LabelProtocol, MotionHeads, predict_instances
from deepaccident_devkit.support.arrays import (
    AnyArray,
    BoolArray,
    FloatArray,
    FrozenArrays,
    IntArray,
)

# Number of pairs of corner and side in one batch: it bounds the memory.
_PAIRS_AT_ONCE = 1 << 18
# Metres; lengths that differ by less are equal: means of cells are inexact in the last bits.
TIE: Final = 1e-9
_TIE_DECIMALS: Final = 9


def convex_hulls(points: IntArray, group: IntArray) -> FloatArray:
    """Return the convex hulls of N groups of points.

    Args:
        points: (P, 2) int64 whole coordinates.
        group: (P,) int64 group of each point: 0 to N − 1, each at least once.

    Returns:
        (N, V, 2) corners in order around each hull, without points on a straight side; hulls of
        fewer than V corners repeat their last one. A single point has 1 corner, a straight line 2.
    """
    if not len(points):
        return np.zeros((0, 1, 2))
    chain, along, aside = _both_sides(points, group)
    corner_rows = _lower_envelope(chain, along, aside)
    chain = chain[corner_rows]
    along = along[corner_rows]
    aside = aside[corner_rows]
    group = chain // 2
    is_right = chain % 2
    aside = np.where(is_right, -aside, aside)
    # up the left side and down the right one, without the right one's end where both meet
    order = np.lexsort((np.where(is_right, -along, along), is_right, group))
    group = group[order]
    corners = np.stack([along, aside], axis=1)[order]
    is_repeated = np.zeros(len(group), dtype=bool)
    is_same_group = group[1:] == group[:-1]
    is_repeated[1:] = is_same_group & (corners[1:] == corners[:-1]).all(axis=1)
    ends = np.flatnonzero(np.append(~is_same_group, True))
    starts = np.concatenate([[0], ends[:-1] + 1])
    is_repeated[ends] |= (corners[ends] == corners[starts]).all(axis=1) & (starts != ends)
    return _padded(corners[~is_repeated], group[~is_repeated])


def hull_distances(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the shortest distances between hulls, pair by pair, 0 where they touch or overlap.

    Args:
        first: (P, V, 2) corners.
        second: (P, W, 2) corners.

    Returns:
        (P,) distances.
    """
    result = np.zeros(len(first))
    step = max(1, _PAIRS_AT_ONCE // max(1, first.shape[1] * second.shape[1]))
    for start in range(0, len(first), step):
        batch = slice(start, start + step)
        result[batch] = _distances(first[batch], second[batch])
    return result


def _both_sides(points: IntArray, group: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """Return the leftmost and the rightmost points of each row of each group, the latter mirrored.

    Returns:
        Chains (2 · group for the left, 2 · group + 1 for the right side), rows and columns, by
        chain and row.
    """
    low = points.min(axis=0)
    rows, columns = (points.max(axis=0) - low + 1).tolist()
    key = np.sort((group * rows + points[:, 0] - low[0]) * columns + points[:, 1] - low[1])
    line, column = np.divmod(key, columns)
    begins = np.append(True, line[1:] != line[:-1])
    ends = np.append(begins[1:], True)
    group, row = np.divmod(line[begins], rows)
    chain = np.concatenate([2 * group, 2 * group + 1])
    aside = np.concatenate([column[begins] + low[1], -(column[ends] + low[1])])
    order = np.argsort(chain, kind="stable")
    return chain[order], np.tile(row + low[0], 2)[order], aside[order]


def _lower_envelope(chain: IntArray, along: IntArray, aside: IntArray) -> IntArray:
    """Return the rows that are corners of the convex lower side of each chain; its ends always are.

    A point on or above the line between any two others is not a corner. So all points above the
    line between their neighbours are removed at once, again and again, until there are none.

    Args:
        chain: (P,) chain of each point.
        along: (P,) coordinate in which each chain ascends.
        aside: (P,) other coordinate.
    """
    rows = np.arange(len(chain))
    while True:
        part = chain[rows]
        a = along[rows]
        b = aside[rows]
        is_inner = np.zeros(len(rows), dtype=bool)
        is_same_chain = part[2:] == part[:-2]
        rise = (b[1:-1] - b[:-2]) * (a[2:] - a[:-2])
        is_inner[1:-1] = is_same_chain & (rise >= (b[2:] - b[:-2]) * (a[1:-1] - a[:-2]))
        if not is_inner.any():
            return rows
        rows = rows[~is_inner]


def _padded(corners: IntArray, group: IntArray) -> FloatArray:
    """Return the corners of each group, the last one repeated, shape (N, V, 2)."""
    count = np.bincount(group)
    start = np.cumsum(count) - count
    offset = np.minimum(np.arange(count.max()), count[:, None] - 1)
    return np.asarray(corners[start[:, None] + offset].astype(np.float64))


def _distances(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the shortest distances between hulls, pair by pair, shape (P,)."""
    to_second, direction_to_second = _to_sides(first, second)
    to_first, direction_to_first = _to_sides(second, first)
    is_to_second = (to_second <= to_first)[:, None]
    direction = np.where(is_to_second, direction_to_second, -direction_to_first)
    squared = np.minimum(to_second, to_first)
    return np.where(_is_separating(direction, first, second), np.sqrt(squared), 0.0)


def _to_sides(points: FloatArray, hull: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the shortest way from a side of hulls to a corner: squared length and direction.

    Args:
        points: (P, V, 2) corners.
        hull: (P, W, 2) corners of the other hulls.

    Returns:
        Squared lengths, (P,), and vectors of any length, (P, 2).
    """
    side = np.roll(hull, -1, axis=1) - hull
    apart = points[:, :, None] - hull[:, None]
    length = (side * side).sum(axis=-1)[:, None]
    along = (apart * side[:, None]).sum(axis=-1)
    across = side[:, None, :, 0] * apart[..., 1] - side[:, None, :, 1] * apart[..., 0]
    is_beside = (along > 0) & (along < length)
    # beyond a side's ends the way to the end itself is the nearest; each end is some side's start
    to_side = across * across / np.where(is_beside, length, 1.0)
    squared = np.where(is_beside, to_side, (apart * apart).sum(axis=-1))
    pair = np.arange(len(points))
    flat = squared.reshape(len(points), -1)
    best = np.argmin(flat, axis=1)
    corner, edge = np.divmod(best, hull.shape[1])
    to_end = apart[pair, corner, edge]
    best_side = side[pair, edge]
    normal = np.stack([-best_side[:, 1], best_side[:, 0]], axis=1)
    normal = normal * across[pair, corner, edge, None]
    direction = np.where(is_beside[pair, corner, edge, None], normal, to_end)
    return flat[pair, best], direction


def _is_separating(direction: FloatArray, first: FloatArray, second: FloatArray) -> BoolArray:
    """Return whether a line across a direction separates the two hulls, shape (P,).

    The direction leads from the second hull to the first.

    For hulls that are apart the shortest way between corners and sides is the shortest of all, and
    such a line crosses it; hulls that overlap cannot be separated.
    """
    lowest_first = np.einsum("pvk,pk->pv", first, direction).min(axis=1)
    highest_second = np.einsum("pvk,pk->pv", second, direction).max(axis=1)
    return np.asarray(lowest_first > highest_second)


@dataclass(frozen=True, slots=True, kw_only=True)
class AccidentReading:
    """Which instances collide: the ones with convex hulls of cell centres near each other.

    Points and lines are hulls too. For heads the instances are read as for the paper's motion
    metrics; the present frame counts, and the frame of a pair's accident is where it is closest,
    the earliest if there are several.

    Attributes:
        danger_distance: Metres; instances that come nearer to each other collide. The paper has 1
            m.
    """

    danger_distance: float = 1.0

    def __post_init__(self) -> None:
        """Check the value; raises ConfigError."""
        if not 0 < self.danger_distance < np.inf:
            raise ConfigError(
                f"danger_distance: expected metres above 0, found {self.danger_distance!r}"
            )


def instances_of_heads(heads: MotionHeads) -> AnyArray:
    """Return the instances of heads, read off as for the motion metrics.

    The maps (T, H, W) are in the orientation of the heads.
    """
    return predict_instances(heads, "motion").instance


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class InstanceTracks(FrozenArrays):
    """Positions of instances at T moments; arrays are read-only.

    Attributes:
        identity: (I,) int64, ascending.
        center: (T, I, 2) float64 mean of their cells, x forward, y left, metres; NaN where an
            instance is missing.
    """

    identity: IntArray
    center: FloatArray

    def at(self, frame: int, identities: tuple[int, int]) -> FloatArray:
        """Return the positions of two instances at a moment, (2, 2); NaN where missing."""
        columns = self.identity.searchsorted(identities)
        return np.asarray(self.center[frame, columns])


@dataclass(frozen=True, slots=True, kw_only=True)
class MapContact:
    """The two instances that collide.

    Attributes:
        frame: Frame of the maps, from 0.
        ids: Ids of the two, ascending.
        distance: Metres between their outlines.
    """

    frame: int
    ids: tuple[int, int]
    distance: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class InstanceAccident:
    """The accident in one set of instance maps, if there is one.

    Attributes:
        tracks: Tracks of all instances.
        contact: Colliding pair; None if no pair comes near enough.
    """

    tracks: InstanceTracks
    contact: MapContact | None

    @property
    def positions(self) -> FloatArray:
        """(2, 2) x forward, y left of the colliding pair at its moment, metres; NaN without one."""
        if self.contact is None:
            return np.full((2, 2), np.nan)
        return self.tracks.at(self.contact.frame, self.contact.ids)

    def explicit(self, seconds: float) -> Accident | None:
        """Return it as an explicit accident without ids; None without a contact.

        Args:
            seconds: Seconds from frame to frame.
        """
        if self.contact is None:
            return None
        return Accident(positions=self.positions, time=self.contact.frame * seconds)


def even(length: FloatArray) -> FloatArray:
    """Return lengths in metres, rounded so that values within `TIE` compare equal."""
    return np.round(length, _TIE_DECIMALS)


def map_accident(
    instance: AnyArray, grid: BevGrid, rules: LabelProtocol | None, reading: AccidentReading
) -> InstanceAccident:
    """Return the tracks of instances, and the pair of them that collides, if any does.

    Of several pairs and moments the one with the smallest distance counts; of equal ones the
    earlier, then the one with the nearer centres, then the one with the lower ids.

    Args:
        instance: (T, H, W) ids from 1 that stay the same over the frames, 0 or less elsewhere.
        grid: Cells and orientation of the maps.
        rules: Protocol of the labels that the maps are, or were learned from: where it has the
            half-cell shift, it is undone in positions. None for maps without any.
        reading: What counts as a collision.
    """
    shapes = _shapes(instance, grid.orientation)
    size = np.array([grid.x[2], grid.y[2]])
    return InstanceAccident(
        tracks=_tracks(shapes, len(instance), grid, rules),
        contact=_contact(shapes, size, reading.danger_distance),
    )


def _tracks(
    shapes: _Shapes, frames: int, grid: BevGrid, rules: LabelProtocol | None
) -> InstanceTracks:
    """Return the tracks of instances; arguments as for `map_accident`."""
    identity, identity_index = np.unique(shapes.identity, return_inverse=True)
    center = np.full((frames, len(identity), 2), np.nan)
    cells = shapes.center + (0.5 if rules is None else rules.place_in_cell)
    origin = [grid.x[0], grid.y[0]]
    size = np.array([grid.x[2], grid.y[2]])
    center[shapes.frame, identity_index] = origin + cells * size
    return InstanceTracks(identity=identity, center=center)


def predicted_tracks(output: MotionOutput, rules: LabelProtocol | None) -> list[InstanceTracks]:
    """Return the tracks of each of the K predictions; arguments as for `map_accident`."""
    tracks = []
    for maps in _instance_maps(output, None):
        shapes = _shapes(maps, output.grid.orientation)
        tracks.append(_tracks(shapes, len(maps), output.grid, rules))
    return tracks


def _instance_maps(output: MotionOutput, frames: int | None) -> Iterator[AnyArray]:
    """Yield the instances of each prediction, cut to a number of frames; None for all."""
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
    """Return what `map_accident` reads off each of the K predictions.

    Args:
        output: Predictions.
        rules: As for `map_accident`.
        reading: As for `map_accident`.
        frames: Number of frames to which predictions are cut; None for all.
    """
    accidents = []
    for maps in _instance_maps(output, frames):
        accidents.append(map_accident(maps, output.grid, rules, reading))
    return accidents


def match_tracks(predicted: InstanceTracks, truth: InstanceTracks, gate: float) -> dict[int, int]:
    """Match instances with the same path, one to one: predicted id → true id.

    Pair distance: mean centre distance over the moments at which both exist. The matching has as
    many pairs within `gate` as possible, and then the least sum of distances. (So a distant pair
    cannot use up an instance that another one needs, as it does in the released code.)

    Args:
        predicted: Tracks over T moments.
        truth: Tracks over the same moments.
        gate: Metres; pairs farther apart, and pairs that never exist together, do not match.
    """
    from scipy.optimize import linear_sum_assignment

    apart = np.linalg.norm(predicted.center[:, :, None] - truth.center[:, None], axis=-1)
    is_common = np.isfinite(apart)
    sums = np.where(is_common, apart, 0).sum(axis=0)
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
    """N instances at frames, by frame and id; cells are counted along x forward and y left.

    Attributes:
        frame: (N,) int64.
        identity: (N,) int64.
        center: (N, 2) float64 mean of the cells.
        low: (N, 2) int64 lowest cells.
        high: (N, 2) int64 highest cells.
        cells: (P, 2) int64 all cells.
        group: (P,) int64 instance of each cell, from 0 to N − 1.
    """

    frame: IntArray
    identity: IntArray
    center: FloatArray
    low: IntArray
    high: IntArray
    cells: IntArray
    group: IntArray

    def hulls(self, rows: IntArray) -> FloatArray:
        """Return the outlines of some instances in cells, shape (len(rows), V, 2)."""
        number = np.full(len(self.frame), -1)
        number[rows] = np.arange(len(rows))
        group = number[self.group]
        is_selected = group >= 0
        return convex_hulls(self.cells[is_selected], group[is_selected])


def _shapes(instance: AnyArray, orientation: Orientation) -> _Shapes:
    """Return the instances of maps (T, H, W), by frame and id."""
    rows, columns = instance.shape[1:]
    flat = np.flatnonzero(instance > 0)  # of a mask: much faster than of integers
    frame, cell = np.divmod(flat, rows * columns)
    row, column = np.divmod(cell, columns)
    y, x = cells_in(row, column, (rows, columns), orientation, "devkit")
    identity = instance.reshape(-1)[flat].astype(np.int64)
    keys = frame * (identity.max(initial=0) + 1) + identity
    key, group = np.unique(keys, return_inverse=True)
    count = np.bincount(group, minlength=len(key))
    order = np.argsort(group, kind="stable")
    begin = np.cumsum(count) - count
    cells = np.stack([x, y], axis=1)
    sums = np.stack([np.bincount(group, values, len(key)) for values in cells.T], axis=1)
    low = cells
    high = cells
    if len(key):
        sorted_cells = cells[order]
        low = np.minimum.reduceat(sorted_cells, begin)
        high = np.maximum.reduceat(sorted_cells, begin)
    return _Shapes(
        frame=frame[order][begin],
        identity=identity[order][begin],
        center=sums / count[:, None],
        low=low,
        high=high,
        cells=cells,
        group=group,
    )


def _contact(shapes: _Shapes, size: FloatArray, danger_distance: float) -> MapContact | None:
    """Return the colliding pair of instances; None if no pair comes near enough.

    Args:
        shapes: Instances at frames.
        size: (2,) size of a cell along x and y, metres.
        danger_distance: Metres; the pair comes nearer than this.
    """
    first, second = _candidates(shapes, size, danger_distance)
    if not len(first):
        return None
    rows, row_index = np.unique(np.concatenate([first, second]), return_inverse=True)
    unit = size.min()  # square cells stay whole numbers
    hulls = shapes.hulls(rows) * (size / unit)
    first_hulls = hulls[row_index[: len(first)]]
    second_hulls = hulls[row_index[len(first) :]]
    distance = even(hull_distances(first_hulls, second_hulls) * unit)
    near = np.flatnonzero(distance < danger_distance)
    if not len(near):
        return None
    first = first[near]
    second = second[near]
    distance = distance[near]
    offset = (shapes.center[first] - shapes.center[second]) * size
    center_distance = even(np.linalg.norm(offset, axis=1))
    frame = shapes.frame[first]
    identity = shapes.identity
    keys = (identity[second], identity[first], center_distance, frame, distance)
    best = np.lexsort(keys)[0]
    return MapContact(
        frame=int(frame[best]),
        ids=(int(identity[first[best]]), int(identity[second[best]])),
        distance=float(distance[best]),
    )


def _candidates(
    shapes: _Shapes, size: FloatArray, danger_distance: float
) -> tuple[IntArray, IntArray]:
    """Return pairs of rows of one frame with bounding boxes nearer than the distance."""
    firsts = [np.zeros(0, dtype=np.int64)]
    seconds = [np.zeros(0, dtype=np.int64)]
    starts = np.append(np.flatnonzero(np.diff(shapes.frame, prepend=-1)), len(shapes.frame))
    for start, end in zip(starts[:-1].tolist(), starts[1:].tolist(), strict=True):
        low = shapes.low[start:end]
        high = shapes.high[start:end]
        gap = np.maximum(low[:, None] - high, low - high[:, None])
        distance = np.hypot(*np.moveaxis(np.maximum(gap, 0) * size, -1, 0))
        first, second = np.nonzero(np.triu(distance < danger_distance, 1))
        firsts.append(first + start)
        seconds.append(second + start)
    return np.concatenate(firsts), np.concatenate(seconds)
