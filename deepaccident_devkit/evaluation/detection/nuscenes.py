"""A summary of a detection result as the nuScenes devkit prints one, as far as this dataset goes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import fsum, isnan
from typing import Any, Final

from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.evaluation.detection.result import DetectionResult
from deepaccident_devkit.evaluation.frozen_mappings import FrozenMappings, plain
from deepaccident_devkit.text import columns_text

AP_WEIGHT: Final = 5
"""nuScenes' weight of mAP beside one for each error."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NuScenesSummary(FrozenMappings):
    """mAP, mean errors and one score of all, in nuScenes' manner.

    The score is like nuScenes' NDS and is not it: this dataset has no attributes, so that there is no AAE, and the
    weights are 5 for mAP and 1 for each of four errors, of 9 (nuScenes: of 10).

    Attributes:
        mean_average_precision: in %.
        errors: mATE (m), mASE (1 − IoU), mAOE (rad), mAVE (m/s) → mean over the classes.
        score_without_attributes: in %, the weighted mean of mAP and of 1 − error (0 for errors above 1, and for an
            error that is not known, such as that of velocities which a detector does not give).
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
