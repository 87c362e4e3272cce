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

# `higher_is_better` of a headline → word of the report.
_BETTER_WORDS: Final = {True: "higher", False: "lower", None: ""}
# Field of a result → heading of its table.
_TABLE_HEADINGS: Final = {
    "truths": "Actors in the samples' true accidents",
    "within": "By the allowed distance (m)",
    "ranges": "By range",
    "classes": "By class",
    "beside": "With other choices, always reported as well",
}
# Known values of a class without true boxes.
_KNOWN_WITHOUT_TRUTH: Final = ("thresholds", "truths", "detections")
# Fields of the results' own metadata that the header shows, if present.
_HEADER_META: Final = ("method", "name", "authors", "url", "date")
REPORT_FILE: Final = "report.html"
FIGURES_FOLDER: Final = "figures"


def report_context(run: EvaluationRun) -> dict[str, Any]:
    """Return the data of a run for the template `evaluation_report.html`, without pictures."""
    fields, summary = run.result.as_dict(), run.summary()
    everything = next((item for item in run.breakdowns if item.by == EVERYTHING), None)
    group, percent = None, ""
    if everything is not None:
        percent = f"{100 * everything.resampling.confidence:g} % "
        group = next(iter(everything.groups), None)
    common_values = {
        item.by: item.groups[0].value or UNKNOWN for item in run.breakdowns if len(item.groups) == 1
    }
    return {
        "title": f"{run.setup.task.capitalize()}, protocol {run.setup.protocol}",
        "partial": "" if run.partial is None else run.partial.text(),
        "header": _header(run, summary),
        "headlines": _headline_rows(run.result, group),
        "interval": f"{percent}interval",
        "interval_notes": () if group is None or group.intervals else group.notes,
        "predictors": [*predictor_tables(fields), *means_tables(summary).values()],
        "further": _further_tables(summary),
        "whole_numbers": {
            name: result_text(value) for name, value in fields.items() if isinstance(value, int)
        },
        "said": [*(fields.get("notes") or ()), *reading_notes(summary)],
        "counts": _counts(run.result, fields),
        "breakdowns": [_breakdown(item) for item in run.breakdowns if item.by not in common_values],
        "same": [
            f"{name.replace('_', ' ')} {value}"
            for name, value in common_values.items()
            if name != EVERYTHING
        ],
        "sanity": None if run.sanity is None else SanityReport(**run.sanity),
        "choices": dict(_choices(run)),
    }


def _headline_rows(result: Any, group: Group[Any] | None) -> list[list[str]]:
    rows = []
    for headline in _headlines(result):
        interval = _interval_text(headline, group)
        direction = _BETTER_WORDS[headline.higher_is_better]
        rows.append([headline.name, headline.text(), interval, direction])
    return rows


def _further_tables(summary: Mapping[str, Any]) -> dict[str, tuple[Any, list[str]]]:
    tables = {}
    for extra, part in further_results(summary):
        notes = [*part["notes"], *part["interval_notes"]]
        tables[extra.title.capitalize()] = (extra.tables(part), notes)
    return tables


def _header(run: EvaluationRun, summary: Mapping[str, Any]) -> dict[str, str]:
    """Return what was evaluated, and how."""
    setup, results, counts = run.setup, run.results, summary["counts"]
    protocol = setup.protocol
    changes = [f"{name} = {scalar(value)}" for name, value in setup.switches.items()]
    if changes:
        protocol += f", but {', '.join(changes)}"
    header = {"task": setup.task, "protocol": protocol}
    header |= {name: scalar(results.meta[name]) for name in _HEADER_META if name in results.meta}
    header |= {
        "samples": f"{counts['samples']:,} of {counts['scenarios']:,} scenarios",
        "selection": run.selection.text(),
    }
    if run.evaluator.has_horizon:
        header["horizon"] = f"{setup.horizon:g} s"
    header |= {"results": results.path, "results' hash": results.fingerprint}
    sent = sent_bytes(summary)
    if sent:
        header["bytes"] = sent.text()
    versions = [f"{name} {version}" for name, version in summary["environment"].items()]
    return header | {
        "release": f"{run.release.version}, {run.release.dataroot}",
        "release's hash": run.release.fingerprint,
        "devkit": summary["devkit_version"],
        "made with": ", ".join(versions),
    }


def _counts(result: object, fields: Mapping[str, Any]) -> dict[str, Any]:
    """Return heading → counts, in the form of `_columns`."""
    for name in _absent_classes(result):
        row = fields["classes"][name]
        row.update({key: None for key in row if key not in _KNOWN_WITHOUT_TRUTH})
    counts = {}
    for name, title in _TABLE_HEADINGS.items():
        if fields.get(name):
            counts[title] = _columns(fields[name])
    return counts


def _columns(value: Any) -> Any:
    """Return the form of a value in the report.

    Pairs become a text of ranges, a mapping of numbers texts by name, and a mapping of mappings
    rows with a heading.
    """
    if not isinstance(value, Mapping):
        return "; ".join(_range_text(low, high) for low, high in value)
    if not all(isinstance(row, Mapping) for row in value.values()):
        return {str(name): result_text(number) for name, number in value.items()}
    columns: dict[str, bool] = {}  # name → whether its values are plain
    for row in value.values():
        for name, cell in row.items():
            columns[name] = columns.get(name, True) and not isinstance(cell, Mapping)
    names = [name for name, is_plain in columns.items() if is_plain]
    rows = [["", *names]]
    for key, row in value.items():
        rows.append([key, *(result_text(row.get(name)) for name in names)])
    return rows


def _range_text(low: float, high: float | None) -> str:
    if high is None:
        return f"{low:g} m and more"
    return f"{low:g} to {high:g} m"


def _breakdown(broken: Breakdown[Any]) -> dict[str, Any]:
    """Return a table for an attribute, and one of only the vehicles if sample numbers differ."""
    groups, vehicle_groups = broken.groups, broken.without_infrastructure
    vehicle_samples = sum(group.samples for group in vehicle_groups)
    vehicles = None
    if vehicle_samples != sum(group.samples for group in groups):
        vehicles = _groups(broken, vehicle_groups, "without the roadside")
    return {
        "by": broken.by.replace("_", " "),
        "all": _groups(broken, groups, "all agents"),
        "vehicles": vehicles,
    }


def _groups(broken: Breakdown[Any], groups: Sequence[Group[Any]], agents: str) -> dict[str, Any]:
    headlines_of_groups = [_headlines(group.result) for group in groups]
    names = list(dict.fromkeys(item.name for row in headlines_of_groups for item in row))
    rows = []
    for group, group_headlines in zip(groups, headlines_of_groups, strict=True):
        cells = {item.name: (item.text(), _interval_text(item, group)) for item in group_headlines}
        label = UNKNOWN if group.value is None else group.value
        counts = [f"{group.samples:,}", f"{group.scenarios:,}"]
        rows.append([label, *counts, *(cells.get(name, "–") for name in names)])
    percent = 100 * broken.resampling.confidence
    return {
        "heading": [broken.by.replace("_", " "), "samples", "scenarios", *names],
        "rows": rows,
        "caption": f"{agents}; {percent:g} % intervals, if there are {LEAST_CLUSTERS} clusters",
    }


def _choices(run: EvaluationRun) -> Iterator[tuple[str, Any]]:
    """Yield every switch of the protocol, and all other settings."""
    yield "Every switch of the protocol", run.setup.as_dict()["settings"]
    yield "Selection of samples", run.selection.as_dict()
    if run.results.form is not None:
        yield "Form of the results", run.results.form
    if run.results.meta:
        yield "What the results say about themselves", run.results.meta


def _headlines(result: Any) -> list[Headline]:
    """Return the headlines as a report shows them.

    A class without true boxes has no value, even if the rules count 0.
    """
    paths = {f"class_average_precision/{name}" for name in _absent_classes(result)}
    shown_headlines = []
    for headline in headlines(result):
        absent = headline.path in paths
        shown_headlines.append(replace(headline, value=None) if absent else headline)
    return shown_headlines


def _absent_classes(result: object) -> list[str]:
    """Return classes without true boxes in a result of detection."""
    if not isinstance(result, DetectionResult):
        return []
    truths = result.truths.sum(axis=1)
    return [name for name, count in zip(result.classes, truths, strict=True) if not count]


def _interval_text(headline: Headline, group: Group[Any] | None) -> str:
    if group is None or headline.value is None:
        return ""
    low, high = group.intervals.get(headline.path, (math.nan, math.nan))
    if math.isnan(low) or math.isnan(high):
        return ""
    digits = 3
    if headline.unit == "%":
        digits = 2
    return f"{low:.{digits}f} to {high:.{digits}f}"


def save_report(
    run: EvaluationRun,
    folder: str | os.PathLike[str],
    *,
    dataset: Dataset | None = None,
    results: Results | None = None,
) -> Path:
    """Write `report.html` and `figures/*.png` into a folder; the same run makes the same bytes.

    The report needs no other file and can be sent as it is. In a partial run each section and each
    figure is marked as partial.

    Args:
        run: Result of `evaluate_results`.
        folder: Folder to write into; it is made if it does not exist, and files of an earlier
            report in it are replaced.
        dataset: The release; with it and `results` the report also shows the worst and the best
            samples.
        results: The predictions that were evaluated.

    Returns:
        The report's path.

    Raises:
        ConfigError: The folder cannot be written to, or is a file.
        OutputFolderError: Its `figures` is a link.
    """
    target = writable_folder(folder)
    unsaved_figures = [*run_figures(run)]
    if dataset is not None and results is not None:
        unsaved_figures += sample_figures(run, dataset, results)
    figures_folder = place_in(target, FIGURES_FOLDER, opened=True)
    figures = []
    for run_figure in unsaved_figures:
        figures.append((run_figure, save_figure(run, run_figure, figures_folder)))
    write_bytes(target / REPORT_FILE, report_html(run, figures).encode())
    return target / REPORT_FILE


def report_html(run: EvaluationRun, figures: Sequence[tuple[RunFigure, Path]]) -> str:
    """Return the complete page, with the figures' PNG files as a part of it."""
    pictures = []
    for figure, path in figures:
        pictures.append((read_bytes(path, "image"), figure.alt, figure.caption))
    return document(
        "evaluation_report.html", style=page_style(), pictures=pictures, **report_context(run)
    )
