"""The numbers that a result holds: the few that are shown first, all of them by their paths, and the limits of each."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass
from fnmatch import fnmatchcase
from types import MappingProxyType
from typing import Any, ClassVar, Final, Literal

import numpy as np

from deepaccident_devkit.evaluation.frozen_mappings import FrozenMappings
from deepaccident_devkit.reports import table_html
from deepaccident_devkit.support.arrays import FloatArray, known
from deepaccident_devkit.support.text import choice

Unit = Literal["%", "share", "m", "s", "rad", "m/s", "1 - overlap", "1/min"]
LIMITS: Final[Mapping[Unit, float]] = MappingProxyType({"%": 100.0, "share": 1.0, "1 - overlap": 1.0})
"""The most that a number of a unit can be; others have no limit."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Headline:
    """One number of a result.

    Attributes:
        name: short, as tables print it: `iou 30x30`, `accuracy@10`, `mAP`.
        value: None where there is nothing to count, or the result has no such number.
        unit: `%` for percent, `share` for a share in [0, 1].
        higher_is_better: whether more is better; None where neither is.
        path: of the number in the result, as `breakdowns.numbers_of` has it: `ranges/30x30/iou`.
    """

    name: str
    value: float | None
    unit: Unit
    higher_is_better: bool | None
    path: str

    def text(self) -> str:
        """The value with its unit; see `value_text`."""
        return value_text(self.value, self.unit)


@dataclass(frozen=True, slots=True)
class _Row:
    """Where a number stands in a task's result; `*` is any key, and takes its place in the name."""

    path: str
    name: str
    unit: Unit
    better: Literal["higher", "lower", "neither"] = "lower"


_SHOWN: Final = 4
"""Headlines in a result's text."""
_HIGHER_IS_BETTER: Final = {"higher": True, "lower": False, "neither": None}
_ROWS: Final[Mapping[str, tuple[_Row, ...]]] = MappingProxyType(
    {
        "motion": (
            _Row("ranges/*/iou", "iou *", "%", "higher"),
            _Row("ranges/*/pq", "vpq *", "%", "higher"),
            _Row("min_ade", "min_ade", "m"),
            _Row("min_fde", "min_fde", "m"),
            _Row("miss_rate", "miss_rate", "share"),
        ),
        "accident": (
            _Row("apa", "apa", "share", "higher"),
            _Row("precision", "precision", "share", "higher"),
            _Row("recall", "recall", "share", "higher"),
            _Row("false_alarm_rate", "false_alarm_rate", "share"),
            _Row("average_precision", "average_precision", "share", "higher"),
            _Row("within/*/accuracy", "accuracy@*", "share", "higher"),
            _Row("id_error", "id_error", "share"),
            _Row("position_error", "position_error", "m"),
            _Row("time_error", "time_error", "s"),
            _Row("lateness", "lateness", "s", "neither"),
        ),
        "detection": (
            _Row("mean_average_precision", "mAP", "%", "higher"),
            _Row("mean_errors/ATE", "mATE", "m"),
            _Row("mean_errors/ASE", "mASE", "1 - overlap"),
            _Row("mean_errors/AOE", "mAOE", "rad"),
            _Row("mean_errors/AVE", "mAVE", "m/s"),
            _Row("class_average_precision/*", "AP *", "%", "higher"),
        ),
        "warning": (
            _Row("groups/*/auc_ahead", "auc_ahead *", "share", "higher"),
            _Row("groups/*/twin_wins", "twin_wins *", "share", "higher"),
            _Row("groups/*/average_precision", "AP *", "share", "higher"),
            _Row("groups/*/operating/precision", "precision *", "share", "higher"),
            _Row("groups/*/operating/time_in_alarm", "time_in_alarm *", "share"),
            _Row("groups/*/operating/recall", "recall *", "share", "higher"),
            _Row("groups/*/operating/tta0", "tta0 *", "s", "higher"),
            _Row("figures/*/average_precision", "AP *", "share", "higher"),
            _Row("figures/*/mean_time", "mTTA *", "s", "higher"),
            _Row("figures/*/time_at_r80", "TTA@R80 *", "s", "higher"),
        ),
    }
)
HEADLINE_UNITS: Final[Mapping[str, Unit]] = MappingProxyType(
    {row.path: row.unit for rows in _ROWS.values() for row in rows}
)
"""Path of a headline, `*` for any key → its unit."""


class TaskResult(FrozenMappings):
    """Base of the results of a task's evaluators: its text, and what a notebook shows, are its headlines."""

    __slots__ = ()

    task: ClassVar[str]
    samples: int

    def __repr__(self) -> str:
        """How many samples, and the first headlines."""
        found = headlines(self.task, self)
        shown = [f"{each.name} {each.text()}" for each in found[:_SHOWN]]
        return f"{type(self).__name__}({self.samples:,} samples: {', '.join(shown)}{', …' * (len(found) > _SHOWN)})"

    def _repr_html_(self) -> str:
        rows = [(each.name, each.text()) for each in headlines(self.task, self)]
        return table_html([("number", "value"), *rows], f"{type(self).__name__}, {self.samples:,} samples")


def headlines(task: str, result: object) -> tuple[Headline, ...]:
    """The headline numbers of a result, the most important first.

    Args:
        task: `motion`, `accident`, `detection` or `warning`.
        result: of that task's evaluator.

    Returns:
        Those that this result has: a protocol without a number (the released accidents have no precision) has no such
        headline either.

    Raises:
        ChoiceError: no such task.
    """
    task = choice("task", task, _ROWS)
    return tuple(
        Headline(
            name=row.name.replace("*", key),
            value=known(value),
            unit=row.unit,
            higher_is_better=_HIGHER_IS_BETTER[row.better],
            path=row.path.replace("*", key),
        )
        for row in _ROWS[task]
        for key, value in _found(result, row.path)
    )


def value_text(value: float | None, unit: Unit, *, signed: bool = False) -> str:
    """A number with its unit, for people: `41.20 %`, `0.875`, `1.300 m`; `–` for none.

    With `signed` it is a change: `+1.300 m`, and `+0.54` of percents, in percentage points.
    """
    if value is None:
        return "–"
    number = f"{value:{'+' if signed else ''}.{2 if unit == '%' else 3}f}"
    return number if unit in ("share", "1 - overlap") or (signed and unit == "%") else f"{number} {unit}"


def _found(result: object, path: str) -> Iterator[tuple[str, Any]]:
    """Keys that stand for the `*` (an empty one without) and the values there."""
    head, _, rest = path.partition("/")
    if isinstance(result, Mapping):
        for name, each in result.items():
            text = f"{name:g}" if isinstance(name, float) else str(name)
            if head in ("*", text):
                yield from ((text, value) for _, value in (_found(each, rest) if rest else [("", each)]))
    elif hasattr(result, head):
        value = getattr(result, head)
        yield from _found(value, rest) if rest else [("", value)]


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
    there = alone[np.isfinite(alone)]
    least = there.min(initial=0.0)
    return (0.0, 1.0 if there.max(initial=0.0) <= 1 else math.inf) if least >= 0 else (-math.inf, math.inf)


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
