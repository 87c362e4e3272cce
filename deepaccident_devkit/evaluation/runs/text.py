"""Texts of runs, bundles and results files, and tables of the predictors that know nothing.

Every block of a partial run is marked as partial. `reading_notes` are what a reader has to know
before comparing the numbers with published ones.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

from deepaccident_devkit.errors import shortened
from deepaccident_devkit.evaluation.results import Results
from deepaccident_devkit.evaluation.runs.further import Json, further_results
from deepaccident_devkit.evaluation.runs.over_bytes import sent_bytes
from deepaccident_devkit.evaluation.runs.setups import agent_of, evaluator_class, scenario_of
from deepaccident_devkit.evaluation.warning.recordings import GIVEN
from deepaccident_devkit.support.reports import Table
from deepaccident_devkit.support.text import columns_text, counted

SHOWN_BREAKDOWNS: Final = ("time_to_impact", "accident_visibility")
# Number of headlines that a breakdown shows.
_MAX_HEADLINES: Final = 5
# Parts of the metrics that hold no counts of the samples.
_PARTS_WITHOUT_COUNTS: Final = ("beside", "notes", "curve", "references", "counted")
# Cells of published numbers (start, end and size in metres), and their predictions of a sample.
_PUBLISHED_CELLS: Final = [-50.0, 50.0, 0.5]
_PUBLISHED_PREDICTIONS: Final = 6
# Share of true paths with a match below which errors of paths hardly describe the other paths.
_MIN_PATH_SHARE: Final = 0.9
# Percentage of infeasible plans from which on something is probably wrong with the plans.
_MIN_INFEASIBLE_PERCENT: Final = 90
# Characters of the notes in results that are shown; the notes may hold a hash for every scenario.
_MAX_META_LENGTH: Final = 1000
# Thresholds that are listed for use with another split.
_THRESHOLD_NAMES: Final = ("best_f1", "quiet")
# A table is transposed if it has more columns than rows by more than this number.
_MAX_EXTRA_COLUMNS: Final = 4
# Columns of the protocol `clean`. Recall and seconds never stand without precision and the time in
# alarm.
_CLEAN_COLUMNS: Final[Mapping[str, str]] = {
    "auc_ahead": "auc_ahead",
    "twin_wins": "twin_wins",
    "AP": "average_precision",
    "mTTA": "mean_time",
    "precision": "operating/precision",
    "in alarm": "operating/time_in_alarm",
    "s/min": "operating/alarm_seconds_per_minute",
    "runs/min": "operating/episodes_per_minute",
    "recall": "operating/recall",
    "tta0": "operating/tta0",
    "tta_hit": "operating/tta_hit",
}
_PRINTED: Final = {"AP": "average_precision", "mTTA": "mean_time", "TTA@R80": "time_at_r80"}
_AT_HALF: Final = {
    "P@0.5": "precision_at_half",
    "R@0.5": "recall_at_half",
    "TTA@0.5": "time_at_half",
}
_FIELD_COLUMNS: Final[Mapping[str, Mapping[str, str]]] = {
    "ustring": _PRINTED,
    "dsta": _PRINTED | {"P@R80": "precision_at_r80"},
    "drive": _PRINTED | _AT_HALF,
    "dad": _PRINTED,
}


def summary_text(summary: Json, by: Sequence[str] = SHOWN_BREAKDOWNS) -> str:
    """Return a summary as blocks of aligned lines.

    The blocks are what was evaluated, headlines, counts, breakdowns and notes.

    Args:
        summary: Summary as made by `EvaluationRun.summary` and stored in `metrics_summary.json`.
        by: Names of the breakdowns to show.
    """
    partial = summary["partial"]
    mark = ""
    if partial is not None:
        mark = f"   {partial['mark']}"
    metrics = summary["metrics"]
    blocks = [
        ("evaluated", _head(summary)),
        ("results", _headlines(summary)),
        ("predictors", predictors_text(metrics)),
        ("means", _means_text(summary)),
    ]
    for extra, numbers in further_results(summary):
        blocks.append((extra.title, extra.text(numbers)))
    blocks.append(("counts", _counts(metrics)))
    for name in by:
        if name in summary["breakdowns"]:
            blocks.append((f"by {name}", _breakdown(summary, name)))
    notes = [*notes_of(metrics), *reading_notes(summary)]
    blocks.append(("notes", "\n".join(notes)))
    return "\n\n".join(f"{title}{mark}\n{_indented(text)}" for title, text in blocks if text)


def _head(summary: Json) -> str:
    """Return aligned lines on what was evaluated."""
    release, results = summary["release"], summary["results"]
    lines = {
        "task": _task_text(summary),
        "samples": _samples_text(summary),
        "predictions": f"{results['path']} ({results['fingerprint']}){_left_out_text(summary)}",
    }
    sent = sent_bytes(summary)
    if sent:
        lines["bytes"] = sent.text()
    lines |= {
        "release": f"{release['dataroot']} ({release['version']}, {release['fingerprint']})",
        "devkit": summary["devkit_version"],
    }
    return _aligned(lines)


def _task_text(summary: Json) -> str:
    """Return the task, its protocol and the changed switches."""
    switches = ", ".join(f"{name}={value!r}" for name, value in summary["switches"].items())
    changes = ""
    if switches:
        changes = f" with {switches}"
    return f"{summary['task']}, protocol {summary['protocol']}{changes}"


def _samples_text(summary: Json) -> str:
    """Return how many samples were evaluated, and how they were selected."""
    counts = summary["counts"]
    agents = "all agents" if summary["agents"] is None else ", ".join(summary["agents"])
    horizon = ""
    if "means" not in summary["metrics"]:
        horizon = f", horizon {summary['horizon']:g} s"
    return (
        f"{counts['samples']} of {counts['scenarios']} scenarios: split {summary['split']}, list "
        f"{summary['samples']}, scope {summary['scope']}, {agents}{horizon}"
    )


def _left_out_text(summary: Json) -> str:
    """Return how many predictions were left out; empty if none were."""
    left_out = summary["counts"].get("left_out", 0)
    if not left_out:
        return ""
    return f"; left out: {counted(left_out, 'prediction')} of other samples"


def _aligned(lines: Json) -> str:
    width = max(map(len, lines), default=0)
    return "\n".join(f"{name:<{width}}  {text}".strip() for name, text in lines.items())


def _headlines(summary: Json) -> str:
    """Return the table of the headlines, with intervals and alternatives where the run has them."""
    overall = summary["breakdowns"].get("all")
    groups = overall["groups"] if overall else []
    intervals = groups[0]["intervals"] if groups else {}
    alternatives: Mapping[str, Any] = summary["metrics"].get("beside") or {}
    titles = ["number", "value", *(f"if {name}" for name in alternatives)]
    if intervals:
        titles.insert(2, f"{overall['resampling']['confidence']:.0%} interval")
    rows = [titles]
    missing = []
    for headline in summary["headlines"]:
        row = [headline["name"], headline["text"]]
        if intervals:
            interval = _interval(intervals.get(headline["path"]))
            row.append(interval)
            if interval == "–" != headline["text"]:
                missing.append(headline["name"])
        for metrics in alternatives.values():
            row.append(_number(_value_at(metrics, headline["path"])))
        rows.append(row)
    notes = groups[0]["notes"] if groups else []
    if intervals:
        notes = []
        if missing:  # by the names of the rows, some of which may have no interval
            names = ", ".join(missing)
            notes = [f"no interval of {names}: too few clusters have or change them"]
    return "\n".join([columns_text(rows), *notes])


def _counts(metrics: Json) -> str:
    """Return a line for each part of the metrics that holds whole numbers."""
    lines = {}
    for part, numbers in _whole_numbers(metrics, ""):
        lines[part] = ", ".join(f"{name} {number}" for name, number in numbers.items())
    return _aligned(lines)


def _whole_numbers(part: Json, path: str) -> Iterator[tuple[str, dict[str, str]]]:
    """Yield the path of each part with whole numbers, and their texts by name."""
    texts = {name: _whole_number(value) for name, value in part.items()}
    numbers = {name: text for name, text in texts.items() if text}
    if numbers:
        yield path, numbers
    for name, value in part.items():
        if isinstance(value, Mapping) and name not in _PARTS_WITHOUT_COUNTS:
            yield from _whole_numbers(value, f"{path}/{name}" if path else name)


def _whole_number(value: object) -> str:
    """Return the text of a whole number, or of several; empty for anything else."""
    numbers = value if isinstance(value, list) else [value]
    if all(type(number) is int for number in numbers):
        return "+".join(map(str, numbers))
    return ""


def _breakdown(summary: Json, name: str) -> str:
    """Return the table of a breakdown: the headlines of each group."""
    headlines = summary["headlines"][:_MAX_HEADLINES]
    titles = []
    for headline in headlines:
        unit = "" if headline["unit"] == "share" else f", {headline['unit']}"
        titles.append(headline["name"] + unit)
    rows = [("value", "samples", "scenarios", *titles)]
    for group in summary["breakdowns"][name]["groups"]:
        numbers = (_number(group["headlines"].get(headline["path"])) for headline in headlines)
        value = "unknown" if group["value"] is None else group["value"]
        rows.append((value, str(group["samples"]), str(group["scenarios"]), *numbers))
    return columns_text(rows)


def notes_of(metrics: Json) -> Iterator[str]:
    """Yield the notes of a result beside its numbers, each sentence once."""
    yield from dict.fromkeys(metrics.get("notes") or ())
    for name, alternative in (metrics.get("beside") or {}).items():
        for note in alternative.get("notes") or ():
            if note not in metrics["notes"]:
                yield f"if {name}: {note}"


def _value_at(part: Any, path: str) -> Any:
    """Return the value at a path such as `ranges/30x30/iou`; None if there is none."""
    for name in path.split("/"):
        part = part.get(name) if isinstance(part, Mapping) else None
    return part


def _number(value: float | None) -> str:
    if value is None:
        return "–"
    return f"{value:.3f}"


def _interval(ends: Sequence[float | None] | None) -> str:
    if not ends:
        return "–"
    low, high = ends
    if low is None or high is None:
        return "–"
    return f"[{low:.3f}, {high:.3f}]"


def _indented(text: str) -> str:
    return "\n".join(f"  {line}" for line in text.splitlines())


def predictor_tables(metrics: Json) -> list[Table]:
    """Return a table for each group of recordings in the metrics of a summary of warnings.

    The list is empty if the metrics have no references.
    """
    references: Mapping[str, Json] | None = metrics.get("references")
    if not references:
        return []
    is_clean = "groups" in metrics
    groups: Mapping[str, Json] = metrics["groups" if is_clean else "figures"]
    tables = []
    for group, figures in groups.items():
        columns = _CLEAN_COLUMNS if is_clean else _FIELD_COLUMNS[group.partition(" ")[0]]
        predictors = {GIVEN: figures}
        for name, reference in references.items():
            predictors[name] = reference[group]
        rows = [(group, *columns)]
        for name, numbers in predictors.items():
            rows.append((name, *(_cell(numbers, path) for path in columns.values())))
        notes = tuple(_operating(metrics, figures)) if is_clean else ()
        tables.append(Table(rows=tuple(rows), notes=notes))
    return tables


def predictors_text(metrics: Json) -> str:
    """Return all tables of `predictor_tables` as aligned lines; empty without any."""
    return "\n\n".join(table.to_text() for table in predictor_tables(metrics))


def means_tables(summary: Json) -> dict[str, Table]:
    """Return the tables of a summary of means by name.

    The column `n` is the number of samples of a row; a mean over fewer samples has its own number
    behind it. Numbers are columns, or rows if there are many more of them than rows.
    """
    tables, metrics = {}, summary["metrics"]
    metric_rows = evaluator_class(summary["task"]).result_class.rows
    units = {row.path.rpartition("/")[2]: row.unit for row in metric_rows}
    for name, means in (metrics.get("means") or {}).items():
        counts = metrics["counted"][name]
        columns = dict.fromkeys(column for row in means.values() for column in row)
        headings = (f"{column}, {units[column]}" for column in columns)
        cells = [(name, "n", *headings)]
        for row, values in means.items():
            row_counts = counts[row]
            row_count = max(row_counts.values())
            texts = [
                _mean(values.get(column), row_counts.get(column, 0), row_count)
                for column in columns
            ]
            cells.append((row, f"{row_count:,}", *texts))
        is_wide = len(cells[0]) > len(cells) + _MAX_EXTRA_COLUMNS
        tables[name] = Table(rows=list(zip(*cells, strict=True)) if is_wide else cells)
    return tables


def _mean(value: float | None, count: int, row_count: int) -> str:
    if value is None:
        return "–"
    if count == row_count:
        return f"{value:.2f}"
    return f"{value:.2f} ({count:,})"


def _means_text(summary: Json) -> str:
    """Return the tables that the headlines come from, and the names of the other tables."""
    tables = means_tables(summary)
    if not tables:
        return ""
    main_names = {headline["path"].split("/")[1] for headline in summary["headlines"]}
    texts = [table.to_text() for name, table in tables.items() if name in main_names]
    other_names = "; ".join(name for name in tables if name not in main_names)
    if other_names:
        texts.append(f"also in metrics_summary.json and the report: {other_names}")
    return "\n\n".join(texts)


def _cell(numbers: Json, path: str) -> str:
    return number_text(_value_at(numbers, path))


def number_text(value: float | None) -> str:
    """Return the text of a number in a table; a dash for None."""
    if value is None:
        return "–"
    if abs(value) < 10:
        return f"{value:.3f}"
    return f"{value:.1f}"


def _operating(metrics: Json, figures: Json) -> Iterator[str]:
    """Yield notes on the threshold of a group, and on the time left after a latency."""
    threshold = figures["operating"]["threshold"]
    threshold_text = "none" if threshold is None else f"{threshold:.4g}"
    source = "of recall 0.8, or the highest, on these recordings"
    if metrics["operating_by"] == "given":
        source = "given"
    other_thresholds = ", ".join(f"{name} {_cell(figures, name)}" for name in _THRESHOLD_NAMES)
    yield f"threshold {threshold_text} ({source}); for another split: {other_thresholds}"
    times_after = figures["tta0_after"]
    if times_after:
        texts = []
        for latency, seconds in times_after.items():
            texts.append(f"{latency} s: {'–' if seconds is None else f'{seconds:.3f} s'}")
        yield f"tta0 if the two who collide are told after a latency of {', '.join(texts)}"


def results_text(results: Results) -> str:
    """Return aligned lines on results: their task and path, samples, agents, notes and form."""
    tokens = results.tokens
    scenarios = set(map(scenario_of, tokens))
    agents = Counter(map(agent_of, tokens))
    lines = {
        "results": f"{results.task}, {results.path}",
        "fingerprint": results.fingerprint,
        "samples": f"{len(tokens)} of {len(scenarios)} scenarios",
        "agents": ", ".join(f"{name} {count}" for name, count in sorted(agents.items())),
        "meta": shortened(json.dumps(results.meta, ensure_ascii=False), _MAX_META_LENGTH),
    }
    form = results.form
    if form is not None:
        lines["form"] = (
            f"{form.stored}, up to {form.predictions} predictions of {form.frames} frames, "
            f"{form.step:g} s apart, cells x {form.grid.x}, y {form.grid.y}, orientation "
            f"{form.grid.orientation}, labels {form.labels}"
        )
    return _aligned(lines)


def reading_notes(summary: Json) -> list[str]:
    """Return sentences that help to read a summary's numbers.

    They name cells, frames and predictions that differ from the published ones, and other limits.
    """
    form, metrics = summary["results"]["form"], summary["metrics"]
    notes: list[str] = []
    if form is not None:
        notes += _cells(form, metrics.get("ranges") or ())
        notes += _frames(form, summary["horizon"])
    is_released = summary["protocol"] == "released"
    if summary["task"] == "motion":
        notes += _paths(metrics)
    elif summary["task"] == "accident" and is_released and form is not None:
        notes += _predictions(form)
    elif summary["task"] == "planning":
        notes += _infeasible(metrics)
    elif summary["task"] == "detection" and is_released:
        notes.append(
            "released: hidden boxes and the agent's own are truth, a class without true boxes "
            "counts as 0, an error as 1 where a recall is not reached, velocities are the label's "
            "raw ones; --protocol paper leaves these out"
        )
    return notes


def _infeasible(metrics: Json) -> Iterator[str]:
    for table, rows in metrics["means"].items():
        percent = rows[GIVEN].get("infeasible") or 0.0
        if percent >= _MIN_INFEASIBLE_PERCENT:
            yield (
                f"suspicious: {percent:.0f} % of the plans of {table} cannot be driven; --sanity "
                "looks for mistakes"
            )


def _cells(form: Json, ranges: Sequence[str]) -> Iterator[str]:
    """Yield notes on cells that differ from the published ones, and on ranges beyond the maps."""
    if form["x"] == form["y"] == _PUBLISHED_CELLS:
        return
    axes = [f"{name} from {form[name][0]:g} to {form[name][1]:g} m" for name in "xy"]
    yield (
        f"the maps have cells of {form['x'][2]:g} m, {', '.join(axes)}, and so have the labels "
        "that they are compared with; published numbers are of cells of 0.5 m, x and y from -50 "
        "to 50 m, and cannot be compared with these"
    )
    ends = [*form["x"][:2], *form["y"][:2]]
    reach = min(map(abs, ends))
    for name in ranges:
        if max(map(float, name.split("x"))) > 2 * reach:
            yield f"{name}: the maps end before this range does; only their cells count"


def _frames(form: Json, horizon: float) -> Iterator[str]:
    frame_count = round(horizon / form["step"]) + 1
    if form["frames"] > frame_count:
        yield (
            f"predictions have {form['frames']} frames; the first {frame_count} are evaluated, "
            "and the first of all must be the present: leave out past frames"
        )


def _predictions(form: Json) -> Iterator[str]:
    if form["stored"] == "instances":
        yield (
            "instance maps: cannot be compared with published APA, which is of heads "
            "(docs/numbers.md)"
        )
    if form["predictions"] < _PUBLISHED_PREDICTIONS:
        yield (
            f"predictions of a sample: {form['predictions']}; published numbers are of "
            f"{_PUBLISHED_PREDICTIONS}, five samples and then their mean"
        )


def _paths(metrics: Json) -> Iterator[str]:
    matched = metrics["paths"]
    true = metrics["path_true_positive"] + metrics["path_false_negative"]
    if matched < _MIN_PATH_SHARE * true:
        yield (
            f"{matched} of {true} true paths have a match; min_ade, min_fde and miss_rate are of "
            "these alone"
        )
