"""From the boxes of one sample to its counts: near pairs, matches, and the errors of the matches.

A *candidate* is a detection within the problem of one class. `Reach` has the candidates that are
near enough to any true box, in descending order of their scores (equal ones in the order of the
boxes), each with the true boxes that it reaches, in the order of the boxes, and the pair's rank: of
two pairs that compete the lower rank wins. No two ranks are equal.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
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
# Errors of translation (m), scale (1 − overlap), orientation (rad) and velocity (m/s), in the order
# of columns.
ERRORS: Final = ("ATE", "ASE", "AOE", "AVE")
# The released code's full turn, radians.
RELEASED_TURN: Final = 2 * 3.1415926
# Names of the columns of `frame_counts` that refer to detections by their rows → number of columns.
COLUMNS: Final = {"detections": 2, "tp": 2, "spent": 2, "excused": 3, "matches": 2, "errors": 6}
_NO_BOX: Final = -1
_CORNERS: Final = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0]]) / 2


@dataclass(slots=True)
class Steps:
    """Changes of the matches while the score threshold falls: which candidate changes which count.

    Attributes:
        tp: Candidates with which one more true box has a detection, where both count.
        spent: Candidates with which one more detection that counts goes to a true box that does not
            count.
        excused: Candidates with which a true box that counts gets a detection that does not count
            (+1) or loses it (−1): the true box is neither found nor missed.
        holder: True box → candidate that it has in the end.
    """

    tp: list[int] = field(default_factory=list)
    spent: list[int] = field(default_factory=list)
    excused: list[tuple[int, int]] = field(default_factory=list)
    holder: dict[int, int] = field(default_factory=dict)

    def note(self, arriving: int, changes: Sequence[int]) -> None:
        """Note what a candidate changed.

        Args:
            arriving: The candidate.
            changes: Changes of tp, spent, excused, and of the pairs in which neither box counts.
        """
        hit_change, spent_change, excused_change, _ = changes
        if hit_change:
            self.tp.append(arriving)
        if spent_change:
            self.spent.append(arriving)
        if excused_change:
            self.excused.append((arriving, excused_change))


def nearest_by_truth(
    reach: Reach, counts: Mapping[int, bool], truth_counts: Sequence[bool]
) -> Steps:
    """Match each true box in turn with the free candidate of the lowest rank, for every score.

    Each new candidate is offered to the true boxes in their order. The first that has none or ranks
    it lower takes it and passes its former one on to the boxes after it. The result equals matching
    again with one candidate more, since the earlier boxes would not take the one passed on.

    Args:
        reach: Near pairs.
        counts: Whether each candidate counts, or only takes part in matching.
        truth_counts: Whether each true box counts.
    """
    steps = Steps()
    ranks = dict[int, int]()
    for arriving in reach:
        # pairs in which both count, the truth does not, the candidate does not, neither does
        changes = [0, 0, 0, 0]
        offered: int | None = arriving
        taker = _NO_BOX
        while offered is not None:
            taker, rank = _taker(reach[offered], taker, ranks)
            if taker == _NO_BOX:
                break
            released = steps.holder.get(taker)
            steps.holder[taker], ranks[taker] = offered, rank
            for candidate, change in ((offered, 1), (released, -1)):
                if candidate is not None:
                    changes[2 * (not counts[candidate]) + (not truth_counts[taker])] += change
            offered = released
        if any(changes):
            steps.note(arriving, changes)
    return steps


def _taker(
    pairs: Sequence[tuple[int, int]], previous: int, ranks: Mapping[int, int]
) -> tuple[int, int]:
    """Return the first true box after `previous` that takes a candidate, and their rank.

    Args:
        pairs: True boxes and ranks of the candidate.
        previous: True box after which the search begins.
        ranks: Ranks of the pairs that the true boxes are in.
    """
    for truth, rank in pairs:
        if truth > previous and ranks.get(truth, rank) >= rank:
            return truth, rank
    return _NO_BOX, 0


def highest_score_by_truth(reach: Reach) -> dict[int, int]:
    """Match each true box in turn with the free candidate of the highest score.

    Returns:
        True box → candidate.
    """
    candidates_by_truth: dict[int, list[int]] = {}
    for candidate, pairs in reach.items():
        for truth, _ in pairs:
            candidates_by_truth.setdefault(truth, []).append(candidate)
    matched: set[int] = set()
    result: dict[int, int] = {}
    for truth in sorted(candidates_by_truth):
        for candidate in candidates_by_truth[truth]:
            if candidate not in matched:
                matched.add(candidate)
                result[truth] = candidate
                break
    return result


def nearest_by_score(reach: Reach) -> dict[int, int]:
    """Match each candidate in turn with the free true box of the lowest rank.

    Returns:
        True box → candidate.
    """
    result: dict[int, int] = {}
    for candidate, pairs in reach.items():
        free = [(rank, truth) for truth, rank in pairs if truth not in result]
        if free:
            result[min(free)[1]] = candidate
    return result


def costs(detections: BoxColumns, truth: BoxColumns, protocol: DetectionProtocol) -> AnyArray:
    """Return how far each of D detections is from each of G true boxes by the protocol's measure.

    Distances are in metres and in the boxes' own precision; overlaps are negated, so that smaller
    is nearer for them too.

    Returns:
        Costs, shape (D, G).
    """
    return _MEASURES[protocol.measure](detections, truth, protocol)


def limit_of(threshold: float, protocol: DetectionProtocol) -> float:
    """Return the cost below which a threshold's pairs match.

    Where the protocol includes the threshold, pairs match up to this cost.
    """
    return threshold if protocol.measure.startswith("distance") else -threshold


def match_errors(
    detections: BoxColumns, truth: BoxColumns, protocol: DetectionProtocol
) -> FloatArray:
    """Return the errors of M matches, `detections[i]` with `truth[i]`.

    Returns:
        Errors, shape (M, 4), in the order of `ERRORS`; NaN where unknown.
    """
    offset = as_floats(detections.center) - truth.center
    squares = offset[:, 0] ** 2 + offset[:, 1] ** 2
    if protocol.error_of_bottoms:
        height_difference = as_floats(detections.bottom) - truth.bottom
        squares = squares + height_difference**2
    translation = np.sqrt(squares)
    scale = 1 - _overlap_of_matches(detections, truth, protocol)
    turn = _turn_between(as_floats(detections.yaw), as_floats(truth.yaw), protocol)
    velocity = as_floats(truth.velocity) - detections.velocity
    speed_error = np.sqrt(velocity[:, 0] ** 2 + velocity[:, 1] ** 2)
    return np.column_stack([translation, scale, turn, speed_error])


def _overlap_of_matches(
    detections: BoxColumns, truth: BoxColumns, protocol: DetectionProtocol
) -> FloatArray:
    """Return the overlap of matched volumes (M,), as they stand or aligned."""
    if protocol.scale_by_overlap:
        return as_floats(_iou_3d(detections, truth, protocol).diagonal())
    size = as_floats(detections.size)
    true_size = as_floats(truth.size)
    common = _product(np.minimum(size, true_size))
    return _over_union(common, _product(size), _product(true_size))


def _turn_between(
    detected: FloatArray, true: FloatArray, protocol: DetectionProtocol
) -> FloatArray:
    """Return the heading errors of matches (M,), radians."""
    if not protocol.orientation_unwrapped:
        return as_floats(np.abs((true - detected + np.pi) % (2 * np.pi) - np.pi))
    true = true % RELEASED_TURN
    # the released code writes this back into single precision, but not the detection's
    if protocol.single_precision:
        true = as_floats(true.astype(np.float32))
    return np.abs(true - detected % RELEASED_TURN)


def _distance_of_bottoms(
    detections: BoxColumns, truth: BoxColumns, _: DetectionProtocol
) -> AnyArray:
    """Return the distances between the centres of the lower faces, shape (D, G), metres."""
    squares = _squares(truth.center[:, 0], detections.center[:, 0])
    squares += _squares(truth.center[:, 1], detections.center[:, 1])
    squares += _squares(truth.bottom, detections.bottom)
    return np.asarray(np.sqrt(squares))


def _distance_bev(detections: BoxColumns, truth: BoxColumns, _: DetectionProtocol) -> AnyArray:
    """Return the distances between the centres on the ground, shape (D, G), metres."""
    center = detections.center
    true_center = truth.center
    squares = _squares(true_center[:, 0], center[:, 0])
    squares += _squares(true_center[:, 1], center[:, 1])
    return np.asarray(np.sqrt(squares))


def _squares(truth: AnyArray, detections: AnyArray) -> AnyArray:
    """Return the squared differences of each detection and each true box, shape (D, G)."""
    difference: AnyArray = truth - detections[:, None]
    difference *= difference
    return difference


def _iou_3d(detections: BoxColumns, truth: BoxColumns, protocol: DetectionProtocol) -> FloatArray:
    """Return the intersection over union of the volumes, shape (D, G)."""
    areas = intersection_areas(detections.footprint, truth.footprint)
    low, high = _heights(detections, down=protocol.bottom_taken_as_top)
    true_low, true_high = _heights(truth, down=protocol.bottom_taken_as_top)
    shared = np.minimum(high[:, None], true_high) - np.maximum(low[:, None], true_low)
    common = areas * np.maximum(shared, 0)
    return _over_union(common, _product(detections.size)[:, None], _product(truth.size))


def _iou_bev(detections: BoxColumns, truth: BoxColumns, _: DetectionProtocol) -> FloatArray:
    """Return the intersection over union of the footprints, shape (D, G)."""
    common = intersection_areas(detections.footprint, truth.footprint)
    areas = _product(detections.size[:, :2])
    true_areas = _product(truth.size[:, :2])
    return _over_union(common, areas[:, None], true_areas)


def _heights(boxes: BoxColumns, *, down: bool) -> tuple[FloatArray, FloatArray]:
    """Return the lower and the upper ends of boxes (N,), metres; `down` if they reach downwards."""
    bottom = as_floats(boxes.bottom)
    height = as_floats(boxes.size[:, 2])
    return (bottom - height, bottom) if down else (bottom, bottom + height)


def _product(sizes: AnyArray) -> FloatArray:
    """Return the areas or volumes of sizes (N, 2 or 3), shape (N,)."""
    return as_floats(as_floats(sizes).prod(axis=1))


def _over_union(common: FloatArray, sizes: FloatArray, true_sizes: FloatArray) -> FloatArray:
    """Return intersection over union from common parts and sizes; 0 without any size."""
    union = sizes + true_sizes - common
    return np.divide(common, union, out=np.zeros_like(common), where=union > 0)


_MEASURES: Final[Mapping[str, Callable[[BoxColumns, BoxColumns, DetectionProtocol], AnyArray]]] = {
    "distance_of_bottoms": _distance_of_bottoms,
    "distance_bev": _distance_bev,
    "iou_3d": lambda detections, truth, protocol: -_iou_3d(detections, truth, protocol),
    "iou_bev": lambda detections, truth, protocol: -_iou_bev(detections, truth, protocol),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Ring:
    """One range of one sample: the boxes that count, and the near pairs at the widest threshold.

    Attributes:
        counts: (D,) whether each detection counts.
        truth_counts: (G,) whether each true box counts.
        candidate: (P,) detection · classes + class of the true box, by falling score.
        truth: (P,) row of the true box.
        rank: (P,) rank of the pair; the lower wins.
        near: (K, P) whether the pair is near enough at each threshold.
    """

    counts: BoolArray
    truth_counts: BoolArray
    candidate: IntArray
    truth: IntArray
    rank: IntArray
    near: BoolArray

    def reach(self, threshold: int) -> Reach:
        """Return the pairs at a threshold, counted from 0."""
        is_near = self.near[threshold]
        candidates = self.candidate[is_near].tolist()
        truths = self.truth[is_near].tolist()
        ranks = self.rank[is_near].tolist()
        result: dict[int, list[tuple[int, int]]] = {}
        for candidate, truth, rank in zip(candidates, truths, ranks, strict=True):
            result.setdefault(candidate, []).append((truth, rank))
        return result


def frame_counts(
    detections: BoxColumns, truth: BoxColumns, protocol: DetectionProtocol
) -> dict[str, Any]:
    """Match one sample's detections with its true boxes, both in the protocol's frame, and count.

    A *group* is a class within a range (class · ranges + range); a *cell* is a group at a threshold
    (group · thresholds + threshold). Detections are rows of `scores`.

    Returns:
        Lists by name, the same after writing and reading JSON:

        - `truths`: numbers of true boxes that count, by group;
        - `scores`: scores of the detections;
        - `detections`: (groups, detections) that count;
        - `tp`: (cells, detections) that find one more true box when they are added by falling
          score;
        - `spent`: (cells, detections) with which one more detection goes to a true box that does
          not count;
        - `excused`: (cells, detections, changes): true boxes neither found nor missed; see
          `matching.Steps`;
        - `matches`: (cells, detections) of the scores at the curve's points; empty when matched
          by score (as `tp`);
        - `errors`: (classes, detections, ATE, ASE, AOE, AVE) of the matches at the protocol's error
          threshold; None where unknown.
    """
    (detections, _), (truth, _) = boxes_taken(detections, truth, protocol)
    if protocol.unknown_velocity_is_zero:
        truth = _standing_if_unknown(truth)
    codes = class_codes(detections, protocol)
    true_codes = class_codes(truth, protocol)
    cost = costs(detections, truth, protocol)
    ring_count = len(protocol.ranges)
    result: dict[str, Any] = {
        "truths": [0] * (len(protocol.classes) * ring_count),
        "scores": detections.score.tolist(),
        **{name: [[] for _ in range(width)] for name, width in COLUMNS.items()},
    }
    for position in range(ring_count):
        ring = ring_of(detections, truth, protocol, position, cost)
        for group in (true_codes[ring.truth_counts] * ring_count + position).tolist():
            result["truths"][group] += 1
        groups = (codes * ring_count + position)[ring.counts]
        _extend(result["detections"], groups.tolist(), np.flatnonzero(ring.counts).tolist())
        for level in range(len(protocol.thresholds)):
            _count_level(result, ring, (position, level), detections, truth, protocol)
    return result


def ring_of(
    detections: BoxColumns,
    truth: BoxColumns,
    protocol: DetectionProtocol,
    position: int,
    cost: AnyArray | None = None,
) -> Ring:
    """Return one of the protocol's ranges for a sample's boxes.

    Args:
        detections: Detections of the sample.
        truth: True boxes of the sample.
        protocol: The rules.
        position: Number of the range, from 0.
        cost: What `costs` returns for these boxes; None to compute it.
    """
    codes = class_codes(detections, protocol)
    true_codes = class_codes(truth, protocol)
    if cost is None:
        cost = costs(detections, truth, protocol)
    beyond = ~_in_range(detections, protocol, position)
    true_beyond = ~_in_range(truth, protocol, position)
    is_same_class = codes[:, None] == true_codes
    by_truth = protocol.matching == "by_truth"
    if by_truth:
        allowed = is_same_class | beyond[:, None]
    else:
        allowed = is_same_class & ~beyond[:, None] & ~true_beyond
    limits = _limits(protocol)[true_codes]
    within = np.less_equal if protocol.threshold_included else np.less
    row, column = np.nonzero(allowed & within(cost, limits.max(axis=1, initial=-np.inf)))
    near_cost = cost[row, column]
    code = true_codes[column]
    preference: tuple[AnyArray, ...] = (column, near_cost)
    if by_truth:
        # a true box takes detections that count before others, then the nearest; of the others the
        # first
        preference = (row, np.where(beyond[row], 0.0, near_cost), beyond[row])
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
    """Return the position of each box's class in `protocol.classes`, shape (N,); −1 for none."""
    return np.asarray(_class_table(protocol)[boxes.category])


def _count_level(
    result: Mapping[str, Any],
    ring: Ring,
    ring_and_level: tuple[int, int],
    detections: BoxColumns,
    truth: BoxColumns,
    protocol: DetectionProtocol,
) -> None:
    """Add the matches of one range at one threshold to the counts.

    Args:
        result: Counts of the sample.
        ring: The range.
        ring_and_level: Numbers of the range and of the threshold.
        detections: Detections of the sample.
        truth: True boxes of the sample.
        protocol: The rules.
    """
    position, level = ring_and_level
    classes = len(protocol.classes)
    rings = len(protocol.ranges)
    levels = len(protocol.thresholds)
    reach = ring.reach(level)
    if not reach:
        return

    def cells(candidates: Iterable[int]) -> list[int]:
        return [
            ((candidate % classes) * rings + position) * levels + level for candidate in candidates
        ]

    def rows(candidates: Iterable[int]) -> list[int]:
        return [candidate // classes for candidate in candidates]

    def extend(name: str, candidates: Collection[int], *columns: Iterable[Any]) -> None:
        _extend(result[name], cells(candidates), rows(candidates), *columns)

    if protocol.matching == "by_truth":
        matches = _count_by_truth(extend, reach, ring, classes)
    else:
        matches = nearest_by_score(reach)
        extend("tp", matches.values())
    if protocol.thresholds[level] == protocol.error_threshold and matches:
        matched_rows = rows(matches.values())
        errors = match_errors(
            detections.select(np.array(matched_rows)),
            truth.select(np.array(list(matches))),
            protocol,
        )
        codes = [candidate % classes for candidate in matches.values()]
        _extend(result["errors"], codes, matched_rows, *_without_nan(errors))


def _count_by_truth(
    extend: Callable[..., None], reach: Reach, ring: Ring, classes: int
) -> dict[int, int]:
    """Add the matches by truth to the counts with `extend`.

    Returns:
        True box → candidate of the matches in which both count.
    """
    counts = ring.counts.tolist()
    truth_counts = ring.truth_counts.tolist()
    candidate_counts = {candidate: counts[candidate // classes] for candidate in reach}
    steps = nearest_by_truth(reach, candidate_counts, truth_counts)
    extend("tp", steps.tp)
    extend("spent", steps.spent)
    excused = [candidate for candidate, _ in steps.excused]
    extend("excused", excused, [change for _, change in steps.excused])
    matches = {}
    for true_box, candidate in highest_score_by_truth(reach).items():
        if truth_counts[true_box] and candidate_counts[candidate]:
            matches[true_box] = candidate
    extend("matches", matches.values())
    return matches


def _without_nan(values: FloatArray) -> list[list[float | None]]:
    """Return the columns of values as lists, None for NaN."""
    columns = []
    for column in values.T.tolist():
        columns.append([None if isnan(value) else value for value in column])
    return columns


def _extend(columns: Sequence[list[Any]], *values_by_column: Iterable[Any]) -> None:
    """Append values to each of some columns."""
    for column, values in zip(columns, values_by_column, strict=True):
        column.extend(values)


def boxes_taken(
    detections: BoxColumns, truth: BoxColumns, protocol: DetectionProtocol
) -> tuple[tuple[BoxColumns, IntArray], tuple[BoxColumns, IntArray]]:
    """Return the detections and true boxes that exist for a protocol, and their rows.

    They are in the precision of the protocol.
    """
    if protocol.single_precision:
        detections = detections.rounded()
        truth = truth.rounded()
    rows = rows_taken(detections, inside_area(detections, protocol), protocol)
    true_rows = rows_taken(truth, truth_taken(truth, protocol), protocol)
    return (detections.select(rows), rows), (truth.select(true_rows), true_rows)


def rows_taken(boxes: BoxColumns, mask: BoolArray, protocol: DetectionProtocol) -> IntArray:
    """Return the rows of a mask, in the order that decides between equal scores and distances.

    For matching `by_truth` that is the order of the boxes; for `by_score` it does not depend on
    their order.
    """
    rows = np.flatnonzero(mask)
    return rows if protocol.matching == "by_truth" else rows[boxes.select(rows).surest_first]


def truth_taken(truth: BoxColumns, protocol: DetectionProtocol) -> BoolArray:
    """Return which true boxes exist for the protocol, shape (G,).

    They are in its area and of its classes, and not the agent's own box unless that counts.
    """
    exists = inside_area(truth, protocol) & (class_codes(truth, protocol) >= 0)
    if not protocol.own_box:
        exists &= ~truth.own
    return exists


def inside_area(boxes: BoxColumns, protocol: DetectionProtocol) -> BoolArray:
    """Return which boxes are in the protocol's area, shape (N,)."""
    if protocol.area is None:
        return np.ones(len(boxes), dtype=bool)
    points = boxes.center[:, None, :2]
    if protocol.area_of == "footprint":
        along = np.stack([np.cos(boxes.yaw), np.sin(boxes.yaw)], axis=1)[:, None]
        aside = along[..., ::-1] * (-1.0, 1.0)
        length = boxes.size[:, 0, None, None]
        width = boxes.size[:, 1, None, None]
        points = points + _CORNERS[:, :1] * length * along + _CORNERS[:, 1:] * width * aside
    x_low, x_high, y_low, y_high = protocol.area
    x = points[..., 0]
    y = points[..., 1]
    is_inside = (x >= x_low) & (x <= x_high) & (y >= y_low) & (y <= y_high)
    return np.asarray(np.all(is_inside, axis=1))


def _in_range(boxes: BoxColumns, protocol: DetectionProtocol, position: int) -> BoolArray:
    """Return which boxes are in one of the protocol's ranges, shape (N,)."""
    x = as_floats(boxes.center[:, 0])
    y = as_floats(boxes.center[:, 1])
    if protocol.range_from_x_alone:
        y = x
    distance = np.sqrt(x * x + y * y)
    low, high = protocol.ranges[position]
    return np.asarray((distance >= low) & (distance < high))


def _standing_if_unknown(truth: BoxColumns) -> BoxColumns:
    """Return the boxes with velocity 0 where it is not known."""
    unknown = np.isnan(truth.velocity)
    if not unknown.any():
        return truth
    return replace(truth, velocity=np.where(unknown, 0.0, truth.velocity))


@lru_cache(maxsize=8)
def _class_table(protocol: DetectionProtocol) -> IntArray:
    """Return a table from category to the position of its class, −1 for none."""
    table = np.full(len(CATEGORIES), -1, dtype=np.int64)
    for position, (_, categories) in enumerate(protocol.classes):
        table[[CATEGORIES.index(name) for name in categories]] = position
    return readonly(table)


@lru_cache(maxsize=8)
def _limits(protocol: DetectionProtocol) -> FloatArray:
    """Return the costs that pairs of each class must be below, shape (classes, thresholds)."""
    limits = []
    for name, _ in protocol.classes:
        limits.append([limit_of(threshold, protocol) for threshold in protocol.limits(name)])
    return readonly(np.array(limits))
