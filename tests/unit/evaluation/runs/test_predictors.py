"""Tables of predictors that know nothing, and thresholds that another split chose; of metrics made by hand."""

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from refusals import assert_refused

from deepaccident_devkit.errors import EvaluationError, ResultsError
from deepaccident_devkit.evaluation.runs import bundles
from deepaccident_devkit.evaluation.runs.bundles import chosen_threshold
from deepaccident_devkit.evaluation.runs.text import number_text, predictor_tables, predictors_text

TRAINED = "type1_subtype1_accident/Town01_000"
OTHER = "type1_subtype1_normal/Town02_000/ego_vehicle/001"
CLEAN = ("auc_ahead", "twin_wins", "average_precision", "mean_time")
AT_POINT = (
    "precision",
    "time_in_alarm",
    "alarm_seconds_per_minute",
    "episodes_per_minute",
    "recall",
    "tta0",
    "tta_hit",
)
FIELD = ("average_precision", "mean_time", "time_at_r80")


def clean(first: float, **more: Any) -> dict[str, Any]:
    """Numbers that rise by a hundredth from column to column."""
    columns = dict(zip((*CLEAN, *AT_POINT), (first + at / 100 for at in range(11)), strict=True))
    operating = {name: columns.pop(name) for name in AT_POINT} | {"threshold": 0.123456}
    return columns | {"operating": operating, "tta0_after": {}, "best_f1": 0.25, "quiet": None} | more


def test_a_table_a_group_of_the_protocol_clean() -> None:
    groups = {"ego_involved": clean(0.1), "bystander": clean(0.2, tta0_after={"0.0": 1.5, "0.3": None})}
    references = {"always": {"ego_involved": clean(9.95), "bystander": clean(-9.95)}}
    metrics = {"groups": groups, "references": references, "operating_by": "given"}
    one, other = predictor_tables(metrics)
    assert one.rows[0] == (
        *("ego_involved", "auc_ahead", "twin_wins", "AP", "mTTA", "precision", "in alarm", "s/min", "runs/min"),
        *("recall", "tta0", "tta_hit"),
    )
    assert one.rows[1] == ("given", *(f"{0.1 + at / 100:.3f}" for at in range(11)))
    assert one.rows[2] == ("always", "9.950", "9.960", "9.970", "9.980", "9.990", *(["10.0"] * 6))
    assert [row[:2] for row in other.rows[1:]] == [("given", "0.200"), ("always", "-9.950")]
    assert one.notes == ("threshold 0.1235 (given); for another split: best_f1 0.250, quiet –",)
    assert other.notes[1:] == ("tta0 if the two who collide are told after a latency of 0.0 s: 1.500 s, 0.3 s: –",)
    assert predictors_text(metrics) == f"{one.to_text()}\n\n{other.to_text()}"
    metrics |= {"operating_by": "recall"}
    groups["ego_involved"]["operating"]["threshold"] = None
    assert (
        predictor_tables(metrics)[0]
        .notes[0]
        .startswith("threshold none (of recall 0.8, or the highest, on these recordings); for")
    )


@pytest.mark.parametrize(
    ("code", "more"),
    [
        ("ustring", {}),
        ("dsta", {"P@R80": "precision_at_r80"}),
        ("drive", {"P@0.5": "precision_at_half", "R@0.5": "recall_at_half", "TTA@0.5": "time_at_half"}),
        ("dad", {}),
    ],
)
def test_a_published_code_has_columns_of_its_own(code: str, more: dict[str, str]) -> None:
    names = (*FIELD, *more.values())
    figures = {f"{code} bystander": {name: at / 8 for at, name in enumerate(names)}}
    (table,) = predictor_tables({"figures": figures, "references": {"never": figures}})
    assert table.rows[0] == (f"{code} bystander", "AP", "mTTA", "TTA@R80", *more)
    assert table.rows[1:] == tuple(
        (name, *(f"{at / 8:.3f}" for at in range(len(names)))) for name in ("given", "never")
    )
    assert table.notes == ()


@pytest.mark.parametrize(
    ("value", "text"),
    [(None, "–"), (0.0, "0.000"), (9.9994, "9.999"), (-10.0, "-10.0"), (10.0, "10.0"), (-9.5, "-9.500")],
)
def test_numbers(value: float | None, text: str) -> None:
    assert number_text(value) == text


def stored(monkeypatch: pytest.MonkeyPatch, **summary: Any) -> None:
    """A bundle with this summary, of one scenario."""
    whole = {"task": "warning", "protocol": "clean", **summary}
    bundle = SimpleNamespace(summary=whole, scenarios=lambda: {TRAINED: "hash"})
    monkeypatch.setattr(bundles, "read_bundle", lambda _: bundle)


@pytest.mark.parametrize(
    ("summary", "by", "error", "sentence"),
    [
        (
            {"task": "motion"},
            "quiet",
            EvaluationError,
            "^b: is an evaluation of motion clean; expected one of warning, p",
        ),
        (
            {"protocol": "field"},
            "quiet",
            EvaluationError,
            "^b: is an evaluation of warning field; expected one of warn",
        ),
        ({}, "quiet", ResultsError, "^b: its summary has no metrics of warnings; evaluate again$"),
        ({"prevented": None}, "braking", ResultsError, "no prevented accidents; evaluate again with --prevented$"),
        ({"metrics": {"groups": {"bystander": {}}}}, "quiet", ResultsError, "has no metrics of warnings"),
        ({"metrics": {"groups": {}}}, "best_f1", EvaluationError, "^b: found no threshold by best_f1; choose another"),
        ({"metrics": {"groups": {"bystander": {"quiet": None}}}}, "quiet", EvaluationError, "found no threshold by qu"),
        ({"metrics": {"groups": {"bystander": {"quiet": math.inf}}}}, "quiet", EvaluationError, "found no threshold"),
    ],
)
def test_evaluations_without_a_threshold(
    monkeypatch: pytest.MonkeyPatch, summary: dict[str, Any], by: Any, error: type[Exception], sentence: str
) -> None:
    stored(monkeypatch, **summary)
    assert_refused(
        (lambda: chosen_threshold(Path("b"), by, [OTHER]), error, sentence),
    )
