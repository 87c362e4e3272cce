"""Summaries for people: of a run and of a stored bundle alike, marked where it is partial; notes,
and predictors.
"""

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from refusals import assert_refused

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
    number_text,
    predictor_tables,
    predictors_text,
    reading_notes,
)


def lines_of(text: str) -> list[str]:
    return [" ".join(line.split()) for line in text.splitlines()]


def test_what_it_tells(run: EvaluationRun) -> None:
    lines = lines_of(
        summary_text(
            run.broken_down(["all", "agent"], Resampling(resamples=10)).summary(), ["agent"]
        )
    )
    told = {
        "evaluated",
        "task accident, protocol boxes",
        "number value",
        "position_error 0.283 m",
        "no intervals: of 1 cluster (an accident and its twin are one); at least 6 are needed",
        "samples 6, positives 3, negatives 3, unjudged 0, beyond 0, at_impact 0, unplaced 0",
        "within/5 tp 3, fp 0, fn 0",
        "by agent",
        "ego_vehicle 2 2 1.000 1.000 1.000 0.000 1.000",
    }
    assert told - {*lines} == set()


def test_the_bundle_on_disk_reads_alike(run: EvaluationRun, tmp_path: Path) -> None:
    broken = run.broken_down(["all", "agent"], Resampling(resamples=10))
    assert summary_text(read_bundle(save_run(broken, tmp_path / "bundle")).summary) == summary_text(
        broken.summary()
    )


def test_what_a_results_file_holds(results: Results, tmp_path: Path) -> None:
    lines = lines_of(results_text(results))
    assert lines[2:4] == [
        "samples 6 of 2 scenarios",
        "agents ego_vehicle 2, infrastructure 2, other_vehicle 2",
    ]
    with ResultsWriter(tmp_path / "long", "accident", meta={"x": "y" * 50_000}) as writer:
        writer.add(results.tokens[0], [])
    assert len(results_text(read_results(tmp_path / "long"))) < 2000


def told_bytes(meta: object) -> list[str]:
    results = {"path": "/p", "fingerprint": "g", "form": None, "meta": meta}
    return [
        line[6:]
        for line in lines_of(summary_text({**SUMMARY, "results": results}))
        if line.startswith("bytes ")
    ]


@pytest.mark.parametrize(
    ("sent", "told"),
    [
        (
            {"mean": 2900.4, "partners": 4},
            "2,900 a sample (2^11.5), 0.23 Mbit/s at 10 Hz, 4.0 partners, payload boxes",
        ),
        (
            {"mean": 0, "partners": 0.0},
            "0 a sample, 0.00 Mbit/s at 10 Hz, 0.0 partners, payload boxes",
        ),
        (
            {"mean": 2.0**21, "partners": 1.5, "payload": 2**20, "shape": [8, 2]},
            "2,097,152 a sample (2^21.0), 167.77 Mbit/s at 10 Hz, 1.5 partners, payload 1048576",
        ),
    ],
    ids=["some", "none", "own"],
)
def test_bytes_stand_beside_the_numbers(sent: dict[str, Any], told: str) -> None:
    assert told_bytes({"bytes": {"payload": "boxes", **sent}}) == [told]


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
def test_what_others_note_as_bytes_is_left_out_where_it_is_none(meta: object) -> None:
    assert told_bytes(meta) == []


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


def test_all_that_a_summary_may_have() -> None:
    """Switches, agents, intervals, numbers of other choices, breakdowns of five headlines, notes;
    all of it partial.
    """
    intervals = {"at/a": [0.25, 0.75], "at/b": [None, 1.0], "at/c": None}
    agents = ["ego_vehicle", "infrastructure"]
    everyone = {"value": None, "intervals": intervals, "notes": ["no interval of b: few clusters"]}
    by_agent = [
        {
            "value": value,
            "samples": 3,
            "scenarios": scenarios,
            "headlines": {"at/a": 0.25, "at/e": None, "at/f": 0.5},
        }
        for value, scenarios in (("near", 1), (None, 2))
    ]
    summary = {
        **SUMMARY,
        "protocol": "released",
        "partial": {"mark": "PARTIAL: 6 of 8 samples"},
        "switches": {"x": 0.5, "y": "z"},
        "agents": agents,
        "horizon": 1.5,
        "results": {
            "path": "/p",
            "fingerprint": "g",
            "form": FORM | {"predictions": 5, "frames": 6},
        },
        "counts": {"samples": 6, "scenarios": 2, "left_out": 0},
        "metrics": SUMMARY["metrics"]
        | {
            "notes": ["so", "so"],
            "beside": {"paper": {"at": {"a": 0.125, "b": None}, "notes": ["so", "other"]}},
        },
        "breakdowns": {
            "all": {"groups": [everyone], "resampling": {"confidence": 0.9}},
            "agent": {"groups": by_agent},
            "town": {"groups": by_agent},
        },
    }
    lines = lines_of(summary_text(summary, ["agent", "weather"]))
    told = {
        "evaluated PARTIAL: 6 of 8 samples",
        "number value 90% interval if paper",
        "a 1 [0.250, 0.750] 0.125",
        "near 3 1 0.250 – – – –",
        "if paper: other",
    }
    assert told - {*lines} == set()


FORM = {
    "stored": "heads",
    "x": [-50.0, 50.0, 0.5],
    "y": [-50.0, 50.0, 0.5],
    "orientation": "devkit",
    "predictions": 6,
    "frames": 5,
    "step": 0.5,
    "labels": None,
}
PATHS = {
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
    told = None if task == "detection" else FORM | form
    return reading_notes(
        {
            "task": task,
            "protocol": protocol,
            "horizon": 2.0,
            "metrics": metrics or PATHS,
            "results": {"form": told},
        }
    )


@pytest.mark.parametrize("task", ["motion", "accident"])
def test_the_published_form_has_none(task: str) -> None:
    assert notes(task) == []


def test_published_accidents_are_of_six_heads() -> None:
    maps, single = notes("accident", stored="instances", predictions=1)
    assert maps.startswith("instance maps: cannot be compared with published APA")
    assert single.startswith("predictions of a sample: 1; published numbers are of 6")
    assert notes("accident", "paper", stored="instances", predictions=1) == []


def test_detection_of_the_released_code() -> None:
    [note] = notes("detection")
    assert note.startswith("released: hidden boxes and the agent's own are truth")
    assert notes("detection", "paper") == []


@pytest.mark.parametrize("field", ["x", "y"])
def test_each_axis_is_that_of_published_numbers(field: str) -> None:
    assert len(notes(**{field: [-50.0, 50.0, 0.25]})) == 1
    [_, wide] = notes(**{field: [-50.0, 49.5, 0.5]})
    assert wide.startswith("100x100: the maps end before")
    ranges = PATHS | {"ranges": {"30x120": {}, "100x100": {}, "102x30": {}}}
    assert [
        note.split(":")[0] for note in notes(metrics=ranges, **{field: [-51.0, 51.0, 0.5]})[1:]
    ] == [
        "30x120",
        "102x30",
    ]


def test_up_to_where_numbers_are_as_published() -> None:
    assert notes(frames=5) == notes(frames=1) == []
    assert notes(frames=6)[0].startswith("predictions have 6 frames; the first 5 are evaluated")
    assert notes(frames=3, step=1.0) == notes(frames=8, step=0.3) == []
    assert notes(frames=4, step=1.0)[0].startswith(
        "predictions have 4 frames; the first 3 are evaluated"
    )
    [note] = notes("accident", predictions=5)
    assert (
        note == "predictions of a sample: 5; published numbers are of 6, five "
        "samples and then their mean"
    )
    assert notes("accident", predictions=7) == []
    [note] = notes(
        metrics=PATHS | {"paths": 89, "path_true_positive": 89, "path_false_negative": 11}
    )
    assert note.startswith("89 of 100 true paths")
    assert notes("warning", "clean", metrics={}) == []


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


def clean(first: float, **more: Any) -> dict[str, Any]:
    """Numbers that rise by a hundredth from column to column."""
    columns = dict(zip((*CLEAN, *AT_POINT), (first + at / 100 for at in range(11)), strict=True))
    operating = {name: columns.pop(name) for name in AT_POINT} | {"threshold": 0.123456}
    return (
        columns | {"operating": operating, "tta0_after": {}, "best_f1": 0.25, "quiet": None} | more
    )


def test_a_table_a_group_of_the_protocol_clean() -> None:
    groups = {
        "ego_involved": clean(0.1),
        "bystander": clean(0.2, tta0_after={"0.0": 1.5, "0.3": None}),
    }
    references = {"always": {"ego_involved": clean(9.95), "bystander": clean(-9.95)}}
    metrics = {"groups": groups, "references": references, "operating_by": "given"}
    one, other = predictor_tables(metrics)
    assert one.rows[0] == (
        *(
            "ego_involved",
            "auc_ahead",
            "twin_wins",
            "AP",
            "mTTA",
            "precision",
            "in alarm",
            "s/min",
            "runs/min",
        ),
        *("recall", "tta0", "tta_hit"),
    )
    assert one.rows[1] == ("given", *(f"{0.1 + at / 100:.3f}" for at in range(11)))
    assert one.rows[2] == ("always", "9.950", "9.960", "9.970", "9.980", "9.990", *(["10.0"] * 6))
    assert [row[:2] for row in other.rows[1:]] == [("given", "0.200"), ("always", "-9.950")]
    assert one.notes == ("threshold 0.1235 (given); for another split: best_f1 0.250, quiet –",)
    assert other.notes[1:] == (
        "tta0 if the two who collide are told after a latency of 0.0 s: 1.500 s, 0.3 s: –",
    )
    assert predictors_text(metrics) == f"{one.to_text()}\n\n{other.to_text()}"
    metrics |= {"operating_by": "recall"}
    groups["ego_involved"]["operating"]["threshold"] = None
    assert (
        predictor_tables(metrics)[0]
        .notes[0]
        .startswith("threshold none (of recall 0.8, or the highest, on these recordings); for")
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
    assert number_text(value) == text


def stored(monkeypatch: pytest.MonkeyPatch, **summary: Any) -> None:
    """A bundle with this summary, of one scenario."""
    setup = SimpleNamespace(
        task=summary.get("task", "warning"), protocol=summary.get("protocol", "clean")
    )
    bundle = SimpleNamespace(setup=setup, summary=summary, scenarios=lambda: {TRAINED: "hash"})
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
            "has no metrics of warnings",
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
    sentence: str,
) -> None:
    stored(monkeypatch, **summary)
    assert_refused(
        (lambda: chosen_threshold(Path("b"), by, [OTHER]), error, sentence),
    )
