"""Bundles made again: the same, or every difference named."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ResultsError
from deepaccident_devkit.evaluation import Resampling
from deepaccident_devkit.evaluation.results import Results
from deepaccident_devkit.evaluation.runs import (
    EvaluationRun,
    SampleSelection,
    Verification,
    evaluate_results,
    save_run,
    summary_text,
    verify_bundle,
)
from deepaccident_devkit.evaluation.runs.differences import ABSENT, Difference, differing
from deepaccident_devkit.evaluation.runs.rows import read_rows, write_rows

Write = Callable[..., Results]


@pytest.fixture
def bundle(run: EvaluationRun, tmp_path: Path) -> Path:
    return save_run(run.broken_down(["all", "agent"], Resampling(resamples=10)), tmp_path / "bundle")


def verify(bundle: Path, dataset: DeepAccident, **named: Any) -> Verification:
    return verify_bundle(bundle, dataset, workers=1, **named)


def changed(path: Path, change: Callable[[Any], object]) -> None:
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def found(verification: Verification) -> list[tuple[str, str]]:
    return [(each.kind, each.where) for each in verification.differences]


class TestSame:
    def test_nothing_differs(self, bundle: Path, da_b: DeepAccident) -> None:
        verification = verify(bundle, da_b)
        assert (verification.is_same, verification.samples, verification.notes) == (True, 6, ())
        assert verification.to_text() == f"{bundle}: the same; 6 samples evaluated again, all numbers are equal"
        assert verification.as_dict()["same"] is True

    def test_with_results_inside_and_elsewhere(self, run: EvaluationRun, tmp_path: Path, own_release: Path) -> None:
        bundle = save_run(run, tmp_path / "bundle", include_results=True)
        moved = tmp_path / "moved"
        shutil.move(bundle, moved)
        (tmp_path / "accidents.json").unlink()
        assert verify(moved, DeepAccident(dataroot=own_release, verbose=False)).is_same

    def test_a_partial_one(
        self, da_b: DeepAccident, selection: SampleSelection, tmp_path: Path, write_accidents: Write, run: EvaluationRun
    ) -> None:
        results = write_accidents(tmp_path / "some.json", selection.tokens(da_b)[1:])
        part = evaluate_results(da_b, results, run.setup, selection, allow_partial=True, workers=1)
        assert verify(save_run(part, tmp_path / "bundle"), da_b).is_same

    def test_one_whose_results_have_other_samples_too(
        self, da_b: DeepAccident, selection: SampleSelection, tmp_path: Path, results: Results, run: EvaluationRun
    ) -> None:
        fewer = replace(selection, agents=("ego_vehicle",))
        part = evaluate_results(da_b, results, run.setup, fewer, allow_partial=True, workers=1)
        assert (part.partial, part.left_out) == (None, 4)
        assert "; 4 predictions of other samples left out" in summary_text(part.summary())
        assert verify(save_run(part, tmp_path / "bundle"), da_b).is_same


class TestNamed:
    def test_a_number(self, bundle: Path, da_b: DeepAccident) -> None:
        changed(bundle / "metrics_summary.json", lambda summary: summary["metrics"].update(apa=0.99))
        verification = verify(bundle, da_b)
        assert found(verification) == [("file", "metrics_summary.json"), ("number", "metrics/apa")]
        assert verification.to_text().splitlines()[2] == "  number: metrics/apa: stored 0.99, found 1.0"
        assert verification.as_dict()["differences"][1] == {
            "kind": "number",
            "where": "metrics/apa",
            "stored": 0.99,
            "found": 1.0,
        }

    def test_a_number_in_a_breakdown_by_the_last_bit(self, bundle: Path, da_b: DeepAccident) -> None:
        def change(summary: Any) -> None:
            summary["breakdowns"]["all"]["groups"][0]["metrics"]["position_error"] += 1e-15

        changed(bundle / "metrics_summary.json", change)
        assert ("number", "breakdowns/all/groups/0/metrics/position_error") in found(verify(bundle, da_b))

    def test_another_version(self, bundle: Path, da_b: DeepAccident) -> None:
        changed(bundle / "metrics_summary.json", lambda summary: summary.update(devkit_version="0.0.9"))
        verification = verify(bundle, da_b)
        assert found(verification) == [("version", "devkit_version"), ("file", "metrics_summary.json")]
        assert verification.samples == 6

    def test_another_numpy_is_a_note(self, bundle: Path, da_b: DeepAccident) -> None:
        changed(bundle / "metrics_summary.json", lambda summary: summary["environment"].update(numpy="1.0"))
        verification = verify(bundle, da_b)
        assert found(verification) == [("file", "metrics_summary.json")]
        assert verification.notes[0].startswith("evaluated with numpy 1.0, verified with ")

    @pytest.mark.slow
    @pytest.mark.parametrize("kind", ["label", "meta", "calib"])
    def test_a_file_of_a_scenario(self, bundle: Path, own_release: Path, kind: str) -> None:
        opened = DeepAccident(dataroot=own_release, verbose=False)
        pattern = "val/*/meta/*.txt" if kind == "meta" else f"val/*/ego_vehicle/{kind}/*/*"
        path = min(own_release.glob(pattern))
        path.write_bytes(path.read_bytes() + b"\n")
        token = min(opened.split_scenarios("val"))
        verification = verify(bundle, opened)
        assert found(verification) == [("scenario", f"{token}: {kind}"), ("number", "release/fingerprint")]
        assert "edited in place" in verification.notes[0]

    def test_a_scenario_that_is_gone(self, bundle: Path, own_release: Path) -> None:
        for folder in own_release.glob("val/*_normal"):
            shutil.rmtree(folder)
        verification = verify(bundle, DeepAccident(dataroot=own_release, verbose=False))
        assert found(verification)[0] == ("scenario", min(read_scenarios(bundle, "_normal")))
        assert found(verification)[1] == ("evaluation", "all numbers")
        assert "3 predictions are of no sample of this release" in str(verification.differences[1].found)
        assert verification.samples == 0

    def test_a_scenario_that_the_bundle_does_not_state(self, bundle: Path, da_b: DeepAccident) -> None:
        gone = min(read_scenarios(bundle, "_normal"))
        changed(bundle / "scenarios.json", lambda stored: stored["scenarios"].pop(gone))
        assert found(verify(bundle, da_b)) == [("file", "scenarios.json"), ("scenario", gone)]

    def test_why_nothing_can_be_made_again_is_told_in_full(
        self, bundle: Path, da_b: DeepAccident, results: Results, tmp_path: Path, write_accidents: Write
    ) -> None:
        other = write_accidents(tmp_path / "other.json", results.tokens[1:])
        text = verify(bundle, da_b, results=other).to_text()
        assert f"evaluation: all numbers: cannot be made again: {other.path}: 1 of 6 samples have no pred" in text
        assert "marks every number as partial" in text

    def test_other_results(
        self, bundle: Path, da_b: DeepAccident, results: Results, tmp_path: Path, write_accidents: Write
    ) -> None:
        other = write_accidents(tmp_path / "other.json", results.tokens, moved=1.0)
        kinds = {kind for kind, _ in found(verify(bundle, da_b, results=other))}
        assert kinds == {"results", "number", "sample"}
        assert ("results", f"fingerprint of {other.path}") in found(verify(bundle, da_b, results=other.path))

    def test_counts_of_a_sample(self, bundle: Path, da_b: DeepAccident) -> None:
        token = min(json.loads((bundle / "counts.json").read_text())["counts"])
        changed(bundle / "counts.json", lambda state: state["counts"][token].update(unjudged=7))
        assert found(verify(bundle, da_b)) == [("file", "counts.json"), ("sample", f"counts.json {token}/unjudged")]

    def test_a_row(self, bundle: Path, da_b: DeepAccident) -> None:
        rows, stamp = read_rows(bundle / "samples.parquet")
        rows[2]["tp_10m"] = 5
        write_rows(bundle / "samples.parquet", rows[:-1], stamp)
        assert found(verify(bundle, da_b)) == [
            ("file", "samples.parquet"),
            ("sample", f"samples.parquet {rows[2]['token']}/tp_10m"),
            ("sample", f"samples.parquet {rows[-1]['token']}"),
        ]

    def test_files_foreign_missing_and_damaged(self, bundle: Path, da_b: DeepAccident) -> None:
        (bundle / "mine.txt").touch()
        (bundle / "counts.json").unlink()
        (bundle / "samples.parquet").write_bytes(b"PAR1")
        (bundle / "scenarios.json").write_text("{}")
        assert found(verify(bundle, da_b)) == [
            ("file", "counts.json"),
            ("file", "samples.parquet"),
            ("file", "scenarios.json"),
            ("file", "mine.txt"),
            ("file", "scenarios.json"),
            ("file", "counts.json"),
            ("file", "samples.parquet"),
        ]
        (bundle / "files.json").write_text("")
        assert found(verify(bundle, da_b))[0] == ("file", "files.json")

    def test_another_protocol_claimed(self, bundle: Path, da_b: DeepAccident) -> None:
        changed(bundle / "metrics_summary.json", lambda summary: summary.update(switches={"min_score": 2.0}))
        wheres = [where for kind, where in found(verify(bundle, da_b)) if kind == "number"]
        assert "settings/choices/min_score" in wheres
        assert "metrics/apa" in wheres

    def test_many_of_a_kind_are_counted(self) -> None:
        many = tuple(Difference(kind="number", where=str(index), stored=0, found=1) for index in range(12))
        text = Verification(folder=Path("b"), samples=3, differences=many, notes=("so",)).to_text().splitlines()
        assert text[0] == "b: 12 differences; 3 samples evaluated again"
        assert text[-2:] == ["  number: 2 more", "note: so"]
        assert len(text) == 13


class TestRefused:
    def test_no_bundle(self, tmp_path: Path, da_b: DeepAccident) -> None:
        with pytest.raises(ResultsError, match=r"nowhere: no such folder"):
            verify(tmp_path / "nowhere", da_b)

    def test_no_results(self, bundle: Path, da_b: DeepAccident, results: Results) -> None:
        results.path.unlink()
        with pytest.raises(ResultsError, match=r"accidents.json: no such file or folder"):
            verify(bundle, da_b)


def read_scenarios(bundle: Path, ending: str) -> list[str]:
    stored = json.loads((bundle / "scenarios.json").read_text())["scenarios"]
    return [token for token in stored if f"{ending}/" in token]


@pytest.mark.parametrize(
    ("stored", "found", "expected"),
    [
        ({"a": 1, "b": [1, 2]}, {"b": [1, 2], "a": 1}, []),
        ({"a": 1}, {"a": 1.0}, [("a", 1, 1.0)]),
        ({"a": True}, {"a": 1}, [("a", True, 1)]),
        ({"a": {"b": [1, 2]}}, {"a": {"b": [1, 3]}}, [("a/b/1", 2, 3)]),
        ({"a": [1]}, {"a": [1, 2]}, [("a", [1], [1, 2])]),
        ({"a": 1}, {"b": 1}, [("a", 1, ABSENT), ("b", ABSENT, 1)]),
        ({"a": None}, {}, [("a", None, ABSENT)]),
        ({"skip": 1, "keep": {"skip": 1}}, {"skip": 2, "keep": {"skip": 2}}, [("keep/skip", 1, 2)]),
    ],
)
def test_differing(stored: Any, found: Any, expected: list[tuple[str, Any, Any]]) -> None:
    assert list(differing(stored, found, without=["skip"])) == expected


def test_long_values_are_cut_in_a_line() -> None:
    text = Difference(kind="number", where="x", stored="y" * 100, found=ABSENT).text()
    assert text == f"number: x: stored '{'y' * 58}…, found absent"
