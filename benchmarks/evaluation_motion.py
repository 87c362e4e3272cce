"""Measure the motion metrics of a sample: 5 frames, 30 objects, 200 × 200 cells, both ranges; the
references are the released code's times.
"""

import numpy as np

from benchmarks.labels_postprocess import FRAMES, clear_heads
from benchmarks.measure import Figure, best_of, milliseconds, one_core
from deepaccident_devkit.evaluation.motion import motion_counts
from deepaccident_devkit.evaluation.predictions import MotionOutput, instances_of
from deepaccident_devkit.motion import (
    MotionHeads,
    MotionLabelConfig,
    MotionLabels,
    predict_instances,
)

PREDICTIONS = 6
REPEATS, SLOW_REPEATS = 60, 5


def measure() -> list[Figure]:
    """Return the figures; `motion_update_ms` is IoU and VPQ of instances, as are the released
    14.7 ms.
    """
    label = labels_from_heads(clear_heads(seed=0))
    prediction = labels_from_heads(clear_heads(seed=1)).instance
    grid = label.config.grid
    instances = instances_of(prediction, grid)
    heads = tuple(clear_heads(seed) for seed in range(PREDICTIONS))
    output = MotionOutput(grid=grid, heads=heads)
    with one_core():
        instances_s = best_of(REPEATS, lambda: motion_counts(instances, label, trajectories=False))
        paths_s = best_of(REPEATS, lambda: motion_counts(instances, label))
        heads_s = best_of(SLOW_REPEATS, lambda: motion_counts(output, label))
    return [
        milliseconds("motion_update_ms", instances_s, bound=1.0, reference=14.7),
        milliseconds("motion_update_with_paths_ms", paths_s),
        milliseconds("motion_update_of_heads_ms", heads_s),
    ]


def labels_from_heads(heads: MotionHeads) -> MotionLabels:
    """Return the labels at the present that the heads would be right for."""
    config = MotionLabelConfig(future_frames=FRAMES - 1)
    instance = predict_instances(heads).instance
    return MotionLabels(
        config=config,
        segmentation=(instance > 0).astype(np.uint8),
        instance=instance,
        centerness=heads.centerness,
        offset=heads.offset,
        flow=heads.flow,
        future_egomotion=np.zeros((config.frames, 6), dtype=np.float32),
        valid=np.ones(config.frames, dtype=bool),
        id_map={},
        at_present=True,
    )
