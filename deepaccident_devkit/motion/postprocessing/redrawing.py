"""The accident variant's boxes: each instance of the first frame rasterised as a rectangle along its path.

The released accident evaluation looks at these and not at the instances themselves (docs/released_code.md,
Post-processing). All its quirks are kept; the masks' rectangles and the rasterising are those of OpenCV 4.7, whatever
version is installed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Final

import numpy as np

from deepaccident_devkit.arrays import BoolArray, FloatArray, IntArray
from deepaccident_devkit.motion.drawing.polygon_fill import filled_cells
from deepaccident_devkit.motion.postprocessing.contours import Point, are_one_part, convex_hull, first_contour
from deepaccident_devkit.motion.postprocessing.min_area_rect import min_area_rects

LONGEST: Final = (10, 4)
"""Cells, length and width that a box is cut down to: a truck is rasterised as 5 m × 2 m."""
TURNING_MOVE: Final = 4
"""Cells that an instance must move in a step for its box to turn that way."""
_PI: Final = 3.1415926
"""The released code's π."""
_CORNERS: Final = np.array([[1, -1], [-1, -1], [-1, 1], [1, 1]])
"""A rectangle's corners: across and along its long side."""


def redrawn_cells(
    hulls: Sequence[Sequence[Point]], centers: FloatArray, exists: BoolArray, shape: tuple[int, int]
) -> tuple[list[IntArray], list[IntArray]]:
    """Boxes of the first frame's instances in all frames.

    An instance's first box has the length, width and angle of the smallest rectangle around its (last) part in the
    first frame; the later ones turn to where it moved if that was far enough. Boxes are rasterised in frames without a
    gap from the first on, as many as the instance is in: after a gap they are in the wrong frames. Later ids overwrite
    earlier ones.

    Args:
        hulls: of ids 1 to I in the first frame, from `first_hulls`.
        centers: (I, T, 2) rows and columns of the means of ids 1 to I.
        exists: (I, T) whether the id is in the frame.
        shape: rows and columns.

    Returns:
        For each frame (2, P) rows and columns of the cells rasterised, and (P,) their ids.
    """
    instances, frames = exists.shape
    if not instances:
        nothing = np.zeros((2, 0), dtype=np.int64)
        return [nothing] * frames, [nothing[0]] * frames
    size, angle = _first_boxes(hulls)
    instance, frame = np.nonzero(exists)
    step = (np.cumsum(exists, axis=1) - 1)[instance, frame]
    path = np.zeros((instances, frames, 2))
    path[instance, step] = centers[instance, frame]
    heading = _headings(path, angle)[instance, step]
    half = np.maximum(np.rint(np.minimum(size, LONGEST) / 2 + 0.001), 1)[instance]
    corners = _corners(path[instance, step], half, heading)
    corners = np.clip(np.rint(corners).astype(np.int64), 0, (shape[1] - 1, shape[0] - 1))
    cells, drawn = filled_cells(corners, shape, step, frames)
    image, *position = np.unravel_index(cells, (frames, *shape))
    ends = np.searchsorted(image, np.arange(1, frames))
    return np.split(np.stack(position), ends, axis=1), np.split(instance[drawn] + 1, ends)


def first_hulls(position: IntArray, ids: IntArray, instances: int) -> list[list[Point]]:
    """The convex hulls, (x, y), of instances 1 to I: of each one the part that OpenCV lists first.

    Args:
        position: (2, P) rows and columns of the cells, in row-major order.
        ids: (P,) the instance of each; 0 for what counts as background.
        instances: how many there are.
    """
    order = np.argsort(ids, kind="stable")[np.count_nonzero(ids == 0) :]
    owner, (rows, columns) = ids[order], position[:, order]
    ends = np.searchsorted(owner, np.arange(1, instances + 2)).tolist()
    whole = are_one_part(rows, columns, owner - 1, instances).tolist()
    return [
        convex_hull(first_contour(rows[start:end], columns[start:end], one_part=one))
        for (start, end), one in zip(pairwise(ends), whole, strict=True)
    ]


def _first_boxes(hulls: Sequence[Sequence[Point]]) -> tuple[FloatArray, FloatArray]:
    """(I, 2) length and width, cells, and (I,) angles of the smallest rectangles around hulls."""
    sides, angles = (values.astype(np.float64) for values in min_area_rects(hulls))
    upright = sides[:, 1] > sides[:, 0]
    angle = np.where(upright, -angles, 270 - angles) / 180 * _PI
    return np.where(upright[:, None], sides[:, ::-1], sides), angle


def _headings(path: FloatArray, angle: FloatArray) -> FloatArray:
    """(I, T) angles of the boxes at each step of the paths (I, T, 2): first `angle`, then that of the last far move."""
    moved = np.diff(np.rint(path), axis=1)
    far = (moved**2).sum(axis=-1) >= TURNING_MOVE**2
    headings = np.zeros(path.shape[:2])
    headings[:, 0] = angle
    # the math module's functions give the same bits with every numpy
    headings[:, 1:][far] = [math.atan2(across, down) for down, across in moved[far].tolist()]
    counts = np.concatenate([np.ones((len(path), 1), dtype=bool), far], axis=1)
    latest: IntArray = np.maximum.accumulate(np.where(counts, np.arange(path.shape[1]), 0), axis=1)
    return np.take_along_axis(headings, latest, axis=1)


def _corners(centers: FloatArray, half: FloatArray, angle: FloatArray) -> FloatArray:
    """(N, 4, 2) columns and rows of the corners of boxes around `centers` (rows, columns), half as long and wide."""
    cosine, sine = (np.array([function(a) for a in angle.tolist()])[:, None] for function in (math.cos, math.sin))
    across, along = np.moveaxis(_CORNERS * half[:, None, ::-1], -1, 0)
    column = cosine * across + sine * along + centers[:, 1:]
    row = -sine * across + cosine * along + centers[:, :1]
    return np.stack([column, row], axis=-1)
