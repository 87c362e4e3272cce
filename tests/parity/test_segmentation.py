"""The golden numbers of segmentation (tests/data/golden/segmentation): truth and counts exactly,
percentages as torchmetrics to 1e-4, and OneBEV's to 1e-5.
"""

import functools
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from deepaccident_devkit.evaluation.segmentation import (
    CAMERA_CLASSES,
    SegmentationEvaluator,
    SegmentationOutput,
    SegmentationProtocol,
    SegmentationResult,
)
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion import cell_tags, segmentation_of
from deepaccident_devkit.release import BevImage

CASES = ("exact", "noisy", "absent", "camera")
CELLS = 200
ONEBEV_GRID = BevGrid((-48, 48, 0.48), (-48, 48, 0.48), "released")


@functools.cache
def _files(folder: Path) -> tuple[Mapping[str, np.ndarray], Mapping[str, Any]]:
    arrays: dict[str, np.ndarray] = {}
    for name in ("cases", "onebev_scores", "semantic"):
        with np.load(folder / f"{name}.npz") as archive:
            arrays |= dict(archive)
    for name, array in arrays.items():
        if name.endswith(("/pred", "/truth", "/known")):
            arrays[name] = np.unpackbits(array, axis=-1)[..., :CELLS].astype(bool)
    return arrays, json.loads((folder / "expected.json").read_text(encoding="utf-8"))


@pytest.fixture
def golden_files(
    pytestconfig: pytest.Config,
) -> tuple[Mapping[str, np.ndarray], Mapping[str, Any]]:
    return _files(pytestconfig.getoption("golden") / "segmentation")


@pytest.fixture
def images(golden_files: tuple[Mapping[str, np.ndarray], Any]) -> list[BevImage]:
    nothing = np.zeros((1200, 1200), np.uint16)
    return [BevImage(semantic=tags, instance=nothing) for tags in golden_files[0]["semantic"]]


def compute_case(
    arrays: Mapping[str, np.ndarray], case: str, classes: tuple[str, ...]
) -> tuple[SegmentationEvaluator, SegmentationResult]:
    class_set: Any = "camera" if case == "camera" else "bev5"
    evaluator = SegmentationEvaluator(SegmentationProtocol(classes=class_set))
    layers: dict[str, Any] = {"classes": classes, "grid": BevGrid()}
    for number, masks in enumerate(arrays[f"{case}/pred"]):
        truth = SegmentationOutput(masks=arrays[f"{case}/truth"][number], **layers)
        prediction = SegmentationOutput(masks=masks, **layers)
        evaluator.update(str(number), prediction, truth, arrays[f"{case}/known"][number])
    return evaluator, evaluator.compute()


@pytest.mark.parametrize("case", CASES)
def test_counts_and_percentages_equal_torchmetrics(
    golden_files: tuple[Mapping[str, np.ndarray], Mapping[str, Any]], case: str
) -> None:
    arrays, cases = golden_files
    expected = cases[case]
    evaluator, result = compute_case(arrays, case, tuple(expected["classes"]))
    (pooled,) = evaluator.pooled([*evaluator.counts.values()])
    for cells, (name, numbers) in zip(
        pooled["cells"][0], expected["expected"].items(), strict=True
    ):
        common, predicted, true = cells
        assert common.tolist() == numbers["tp"]
        assert (predicted - common).tolist() == numbers["fp"]
        assert (true - common).tolist() == numbers["fn"]

        iou = result.ranges[name]["iou"]
        assert_allclose([*iou.values()], np.array(numbers["iou"], float), rtol=0, atol=1e-4)
        torchmetrics_iou = np.array(numbers["torchmetrics_iou"])
        assert_allclose(np.nan_to_num([*iou.values()]), 100 * torchmetrics_iou, rtol=0, atol=1e-4)
        assert_allclose(result.ranges[name]["miou"], numbers["miou"], rtol=0, atol=1e-4)


def test_thresholds_chosen_on_the_truth_equal_onebevs(
    golden_files: tuple[Mapping[str, np.ndarray], Mapping[str, Any]],
) -> None:
    arrays, cases = golden_files
    expected = cases["onebev"]["expected"]
    evaluator = SegmentationEvaluator("onebev")
    assert evaluator.protocol.thresholds == tuple(cases["onebev"]["thresholds"])
    layers: dict[str, Any] = {"classes": CAMERA_CLASSES, "grid": ONEBEV_GRID}
    for number, scores in enumerate(arrays["scores"]):
        truth = SegmentationOutput(masks=arrays["onebev/truth"][number], **layers)
        prediction = SegmentationOutput(scores=scores, **layers)
        evaluator.update(str(number), prediction, truth, np.ones((CELLS, CELLS), dtype=bool))
    numbers = evaluator.compute().ranges["all"]
    for name, value in {**numbers["iou"], "mean": numbers["miou"]}.items():
        assert value / 100 == pytest.approx(expected[f"{name}/iou@max"], rel=0, abs=1e-5)


@pytest.mark.parametrize("sample", range(4))
def test_truth_equals_the_goldens(
    golden_files: tuple[Mapping[str, np.ndarray], Any], images: list[BevImage], sample: int
) -> None:
    arrays, _ = golden_files
    image = images[sample]
    segmentation = segmentation_of(image, BevGrid())
    assert_array_equal(segmentation.masks, arrays["exact/truth"][sample])
    tags, known = cell_tags(image, BevGrid())
    assert_array_equal(tags, arrays["camera/label"][sample])
    assert_array_equal(known, arrays["camera/known"][sample])
    camera = SegmentationOutput.from_labels(tags, grid=BevGrid())
    assert_array_equal(camera.masks_at(0.5), arrays["camera/truth"][sample])
    onebev_tags, _ = cell_tags(image, ONEBEV_GRID, "corner")
    onebev = SegmentationOutput.from_labels(onebev_tags, grid=ONEBEV_GRID)
    assert_array_equal(onebev.masks_at(0.5), arrays["onebev/truth"][sample])
