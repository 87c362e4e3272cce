"""`DetectionResult`: average precisions and errors of detected boxes, by class."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import fsum, isnan, nan
from typing import Any, ClassVar

import numpy as np

from deepaccident_devkit.evaluation.detection.matching import ERRORS
from deepaccident_devkit.evaluation.task import FrozenMappings, Row, TaskResult, plain
from deepaccident_devkit.support.arrays import AnyArray, FloatArray, FrozenArrays, IntArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DetectionResult(TaskResult, FrozenArrays):
    """Average precisions and errors, by class; arrays are read-only. NaN: nothing to count.

    C classes, R ranges, K thresholds, P points of a curve.

    Attributes:
        mean_average_precision: the mean over all classes, ranges and thresholds that there are, in %.
        class_average_precision: class → the mean over thresholds and ranges, in %.
        mean_errors: ATE, ASE, AOE, AVE → the mean over the classes that there are; units as of `errors`.
        classes: names of the classes.
        ranges: (R, 2) from and to of each range, metres.
        thresholds: (C, K) of the protocol's measure: metres, or shares of overlap.
        average_precision: (C, R, K) in %.
        precision: (C, R, K, P) shares.
        recall: (C, R, K, P) shares; of the `released` curve what is reached at each point (0 where it is not), else the
            levels asked for.
        errors: (C, 4) in the order of `matching.ERRORS`: metres, 1 − overlap, radians, m/s.
        truths: (C, R) how many true boxes count.
        detections: (C, R) how many detections do.
        samples: number of samples.
    """

    task: ClassVar[str] = "detection"
    rows: ClassVar[tuple[Row, ...]] = (
        Row("mean_average_precision", "mAP", "%", "higher"),
        Row("mean_errors/ATE", "mATE", "m"),
        Row("mean_errors/ASE", "mASE", "1 - overlap"),
        Row("mean_errors/AOE", "mAOE", "rad"),
        Row("mean_errors/AVE", "mAVE", "m/s"),
        Row("class_average_precision/*", "AP *", "%", "higher"),
    )
    mean_average_precision: float
    class_average_precision: Mapping[str, float]
    mean_errors: Mapping[str, float]
    classes: tuple[str, ...]
    ranges: FloatArray
    thresholds: FloatArray
    average_precision: FloatArray
    precision: FloatArray
    recall: FloatArray
    errors: FloatArray
    truths: IntArray
    detections: IntArray
    samples: int

    def __post_init__(self) -> None:
        """Freeze arrays and mappings."""
        FrozenArrays.__post_init__(self)
        FrozenMappings.__post_init__(self)

    def as_dict(self) -> dict[str, Any]:
        """All except the curves, as JSON holds it; None where there is nothing to count."""
        by_class = {
            name: {
                "thresholds": self.thresholds[position].tolist(),
                "AP": plain(self.average_precision[position]),
                "mean_AP": plain(self.class_average_precision[name]),
                **{error: plain(value) for error, value in zip(ERRORS, self.errors[position].tolist(), strict=True)},
                "truths": self.truths[position].tolist(),
                "detections": self.detections[position].tolist(),
            }
            for position, name in enumerate(self.classes)
        }
        return {
            "samples": self.samples,
            "ranges": plain(self.ranges),
            "mAP": plain(self.mean_average_precision),
            **{f"m{name}": plain(value) for name, value in self.mean_errors.items()},
            "classes": by_class,
        }


def mean_of(values: AnyArray) -> float:
    """The exact mean of the numbers that are not NaN; NaN if there are none."""
    known = [value for value in np.asarray(values, dtype=np.float64).reshape(-1).tolist() if not isnan(value)]
    return fsum(known) / len(known) if known else nan
