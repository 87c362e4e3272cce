"""Evaluations over the bytes that partners send: whose numbers are shown, with which intervals, and
who is refused.
"""

import json
from pathlib import Path
from typing import Any

import pytest
from generated_bundles import MAIN, write_bundle
from refusals import assert_refused

from deepaccident_devkit.errors import EvaluationError, ResultsError
from deepaccident_devkit.evaluation import Resampling
from deepaccident_devkit.evaluation.breakdowns import cluster_of
from deepaccident_devkit.evaluation.intervals import intervals_of
from deepaccident_devkit.evaluation.runs import BytesPoint, OverBytes, over_bytes, read_bundle
from deepaccident_devkit.evaluation.runs.over_bytes import sent_bytes
from deepaccident_devkit.evaluation.runs.setups import scenario_of

FEW = Resampling(resamples=60)


def sent(mean: float, payload: object = "boxes") -> dict[str, object]:
    return {"payload": payload, "mean": mean, "partners": 1.0, "samples": 8}


def bundle(folder: Path, found: int, mean: float, samples: int = 8) -> Path:
    """Some clusters, of which each has another share of its 100 cells found."""
    return write_bundle(
        folder, [(found + each, 100 - found - each) for each in range(samples)], sent=sent(mean)
    )


@pytest.fixture
def three(tmp_path: Path) -> list[Path]:
    return [
        bundle(tmp_path / name, *each)
        for name, each in (("a", (40, 0.0)), ("b", (60, 1e6)), ("c", (50, 2e3)))
    ]


def shown(found: OverBytes, headline: str = MAIN) -> list[BytesPoint]:
    return [each for each in found.points if each.headline == headline]


def test_each_evaluation_has_its_bytes_and_numbers(three: list[Path]) -> None:
    found = over_bytes(three, FEW)
    assert (found.task, found.protocol, found.samples) == ("motion", "released", 8)
    assert [(each.evaluation, each.bytes) for each in shown(found)] == [
        ("a", 0.0),
        ("b", 1e6),
        ("c", 2e3),
    ]
    assert [each.value for each in shown(found)] == pytest.approx([43.5, 63.5, 53.5])
    assert {each.unit for each in shown(found)} == {"%"}


def test_intervals_are_those_of_an_evaluation(three: list[Path]) -> None:
    evaluator = read_bundle(three[1]).evaluator()
    names = {token: cluster_of(scenario_of(token)) for token in sorted(evaluator.tokens)}
    made = intervals_of(evaluator, evaluator.clustered(names), evaluator.compute(), FEW).ends
    point = shown(over_bytes(three, FEW))[1]
    assert (point.low, point.high) == made["ranges/30x30/iou"]
    assert point.low < point.value < point.high
    without = shown(over_bytes(three, Resampling(resamples=0)))[1]
    assert (without.low, without.high, without.value) == (None, None, point.value)


def test_text_and_tables(three: list[Path]) -> None:
    found = over_bytes(three, FEW)
    lines = [line.split() for line in found.to_text().splitlines()]
    point = shown(found)[1]
    assert lines[4] == [
        *MAIN.split(),
        "b",
        "1,000,000",
        "63.50",
        "%",
        f"[{point.low:.3f},",
        f"{point.high:.3f}]",
    ]
    assert json.loads(found.to_json())["points"][1]["bytes"] == 1e6


def test_folders_of_one_name_are_told_apart(tmp_path: Path) -> None:
    folders = [
        bundle(tmp_path / each / "motion", 40, mean) for each, mean in (("a", 1.0), ("b", 2.0))
    ]
    assert [each.evaluation for each in shown(over_bytes(folders, FEW))] == [
        str(each) for each in folders
    ]


def test_samples_that_all_have(tmp_path: Path, three: list[Path]) -> None:
    longer = bundle(tmp_path / "longer", 60, 5.0, samples=10)
    assert_refused(
        (lambda: over_bytes([*three, longer], FEW), EvaluationError, "2 samples only in .*longer")
    )
    found = over_bytes([longer, *three], FEW, common=True)
    assert (found.samples, next(each.value for each in shown(found))) == (8, pytest.approx(63.5))


@pytest.mark.parametrize(
    "note",
    [None, {}, sent(-1.0), sent(1.0, payload="a\nb")],
    ids=["none", "empty", "less", "lines"],
)
def test_results_that_do_not_note_bytes_are_named(
    tmp_path: Path, three: list[Path], note: Any
) -> None:
    silent = write_bundle(tmp_path / "silent", [(3, 1)] * 8, sent=note)
    told = (f"{silent}: its results do not note", "predict again into a new folder")
    assert_refused((lambda: over_bytes([three[0], silent], FEW), EvaluationError, told))
    assert sent_bytes(read_bundle(silent).summary) is None


def test_other_rules_and_no_evaluation(tmp_path: Path, three: list[Path]) -> None:
    path = three[2] / "metrics_summary.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"protocol": "paper"}))
    assert_refused(
        (
            lambda: over_bytes(three, FEW),
            EvaluationError,
            "were not evaluated by the same rules: protocol",
        ),
        (lambda: over_bytes([three[0], tmp_path / "none"], FEW), ResultsError, "no such folder"),
    )
