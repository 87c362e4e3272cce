"""`save_report`: one HTML file with the whole evaluation, and its figures as PNG files."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.evaluation.breakdowns import EVERYTHING, Breakdown, Group
from deepaccident_devkit.evaluation.detection import DetectionResult
from deepaccident_devkit.evaluation.intervals import MIN_CLUSTERS
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
from deepaccident_devkit.render.styles import page_style
from deepaccident_devkit.support.files import place_in, writable_folder, write_bytes
from deepaccident_devkit.support.human_names import column_name, human_name, metric_name, rules_name
from deepaccident_devkit.support.pages import document, result_text, scalar
from deepaccident_devkit.support.reading import read_bytes
from deepaccident_devkit.support.text import PathType, counted, interval_text
from deepaccident_devkit.support.values import NamedValues, ReadOnlyValues

# Word in the report for each value of a headline's `higher_is_better`.
_BETTER_WORDS = {True: "higher", False: "lower", None: ""}
# Heading of the table for each field of a result.
_TABLE_HEADINGS = {
    "truths": "Colliding pairs of the samples",
    "within": "By the allowed distance",
    "ranges": "By range",
    "classes": "By class",
    "beside": "With other switches",
}
# Values that are known even for a class without true boxes.
_KNOWN_WITHOUT_TRUTH = ("thresholds", "truths", "detections")
# Fields of the results' metadata that the header shows, if present.
_HEADER_META = ("method", "name", "authors", "url", "date")
REPORT_FILE: Final = "report.html"
FIGURES_FOLDER: Final = "figures"


def report_context(run: EvaluationRun) -> NamedValues:
    """Collect a run's data for the template `evaluation_report.html`, without pictures."""
    fields = run.result.as_dict()
    summary = run.summary()
    group = None
    percent = ""
    common_values = {}
    for broken in run.breakdowns:
        if broken.by == EVERYTHING:
            percent = f"{100 * broken.resampling.confidence:g} % "
            group = next(iter(broken.groups), None)
        if len(broken.groups) == 1:
            common_values[broken.by] = human_name(broken.groups[0].value)
    return {
        "title": rules_name(run.setup.task, run.setup.protocol),
        "partial": "" if run.partial is None else run.partial.text(),
        "header": _header(run, summary),
        "headlines": _headline_rows(run.result, group),
        "interval": f"{percent}interval",
        "interval_notes": () if group is None or group.intervals else group.notes,
        "predictors": [*predictor_tables(fields), *means_tables(summary).values()],
        "further": _further_tables(summary),
        "whole_numbers": {
            column_name(name): result_text(value)
            for name, value in fields.items()
            if isinstance(value, int)
        },
        "said": [*(fields.get("notes") or ()), *reading_notes(summary)],
        "counts": _counts(run.result, fields),
        "breakdowns": [_breakdown(item) for item in run.breakdowns if item.by not in common_values],
        "same": [
            f"{human_name(name, 'attributes')}: {value}"
            for name, value in common_values.items()
            if name != EVERYTHING
        ],
        "sanity": None if run.sanity is None else SanityReport(**run.sanity),
        "choices": dict(_choices(run)),
    }


def _headline_rows(result: Any, group: Group[Any] | None) -> list[list[str]]:
    rows = []
    for headline in _headlines(result):
        interval = _headline_interval(headline, group)
        direction = _BETTER_WORDS[headline.higher_is_better]
        rows.append([metric_name(headline.name), headline.text(), interval, direction])
    return rows


def _further_tables(summary: ReadOnlyValues) -> dict[str, tuple[Any, list[str]]]:
    tables = {}
    for extra, part in further_results(summary):
        notes = [*part["notes"], *part["interval_notes"]]
        heading = extra.title.capitalize()
        tables[heading] = (extra.tables(part), notes)
    return tables


def _header(run: EvaluationRun, summary: ReadOnlyValues) -> dict[str, str]:
    """Return the rows of the header: what was evaluated, and how."""
    setup = run.setup
    results = run.results
    counts = summary["counts"]
    protocol = setup.protocol
    changes = [f"{name}={value!r}" for name, value in setup.switches.items()]
    if changes:
        protocol += f", but {', '.join(changes)}"
    header = {"task": setup.task, "protocol": protocol}
    header |= {name: scalar(results.meta[name]) for name in _HEADER_META if name in results.meta}
    header |= {
        "samples": f"{counts['samples']:,} from {counted(counts['scenarios'], 'scenario')}",
        "selection": run.selection.text(),
    }
    if run.evaluator.has_horizon:
        header["horizon"] = f"{setup.horizon:g} s"
    header |= {"results": results.path, "results' hash": results.fingerprint}
    sent = sent_bytes(summary)
    if sent:
        header["communication"] = sent.text()
    versions = [f"{name} {version}" for name, version in summary["environment"].items()]
    return header | {
        "release": f"{run.release.version}, {run.release.dataroot}",
        "release's hash": run.release.fingerprint,
        "devkit": summary["devkit_version"],
        "made with": ", ".join(versions),
    }


def _counts(result: object, fields: ReadOnlyValues) -> NamedValues:
    """Return the counts of a result by heading, formatted by `_columns`."""
    for name in _absent_classes(result):
        row = fields["classes"][name]
        for key in row.keys() - {*_KNOWN_WITHOUT_TRUTH}:
            row[key] = None
    counts = {}
    for name, title in _TABLE_HEADINGS.items():
        if fields.get(name):
            counts[title] = _columns(fields[name], name)
    return counts


def _columns(value: Any, part: str) -> Any:
    """Format a value of a part of a result for the report.

    Pairs become a text of ranges, a mapping of numbers becomes texts by name, and a mapping of
    mappings becomes rows with a heading.
    """
    if not isinstance(value, Mapping):
        ranges = []
        for low, high in value:
            end = "m and more" if high is None else f"to {high:g} m"
            ranges.append(f"{low:g} {end}")
        return "; ".join(ranges)
    if not all(isinstance(row, Mapping) for row in value.values()):
        return {column_name(str(name)): result_text(number) for name, number in value.items()}
    is_plain: dict[str, bool] = {}  # whether all values of a column are plain, by column name
    for row in value.values():
        for name, cell in row.items():
            is_plain[name] = is_plain.get(name, True) and not isinstance(cell, Mapping)
    names = [name for name in is_plain if is_plain[name] and name != "distance"]
    rows = [["", *map(column_name, names)]]
    for key, row in value.items():
        texts = [result_text(row.get(name)) for name in names]
        rows.append([column_name(f"{part}/{key}"), *texts])
    return rows


def _breakdown(broken: Breakdown[Any]) -> NamedValues:
    """Make a table of an attribute's groups, and a table without the roadside if it differs."""
    groups = broken.groups
    vehicle_groups = broken.without_infrastructure
    samples = sum(group.samples for group in groups)
    vehicle_samples = sum(group.samples for group in vehicle_groups)
    vehicles = None
    if vehicle_samples != samples:
        vehicles = _group_table(broken, vehicle_groups, "without infrastructure")
    return {
        "by": human_name(broken.by, "attributes"),
        "all": _group_table(broken, groups, "all agents"),
        "vehicles": vehicles,
    }


def _group_table(broken: Breakdown[Any], groups: Sequence[Group[Any]], agents: str) -> NamedValues:
    """Make a table, with a caption, of the headline numbers of a breakdown's groups."""
    names: dict[str, None] = {}
    cells_of_groups = []
    for group in groups:
        cells = {}
        for headline in _headlines(group.result):
            name = metric_name(headline.name)
            names[name] = None
            cells[name] = (headline.text(), _headline_interval(headline, group))
        cells_of_groups.append(cells)
    rows = []
    for group, cells in zip(groups, cells_of_groups, strict=True):
        numbers = [cells.get(name, "–") for name in names]
        counts = [f"{group.samples:,}", f"{group.scenarios:,}"]
        rows.append([human_name(group.value), *counts, *numbers])
    percent = 100 * broken.resampling.confidence
    return {
        "heading": [human_name(broken.by, "attributes"), "samples", "scenarios", *names],
        "rows": rows,
        "caption": (
            f"{agents}; {percent:g} % confidence intervals where there are at least {MIN_CLUSTERS} "
            "scenario pairs"
        ),
    }


def _choices(run: EvaluationRun) -> Iterator[tuple[str, Any]]:
    """Yield the headings and values of the protocol's switches and of all other settings."""
    yield "Every switch of the protocol", run.setup.as_dict()["settings"]
    yield "Selection of samples", run.selection.as_dict()
    if run.results.form is not None:
        yield "Form of the results", run.results.form
    if run.results.meta:
        yield "Metadata of the results", run.results.meta


def _headlines(result: Any) -> list[Headline]:
    """Return the headlines of a result as a report shows them.

    A class without true boxes has no value, even if the protocol counts it as 0.
    """
    paths = {f"class_average_precision/{name}" for name in _absent_classes(result)}
    shown_headlines = []
    for headline in headlines(result):
        absent = headline.path in paths
        shown_headlines.append(replace(headline, value=None) if absent else headline)
    return shown_headlines


def _absent_classes(result: object) -> list[str]:
    """Return the classes that have no true boxes, if the result is one of detection."""
    if not isinstance(result, DetectionResult):
        return []
    truths = result.truths.sum(axis=1)
    return [name for name, count in zip(result.classes, truths, strict=True) if not count]


def _headline_interval(headline: Headline, group: Group[Any] | None) -> str:
    if group is None or headline.value is None or headline.path not in group.intervals:
        return ""
    low, high = group.intervals[headline.path]
    return interval_text(low, high, 2 if headline.unit == "%" else 3)


def save_report(
    run: EvaluationRun,
    folder: PathType,
    *,
    dataset: Dataset | None = None,
    results: Results | None = None,
) -> Path:
    """Write `report.html` and `figures/*.png` into a folder.

    The same run always gives the same bytes. The report needs no other file, so it can be sent on
    its own. For a partial run, each section and each figure is marked as partial.

    Args:
        run: Result of `evaluate_results`.
        folder: Folder to write into. It is created if it does not exist; the files of an earlier
            report in it are replaced.
        dataset: The release. If `dataset` and `results` are both passed, the report also shows the
            worst and the best samples.
        results: The predictions that were evaluated.

    Returns:
        The report's path.

    Raises:
        ConfigError: The folder cannot be written to, or is a file.
        OutputFolderError: The folder `figures` in it is a link.
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
    """Return the complete page, in which the figures' PNG files are embedded."""
    pictures = []
    for figure, path in figures:
        pictures.append((read_bytes(path, "image"), figure.alt, figure.caption))
    return document(
        "evaluation_report.html", style=page_style(), pictures=pictures, **report_context(run)
    )
