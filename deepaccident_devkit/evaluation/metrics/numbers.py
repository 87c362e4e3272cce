"""The numbers that a result holds, by their paths, and the limits of each."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from fnmatch import fnmatchcase
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from deepaccident_devkit.arrays import FloatArray
from deepaccident_devkit.evaluation.metrics.headlines import HEADLINE_UNITS, LIMITS, Unit

_UNITS: Final[Mapping[str, Unit]] = MappingProxyType(
    {
        **HEADLINE_UNITS,
        "ranges/*/sq": "%",
        "ranges/*/rq": "%",
        "mean_iou": "%",
        "iou/*": "%",
        "path_accuracy": "share",
        "area_under_curve": "share",
        "mean_time": "s",
        "recall": "share",
        "precision": "share",
        "time_in_alarm": "share",
        "early_share": "share",
        "tta_hit": "s",
        "tta0": "s",
        "tta0_after/*": "s",
        "time_at_r80": "s",
        "time_at_half": "s",
        "precision_at_*": "share",
        "recall_at_half": "share",
        "alarm_seconds_per_minute": "1/min",
        "episodes_per_minute": "1/min",
        "shares/*": "share",
        "warned": "share",
        "extrapolated": "share",
        "braking_seconds_per_minute": "1/min",
    }
)
"""Pattern of paths → unit."""
_SIGNED: Final = ("lateness",)
"""Numbers with a unit that can be below 0."""
_WITHOUT: Final = (
    "false_recordings",
    *("within/*/distance", "threshold", "best_f1", "quiet", "quiet_braking"),
    "median_*",
)
"""Totals, settings, and medians, which jump when a cluster is left out: the jackknife does not hold for them."""


def numbers_of(result: object) -> dict[str, float]:
    """The floats of a result by their path in it: `min_ade`, `ranges/30x30/iou`; whole numbers, texts and None not."""
    return dict(_numbers(result, ""))


def has_interval(path: str) -> bool:
    """Whether a number is one that the jackknife holds for: neither a total, nor a setting, nor a median."""
    return not _is_one_of(path, _WITHOUT)


def range_of(path: str, alone: FloatArray) -> tuple[float, float]:
    """The least and the most that a number can be; infinite for no limit.

    By its unit: shares are in [0, 1], percents in [0, 100], lengths and times from 0. A number that is not of the
    devkit's own has no unit: it is taken for a share if no cluster is outside [0, 1], and else for one that is never
    below 0 if none is.

    Args:
        path: of the number.
        alone: (C,) what it is in each of the clusters; NaN where there is nothing to count.
    """
    unit = next((unit for pattern, unit in _UNITS.items() if _is_one_of(path, (pattern,))), None)
    if unit is not None:
        return -math.inf if _is_one_of(path, _SIGNED) else 0.0, LIMITS.get(unit, math.inf)
    known = alone[np.isfinite(alone)]
    least = known.min(initial=0.0)
    return (0.0, 1.0 if known.max(initial=0.0) <= 1 else math.inf) if least >= 0 else (-math.inf, math.inf)


def _is_one_of(path: str, patterns: tuple[str, ...]) -> bool:
    """Whether a pattern fits the path, or its end, as of the results `beside` others."""
    return any(fnmatchcase(path, pattern) or fnmatchcase(path, f"*/{pattern}") for pattern in patterns)


def _numbers(value: object, path: str) -> Iterator[tuple[str, float]]:
    parts: Mapping[Any, object] = {}
    if isinstance(value, float):
        yield path, value
    elif is_dataclass(value):
        parts = {field.name: getattr(value, field.name) for field in fields(value)}
    elif isinstance(value, Mapping):
        parts = value
    elif isinstance(value, (list, tuple)):
        parts = dict(enumerate(value))
    for key, part in parts.items():
        name = f"{key:g}" if isinstance(key, float) else str(key)
        yield from _numbers(part, f"{path}/{name}" if path else name)
