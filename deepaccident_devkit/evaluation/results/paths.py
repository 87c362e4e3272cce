"""Where predicted instances go: id → a point in each frame, x forward, y left, metres; NaN in frames without it."""

from __future__ import annotations

import numpy as np

from deepaccident_devkit.arrays import AnyArray, FloatArray
from deepaccident_devkit.evaluation.instance_paths import instance_paths
from deepaccident_devkit.evaluation.predictions import MotionOutput
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion import LinkedInstances, predict_instances, trajectories


def paths_of(output: MotionOutput, labels: str | None) -> dict[int, FloatArray]:
    """The paths of the instances in the first frame of the last prediction, in the present ego frame.

    Args:
        output: of a sample.
        labels: the label protocol that the model learned from; None if not known (`linked_paths`).

    Returns:
        Id, ascending → (T, 2).
    """
    if output.instances is not None:
        return map_paths(output.instances[-1], output.grid)
    heads = (output.heads or ())[-1]
    return linked_paths(predict_instances(heads, "motion"), output.grid, labels)


def linked_paths(linked: LinkedInstances, grid: BevGrid, labels: str | None) -> dict[int, FloatArray]:
    """Likewise of instances that were read off heads; without a label protocol a cell stands for its middle."""
    frames = len(linked.instance)
    points = trajectories(linked, grid, labels) if labels else trajectories(linked, grid, half_cell_shift=False)
    return {name: _in_frames(path, linked.paths[name].frames, frames) for name, path in points.items()}


def map_paths(instance: AnyArray, grid: BevGrid) -> dict[int, FloatArray]:
    """Likewise of instance maps (T, H, W); points are the means of the cells' centres."""
    present = [np.unique(frame) for frame in instance]
    return {
        name: _in_frames(path, np.flatnonzero([name in ids for ids in present]), len(instance))
        for name, path in instance_paths(instance, grid).items()
    }


def _in_frames(points: FloatArray, frames: AnyArray, count: int) -> FloatArray:
    result = np.full((count, 2), np.nan)
    result[frames] = points
    return result
