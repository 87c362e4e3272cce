"""What a bundle's summary says, for pages: facts, headline numbers and breakdowns, checked before they are shown."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import msgspec

from deepaccident_devkit.errors import ResultsError
from deepaccident_devkit.evaluation.accident.scoring import AccidentsWithin
from deepaccident_devkit.evaluation.breakdowns import ATTRIBUTES, EVERYTHING
from deepaccident_devkit.evaluation.runs import Bundle
from deepaccident_devkit.evaluation.runs.bundles import SUMMARY_FILE, Line
from deepaccident_devkit.evaluation.runs.setups import evaluator_class
from deepaccident_devkit.evaluation.task import LIMITS, value_text
from deepaccident_devkit.plugins.explore.scenarios import UNKNOWN_VALUE
from deepaccident_devkit.render.outcomes.above import count_words
from deepaccident_devkit.support.json_text import as_record
from deepaccident_devkit.support.pages import scalar

# What results say of themselves, and is shown if they do.
_METHOD: Final = ("method", "name", "authors", "url", "date")
_Json = Mapping[str, Any]
_Interval = tuple[float, float]
_Row = Mapping[str, Any]
# Columns that say which sample it is.
_WHICH: Final = (
    "token",
    "scenario",
    "agent",
    "frame",
    "time_to_impact",
    "accident_visibility",
    "recording",
)
_NUMBER: Final = r"[0-9]+(?:\.[0-9]+)?"
_CASES: Final = ("tp", "fp", "fn")
# Column → what is said of it.
_ERRORS: Final = {"position_error": "places {:.1f} m off in sum", "time_error": "time {:.1f} s off"}


class _Counted(msgspec.Struct):
    samples: int
    scenarios: int


class _Results(msgspec.Struct):
    fingerprint: Line
    meta: dict[str, Any]


class _Headline(msgspec.Struct):
    name: Line
    text: Line
    path: Line
    unit: Line


class _Resampling(msgspec.Struct):
    confidence: float


class _Group(_Counted):
    value: Line | None
    headlines: dict[str, float | None]
    intervals: dict[str, list[float | None]]
    notes: list[Line]


class _Breakdown(msgspec.Struct):
    resampling: _Resampling
    groups: list[_Group]


class _Shown(msgspec.Struct):
    """Of a summary what is shown beyond what `read_bundle` has checked."""

    devkit_version: Line
    counts: _Counted
    results: _Results
    headlines: list[_Headline]
    breakdowns: dict[str, _Breakdown]


@dataclass(frozen=True, slots=True, kw_only=True)
class MainNumber:
    """The number by which samples are ranked.

    Attributes:
        name: such as `apa`.
        path: in the result.
        unit: such as `share`.
        limit: the largest value that it can have.
    """

    name: str
    path: str
    unit: Any
    limit: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Evaluated:
    """A bundle's numbers.

    Attributes:
        facts: name → what was evaluated, and how.
        mark: that it is partial; empty if it is not.
        headlines: of all samples: `name`, `text`, `interval` (empty if there is none), `better` (`higher`, `lower` or
            empty).
        interval: heading of the intervals: `95 % interval`.
        notes: on the intervals.
        main: the number that the bars show; None if the result has none.
        breakdowns: attribute → a bar for each of several values, as `_bar` describes it.
        same: attribute → the only value that the samples have.
    """

    facts: Mapping[str, str]
    mark: str
    headlines: tuple[dict[str, str], ...]
    interval: str
    notes: tuple[str, ...]
    main: MainNumber | None
    breakdowns: Mapping[str, tuple[dict[str, Any], ...]]
    same: Mapping[str, str]


def evaluated(bundle: Bundle) -> Evaluated:
    """A bundle's numbers; raises ResultsError if its summary does not hold them."""
    summary = bundle.summary
    try:
        as_record(summary, _Shown)
    except ValueError as error:
        raise ResultsError(
            f"{bundle.folder / SUMMARY_FILE}: cannot be shown ({error}); evaluate again"
        ) from error
    everything = summary["breakdowns"].get(EVERYTHING)
    group = next(iter(everything["groups"]), None) if everything is not None else None
    main = _main_number(summary)
    bars = {
        by: tuple(_bar(each, main) for each in broken["groups"])
        for by, broken in summary["breakdowns"].items()
        if by in ATTRIBUTES and by != EVERYTHING
    }
    return Evaluated(
        facts=_facts(bundle),
        mark="" if summary["partial"] is None else summary["partial"]["mark"],
        headlines=tuple(_headline_row(each, group) for each in summary["headlines"]),
        interval="interval"
        if everything is None
        else f"{100 * everything['resampling']['confidence']:g} % interval",
        notes=() if group is None else tuple(group["notes"]),
        main=main,
        breakdowns={by: each for by, each in bars.items() if len(each) > 1},
        same={by: each[0]["value"] for by, each in bars.items() if len(each) == 1},
    )


def _facts(bundle: Bundle) -> dict[str, str]:
    summary, setup = bundle.summary, bundle.setup
    changed = ", ".join(f"{name} = {scalar(value)}" for name, value in setup.switches.items())
    counts, results, release = summary["counts"], summary["results"], summary["release"]
    left_out = (
        f"; {counts['left_out']:,} predictions of other samples left out"
        if counts["left_out"]
        else ""
    )
    return {
        "task": setup.task,
        "protocol": setup.protocol + (f", but {changed}" if changed else ""),
        **{name: scalar(results["meta"][name]) for name in _METHOD if name in results["meta"]},
        "samples": f"{counts['samples']:,} of {counts['scenarios']:,} scenarios{left_out}",
        "selection": bundle.selection.text(),
        **({"horizon": f"{setup.horizon:g} s"} if evaluator_class(setup.task).has_horizon else {}),
        "results": results["path"],
        "results' hash": results["fingerprint"],
        "release": f"{release['version']}, {release['dataroot']}",
        "devkit": summary["devkit_version"],
    }


def _main_number(summary: _Json) -> MainNumber | None:
    """The first of the task's main numbers that the result has."""
    there = {each["path"]: each for each in summary["headlines"]}
    path = next(
        (path for path in evaluator_class(summary["task"]).main_numbers if path in there), None
    )
    if path is None:
        return None
    unit: Any = there[path]["unit"]
    return MainNumber(name=there[path]["name"], path=path, unit=unit, limit=LIMITS.get(unit, 1.0))


def _headline_row(headline: _Json, group: _Json | None) -> dict[str, str]:
    higher, unit = headline.get("higher_is_better"), headline["unit"]
    better = "higher" if higher is True else "lower" if higher is False else ""
    interval = _interval_text(_ends(group, headline["path"]), unit)
    return {
        "name": headline["name"],
        "text": headline["text"],
        "interval": interval,
        "better": better,
    }


def _bar(group: _Json, main: MainNumber | None) -> dict[str, Any]:
    """The main number of the samples that have one `value` of an attribute.

    `samples` and `scenarios` count them, `text` and `interval` are for readers; `width` of the bar and both `ends` of
    the interval are percents of the longest bar, None where there is no number.
    """
    value = None if main is None else finite(group["headlines"].get(main.path))
    ends = None if main is None else _ends(group, main.path)
    return {
        "value": UNKNOWN_VALUE if group["value"] is None else group["value"],
        "samples": group["samples"],
        "scenarios": group["scenarios"],
        "text": "–" if main is None else value_text(value, main.unit),
        "interval": "" if main is None else _interval_text(ends, main.unit),
        "width": None if main is None or value is None else _percents([value], main.limit)[0],
        "ends": None if main is None or ends is None else _percents(ends, main.limit),
    }


def _percents(values: Iterable[float], limit: float) -> list[float]:
    return [round(100 * min(max(each / limit, 0.0), 1.0), 2) for each in values]


def _ends(group: _Json | None, path: str) -> _Interval | None:
    """Both ends of an interval; None if it has none."""
    known = [] if group is None else [finite(each) for each in group["intervals"].get(path, ())]
    if len(known) != 2 or known[0] is None or known[1] is None:
        return None
    return known[0], known[1]


def _interval_text(ends: _Interval | None, unit: str) -> str:
    digits = 2 if unit == "%" else 3
    return "" if ends is None else f"{ends[0]:.{digits}f} to {ends[1]:.{digits}f}"


def finite(value: object) -> float | None:
    """A number of a file as a float; None if it is no finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None


def verdict_text(task: str, row: _Row, *, whole: bool = False) -> str:
    """A sample's verdict: `FN`, or `TP, places 1.2 m off in sum, time 0.1 s off`.

    The values of the row may be anything. The `whole` one is at all distances, ranges and thresholds, else it is at the
    widest, and at the middle threshold.
    """
    return _WORDS[task](row, whole=whole)


def other_values(row: _Row) -> dict[str, str]:
    """What the row has except which sample it is: name → text."""
    return {
        name.replace("_", " "): scalar(value) for name, value in row.items() if name not in _WHICH
    }


def _accident(row: _Row, *, whole: bool) -> str:
    distances = _named(row, rf"tp_({_NUMBER})m")
    words = [f"{each} m: {_cases(row, each)}" for each in distances] if whole else []
    words = words or [_cases(row, each) for each in distances[-1:]]
    for name, said in _ERRORS.items():
        value = finite(row.get(name))
        words += [] if value is None else [said.format(value)]
    return ", ".join([*words, *["names others"] * bool(finite(row.get("id_error")))])


def _cases(row: _Row, distance: str) -> str:
    tp, fp, fn = (_count(row, f"{case}_{distance}m") for case in _CASES)
    unknown: dict[str, Any] = {"id_error": None, "position_error": None, "time_error": None}
    return count_words(
        AccidentsWithin(distance=float(distance), tp=tp, fp=fp, fn=fn, accuracy=math.nan, **unknown)
    )


def _motion(row: _Row, *, whole: bool) -> str:
    ranges = _named(row, rf"pq_({_NUMBER}x{_NUMBER})")
    return "; ".join(_instances(row, each) for each in (ranges if whole else ranges[-1:]))


def _instances(row: _Row, around: str) -> str:
    shares = [
        f"{name} {_percent(row.get(f'{key}_{around}'))}"
        for name, key in (("VPQ", "pq"), ("IoU", "iou"))
    ]
    counts = [f"{_count(row, f'{case}_{around}')} {case.upper()}" for case in _CASES]
    return f"{around} m: {', '.join([*shares, *counts])}"


def _detection(row: _Row, *, whole: bool) -> str:
    thresholds = _named(row, rf"tp_({_NUMBER})")
    shown = thresholds if whole else thresholds[len(thresholds) // 2 :][:1]
    found = [f"{_count(row, f'tp_{each}')} TP at {each}" for each in shown]
    return ", ".join(
        [f"{_count(row, 'truths')} true boxes", f"{_count(row, 'detections')} detections", *found]
    )


def _values(row: _Row, **_: bool) -> str:
    return ", ".join(f"{name} {text}" for name, text in other_values(row).items())


_WORDS: Final[Mapping[str, Callable[..., str]]] = {
    "accident": _accident,
    "motion": _motion,
    "detection": _detection,
    **dict.fromkeys(("warning", "planning", "forecasting"), _values),
}


def _named(row: _Row, pattern: str) -> list[str]:
    """The parts of columns' names that a pattern finds, from the smallest number on."""
    found = [match[1] for name in row if (match := re.fullmatch(pattern, name))]
    return sorted(found, key=lambda text: float(text.partition("x")[0]))


def _count(row: _Row, name: str) -> int:
    value = finite(row.get(name))
    return 0 if value is None else int(value)


def _percent(value: object) -> str:
    known = finite(value)
    return "–" if known is None else f"{known:.1f} %"
