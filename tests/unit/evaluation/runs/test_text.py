"""Summaries for people: alike for a run and its bundle, marked where the run is partial; notes, and
predictors.
"""

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import EvaluationError, ResultsError
from deepaccident_devkit.evaluation import Resampling
from deepaccident_devkit.evaluation.results import Results, ResultsWriter, read_results
from deepaccident_devkit.evaluation.runs import (
    EvaluationRun,
    bundles,
    read_bundle,
    results_text,
    save_run,
    summary_text,
)
from deepaccident_devkit.evaluation.runs.bundles import chosen_threshold
from deepaccident_devkit.evaluation.runs.text import (
    predictor_tables,
    predictors_text,
    reading_notes,
    table_number_text,
)


def lines_of(text: str) -> list[str]:
    return [" ".join(line.split()) for line in text.splitlines()]


def test_the_summary_of_a_run(run: EvaluationRun) -> None:
    summary = run.broken_down(["all", "agent"], Resampling(resamples=10)).summary()
    lines = lines_of(summary_text(summary, ["agent"]))
    expected_lines = {
        "evaluated",
        "task accident, protocol boxes",
        "number value",
        "position error 0.283 m",
        "no confidence intervals: 1 scenario pair, at least 6 needed",
        (
            "samples 6, samples before an accident 3, samples without an accident 3, not scored 0, "
            "beyond the horizon 0, at the impact 0, position unknown 0"
        ),
        "within 5 m hits (TP) 3, false alarms (FP) 0, misses (FN) 0",
        "by agent",
        "ego vehicle 2 2 1.000 1.000 1.000 0.000 1.000",
    }

    assert expected_lines - {*lines} == set()


def test_the_bundle_on_disk_has_the_same_text(run: EvaluationRun, tmp_path: Path) -> None:
    broken_down = run.broken_down(["all", "agent"], Resampling(resamples=10))
    bundle = read_bundle(save_run(broken_down, tmp_path / "bundle"))
    assert summary_text(bundle.summary) == summary_text(broken_down.summary())


def test_the_text_of_a_results_file(results: Results, tmp_path: Path) -> None:
    assert lines_of(results_text(results))[2:4] == [
        "samples 6 from 2 scenarios",
        "agents ego vehicle 2, infrastructure 2, other vehicle 2",
    ]

    with ResultsWriter(tmp_path / "long", "accident", meta={"x": "y" * 50_000}) as writer:
        writer.add(results.tokens[0], [])

    assert len(results_text(read_results(tmp_path / "long"))) < 2000


def bytes_texts(meta: object) -> list[str]:
    """Return the summary's lines on bytes, for results with this `meta`."""
    results = {"path": "/p", "fingerprint": "g", "form": None, "meta": meta}
    lines = lines_of(summary_text({**SUMMARY, "results": results}))
    heading = "communication "
    return [line.removeprefix(heading) for line in lines if line.startswith(heading)]


@pytest.mark.parametrize(
    ("sent", "text"),
    [
        (
            {"mean": 2900.4, "partners": 4},
            "2,900 bytes per sample (2^11.5), 0.23 Mbit/s at 10 Hz, 4.0 partners, payload boxes",
        ),
        (
            {"mean": 0, "partners": 0.0},
            "none",
        ),
        (
            {"mean": 2.0**21, "partners": 1.5, "payload": 2**20, "shape": [8, 2]},
            (
                "2,097,152 bytes per sample (2^21.0), 167.77 Mbit/s at 10 Hz, 1.5 partners, "
                "payload 1048576"
            ),
        ),
    ],
    ids=["some", "none", "own"],
)
def test_bytes_stand_beside_the_numbers(sent: dict[str, Any], text: str) -> None:
    assert bytes_texts({"bytes": {"payload": "boxes", **sent}}) == [text]


@pytest.mark.parametrize(
    "meta",
    [
        None,
        {},
        {"bytes": None},
        {"bytes": 7},
        {"bytes": {"mean": 7.0}},
        {"bytes": {"payload": "boxes", "mean": "many", "partners": 1}},
        {"bytes": {"payload": "boxes", "mean": -7.0, "partners": 1}},
        {"bytes": {"payload": "a\nb", "mean": 7.0, "partners": 1}},
        {"bytes": {"payload": True, "mean": 7.0, "partners": 1}},
        {"bytes": {"payload": "boxes", "mean": 7.0, "partners": None}},
    ],
    ids=[
        "nothing",
        "empty",
        "none",
        "number",
        "part",
        "words",
        "negative",
        "lines",
        "flag",
        "unknown",
    ],
)
def test_malformed_notes_of_bytes_are_left_out(meta: object) -> None:
    assert bytes_texts(meta) == []


SUMMARY: dict[str, Any] = {
    "task": "accident",
    "protocol": "boxes",
    "switches": {},
    "agents": None,
    "split": "val",
    "samples": "evaluate",
    "scope": "all",
    "horizon": 2.0,
    "partial": None,
    "release": {"dataroot": "/r", "version": "v1", "fingerprint": "f"},
    "results": {"path": "/p", "fingerprint": "g", "form": None},
    "counts": {"samples": 6, "scenarios": 2, "left_out": 3},
    "devkit_version": "1",
    "headlines": [
        {"name": name, "path": f"at/{name}", "text": text, "unit": "m"}
        for name, text in zip("abcdef", "123456", strict=True)
    ],
    "metrics": {
        "n": 1,
        "flag": True,
        "at": {"a": 0.5, "pairs": [3, 4], "odd": [1, 0.5]},
        "longer": {"k": 5},
        "curve": {"k": 2},
    },
    "breakdowns": {},
}


def test_the_text_of_a_full_summary() -> None:
    """A partial run with switches, agents, intervals, numbers of other protocols, notes and
    breakdowns of five headlines.
    """
    intervals = {"at/a": [0.25, 0.75], "at/b": [None, 1.0], "at/c": None}
    all_samples = {
        "value": None,
        "intervals": intervals,
        "notes": ["no interval of b: few clusters"],
    }
    near = {
        "value": "near",
        "samples": 3,
        "scenarios": 1,
        "headlines": {"at/a": 0.25, "at/e": None, "at/f": 0.5},
    }
    by_agent = [near, near | {"value": None, "scenarios": 2}]
    summary = {
        **SUMMARY,
        "protocol": "released",
        "partial": {"mark": "PARTIAL: 6 of 8 samples"},
        "switches": {"x": 0.5, "y": "z"},
        "agents": ["ego_vehicle", "infrastructure"],
        "horizon": 1.5,
        "results": {
            "path": "/p",
            "fingerprint": "g",
            "form": PUBLISHED_FORM | {"predictions": 5, "frames": 6},
        },
        "counts": {"samples": 6, "scenarios": 2, "left_out": 0},
        "metrics": SUMMARY["metrics"]
        | {
            "notes": ["so", "so"],
            "beside": {"paper": {"at": {"a": 0.125, "b": None}, "notes": ["so", "other"]}},
        },
        "breakdowns": {
            "all": {"groups": [all_samples], "resampling": {"confidence": 0.9}},
            "agent": {"groups": by_agent},
            "town": {"groups": by_agent},
        },
    }
    lines = lines_of(summary_text(summary, ["agent", "weather"]))
    expected_lines = {
        "evaluated PARTIAL: 6 of 8 samples",
        "number value 90 % interval if paper",
        "a 1 [0.250, 0.750] 0.125",
        "near 3 1 0.250 – – – –",
        "if paper: other",
    }

    assert expected_lines - {*lines} == set()


PUBLISHED_FORM = {
    "stored": "heads",
    "x": [-50.0, 50.0, 0.5],
    "y": [-50.0, 50.0, 0.5],
    "orientation": "devkit",
    "predictions": 6,
    "frames": 5,
    "step": 0.5,
    "labels": None,
}
PATH_METRICS = {
    "paths": 9,
    "path_true_positive": 9,
    "path_false_negative": 1,
    "ranges": {"30x30": {}, "100x100": {}},
}


def notes(
    task: str = "motion",
    protocol: str = "released",
    *,
    metrics: dict[str, Any] | None = None,
    **form: Any,
) -> list[str]:
    """Return the notes on an evaluation of results that have the published form, but for `form`."""
    return reading_notes(
        {
            "task": task,
            "protocol": protocol,
            "horizon": 2.0,
            "metrics": metrics or PATH_METRICS,
            "results": {"form": None if task == "detection" else PUBLISHED_FORM | form},
        }
    )


@pytest.mark.parametrize("task", ["motion", "accident"])
def test_the_published_form_has_no_notes(task: str) -> None:
    assert notes(task) == []


def test_published_accidents_are_of_six_heads() -> None:
    maps, single = notes("accident", stored="instances", predictions=1)

    assert maps.startswith(
        "predictions are instance maps; their APA cannot be compared with published APA"
    )
    assert single.startswith("each sample has 1 prediction; published numbers use 6")
    assert notes("accident", "paper", stored="instances", predictions=1) == []


def test_detection_of_the_released_code() -> None:
    [note] = notes("detection")
    assert note.startswith(
        "the protocol released takes hidden boxes and the agent's own box as truth"
    )
    assert notes("detection", "paper") == []


@pytest.mark.parametrize("field", ["x", "y"])
def test_each_axis_is_that_of_published_numbers(field: str) -> None:
    assert len(notes(**{field: [-50.0, 50.0, 0.25]})) == 1

    [_, wide] = notes(**{field: [-50.0, 49.5, 0.5]})
    assert wide.startswith("100 m × 100 m: the maps end within")

    metrics = PATH_METRICS | {"ranges": {"30x120": {}, "100x100": {}, "102x30": {}}}
    [_, *range_notes] = notes(metrics=metrics, **{field: [-51.0, 51.0, 0.5]})
    assert [note.split(":")[0] for note in range_notes] == ["30x120", "102x30"]


def test_forms_other_than_the_published_one_are_noted() -> None:
    assert notes(frames=5) == notes(frames=1) == []
    assert notes(frames=6)[0].startswith(
        "predictions have 6 frames, of which the first 5 are evaluated"
    )
    assert notes(frames=3, step=1.0) == notes(frames=8, step=0.3) == []

    [note, *_] = notes(frames=4, step=1.0)
    assert note.startswith("predictions have 4 frames, of which the first 3 are evaluated")

    [note] = notes("accident", predictions=5)
    assert (
        note == "each sample has 5 predictions; published numbers use 6: five "
        "random draws, then their mean"
    )
    assert notes("accident", predictions=7) == []

    paths = {"paths": 89, "path_true_positive": 89, "path_false_negative": 11}
    [note] = notes(metrics=PATH_METRICS | paths)
    assert note.startswith("89 of 100 true paths")
    assert notes("warning", "clean", metrics={}) == []


TRAINED_SCENARIO = "type1_subtype1_accident/Town01_000"
OTHER_SAMPLE = "type1_subtype1_normal/Town02_000/ego_vehicle/001"
CLEAN_COLUMNS = ("auc_ahead", "twin_wins", "average_precision", "mean_time")
OPERATING_COLUMNS = (
    "precision",
    "time_in_alarm",
    "alarm_seconds_per_minute",
    "episodes_per_minute",
    "recall",
    "tta0",
    "tta_hit",
)


def clean_numbers(first: float, **more: Any) -> dict[str, Any]:
    """Return numbers of the protocol clean, which rise by a hundredth from column to column."""
    numbers = {}
    for index, name in enumerate((*CLEAN_COLUMNS, *OPERATING_COLUMNS)):
        numbers[name] = first + index / 100
    operating = {name: numbers.pop(name) for name in OPERATING_COLUMNS} | {"threshold": 0.123456}
    thresholds = {"best_f1": 0.25, "quiet": None}
    return {**numbers, "operating": operating, "tta0_after": {}, **thresholds, **more}


def test_predictors_have_a_table_for_each_group() -> None:
    groups = {
        "ego_involved": clean_numbers(0.1),
        "bystander": clean_numbers(0.2, tta0_after={"0.0": 1.5, "0.3": None}),
    }
    references = {
        "always": {"ego_involved": clean_numbers(9.95), "bystander": clean_numbers(-9.95)}
    }
    metrics = {"groups": groups, "references": references, "operating_by": "given"}
    ego, bystander = predictor_tables(metrics)

    assert ego.rows[0] == (
        "ego involved in the accident",
        "AUC ahead",
        "AUC twins",
        "AP",
        "mTTA",
        "precision",
        "in alarm",
        "s/min",
        "alarms/min",
        "recall",
        "TTA, miss 0",
        "TTA, hits",
    )
    assert ego.rows[1] == ("this model", *(f"{0.1 + index / 100:.3f}" for index in range(11)))
    assert ego.rows[2] == (
        "always in alarm",
        "9.950",
        "9.960",
        "9.970",
        "9.980",
        "9.990",
        *["10.0"] * 6,
    )
    assert [row[:2] for row in bystander.rows[1:]] == [
        ("this model", "0.200"),
        ("always in alarm", "-9.950"),
    ]

    assert ego.notes == (
        "threshold 0.1235, as given; thresholds for another split: best_f1 0.250, quiet –",
    )
    assert bystander.notes[1:] == (
        (
            "TTA (a miss counts as 0 s) if the warning reaches the colliding pair after a latency "
            "of 0.0 s: 1.500 s, 0.3 s: –"
        ),
    )
    assert predictors_text(metrics) == f"{ego.to_text()}\n\n{bystander.to_text()}"

    metrics["operating_by"] = "recall"
    groups["ego_involved"]["operating"]["threshold"] = None
    ego, _ = predictor_tables(metrics)
    assert ego.notes[0].startswith(
        "threshold none, chosen on these recordings for a recall of 0.8, or for the "
        "highest recall; "
    )


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "–"),
        (0.0, "0.000"),
        (9.9994, "9.999"),
        (-10.0, "-10.0"),
        (10.0, "10.0"),
        (-9.5, "-9.500"),
    ],
)
def test_numbers(value: float | None, text: str) -> None:
    assert table_number_text(value) == text


def patch_bundle(monkeypatch: pytest.MonkeyPatch, **summary: Any) -> None:
    """Read a bundle with this summary, of one scenario."""
    task = summary.get("task", "warning")
    protocol = summary.get("protocol", "clean")
    bundle = SimpleNamespace(
        setup=SimpleNamespace(task=task, protocol=protocol),
        summary=summary,
        scenarios=lambda: {TRAINED_SCENARIO: "hash"},
    )
    monkeypatch.setattr(bundles, "read_bundle", lambda _: bundle)


@pytest.mark.parametrize(
    ("summary", "by", "error", "message"),
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
        ({}, "quiet", ResultsError, "^b: its summary has no warning metrics; evaluate again$"),
        (
            {"prevented": None},
            "braking",
            ResultsError,
            "no prevented accidents; evaluate again with --prevented$",
        ),
        (
            {"metrics": {"groups": {"bystander": {}}}},
            "quiet",
            ResultsError,
            "has no warning metrics",
        ),
        (
            {"metrics": {"groups": {}}},
            "best_f1",
            EvaluationError,
            "^b: found no threshold by best_f1; choose another",
        ),
        (
            {"metrics": {"groups": {"bystander": {"quiet": None}}}},
            "quiet",
            EvaluationError,
            "found no threshold by qu",
        ),
        (
            {"metrics": {"groups": {"bystander": {"quiet": math.inf}}}},
            "quiet",
            EvaluationError,
            "found no threshold",
        ),
    ],
)
def test_evaluations_without_a_threshold(
    monkeypatch: pytest.MonkeyPatch,
    summary: dict[str, Any],
    by: Any,
    error: type[Exception],
    message: str,
) -> None:
    patch_bundle(monkeypatch, **summary)
    assert_raises(
        (lambda: chosen_threshold(Path("b"), by, [OTHER_SAMPLE]), error, message),
    )
