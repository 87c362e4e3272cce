"""Where the instances of instance maps go."""

from __future__ import annotations

import numpy as np

from deepaccident_devkit.arrays import AnyArray, FloatArray
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion.orientations import cells_in


def instance_paths(instance: AnyArray, grid: BevGrid) -> dict[int, FloatArray]:
    """Where the instances of the first frame go, as `LinkedInstances.centers` has it for those read off heads.

    Args:
        instance: (T, H, W) ids from 1 that stay the same over the frames, 0 elsewhere.
        grid: its cells and orientation.

    Returns:
        Id, ascending → (n, 2) x forward, y left, metres: the mean of its cells' centres in each frame that it is in;
        a frame without it has no point.
    """
    shape = instance.shape[1:]
    ids = np.unique(instance[0][instance[0] > 0])
    place = np.flatnonzero(instance > 0)
    identity = instance.reshape(-1)[place]
    which = np.minimum(np.searchsorted(ids, identity), max(len(ids) - 1, 0))
    known = ids[which] == identity if len(ids) else np.zeros(len(place), dtype=bool)
    frame, *cell = np.unravel_index(place[known], instance.shape)
    key, length = which[known] * len(instance) + frame, len(ids) * len(instance)
    y, x = cells_in(cell[0], cell[1], shape, grid.orientation, "devkit")
    count = np.bincount(key, minlength=length)
    mean = [np.bincount(key, along, length) / np.maximum(count, 1) for along in (x, y)]
    metres = [low + (along + 0.5) * size for along, (low, _, size) in zip(mean, (grid.x, grid.y), strict=True)]
    paths = np.stack(metres, axis=-1).reshape(len(ids), len(instance), 2)
    there = count.reshape(len(ids), len(instance)) > 0
    return {name: path[here] for name, path, here in zip(ids.tolist(), paths, there, strict=True)}
