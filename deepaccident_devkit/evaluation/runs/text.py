"""Texts of runs, bundles and results files, and the table of predictors that know nothing, for warnings.

Every block of a partial run says that it is partial. `reading_notes` are what a reader has to know before comparing the
numbers with published ones.
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
# Headlines that a breakdown shows.
_COLUMNS: Final = 5
# Parts of the metrics that hold no counts of the samples.
_NOT_COUNTED: Final = ("beside", "notes", "curve", "references", "counted")
_PUBLISHED_CELLS: Final = [-50.0, 50.0, 0.5]
_PUBLISHED_PREDICTIONS: Final = 6
# Share of true paths with a match below which errors of paths say little of the others.
_FEW_PATHS: Final = 0.9
# Percent of plans from which on something is probably wrong with them.
_MOST_INFEASIBLE: Final = 90
# Letters of the notes in results that are shown; they may hold a hash a scenario.
_META: Final = 1000
# Thresholds that are told for another split.
_TOLD: Final = ("best_f1", "quiet")
# Of the protocol `clean`. Recall and seconds never stand without precision and the time in alarm.
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
    """A summary as blocks of aligned lines: what was evaluated, headlines, counts, breakdowns, notes.

    Args:
        summary: as `EvaluationRun.summary` makes it and `metrics_summary.json` has it.
        by: which of its breakdowns to show.
    """
    mark = "" if summary["partial"] is None else f"   {summary['partial']['mark']}"
    blocks = [
        ("evaluated", _head(summary)),
        ("results", _headlines(summary)),
        ("predictors", predictors_text(summary["metrics"])),
        ("means", _means_text(summary)),
        *((each.title, each.text(part)) for each, part in further_results(summary)),
        ("counts", _counts(summary["metrics"])),
        *(
            (f"by {name}", _breakdown(summary, name))
            for name in by
            if name in summary["breakdowns"]
        ),
        ("notes", "\n".join([*notes_of(summary["metrics"]), *reading_notes(summary)])),
    ]
    return "\n\n".join(f"{title}{mark}\n{_indented(text)}" for title, text in blocks if text)


def _head(summary: Json) -> str:
    switches = ", ".join(f"{name}={value!r}" for name, value in summary["switches"].items())
    agents = "all agents" if summary["agents"] is None else ", ".join(summary["agents"])
    release, results, counts = summary["release"], summary["results"], summary["counts"]
    left_out = counts.get("left_out", 0)
    others = f"; left out: {counted(left_out, 'prediction')} of other samples" if left_out else ""
    horizon = f", horizon {summary['horizon']:g} s" if "means" not in summary["metrics"] else ""
    lines = {
        "task": f"{summary['task']}, protocol {summary['protocol']}{f' with {switches}' if switches else ''}",
        "samples": f"{counts['samples']} of {counts['scenarios']} scenarios: split {summary['split']}, list "
        f"{summary['samples']}, scope {summary['scope']}, {agents}{horizon}",
        "predictions": f"{results['path']} ({results['fingerprint']}){others}",
        **({"bytes": sent.text()} if (sent := sent_bytes(summary)) else {}),
        "release": f"{release['dataroot']} ({release['version']}, {release['fingerprint']})",
        "devkit": summary["devkit_version"],
    }
    return _aligned(lines)


def _aligned(lines: Json) -> str:
    width = max(map(len, lines), default=0)
    return "\n".join(f"{name:<{width}}  {text}".strip() for name, text in lines.items())


def _headlines(summary: Json) -> str:
    everyone = summary["breakdowns"].get("all")
    groups = everyone["groups"] if everyone else []
    intervals = groups[0]["intervals"] if groups else {}
    beside: Mapping[str, Any] = summary["metrics"].get("beside") or {}
    percent = f"{everyone['resampling']['confidence']:.0%} interval" if intervals else ""
    rows = [
        ("number", "value", *([percent] if percent else []), *(f"if {name}" for name in beside))
    ]
    for each in summary["headlines"]:
        interval = [_interval(intervals.get(each["path"]))] if percent else []
        others = (_number(_at(part, each["path"])) for part in beside.values())
        rows.append((each["name"], each["text"], *interval, *others))
    notes = groups[0]["notes"] if groups else []
    if percent:  # by the names of the rows, of which some may have no interval
        names = [name for name, value, interval, *_ in rows if interval == "–" != value]
        notes = [f"no interval of {', '.join(names)}: too few clusters have or change them"] * bool(
            names
        )
    return "\n".join([columns_text(rows), *notes])


def _counts(metrics: Json) -> str:
    """A line for each part of the metrics that holds whole numbers."""
    return _aligned(
        {
            part: ", ".join(map(" ".join, numbers.items()))
            for part, numbers in _whole_numbers(metrics, "")
        }
    )


def _whole_numbers(part: Json, path: str) -> Iterator[tuple[str, dict[str, str]]]:
    here = {name: _whole(value) for name, value in part.items()}
    known = {name: text for name, text in here.items() if text}
    if known:
        yield path, known
    for name, value in part.items():
        if isinstance(value, Mapping) and name not in _NOT_COUNTED:
            yield from _whole_numbers(value, f"{path}/{name}" if path else name)


def _whole(value: object) -> str:
    """Text of a whole number, or of several; empty for all else."""
    numbers = value if isinstance(value, list) else [value]
    return (
        "+".join(map(str, numbers))
        if numbers and all(type(each) is int for each in numbers)
        else ""
    )


def _breakdown(summary: Json, name: str) -> str:
    shown = summary["headlines"][:_COLUMNS]
    names = (
        each["name"] + ("" if each["unit"] == "share" else f", {each['unit']}") for each in shown
    )
    rows = [("value", "samples", "scenarios", *names)]
    for group in summary["breakdowns"][name]["groups"]:
        values = (_number(group["headlines"].get(each["path"])) for each in shown)
        value = "unknown" if group["value"] is None else group["value"]
        rows.append((value, str(group["samples"]), str(group["scenarios"]), *values))
    return columns_text(rows)


def notes_of(metrics: Json) -> Iterator[str]:
    """What a result says beside its numbers, each sentence once."""
    yield from dict.fromkeys(metrics.get("notes") or ())
    for name, part in (metrics.get("beside") or {}).items():
        yield from (
            f"if {name}: {note}" for note in part.get("notes") or () if note not in metrics["notes"]
        )


def _at(part: Any, path: str) -> Any:
    for name in path.split("/"):
        part = part.get(name) if isinstance(part, Mapping) else None
    return part


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.3f}"


def _interval(ends: Sequence[float | None] | None) -> str:
    return "–" if not ends or None in ends else f"[{ends[0]:.3f}, {ends[1]:.3f}]"


def _indented(text: str) -> str:
    return "\n".join(f"  {line}" for line in text.splitlines())


def predictor_tables(metrics: Json) -> list[Table]:
    """A table for each group of recordings, of the metrics in a summary of warnings; none without references."""
    references: Mapping[str, Json] | None = metrics.get("references")
    if not references:
        return []
    clean = "groups" in metrics
    groups: Mapping[str, Json] = metrics["groups" if clean else "figures"]
    tables = []
    for group, given in groups.items():
        everyone = {GIVEN: given, **{name: each[group] for name, each in references.items()}}
        columns = _CLEAN_COLUMNS if clean else _FIELD_COLUMNS[group.partition(" ")[0]]
        rows = [
            (name, *(_cell(figures, path) for path in columns.values()))
            for name, figures in everyone.items()
        ]
        notes = tuple(_operating(metrics, given)) if clean else ()
        tables.append(Table(rows=((group, *columns), *rows), notes=notes))
    return tables


def predictors_text(metrics: Json) -> str:
    """All tables of `predictor_tables`, as aligned lines; empty without any."""
    return "\n\n".join(each.to_text() for each in predictor_tables(metrics))


def means_tables(summary: Json) -> dict[str, Table]:
    """The tables of a summary of means by name; `n` is of how many, and stands behind means of fewer.

    Numbers are the columns, or where they are more than the rows, these.
    """
    tables, metrics = {}, summary["metrics"]
    units = {
        row.path.rpartition("/")[2]: row.unit
        for row in evaluator_class(summary["task"]).result_class.rows
    }
    for name, means in (metrics.get("means") or {}).items():
        counted = metrics["counted"][name]
        columns = dict.fromkeys(column for row in means.values() for column in row)
        headings = (f"{column}, {units[column]}" for column in columns)
        most = {row: max(counts.values()) for row, counts in counted.items()}
        cells = [(name, "n", *headings)]
        for row, values in means.items():
            told = (
                _mean(values.get(each), counted[row].get(each, 0), most[row]) for each in columns
            )
            cells.append((row, f"{most[row]:,}", *told))
        wide = len(cells[0]) > len(cells) + _WIDER
        tables[name] = Table(rows=list(zip(*cells, strict=True)) if wide else cells)
    return tables


# More columns than rows from which a table is turned.
_WIDER: Final = 4


def _mean(value: float | None, count: int, most: int) -> str:
    return "–" if value is None else f"{value:.2f}" if count == most else f"{value:.2f} ({count:,})"


def _means_text(summary: Json) -> str:
    """The tables that headlines are of, and the names of the others."""
    tables = means_tables(summary)
    main = {each["path"].split("/")[1] for each in summary["headlines"]} if tables else ()
    others = "; ".join(name for name in tables if name not in main)
    texts = [table.to_text() for name, table in tables.items() if name in main]
    texts += [f"also in metrics_summary.json and the report: {others}"] * bool(others)
    return "\n\n".join(texts)


def _cell(figures: Json, path: str) -> str:
    return number_text(_at(figures, path))


def number_text(value: float | None) -> str:
    """A number of a table; a dash for none."""
    return "–" if value is None else f"{value:.3f}" if abs(value) < 10 else f"{value:.1f}"


def _operating(metrics: Json, given: Json) -> Iterator[str]:
    operating, after = given["operating"], given["tta0_after"]
    threshold = operating["threshold"]
    found = "none" if threshold is None else f"{threshold:.4g}"
    how = (
        "given"
        if metrics["operating_by"] == "given"
        else "of recall 0.8, or the highest, on these recordings"
    )
    others = ", ".join(f"{name} {_cell(given, name)}" for name in _TOLD)
    yield f"threshold {found} ({how}); for another split: {others}"
    if after:
        told = ", ".join(
            f"{latency} s: {'–' if left is None else f'{left:.3f} s'}"
            for latency, left in after.items()
        )
        yield f"tta0 if the two who collide are told after a latency of {told}"


def results_text(results: Results) -> str:
    """A few aligned lines: whose predictions, of which samples, in which form."""
    tokens = results.tokens
    agents = Counter(map(agent_of, tokens))
    lines = {
        "results": f"{results.task}, {results.path}",
        "fingerprint": results.fingerprint,
        "samples": f"{len(tokens)} of {len(set(map(scenario_of, tokens)))} scenarios",
        "agents": ", ".join(f"{name} {count}" for name, count in sorted(agents.items())),
        "meta": shortened(json.dumps(results.meta, ensure_ascii=False), _META),
    }
    form = results.form
    if form is not None:
        lines["form"] = (
            f"{form.stored}, up to {form.predictions} predictions of {form.frames} frames, {form.step:g} s apart, "
            f"cells x {form.grid.x}, y {form.grid.y}, orientation {form.grid.orientation}, labels {form.labels}"
        )
    return _aligned(lines)


def reading_notes(summary: Json) -> list[str]:
    """Sentences on a summary's numbers: cells, frames and predictions that published ones do not have, and others."""
    form, metrics = summary["results"]["form"], summary["metrics"]
    notes = (
        []
        if form is None
        else [*_cells(form, metrics.get("ranges") or ()), *_frames(form, summary["horizon"])]
    )
    released = summary["protocol"] == "released"
    if summary["task"] == "motion":
        notes += _paths(metrics)
    elif summary["task"] == "accident" and released and form is not None:
        notes += _predictions(form)
    elif summary["task"] == "planning":
        notes += _infeasible(metrics)
    elif summary["task"] == "detection" and released:
        notes.append(
            "released: hidden boxes and the agent's own are truth, a class without true boxes counts as 0, an error "
            "as 1 where a recall is not reached, velocities are the label's raw ones; --protocol paper leaves these out"
        )
    return notes


def _infeasible(metrics: Json) -> Iterator[str]:
    for table, rows in metrics["means"].items():
        share = rows[GIVEN].get("infeasible") or 0.0
        if share >= _MOST_INFEASIBLE:
            yield f"suspicious: {share:.0f} % of the plans of {table} cannot be driven; --sanity looks for mistakes"


def _cells(form: Json, ranges: Sequence[str]) -> Iterator[str]:
    if form["x"] == form["y"] == _PUBLISHED_CELLS:
        return
    axes = ", ".join(
        f"{name} from {low:g} to {high:g} m" for name in "xy" for low, high, _ in [form[name]]
    )
    yield (
        f"the maps have cells of {form['x'][2]:g} m, {axes}, and so have the labels that they are compared with; "
        "published numbers are of cells of 0.5 m, x and y from -50 to 50 m, and cannot be compared with these"
    )
    reach = min(abs(end) for name in "xy" for end in form[name][:2])
    for name in ranges:
        if max(float(side) for side in name.split("x")) > 2 * reach:
            yield f"{name}: the maps end before this range does; only their cells count"


def _frames(form: Json, horizon: float) -> Iterator[str]:
    needed = round(horizon / form["step"]) + 1
    if form["frames"] > needed:
        yield (
            f"predictions have {form['frames']} frames; the first {needed} are evaluated, and the first of all must be "
            "the present: leave out past frames"
        )


def _predictions(form: Json) -> Iterator[str]:
    if form["stored"] == "instances":
        yield "instance maps: cannot be compared with published APA, which is of heads (docs/numbers.md)"
    if form["predictions"] < _PUBLISHED_PREDICTIONS:
        yield (
            f"predictions of a sample: {form['predictions']}; published numbers are of {_PUBLISHED_PREDICTIONS}, five "
            "samples and then their mean"
        )


def _paths(metrics: Json) -> Iterator[str]:
    found = metrics["paths"]
    true = metrics["path_true_positive"] + metrics["path_false_negative"]
    if found < _FEW_PATHS * true:
        yield f"{found} of {true} true paths have a match; min_ade, min_fde and miss_rate are of these alone"
