"""Accidents that instance maps show, by the paper's words: instances whose outlines come near each other.

docs/released_code.md, Paper versus code, has where the released code differs. Outlines are convex hulls of sets of
cells; points and straight lines are hulls like any other. With whole numbers as coordinates everything that is compared
is exact, so that equal distances are equal floats.
"""

from __future__ import annotations

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

# The number of pairs of corner and side in one batch: bounds the memory.
_PAIRS_AT_ONCE = 1 << 18


def convex_hulls(points: IntArray, group: IntArray) -> FloatArray:
    """The convex hulls of N groups of points.

    Args:
        points: (P, 2) int64 whole coordinates.
        group: (P,) int64 which group each belongs to: 0 to N − 1, each at least once.

    Returns:
        (N, V, 2) corners in order around each hull, without those on a straight side; hulls of fewer than V corners
        repeat their last one. A single point has 1 corner, a straight line 2.
    """
    if not len(points):
        return np.zeros((0, 1, 2))
    chain, along, aside = _both_sides(points, group)
    kept = _lower_envelope(chain, along, aside)
    group, right = chain[kept] // 2, chain[kept] % 2
    along, aside = along[kept], np.where(right, -aside[kept], aside[kept])
    # up the left side and down the right one, without the right one's end where both meet in a point
    order = np.lexsort((np.where(right, -along, along), right, group))
    group, corners = group[order], np.stack([along, aside], axis=1)[order]
    again = np.zeros(len(group), dtype=bool)
    again[1:] = (group[1:] == group[:-1]) & (corners[1:] == corners[:-1]).all(axis=1)
    last = np.append(group[1:] != group[:-1], True)
    first = np.concatenate([[0], np.flatnonzero(last)[:-1] + 1])
    again[last] |= (corners[last] == corners[first]).all(axis=1) & (first != np.flatnonzero(last))
    return _padded(corners[~again], group[~again])


def hull_distances(first: FloatArray, second: FloatArray) -> FloatArray:
    """The shortest ways between hulls, pair by pair, 0 where they touch or overlap: (P, V, 2), (P, W, 2) → (P,)."""
    result = np.zeros(len(first))
    step = max(1, _PAIRS_AT_ONCE // max(1, first.shape[1] * second.shape[1]))
    for start in range(0, len(first), step):
        part = slice(start, start + step)
        result[part] = _distances(first[part], second[part])
    return result


def _both_sides(points: IntArray, group: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """The leftmost and the rightmost points of each row of each group, the latter mirrored.

    Returns:
        Chains (2 · group for the left, 2 · group + 1 for the right side), rows and columns, by chain and row.
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
    """Which points of each chain, ascending in `along`, are corners of its convex lower side; its ends always are.

    A point on or above the line between any two others is no corner. So all points above the line between their
    neighbours are removed at once, again and again, until there are none.
    """
    kept = np.arange(len(chain))
    while True:
        part, a, b = chain[kept], along[kept], aside[kept]
        inner = np.zeros(len(kept), dtype=bool)
        inner[1:-1] = (part[2:] == part[:-2]) & (
            (b[1:-1] - b[:-2]) * (a[2:] - a[:-2]) >= (b[2:] - b[:-2]) * (a[1:-1] - a[:-2])
        )
        if not inner.any():
            return kept
        kept = kept[~inner]


def _padded(corners: IntArray, group: IntArray) -> FloatArray:
    count = np.bincount(group)
    first = np.cumsum(count) - count
    which = np.minimum(np.arange(count.max()), count[:, None] - 1)
    return np.asarray(corners[first[:, None] + which].astype(np.float64))


def _distances(first: FloatArray, second: FloatArray) -> FloatArray:
    there, way_there = _to_sides(first, second)
    back, way_back = _to_sides(second, first)
    way = np.where((there <= back)[:, None], way_there, -way_back)
    nearest = np.minimum(there, back)
    return np.where(_parts(way, first, second), np.sqrt(nearest), 0.0)


def _to_sides(points: FloatArray, hull: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The shortest way from a side of hulls (P, W, 2) to a corner (P, V, 2): its square, and a vector of any length."""
    side = np.roll(hull, -1, axis=1) - hull
    apart = points[:, :, None] - hull[:, None]
    length = (side * side).sum(axis=-1)[:, None]
    along = (apart * side[:, None]).sum(axis=-1)
    across = side[:, None, :, 0] * apart[..., 1] - side[:, None, :, 1] * apart[..., 0]
    beside = (along > 0) & (along < length)
    # beyond a side's ends the way to the end itself is the nearest; each end is some side's start
    squared = np.where(
        beside, across * across / np.where(beside, length, 1.0), (apart * apart).sum(axis=-1)
    )
    pair = np.arange(len(points))
    flat = squared.reshape(len(points), -1)
    best = np.argmin(flat, axis=1)
    corner, edge = np.divmod(best, hull.shape[1])
    to_end, chosen = apart[pair, corner, edge], side[pair, edge]
    normal = np.stack([-chosen[:, 1], chosen[:, 0]], axis=1) * across[pair, corner, edge, None]
    return flat[pair, best], np.where(beside[pair, corner, edge, None], normal, to_end)


def _parts(way: FloatArray, first: FloatArray, second: FloatArray) -> BoolArray:
    """Whether a line across `way`, from second to first, has each hull on a side of its own.

    Of hulls that are apart the shortest way between corners and sides is the shortest of all, and such a line crosses
    it; hulls that overlap cannot be separated.
    """
    near = np.einsum("pvk,pk->pv", first, way).min(axis=1)
    far = np.einsum("pvk,pk->pv", second, way).max(axis=1)
    return np.asarray(near > far)


# Lengths that differ by less, in metres, are equal: means of cells are inexact in the last bits.
TIE: Final = 1e-9
_TIE_DECIMALS: Final = 9


@dataclass(frozen=True, slots=True, kw_only=True)
class AccidentReading:
    """Which instances collide: those whose cells' centres have convex hulls (points and lines allowed) near each other.

    Of heads the instances are those of the paper's motion metrics; the present frame counts, and the frame of a pair's
    accident is where it is closest, the earliest if there are several.

    Attributes:
        danger_distance: metres; instances that come nearer to each other collide. The paper says 1 m.
    """

    danger_distance: float = 1.0

    def __post_init__(self) -> None:
        """Check the value; raises ConfigError."""
        if not 0 < self.danger_distance < np.inf:
            raise ConfigError(
                f"danger_distance: expected metres above 0, found {self.danger_distance!r}"
            )


def instances_of_heads(heads: MotionHeads) -> AnyArray:
    """(T, H, W) the instances of heads, in their orientation, read off as for the motion metrics."""
    return predict_instances(heads, "motion").instance


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class InstanceTracks(FrozenArrays):
    """Where instances are at T moments; arrays are read-only.

    Attributes:
        identity: (I,) int64, ascending.
        center: (T, I, 2) float64 mean of their cells, x forward, y left, metres; NaN where they are not.
    """

    identity: IntArray
    center: FloatArray

    def at(self, frame: int, identities: tuple[int, int]) -> FloatArray:
        """(2, 2) where two instances are at a moment; NaN where they are not."""
        return np.asarray(self.center[frame, self.identity.searchsorted(identities)])


@dataclass(frozen=True, slots=True, kw_only=True)
class Contact:
    """The two instances that collide.

    Attributes:
        frame: of the maps, from 0.
        ids: ascending.
        distance: metres between their outlines.
    """

    frame: int
    ids: tuple[int, int]
    distance: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class InstanceAccident:
    """What is read off one set of instance maps.

    Attributes:
        tracks: of all instances.
        contact: None if no pair comes near enough.
    """

    tracks: InstanceTracks
    contact: Contact | None

    @property
    def positions(self) -> FloatArray:
        """(2, 2) x forward, y left of the two that collide, at that moment; of those with a contact."""
        return (
            np.full((2, 2), np.nan)
            if self.contact is None
            else self.tracks.at(self.contact.frame, self.contact.ids)
        )

    def explicit(self, seconds: float) -> Accident | None:
        """It as an explicit accident without ids, `seconds` from frame to frame; None without a contact."""
        return (
            None
            if self.contact is None
            else Accident(positions=self.positions, time=self.contact.frame * seconds)
        )


def even(length: FloatArray) -> FloatArray:
    """Lengths in metres of which those that differ by less than `TIE` in their last bits are equal floats."""
    return np.round(length, _TIE_DECIMALS)


def accident_of(
    instance: AnyArray, grid: BevGrid, rules: LabelProtocol | None, reading: AccidentReading
) -> InstanceAccident:
    """Where instances are, and which pair of them collides when, if any does.

    Of several pairs and moments the one with the smallest distance is taken; of equal ones the earlier, then that with
    the nearer centres, then that with the lower ids.

    Args:
        instance: (T, H, W) ids from 1 that stay the same over the frames, 0 or less elsewhere.
        grid: its cells and orientation.
        rules: of the labels that the maps are, or were learned from: where they have the half-cell shift, it is undone
            in positions. None for maps without any.
        reading: how near is a collision.
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
    identity, which = np.unique(shapes.identity, return_inverse=True)
    center = np.full((frames, len(identity), 2), np.nan)
    place = shapes.center + (0.5 if rules is None else rules.place_in_cell)
    center[shapes.frame, which] = [grid.x[0], grid.y[0]] + place * np.array([grid.x[2], grid.y[2]])
    return InstanceTracks(identity=identity, center=center)


def predicted_tracks(output: MotionOutput, rules: LabelProtocol | None) -> list[InstanceTracks]:
    """Where the instances of each of the K predictions go; arguments as of `accident_of`."""
    maps = (
        map(instances_of_heads, output.heads or ())
        if output.instances is None
        else output.instances
    )
    return [
        _tracks(_shapes(each, output.grid.orientation), len(each), output.grid, rules)
        for each in maps
    ]


def predicted_accidents(
    output: MotionOutput,
    rules: LabelProtocol | None,
    reading: AccidentReading,
    frames: int | None = None,
) -> list[InstanceAccident]:
    """What `accident_of` reads off each of the K predictions, cut to so many frames; None for all."""
    heads = [each if frames is None else first_frames(each, frames) for each in output.heads or ()]
    maps = (
        map(instances_of_heads, heads) if output.instances is None else output.instances[:, :frames]
    )
    return [accident_of(each, output.grid, rules, reading) for each in maps]


def match_tracks(predicted: InstanceTracks, truth: InstanceTracks, gate: float) -> dict[int, int]:
    """Instances with the same path, one to one: predicted id → true id.

    The distance of two is the mean of that of their centres over the moments at which both are there. Of all ways to
    match, as many pairs as possible within `gate`, and of those with as many the least sum of distances. (So a distant
    pair cannot use up an instance that another one needs, as it does in the released code.)

    Args:
        predicted: over T moments.
        truth: over the same.
        gate: metres; pairs farther apart, and those that are never there together, are no match.
    """
    from scipy.optimize import linear_sum_assignment

    apart = np.linalg.norm(predicted.center[:, :, None] - truth.center[:, None], axis=-1)
    common = np.isfinite(apart)
    sums = np.where(common, apart, 0).sum(axis=0)
    distance = np.where(common.any(axis=0), even(sums / np.maximum(common.sum(axis=0), 1)), np.inf)
    allowed = distance <= gate + TIE
    # one more pair within the gate outweighs any sum of distances
    refused = (gate + 1) * (min(distance.shape) + 1)
    rows, columns = linear_sum_assignment(np.where(allowed, distance, refused))
    return {
        int(predicted.identity[row]): int(truth.identity[column])
        for row, column in zip(rows.tolist(), columns.tolist(), strict=True)
        if allowed[row, column]
    }


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Shapes:
    """N instances at frames, by frame and id; cells are counted along x forward and y left.

    Attributes:
        frame: (N,) int64.
        identity: (N,) int64.
        center: (N, 2) float64 mean of the cells.
        low: (N, 2) int64 lowest cells.
        high: (N, 2) int64 highest cells.
        cells: (P, 2) int64, and `group` (P,) whose each is.
    """

    frame: IntArray
    identity: IntArray
    center: FloatArray
    low: IntArray
    high: IntArray
    cells: IntArray
    group: IntArray

    def hulls(self, which: IntArray) -> FloatArray:
        """(len(which), V, 2) the outlines of some, in cells."""
        number = np.full(len(self.frame), -1)
        number[which] = np.arange(len(which))
        group = number[self.group]
        return convex_hulls(self.cells[group >= 0], group[group >= 0])


def _shapes(instance: AnyArray, orientation: Orientation) -> _Shapes:
    rows, columns = instance.shape[1:]
    flat = np.flatnonzero(instance > 0)  # of a mask: much faster than of integers
    frame, cell = np.divmod(flat, rows * columns)
    row, column = np.divmod(cell, columns)
    y, x = cells_in(row, column, (rows, columns), orientation, "devkit")
    identity = instance.reshape(-1)[flat].astype(np.int64)
    key, group = np.unique(frame * (identity.max(initial=0) + 1) + identity, return_inverse=True)
    count = np.bincount(group, minlength=len(key))
    order = np.argsort(group, kind="stable")
    begin = np.cumsum(count) - count
    cells = np.stack([x, y], axis=1)
    center = (
        np.stack([np.bincount(group, along, len(key)) for along in cells.T], axis=1)
        / count[:, None]
    )
    of_each = cells[order]
    return _Shapes(
        frame=frame[order][begin],
        identity=identity[order][begin],
        center=center,
        low=np.minimum.reduceat(of_each, begin) if len(key) else cells,
        high=np.maximum.reduceat(of_each, begin) if len(key) else cells,
        cells=cells,
        group=group,
    )


def _contact(shapes: _Shapes, size: FloatArray, danger_distance: float) -> Contact | None:
    first, second = _candidates(shapes, size, danger_distance)
    if not len(first):
        return None
    which, place = np.unique(np.concatenate([first, second]), return_inverse=True)
    unit = size.min()  # square cells stay whole numbers
    hulls = shapes.hulls(which) * (size / unit)
    distance = even(hull_distances(hulls[place[: len(first)]], hulls[place[len(first) :]]) * unit)
    near = np.flatnonzero(distance < danger_distance)
    if not len(near):
        return None
    first, second, distance = first[near], second[near], distance[near]
    between = even(np.linalg.norm((shapes.center[first] - shapes.center[second]) * size, axis=1))
    frame = shapes.frame[first]
    best = np.lexsort((shapes.identity[second], shapes.identity[first], between, frame, distance))[
        0
    ]
    return Contact(
        frame=int(frame[best]),
        ids=(int(shapes.identity[first[best]]), int(shapes.identity[second[best]])),
        distance=float(distance[best]),
    )


def _candidates(
    shapes: _Shapes, size: FloatArray, danger_distance: float
) -> tuple[IntArray, IntArray]:
    """Pairs of rows of one frame whose bounding boxes are nearer than the danger distance."""
    firsts, seconds = [np.zeros(0, dtype=np.int64)], [np.zeros(0, dtype=np.int64)]
    starts = np.append(np.flatnonzero(np.diff(shapes.frame, prepend=-1)), len(shapes.frame))
    for start, end in zip(starts[:-1].tolist(), starts[1:].tolist(), strict=True):
        low, high = shapes.low[start:end], shapes.high[start:end]
        gap = np.maximum(low[:, None] - high, low - high[:, None])
        near = np.hypot(*np.moveaxis(np.maximum(gap, 0) * size, -1, 0)) < danger_distance
        first, second = np.nonzero(np.triu(near, 1))
        firsts.append(first + start)
        seconds.append(second + start)
    return np.concatenate(firsts), np.concatenate(seconds)
