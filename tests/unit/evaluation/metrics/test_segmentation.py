"""Intersection over union of BEV targets."""

import json
import math

import numpy as np
import pytest
from refusals import assert_refused

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.evaluation.metrics.segmentation import BevSegmentationEvaluator
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion import BEV_CLASSES, BevSegmentation

GRID = BevGrid((0, 4, 1), (0, 4, 1))


def targets(known: bool = True, **cells) -> BevSegmentation:
    masks = np.zeros((len(BEV_CLASSES), 4, 4), dtype=bool)
    for name, rows in cells.items():
        masks[BEV_CLASSES.index(name), rows] = True
    return BevSegmentation(grid=GRID, masks=masks, known=np.full((4, 4), known))


def test_cells_are_summed_over_samples() -> None:
    evaluator = BevSegmentationEvaluator()
    evaluator.update("a", targets(road=slice(0, 2)), targets(road=slice(1, 3)))
    evaluator.update("b", targets(road=slice(0, 4)).masks.astype(np.uint8), targets(road=slice(0, 4)))
    result = evaluator.compute()
    assert result.cells["road"] == (20, 4, 4)
    assert result.iou["road"] == pytest.approx(100 * 20 / 28)
    assert math.isnan(result.iou["vehicle"])
    assert result.mean_iou == result.iou["road"]
    assert json.dumps(result.as_dict(), allow_nan=False)


def test_unknown_cells_do_not_count() -> None:
    evaluator = BevSegmentationEvaluator()
    evaluator.update("a", targets(road=slice(0, 4)), targets(known=False))
    assert math.isnan(evaluator.compute().mean_iou)
    assert math.isnan(BevSegmentationEvaluator().compute().mean_iou)


def test_predictions_that_do_not_fit() -> None:
    evaluator, truth = BevSegmentationEvaluator(), targets()
    assert_refused(
        (lambda: evaluator.update("a", np.zeros((5, 3, 4), dtype=bool), truth), GeometryError, "expected shape"),
        (
            lambda: evaluator.update("a", np.full((5, 4, 4), 0.4), truth),
            GeometryError,
            "compare scores with a threshold",
        ),
    )
    moved = BevSegmentation(grid=GRID.with_orientation("fiery"), masks=truth.masks, known=truth.known)
    with pytest.raises(GeometryError, match="use one grid"):
        evaluator.update("a", moved, truth)
