"""The task `segmentation`: laws of its counts, its truth, its pictures, and runs on a release."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.expected_errors import assert_raises

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import (
    ConfigError,
    EvaluationError,
    GeometryError,
    MissingFileError,
)
from deepaccident_devkit.evaluation import ResultsWriter, SegmentationOutput, read_results
from deepaccident_devkit.evaluation.runs import compare_bundles, evaluate_results, save_run
from deepaccident_devkit.evaluation.runs.sanity import check_sanity
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup
from deepaccident_devkit.evaluation.runs.verification import verify_bundle
from deepaccident_devkit.evaluation.segmentation import (
    CAMERA_CLASSES,
    SegmentationEvaluator,
    SegmentationProtocol,
    segmentation_truth,
)
from deepaccident_devkit.evaluation.task import headlines
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion import BEV_CLASSES
from deepaccident_devkit.render.outcomes.described import sample_drawing, task_drawing

GRID = BevGrid((-60.0, 60.0, 5.0), (-55.0, 60.0, 5.0))
SHAPE = (5, *GRID.shape)
SAMPLE = "a/b/ego_vehicle/001"
KNOWN = np.ones(GRID.shape, dtype=bool)


def random_masks(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(size=SHAPE) < 0.4


def make_output(masks: np.ndarray, grid: BevGrid = GRID, **options: Any) -> SegmentationOutput:
    return SegmentationOutput.from_arrays(masks=masks, grid=grid, **options)


def count(prediction: SegmentationOutput, truth: SegmentationOutput, known: np.ndarray) -> Any:
    evaluator = SegmentationEvaluator()
    evaluator.update(SAMPLE, prediction, truth, known)
    return evaluator.counts[SAMPLE]["cells"]


@given(st.integers(0, 99), st.permutations(range(5)), st.sampled_from(["released", "fiery"]))
def test_orientation_order_and_unknown_cells_change_no_count(
    seed: int, order: list[int], orientation: Any
) -> None:
    predicted, true = random_masks(seed), random_masks(seed + 100)
    known = random_masks(seed + 200)[0]
    expected = count(make_output(predicted & known), make_output(true & known), KNOWN)
    turned = GRID.reorient(predicted, orientation)[order]
    classes = [BEV_CLASSES[index] for index in order]
    prediction = make_output(turned, orientation=orientation, classes=classes)
    assert count(prediction, make_output(true), known) == expected
    turned_truth = make_output(GRID.reorient(true, orientation), orientation=orientation)
    assert count(prediction, turned_truth, GRID.reorient(known, orientation)) == expected


@given(st.integers(0, 99))
def test_a_range_counts_the_cells_whose_centres_it_contains(seed: int) -> None:
    predicted, true = random_masks(seed), random_masks(seed + 100)
    counts = count(make_output(predicted), make_output(true), KNOWN)[0]
    distance = np.abs(GRID.centers()).max(axis=-1)
    for side, (common, predicted_count, true_count) in zip((30, 100, 1000), counts, strict=True):
        in_range = distance <= side / 2
        assert common == (predicted & true & in_range).sum(axis=(1, 2)).tolist()
        assert predicted_count == (predicted & in_range).sum(axis=(1, 2)).tolist()
        assert true_count == (true & in_range).sum(axis=(1, 2)).tolist()


def test_scores_count_from_the_threshold_on_and_absent_classes_by_the_protocol() -> None:
    scores = np.zeros(SHAPE)
    scores[0, 10] = 0.5
    scores[1, 10] = np.nextafter(0.5, 0)
    masks = np.zeros(SHAPE, dtype=bool)
    masks[:2, 10, :12] = True
    prediction = SegmentationOutput.from_arrays(scores=scores, grid=GRID)
    expected = {False: (25.0, np.nan), True: (10.0, 0.0)}
    for absent_is_zero, (miou, pedestrian) in expected.items():
        evaluator = SegmentationEvaluator(SegmentationProtocol(absent_is_zero=absent_is_zero))
        evaluator.update(SAMPLE, prediction, make_output(masks), KNOWN)
        result = evaluator.compute()
        assert result.ranges["all"]["iou"]["road"] == 50
        assert result.ranges["all"]["iou"]["lane_line"] == 0
        np.testing.assert_equal(result.ranges["all"]["iou"]["pedestrian"], pedestrian)
        assert result.ranges["all"]["miou"] == miou
    names = [number.name for number in headlines(result)]
    assert names == ["miou 100x100", *(f"iou {name}" for name in BEV_CLASSES), "miou 30x30"]


def test_other_predictions_are_refused() -> None:
    truth = make_output(random_masks(0))
    nearer = BevGrid((-50.0, 70.0, 5.0), GRID.y)
    four = SegmentationOutput(classes=BEV_CLASSES[:4], grid=GRID, masks=random_masks(0)[:4])
    assert_raises(
        (lambda: count(four, truth, KNOWN), EvaluationError, ("pedestrian", "classes=camera")),
        (
            lambda: count(make_output(random_masks(0), nearer), truth, KNOWN),
            EvaluationError,
            ("x=(-60.0", "found", "x=(-50.0"),
        ),
        (
            lambda: count(np.zeros(SHAPE), truth, KNOWN),  # type: ignore[arg-type]
            EvaluationError,
            ("SegmentationOutput, found ndarray",),
        ),
        (lambda: SegmentationOutput.from_arrays(grid=GRID), GeometryError, ("masks or scores",)),
        (
            lambda: make_output(random_masks(0), classes="road"),
            GeometryError,
            ("classes", "'road'"),
        ),
        (lambda: SegmentationProtocol(thresholds=()), ConfigError, ("thresholds", "found ()")),
        (lambda: SegmentationProtocol(thresholds=(1.1,)), ConfigError, ("1.1",)),
    )


def test_the_picture_divides_known_cells_by_outcome() -> None:
    predicted, true, known = random_masks(1), random_masks(2), random_masks(3)[0]
    evaluator = SegmentationEvaluator()
    drawing = evaluator.drawing(None, SAMPLE, make_output(predicted), make_output(true), known)  # type: ignore[arg-type]
    expected = {
        "truth": predicted & true,
        "right": predicted & true,
        "missed": true & ~predicted,
        "false": predicted & ~true,
    }
    assert [cells.role for cells in drawing.cells] == [*expected]
    for cells in drawing.cells:
        masks = expected[cells.role] & known
        np.testing.assert_array_equal(cells.instance[0] > 0, masks.any(axis=0))
        assert (cells.instance[0] == 5).sum() == masks[4].sum()  # the last class is on top
    (alone,) = make_output(predicted).drawing().cells
    np.testing.assert_array_equal(alone.instance[0] > 0, predicted.any(axis=0))


@pytest.fixture(scope="module")
def tokens(da: DeepAccident) -> list[str]:
    return da.samples("train", "evaluate")


def write_changed(da: DeepAccident, tokens: list[str], path: Path, change: Any) -> Any:
    with ResultsWriter(path, "segmentation", meta={"method": path.name}) as writer:
        for token in tokens:
            writer.add(token, change(token))
    return read_results(path)


def test_runs_on_a_release(da: DeepAccident, tokens: list[str], tmp_path: Path) -> None:
    perfect = write_changed(
        da, tokens, tmp_path / "perfect", lambda token: make_output_of(da, token)
    )
    missed = write_changed(
        da,
        tokens,
        tmp_path / "missed",
        lambda _: make_output(np.zeros((5, 200, 200), bool), BevGrid()),
    )
    setup = EvaluationSetup(task="segmentation", protocol="clean")
    bundles = []
    for results, miou in ((perfect, 100.0), (missed, 0.0)):
        run = evaluate_results(da, results, setup, "train", workers=1)
        assert run.result.ranges["100x100"]["miou"] == miou
        assert run.result.samples == len(tokens) > 1
        bundles.append(save_run(run, tmp_path / f"run_{miou:g}"))
    assert verify_bundle(bundles[0], da, results=perfect).is_same
    assert "mIoU" in compare_bundles(*bundles).to_text()
    onebev_grid = BevGrid((-48, 48, 0.48), (-48, 48, 0.48), "released")
    onebev = EvaluationSetup(task="segmentation", protocol="onebev")
    tags = write_changed(
        da,
        tokens,
        tmp_path / "tags",
        lambda token: segmentation_truth(da, token, onebev_grid, onebev.rules)[0],
    )
    result = evaluate_results(da, tags, onebev, "train", workers=1).result
    assert result.ranges["all"]["iou"]["7"] == 100
    assert [*result.ranges["all"]["iou"]] == [*CAMERA_CLASSES]


def make_output_of(da: DeepAccident, token: str, grid: BevGrid | None = None) -> SegmentationOutput:
    segmentation = da.bev_segmentation(token, grid)
    return make_output(segmentation.masks, BevGrid())


MISTAKES = {
    "": make_output_of,
    "y mirrored": lambda da, token: make_output(
        da.bev_segmentation(token).masks, BevGrid(), orientation="released"
    ),
    "x and y swapped": lambda da, token: make_output(
        da.bev_segmentation(token).masks, BevGrid(), orientation="fiery"
    ),
    "half a cell too far back and left": lambda da, token: make_output_of(
        da, token, BevGrid((-49.75, 50.25, 0.5), (-50.25, 49.75, 0.5))
    ),
    "layers swapped": lambda da, token: make_output(
        da.bev_segmentation(token).masks[[2, 1, 0, 3, 4]], BevGrid()
    ),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_sanity_names_the_mistake(
    da: DeepAccident, tokens: list[str], tmp_path: Path, mistake: str
) -> None:
    results = write_changed(da, tokens, tmp_path / "s", lambda token: MISTAKES[mistake](da, token))
    setup = EvaluationSetup(task="segmentation", protocol="clean")
    report = check_sanity(da, results, setup, tokens)
    assert {*MISTAKES} - {""} <= {*report.sought}
    assert [warning.partition(":")[0] for warning in report.warnings] == [mistake][: bool(mistake)]


def test_a_release_without_bev_files_is_refused(da_b: DeepAccident) -> None:
    token = da_b.scenario[0]["token"] + "/ego_vehicle/001"
    assert_raises(
        (
            lambda: segmentation_truth(da_b, token, BevGrid()),
            MissingFileError,
            ("BEV_instance_camera", "no such file"),
        )
    )


def test_a_sample_draws_itself(da: DeepAccident, tokens: list[str]) -> None:
    drawn = sample_drawing(da, tokens[0], make_output_of(da, tokens[0]), task="segmentation")
    assert "mIoU (100 m × 100 m) 100.00 %" in drawn.words
    assert [bool(cells.instance.any()) for cells in drawn.drawing.cells] == [
        True,
        True,
        False,
        False,
    ]


def test_without_bev_files_the_prediction_is_drawn_alone(da_b: DeepAccident) -> None:
    token = da_b.scenario[0]["token"] + "/ego_vehicle/001"
    prediction = make_output(random_masks(1))
    (cells,) = task_drawing(da_b, token, prediction, "segmentation").cells
    assert cells.role == "predicted"
