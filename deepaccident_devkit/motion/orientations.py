"""The same maps lying otherwise: cells change places, and what offset and flow say along rows and columns with them.

The devkit's orientation is the hub: `released` has its rows in reverse order, so that what points down the rows
changes its sign; `fiery` is its transpose, so that rows and columns, and the two channels, change places.
"""

from __future__ import annotations

import numpy as np

from deepaccident_devkit.arrays import AnyArray
from deepaccident_devkit.errors import ChoiceError, GeometryError
from deepaccident_devkit.geometry.bev_grid import ORIENTATIONS, Orientation


def to_orientation(
    array: AnyArray, *, vectors: bool, source: Orientation, target: Orientation, ignore: float | None = None
) -> AnyArray:
    """Maps (…, H, W) that lie as `source` says, lying as `target` says.

    Args:
        array: any maps; with `vectors`, (…, 2, H, W), down the rows and along the columns.
        vectors: whether the values point along rows and columns (offset, flow).
        source: how they lie.
        target: how they are to lie.
        ignore: a value of `vectors` that is a mark and no number of cells; None for none.

    Returns:
        A view where no value changes, else a new array.

    Raises:
        GeometryError: `vectors` have another shape.
        ChoiceError: there is no such orientation.
    """
    for name in (source, target):
        if name not in ORIENTATIONS:
            raise ChoiceError(f"orientation: expected one of {', '.join(ORIENTATIONS)}, found {name!r}")
    if source == target:
        return array
    devkit = _with_devkit(array, source)
    if not vectors:
        return _with_devkit(devkit, target)
    if array.ndim < 3 or array.shape[-3] != 2:
        raise GeometryError(f"vectors: expected shape (…, 2, H, W), found {array.shape}")
    down, along = devkit[..., 0, :, :], devkit[..., 1, :, :]
    for name in (source, target):
        if name == "fiery":
            down, along = along, down
        elif name == "released":
            down = _negated(down, ignore)
    return _with_devkit(np.stack([down, along], axis=-3), target)


def cells_in(
    row: AnyArray, column: AnyArray, shape: tuple[int, int], source: Orientation, target: Orientation
) -> tuple[AnyArray, AnyArray]:
    """Where cells of one orientation, `shape` its rows and columns, are in another: row and column."""
    rows, columns = shape
    if source == "fiery":
        row, column, rows, columns = column, row, columns, rows
    if (source == "released") != (target == "released"):
        row = rows - 1 - row
    return (column, row) if target == "fiery" else (row, column)


def vectors_in(down: AnyArray, along: AnyArray, source: Orientation, target: Orientation) -> tuple[AnyArray, AnyArray]:
    """What points down the rows and along the columns of one orientation, in another."""
    if source == "fiery":
        down, along = along, down
    if (source == "released") != (target == "released"):
        down = 0 - down
    return (along, down) if target == "fiery" else (down, along)


def _with_devkit(maps: AnyArray, orientation: Orientation) -> AnyArray:
    """The devkit's orientation → `orientation`, or back: each is its own way back."""
    if orientation == "fiery":
        return maps.swapaxes(-1, -2)
    return maps if orientation == "devkit" else maps[..., ::-1, :]


def _negated(values: AnyArray, ignore: float | None) -> AnyArray:
    negative = 0 - values  # and not −0.0 where there was 0
    return negative if ignore is None else np.where(values == ignore, values, negative)
