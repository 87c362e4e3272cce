"""Intersection over union of segmentations: cells counted by class, summed over samples (evaluation.md b)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from deepaccident_devkit.arrays import AnyArray, BoolArray, as_numbers
from deepaccident_devkit.errors import GeometryError


@dataclass(frozen=True, slots=True, kw_only=True)
class SegmentationCounts:
    """Cells of one class.

    Attributes:
        true_positive: of the class in both.
        false_positive: predicted alone.
        false_negative: true alone.
    """

    true_positive: int
    false_positive: int
    false_negative: int


def segmentation_counts(prediction: AnyArray, label: AnyArray, classes: int = 2) -> tuple[SegmentationCounts, ...]:
    """Compare two segmentations cell by cell.

    Args:
        prediction: any shape, integers: the class of each cell, from 0.
        label: the same shape.
        classes: how many are counted; cells of others are of none of them.

    Returns:
        The counts of each class.

    Raises:
        GeometryError: other shapes.
    """
    predicted, true = as_numbers("prediction", prediction, dtype=None), as_numbers("label", label, dtype=None)
    if predicted.shape != true.shape:
        raise GeometryError(f"prediction: expected the label's shape {true.shape}, found {predicted.shape}")
    return tuple(mask_counts(predicted == index, true == index) for index in range(classes))


def mask_counts(predicted: BoolArray, true: BoolArray) -> SegmentationCounts:
    """Compare two masks of one class, of the same shape."""
    both = int(np.count_nonzero(predicted & true))
    return SegmentationCounts(
        true_positive=both,
        false_positive=int(np.count_nonzero(predicted)) - both,
        false_negative=int(np.count_nonzero(true)) - both,
    )


def iou(counts: Iterable[SegmentationCounts], *, absent: float = 0.0) -> float:
    """Intersection over union of one class, in [0, 1], over all samples; `absent` where neither side has the class."""
    every = list(counts)
    both = sum(each.true_positive for each in every)
    union = both + sum(each.false_positive + each.false_negative for each in every)
    return both / union if union else absent
