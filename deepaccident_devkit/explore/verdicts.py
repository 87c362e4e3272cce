"""What a bundle says of a sample, in words: from its row of `samples.parquet`."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from typing import Any, Final

from deepaccident_devkit.evaluation.metrics.accident.scoring import AccidentsWithin
from deepaccident_devkit.explore.evaluations import finite
from deepaccident_devkit.pages import scalar
from deepaccident_devkit.render.outcomes.accident import count_words

Row = Mapping[str, Any]
_WHICH: Final = ("token", "scenario", "agent", "frame", "time_to_impact", "accident_visibility", "recording")
"""Columns that say which sample it is."""
_NUMBER: Final = r"[0-9]+(?:\.[0-9]+)?"
_CASES: Final = ("tp", "fp", "fn")
_ERRORS: Final = {"position_error": "places {:.1f} m off in sum", "time_error": "time {:.1f} s off"}
"""Column → what is said of it."""


def verdict(task: str, row: Row, *, whole: bool = False) -> str:
    """A sample's verdict: `FN`, or `TP, places 1.2 m off in sum, time 0.1 s off`.

    Args:
        task: of the evaluation.
        row: of the sample; its values may be anything.
        whole: whether at all distances, ranges and thresholds; if not, at the widest, and at the middle threshold.
    """
    return _WORDS[task](row, whole=whole)


def other_values(row: Row) -> dict[str, str]:
    """What the row has except which sample it is: name → text."""
    return {name.replace("_", " "): scalar(value) for name, value in row.items() if name not in _WHICH}


def _accident(row: Row, *, whole: bool) -> str:
    distances = _named(row, rf"tp_({_NUMBER})m")
    words = [f"{each} m: {_cases(row, each)}" for each in distances] if whole else []
    words = words or [_cases(row, each) for each in distances[-1:]]
    for name, said in _ERRORS.items():
        value = finite(row.get(name))
        words += [] if value is None else [said.format(value)]
    return ", ".join([*words, *["names others"] * bool(finite(row.get("id_error")))])


def _cases(row: Row, distance: str) -> str:
    tp, fp, fn = (_count(row, f"{case}_{distance}m") for case in _CASES)
    unknown: dict[str, Any] = {"id_error": None, "position_error": None, "time_error": None}
    within = AccidentsWithin(distance=float(distance), tp=tp, fp=fp, fn=fn, accuracy=math.nan, **unknown)
    return count_words(within)


def _motion(row: Row, *, whole: bool) -> str:
    ranges = _named(row, rf"pq_({_NUMBER}x{_NUMBER})")
    return "; ".join(_instances(row, each) for each in (ranges if whole else ranges[-1:]))


def _instances(row: Row, around: str) -> str:
    shares = [f"{name} {_percent(row.get(f'{name.lower()}_{around}'))}" for name in ("PQ", "IoU")]
    counts = [f"{_count(row, f'{case}_{around}')} {case.upper()}" for case in _CASES]
    return f"{around} m: {', '.join([*shares, *counts])}"


def _detection(row: Row, *, whole: bool) -> str:
    thresholds = _named(row, rf"tp_({_NUMBER})")
    shown = thresholds if whole else thresholds[len(thresholds) // 2 :][:1]
    found = [f"{_count(row, f'tp_{each}')} TP at {each}" for each in shown]
    return ", ".join([f"{_count(row, 'truths')} true boxes", f"{_count(row, 'detections')} detections", *found])


def _warning(row: Row, **_: bool) -> str:
    return ", ".join(f"{name} {text}" for name, text in other_values(row).items())


_WORDS: Final[Mapping[str, Callable[..., str]]] = {
    "accident": _accident,
    "motion": _motion,
    "detection": _detection,
    "warning": _warning,
}


def _named(row: Row, pattern: str) -> list[str]:
    """The parts of columns' names that a pattern finds, from the smallest number on."""
    found = [match[1] for name in row if (match := re.fullmatch(pattern, name))]
    return sorted(found, key=lambda text: float(text.partition("x")[0]))


def _count(row: Row, name: str) -> int:
    value = finite(row.get(name))
    return 0 if value is None else int(value)


def _percent(value: object) -> str:
    known = finite(value)
    return "–" if known is None else f"{known:.1f} %"
