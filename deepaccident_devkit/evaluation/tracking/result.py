"""`TrackingResult`: the numbers of tracks for each class, and their means."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import chain
from typing import ClassVar

from deepaccident_devkit.evaluation.evaluator import ratio
from deepaccident_devkit.evaluation.task import Row, TaskResult

# Numbers of any protocol; headlines in the order of tables.
_SHARES = ("hota", "amota", "det_a", "ass_a", "idf1")
_OTHER_SHARES = (
    *("loc_a", "det_re", "det_pr", "ass_re", "ass_pr", "motp_similarity"),
    *("id_recall", "id_precision", "recall", "motar"),
)
# Headlines are floats, other counts are integers.
_COUNTS = ("id_switches", "fragments", "mostly_tracked")
_COLUMNS = (
    *(Row(name, "share", "higher") for name in _SHARES),
    Row("mota", "share", "higher", is_signed=True),
    *(Row(name, "m") for name in ("amotp", "motp")),
    *(Row(name, "count") for name in _COUNTS[:2]),
    Row(_COUNTS[2], "count", "higher"),
    *(Row(name, "share", "higher", is_headline=False) for name in _OTHER_SHARES),
    Row("moda", "share", "higher", is_signed=True, is_headline=False),
    Row("faf", "count", is_headline=False),
    *(Row(name, "s", is_headline=False) for name in ("tid", "lgd")),
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
    mean: dict[str, float] = {}
    for name in dict.fromkeys(chain.from_iterable(classes.values())):
        values = [numbers[name] for numbers in with_truth if not math.isnan(numbers[name])]
        if any(isinstance(numbers[name], int) for numbers in classes.values()):
            mean[name] = float(sum(values)) if name in _COUNTS else sum(values)
        else:
            mean[name] = ratio(math.fsum(values), len(values))
    return mean
