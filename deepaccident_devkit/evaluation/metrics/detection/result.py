"""`DetectionResult`, and the form in which nuScenes' devkit prints one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import fsum, isnan, nan
from typing import Any, ClassVar, Final

import numpy as np

from deepaccident_devkit.arrays import AnyArray, FloatArray, FrozenArrays, IntArray
from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.evaluation.metrics.detection.matching import ERRORS
from deepaccident_devkit.evaluation.metrics.frozen_mappings import FrozenMappings, plain
from deepaccident_devkit.evaluation.metrics.numbers import TaskResult
from deepaccident_devkit.text import columns_text


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


AP_WEIGHT: Final = 5
"""nuScenes' weight of mAP beside one for each error."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NuScenesSummary(FrozenMappings):
    """mAP, mean errors and one score of all, in nuScenes' manner.

    The score is like nuScenes' NDS, but not the same: this dataset has no attributes, so that there is no AAE, and the
    weights are 5 for mAP and 1 for each of four errors, of 9 (nuScenes: of 10).

    Attributes:
        mean_average_precision: in %.
        errors: mATE (m), mASE (1 − IoU), mAOE (rad), mAVE (m/s) → mean over the classes.
        score_without_attributes: in %, the weighted mean of mAP and of 1 − error (0 for errors above 1, and for an
            unknown error, such as that of velocities which a detector does not give).
        table: class → AP (%) and errors.
    """

    mean_average_precision: float
    errors: Mapping[str, float]
    score_without_attributes: float
    table: Mapping[str, Mapping[str, float]]

    def as_dict(self) -> dict[str, Any]:
        """All of it, as JSON holds it; None for what is not known."""
        return {
            "mAP": plain(self.mean_average_precision),
            **plain(self.errors),
            "score_without_attributes": plain(self.score_without_attributes),
            "classes": plain(self.table),
        }

    def to_text(self) -> str:
        """A table of the classes, and the means beneath."""
        rows = [["class", "AP %", *(name.removeprefix("m") for name in self.errors)]]
        rows += [[name, *(_text(value) for value in row.values())] for name, row in self.table.items()]
        means = [self.mean_average_precision, *self.errors.values()]
        rows.append(["mean", *(_text(value) for value in means)])
        score = f"score without attributes (5 mAP + 4 errors, of 9): {_text(self.score_without_attributes)} %"
        return f"{columns_text(rows)}\n{score}"


def nuscenes_summary(result: DetectionResult) -> NuScenesSummary:
    """The summary of a result that has errors, such as that of the protocol `paper`.

    Raises:
        ChoiceError: the result has more than one range, such as that of `released_iou`.
    """
    if len(result.ranges) > 1:
        raise ChoiceError(f"a nuScenes summary is of one range, the result has {len(result.ranges)}")
    errors = {f"m{name}": value for name, value in result.mean_errors.items()}
    mean = result.mean_average_precision
    parts = [AP_WEIGHT * mean / 100, *(0.0 if isnan(value) else 1 - min(1.0, value) for value in errors.values())]
    table = {
        name: {"AP": average, **dict(zip(errors, result.errors[position].tolist(), strict=True))}
        for position, (name, average) in enumerate(result.class_average_precision.items())
    }
    return NuScenesSummary(
        mean_average_precision=mean,
        errors=errors,
        score_without_attributes=100 * fsum(parts) / (AP_WEIGHT + len(errors)),
        table=table,
    )


def _text(value: float) -> str:
    return "–" if isnan(value) else f"{value:.3f}"
