"""Texts of runs, bundles and results files, and tables that compare predictors.

Every block of a partial run is marked as partial. `reading_notes` gives what a reader must know
before comparing the numbers with published ones.
"""

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from typing import Any, Final

from deepaccident_devkit.errors import shortened
from deepaccident_devkit.evaluation.results import Results
from deepaccident_devkit.evaluation.runs.further import Json, further_results
from deepaccident_devkit.evaluation.runs.over_bytes import sent_bytes
from deepaccident_devkit.evaluation.runs.setups import agent_of, evaluator_class, scenario_of
from deepaccident_devkit.evaluation.warning.recordings import GIVEN_SCORES
from deepaccident_devkit.support.human_names import (
    column_name,
    heading_name,
    human_name,
    metric_name,
    with_unit,
)
from deepaccident_devkit.support.reports import Table
from deepaccident_devkit.support.text import columns_text, counted, interval_text, number_text
from deepaccident_devkit.support.values import ReadOnlyValues

SHOWN_BREAKDOWNS: Final = ("time_to_impact", "accident_visibility")
# Text that replaces a missing number.
_MISSING = "–"
# A breakdown shows at most this many headlines.
_MAX_HEADLINES = 5
# Parts of the metrics that do not contain counts.
_PARTS_WITHOUT_COUNTS = ("beside", "notes", "curve", "references", "counted")
# Start and end of each axis, and size of the cells, for published numbers; metres.
_PUBLISHED_CELLS = [-50.0, 50.0, 0.5]
# Number of predictions per sample for published numbers.
_PUBLISHED_PREDICTIONS = 6
# The errors of paths only describe all paths well if at least this share of them is matched.
_MIN_PATH_SHARE = 0.9
# If at least this percentage of plans is infeasible, something is probably wrong with them.
_MIN_INFEASIBLE_PERCENT = 90
# At most this many characters of the notes in results are shown, since notes may contain a hash for
# every scenario.
_MAX_META_LENGTH = 1000
# Names of the thresholds that are listed so that they can be used for another split.
_THRESHOLD_NAMES = ("best_f1", "quiet")
# A table is transposed if it has more columns than rows by more than this number.
_MAX_EXTRA_COLUMNS = 4
# Paths of the numbers of the protocol `clean`. Recall and seconds are never shown without precision
# and time in alarm.
_CLEAN_COLUMNS = (
    "auc_ahead",
    "twin_wins",
    "average_precision",
    "mean_time",
    "operating/precision",
    "operating/time_in_alarm",
    "operating/alarm_seconds_per_minute",
    "operating/episodes_per_minute",
    "operating/recall",
    "operating/tta0",
    "operating/tta_hit",
)
_PRINTED_COLUMNS = ("average_precision", "mean_time", "time_at_r80")
_FIELD_COLUMNS = {
    "ustring": _PRINTED_COLUMNS,
    "dsta": (*_PRINTED_COLUMNS, "precision_at_r80"),
    "drive": (*_PRINTED_COLUMNS, "precision_at_half", "recall_at_half", "time_at_half"),
    "dad": _PRINTED_COLUMNS,
}


def summary_text(summary: Json, by: Sequence[str] = SHOWN_BREAKDOWNS) -> str:
    """Format a summary as blocks of aligned lines.

    The blocks show what was evaluated, headlines, counts, breakdowns and notes.

    Args:
        summary: Summary from `EvaluationRun.summary`, or from `metrics_summary.json`.
        by: Names of the breakdowns to show.
    """
    partial = summary["partial"]
    mark = ""
    if partial is not None:
        mark = f"   {partial['mark']}"
    metrics = summary["metrics"]
    blocks = [
        ("evaluated", _evaluation_text(summary)),
        ("results", _headlines_text(summary)),
        ("predictors", predictors_text(metrics)),
        ("means", _means_text(summary)),
    ]
    for extra, numbers in further_results(summary):
        blocks.append((extra.title, extra.text(numbers)))
    blocks.append(("counts", _counts_text(metrics)))
    for name in by:
        if name in summary["breakdowns"]:
            heading = f"by {human_name(name, 'attributes')}"
            blocks.append((heading, _breakdown_text(summary, name)))
    notes = [*notes_of(metrics), *reading_notes(summary)]
    blocks.append(("notes", "\n".join(notes)))
    texts = []
    for title, text in blocks:
        if text:
            indented = "\n".join(f"  {line}" for line in text.splitlines())
            texts.append(f"{title}{mark}\n{indented}")
    return "\n\n".join(texts)


def _evaluation_text(summary: Json) -> str:
    """Format aligned lines that say what was evaluated."""
    release = summary["release"]
    results = summary["results"]
    lines = {
        "task": _task_text(summary),
        "samples": _samples_text(summary),
        "predictions": f"{results['path']} ({results['fingerprint']}){_left_out_text(summary)}",
    }
    sent = sent_bytes(summary)
    if sent:
        lines["communication"] = sent.text()
    lines |= {
        "release": f"{release['dataroot']} ({release['version']}, {release['fingerprint']})",
        "devkit": summary["devkit_version"],
    }
    return _align_lines(lines)


def _task_text(summary: Json) -> str:
    """Format the task, its protocol and the changed switches."""
    switches = [f"{name}={value!r}" for name, value in summary["switches"].items()]
    changes = ""
    if switches:
        changes = f" with {', '.join(switches)}"
    return f"{summary['task']}, protocol {summary['protocol']}{changes}"


def _samples_text(summary: Json) -> str:
    """Say how many samples were evaluated, and how they were selected."""
    counts = summary["counts"]
    agents = "all agents"
    if summary["agents"] is not None:
        agents = ", ".join(map(human_name, summary["agents"]))
    horizon = ""
    if "means" not in summary["metrics"]:
        horizon = f", horizon {summary['horizon']:g} s"
    return (
        f"{counts['samples']} from {counted(counts['scenarios'], 'scenario')}: split "
        f"{summary['split']}, samples {summary['samples']}, scope {summary['scope']}, "
        f"{agents}{horizon}"
    )


def _left_out_text(summary: Json) -> str:
    """Say how many predictions were left out; empty if none were."""
    left_out = summary["counts"].get("left_out", 0)
    if not left_out:
        return ""
    return f"; left out: {counted(left_out, 'prediction')} for other samples"


def _align_lines(lines: Json) -> str:
    """Format a line for each name and its text; the texts are aligned."""
    width = max(map(len, lines), default=0)
    aligned = []
    for name, text in lines.items():
        line = f"{name:<{width}}  {text}"
        aligned.append(line.strip())
    return "\n".join(aligned)


def _headlines_text(summary: Json) -> str:
    """Format the table of the headlines, with intervals and alternatives if the run has them.

    If there are intervals, the note about missing ones uses the names in the table; otherwise the
    notes of the group say why there are none.
    """
    intervals: ReadOnlyValues = {}
    group_notes: list[str] = []
    overall = summary["breakdowns"].get("all")
    if overall and overall["groups"]:
        group = overall["groups"][0]
        intervals = group["intervals"]
        group_notes = group["notes"]
    alternatives: ReadOnlyValues = summary["metrics"].get("beside") or {}
    titles = ["number", "value"]
    if intervals:
        titles.append(f"{100 * overall['resampling']['confidence']:.0f} % interval")
    titles += [f"if {name}" for name in alternatives]
    rows = [titles]
    without_interval = []
    for headline in summary["headlines"]:
        path = headline["path"]
        name = metric_name(headline["name"])
        row = [name, headline["text"]]
        if intervals:
            interval = interval_text(*(intervals.get(path) or (None, None)))
            row.append(interval)
            if interval == _MISSING and headline["text"] != _MISSING:
                without_interval.append(name)
        for metrics in alternatives.values():
            row.append(number_text(_find_value(metrics, path), 3))
        rows.append(row)
    notes = [] if intervals else group_notes
    if without_interval:
        names = "; ".join(without_interval)
        reason = "too few scenario pairs have a value, or leaving out a pair changes nothing"
        notes = [f"no interval for {names}: {reason}"]
    return "\n".join([columns_text(rows), *notes])


def _counts_text(metrics: Json) -> str:
    """Format one line for each part of the metrics that contains integers."""
    lines = {}
    for path, numbers in _find_whole_numbers(metrics, ""):
        counts = [f"{column_name(name)} {number}" for name, number in numbers.items()]
        lines[column_name(path)] = ", ".join(counts)
    return _align_lines(lines)


def _find_whole_numbers(part: Json, path: str) -> Iterator[tuple[str, dict[str, str]]]:
    """Yield the path of each part that contains integers, and their texts by name."""
    numbers = {}
    for name, value in part.items():
        text = _whole_number_text(value)
        if text:
            numbers[name] = text
    if numbers:
        yield path, numbers
    for name, value in part.items():
        if isinstance(value, Mapping) and name not in _PARTS_WITHOUT_COUNTS:
            yield from _find_whole_numbers(value, f"{path}/{name}" if path else name)


def _whole_number_text(value: object) -> str:
    """Format an integer, or a list of integers; anything else is an empty text."""
    numbers = value if isinstance(value, list) else [value]
    if all(type(number) is int for number in numbers):
        return "+".join(map(str, numbers))
    return ""


def _breakdown_text(summary: Json, name: str) -> str:
    """Format the table of a breakdown, which shows the headlines of each group."""
    headlines = summary["headlines"][:_MAX_HEADLINES]
    titles = [with_unit(metric_name(headline["name"]), headline["unit"]) for headline in headlines]
    rows = [[human_name(name, "attributes"), "samples", "scenarios", *titles]]
    for group in summary["breakdowns"][name]["groups"]:
        row = [human_name(group["value"]), str(group["samples"]), str(group["scenarios"])]
        for headline in headlines:
            number = group["headlines"].get(headline["path"])
            row.append(number_text(number, 3))
        rows.append(row)
    return columns_text(rows)


def notes_of(metrics: Json) -> Iterator[str]:
    """Yield each different note of a result and of its alternatives once."""
    yield from dict.fromkeys(metrics.get("notes") or ())
    alternatives: ReadOnlyValues = metrics.get("beside") or {}
    for name, alternative in alternatives.items():
        for note in alternative.get("notes") or ():
            if note not in metrics["notes"]:
                yield f"if {name}: {note}"


def _find_value(part: Any, path: str) -> Any:
    """Return the value at a path such as `ranges/30x30/iou`; None if it does not exist."""
    for name in path.split("/"):
        if not isinstance(part, Mapping):
            return None
        part = part.get(name)
    return part


def predictor_tables(metrics: Json) -> list[Table]:
    """Build tables that compare predictors, one for each group of recordings.

    The list is empty unless the metrics come from the task `warning` and include reference
    predictors.
    """
    references: Mapping[str, Json] | None = metrics.get("references")
    if not references:
        return []
    is_clean = "groups" in metrics
    groups: Mapping[str, Json] = metrics["groups" if is_clean else "figures"]
    tables = []
    for group, figures in groups.items():
        columns: Sequence[str] = _CLEAN_COLUMNS
        notes: tuple[str, ...] = ()
        if is_clean:
            notes = tuple(_threshold_notes(metrics, figures))
        else:
            figure_set = group.partition(" ")[0]
            columns = _FIELD_COLUMNS[figure_set]
        figures_by_predictor = {GIVEN_SCORES: figures}
        for name, figures_by_group in references.items():
            figures_by_predictor[name] = figures_by_group[group]
        rows = [(human_name(group), *map(heading_name, columns))]
        for name, numbers in figures_by_predictor.items():
            cells = [table_number_text(_find_value(numbers, path)) for path in columns]
            rows.append((human_name(name), *cells))
        tables.append(Table(rows=tuple(rows), notes=notes))
    return tables


def predictors_text(metrics: Json) -> str:
    """Format all tables that compare predictors as aligned lines; empty if there are none."""
    return "\n\n".join(table.to_text() for table in predictor_tables(metrics))


def means_tables(summary: Json) -> dict[str, Table]:
    """Build the tables of means in a summary, by name; empty if the task does not report means.

    The column `n` states the number of samples of a row; a mean over fewer samples is followed by
    its own number of samples. A table with many more columns than rows is transposed.
    """
    metrics = summary["metrics"]
    description_rows = evaluator_class(summary["task"]).result_class.rows
    units = {row.path.rpartition("/")[2]: row.unit for row in description_rows}
    tables = {}
    for name, means in (metrics.get("means") or {}).items():
        columns = dict.fromkeys(chain.from_iterable(means.values()))
        headings = (with_unit(metric_name(column), units[column]) for column in columns)
        rows = [(human_name(name), "n", *headings)]
        for row_name, values in means.items():
            counts = metrics["counted"][name][row_name]
            row_count = max(counts.values())
            cells = []
            for column in columns:
                cells.append(_mean_text(values.get(column), counts.get(column, 0), row_count))
            rows.append((human_name(row_name), f"{row_count:,}", *cells))
        if len(rows[0]) > len(rows) + _MAX_EXTRA_COLUMNS:
            rows = list(zip(*rows, strict=True))
        tables[name] = Table(rows=rows)
    return tables


def _mean_text(value: float | None, count: int, row_count: int) -> str:
    """Format a mean with two decimals, and its number of samples if it differs from the row's."""
    if value is None:
        return _MISSING
    if count == row_count:
        return f"{value:.2f}"
    return f"{value:.2f} ({count:,})"


def _means_text(summary: Json) -> str:
    """Format the tables that contain the headlines, and name the other tables."""
    tables = means_tables(summary)
    if not tables:
        return ""
    main_names = {headline["path"].split("/")[1] for headline in summary["headlines"]}
    texts = []
    other_names = []
    for name, table in tables.items():
        if name in main_names:
            texts.append(table.to_text())
        else:
            other_names.append(human_name(name))
    if other_names:
        texts.append(f"also in metrics_summary.json and the report: {'; '.join(other_names)}")
    return "\n\n".join(texts)


def table_number_text(value: float | None) -> str:
    """Format a number in a table; None is a dash."""
    if value is None:
        return _MISSING
    if abs(value) < 10:
        return f"{value:.3f}"
    return f"{value:.1f}"


def _threshold_notes(metrics: Json, figures: Json) -> Iterator[str]:
    """Yield notes about a group's threshold, and about the warning time left after a latency."""
    threshold = figures["operating"]["threshold"]
    threshold_text = "none" if threshold is None else f"{threshold:.4g}"
    source = "chosen on these recordings for a recall of 0.8, or for the highest recall"
    if metrics["operating_by"] == "given":
        source = "as given"
    other_thresholds = [
        f"{name} {table_number_text(figures.get(name))}" for name in _THRESHOLD_NAMES
    ]
    yield (
        f"threshold {threshold_text}, {source}; thresholds for another split: "
        f"{', '.join(other_thresholds)}"
    )
    seconds_by_latency = figures["tta0_after"]
    if seconds_by_latency:
        texts = []
        for latency, seconds in seconds_by_latency.items():
            time_left = _MISSING
            if seconds is not None:
                time_left = f"{seconds:.3f} s"
            texts.append(f"{latency} s: {time_left}")
        yield (
            "TTA (a miss counts as 0 s) if the warning reaches the colliding pair after a latency "
            f"of {', '.join(texts)}"
        )


def results_text(results: Results) -> str:
    """Describe results in aligned lines: task, path, samples, agents, notes and form."""
    tokens = results.tokens
    scenarios = set(map(scenario_of, tokens))
    agent_counts = sorted(Counter(map(agent_of, tokens)).items())
    meta = json.dumps(results.meta, ensure_ascii=False)
    lines = {
        "results": f"{results.task}, {results.path}",
        "fingerprint": results.fingerprint,
        "samples": f"{len(tokens)} from {counted(len(scenarios), 'scenario')}",
        "agents": ", ".join(f"{human_name(name)} {count}" for name, count in agent_counts),
        "meta": shortened(meta, _MAX_META_LENGTH),
    }
    form = results.form
    if form is not None:
        lines["form"] = form.text
    return _align_lines(lines)


def reading_notes(summary: Json) -> list[str]:
    """Return sentences that say what to keep in mind when reading a summary's numbers.

    They name cells, frames and numbers of predictions that differ from published numbers,
    and other limits.
    """
    form = summary["results"]["form"]
    metrics = summary["metrics"]
    notes: list[str] = []
    if form is not None:
        if summary["protocol"] != "onebev":  # which was published with other cells
            notes += _cell_notes(form, metrics.get("ranges") or ())
        if "frames" in form:
            notes += _frame_notes(form, summary["horizon"])
    is_released = summary["protocol"] == "released"
    if summary["task"] == "motion":
        notes += _path_notes(metrics)
    elif summary["task"] == "accident" and is_released and form is not None:
        notes += _prediction_notes(form)
    elif summary["task"] == "planning":
        notes += _plan_notes(metrics)
    elif summary["task"] == "detection" and is_released:
        notes.append(
            "the protocol released takes hidden boxes and the agent's own box as truth, counts a "
            "class without true boxes as 0 and an error at an unreached recall as 1, and compares "
            "raw velocities of the labels; --protocol paper does none of this"
        )
    return notes


def _plan_notes(metrics: Json) -> Iterator[str]:
    """Yield a note for each table in which most plans cannot be driven."""
    for table, rows in metrics["means"].items():
        percent = rows[GIVEN_SCORES].get("infeasible") or 0.0
        if percent >= _MIN_INFEASIBLE_PERCENT:
            yield (
                f"suspicious: {percent:.0f} % of the plans of {table} cannot be driven; --sanity "
                "looks for mistakes"
            )


def _cell_notes(form: Json, ranges: Sequence[str]) -> Iterator[str]:
    """Yield notes about cells unlike the published ones, and about ranges beyond the maps."""
    if form["x"] == form["y"] == _PUBLISHED_CELLS:
        return
    axes = [f"{name} from {form[name][0]:g} to {form[name][1]:g} m" for name in "xy"]
    yield (
        f"the maps and their labels have cells of {form['x'][2]:g} m, {', '.join(axes)}; "
        "published numbers use cells of 0.5 m, x and y from −50 to 50 m, and cannot be compared "
        "with these"
    )
    map_ends = [*form["x"][:2], *form["y"][:2]]
    nearest_end = min(map(abs, map_ends))
    for name in ranges:
        if name == "all":
            continue
        side = max(map(float, name.split("x")))
        if side > 2 * nearest_end:
            yield f"{human_name(name)}: the maps end within this range; only their cells count"


def _frame_notes(form: Json, horizon: float) -> Iterator[str]:
    """Yield a note if predictions have more frames than are evaluated."""
    frame_count = round(horizon / form["step"]) + 1
    if form["frames"] > frame_count:
        yield (
            f"predictions have {form['frames']} frames, of which the first {frame_count} are "
            "evaluated; the first frame must be the present, so leave out past frames"
        )


def _prediction_notes(form: Json) -> Iterator[str]:
    """Yield notes about predictions whose kind or number differs from that of published numbers."""
    if form["stored"] == "instances":
        yield (
            "predictions are instance maps; their APA cannot be compared with published APA, which "
            "is computed from heads (docs/numbers.md)"
        )
    if form["predictions"] < _PUBLISHED_PREDICTIONS:
        yield (
            f"each sample has {counted(form['predictions'], 'prediction')}; published numbers use "
            f"{_PUBLISHED_PREDICTIONS}: five random draws, then their mean"
        )


def _path_notes(metrics: Json) -> Iterator[str]:
    """Yield a note if many true paths have no match."""
    matched_count = metrics["paths"]
    true_count = metrics["path_true_positive"] + metrics["path_false_negative"]
    if matched_count < _MIN_PATH_SHARE * true_count:
        yield (
            f"{matched_count} of {true_count} true paths have a match; minADE, minFDE and the miss "
            "rate are averaged over these only"
        )
