"""Evaluations over the bytes that partners send: numbers, intervals, and evaluations that are
refused.
"""

import json
from pathlib import Path
from typing import Any

import pytest
from support.expected_errors import assert_raises
from support.generated_bundles import MAIN, write_bundle

from deepaccident_devkit.errors import EvaluationError, ResultsError
from deepaccident_devkit.evaluation import Resampling
from deepaccident_devkit.evaluation.breakdowns import cluster_of
from deepaccident_devkit.evaluation.intervals import intervals_of
from deepaccident_devkit.evaluation.runs import BytesPoint, OverBytes, over_bytes, read_bundle
from deepaccident_devkit.evaluation.runs.over_bytes import sent_bytes
from deepaccident_devkit.evaluation.runs.setups import scenario_of
from deepaccident_devkit.support.human_names import metric_name

FEW_RESAMPLES = Resampling(resamples=60)


def bytes_note(mean: float, payload: object = "boxes") -> dict[str, object]:
    return {"payload": payload, "mean": mean, "partners": 1.0, "samples": 8}


def write_shares(folder: Path, hit_cells: int, mean_bytes: float, samples: int = 8) -> Path:
    """Write a bundle: of 100 cells in a cluster, the first hits `hit_cells`, each next one more."""
    cells = [(hits, 100 - hits) for hits in range(hit_cells, hit_cells + samples)]
    return write_bundle(folder, cells, bytes_note=bytes_note(mean_bytes))


@pytest.fixture
def three_bundles(tmp_path: Path) -> list[Path]:
    return [
        write_shares(tmp_path / "a", 40, 0.0),
        write_shares(tmp_path / "b", 60, 1e6),
        write_shares(tmp_path / "c", 50, 2e3),
    ]


def points_of(report: OverBytes, headline: str = MAIN) -> list[BytesPoint]:
    return [point for point in report.points if point.headline == headline]


def test_each_evaluation_has_its_bytes_and_numbers(three_bundles: list[Path]) -> None:
    report = over_bytes(three_bundles, FEW_RESAMPLES)
    points = points_of(report)

    assert (report.task, report.protocol, report.samples) == ("motion", "released", 8)
    assert [(point.evaluation, point.bytes) for point in points] == [
        ("a", 0.0),
        ("b", 1e6),
        ("c", 2e3),
    ]
    assert [point.value for point in points] == pytest.approx([43.5, 63.5, 53.5])
    assert {point.unit for point in points} == {"%"}


def test_intervals_are_those_of_an_evaluation(three_bundles: list[Path]) -> None:
    evaluator = read_bundle(three_bundles[1]).evaluator()
    names = {token: cluster_of(scenario_of(token)) for token in sorted(evaluator.tokens)}
    clusters = evaluator.clustered(names)
    intervals = intervals_of(evaluator, clusters, evaluator.compute(), FEW_RESAMPLES).ends

    point = points_of(over_bytes(three_bundles, FEW_RESAMPLES))[1]
    assert (point.low, point.high) == intervals["ranges/30x30/iou"]
    assert point.low < point.value < point.high

    bare_point = points_of(over_bytes(three_bundles, Resampling(resamples=0)))[1]
    assert (bare_point.low, bare_point.high, bare_point.value) == (None, None, point.value)


def test_text_and_tables(three_bundles: list[Path]) -> None:
    report = over_bytes(three_bundles, FEW_RESAMPLES)
    point = points_of(report)[1]
    row = report.to_text().splitlines()[4].split()

    interval = [f"[{point.low:.3f},", f"{point.high:.3f}]"]
    assert row == [*metric_name(MAIN).split(), "b", "1,000,000", "63.50", "%", *interval]
    assert json.loads(report.to_json())["points"][1]["bytes"] == 1e6


def test_folders_of_the_same_name_are_shown_with_the_parts_that_differ(tmp_path: Path) -> None:
    folders = [
        write_shares(tmp_path / "a" / "motion", 40, 1.0),
        write_shares(tmp_path / "b" / "motion", 40, 2.0),
    ]
    points = points_of(over_bytes(folders, FEW_RESAMPLES))

    assert [point.evaluation for point in points] == ["a", "b"]


def test_samples_of_one_evaluation_only_are_refused_or_left_out(
    tmp_path: Path, three_bundles: list[Path]
) -> None:
    longer = write_shares(tmp_path / "longer", 60, 5.0, samples=10)
    assert_raises(
        (
            lambda: over_bytes([*three_bundles, longer], FEW_RESAMPLES),
            EvaluationError,
            "2 samples only in .*longer",
        )
    )

    report = over_bytes([longer, *three_bundles], FEW_RESAMPLES, common=True)
    assert report.samples == 8
    assert points_of(report)[0].value == pytest.approx(63.5)


@pytest.mark.parametrize(
    "note",
    [None, {}, bytes_note(-1.0), bytes_note(1.0, payload="a\nb")],
    ids=["none", "empty", "less", "lines"],
)
def test_results_that_do_not_note_bytes_are_named(
    tmp_path: Path, three_bundles: list[Path], note: Any
) -> None:
    silent = write_bundle(tmp_path / "silent", [(3, 1)] * 8, bytes_note=note)
    message = (f"{silent}: its results do not note", "predict again into a new folder")

    assert_raises(
        (lambda: over_bytes([three_bundles[0], silent], FEW_RESAMPLES), EvaluationError, message)
    )
    assert sent_bytes(read_bundle(silent).summary) is None


def test_other_rules_and_missing_folders_are_refused(
    tmp_path: Path, three_bundles: list[Path]
) -> None:
    path = three_bundles[2] / "metrics_summary.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"protocol": "paper"}))

    assert_raises(
        (
            lambda: over_bytes(three_bundles, FEW_RESAMPLES),
            EvaluationError,
            "were not evaluated by the same rules: protocol",
        ),
        (
            lambda: over_bytes([three_bundles[0], tmp_path / "none"], FEW_RESAMPLES),
            ResultsError,
            "no such folder",
        ),
    )
