"""A summary for people: of a run and of a stored bundle alike, marked where it is partial."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation import Resampling
from deepaccident_devkit.evaluation.results import Results, ResultsWriter, read_results
from deepaccident_devkit.evaluation.runs import (
    EvaluationRun,
    Partial,
    SampleSelection,
    evaluate_results,
    read_bundle,
    results_text,
    save_run,
    summary_text,
)
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup
from deepaccident_devkit.evaluation.runs.text import _notes

Write = Callable[..., Results]


def lines_of(text: str) -> list[str]:
    return [" ".join(line.split()) for line in text.splitlines()]


def test_what_it_tells(run: EvaluationRun) -> None:
    lines = lines_of(summary_text(run.broken_down(["all", "agent"], Resampling(resamples=10)).summary(), ["agent"]))
    assert lines[:2] == ["evaluated", "task accident, protocol boxes"]
    assert lines[2].startswith(
        "samples 6 of 2 scenarios: split val, list evaluate, scope all, ego_vehicle, other_vehicle, inf"
    )
    assert "number value" in lines
    assert "position_error 0.283 m" in lines
    assert "no intervals: of 1 cluster (an accident and its twin are one); at least 6 are needed" in lines
    assert "samples 6, positives 3, negatives 3, unjudged 0, beyond 0, at_impact 0, unplaced 0" in lines
    assert "within/5 tp 3, fp 0, fn 0" in lines
    assert lines[lines.index("by agent") + 1].startswith(
        "value samples scenarios apa precision recall false_alarm_rate"
    )
    assert "ego_vehicle 2 2 1.000 1.000 1.000 0.000 1.000" in lines


def test_intervals_and_why_there_is_none(run: EvaluationRun) -> None:
    summary = run.broken_down(["all"], Resampling(confidence=0.9)).summary()
    [group] = summary["breakdowns"]["all"]["groups"]
    group.update(intervals={"apa": [0.651, 1.0]}, notes=["no interval of id_error: fewer than 6 clusters have it"])
    lines = lines_of(summary_text(summary, []))
    assert "number value 90% interval" in lines
    assert "apa 1.000 [0.651, 1.000]" in lines
    assert "id_error 0.000 –" in lines
    assert group["notes"][0] in lines


def test_switches_and_no_intervals(run: EvaluationRun) -> None:
    switched = replace(run, setup=replace(run.setup, switches={"reading.danger_distance": 0.5}))
    lines = lines_of(summary_text(switched.summary()))
    assert "task accident, protocol boxes with reading.danger_distance=0.5" in lines
    assert "number value" in lines


def test_the_bundle_on_disk_reads_alike(run: EvaluationRun, tmp_path: Path) -> None:
    broken = run.broken_down(["all", "agent"], Resampling(resamples=10))
    stored = read_bundle(save_run(broken, tmp_path / "bundle")).summary
    assert summary_text(stored) == summary_text(broken.summary())


def test_results_of_other_choices_stand_beside(
    da_b: DeepAccident, selection: SampleSelection, tmp_path: Path, write_motion: Write
) -> None:
    results = write_motion(tmp_path / "motion", selection.tokens(da_b))
    run = evaluate_results(da_b, results, EvaluationSetup(task="accident", protocol="paper"), selection, workers=1)
    text = summary_text(run.summary())
    assert "number value if sample_choice=mean_first" in lines_of(text)
    assert "6 of 6 predictions were given as instance maps" in text


def test_every_block_of_a_partial_one_says_so(run: EvaluationRun) -> None:
    partial = replace(run, partial=Partial(missing=2, extra=0, expected=8, evaluated=6))
    text = summary_text(partial.broken_down(["all", "agent"], Resampling(resamples=0)).summary(), ["agent"])
    titles = [block.splitlines()[0] for block in text.split("\n\n")]
    assert titles == [f"{name}   PARTIAL: 6 of 8 samples" for name in ("evaluated", "results", "counts", "by agent")]


def test_what_a_results_file_holds(
    da_b: DeepAccident, results: Results, tmp_path: Path, write_motion: Write, selection: SampleSelection
) -> None:
    lines = lines_of(results_text(results))
    assert lines[0] == f"results accident, {results.path}"
    assert lines[2:] == [
        "samples 6 of 2 scenarios",
        "agents ego_vehicle 2, infrastructure 2, other_vehicle 2",
        f"meta {json.dumps(results.meta)}",
    ]
    motion = write_motion(tmp_path / "motion", selection.tokens(da_b)[:1])
    assert lines_of(results_text(motion))[-1].startswith(
        "form instances, up to 1 predictions of 5 frames, 0.5 s apart, cells x (-50.0, 50.0, 0.5), y (-50.0, 50.0, 0.5)"
    )


def test_notes_of_results_that_stand_beside_say_of_which() -> None:
    metrics = {"notes": ["both"], "beside": {"paper": {"notes": ["both", "its own"]}}}
    assert list(_notes(metrics)) == ["both", "if paper: its own"]


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
        {"name": name, "path": f"at/{name}", "text": text} for name, text in zip("abcdef", "123456", strict=True)
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


def test_lines_are_aligned() -> None:
    assert summary_text(SUMMARY) == "\n".join(
        [
            "evaluated",
            "  task         accident, protocol boxes",
            "  samples      6 of 2 scenarios: split val, list evaluate, scope all, all agents, horizon 2 s",
            "  predictions  /p (g); 3 predictions of other samples left out",
            "  release      /r (v1, f)",
            "  devkit       1",
            "",
            "results",
            *(
                f"  {line}"
                for line in ["number  value", *(f"{name}           {at}" for at, name in enumerate("abcdef", 1))]
            ),
            "",
            "counts",
            "  n 1",
            "  at      pairs 3+4",
            "  longer  k 5",
        ]
    )


def test_breakdowns_show_five_headlines_and_what_is_unknown() -> None:
    groups = [
        {"value": value, "samples": 2, "scenarios": 1, "headlines": {"at/a": 0.25, "at/e": None, "at/f": 0.5}}
        for value in ("near", None)
    ]
    lines = summary_text({**SUMMARY, "breakdowns": {"agent": {"groups": groups}}}, ["agent", "weather"]).split("\n\n")[
        -1
    ]
    assert lines_of(lines) == [
        "by agent",
        "value samples scenarios a b c d e",
        "near 2 1 0.250 – – – –",
        "unknown 2 1 0.250 – – – –",
    ]


def test_of_meta_every_letter_is_shown(tmp_path: Path) -> None:
    with ResultsWriter(tmp_path / "a.json", "accident", meta={"über": "π"}) as writer:
        writer.add("t/s/ego_vehicle/001", [])
    *_, line = results_text(read_results(tmp_path / "a.json")).splitlines()
    assert line == 'meta         {"über": "π"}'
