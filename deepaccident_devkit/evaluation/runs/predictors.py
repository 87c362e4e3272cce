"""Predictions beside predictors that know nothing, and an operating point from another split: task `warning`."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final, Literal

from deepaccident_devkit.errors import EvaluationError, ResultsError
from deepaccident_devkit.evaluation.breakdowns import cluster_of
from deepaccident_devkit.evaluation.runs.bundles import read_bundle
from deepaccident_devkit.evaluation.runs.setups import scenario_of
from deepaccident_devkit.evaluation.warning.recordings import GIVEN, GROUPS
from deepaccident_devkit.reports import Table

Json = Mapping[str, Any]
Chooser = Literal["best_f1", "quiet", "braking"]
"""Which threshold of an evaluation is taken: of the best F1; of at most one second a minute in false alarm; or of at
most one second a minute of braking for false alarms, which the evaluation of prevented accidents finds."""
_TOLD: Final = ("best_f1", "quiet")
_COLUMNS: Final[Mapping[str, str]] = {
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
"""Of the protocol `clean`. Recall and seconds never stand without precision and the time in alarm."""
_PRINTED: Final = {"AP": "average_precision", "mTTA": "mean_time", "TTA@R80": "time_at_r80"}
_AT_HALF: Final = {"P@0.5": "precision_at_half", "R@0.5": "recall_at_half", "TTA@0.5": "time_at_half"}
_FIELD_COLUMNS: Final[Mapping[str, Mapping[str, str]]] = {
    "ustring": _PRINTED,
    "dsta": _PRINTED | {"P@R80": "precision_at_r80"},
    "drive": _PRINTED | _AT_HALF,
    "dad": _PRINTED,
}


def predictor_tables(metrics: Json) -> list[Table]:
    """A table for each group of recordings; none if the result has no references.

    Args:
        metrics: of a summary, as JSON holds an `AnticipationResult` or a `FieldResult`.
    """
    references: Mapping[str, Json] | None = metrics.get("references")
    if not references:
        return []
    clean = "groups" in metrics
    groups: Mapping[str, Json] = metrics["groups" if clean else "figures"]
    tables = []
    for group, given in groups.items():
        everyone = {GIVEN: given, **{name: each[group] for name, each in references.items()}}
        columns = _COLUMNS if clean else _FIELD_COLUMNS[group.partition(" ")[0]]
        rows = [(name, *(_cell(figures, path) for path in columns.values())) for name, figures in everyone.items()]
        notes = tuple(_operating(metrics, given)) if clean else ()
        tables.append(Table(rows=((group, *columns), *rows), notes=notes))
    return tables


def predictors_text(metrics: Json) -> str:
    """All tables of `predictor_tables`, as aligned lines; empty without any."""
    return "\n\n".join(each.to_text() for each in predictor_tables(metrics))


def chosen_threshold(folder: Path, by: Chooser, tokens: Iterable[str]) -> float:
    """The threshold that an evaluation of another split found best for the agents that are involved.

    A car does not know whether it will be involved, so that there is one threshold for all groups.

    Args:
        folder: bundle of an evaluation of the task `warning`, protocol `clean`.
        by: which of the thresholds found there.
        tokens: of the samples that are to be evaluated with it.

    Raises:
        ResultsError: there is no bundle.
        EvaluationError: it is of another task or protocol, has a scenario of these samples or its twin, or found no
            threshold.
    """
    bundle = read_bundle(folder)
    kind = tuple(bundle.summary.get(name) for name in ("task", "protocol"))
    if kind != ("warning", "clean"):
        raise EvaluationError(
            f"{folder}: is an evaluation of {' '.join(map(str, kind))}; expected one of warning, protocol clean"
        )
    own = {cluster_of(scenario) for scenario in bundle.scenarios()}
    shared = sorted({scenario for scenario in map(scenario_of, tokens) if cluster_of(scenario) in own})
    if shared:
        raise EvaluationError(
            f"{folder}: is an evaluation of {shared[0]} or its twin, too; a threshold that is chosen on the recordings "
            "it is tried on flatters: give one of another split, such as train or val"
        )
    try:
        groups: Mapping[str, Json] = bundle.summary["prevented" if by == "braking" else "metrics"]["groups"]
        group = next((name for name in GROUPS if name in groups), None)
        threshold = None if group is None else groups[group]["quiet_braking" if by == "braking" else by]
    except (LookupError, TypeError) as error:
        what, how = ("prevented accidents", " with --prevented") if by == "braking" else ("metrics of warnings", "")
        raise ResultsError(f"{folder}: its summary has no {what}; evaluate again{how}") from error
    if not isinstance(threshold, float) or not math.isfinite(threshold):
        raise EvaluationError(
            f"{folder}: found no threshold by {by}; choose another, or give one with --switch threshold=…"
        )
    return threshold


def _cell(figures: Json, path: str) -> str:
    value: Any = figures
    for name in path.split("/"):
        value = value[name]
    return number_text(value)


def number_text(value: float | None) -> str:
    """A number of a table; a dash for none."""
    return "–" if value is None else f"{value:.3f}" if abs(value) < 10 else f"{value:.1f}"


def _operating(metrics: Json, given: Json) -> Iterator[str]:
    operating, after = given["operating"], given["tta0_after"]
    threshold = operating["threshold"]
    found = "none" if threshold is None else f"{threshold:.4g}"
    how = "given" if metrics["operating_by"] == "given" else "of recall 0.8, or the highest, on these recordings"
    others = ", ".join(f"{name} {_cell(given, name)}" for name in _TOLD)
    yield f"threshold {found} ({how}); for another split: {others}"
    if after:
        told = ", ".join(f"{latency} s: {'–' if left is None else f'{left:.3f} s'}" for latency, left in after.items())
        yield f"tta0 if the two who collide are told after a latency of {told}"
