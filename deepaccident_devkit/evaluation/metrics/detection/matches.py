"""`DetectionMatches`: which detection is which true box, to look at; the metrics do not use it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from deepaccident_devkit.arrays import FrozenArrays, IntArray
from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.evaluation.metrics.detection.boxes import DetectedBoxes, columns_of
from deepaccident_devkit.evaluation.metrics.detection.frame_counts import (
    Ring,
    inside_area,
    ring_of,
    rows_taken,
    truth_taken,
)
from deepaccident_devkit.evaluation.metrics.detection.matching import nearest_by_score, nearest_by_truth
from deepaccident_devkit.evaluation.metrics.detection.protocols import DetectionProtocol, detection_protocol
from deepaccident_devkit.geometry import Boxes


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
