"""`BevGrid`: cells of a raster seen from above in three orientations, and conversions of rasters.

Each conversion goes through the devkit's orientation. `released` has its rows in reverse order, so
vectors down the rows change their sign. `fiery` is its transpose, so rows and columns, and the two
channels, change places.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, field, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.errors import ConfigError, GeometryError
from deepaccident_devkit.support.arrays import AnyArray, BoolArray, FloatArray, IntArray, as_numbers
from deepaccident_devkit.support.text import choice, settle_choices

Orientation = Literal["devkit", "released", "fiery"]
Axis = tuple[float, float, float]
ORIENTATIONS: tuple[Orientation, ...] = get_args(Orientation)
# Largest distance of a range from a whole number of cells, in cells: decimal cell sizes are not
# exact in binary.
_CELL_COUNT_TOLERANCE = 1e-6


@dataclass(frozen=True, slots=True)
class BevGrid:
    """Square or rectangular cells over a part of the ground; equal grids have equal hashes.

    Ranges are always right-handed metres, x forward and y **left**. The orientation only defines
    the order of the cells in an array (for the default ranges, 200 × 200):

    - `"devkit"`: row = y index, column = x index, both rising: row 0 is the far right (y = −50),
      column 0 the far rear (x = −50).
    - `"released"`: the released labels' left-handed rows, column = x index: row 0 is the far
      **left** (y = 50). Exactly the devkit's rows in reverse order: `released[..., ::-1, :]` is the
      devkit's array.
    - `"fiery"`: row = x index, column = y index, both rising: row 0 is the far rear, column 0 the
      far right. Exactly the devkit's array, transposed.

    Attributes:
        x: Start, end and cell size along x, metres.
        y: Start, end and cell size along y, metres.
        orientation: Order of the cells in an array.
    """

    x: Axis = (-50.0, 50.0, 0.5)
    y: Axis = (-50.0, 50.0, 0.5)
    orientation: Orientation = "devkit"
    _counts: tuple[int, int] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Check the ranges; raises ConfigError, or ChoiceError for an unknown orientation."""
        settle_choices(self, {"orientation": ORIENTATIONS})
        for name in ("x", "y"):
            object.__setattr__(self, name, _axis(name, getattr(self, name)))
        object.__setattr__(self, "_counts", (_cell_count("x", self.x), _cell_count("y", self.y)))

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of an array: (y cells, x cells), for `"fiery"` (x cells, y cells)."""
        along_x, along_y = self._counts
        return (along_x, along_y) if self.orientation == "fiery" else (along_y, along_x)

    @property
    def cells(self) -> int:
        """Number of cells."""
        return math.prod(self._counts)

    @property
    def text(self) -> str:
        """`200 × 200 cells of 0.5 m`: rows, columns and the size of a cell along x and y."""
        rows, columns = self.shape
        sizes = dict.fromkeys(f"{axis[2]:g}" for axis in (self.x, self.y))
        return f"{rows} × {columns} cells of {' × '.join(sizes)} m"

    def with_orientation(self, orientation: Orientation) -> BevGrid:
        """Return the same cells with another order in an array. Raises ChoiceError."""
        if orientation in ORIENTATIONS:
            return _with_orientation(self, orientation)
        return replace(self, orientation=orientation)  # the new grid checks it

    def index_of(self, points: ArrayLike) -> tuple[IntArray, BoolArray]:
        """Return the cells in which points lie.

        In every orientation, a cell includes its lower edges in x and y. (Label rasters round
        polygon corners by another rule, docs/released_code.md, Motion labels; this one is for
        points.)

        Args:
            points: (N, 2) or (N, 3) x forward, y left, metres.

        Returns:
            (N, 2) int64 row and column in this orientation, −1 −1 for points outside the grid; and
            (N,) bool, which points are in it (NaN is not).

        Raises:
            GeometryError: `points` has another shape.
        """
        positions = as_numbers("points", points, "points of shape (N, 2) or (N, 3)")
        if positions.ndim != 2 or positions.shape[1] not in (2, 3):
            raise GeometryError(f"points: expected shape (N, 2) or (N, 3), found {positions.shape}")
        cells = []
        is_inside = np.ones(len(positions), dtype=bool)
        axes = zip(positions.T, (self.x, self.y), self._counts, strict=False)
        for values, (low, high, size), count in axes:
            within = (values >= low) & (values < high)
            offset = np.where(within, values, low) - low
            cell = np.floor(offset / size).astype(np.int64)
            cells.append(np.minimum(cell, count - 1))
            is_inside &= within
        along_x, along_y = cells
        devkit_shape = self._counts[::-1]
        index = np.stack(
            cells_in(along_y, along_x, devkit_shape, "devkit", self.orientation), axis=1
        )
        index[~is_inside] = -1
        return index, is_inside

    def centers(self) -> FloatArray:
        """Return the cells' centres in this orientation, (rows, columns, 2) x forward, y left."""
        x, y = (
            low + (np.arange(count) + 0.5) * size
            for (low, _, size), count in zip((self.x, self.y), self._counts, strict=True)
        )
        return self._laid_out(np.stack(np.meshgrid(x, y), axis=-1))

    def reorient(self, raster: AnyArray, orientation: Orientation) -> AnyArray:
        """Return a raster (…, rows, columns) of this grid as a view in another orientation.

        Only cells change places. The values of offset and flow channels point along rows and
        columns: the caller has to negate or swap them.

        Raises:
            GeometryError: the raster has another shape than the grid.
            ChoiceError: there is no such orientation.
        """
        target = self.with_orientation(orientation)
        array = as_numbers("raster", raster, dtype=None)
        if array.shape[-2:] != self.shape:
            raise GeometryError(
                f"raster: expected shape (…, {self.shape[0]}, {self.shape[1]}), found {array.shape}"
            )
        return _turned(_turned(array, self.orientation), target.orientation)

    def _laid_out(self, devkit: FloatArray) -> FloatArray:
        """Return an array (rows, columns, …) of the devkit's orientation in this one."""
        if self.orientation == "fiery":
            return devkit.swapaxes(0, 1)
        return devkit if self.orientation == "devkit" else devkit[::-1]


def _turned(raster: AnyArray, orientation: Orientation) -> AnyArray:
    """Return a raster (…, rows, columns) of the devkit's orientation in another one, or back.

    Each conversion is its own inverse.
    """
    if orientation == "fiery":
        return raster.swapaxes(-1, -2)
    return raster if orientation == "devkit" else raster[..., ::-1, :]


def cells_in(
    row: AnyArray,
    column: AnyArray,
    shape: tuple[int, int],
    source: Orientation,
    target: Orientation,
) -> tuple[AnyArray, AnyArray]:
    """Return row and column in another orientation, for cells of one orientation.

    Args:
        row: Rows of the cells.
        column: Columns of the cells.
        shape: Rows and columns of an array in the orientation `source`.
        source: Orientation of the arguments.
        target: Orientation of the result.
    """
    rows, columns = shape
    if source == "fiery":
        row, column, rows, columns = column, row, columns, rows
    if (source == "released") != (target == "released"):
        row = rows - 1 - row
    return (column, row) if target == "fiery" else (row, column)


@functools.lru_cache(maxsize=256)
def _with_orientation(grid: BevGrid, orientation: Orientation) -> BevGrid:
    """Return the grid in another orientation, cached: labels need the same few for each sample."""
    return replace(grid, orientation=orientation)


def _axis(name: str, axis: Axis) -> Axis:
    """Return start, end and cell size as floats; raises ConfigError."""
    try:
        low, high, size = (float(number) for number in axis)
    except (TypeError, ValueError, OverflowError) as error:
        raise ConfigError(
            f"{name}: expected start, end and cell size in metres, found {axis!r}"
        ) from error
    if not (low < high and 0 < size < math.inf and math.isfinite((high - low) / size)):
        raise ConfigError(
            f"{name}: expected start < end and a cell size above 0 in metres, found {axis!r}"
        )
    return low, high, size


def _cell_count(name: str, axis: Axis) -> int:
    """Return the number of cells along an axis; raises ConfigError if it is not a whole number."""
    low, high, size = axis
    cells = (high - low) / size
    count = round(cells)
    if count > 0 and abs(cells - count) <= _CELL_COUNT_TOLERANCE:
        return count
    suggestions = []
    for number in (math.floor(cells), math.floor(cells) + 1):
        if number > 0:
            suggestions.append(f"({low:g}, {low + number * size:g}, {size:g})")
    nearest = "the nearest that are" if len(suggestions) > 1 else "the nearest that is"
    raise ConfigError(
        f"{name}: {low:g} to {high:g} m is not a whole number of cells of {size:g} m "
        f"({cells:.6g}); {nearest}: {' and '.join(suggestions)}"
    )


def to_orientation(
    array: AnyArray,
    *,
    vectors: bool,
    source: Orientation,
    target: Orientation,
    ignore: float | None = None,
) -> AnyArray:
    """Return maps (…, H, W) of the orientation `source` in the orientation `target`.

    The result is a view if no value changes.

    Args:
        array: Maps (…, H, W), or vectors (…, 2, H, W), down the rows and along the columns.
        vectors: Whether the maps are vectors, which turn too, unless both components are `ignore`.
        source: Orientation of the maps.
        target: Orientation of the result.
        ignore: Value of both components of vectors that stay as they are; None for none.

    Raises:
        GeometryError: vectors of another shape.
        ChoiceError: no such orientation.
    """
    source, target = (choice("orientation", name, ORIENTATIONS) for name in (source, target))
    if source == target:
        return array
    devkit = _turned(array, source)
    if not vectors:
        return _turned(devkit, target)
    if array.ndim < 3 or array.shape[-3] != 2:
        raise GeometryError(f"vectors: expected shape (…, 2, H, W), found {array.shape}")
    down = devkit[..., 0, :, :]
    along = devkit[..., 1, :, :]
    result = np.stack(vectors_in(down, along, source, target), axis=-3)
    if ignore is not None:
        np.copyto(result, ignore, where=((down == ignore) & (along == ignore))[..., None, :, :])
    return _turned(result, target)


def vectors_in(
    down: AnyArray, along: AnyArray, source: Orientation, target: Orientation
) -> tuple[AnyArray, AnyArray]:
    """Return components down the rows and along the columns of one orientation in another one."""
    if source == "fiery":
        down, along = along, down
    if (source == "released") != (target == "released"):
        down = 0 - down  # and not −0.0 where there was 0
    return (along, down) if target == "fiery" else (down, along)


def axes_of(grid: BevGrid) -> tuple[Axis, Axis]:
    """Return start, end and cell size of rows and of columns as the orientation counts them.

    The released rows run along a left-handed y: its start and end are the negated end and start of
    the grid's.
    """
    low, high, size = grid.y
    if grid.orientation == "fiery":
        return grid.x, grid.y
    return (grid.y if grid.orientation == "devkit" else (-high, -low, size)), grid.x
