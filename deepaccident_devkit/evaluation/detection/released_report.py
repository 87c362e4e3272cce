"""The dictionary and the text in which the released code reports detection (DeepAccident_det_eval)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.evaluation.detection.measures import ERRORS
from deepaccident_devkit.evaluation.detection.result import DetectionResult, mean_of

_RANGES: Final = ("easy", "moderate", "hard")
_RANGE_HEADINGS: Final = ("0-30m", "30-50m", ">50m")
_THRESHOLDS: Final = ("strict", "loose")
_RULE: Final = "-" * 40


def released_dict(result: DetectionResult) -> dict[str, float]:
    """The numbers under the released code's names, of a result of `released` or `released_iou`.

    Raises:
        ChoiceError: the result is of another form.
    """
    return _overlap_dict(result) if _of_overlaps(result) else _distance_dict(result)


def released_text(result: DetectionResult) -> str:
    """What the released code prints; average precisions are cut, not rounded, to two decimals. Raises ChoiceError."""
    return _overlap_text(result) if _of_overlaps(result) else _distance_text(result)


def _of_overlaps(result: DetectionResult) -> bool:
    shape = result.average_precision.shape[1:]
    if shape == (3, 2):
        return True
    if shape != (1, 4):
        raise ChoiceError(
            f"the released code has no report of {shape[0]} ranges and {shape[1]} thresholds; evaluate with the "
            "protocols 'released' or 'released_iou'"
        )
    return False


def _distance_dict(result: DetectionResult) -> dict[str, float]:
    numbers = {}
    for position, (name, average) in enumerate(result.class_average_precision.items()):
        numbers[f"CARLA/{name}_3D_average_distance_mAP"] = average
        for error, value in zip(ERRORS, result.errors[position].tolist(), strict=True):
            numbers[f"CARLA/{name}_m{error}"] = value
    numbers["CARLA/Overall_3D_mAP"] = result.mean_average_precision
    return numbers


def _distance_text(result: DetectionResult) -> str:
    parts = []
    for position, (name, average) in enumerate(result.class_average_precision.items()):
        parts += [
            f"\n{name} average mAP over distance matching threshold: (0.5, 1, 2, 4) meter\n",
            f"{_cut(average):<10}\n",
            _row([f"m{error}" for error in ERRORS]),
            f"{_RULE}\n",
            _row([str(value) for value in result.errors[position].tolist()]),
            "\n",
        ]
    parts.append(f"\nOverall mAP:\n{result.mean_average_precision:.4f}\n")
    return "".join(parts)


def _overlap_dict(result: DetectionResult) -> dict[str, float]:
    numbers = {}
    for position, name in enumerate(result.classes):
        for level, strictness in enumerate(_THRESHOLDS):
            for ring, difficulty in enumerate(_RANGES):
                numbers[f"CARLA/{name}_3D_{difficulty}_{strictness}"] = float(
                    result.average_precision[position, ring, level]
                )
    for name, average in result.class_average_precision.items():
        numbers[f"CARLA/Overall_3D_{name}"] = average
    for difficulty, average in zip(_RANGES, _by_range(result), strict=True):
        numbers[f"CARLA/Overall_3D_{difficulty}"] = average
    numbers["CARLA/Overall_3D"] = result.mean_average_precision
    return numbers


def _overlap_text(result: DetectionResult) -> str:
    parts = []
    for position, name in enumerate(result.classes):
        parts.append("\n")
        for level, threshold in enumerate(result.thresholds[position].tolist()):
            averages = result.average_precision[position, :, level].tolist()
            parts += [
                f"{name} IOU matching threshold: {threshold:.2f}\n",
                _row(_RANGE_HEADINGS),
                f"{_RULE}\n",
                _row([str(_cut(average)) for average in averages]),
                "\n",
            ]
    parts.append("\nmAP_by_category@\n")
    parts += [f"{name}: {average:.4f}\n" for name, average in result.class_average_precision.items()]
    easy, moderate, hard = _by_range(result)
    parts += [
        f"\nOverall AP@{', '.join(_RANGES)}:\n3d   AP:{easy:.4f}, {moderate:.4f}, {hard:.4f}\n",
        f"\nOverall AP@: {result.mean_average_precision:.4f}\n",
    ]
    return "".join(parts)


def _by_range(result: DetectionResult) -> list[float]:
    return [mean_of(result.average_precision[:, ring]) for ring in range(len(_RANGES))]


def _cut(average: float) -> float:
    return float(np.trunc(average * 100)) / 100


def _row(words: Sequence[str]) -> str:
    return "\t".join(f"{word:<10}" for word in words) + "\n"
