"""The golden numbers of tracks (tests/data/golden/tracking), which TrackEval 1.3.0 and
nuscenes-devkit 1.2.0 made.
"""

import functools
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from support.expected_errors import assert_raises
from support.packed_release import unpack_release
from support.track_scenes import evaluate_rows

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ResultsError
from deepaccident_devkit.evaluation.results import read_results
from deepaccident_devkit.evaluation.runs import evaluate_results
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup, SampleSelection
from deepaccident_devkit.taxonomy import CATEGORIES

# Truth of the results file → its name in the golden files.
TRUTHS = {"visible": "truth_seen_by_any", "own": "truth_seen_by_the_agent"}
# The golden truth of the results file is rounded to 0.1 mm.
ROUNDING = 1e-5
CASES = ("exact", "noisy", "swapped", "everything")
# Number → its name in the files of each judge.
TRACKEVAL = {
    "hota": "HOTA",
    "det_a": "DetA",
    "ass_a": "AssA",
    "det_re": "DetRe",
    "det_pr": "DetPr",
    "ass_re": "AssRe",
    "ass_pr": "AssPr",
    "loc_a": "LocA",
    "mota": "MOTA",
    "moda": "MODA",
    "motp_similarity": "MOTP",
    "tp": "CLR_TP",
    "fn": "CLR_FN",
    "fp": "CLR_FP",
    "id_switches": "IDSW",
    "mostly_tracked": "MT",
    "partly_tracked": "PT",
    "mostly_lost": "ML",
    "fragments": "Frag",
    "idf1": "IDF1",
    "id_recall": "IDR",
    "id_precision": "IDP",
    "idtp": "IDTP",
    "idfn": "IDFN",
    "idfp": "IDFP",
}
NUSCENES = {
    **{name: name for name in ("amota", "amotp", "recall", "motar", "mota", "motp", "faf")},
    **{name: name for name in ("tp", "fp", "fn", "tid", "lgd")},
    "mostly_tracked": "mt",
    "mostly_lost": "ml",
    "id_switches": "ids",
    "fragments": "frag",
}
SIX_CLASSES = [[name, [name]] for name in CATEGORIES]


@functools.cache
def read_json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def golden_folder(pytestconfig: pytest.Config) -> Path:
    folder = pytestconfig.getoption("golden") / "tracking"
    if not (folder / "sequences.json").is_file():
        pytest.fail(f"{folder}: no golden tracks; see pytest --golden DIR")
    return folder


@pytest.fixture(scope="module")
def packed_da(golden_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> DeepAccident:
    packed = golden_folder.parent / "windows/release.npz"
    root = unpack_release(packed, tmp_path_factory.mktemp("tracking"))
    return DeepAccident(dataroot=root, verbose=False, workers=1)


def assert_same_numbers(
    actual: Mapping[str, float],
    expected: Mapping[str, float | None],
    names: Mapping[str, str],
    tolerance: float,
) -> None:
    """Compare the numbers that both have; None is NaN."""
    for name, other_name in names.items():
        value = expected[other_name]
        if value is None:
            assert math.isnan(actual[name]), name
        else:
            assert actual[name] == pytest.approx(value, abs=tolerance), name


def assert_same_as_trackeval(
    metrics: Mapping[str, Any], expected: Mapping[str, Any], tolerance: float = 1e-9
) -> None:
    for class_name, numbers in expected["classes"].items():
        assert_same_numbers(metrics["classes"][class_name], numbers, TRACKEVAL, tolerance)
    assert_same_numbers(metrics["class_mean"], expected["class_mean"], TRACKEVAL, tolerance)
    assert_same_numbers(metrics["pooled"], expected["all_detections"], TRACKEVAL, tolerance)


def assert_same_as_nuscenes(metrics: Mapping[str, Any], expected: Mapping[str, Any]) -> None:
    for class_name, numbers in expected["classes"].items():
        if numbers["gt"] is not None:
            assert metrics["classes"][class_name]["true_boxes"] == numbers["gt"]
            assert_same_numbers(metrics["classes"][class_name], numbers, NUSCENES, 1e-6)
    assert_same_numbers(metrics["class_mean"], expected["mean"], NUSCENES, 1e-6)


@pytest.mark.parametrize(
    ("prefix", "case"),
    [*(("", case) for case in CASES), *(("end_to_end_", case) for case in TRUTHS.values())],
)
def test_sequences_have_the_numbers_of_trackeval(
    golden_folder: Path, prefix: str, case: str
) -> None:
    sequences = read_json(golden_folder / f"{prefix}sequences.json")[case]
    expected = read_json(golden_folder / f"{prefix}trackeval.json")[case]

    result = evaluate_rows(sequences["recordings"])

    assert_same_as_trackeval(vars_of(result), expected)


@pytest.mark.parametrize("case", CASES)
def test_sequences_have_the_numbers_of_the_nuscenes_devkit(golden_folder: Path, case: str) -> None:
    sequences = read_json(golden_folder / "sequences.json")[case]

    result = evaluate_rows(sequences["recordings"], "nuscenes", classes=SIX_CLASSES)

    assert_same_as_nuscenes(vars_of(result), read_json(golden_folder / "nuscenes.json")[case])


def vars_of(result: Any) -> dict[str, Any]:
    return {name: getattr(result, name) for name in ("classes", "class_mean", "pooled")}


@pytest.mark.parametrize("truth", TRUTHS)
def test_results_file_has_the_numbers_of_trackeval(
    packed_da: DeepAccident, golden_folder: Path, truth: str
) -> None:
    results = read_results(golden_folder / "results.json")
    setup = EvaluationSetup(task="tracking", protocol="clean", switches={"truth": truth})

    run = evaluate_results(packed_da, results, setup, "all", workers=1)

    expected = read_json(golden_folder / "end_to_end_trackeval.json")[TRUTHS[truth]]
    assert_same_as_trackeval(vars_of(run.result), expected, ROUNDING)


def test_results_file_has_the_numbers_of_the_nuscenes_devkit(
    packed_da: DeepAccident, golden_folder: Path
) -> None:
    expected = read_json(golden_folder / "end_to_end_nuscenes.json")
    results = read_results(golden_folder / "results.json")
    setup = EvaluationSetup(task="tracking", protocol="nuscenes")
    selection = SampleSelection(
        split="all", samples="all", scope="all", agents=(expected["agent"],)
    )

    run = evaluate_results(packed_da, results, setup, selection, allow_partial=True, workers=1)

    assert_same_as_nuscenes(vars_of(run.result), expected)


def test_wrong_files_are_refused_and_right_ones_are_read(
    golden_folder: Path, tmp_path: Path
) -> None:
    cases = read_json(golden_folder / "refused.json")
    path = tmp_path / "tracking.json"

    for case in cases["refused"]:
        path.write_text(case["content"], encoding="utf-8")
        parts = (str(path), *case["message_has"])
        assert_raises((lambda: read_results(path), ResultsError, parts))
    for case in cases["taken"]:
        path.write_text(case["content"], encoding="utf-8")
        assert read_results(path).prediction(cases["token"]).boxes.frame == "world"
