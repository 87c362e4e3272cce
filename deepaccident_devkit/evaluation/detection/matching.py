"""How near boxes are to one another, which are matched, and the errors of a match.

A *candidate* is a detection within the problem of one class; `Reach` has those that are near enough to any true box,
in descending order of their scores (equal ones in the order given), each with the true boxes that it reaches, in the
order given, and the pair's rank: of two pairs that compete the lower wins. No two ranks are equal.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from deepaccident_devkit.evaluation.detection.boxes import BoxColumns
from deepaccident_devkit.evaluation.detection.protocols import DetectionProtocol
from deepaccident_devkit.geometry.box_arrays import intersection_areas
from deepaccident_devkit.support.arrays import AnyArray, FloatArray, as_floats

Reach = Mapping[int, Sequence[tuple[int, int]]]
"""Candidate → (true box, rank) of the pairs that are near enough."""
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


def nearest_by_truth(reach: Reach, counts: Mapping[int, bool], truth_counts: Sequence[bool]) -> Steps:
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


def _taker(pairs: Sequence[tuple[int, int]], behind: int, ranks: Mapping[int, int]) -> tuple[int, int]:
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


ERRORS: Final = ("ATE", "ASE", "AOE", "AVE")
"""Errors of translation (m), scale (1 − overlap), orientation (rad) and velocity (m/s), in the order of columns."""
RELEASED_TURN: Final = 2 * 3.1415926
"""The released code's full turn, radians."""


def costs(detections: BoxColumns, truth: BoxColumns, protocol: DetectionProtocol) -> AnyArray:
    """How far each of D detections is from each of G true boxes by the protocol's measure: (D, G), the less the nearer.

    Distances in metres, of the boxes' own precision; overlaps negated, so that they too are the less the nearer.
    """
    return _MEASURES[protocol.measure](detections, truth, protocol)


def limit_of(threshold: float, protocol: DetectionProtocol) -> float:
    """The cost below which (or, where the protocol includes it, up to which) a threshold's pairs match."""
    return threshold if protocol.measure.startswith("distance") else -threshold


def match_errors(detections: BoxColumns, truth: BoxColumns, protocol: DetectionProtocol) -> FloatArray:
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
    return np.column_stack([translation, 1 - _overlap_of_matches(detections, truth, protocol), turn, speed_error])


def _overlap_of_matches(detections: BoxColumns, truth: BoxColumns, protocol: DetectionProtocol) -> FloatArray:
    if protocol.scale_by_overlap:
        return as_floats(_iou_3d(detections, truth, protocol).diagonal())
    mine, theirs = as_floats(detections.size), as_floats(truth.size)
    common = _product(np.minimum(mine, theirs))
    union = _product(mine) + _product(theirs) - common
    return np.divide(common, union, out=np.zeros_like(common), where=union > 0)


def _turn_between(detected: FloatArray, true: FloatArray, protocol: DetectionProtocol) -> FloatArray:
    if not protocol.orientation_unwrapped:
        return as_floats(np.abs((true - detected + np.pi) % (2 * np.pi) - np.pi))
    true = true % RELEASED_TURN
    if protocol.single_precision:  # the released code writes this back into single precision, the detection's not
        true = as_floats(true.astype(np.float32))
    return np.abs(true - detected % RELEASED_TURN)


def _distance_of_bottoms(detections: BoxColumns, truth: BoxColumns, _: DetectionProtocol) -> AnyArray:
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
    return _over_union(areas * np.maximum(shared, 0), _product(detections.size), _product(truth.size))


def _iou_bev(detections: BoxColumns, truth: BoxColumns, _: DetectionProtocol) -> FloatArray:
    areas = intersection_areas(detections.footprint, truth.footprint)
    return _over_union(areas, _product(detections.size[:, :2]), _product(truth.size[:, :2]))


def _heights(boxes: BoxColumns, *, down: bool) -> tuple[FloatArray, FloatArray]:
    bottom, height = as_floats(boxes.bottom), as_floats(boxes.size[:, 2])
    return (bottom - height, bottom) if down else (bottom, bottom + height)


def _product(sizes: AnyArray) -> FloatArray:
    return as_floats(as_floats(sizes).prod(axis=1))


def _over_union(common: FloatArray, mine: FloatArray, theirs: FloatArray) -> FloatArray:
    union = mine[:, None] + theirs - common
    return np.divide(common, union, out=np.zeros_like(common), where=union > 0)


_MEASURES: Final[Mapping[str, Callable[[BoxColumns, BoxColumns, DetectionProtocol], AnyArray]]] = {
    "distance_of_bottoms": _distance_of_bottoms,
    "distance_bev": _distance_bev,
    "iou_3d": lambda detections, truth, protocol: -_iou_3d(detections, truth, protocol),
    "iou_bev": lambda detections, truth, protocol: -_iou_bev(detections, truth, protocol),
}
