"""What lies beneath the actors that stayed: ground that no picture saw, although pictures saw all around it."""

from __future__ import annotations

from typing import Final

import numpy as np

from deepaccident_devkit.support.arrays import ByteArray, IntArray

_LARGEST: Final = 60.0
"""Square metres of a hole that parked vehicles can make: two lorries. A larger one may be a yard."""


def hidden_ground(classes: ByteArray, resolution: float) -> ByteArray:
    """The ground of small holes: what most of the cells around a hole are, road lines taken for road.

    Args:
        classes: (H, W) uint8, 0 where nothing was seen, 1 road, 2 road line, then others.
        resolution: side of a cell, metres.

    Returns:
        (H, W) uint8, the class of the cells of holes; 0 where something was seen, and in holes that are larger than
        60 m² or reach the raster's edge.
    """
    from scipy import ndimage

    labels, count = ndimage.label(classes == 0)
    filled = np.zeros_like(classes)
    closed = np.bincount(labels.ravel(), minlength=count + 1) * resolution**2 <= _LARGEST
    closed[0] = False
    for edge in (labels[0], labels[-1], labels[:, 0], labels[:, -1]):
        closed[edge] = False
    rows, columns = np.nonzero(closed[labels])
    holes = labels[rows, columns].astype(np.int64)
    filled[rows, columns] = _classes_around(classes, rows, columns, holes, count)[holes]
    return filled


def _classes_around(classes: ByteArray, rows: IntArray, columns: IntArray, holes: IntArray, count: int) -> ByteArray:
    """The most frequent class (1 + count,) beside the cells (N,) of each hole, by the hole's number."""
    kinds = int(classes.max(initial=0)) + 1
    votes = np.zeros((count + 1, max(kinds, 3)), dtype=np.int64)
    for down, right in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        np.add.at(votes, (holes, classes[rows + down, columns + right]), 1)
    votes[:, 1] += votes[:, 2]
    votes[:, [0, 2]] = 0
    result: ByteArray = votes.argmax(axis=1).astype(np.uint8)
    return result
