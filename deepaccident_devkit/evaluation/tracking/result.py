"""`TrackingResult`: the numbers of tracks for each class, and their means."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import chain
from typing import ClassVar

from deepaccident_devkit.evaluation.task import Row, TaskResult

# Numbers of any protocol; headlines in the order of tables.
_COLUMNS = (
    Row("hota", "share", "higher"),
    Row("amota", "share", "higher"),
    Row("amotp", "m"),
    Row("det_a", "share", "higher"),
    Row("ass_a", "share", "higher"),
    Row("loc_a", "share", "higher", is_headline=False),
    Row("mota", "share", "higher", is_signed=True),
    Row("motp", "m"),
    Row("idf1", "share", "higher"),
    Row("id_switches", "count"),
    Row("fragments", "count"),
    Row("mostly_tracked", "count", "higher"),
    Row("moda", "share", "higher", is_signed=True, is_headline=False),
    Row("tid", "s", is_headline=False),
    Row("lgd", "s", is_headline=False),
)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class TrackingResult(TaskResult):
    """Numbers of tracks; NaN if there is nothing to count.

    Attributes:
        class_mean: Name → mean over the classes with truth; counts are summed.
        pooled: Name → number of all classes together, counted box by box; empty if the protocol
            has no such numbers.
        classes: Class → name → number.
        samples: Number of samples.
        recordings: Number of recordings.
        notes: Sentences that say what the numbers are about: classes, truth, range, threshold.
    """

    rows: ClassVar[tuple[Row, ...]] = (
        *(replace(row, path=f"class_mean/{row.path}") for row in _COLUMNS),
        *(replace(row, path=f"*/{row.path}", is_headline=False) for row in _COLUMNS),
    )
    class_mean: Mapping[str, float]
    pooled: Mapping[str, float]
    classes: Mapping[str, Mapping[str, float]]
    samples: int
    recordings: int
    notes: tuple[str, ...]


def mean_of_classes(classes: Mapping[str, Mapping[str, float]]) -> dict[str, float]:
    """Average the numbers of the classes with truth, without NaN, and sum their counts.

    Args:
        classes: Class → name → number; counts are integers.
    """
    with_truth = [numbers for numbers in classes.values() if numbers["true_boxes"]]
    mean = {}
    for name in dict.fromkeys(chain.from_iterable(classes.values())):
        values = [numbers[name] for numbers in with_truth if not math.isnan(numbers[name])]
        if values and all(isinstance(value, int) for value in values):
            mean[name] = sum(values)
        else:
            mean[name] = math.fsum(values) / len(values) if values else math.nan
    return mean
