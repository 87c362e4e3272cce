"""The counts of one sample's boxes: near pairs, matches, and the errors of the matches.

A *candidate* is a detection that can be matched with true boxes of one class. `Reach` contains the
candidates that are near enough to any true box, in descending order of score (ties: in the order of
the boxes). Each candidate has the true boxes that it reaches, in the order of the boxes, with the
rank of each pair. If two pairs compete, the one with the lower rank wins. All ranks differ.
"""

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
from deepaccident_devkit.support.values import NamedValues, ReadOnlyValues
from deepaccident_devkit.taxonomy import CATEGORIES

# Candidate → (true box, rank) of each pair that is near enough.
Reach = Mapping[int, Sequence[tuple[int, int]]]
# Errors of translation (m), scale (1 − overlap), orientation (rad) and velocity (m/s), in the order
# of the columns.
ERRORS: Final = ("ATE", "ASE", "AOE", "AVE")
# The released code's full turn, radians.
RELEASED_TURN: Final = 2 * 3.1415926
# Names of the lists in `frame_counts` that refer to detections by index → number of columns.
COLUMNS: Final = {"detections": 2, "tp": 2, "spent": 2, "excused": 3, "matches": 2, "errors": 6}
# Replaces the index of a true box if there is none.
_NO_BOX = -1
# Corners of a footprint relative to its centre, as fractions of its length and width.
_CORNERS = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0]]) / 2


@dataclass(slots=True)
class Steps:
    """Changes of the matches while candidates are added in descending order of score.

    Attributes:
        tp: Candidates that add a match in which both boxes count.
        spent: Candidates that add a match in which the detection counts, but not the true box.
        excused: Candidates that add (+1) or remove (−1) a match in which the true box counts, but
            not the detection; such a true box is neither found nor missed.
        holder: True box → candidate that it is finally matched with.
    """

    tp: list[int] = field(default_factory=list)
    spent: list[int] = field(default_factory=list)
    excused: list[tuple[int, int]] = field(default_factory=list)
    holder: dict[int, int] = field(default_factory=dict)

    def note(self, arriving: int, changes: Sequence[int]) -> None:
        """Record what a candidate changed.

        Args:
            arriving: Candidate that was added.
            changes: Changes in the numbers of pairs in which both boxes count, only the detection
                counts, only the true box counts, and neither box counts.
        """
        tp_change, spent_change, excused_change, _ = changes
        if tp_change:
            self.tp.append(arriving)
        if spent_change:
            self.spent.append(arriving)
        if excused_change:
            self.excused.append((arriving, excused_change))


def nearest_by_truth(
    reach: Reach, counts: Mapping[int, bool], truth_counts: Sequence[bool]
) -> Steps:
    """Match each true box in turn with the free candidate of the lowest rank, at every score.

    Each new candidate is offered to the true boxes in order. The first box that has no candidate,
    or one with a higher rank, takes the new one and passes its former candidate on to the boxes
    after it. The result is the same as if all boxes were matched again with the additional
    candidate, since earlier boxes would not take the one that is passed on.

    Args:
        reach: Pairs that are near enough.
        counts: Candidate → whether it counts; otherwise it only takes part in matching.
        truth_counts: (G,) whether each true box counts.
    """
    steps = Steps()
    ranks: dict[int, int] = {}
    for arriving in reach:
        # see `Steps.note`
        changes = [0, 0, 0, 0]
        offered: int | None = arriving
        true_box = _NO_BOX
        while offered is not None:
            true_box, rank = _next_true_box(reach[offered], true_box, ranks)
            if true_box == _NO_BOX:
                break
            former = steps.holder.get(true_box)
            steps.holder[true_box] = offered
            ranks[true_box] = rank
            for candidate, change in ((offered, 1), (former, -1)):
                if candidate is not None:
                    kind = 2 * (not counts[candidate]) + (not truth_counts[true_box])
                    changes[kind] += change
            offered = former
        if any(changes):
            steps.note(arriving, changes)
    return steps


def _next_true_box(
    pairs: Sequence[tuple[int, int]], previous: int, ranks: Mapping[int, int]
) -> tuple[int, int]:
    """Return the next true box that prefers a candidate to its present match, and the pair's rank.

    Args:
        pairs: Each true box that is near enough to the candidate, and the rank of this pair.
        previous: Index of a true box; only true boxes with a higher index are searched.
        ranks: True box → rank of the pair in which it is matched at present.
    """
    for true_box, rank in pairs:
        if true_box > previous and ranks.get(true_box, rank) >= rank:
            return true_box, rank
    return _NO_BOX, 0


def highest_score_by_truth(reach: Reach) -> dict[int, int]:
    """Match each true box in turn with the free candidate that has the highest score.

    Returns:
        True box → candidate.
    """
    candidates_by_truth: dict[int, list[int]] = {}
    for candidate, pairs in reach.items():
        for true_box, _ in pairs:
            candidates_by_truth.setdefault(true_box, []).append(candidate)
    matched_candidates: set[int] = set()
    matches = {}
    for true_box, candidates in sorted(candidates_by_truth.items()):
        for candidate in candidates:
            if candidate not in matched_candidates:
                matched_candidates.add(candidate)
                matches[true_box] = candidate
                break
    return matches


def nearest_by_score(reach: Reach) -> dict[int, int]:
    """Match each candidate in turn with the free true box that has the lowest rank.

    Returns:
        True box → candidate.
    """
    matches: dict[int, int] = {}
    for candidate, pairs in reach.items():
        free_pairs = [(rank, true_box) for true_box, rank in pairs if true_box not in matches]
        if free_pairs:
            _, nearest_box = min(free_pairs)
            matches[nearest_box] = candidate
    return matches


def costs(detections: BoxColumns, truth: BoxColumns, protocol: DetectionProtocol) -> AnyArray:
    """Compute how far each of D detections is from each of G true boxes, by the protocol's measure.

    Distances are in metres, in the boxes' own precision. Overlaps are negated, so that smaller
    always means nearer.

    Returns:
        Costs, shape (D, G).
    """
    if protocol.measure == "distance_of_bottoms":
        return _distance_of_bottoms(detections, truth)
    if protocol.measure == "distance_bev":
        return _distance_bev(detections, truth)
    if protocol.measure == "iou_3d":
        return -_iou_3d(detections, truth, protocol)
    return -_iou_bev(detections, truth)


def limit_of(threshold: float, protocol: DetectionProtocol) -> float:
    """Return the cost below which pairs match at a threshold.

    If the protocol includes the threshold, pairs with exactly this cost match, too.
    """
    if protocol.measure.startswith("distance"):
        return threshold
    return -threshold


def match_errors(
    detections: BoxColumns, truth: BoxColumns, protocol: DetectionProtocol
) -> FloatArray:
    """Compute the errors of M matches, in which `detections[i]` is matched with `truth[i]`.

    Returns:
        Errors, shape (M, 4), in the order of `ERRORS`; NaN if unknown.
    """
    offset = as_floats(detections.center) - truth.center
    squares = offset[:, 0] ** 2 + offset[:, 1] ** 2
    if protocol.error_of_bottoms:
        height_difference = as_floats(detections.bottom) - truth.bottom
        squares = squares + height_difference**2
    translation = np.sqrt(squares)
    scale = 1 - _overlap_of_matches(detections, truth, protocol)
    orientation = _heading_errors(as_floats(detections.yaw), as_floats(truth.yaw), protocol)
    velocity_difference = as_floats(truth.velocity) - detections.velocity
    velocity = np.sqrt(velocity_difference[:, 0] ** 2 + velocity_difference[:, 1] ** 2)
    return np.column_stack([translation, scale, orientation, velocity])


def _overlap_of_matches(
    detections: BoxColumns, truth: BoxColumns, protocol: DetectionProtocol
) -> FloatArray:
    """Compute the overlap of volumes of each match (M,), aligned unless `scale_by_overlap`."""
    if protocol.scale_by_overlap:
        return as_floats(_iou_3d(detections, truth, protocol).diagonal())
    size = as_floats(detections.size)
    true_size = as_floats(truth.size)
    common_volumes = _products(np.minimum(size, true_size))
    return _over_union(common_volumes, _products(size), _products(true_size))


def _heading_errors(
    yaw: FloatArray, true_yaw: FloatArray, protocol: DetectionProtocol
) -> FloatArray:
    """Compute the heading error of each match (M,), radians."""
    if not protocol.orientation_unwrapped:
        turn = true_yaw - yaw
        return as_floats(np.abs((turn + np.pi) % (2 * np.pi) - np.pi))
    true_yaw = true_yaw % RELEASED_TURN
    # the released code rounds this to single precision again, but not the detection's yaw
    if protocol.single_precision:
        true_yaw = as_floats(true_yaw.astype(np.float32))
    return np.abs(true_yaw - yaw % RELEASED_TURN)


def _distance_of_bottoms(detections: BoxColumns, truth: BoxColumns) -> AnyArray:
    """Return the distances between the centres of the lower faces, shape (D, G), metres."""
    squares = _ground_squares(detections, truth)
    squares += _squares(truth.bottom, detections.bottom)
    return np.sqrt(squares)


def _distance_bev(detections: BoxColumns, truth: BoxColumns) -> AnyArray:
    """Return the distances between the centres on the ground, shape (D, G), metres."""
    return np.sqrt(_ground_squares(detections, truth))


def _ground_squares(detections: BoxColumns, truth: BoxColumns) -> AnyArray:
    """Return the squared distances between the centres on the ground, shape (D, G), m²."""
    x, y, _ = detections.center.T
    true_x, true_y, _ = truth.center.T
    squares = _squares(true_x, x)
    squares += _squares(true_y, y)
    return squares


def _squares(truth: AnyArray, detections: AnyArray) -> AnyArray:
    """Return the squared differences between values (G,) and values (D,), shape (D, G)."""
    difference: AnyArray = truth - detections[:, None]
    difference *= difference
    return difference


def _iou_3d(detections: BoxColumns, truth: BoxColumns, protocol: DetectionProtocol) -> FloatArray:
    """Return the intersection over union of the volumes, shape (D, G)."""
    areas = intersection_areas(detections.footprint, truth.footprint)
    bottom, top = _heights(detections, protocol)
    true_bottom, true_top = _heights(truth, protocol)
    common_top = np.minimum(top[:, None], true_top)
    common_bottom = np.maximum(bottom[:, None], true_bottom)
    common_volumes = areas * np.maximum(common_top - common_bottom, 0)
    volumes = _products(detections.size)
    return _over_union(common_volumes, volumes[:, None], _products(truth.size))


def _iou_bev(detections: BoxColumns, truth: BoxColumns) -> FloatArray:
    """Return the intersection over union of the footprints, shape (D, G)."""
    common_areas = intersection_areas(detections.footprint, truth.footprint)
    areas = _products(detections.size[:, :2])
    true_areas = _products(truth.size[:, :2])
    return _over_union(common_areas, areas[:, None], true_areas)


def _heights(boxes: BoxColumns, protocol: DetectionProtocol) -> tuple[FloatArray, FloatArray]:
    """Return the lower and the upper z of boxes, (N,) each, metres."""
    bottom = as_floats(boxes.bottom)
    height = as_floats(boxes.size[:, 2])
    if protocol.bottom_taken_as_top:
        return bottom - height, bottom
    return bottom, bottom + height


def _products(sizes: AnyArray) -> FloatArray:
    """Multiply sizes (N, 2 or 3) to areas or volumes, shape (N,)."""
    return as_floats(as_floats(sizes).prod(axis=1))


def _over_union(common: FloatArray, sizes: FloatArray, true_sizes: FloatArray) -> FloatArray:
    """Compute intersection over union from intersections and areas (or volumes); 0 for 0 / 0."""
    union = sizes + true_sizes - common
    return np.divide(common, union, out=np.zeros_like(common), where=union > 0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Ring:
    """Which boxes of a sample count in one range, and the near pairs at the widest threshold.

    Attributes:
        counts: (D,) bool, True for detections that count.
        truth_counts: (G,) bool, True for true boxes that count.
        candidate: (P,) index of the detection · number of classes + class of the true box, in
            descending order of score.
        truth: (P,) index of the true box.
        rank: (P,) rank of the pair; the lower rank wins.
        near: (K, P) bool, True if the pair is near enough at the threshold.
    """

    counts: BoolArray
    truth_counts: BoolArray
    candidate: IntArray
    truth: IntArray
    rank: IntArray
    near: BoolArray

    def reach(self, threshold: int) -> Reach:
        """Return the pairs that are near enough at the threshold with an index."""
        is_near = self.near[threshold]
        candidates = self.candidate[is_near].tolist()
        true_boxes = self.truth[is_near].tolist()
        ranks = self.rank[is_near].tolist()
        reach: dict[int, list[tuple[int, int]]] = {}
        for candidate, true_box, rank in zip(candidates, true_boxes, ranks, strict=True):
            reach.setdefault(candidate, []).append((true_box, rank))
        return reach


def frame_counts(
    detections: BoxColumns, truth: BoxColumns, protocol: DetectionProtocol
) -> NamedValues:
    """Match one sample's detections with its true boxes, both in the protocol's frame, and count.

    A *group* is a class in a range (index: class · ranges + range). A *cell* is a group at a
    threshold (index: group · thresholds + threshold). Detections are indices into `scores`.

    Returns:
        Lists by name, which do not change when written to JSON and read again. Each entry in
        brackets is a column:

        - `truths`: how many true boxes count, for each group;
        - `scores`: scores of the detections;
        - `detections`: (groups, detections), the detections that count;
        - `tp`: (cells, detections), the detections that add a found true box when they are added in
          descending order of score;
        - `spent`: (cells, detections), the detections that add a match with a true box that does
          not count;
        - `excused`: (cells, detections, changes), the changes of the number of true boxes that are
          neither found nor missed; see `matching.Steps`;
        - `matches`: (cells, detections), the detections whose scores are the curve's points; empty
          for matching by score, which uses `tp` instead;
        - `errors`: (classes, detections, ATE, ASE, AOE, AVE), the errors of the matches at the
          protocol's error threshold; None if unknown.
    """
    detections, _ = existing_detections(detections, protocol)
    truth, _ = existing_truth(truth, protocol)
    if protocol.unknown_velocity_is_zero:
        truth = _standing_if_unknown(truth)
    codes = class_codes(detections, protocol)
    true_codes = class_codes(truth, protocol)
    cost = costs(detections, truth, protocol)
    range_count = len(protocol.ranges)
    result: NamedValues = {
        "truths": [0] * (len(protocol.classes) * range_count),
        "scores": detections.score.tolist(),
    }
    for name, width in COLUMNS.items():
        result[name] = [[] for _ in range(width)]
    for position in range(range_count):
        ring = ring_of(detections, truth, protocol, position, cost)
        true_groups = true_codes[ring.truth_counts] * range_count + position
        for group in true_groups.tolist():
            result["truths"][group] += 1
        rows = np.flatnonzero(ring.counts)
        groups = codes[rows] * range_count + position
        _extend(result["detections"], groups.tolist(), rows.tolist())
        for level in range(len(protocol.thresholds)):
            _add_matches(result, ring, (position, level), detections, truth, protocol)
    return result


def ring_of(
    detections: BoxColumns,
    truth: BoxColumns,
    protocol: DetectionProtocol,
    position: int,
    cost: AnyArray | None = None,
) -> Ring:
    """Find the boxes that count in one of the protocol's ranges, and the pairs that are near.

    Args:
        detections: D detections of the sample.
        truth: G true boxes of the sample.
        protocol: Rules of the evaluation.
        position: Index of the range in `protocol.ranges`.
        cost: (D, G) result of `costs` for these boxes; None to compute it.
    """
    codes = class_codes(detections, protocol)
    true_codes = class_codes(truth, protocol)
    if cost is None:
        cost = costs(detections, truth, protocol)
    is_beyond = ~_in_range(detections, protocol, position)
    is_true_beyond = ~_in_range(truth, protocol, position)
    is_same_class = codes[:, None] == true_codes
    is_by_truth = protocol.matching == "by_truth"
    if is_by_truth:
        is_allowed = is_same_class | is_beyond[:, None]
    else:
        is_allowed = is_same_class & ~is_beyond[:, None] & ~is_true_beyond
    limits = _cost_limits(protocol)[true_codes]
    is_within = np.less_equal if protocol.threshold_included else np.less
    widest_limits = limits.max(axis=1, initial=-np.inf)
    row, column = np.nonzero(is_allowed & is_within(cost, widest_limits))
    near_cost = cost[row, column]
    code = true_codes[column]
    preference: tuple[AnyArray, ...] = (column, near_cost)
    if is_by_truth:
        # a true box prefers detections that count, and among these the nearest; among the others,
        # it prefers the first
        near_cost_of_counted = np.where(is_beyond[row], 0.0, near_cost)
        preference = (row, near_cost_of_counted, is_beyond[row])
    rank = _positions(np.lexsort(preference))
    arrival = _positions(np.argsort(-detections.score, kind="stable"))
    order = np.lexsort((column, code, arrival[row]))
    candidate = row * len(protocol.classes) + code
    is_near = is_within(near_cost, limits[column].T)
    return Ring(
        counts=~is_beyond & (codes >= 0),
        truth_counts=~is_true_beyond,
        candidate=candidate[order],
        truth=column[order],
        rank=rank[order],
        near=is_near[:, order],
    )


def _positions(order: IntArray) -> IntArray:
    """Invert a permutation (N,): return the position of each index in the order."""
    positions = np.empty(len(order), dtype=np.int64)
    positions[order] = np.arange(len(order))
    return positions


def class_codes(boxes: BoxColumns, protocol: DetectionProtocol) -> IntArray:
    """Return the index of each box's class in `protocol.classes`, (N,); −1 if it has no class."""
    class_table = _class_table(protocol)
    return np.asarray(class_table[boxes.category])


def _add_matches(
    result: ReadOnlyValues,
    ring: Ring,
    range_and_level: tuple[int, int],
    detections: BoxColumns,
    truth: BoxColumns,
    protocol: DetectionProtocol,
) -> None:
    """Add the matches in one range at one threshold to the counts.

    Args:
        result: Counts of the sample, as in `frame_counts`; they are changed.
        ring: Boxes that count in the range, and the near pairs.
        range_and_level: Index of the range, and index of the threshold.
        detections: Detections of the sample.
        truth: True boxes of the sample.
        protocol: Rules of the evaluation.
    """
    position, level = range_and_level
    class_count = len(protocol.classes)
    range_count = len(protocol.ranges)
    level_count = len(protocol.thresholds)
    reach = ring.reach(level)
    if not reach:
        return

    def add_candidates(name: str, candidates: Collection[int], *columns: Iterable[Any]) -> None:
        cells = []
        rows = []
        for candidate in candidates:
            row, code = divmod(candidate, class_count)
            group = code * range_count + position
            cells.append(group * level_count + level)
            rows.append(row)
        _extend(result[name], cells, rows, *columns)

    if protocol.matching == "by_truth":
        matches = _add_matches_by_truth(add_candidates, reach, ring, class_count)
    else:
        matches = nearest_by_score(reach)
        add_candidates("tp", matches.values())
    if protocol.thresholds[level] == protocol.error_threshold and matches:
        true_rows = np.array([*matches])
        rows, codes = np.divmod([*matches.values()], class_count)
        errors = match_errors(detections.select(rows), truth.select(true_rows), protocol)
        _extend(result["errors"], codes.tolist(), rows.tolist(), *_without_nan(errors))


def _add_matches_by_truth(
    add_candidates: Callable[..., None], reach: Reach, ring: Ring, class_count: int
) -> dict[int, int]:
    """Match by truth, and add the matches to the counts with `add_candidates`.

    Returns:
        True box → matched candidate, for matches in which both count.
    """
    counts = ring.counts.tolist()
    truth_counts = ring.truth_counts.tolist()
    candidate_counts = {candidate: counts[candidate // class_count] for candidate in reach}
    steps = nearest_by_truth(reach, candidate_counts, truth_counts)
    add_candidates("tp", steps.tp)
    add_candidates("spent", steps.spent)
    excused_candidates = [candidate for candidate, _ in steps.excused]
    excused_changes = [change for _, change in steps.excused]
    add_candidates("excused", excused_candidates, excused_changes)
    matches = {}
    for true_box, candidate in highest_score_by_truth(reach).items():
        if truth_counts[true_box] and candidate_counts[candidate]:
            matches[true_box] = candidate
    add_candidates("matches", matches.values())
    return matches


def _without_nan(values: FloatArray) -> list[list[float | None]]:
    """Convert an array to a list of columns, with None instead of NaN."""
    columns = []
    for column in values.T.tolist():
        columns.append([None if isnan(value) else value for value in column])
    return columns


def _extend(columns: Sequence[list[Any]], *values_by_column: Iterable[Any]) -> None:
    """Append values to each of the columns."""
    for column, values in zip(columns, values_by_column, strict=True):
        column.extend(values)


def existing_detections(
    detections: BoxColumns, protocol: DetectionProtocol
) -> tuple[BoxColumns, IntArray]:
    """Return the detections in the protocol's area, in its precision, and their indices."""
    if protocol.single_precision:
        detections = detections.rounded()
    return _select(detections, inside_area(detections, protocol), protocol)


def existing_truth(truth: BoxColumns, protocol: DetectionProtocol) -> tuple[BoxColumns, IntArray]:
    """Return the true boxes that the protocol uses, in its precision, and their indices.

    They are in its area and belong to one of its classes. The agent's own box is left out, unless
    the protocol's `own_box` is True.
    """
    if protocol.single_precision:
        truth = truth.rounded()
    exists = inside_area(truth, protocol) & (class_codes(truth, protocol) >= 0)
    if not protocol.own_box:
        exists &= ~truth.own
    return _select(truth, exists, protocol)


def _select(
    boxes: BoxColumns, mask: BoolArray, protocol: DetectionProtocol
) -> tuple[BoxColumns, IntArray]:
    """Return the boxes that a mask selects, and their indices.

    Their order breaks ties of scores and distances. For matching `by_truth` it is the order of
    `boxes`; for `by_score` it does not depend on that order.
    """
    rows = np.flatnonzero(mask)
    if protocol.matching == "by_score":
        rows = rows[boxes.select(rows).surest_first]
    return boxes.select(rows), rows


def inside_area(boxes: BoxColumns, protocol: DetectionProtocol) -> BoolArray:
    """Find the boxes that are in the protocol's area, shape (N,) bool."""
    if protocol.area is None:
        return np.ones(len(boxes), dtype=bool)
    points = boxes.center[:, None, :2]
    if protocol.area_of == "footprint":
        forward = np.stack([np.cos(boxes.yaw), np.sin(boxes.yaw)], axis=1)[:, None]
        left = forward[..., ::-1] * (-1.0, 1.0)
        length = boxes.size[:, 0, None, None]
        width = boxes.size[:, 1, None, None]
        points = points + _CORNERS[:, :1] * length * forward + _CORNERS[:, 1:] * width * left
    x_low, x_high, y_low, y_high = protocol.area
    x = points[..., 0]
    y = points[..., 1]
    is_inside = (x >= x_low) & (x <= x_high) & (y >= y_low) & (y <= y_high)
    return np.asarray(is_inside.all(axis=1))


def _in_range(boxes: BoxColumns, protocol: DetectionProtocol, position: int) -> BoolArray:
    """Find the boxes in the range with index `position`, shape (N,) bool."""
    x = as_floats(boxes.center[:, 0])
    y = as_floats(boxes.center[:, 1])
    if protocol.range_from_x_alone:
        y = x
    distance = np.sqrt(x * x + y * y)
    start, end = protocol.ranges[position]
    return np.asarray((distance >= start) & (distance < end))


def _standing_if_unknown(truth: BoxColumns) -> BoxColumns:
    """Replace unknown velocities by 0."""
    is_unknown = np.isnan(truth.velocity)
    if not is_unknown.any():
        return truth
    return replace(truth, velocity=np.where(is_unknown, 0.0, truth.velocity))


@lru_cache(maxsize=8)
def _class_table(protocol: DetectionProtocol) -> IntArray:
    """Return an array that maps a category's index to its class index; −1 if it has no class."""
    table = np.full(len(CATEGORIES), -1, dtype=np.int64)
    for position, (_, categories) in enumerate(protocol.classes):
        for name in categories:
            table[CATEGORIES.index(name)] = position
    return readonly(table)


@lru_cache(maxsize=8)
def _cost_limits(protocol: DetectionProtocol) -> FloatArray:
    """Return the cost below which pairs match, for each class: shape (classes, thresholds)."""
    limits = []
    for name, _ in protocol.classes:
        limits.append([limit_of(threshold, protocol) for threshold in protocol.limits(name)])
    return readonly(np.array(limits))
