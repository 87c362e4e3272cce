"""What one sample adds to the metrics: small columns of whole numbers, its scores, and the errors of its matches.

`DetectionMatches` says which detection is which true box, to look at; the metrics do not use it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from math import isnan
from typing import Any, Final

import numpy as np

from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.evaluation.detection.boxes import BoxColumns, DetectedBoxes, columns_of
from deepaccident_devkit.evaluation.detection.matching import (
    Reach,
    costs,
    highest_score_by_truth,
    limit_of,
    match_errors,
    nearest_by_score,
    nearest_by_truth,
)
from deepaccident_devkit.evaluation.detection.protocols import DetectionProtocol, detection_protocol
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.support.arrays import (
    AnyArray,
    BoolArray,
    FloatArray,
    FrozenArrays,
    IntArray,
    as_floats,
    readonly,
)
from deepaccident_devkit.taxonomy import CATEGORIES

COLUMNS: Final = {"detections": 2, "tp": 2, "spent": 2, "excused": 3, "matches": 2, "errors": 6}
"""Names of the columns of `frame_counts` that name detections by their rows → how many they are together."""
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
        pairs = zip(self.candidate[near].tolist(), self.truth[near].tolist(), self.rank[near].tolist(), strict=True)
        result: dict[int, list[tuple[int, int]]] = {}
        for candidate, truth, rank in pairs:
            result.setdefault(candidate, []).append((truth, rank))
        return result


def frame_counts(detections: BoxColumns, truth: BoxColumns, protocol: DetectionProtocol) -> dict[str, Any]:
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
    if protocol.single_precision:
        detections, truth = detections.rounded(), truth.rounded()
    truth = truth.select(rows_taken(truth, truth_taken(truth, protocol), protocol))
    detections = detections.select(rows_taken(detections, inside_area(detections, protocol), protocol))
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
        _extend(result["detections"], group[ring.counts].tolist(), np.flatnonzero(ring.counts).tolist())
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
    beyond, true_beyond = ~_in_range(detections, protocol, position), ~_in_range(truth, protocol, position)
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
        steps = nearest_by_truth(reach, {one: counts[one // classes] for one in reach}, truth_counts)
        _extend(result["tp"], cells(steps.tp), rows(steps.tp))
        _extend(result["spent"], cells(steps.spent), rows(steps.spent))
        changed = [candidate for candidate, _ in steps.excused]
        _extend(result["excused"], cells(changed), rows(changed), [change for _, change in steps.excused])
        taken = highest_score_by_truth(reach)
        matched = {one: by for one, by in taken.items() if truth_counts[one] and counts[by // classes]}
        _extend(result["matches"], cells(matched.values()), rows(matched.values()))
    else:
        matched = nearest_by_score(reach)
        _extend(result["tp"], cells(matched.values()), rows(matched.values()))
    if protocol.thresholds[level] == protocol.error_threshold and matched:
        by = rows(matched.values())
        values = match_errors(detections.select(np.array(by)), truth.select(np.array(list(matched))), protocol)
        columns = [[None if isnan(value) else value for value in column] for column in values.T.tolist()]
        _extend(result["errors"], [one % classes for one in matched.values()], by, *columns)


def _extend(columns: Sequence[list[Any]], *more: Iterable[Any]) -> None:
    for column, values in zip(columns, more, strict=True):
        column.extend(values)


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
    return replace(truth, velocity=np.where(unknown, 0.0, truth.velocity)) if unknown.any() else truth


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
    limits = [[limit_of(one, protocol) for one in protocol.limits(name)] for name, _ in protocol.classes]
    return readonly(np.array(limits))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DetectionMatches(FrozenArrays):
    """The matches of one sample at one threshold, with all detections at once; rows of the boxes given.

    Boxes that do not count (beyond the protocol's area and ranges, of other classes, or matched with such) are in none.

    Attributes:
        threshold: metres or a share, of the protocol's.
        detection: (M,) int64 detections that are true positives.
        truth: (M,) int64 the true box of each.
        false: (F,) int64 detections without a true box.
        missed: (G,) int64 true boxes without a detection.
    """

    threshold: float
    detection: IntArray
    truth: IntArray
    false: IntArray
    missed: IntArray


def detection_matches(
    prediction: DetectedBoxes,
    truth: Boxes,
    protocol: str | DetectionProtocol = "released",
    threshold: float | None = None,
) -> DetectionMatches:
    """Match one sample's detections with its true boxes as `DetectionEvaluator` does.

    Args:
        prediction: what was detected, in the protocol's frame.
        truth: the true boxes in that frame, as `detection_truth` gives them.
        protocol: name, or a protocol.
        threshold: one of the protocol's; None for that of its errors, or else the middle one.

    Raises:
        ChoiceError: no such protocol, or not one of its thresholds.
    """
    rules = detection_protocol(protocol)
    middle = rules.thresholds[len(rules.thresholds) // 2]
    chosen = threshold or rules.error_threshold or middle
    if chosen not in rules.thresholds:
        raise ChoiceError(f"threshold: expected one of {', '.join(map(str, rules.thresholds))}, found {threshold!r}")
    detected, true = columns_of(prediction.boxes, prediction.scores), columns_of(truth)
    if rules.single_precision:
        detected, true = detected.rounded(), true.rounded()
    rows = rows_taken(detected, inside_area(detected, rules), rules)
    true_rows = rows_taken(true, truth_taken(true, rules), rules)
    detected, true = detected.select(rows), true.select(true_rows)
    pairs: list[tuple[int, int]] = []
    unmatched: set[int] = set()
    missed: set[int] = set()
    for position in range(len(rules.ranges)):
        ring = ring_of(detected, true, rules, position)
        holder = _holders(ring, rules, rules.thresholds.index(chosen))
        counts, true_counts = ring.counts, ring.truth_counts
        pairs += [(rows[by], true_rows[one]) for one, by in holder.items() if counts[by] and true_counts[one]]
        unmatched |= {*np.flatnonzero(counts).tolist()} - {*holder.values()}
        missed |= {*np.flatnonzero(true_counts).tolist()} - {*holder}
    matched = np.array(sorted(pairs), dtype=np.int64).reshape(-1, 2)
    return DetectionMatches(
        threshold=chosen,
        detection=matched[:, 0],
        truth=matched[:, 1],
        false=np.sort(rows[list(unmatched)]),
        missed=np.sort(true_rows[list(missed)]),
    )


def _holders(ring: Ring, rules: DetectionProtocol, level: int) -> Mapping[int, int]:
    """True box → detection of all that match, those that do not count among them."""
    reach, classes = ring.reach(level), len(rules.classes)
    if rules.matching == "by_score":
        taken = nearest_by_score(reach)
    else:
        counts = {candidate: bool(ring.counts[candidate // classes]) for candidate in reach}
        taken = nearest_by_truth(reach, counts, ring.truth_counts.tolist()).holder
    return {truth: candidate // classes for truth, candidate in taken.items()}
