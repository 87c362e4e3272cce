"""Measure the counts of a segmented sample: 5 classes, 200 × 200 cells, three ranges; the reference
is torchmetrics' MultilabelJaccardIndex in one thread.
"""

import numpy as np

from benchmarks.measure import Figure, best_of, milliseconds, one_core
from deepaccident_devkit.evaluation.segmentation import SegmentationEvaluator, SegmentationOutput
from deepaccident_devkit.geometry import BevGrid

REPEATS = 60


def measure() -> list[Figure]:
    """Return the figure of one update."""
    grid = BevGrid()
    masks = np.random.default_rng(0).uniform(size=(2, 5, *grid.shape)) < 0.2
    prediction, truth = (
        SegmentationOutput.from_arrays(masks=layers, grid=grid) for layers in masks
    )
    known = np.ones(grid.shape, dtype=bool)
    evaluator = SegmentationEvaluator()
    with one_core():
        seconds = best_of(REPEATS, lambda: evaluator.update("sample", prediction, truth, known))
    return [milliseconds("segmentation_update_ms", seconds, bound=0.5, reference=25)]
