"""The numbers of a bundle's summary for pages, checked before they are shown.

These are facts, headline numbers and breakdowns.
"""

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

# Metadata of results that is shown if present.
_METHOD_FIELDS: Final = ("method", "name", "authors", "url", "date")
_Json = Mapping[str, Any]
_Interval = tuple[float, float]
_Row = Mapping[str, Any]
# Columns that identify the sample.
_SAMPLE_COLUMNS: Final = (
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
# Column → text of the error.
_ERROR_TEXTS: Final = {
    "position_error": "places {:.1f} m off in sum",
    "time_error": "time {:.1f} s off",
}


class _SampleCounts(msgspec.Struct):
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


class _Group(_SampleCounts):
    value: Line | None
    headlines: dict[str, float | None]
    intervals: dict[str, list[float | None]]
    notes: list[Line]


class _Breakdown(msgspec.Struct):
    resampling: _Resampling
    groups: list[_Group]


class _Summary(msgspec.Struct):
    """The parts of a summary that are shown, beyond what `read_bundle` has checked."""

    devkit_version: Line
    counts: _SampleCounts
    results: _Results
    headlines: list[_Headline]
    breakdowns: dict[str, _Breakdown]


@dataclass(frozen=True, slots=True, kw_only=True)
class MainNumber:
    """The number by which samples are ranked.

    Attributes:
        name: Name, such as `apa`.
        path: Path in the result.
        unit: Unit, such as `share`.
        limit: Largest possible value.
    """

    name: str
    path: str
    unit: Any
    limit: float


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluationNumbers:
    """The numbers of a bundle.

    Attributes:
        facts: Name → what was evaluated, and how.
        mark: Mark of a partial evaluation; empty for a complete one.
        headlines: Headlines of all samples: `name`, `text`, `interval` (empty if there is none),
            `better` (`higher`, `lower` or empty).
        interval: Heading of the intervals: `95 % interval`.
        notes: Notes on the intervals.
        main: Number that the bars show; None if the result has none.
        breakdowns: Attribute → a bar for each of several values, as `_bar` describes it.
        common: Attribute → the only value that the samples have.
    """

    facts: Mapping[str, str]
    mark: str
    headlines: tuple[dict[str, str], ...]
    interval: str
    notes: tuple[str, ...]
    main: MainNumber | None
    breakdowns: Mapping[str, tuple[dict[str, Any], ...]]
    common: Mapping[str, str]


def read_numbers(bundle: Bundle) -> EvaluationNumbers:
    """Return a bundle's numbers; raise ResultsError if its summary does not hold them."""
    summary = bundle.summary
    try:
        as_record(summary, _Summary)
    except ValueError as error:
        raise ResultsError(
            f"{bundle.folder / SUMMARY_FILE}: cannot be shown ({error}); evaluate again"
        ) from error
    overall = summary["breakdowns"].get(EVERYTHING)
    group, interval = None, "interval"
    if overall is not None:
        group = next(iter(overall["groups"]), None)
        interval = f"{100 * overall['resampling']['confidence']:g} % interval"
    main = _main_number(summary)
    breakdowns: dict[str, tuple[dict[str, Any], ...]] = {}
    common: dict[str, str] = {}
    for attribute, breakdown in summary["breakdowns"].items():
        if attribute in ATTRIBUTES and attribute != EVERYTHING:
            bars = tuple(_bar(bar_group, main) for bar_group in breakdown["groups"])
            if len(bars) > 1:
                breakdowns[attribute] = bars
            elif bars:
                common[attribute] = bars[0]["value"]
    return EvaluationNumbers(
        facts=_facts(bundle),
        mark="" if summary["partial"] is None else summary["partial"]["mark"],
        headlines=tuple(_headline_row(headline, group) for headline in summary["headlines"]),
        interval=interval,
        notes=() if group is None else tuple(group["notes"]),
        main=main,
        breakdowns=breakdowns,
        common=common,
    )


def _facts(bundle: Bundle) -> dict[str, str]:
    summary, setup = bundle.summary, bundle.setup
    counts, results, release = summary["counts"], summary["results"], summary["release"]
    switches = ", ".join(f"{name} = {scalar(value)}" for name, value in setup.switches.items())
    protocol = f"{setup.protocol}, but {switches}" if switches else setup.protocol
    facts = {"task": setup.task, "protocol": protocol}
    for name in _METHOD_FIELDS:
        if name in results["meta"]:
            facts[name] = scalar(results["meta"][name])
    samples = f"{counts['samples']:,} of {counts['scenarios']:,} scenarios"
    if counts["left_out"]:
        samples += f"; {counts['left_out']:,} predictions of other samples left out"
    facts |= {"samples": samples, "selection": bundle.selection.text()}
    if evaluator_class(setup.task).has_horizon:
        facts["horizon"] = f"{setup.horizon:g} s"
    return {
        **facts,
        "results": results["path"],
        "results' hash": results["fingerprint"],
        "release": f"{release['version']}, {release['dataroot']}",
        "devkit": summary["devkit_version"],
    }


def _main_number(summary: _Json) -> MainNumber | None:
    """Return the first of the task's main numbers that the result has."""
    headlines = {headline["path"]: headline for headline in summary["headlines"]}
    for path in evaluator_class(summary["task"]).main_numbers:
        if path in headlines:
            headline = headlines[path]
            unit: Any = headline["unit"]
            limit = LIMITS.get(unit, 1.0)
            return MainNumber(name=headline["name"], path=path, unit=unit, limit=limit)
    return None


def _headline_row(headline: _Json, group: _Json | None) -> dict[str, str]:
    better = ""
    if headline.get("higher_is_better") is True:
        better = "higher"
    elif headline.get("higher_is_better") is False:
        better = "lower"
    ends = _interval_ends(group, headline["path"])
    return {
        "name": headline["name"],
        "text": headline["text"],
        "interval": _interval_text(ends, headline["unit"]),
        "better": better,
    }


def _bar(group: _Json, main: MainNumber | None) -> dict[str, Any]:
    """Return the main number of the samples that have one `value` of an attribute.

    `samples` and `scenarios` count them, `text` and `interval` are for readers; `width` of the bar
    and both `ends` of the interval are percents of the longest bar, None where there is no number.
    """
    text, interval, width, end_percents = "–", "", None, None
    if main is not None:
        value = finite(group["headlines"].get(main.path))
        ends = _interval_ends(group, main.path)
        text, interval = value_text(value, main.unit), _interval_text(ends, main.unit)
        if value is not None:
            width = _percents([value], main.limit)[0]
        if ends is not None:
            end_percents = _percents(ends, main.limit)
    return {
        "value": UNKNOWN_VALUE if group["value"] is None else group["value"],
        "samples": group["samples"],
        "scenarios": group["scenarios"],
        "text": text,
        "interval": interval,
        "width": width,
        "ends": end_percents,
    }


def _percents(values: Iterable[float], limit: float) -> list[float]:
    return [round(100 * min(max(value / limit, 0.0), 1.0), 2) for value in values]


def _interval_ends(group: _Json | None, path: str) -> _Interval | None:
    """Return both ends of an interval; None if there is none."""
    if group is None:
        return None
    ends = [finite(value) for value in group["intervals"].get(path, ())]
    if len(ends) != 2 or ends[0] is None or ends[1] is None:
        return None
    return ends[0], ends[1]


def _interval_text(ends: _Interval | None, unit: str) -> str:
    digits = 2 if unit == "%" else 3
    if ends is None:
        return ""
    return f"{ends[0]:.{digits}f} to {ends[1]:.{digits}f}"


def finite(value: object) -> float | None:
    """Return a number of a file as a float; None if it is no finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    if math.isfinite(number):
        return number
    return None


def verdict_text(task: str, row: _Row, *, in_full: bool = False) -> str:
    """Return a sample's verdict: `FN`, or `TP, places 1.2 m off in sum, time 0.1 s off`.

    The values of the row may be anything. With `in_full` it covers all distances, ranges and
    thresholds; without it only the widest, and the middle threshold.
    """
    return _VERDICT_FUNCTIONS[task](row, in_full=in_full)


def other_values(row: _Row) -> dict[str, str]:
    """Return the columns that do not identify the sample: name → text."""
    return {
        name.replace("_", " "): scalar(value)
        for name, value in row.items()
        if name not in _SAMPLE_COLUMNS
    }


def _accident(row: _Row, *, in_full: bool) -> str:
    distances = _named_parts(row, rf"tp_({_NUMBER})m")
    if in_full and distances:
        texts = [f"{distance} m: {_cases(row, distance)}" for distance in distances]
    else:
        texts = [_cases(row, distance) for distance in distances[-1:]]
    for name, template in _ERROR_TEXTS.items():
        value = finite(row.get(name))
        if value is not None:
            texts.append(template.format(value))
    if finite(row.get("id_error")):
        texts.append("names others")
    return ", ".join(texts)


def _cases(row: _Row, distance: str) -> str:
    tp, fp, fn = (_count(row, f"{case}_{distance}m") for case in _CASES)
    unknown: dict[str, Any] = {"id_error": None, "position_error": None, "time_error": None}
    outcome = AccidentsWithin(
        distance=float(distance), tp=tp, fp=fp, fn=fn, accuracy=math.nan, **unknown
    )
    return count_words(outcome)


def _motion(row: _Row, *, in_full: bool) -> str:
    ranges = _named_parts(row, rf"pq_({_NUMBER}x{_NUMBER})")
    if not in_full:
        ranges = ranges[-1:]
    return "; ".join(_range_text(row, range_name) for range_name in ranges)


def _range_text(row: _Row, range_name: str) -> str:
    texts = []
    for title, key in (("VPQ", "pq"), ("IoU", "iou")):
        texts.append(f"{title} {_percent(row.get(f'{key}_{range_name}'))}")
    for case in _CASES:
        texts.append(f"{_count(row, f'{case}_{range_name}')} {case.upper()}")
    return f"{range_name} m: {', '.join(texts)}"


def _detection(row: _Row, *, in_full: bool) -> str:
    thresholds = _named_parts(row, rf"tp_({_NUMBER})")
    if not in_full:
        thresholds = thresholds[len(thresholds) // 2 :][:1]
    texts = [
        f"{_count(row, 'truths')} true boxes",
        f"{_count(row, 'detections')} detections",
    ]
    for threshold in thresholds:
        texts.append(f"{_count(row, f'tp_{threshold}')} TP at {threshold}")
    return ", ".join(texts)


def _values(row: _Row, **_: bool) -> str:
    return ", ".join(f"{name} {text}" for name, text in other_values(row).items())


_VERDICT_FUNCTIONS: Final[Mapping[str, Callable[..., str]]] = {
    "accident": _accident,
    "motion": _motion,
    "detection": _detection,
    **dict.fromkeys(("warning", "planning", "forecasting"), _values),
}


def _named_parts(row: _Row, pattern: str) -> list[str]:
    """Return the parts of columns' names that a pattern captures, from the smallest number on."""
    matches = [re.fullmatch(pattern, name) for name in row]
    parts = [match[1] for match in matches if match is not None]
    return sorted(parts, key=lambda text: float(text.partition("x")[0]))


def _count(row: _Row, name: str) -> int:
    value = finite(row.get(name))
    if value is None:
        return 0
    return int(value)


def _percent(value: object) -> str:
    number = finite(value)
    if number is None:
        return "–"
    return f"{number:.1f} %"
