"""The sections of a report, each from a run's summary or its results; all text is escaped."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

from deepaccident_devkit.evaluation.metrics.attributes import EVERYTHING
from deepaccident_devkit.evaluation.metrics.breakdowns import Breakdown, Group
from deepaccident_devkit.evaluation.metrics.detection import DetectionResult
from deepaccident_devkit.evaluation.metrics.headlines import Headline, headlines, value_text
from deepaccident_devkit.evaluation.metrics.intervals import LEAST_CLUSTERS
from deepaccident_devkit.evaluation.runs import EvaluationRun
from deepaccident_devkit.evaluation.runs.predictors import PredictorTable, predictor_tables
from deepaccident_devkit.evaluation.runs.prevention import prevention_tables
from deepaccident_devkit.evaluation.runs.sanity import NOTHING_WRONG
from deepaccident_devkit.evaluation.runs.text import reading_notes
from deepaccident_devkit.render.evaluation.breakdowns import UNKNOWN
from deepaccident_devkit.render.markup import Markup, facts, joined, number, scalar, table, tag, tree

_BETTER: Final = {True: "higher", False: "lower", None: ""}
_PARTS: Final = {
    "truths": "Actors in the samples' true accidents",
    "within": "By the allowed distance (m)",
    "ranges": "By range",
    "classes": "By class",
    "beside": "With other choices, always reported as well",
}
"""Field of a result → heading of its table."""
_COUNTED: Final = ("thresholds", "truths", "detections")
"""What is known of a class without true boxes."""
_SHOWN_META: Final = ("method", "name", "authors", "url", "date")
"""Fields that results give about themselves and that are shown at the top, if there are any."""


def header(run: EvaluationRun) -> Markup:
    """What was evaluated, and how."""
    setup, selection = run.setup, run.selection
    meta = {name: scalar(run.results.meta[name]) for name in _SHOWN_META if name in run.results.meta}
    summary = run.summary()
    changed = ", ".join(f"{name} = {scalar(value)}" for name, value in setup.switches.items())
    rows = {
        "task": setup.task,
        "protocol": setup.protocol + (f", but {changed}" if changed else ""),
        **meta,
        "samples": f"{summary['counts']['samples']:,} of {summary['counts']['scenarios']:,} scenarios",
        "selection": selection.text(),
        **({} if setup.task == "detection" else {"horizon": f"{setup.horizon:g} s"}),
        "results": run.results.path,
        "results' hash": run.results.fingerprint,
        "release": f"{run.release.version}, {run.release.dataroot}",
        "release's hash": run.release.fingerprint,
        "devkit": summary["devkit_version"],
        "made with": ", ".join(f"{name} {version}" for name, version in summary["environment"].items()),
    }
    return facts(rows)


def headline_table(run: EvaluationRun) -> Markup:
    """The headline numbers, with intervals if the run has them."""
    everything = next((each for each in run.breakdowns if each.by == EVERYTHING), None)
    group = everything.groups[0] if everything is not None and everything.groups else None
    rows = [
        [each.name, each.text(), _interval_text(each, group), _BETTER[each.higher_is_better]]
        for each in _headlines(run.setup.task, run.result)
    ]
    percent = f"{100 * everything.resampling.confidence:g} % interval" if everything is not None else "interval"
    notes = [tag("p", note, class_="note") for note in (() if group is None else group.notes)]
    return joined([tag("div", table(["number", "value", percent, "better"], rows), class_="big"), *notes])


def predictors(run: EvaluationRun) -> Markup:
    """The predictions beside predictors that know nothing or only the present; empty except for warnings."""
    return _tables(predictor_tables(run.result.as_dict()))


def prevention(run: EvaluationRun) -> Markup:
    """The accidents that the alarms would have prevented, beside the braking for nothing; empty without."""
    prevented = run.summary().get("prevented")
    if prevented is None:
        return Markup("")
    notes = [*prevented["notes"], *prevented["interval_notes"]]
    return joined([_tables(prevention_tables(prevented)), *(tag("p", each, class_="note") for each in notes)])


def counts(run: EvaluationRun) -> Markup:
    """What was counted: the whole numbers of a result, its notes, and its other tables."""
    told = run.result.as_dict()
    numbers = {name: number(value) for name, value in told.items() if isinstance(value, int)}
    named = {title: told[name] for name, title in _PARTS.items() if told.get(name)}
    for name in _absent_classes(run.result):
        row = told["classes"][name]
        row.update({key: None for key in row if key not in _COUNTED})
    said = [*(told.get("notes") or ()), *reading_notes(run.summary())]
    notes = [tag("p", str(note), class_="note") for note in said]
    parts = [tag("div", tag("h3", title), _columns(value)) for title, value in named.items()]
    return joined([facts(numbers), *notes, *parts])


def breakdowns(run: EvaluationRun) -> Iterator[Markup]:
    """A table for each attribute, and a table of only the vehicles below it if the numbers of samples differ.

    If all samples have the same value of an attribute, only this value is given.
    """
    same = {each.by: each.groups[0].value or UNKNOWN for each in run.breakdowns if len(each.groups) == 1}
    for each in run.breakdowns:
        if each.by not in same:
            yield tag("h3", f"by {each.by.replace('_', ' ')}")
            yield _groups(run.setup.task, each, each.groups, "all agents")
            if _samples(each.without_infrastructure) != _samples(each.groups):
                below = _groups(run.setup.task, each, each.without_infrastructure, "without the roadside")
                yield tag("details", tag("summary", "without the roadside's samples"), below)
    named = [f"{name.replace('_', ' ')} {value}" for name, value in same.items() if name != EVERYTHING]
    if named:
        yield tag("p", f"The same in all samples: {', '.join(named)}.")


def sanity(report: Mapping[str, Any]) -> Markup:
    """What a sanity check says.

    Args:
        report: as `SanityReport.as_dict` has it.
    """
    looked = [
        [each["name"], _share(each["given"]), _share(each["score"]), scalar(each["suspected"]), each["description"]]
        for each in report["candidates"]
    ]
    found = [tag("p", each, class_="warning") for each in report["warnings"]] or [tag("p", NOTHING_WRONG)]
    heading = ["mistake", "fits as given", "fits if undone", "suspected", "what is right"]
    mistakes = table(heading, looked, f"of {report['samples']:,} samples")
    return joined([*found, tag("details", tag("summary", "All mistakes that were looked for"), mistakes)])


def choices(run: EvaluationRun) -> Markup:
    """Every switch of the protocol, and all other settings; closed until the reader opens them."""
    given = run.setup.as_dict()
    said = [("Every switch of the protocol", given["settings"]), ("Selection of samples", run.selection.as_dict())]
    if run.results.form is not None:
        said.append(("Form of the results", run.results.form))
    if run.results.meta:
        said.append(("What the results say about themselves", run.results.meta))
    return joined(
        tag("details", tag("summary", name), tag("div", tree(value), class_="wide text")) for name, value in said
    )


def checking() -> Markup:
    """How others can check the numbers."""
    return joined(
        [
            tag(
                "p",
                "This report is one file of a bundle. Anyone who has the bundle, the results and the release can "
                "compute all numbers again, and the command lists all that differ:",
            ),
            tag("p", tag("code", "deepaccident evaluate verify DIR --dataroot DATAROOT --results RESULTS")),
            tag(
                "p",
                "The release's hash is made of the label, meta and calib files of each scenario evaluated "
                "(scenarios.json).",
            ),
        ]
    )


def _groups(task: str, broken: Breakdown[Any], groups: Sequence[Group[Any]], whose: str) -> Markup:
    names = list(dict.fromkeys(each.name for group in groups for each in _headlines(task, group.result)))
    rows = []
    for group in groups:
        known = {each.name: each for each in _headlines(task, group.result)}
        cells = [_cell(known.get(name), group) for name in names]
        label = UNKNOWN if group.value is None else group.value
        rows.append([label, f"{group.samples:,}", f"{group.scenarios:,}", *cells])
    how = f"{100 * broken.resampling.confidence:g} % intervals, if there are {LEAST_CLUSTERS} clusters"
    return table([broken.by.replace("_", " "), "samples", "scenarios", *names], rows, f"{whose}; {how}")


def _headlines(task: str, result: object) -> list[Headline]:
    """The headlines as a report shows them: a class without true boxes has no value, also where the rules count 0."""
    paths = {f"class_average_precision/{name}" for name in _absent_classes(result)}
    return [replace(each, value=None) if each.path in paths else each for each in headlines(task, result)]


def _absent_classes(result: object) -> list[str]:
    """Classes without true boxes, of a detection's result."""
    if not isinstance(result, DetectionResult):
        return []
    return [name for name, truths in zip(result.classes, result.truths.sum(axis=1), strict=True) if not truths]


def _cell(headline: Headline | None, group: Group[Any]) -> Markup:
    if headline is None:
        return joined(["–"])
    interval = _interval_text(headline, group)
    return joined([headline.text(), *([tag("div", interval, class_="interval")] if interval else [])])


def _interval_text(headline: Headline, group: Group[Any] | None) -> str:
    low, high = (math.nan, math.nan) if group is None else group.intervals.get(headline.path, (math.nan, math.nan))
    if headline.value is None or math.isnan(low) or math.isnan(high):
        return ""
    digits = 2 if headline.unit == "%" else 3
    return f"{low:.{digits}f} to {high:.{digits}f}"


def _columns(value: Any) -> Markup:
    """A mapping of mappings as a table with one row each, a mapping of numbers as facts, pairs as ranges."""
    if not isinstance(value, Mapping):
        return tag(
            "p", "; ".join(f"{low:g} m and more" if high is None else f"{low:g} to {high:g} m" for low, high in value)
        )
    if not all(isinstance(each, Mapping) for each in value.values()):
        return facts({str(name): number(each) for name, each in value.items()})
    names = list(dict.fromkeys(name for each in value.values() for name in each))
    plain = [name for name in names if not any(isinstance(each.get(name), Mapping) for each in value.values())]
    return table(["", *plain], [[key, *(number(each.get(name)) for name in plain)] for key, each in value.items()])


def _tables(tables: Sequence[PredictorTable]) -> Markup:
    return joined(
        joined(
            [table(list(each.rows[0]), [list(row) for row in each.rows[1:]]), *(tag("p", note) for note in each.notes)]
        )
        for each in tables
    )


def _samples(groups: Sequence[Group[Any]]) -> int:
    return sum(group.samples for group in groups)


def _share(value: float | None) -> str:
    return "–" if value is None else f"{value:.3f}"
