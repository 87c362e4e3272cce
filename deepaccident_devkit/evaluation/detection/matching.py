"""From the boxes of one sample to its counts: which are near enough, which are matched, and the errors of the matches.

A *candidate* is a detection within the problem of one class; `Reach` has those that are near enough to any true box,
in descending order of their scores (equal ones in the order given), each with the true boxes that it reaches, in the
order given, and the pair's rank: of two pairs that compete the lower wins. No two ranks are equal.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from math import isnan
from typing import Any, Final

import numpy as np

from deepaccident_devkit.evaluation.detection.boxes import BoxColumns, DetectionProtocol
from deepaccident_devkit.geometry.box_arrays import intersection_areas
from deepaccident_devkit.support.arrays import (
    AnyArray,
    BoolArray,
    FloatArray,
    IntArray,
    as_floats,
    readonly,
)
from deepaccident_devkit.taxonomy import CATEGORIES

# Candidate → (true box, rank) of the pairs that are near enough.
Reach = Mapping[int, Sequence[tuple[int, int]]]
_NOBODY: Final = -1


@dataclass(slots=True)
class Steps:
    """How matches change while the score threshold falls: which candidate changes which count.

    Attributes:
        tp: candidates with which one more true box has a detection, both of which count.
        spent: those with which one more detection that counts goes to a true box that does not.
        excused: those with which a true box that counts gets a detection that does not (+1) or gets rid of it
            (−1): it is neither found nor missed.
        holder: true box → the candidate that it has in the end.
    """

    tp: list[int] = field(default_factory=list)
    spent: list[int] = field(default_factory=list)
    excused: list[tuple[int, int]] = field(default_factory=list)
    holder: dict[int, int] = field(default_factory=dict)

    def note(self, arriving: int, changes: Sequence[int]) -> None:
        """Note what a candidate changed: found, spent, excused (and pairs of which neither counts)."""
        found, spent, excused, _ = changes
        if found:
            self.tp.append(arriving)
        if spent:
            self.spent.append(arriving)
        if excused:
            self.excused.append((arriving, excused))


def nearest_by_truth(
    reach: Reach, counts: Mapping[int, bool], truth_counts: Sequence[bool]
) -> Steps:
    """Each true box in turn takes the candidate of the lowest rank that is left, for every score at once.

    Each new candidate is offered to the true boxes in their order. The first that has none or ranks it lower
    takes it and passes its former one on to the boxes after it: that is the same as to match again with one candidate
    more, since the boxes before it would not have taken the one passed on.

    Args:
        reach: the pairs.
        counts: whether each candidate counts, or is there to be matched alone.
        truth_counts: whether each true box does.
    """
    steps, ranks = Steps(), dict[int, int]()
    for arriving in reach:
        # pairs of which both count, of which the truth does not, the candidate does not, neither does
        changes = [0, 0, 0, 0]
        offered: int | None = arriving
        behind = _NOBODY
        while offered is not None:
            behind, rank = _taker(reach[offered], behind, ranks)
            if behind == _NOBODY:
                break
            handed_on = steps.holder.get(behind)
            steps.holder[behind], ranks[behind] = offered, rank
            for candidate, change in ((offered, 1), (handed_on, -1)):
                if candidate is not None:
                    changes[2 * (not counts[candidate]) + (not truth_counts[behind])] += change
            offered = handed_on
        if any(changes):
            steps.note(arriving, changes)
    return steps


def _taker(
    pairs: Sequence[tuple[int, int]], behind: int, ranks: Mapping[int, int]
) -> tuple[int, int]:
    """The first true box after `behind` that takes a candidate with these pairs, and their rank."""
    for truth, rank in pairs:
        if truth > behind and ranks.get(truth, rank) >= rank:
            return truth, rank
    return _NOBODY, 0


def highest_score_by_truth(reach: Reach) -> dict[int, int]:
    """Each true box in turn takes the candidate with the highest score that is left: true box → candidate."""
    wanted: dict[int, list[int]] = {}
    for candidate, pairs in reach.items():
        for truth, _ in pairs:
            wanted.setdefault(truth, []).append(candidate)
    taken: set[int] = set()
    result: dict[int, int] = {}
    for truth in sorted(wanted):
        for candidate in wanted[truth]:
            if candidate not in taken:
                taken.add(candidate)
                result[truth] = candidate
                break
    return result


def nearest_by_score(reach: Reach) -> dict[int, int]:
    """Each candidate in turn takes the true box of the lowest rank that is left: true box → candidate."""
    result: dict[int, int] = {}
    for candidate, pairs in reach.items():
        free = [(rank, truth) for truth, rank in pairs if truth not in result]
        if free:
            result[min(free)[1]] = candidate
    return result


# Errors of translation (m), scale (1 − overlap), orientation (rad) and velocity (m/s), in the order of columns.
ERRORS: Final = ("ATE", "ASE", "AOE", "AVE")
# The released code's full turn, radians.
RELEASED_TURN: Final = 2 * 3.1415926


def costs(detections: BoxColumns, truth: BoxColumns, protocol: DetectionProtocol) -> AnyArray:
    """How far each of D detections is from each of G true boxes by the protocol's measure: (D, G), the less the nearer.

    Distances in metres, of the boxes' own precision; overlaps negated, so that they too are the less the nearer.
    """
    return _MEASURES[protocol.measure](detections, truth, protocol)


def limit_of(threshold: float, protocol: DetectionProtocol) -> float:
    """The cost below which (or, where the protocol includes it, up to which) a threshold's pairs match."""
    return threshold if protocol.measure.startswith("distance") else -threshold


def match_errors(
    detections: BoxColumns, truth: BoxColumns, protocol: DetectionProtocol
) -> FloatArray:
    """The errors of M matches, `detections[i]` with `truth[i]`: (M, 4) in the order of `ERRORS`; NaN where unknown."""
    offset = as_floats(detections.center) - truth.center
    if protocol.error_of_bottoms:
        offset[:, 2] = as_floats(detections.bottom) - truth.bottom
        translation = np.sqrt(offset[:, 0] ** 2 + offset[:, 1] ** 2 + offset[:, 2] ** 2)
    else:
        translation = np.sqrt(offset[:, 0] ** 2 + offset[:, 1] ** 2)
    turn = _turn_between(as_floats(detections.yaw), as_floats(truth.yaw), protocol)
    speed = as_floats(truth.velocity) - detections.velocity
    speed_error = np.sqrt(speed[:, 0] ** 2 + speed[:, 1] ** 2)
    return np.column_stack(
        [translation, 1 - _overlap_of_matches(detections, truth, protocol), turn, speed_error]
    )


def _overlap_of_matches(
    detections: BoxColumns, truth: BoxColumns, protocol: DetectionProtocol
) -> FloatArray:
    if protocol.scale_by_overlap:
        return as_floats(_iou_3d(detections, truth, protocol).diagonal())
    mine, theirs = as_floats(detections.size), as_floats(truth.size)
    return _over_union(_product(np.minimum(mine, theirs)), _product(mine), _product(theirs))


def _turn_between(
    detected: FloatArray, true: FloatArray, protocol: DetectionProtocol
) -> FloatArray:
    if not protocol.orientation_unwrapped:
        return as_floats(np.abs((true - detected + np.pi) % (2 * np.pi) - np.pi))
    true = true % RELEASED_TURN
    if (
        protocol.single_precision
    ):  # the released code writes this back into single precision, the detection's not
        true = as_floats(true.astype(np.float32))
    return np.abs(true - detected % RELEASED_TURN)


def _distance_of_bottoms(
    detections: BoxColumns, truth: BoxColumns, _: DetectionProtocol
) -> AnyArray:
    squares = _squares(truth.center[:, 0], detections.center[:, 0])
    squares += _squares(truth.center[:, 1], detections.center[:, 1])
    squares += _squares(truth.bottom, detections.bottom)
    return np.asarray(np.sqrt(squares))


def _distance_bev(detections: BoxColumns, truth: BoxColumns, _: DetectionProtocol) -> AnyArray:
    squares = _squares(truth.center[:, 0], detections.center[:, 0])
    squares += _squares(truth.center[:, 1], detections.center[:, 1])
    return np.asarray(np.sqrt(squares))


def _squares(truth: AnyArray, detections: AnyArray) -> AnyArray:
    difference: AnyArray = truth - detections[:, None]
    difference *= difference
    return difference


def _iou_3d(detections: BoxColumns, truth: BoxColumns, protocol: DetectionProtocol) -> FloatArray:
    areas = intersection_areas(detections.footprint, truth.footprint)
    down = protocol.bottom_taken_as_top
    (low, high), (true_low, true_high) = _heights(detections, down=down), _heights(truth, down=down)
    shared = np.minimum(high[:, None], true_high) - np.maximum(low[:, None], true_low)
    return _over_union(
        areas * np.maximum(shared, 0), _product(detections.size)[:, None], _product(truth.size)
    )


def _iou_bev(detections: BoxColumns, truth: BoxColumns, _: DetectionProtocol) -> FloatArray:
    areas = intersection_areas(detections.footprint, truth.footprint)
    return _over_union(
        areas, _product(detections.size[:, :2])[:, None], _product(truth.size[:, :2])
    )


def _heights(boxes: BoxColumns, *, down: bool) -> tuple[FloatArray, FloatArray]:
    bottom, height = as_floats(boxes.bottom), as_floats(boxes.size[:, 2])
    return (bottom - height, bottom) if down else (bottom, bottom + height)


def _product(sizes: AnyArray) -> FloatArray:
    return as_floats(as_floats(sizes).prod(axis=1))


def _over_union(common: FloatArray, mine: FloatArray, theirs: FloatArray) -> FloatArray:
    union = mine + theirs - common
    return np.divide(common, union, out=np.zeros_like(common), where=union > 0)


_MEASURES: Final[Mapping[str, Callable[[BoxColumns, BoxColumns, DetectionProtocol], AnyArray]]] = {
    "distance_of_bottoms": _distance_of_bottoms,
    "distance_bev": _distance_bev,
    "iou_3d": lambda detections, truth, protocol: -_iou_3d(detections, truth, protocol),
    "iou_bev": lambda detections, truth, protocol: -_iou_bev(detections, truth, protocol),
}


# Names of the columns of `frame_counts` that name detections by their rows → how many they are together.
COLUMNS: Final = {"detections": 2, "tp": 2, "spent": 2, "excused": 3, "matches": 2, "errors": 6}
_CORNERS: Final = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0]]) / 2


@dataclass(frozen=True, slots=True, kw_only=True)
class Ring:
    """One range of one sample: the boxes that count in it, and the pairs near enough at the widest threshold.

    Attributes:
        counts: (D,) whether each detection counts.
        truth_counts: (G,) whether each true box does.
        candidate: (P,) detection · classes + class of the true box, by falling score.
        truth: (P,) the true box.
        rank: (P,) which pair wins.
        near: (K, P) whether the pair is near enough at each threshold.
    """

    counts: BoolArray
    truth_counts: BoolArray
    candidate: IntArray
    truth: IntArray
    rank: IntArray
    near: BoolArray

    def reach(self, threshold: int) -> Reach:
        """The pairs at a threshold."""
        near = self.near[threshold]
        pairs = zip(
            self.candidate[near].tolist(),
            self.truth[near].tolist(),
            self.rank[near].tolist(),
            strict=True,
        )
        result: dict[int, list[tuple[int, int]]] = {}
        for candidate, truth, rank in pairs:
            result.setdefault(candidate, []).append((truth, rank))
        return result


def frame_counts(
    detections: BoxColumns, truth: BoxColumns, protocol: DetectionProtocol
) -> dict[str, Any]:
    """Match one sample's detections with its true boxes, both in the protocol's frame, and count.

    A *group* is a class within a range (class · ranges + range); a *cell* is a group at a threshold (group · thresholds
    + threshold). Detections are rows of `scores`.

    Returns:
        Lists by name, the same after writing and reading JSON:

        - `truths`: how many true boxes of each group count;
        - `scores`: of each detection;
        - `detections`: (groups, detections) that count;
        - `tp`: (cells, detections) that find one more true box when they are added by falling score;
        - `spent`: (cells, detections) with which one more detection goes to a true box that does not count;
        - `excused`: (cells, detections, changes): true boxes neither found nor missed; see `matching.Steps`;
        - `matches`: (cells, detections) whose scores decide the curve's points; empty when matched by score (as `tp`);
        - `errors`: (classes, detections, ATE, ASE, AOE, AVE) of the matches at the protocol's error threshold; None
          where unknown.
    """
    (detections, _), (truth, _) = boxes_taken(detections, truth, protocol)
    if protocol.unknown_velocity_is_zero:
        truth = _standing_if_unknown(truth)
    codes, true_codes = class_codes(detections, protocol), class_codes(truth, protocol)
    cost = costs(detections, truth, protocol)
    ring_count, level_count = len(protocol.ranges), len(protocol.thresholds)
    result: dict[str, Any] = {
        "truths": [0] * (len(protocol.classes) * ring_count),
        "scores": detections.score.tolist(),
        **{name: [[] for _ in range(width)] for name, width in COLUMNS.items()},
    }
    for position in range(ring_count):
        ring = ring_of(detections, truth, protocol, position, cost)
        group = codes * ring_count + position
        for one in (true_codes[ring.truth_counts] * ring_count + position).tolist():
            result["truths"][one] += 1
        _extend(
            result["detections"], group[ring.counts].tolist(), np.flatnonzero(ring.counts).tolist()
        )
        for level in range(level_count):
            _count_level(result, ring, (position, level), detections, truth, protocol)
    return result


def ring_of(
    detections: BoxColumns,
    truth: BoxColumns,
    protocol: DetectionProtocol,
    position: int,
    cost: AnyArray | None = None,
) -> Ring:
    """One of the protocol's ranges, counted from 0, of a sample's boxes; `cost` as `measures.costs` gives it."""
    codes, true_codes = class_codes(detections, protocol), class_codes(truth, protocol)
    cost = costs(detections, truth, protocol) if cost is None else cost
    beyond, true_beyond = (
        ~_in_range(detections, protocol, position),
        ~_in_range(truth, protocol, position),
    )
    same = codes[:, None] == true_codes
    by_truth = protocol.matching == "by_truth"
    allowed = same | beyond[:, None] if by_truth else same & ~beyond[:, None] & ~true_beyond
    limits = _limits(protocol)[true_codes]
    within = np.less_equal if protocol.threshold_included else np.less
    row, column = np.nonzero(allowed & within(cost, limits.max(axis=1, initial=-np.inf)))
    near_cost, code = cost[row, column], true_codes[column]
    # a true box takes what counts before what does not, then the nearest (of those that do not, the first)
    by_truth_keys = (row, np.where(beyond[row], 0.0, near_cost), beyond[row])
    preference: tuple[AnyArray, ...] = by_truth_keys if by_truth else (column, near_cost)
    rank = np.empty(len(row), dtype=np.int64)
    rank[np.lexsort(preference)] = np.arange(len(row))
    arrival = np.empty(len(detections), dtype=np.int64)
    arrival[np.argsort(-detections.score, kind="stable")] = np.arange(len(detections))
    order = np.lexsort((column, code, arrival[row]))
    return Ring(
        counts=~beyond & (codes >= 0),
        truth_counts=~true_beyond,
        candidate=(row * len(protocol.classes) + code)[order],
        truth=column[order],
        rank=rank[order],
        near=within(near_cost, limits[column].T)[:, order],
    )


def class_codes(boxes: BoxColumns, protocol: DetectionProtocol) -> IntArray:
    """(N,) position in `protocol.classes` of each box's class; −1 for none."""
    return np.asarray(_class_table(protocol)[boxes.category])


def _count_level(
    result: Mapping[str, Any],
    ring: Ring,
    place: tuple[int, int],
    detections: BoxColumns,
    truth: BoxColumns,
    protocol: DetectionProtocol,
) -> None:
    """Add the matches of one range at one threshold, which are at `place`."""
    position, level = place
    classes, rings, levels = len(protocol.classes), len(protocol.ranges), len(protocol.thresholds)
    reach = ring.reach(level)
    if not reach:
        return

    def cells(candidates: Iterable[int]) -> list[int]:
        return [((one % classes) * rings + position) * levels + level for one in candidates]

    def rows(candidates: Iterable[int]) -> list[int]:
        return [one // classes for one in candidates]

    counts, truth_counts = ring.counts.tolist(), ring.truth_counts.tolist()
    if protocol.matching == "by_truth":
        steps = nearest_by_truth(
            reach, {one: counts[one // classes] for one in reach}, truth_counts
        )
        _extend(result["tp"], cells(steps.tp), rows(steps.tp))
        _extend(result["spent"], cells(steps.spent), rows(steps.spent))
        changed = [candidate for candidate, _ in steps.excused]
        _extend(
            result["excused"],
            cells(changed),
            rows(changed),
            [change for _, change in steps.excused],
        )
        taken = highest_score_by_truth(reach)
        matched = {
            one: by for one, by in taken.items() if truth_counts[one] and counts[by // classes]
        }
        _extend(result["matches"], cells(matched.values()), rows(matched.values()))
    else:
        matched = nearest_by_score(reach)
        _extend(result["tp"], cells(matched.values()), rows(matched.values()))
    if protocol.thresholds[level] == protocol.error_threshold and matched:
        by = rows(matched.values())
        values = match_errors(
            detections.select(np.array(by)), truth.select(np.array(list(matched))), protocol
        )
        columns = [
            [None if isnan(value) else value for value in column] for column in values.T.tolist()
        ]
        _extend(result["errors"], [one % classes for one in matched.values()], by, *columns)


def _extend(columns: Sequence[list[Any]], *more: Iterable[Any]) -> None:
    for column, values in zip(columns, more, strict=True):
        column.extend(values)


def boxes_taken(
    detections: BoxColumns, truth: BoxColumns, protocol: DetectionProtocol
) -> tuple[tuple[BoxColumns, IntArray], tuple[BoxColumns, IntArray]]:
    """Those of one sample's detections and true boxes that exist for a protocol, in its precision, and their rows."""
    if protocol.single_precision:
        detections, truth = detections.rounded(), truth.rounded()
    rows = rows_taken(detections, inside_area(detections, protocol), protocol)
    true_rows = rows_taken(truth, truth_taken(truth, protocol), protocol)
    return (detections.select(rows), rows), (truth.select(true_rows), true_rows)


def rows_taken(boxes: BoxColumns, which: BoolArray, protocol: DetectionProtocol) -> IntArray:
    """The rows that a mask picks, in the order that decides between equal scores and equal distances.

    For matching `by_truth` that is the order given; for `by_score` it does not depend on the order given.
    """
    rows = np.flatnonzero(which)
    return rows if protocol.matching == "by_truth" else rows[boxes.select(rows).surest_first]


def truth_taken(truth: BoxColumns, protocol: DetectionProtocol) -> BoolArray:
    """(G,) which true boxes exist for the protocol: in its area, of its classes, and its own box only if it counts."""
    taken = inside_area(truth, protocol) & (class_codes(truth, protocol) >= 0)
    if not protocol.own_box:
        taken &= ~truth.own
    return taken


def inside_area(boxes: BoxColumns, protocol: DetectionProtocol) -> BoolArray:
    """(N,) which boxes are in the protocol's area."""
    if protocol.area is None:
        return np.ones(len(boxes), dtype=bool)
    points = boxes.center[:, None, :2]
    if protocol.area_of == "footprint":
        along = np.stack([np.cos(boxes.yaw), np.sin(boxes.yaw)], axis=1)[:, None]
        aside = along[..., ::-1] * (-1.0, 1.0)
        length, width = boxes.size[:, 0, None, None], boxes.size[:, 1, None, None]
        points = points + _CORNERS[:, :1] * length * along + _CORNERS[:, 1:] * width * aside
    x_low, x_high, y_low, y_high = protocol.area
    x, y = points[..., 0], points[..., 1]
    return np.asarray(np.all((x >= x_low) & (x <= x_high) & (y >= y_low) & (y <= y_high), axis=1))


def _in_range(boxes: BoxColumns, protocol: DetectionProtocol, position: int) -> BoolArray:
    x, y = as_floats(boxes.center[:, 0]), as_floats(boxes.center[:, 1])
    distance = np.sqrt(x * x + (x * x if protocol.range_from_x_alone else y * y))
    low, high = protocol.ranges[position]
    return np.asarray((distance >= low) & (distance < high))


def _standing_if_unknown(truth: BoxColumns) -> BoxColumns:
    unknown = np.isnan(truth.velocity)
    return (
        replace(truth, velocity=np.where(unknown, 0.0, truth.velocity)) if unknown.any() else truth
    )


@lru_cache(maxsize=8)
def _class_table(protocol: DetectionProtocol) -> IntArray:
    """Category → position of its class, −1 for none."""
    table = np.full(len(CATEGORIES), -1, dtype=np.int64)
    for position, (_, categories) in enumerate(protocol.classes):
        table[[CATEGORIES.index(name) for name in categories]] = position
    return readonly(table)


@lru_cache(maxsize=8)
def _limits(protocol: DetectionProtocol) -> FloatArray:
    """(classes, thresholds) costs that pairs of each class must be below."""
    return readonly(
        np.array(
            [
                [limit_of(one, protocol) for one in protocol.limits(name)]
                for name, _ in protocol.classes
            ]
        )
    )
