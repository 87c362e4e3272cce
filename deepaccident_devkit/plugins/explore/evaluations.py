"""The numbers in a bundle's summary, which are checked before pages show them.

They are facts, headline numbers and breakdowns.
"""

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import msgspec

from deepaccident_devkit.errors import ResultsError
from deepaccident_devkit.evaluation.accident.scoring import AccidentsWithin, count_words
from deepaccident_devkit.evaluation.breakdowns import ATTRIBUTES, EVERYTHING
from deepaccident_devkit.evaluation.runs import Bundle
from deepaccident_devkit.evaluation.runs.bundles import SUMMARY_FILE, Line
from deepaccident_devkit.evaluation.runs.setups import evaluator_class
from deepaccident_devkit.evaluation.task import LIMITS, value_text
from deepaccident_devkit.plugins.explore.scenarios import UNKNOWN_VALUE
from deepaccident_devkit.support.human_names import column_name, human_name
from deepaccident_devkit.support.json_text import as_record
from deepaccident_devkit.support.pages import result_text, scalar
from deepaccident_devkit.support.text import counted

# Fields of the results' metadata that are shown if present.
_METHOD_FIELDS = ("method", "name", "authors", "url", "date")
_Json = Mapping[str, Any]
_Interval = tuple[float, float]
_Row = Mapping[str, Any]
# Columns that identify the sample.
_SAMPLE_COLUMNS = (
    "token",
    "scenario",
    "agent",
    "frame",
    "time_to_impact",
    "accident_visibility",
    "recording",
)
# Number of values in the verdict of a task without words of its own.
_NUM_VALUES = 6
_NUMBER = r"[0-9]+(?:\.[0-9]+)?"
_CASES = ("tp", "fp", "fn")
# Text about the error in each column.
_ERROR_TEXTS = {
    "position_error": "position error {:.1f} m",
    "time_error": "time error {:.1f} s",
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
    """The parts of a summary that pages show and that `read_bundle` has not checked."""

    devkit_version: Line
    counts: _SampleCounts
    results: _Results
    headlines: list[_Headline]
    breakdowns: dict[str, _Breakdown]


@dataclass(frozen=True, slots=True, kw_only=True)
class MainNumber:
    """The number by which samples are ranked.

    Attributes:
        name: Name of the number, such as `apa`.
        path: Path of the number in the result.
        unit: Unit of the number, such as `share`.
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
        facts: Texts about what was evaluated and how, by name.
        mark: Text that marks a partial evaluation; empty for a complete one.
        headlines: Headline numbers over all samples, each with `name`, `text`, `interval` (empty if
            there is none) and `better` (`higher`, `lower` or empty).
        interval: Heading of the intervals, such as `95 % interval`.
        notes: Notes on the intervals.
        main: Number that the bars show; None if the result has none.
        breakdowns: Bars (see `_make_bar`) of each attribute that has several values, by attribute.
        common: Value of each attribute that is the same for all samples, by attribute.
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
    """Read the numbers of a bundle; raise ResultsError if its summary does not contain them."""
    summary = bundle.summary
    try:
        as_record(summary, _Summary)
    except ValueError as error:
        raise ResultsError(
            f"{bundle.folder / SUMMARY_FILE}: cannot be shown ({error}); evaluate again"
        ) from error
    overall = summary["breakdowns"].get(EVERYTHING)
    group = None
    interval = "interval"
    if overall is not None:
        group = next(iter(overall["groups"]), None)
        interval = f"{100 * overall['resampling']['confidence']:g} % interval"
    main = _choose_main_number(summary)
    breakdowns: dict[str, tuple[dict[str, Any], ...]] = {}
    common: dict[str, str] = {}
    for attribute, breakdown in summary["breakdowns"].items():
        if attribute in ATTRIBUTES and attribute != EVERYTHING:
            bars = tuple(_make_bar(bar_group, main) for bar_group in breakdown["groups"])
            if len(bars) > 1:
                breakdowns[attribute] = bars
            elif bars:
                common[attribute] = bars[0]["value"]
    return EvaluationNumbers(
        facts=_collect_facts(bundle),
        mark="" if summary["partial"] is None else summary["partial"]["mark"],
        headlines=tuple(_make_headline_row(headline, group) for headline in summary["headlines"]),
        interval=interval,
        notes=() if group is None else tuple(group["notes"]),
        main=main,
        breakdowns=breakdowns,
        common=common,
    )


def _collect_facts(bundle: Bundle) -> dict[str, str]:
    summary = bundle.summary
    setup = bundle.setup
    counts = summary["counts"]
    results = summary["results"]
    release = summary["release"]
    switches = [f"{name}={value!r}" for name, value in setup.switches.items()]
    protocol = human_name(setup.protocol, "protocols")
    if switches:
        protocol = f"{protocol}, but {', '.join(switches)}"
    facts = {"task": human_name(setup.task, "tasks"), "protocol": protocol}
    for name in _METHOD_FIELDS:
        if name in results["meta"]:
            facts[name] = scalar(results["meta"][name])
    samples = f"{counts['samples']:,} from {counted(counts['scenarios'], 'scenario')}"
    if counts["left_out"]:
        samples += f"; left out: {counted(counts['left_out'], 'prediction')} for other samples"
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


def _choose_main_number(summary: _Json) -> MainNumber | None:
    """Return the first of the task's main numbers that the result has; None if it has none."""
    headlines = {headline["path"]: headline for headline in summary["headlines"]}
    for path in evaluator_class(summary["task"]).main_numbers:
        if path in headlines:
            headline = headlines[path]
            unit: Any = headline["unit"]
            limit = LIMITS.get(unit, 1.0)
            return MainNumber(name=headline["name"], path=path, unit=unit, limit=limit)
    return None


def _make_headline_row(headline: _Json, group: _Json | None) -> dict[str, str]:
    better = ""
    if headline.get("higher_is_better") is True:
        better = "higher"
    elif headline.get("higher_is_better") is False:
        better = "lower"
    ends = _read_interval(group, headline["path"])
    return {
        "name": headline["name"],
        "text": headline["text"],
        "interval": _format_interval(ends, headline["unit"]),
        "better": better,
    }


def _make_bar(group: _Json, main: MainNumber | None) -> dict[str, Any]:
    """Make the bar for the samples that have one value of an attribute.

    The bar has that `value`, the numbers of `samples` and `scenarios`, and `text` and `interval`
    for readers. Its `width` and the `ends` of its interval are percentages of the longest possible
    bar, or None if there is no number.
    """
    text = "–"
    interval = ""
    width = None
    end_percents = None
    if main is not None:
        value = read_finite(group["headlines"].get(main.path))
        ends = _read_interval(group, main.path)
        text = value_text(value, main.unit)
        interval = _format_interval(ends, main.unit)
        if value is not None:
            width = _scale_to_percent(value, main.limit)
        if ends is not None:
            end_percents = [_scale_to_percent(end, main.limit) for end in ends]
    return {
        "value": UNKNOWN_VALUE if group["value"] is None else group["value"],
        "samples": group["samples"],
        "scenarios": group["scenarios"],
        "text": text,
        "interval": interval,
        "width": width,
        "ends": end_percents,
    }


def _scale_to_percent(value: float, limit: float) -> float:
    share = min(max(value / limit, 0.0), 1.0)
    return round(100 * share, 2)


def _read_interval(group: _Json | None, path: str) -> _Interval | None:
    """Return both ends of the interval at a path; None if there is none."""
    if group is None:
        return None
    ends = [read_finite(value) for value in group["intervals"].get(path, ())]
    if len(ends) != 2:
        return None
    low, high = ends
    if low is None or high is None:
        return None
    return low, high


def _format_interval(ends: _Interval | None, unit: str) -> str:
    if ends is None:
        return ""
    low, high = ends
    digits = 2 if unit == "%" else 3
    return f"{low:.{digits}f} to {high:.{digits}f}"


def read_finite(value: object) -> float | None:
    """Convert a value from a file to a float; return None if it is not a finite number."""
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
    """Describe the verdict on a sample: `FN`, or `TP, position error 1.2 m, time error 0.1 s`.

    The row comes from a file, so its values are not trusted. With `in_full`, the verdict covers all
    distances, ranges and thresholds; otherwise only the widest ones and the middle threshold.
    """
    describe = _VERDICT_FUNCTIONS.get(task, _format_values)
    return describe(row, in_full=in_full)


def list_other_values(row: _Row) -> dict[str, str]:
    """Return the texts, by column name, of the columns that do not identify the sample."""
    texts = {}
    for name, value in row.items():
        if name not in _SAMPLE_COLUMNS:
            texts[column_name(name)] = scalar(value)
    return texts


def _format_accident(row: _Row, *, in_full: bool) -> str:
    distances = _find_name_parts(row, rf"tp_({_NUMBER})m")
    if in_full:
        texts = [f"{distance} m: {_format_cases(row, distance)}" for distance in distances]
    else:
        texts = [_format_cases(row, distance) for distance in distances[-1:]]
    for name, template in _ERROR_TEXTS.items():
        value = read_finite(row.get(name))
        if value is not None:
            texts.append(template.format(value))
    if read_finite(row.get("id_error")):
        texts.append("wrong actors")
    return ", ".join(texts)


def _format_cases(row: _Row, distance: str) -> str:
    counts = {case: _read_count(row, f"{case}_{distance}m") for case in _CASES}
    unknown: dict[str, Any] = {"id_error": None, "position_error": None, "time_error": None}
    outcome = AccidentsWithin(distance=float(distance), accuracy=math.nan, **counts, **unknown)
    return count_words(outcome)


def _format_motion(row: _Row, *, in_full: bool) -> str:
    ranges = _find_name_parts(row, rf"pq_({_NUMBER}x{_NUMBER})")
    if not in_full:
        ranges = ranges[-1:]
    texts = [_format_range(row, range_name) for range_name in ranges]
    return "; ".join(texts)


def _format_range(row: _Row, range_name: str) -> str:
    texts = [
        f"VPQ {_format_percent(row.get(f'pq_{range_name}'))}",
        f"IoU {_format_percent(row.get(f'iou_{range_name}'))}",
    ]
    for case in _CASES:
        count = _read_count(row, f"{case}_{range_name}")
        texts.append(f"{count} {case.upper()}")
    return f"{human_name(range_name)}: {', '.join(texts)}"


def _format_detection(row: _Row, *, in_full: bool) -> str:
    thresholds = _find_name_parts(row, rf"tp_({_NUMBER})")
    if not in_full:
        middle = len(thresholds) // 2
        thresholds = thresholds[middle : middle + 1]
    texts = [
        f"{_read_count(row, 'truths')} true boxes",
        f"{_read_count(row, 'detections')} detections",
    ]
    for threshold in thresholds:
        count = _read_count(row, f"tp_{threshold}")
        texts.append(f"{count} TP at {threshold}")
    return ", ".join(texts)


def _format_values(row: _Row, **_: bool) -> str:
    texts = []
    for name, value in row.items():
        if name in _SAMPLE_COLUMNS or value is None:
            continue
        number = read_finite(value)
        text = scalar(value) if number is None else result_text(number)
        texts.append(f"{column_name(name)} {text}")
    return ", ".join(texts[:_NUM_VALUES]) or "no numbers"


# Verdicts that are shorter than all values of a row.
_VERDICT_FUNCTIONS: Mapping[str, Callable[..., str]] = {
    "accident": _format_accident,
    "motion": _format_motion,
    "detection": _format_detection,
}


def _find_name_parts(row: _Row, pattern: str) -> list[str]:
    """Return what a pattern captures in the columns' names, sorted by the numbers in it."""
    parts = []
    for name in row:
        match = re.fullmatch(pattern, name)
        if match is not None:
            parts.append(match[1])
    parts.sort(key=lambda part: float(part.partition("x")[0]))
    return parts


def _read_count(row: _Row, name: str) -> int:
    value = read_finite(row.get(name))
    if value is None:
        return 0
    return int(value)


def _format_percent(value: object) -> str:
    number = read_finite(value)
    if number is None:
        return "–"
    return f"{number:.1f} %"
