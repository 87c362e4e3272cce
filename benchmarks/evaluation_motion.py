"""Motion metrics of a sample: 5 frames, 30 objects, 200 × 200 cells, both ranges; the released
code's times beside.
"""

import numpy as np

from benchmarks.labels_postprocess import FRAMES, clear_heads
from benchmarks.measure import Figure, best_of, one_core
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
    """`motion_update_ms` is IoU and VPQ of instances, which is what the released 14.7 ms are."""
    label, other = label_of(clear_heads(seed=0)), label_of(clear_heads(seed=1))
    grid = label.config.grid
    maps = instances_of(other.instance, grid)
    heads = MotionOutput(grid=grid, heads=tuple(clear_heads(seed) for seed in range(PREDICTIONS)))
    with one_core():
        return [
            Figure(
                name="motion_update_ms",
                value=1e3
                * best_of(REPEATS, lambda: motion_counts(maps, label, trajectories=False)),
                unit="ms",
                bound=1.0,
                reference=14.7,
            ),
            Figure(
                name="motion_update_with_paths_ms",
                value=1e3 * best_of(REPEATS, lambda: motion_counts(maps, label)),
                unit="ms",
            ),
            Figure(
                name="motion_update_of_heads_ms",
                value=1e3 * best_of(SLOW_REPEATS, lambda: motion_counts(heads, label)),
                unit="ms",
            ),
        ]


def label_of(heads: MotionHeads) -> MotionLabels:
    """Heads taken for labels at the present."""
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
