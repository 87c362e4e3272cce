"""`DetectionResult`: what `DetectionEvaluator.compute` returns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import fsum, isnan, nan
from typing import Any

import numpy as np

from deepaccident_devkit.arrays import AnyArray, FloatArray, FrozenArrays, IntArray
from deepaccident_devkit.evaluation.detection.measures import ERRORS


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DetectionResult(FrozenArrays):
    """Average precisions and errors, by class; arrays are read-only. NaN: nothing to count.

    C classes, R ranges, K thresholds, P points of a curve.

    Attributes:
        classes: names of the classes.
        ranges: from and to of each range, metres.
        thresholds: (C, K) of the protocol's measure: metres, or shares of overlap.
        average_precision: (C, R, K) in %.
        precision: (C, R, K, P) shares.
        recall: (C, R, K, P) shares; of the `released` curve what is reached at each point (0 where it is not), else the
            levels asked for.
        errors: (C, 4) in the order of `measures.ERRORS`: metres, 1 − overlap, radians, m/s.
        truths: (C, R) how many true boxes count.
        detections: (C, R) how many detections do.
        samples: number of samples.
    """

    classes: tuple[str, ...]
    ranges: tuple[tuple[float, float], ...]
    thresholds: FloatArray
    average_precision: FloatArray
    precision: FloatArray
    recall: FloatArray
    errors: FloatArray
    truths: IntArray
    detections: IntArray
    samples: int

    @property
    def class_average_precision(self) -> Mapping[str, float]:
        """Class → the mean over thresholds and ranges, in %."""
        return {name: mean_of(values) for name, values in zip(self.classes, self.average_precision, strict=True)}

    @property
    def mean_average_precision(self) -> float:
        """The mean over all classes, ranges and thresholds that there are, in %."""
        return mean_of(np.array(list(self.class_average_precision.values())))

    @property
    def mean_errors(self) -> Mapping[str, float]:
        """ATE, ASE, AOE, AVE → the mean over the classes that there are."""
        return {name: mean_of(column) for name, column in zip(ERRORS, self.errors.T, strict=True)}

    def to_dict(self) -> dict[str, Any]:
        """All but the curves, as JSON holds it; None for what there is nothing to count of."""
        by_class = {
            name: {
                "thresholds": self.thresholds[position].tolist(),
                "AP": _without_nan(self.average_precision[position]),
                "mean_AP": _number(mean_of(self.average_precision[position])),
                **{error: _number(value) for error, value in zip(ERRORS, self.errors[position].tolist(), strict=True)},
                "truths": self.truths[position].tolist(),
                "detections": self.detections[position].tolist(),
            }
            for position, name in enumerate(self.classes)
        }
        return {
            "samples": self.samples,
            "ranges": [[_number(low), None if high == float("inf") else high] for low, high in self.ranges],
            "mAP": _number(self.mean_average_precision),
            **{f"m{name}": _number(value) for name, value in self.mean_errors.items()},
            "classes": by_class,
        }


def mean_of(values: AnyArray) -> float:
    """The exact mean of what is not NaN; NaN if there is nothing."""
    known = [value for value in np.asarray(values, dtype=np.float64).reshape(-1).tolist() if not isnan(value)]
    return fsum(known) / len(known) if known else nan


def _without_nan(values: FloatArray) -> list[Any]:
    return [_without_nan(row) for row in values] if values.ndim > 1 else [_number(value) for value in values.tolist()]


def _number(value: float) -> float | None:
    return None if isnan(value) else value
