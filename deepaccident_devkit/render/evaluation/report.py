"""`save_report`: one HTML file with the whole evaluation, and its figures as PNG files."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.evaluation.breakdowns import EVERYTHING, Breakdown, Group
from deepaccident_devkit.evaluation.detection import DetectionResult
from deepaccident_devkit.evaluation.intervals import LEAST_CLUSTERS
from deepaccident_devkit.evaluation.results import Results
from deepaccident_devkit.evaluation.runs import EvaluationRun
from deepaccident_devkit.evaluation.runs.further import further_results
from deepaccident_devkit.evaluation.runs.over_bytes import sent_bytes
from deepaccident_devkit.evaluation.runs.sanity import SanityReport
from deepaccident_devkit.evaluation.runs.text import means_tables, predictor_tables, reading_notes
from deepaccident_devkit.evaluation.task import Headline, headlines
from deepaccident_devkit.render.evaluation.figures import (
    RunFigure,
    run_figures,
    sample_figures,
    save_figure,
)
from deepaccident_devkit.render.evaluation.panels import UNKNOWN
from deepaccident_devkit.render.styles import page_style
from deepaccident_devkit.support.files import place_in, writable_folder, write_bytes
from deepaccident_devkit.support.pages import document, result_text, scalar
from deepaccident_devkit.support.reading import read_bytes

_BETTER: Final = {True: "higher", False: "lower", None: ""}
# Field of a result → heading of its table.
_PARTS: Final = {
    "truths": "Actors in the samples' true accidents",
    "within": "By the allowed distance (m)",
    "ranges": "By range",
    "classes": "By class",
    "beside": "With other choices, always reported as well",
}
# What is known of a class without true boxes.
_COUNTED: Final = ("thresholds", "truths", "detections")
# Fields that results give about themselves and that are shown at the top, if there are any.
_SHOWN_META: Final = ("method", "name", "authors", "url", "date")
REPORT_FILE: Final = "report.html"
FIGURES_FOLDER: Final = "figures"


def report_context(run: EvaluationRun) -> dict[str, Any]:
    """All that the template `evaluation_report.html` shows of a run, apart from pictures."""
    told, summary = run.result.as_dict(), run.summary()
    everything = next((each for each in run.breakdowns if each.by == EVERYTHING), None)
    group = everything.groups[0] if everything is not None and everything.groups else None
    percent = "" if everything is None else f"{100 * everything.resampling.confidence:g} % "
    same = {
        each.by: each.groups[0].value or UNKNOWN for each in run.breakdowns if len(each.groups) == 1
    }
    return {
        "title": f"{run.setup.task.capitalize()}, protocol {run.setup.protocol}",
        "partial": "" if run.partial is None else run.partial.text(),
        "header": _header(run, summary),
        "headlines": [
            [each.name, each.text(), _interval_text(each, group), _BETTER[each.higher_is_better]]
            for each in _headlines(run.result)
        ],
        "interval": f"{percent}interval",
        "interval_notes": () if group is None or group.intervals else group.notes,
        "predictors": [*predictor_tables(told), *means_tables(summary).values()],
        "further": {
            each.title.capitalize(): (each.tables(part), [*part["notes"], *part["interval_notes"]])
            for each, part in further_results(summary)
        },
        "whole_numbers": {
            name: result_text(value) for name, value in told.items() if isinstance(value, int)
        },
        "said": [*(told.get("notes") or ()), *reading_notes(summary)],
        "counts": _counts(run.result, told),
        "breakdowns": [_breakdown(each) for each in run.breakdowns if each.by not in same],
        "same": [
            f"{name.replace('_', ' ')} {value}"
            for name, value in same.items()
            if name != EVERYTHING
        ],
        "sanity": None if run.sanity is None else SanityReport(**run.sanity),
        "choices": dict(_choices(run)),
    }


def _header(run: EvaluationRun, summary: Mapping[str, Any]) -> dict[str, str]:
    """What was evaluated, and how."""
    setup = run.setup
    changed = ", ".join(f"{name} = {scalar(value)}" for name, value in setup.switches.items())
    return {
        "task": setup.task,
        "protocol": setup.protocol + (f", but {changed}" if changed else ""),
        **{
            name: scalar(run.results.meta[name]) for name in _SHOWN_META if name in run.results.meta
        },
        "samples": f"{summary['counts']['samples']:,} of {summary['counts']['scenarios']:,} scenarios",
        "selection": run.selection.text(),
        **({"horizon": f"{setup.horizon:g} s"} if run.evaluator.has_horizon else {}),
        "results": run.results.path,
        "results' hash": run.results.fingerprint,
        **({"bytes": sent.text()} if (sent := sent_bytes(summary)) else {}),
        "release": f"{run.release.version}, {run.release.dataroot}",
        "release's hash": run.release.fingerprint,
        "devkit": summary["devkit_version"],
        "made with": ", ".join(
            f"{name} {version}" for name, version in summary["environment"].items()
        ),
    }


def _counts(result: object, told: Mapping[str, Any]) -> dict[str, Any]:
    """Heading → what was counted, as `_columns` gives it."""
    for name in _absent_classes(result):
        row = told["classes"][name]
        row.update({key: None for key in row if key not in _COUNTED})
    return {title: _columns(told[name]) for name, title in _PARTS.items() if told.get(name)}


def _columns(value: Any) -> Any:
    """Pairs as a text of ranges, a mapping of numbers as texts by name, one of mappings as rows with a heading."""
    if not isinstance(value, Mapping):
        return "; ".join(
            f"{low:g} m and more" if high is None else f"{low:g} to {high:g} m"
            for low, high in value
        )
    if not all(isinstance(each, Mapping) for each in value.values()):
        return {str(name): result_text(each) for name, each in value.items()}
    names = list(dict.fromkeys(name for each in value.values() for name in each))
    plain = [
        name
        for name in names
        if not any(isinstance(each.get(name), Mapping) for each in value.values())
    ]
    return [
        ["", *plain],
        *([key, *(result_text(each.get(name)) for name in plain)] for key, each in value.items()),
    ]


def _breakdown(broken: Breakdown[Any]) -> dict[str, Any]:
    """A table for an attribute, and one of only the vehicles if the numbers of samples differ."""
    vehicles = broken.without_infrastructure
    differ = sum(each.samples for each in vehicles) != sum(each.samples for each in broken.groups)
    return {
        "by": broken.by.replace("_", " "),
        "all": _groups(broken, broken.groups, "all agents"),
        "vehicles": _groups(broken, vehicles, "without the roadside") if differ else None,
    }


def _groups(broken: Breakdown[Any], groups: Sequence[Group[Any]], whose: str) -> dict[str, Any]:
    names = list(dict.fromkeys(each.name for group in groups for each in _headlines(group.result)))
    rows = []
    for group in groups:
        known = {
            each.name: (each.text(), _interval_text(each, group))
            for each in _headlines(group.result)
        }
        label = UNKNOWN if group.value is None else group.value
        rows.append(
            [
                label,
                f"{group.samples:,}",
                f"{group.scenarios:,}",
                *(known.get(name, "–") for name in names),
            ]
        )
    how = f"{100 * broken.resampling.confidence:g} % intervals, if there are {LEAST_CLUSTERS} clusters"
    heading = [broken.by.replace("_", " "), "samples", "scenarios", *names]
    return {"heading": heading, "rows": rows, "caption": f"{whose}; {how}"}


def _choices(run: EvaluationRun) -> Iterator[tuple[str, Any]]:
    """Every switch of the protocol, and all other settings."""
    yield "Every switch of the protocol", run.setup.as_dict()["settings"]
    yield "Selection of samples", run.selection.as_dict()
    if run.results.form is not None:
        yield "Form of the results", run.results.form
    if run.results.meta:
        yield "What the results say about themselves", run.results.meta


def _headlines(result: Any) -> list[Headline]:
    """The headlines as a report shows them: a class without true boxes has no value, also where the rules count 0."""
    paths = {f"class_average_precision/{name}" for name in _absent_classes(result)}
    return [replace(each, value=None) if each.path in paths else each for each in headlines(result)]


def _absent_classes(result: object) -> list[str]:
    """Classes without true boxes, of a detection's result."""
    if not isinstance(result, DetectionResult):
        return []
    return [
        name
        for name, truths in zip(result.classes, result.truths.sum(axis=1), strict=True)
        if not truths
    ]


def _interval_text(headline: Headline, group: Group[Any] | None) -> str:
    low, high = (
        (math.nan, math.nan)
        if group is None
        else group.intervals.get(headline.path, (math.nan, math.nan))
    )
    if headline.value is None or math.isnan(low) or math.isnan(high):
        return ""
    digits = 2 if headline.unit == "%" else 3
    return f"{low:.{digits}f} to {high:.{digits}f}"


def save_report(
    run: EvaluationRun,
    folder: str | os.PathLike[str],
    *,
    dataset: Dataset | None = None,
    results: Results | None = None,
) -> Path:
    """Write `report.html` and `figures/*.png` into a folder; the same run makes the same bytes.

    The report needs no other file: it can be sent as it is. In a partial run each section and each figure says that it
    is partial.

    Args:
        run: of `evaluate_results`.
        folder: where; it is made if it is not there, and files of an earlier report there are replaced.
        dataset: the release; with it and `results` the report also shows the worst and the best samples.
        results: the predictions that were evaluated.

    Returns:
        The report's path.

    Raises:
        ConfigError: the folder cannot be written to, or is a file.
        OutputFolderError: its `figures` is a link.
    """
    target = writable_folder(folder)
    drawn = [*run_figures(run)]
    if dataset is not None and results is not None:
        drawn += sample_figures(run, dataset, results)
    pictures = place_in(target, FIGURES_FOLDER, opened=True)
    figures = [(each, save_figure(run, each, pictures)) for each in drawn]
    write_bytes(target / REPORT_FILE, report_html(run, figures).encode())
    return target / REPORT_FILE


def report_html(run: EvaluationRun, figures: Sequence[tuple[RunFigure, Path]]) -> str:
    """The complete page, of which the figures' PNG files become part."""
    pictures = [(read_bytes(path, "image"), each.alt, each.caption) for each, path in figures]
    return document(
        "evaluation_report.html", style=page_style(), pictures=pictures, **report_context(run)
    )
