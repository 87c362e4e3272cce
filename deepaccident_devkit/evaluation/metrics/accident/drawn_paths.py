"""`DrawnPaths`: what the released accident evaluation compares: the first frame's instances, their paths, boxes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deepaccident_devkit.arrays import AnyArray, BoolArray, FloatArray, IntArray
from deepaccident_devkit.evaluation.metrics.trajectories import Paths, instance_paths
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion import MotionHeads, PostProcessing, predict_instances, trajectories
from deepaccident_devkit.motion.orientations import to_orientation
from deepaccident_devkit.motion.postprocessing.redrawing import first_hulls, redrawn_cells


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DrawnPaths:
    """One prediction, or the truth, over T frames.

    Attributes:
        paths: by id, ascending, the first frame's instances: (n, 2) positions in metres, one for each frame that the
            instance is in.
        drawn: (T, H, W) the ids as they are rasterised, 0 elsewhere; in the orientation `released`, since outlines
            depend on where they begin.
    """

    paths: Paths
    drawn: AnyArray


def paths_of_heads(heads: MotionHeads, grid: BevGrid, settings: PostProcessing) -> tuple[DrawnPaths, AnyArray]:
    """Instances found by the accident post-processing, and (H, W) their ids at the present, as the heads lie."""
    linked = predict_instances(heads, settings)
    drawn = linked.instance if linked.redrawn is None else linked.redrawn
    drawn = to_orientation(drawn, vectors=False, source=heads.orientation, target="released")
    paths = trajectories(linked, grid, half_cell_shift=False)  # as instance maps' are: only differences count
    return DrawnPaths(paths=paths, drawn=drawn), linked.instance[0]


def paths_of_instances(instance: AnyArray, grid: BevGrid, *, redraw: bool) -> DrawnPaths:
    """Instances given as maps.

    Args:
        instance: (T, H, W) ids from 1 that stay the same over the frames, 0 elsewhere.
        grid: its cells and orientation.
        redraw: rasterise boxes along the paths, as the released post-processing does; else keep the instances.
    """
    paths = instance_paths(instance, grid)
    lying = to_orientation(instance, vectors=False, source=grid.orientation, target="released")
    return DrawnPaths(paths=paths, drawn=_redrawn(lying, np.array([*paths], dtype=np.int64)) if redraw else lying)


def _redrawn(instance: AnyArray, ids: IntArray) -> AnyArray:
    """(T, H, W) the boxes of the first frame's instances `ids`, ascending."""
    frames, *shape = instance.shape
    frame, *position = np.nonzero(np.isin(instance, ids))
    which = np.searchsorted(ids, instance[frame, position[0], position[1]])
    first = frame == 0
    hulls = first_hulls(np.stack(position)[:, first], which[first] + 1, len(ids))
    centers, exists = _centers(which * frames + frame, np.stack(position), (len(ids), frames))
    cells, drawn = redrawn_cells(hulls, centers, exists, (shape[0], shape[1]))
    result = np.zeros_like(instance)
    for image, (row, column), rank in zip(result, cells, drawn, strict=True):
        image[row, column] = ids[rank - 1]
    return result


def _centers(key: IntArray, position: IntArray, shape: tuple[int, int]) -> tuple[FloatArray, BoolArray]:
    """(I, T, 2) mean rows and columns of cells by key, 0 where there are none, and (I, T) where there are some."""
    length = shape[0] * shape[1]
    count = np.bincount(key, minlength=length)
    sums = np.stack([np.bincount(key, along, length) for along in position], axis=-1)
    centers = sums / np.maximum(count, 1)[:, None]
    return centers.reshape(*shape, 2), count.reshape(shape) > 0
