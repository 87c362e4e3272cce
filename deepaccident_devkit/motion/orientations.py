"""The same maps in another orientation: cells change places, and the channels of offset and flow with them.

Each change goes through the devkit's orientation. `released` has its rows in reverse order, so vectors down the rows
change their sign. `fiery` is its transpose, so rows and columns, and the two channels, change places.
"""

from __future__ import annotations

import numpy as np

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.geometry.bev_grid import ORIENTATIONS, Axis, Orientation, cells_in, turned
from deepaccident_devkit.support.arrays import AnyArray
from deepaccident_devkit.support.text import choice

__all__ = ["axes_of", "cells_in", "to_orientation", "vectors_in"]


def to_orientation(
    array: AnyArray, *, vectors: bool, source: Orientation, target: Orientation, ignore: float | None = None
) -> AnyArray:
    """Maps (…, H, W) in the orientation `source`, turned into the orientation `target`.

    Args:
        array: any maps; with `vectors`, (…, 2, H, W), down the rows and along the columns.
        vectors: whether the values point along rows and columns (offset, flow).
        source: the orientation of `array`.
        target: the orientation of the result.
        ignore: the value of both channels where there is no vector; None if all values are vectors.

    Returns:
        A view if no value changes, or a new array.

    Raises:
        GeometryError: `vectors` have another shape.
        ChoiceError: there is no such orientation.
    """
    source, target = (choice("orientation", name, ORIENTATIONS) for name in (source, target))
    if source == target:
        return array
    devkit = turned(array, source)
    if not vectors:
        return turned(devkit, target)
    if array.ndim < 3 or array.shape[-3] != 2:
        raise GeometryError(f"vectors: expected shape (…, 2, H, W), found {array.shape}")
    down, along = devkit[..., 0, :, :], devkit[..., 1, :, :]
    result = np.stack(vectors_in(down, along, source, target), axis=-3)
    if ignore is not None:
        np.copyto(result, ignore, where=((down == ignore) & (along == ignore))[..., None, :, :])
    return turned(result, target)


def vectors_in(down: AnyArray, along: AnyArray, source: Orientation, target: Orientation) -> tuple[AnyArray, AnyArray]:
    """The components down the rows and along the columns of one orientation, as those of another."""
    if source == "fiery":
        down, along = along, down
    if (source == "released") != (target == "released"):
        down = 0 - down  # and not −0.0 where there was 0
    return (along, down) if target == "fiery" else (down, along)


def axes_of(grid: BevGrid) -> tuple[Axis, Axis]:
    """Start, end and cell size, metres, of rows and of columns as the grid's orientation counts them.

    The released rows run along a left-handed y: its start and end are the negated end and start of the grid's.
    """
    low, high, size = grid.y
    if grid.orientation == "fiery":
        return grid.x, grid.y
    return (grid.y if grid.orientation == "devkit" else (-high, -low, size)), grid.x
