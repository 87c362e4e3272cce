"""`BevGrid`: a bird's-eye-view raster in one of three orientations, and their conversions.

Each conversion goes through the devkit's orientation. `released` is the devkit's array with its
rows reversed, so the row components of vectors change sign. `fiery` is the devkit's array
transposed, so the two components of vectors swap places.
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
# Largest difference, in cells, of a range from a whole number of cells: decimal cell sizes are not
# exact in binary.
_CELL_COUNT_TOLERANCE = 1e-6


@dataclass(frozen=True, slots=True)
class BevGrid:
    """A rectangular area of the ground, divided into cells; equal grids have equal hashes.

    Ranges are always in metres, right-handed: x forward, y **left**. The orientation only defines
    the order of the cells in an array (200 × 200 for the default ranges):

    - `"devkit"`: row = y index, column = x index, both ascending: row 0 is the far right (y = −50),
      column 0 the far rear (x = −50).
    - `"released"`: rows are left-handed, as in the released labels, column = x index: row 0 is the
      far **left** (y = 50). This is the devkit's array with its rows reversed: `released[..., ::-1,
      :]` is the devkit's array.
    - `"fiery"`: row = x index, column = y index, both ascending: row 0 is the far rear, column 0
      the far right. This is the devkit's array transposed.

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
        """Check the ranges and the orientation.

        Raises:
            ConfigError: If a range is empty or not a whole number of cells.
            ChoiceError: If the orientation is unknown.
        """
        settle_choices(self, {"orientation": ORIENTATIONS})
        for name in ("x", "y"):
            axis = _checked_axis(name, getattr(self, name))
            object.__setattr__(self, name, axis)
        counts = _cell_count("x", self.x), _cell_count("y", self.y)
        object.__setattr__(self, "_counts", counts)

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of an array: (y cells, x cells); for `"fiery"` (x cells, y cells)."""
        x_count, y_count = self._counts
        if self.orientation == "fiery":
            return x_count, y_count
        return y_count, x_count

    @property
    def cells(self) -> int:
        """Number of cells."""
        return math.prod(self._counts)

    @property
    def text(self) -> str:
        """Rows, columns and cell size in words, such as `200 × 200 cells of 0.5 m`."""
        rows, columns = self.shape
        _, _, x_size = self.x
        _, _, y_size = self.y
        sizes = dict.fromkeys([f"{x_size:g}", f"{y_size:g}"])
        return f"{rows} × {columns} cells of {' × '.join(sizes)} m"

    def with_orientation(self, orientation: Orientation) -> BevGrid:
        """Return the same area in another orientation; raise ChoiceError if it is unknown."""
        if orientation in ORIENTATIONS:
            return _with_orientation(self, orientation)
        return replace(self, orientation=orientation)  # the new grid checks it

    def index_of(self, points: ArrayLike) -> tuple[IntArray, BoolArray]:
        """Return the cells that contain the points.

        In every orientation, a cell includes its lower edges in x and y. This rule is for points
        only: label rasters round the corners of polygons differently (docs/released_code.md, Motion
        labels).

        Args:
            points: (N, 2) or (N, 3) x forward, y left, metres.

        Returns:
            (N, 2) int64 row and column in this orientation, both −1 for points outside the grid;
                and (N,) bool, whether each point is in the grid (False for NaN).

        Raises:
            GeometryError: If `points` has another shape.
        """
        positions = as_numbers("points", points, "points of shape (N, 2) or (N, 3)")
        if positions.ndim != 2 or positions.shape[1] not in (2, 3):
            raise GeometryError(f"points: expected shape (N, 2) or (N, 3), found {positions.shape}")
        cells = []
        is_inside = np.ones(len(positions), dtype=bool)
        axes = zip(positions.T, (self.x, self.y), self._counts, strict=False)
        for values, (start, end, size), count in axes:
            is_in_range = (values >= start) & (values < end)
            offset = np.where(is_in_range, values, start) - start
            cell = np.floor(offset / size).astype(np.int64)
            cells.append(np.minimum(cell, count - 1))
            is_inside &= is_in_range
        column, row = cells
        devkit_shape = self._counts[::-1]
        row_and_column = cells_in(row, column, devkit_shape, "devkit", self.orientation)
        index = np.stack(row_and_column, axis=1)
        index[~is_inside] = -1
        return index, is_inside

    def centers(self) -> FloatArray:
        """Return the cells' centres in this orientation, (rows, columns, 2) x forward, y left."""
        coordinates = []
        for (start, _, size), count in zip((self.x, self.y), self._counts, strict=True):
            coordinates.append(start + (np.arange(count) + 0.5) * size)
        centers = np.stack(np.meshgrid(*coordinates), axis=-1)
        if self.orientation == "fiery":
            return centers.swapaxes(0, 1)
        return centers if self.orientation == "devkit" else centers[::-1]

    def reorient(self, raster: AnyArray, orientation: Orientation) -> AnyArray:
        """Return a view of this grid's raster (…, rows, columns) in another orientation.

        Only the order of cells changes. Offsets and flows are vectors along rows and columns: the
        caller has to negate or swap their components (see `to_orientation`).

        Raises:
            GeometryError: If the raster's shape is not the grid's.
            ChoiceError: If the orientation is unknown.
        """
        target = self.with_orientation(orientation)
        array = as_numbers("raster", raster, dtype=None)
        if array.shape[-2:] != self.shape:
            raise GeometryError(
                f"raster: expected shape (…, {self.shape[0]}, {self.shape[1]}), found {array.shape}"
            )
        devkit_raster = _reorient(array, self.orientation)
        return _reorient(devkit_raster, target.orientation)


def _reorient(raster: AnyArray, orientation: Orientation) -> AnyArray:
    """Convert a raster (…, rows, columns) from the devkit's orientation to another one, or back.

    Each conversion is its own inverse.
    """
    if orientation == "fiery":
        return raster.swapaxes(-1, -2)
    if orientation == "devkit":
        return raster
    return raster[..., ::-1, :]


def cells_in(
    row: AnyArray,
    column: AnyArray,
    shape: tuple[int, int],
    source: Orientation,
    target: Orientation,
) -> tuple[AnyArray, AnyArray]:
    """Convert the rows and columns of cells to another orientation.

    Args:
        row: Rows of the cells.
        column: Columns of the cells.
        shape: Numbers of rows and columns of an array in the orientation `source`.
        source: Orientation of the arguments.
        target: Orientation of the result.
    """
    row_count, column_count = shape
    if source == "fiery":
        row, column = column, row
        row_count = column_count
    if (source == "released") != (target == "released"):
        row = row_count - 1 - row
    return (column, row) if target == "fiery" else (row, column)


@functools.lru_cache(maxsize=256)
def _with_orientation(grid: BevGrid, orientation: Orientation) -> BevGrid:
    """Return the grid in another orientation, cached because all samples use the same grids."""
    return replace(grid, orientation=orientation)


def _checked_axis(name: str, axis: Axis) -> Axis:
    """Return start, end and cell size as floats; raise ConfigError if they make no valid axis."""
    try:
        start, end, size = (float(number) for number in axis)
    except (TypeError, ValueError, OverflowError) as error:
        raise ConfigError(
            f"{name}: expected start, end and cell size in metres, found {axis!r}"
        ) from error
    if not (start < end and 0 < size < math.inf and math.isfinite((end - start) / size)):
        raise ConfigError(
            f"{name}: expected start < end and a cell size above 0 in metres, found {axis!r}"
        )
    return start, end, size


def _cell_count(name: str, axis: Axis) -> int:
    """Return the number of cells along an axis; raise ConfigError if it is not a whole number."""
    start, end, size = axis
    exact_count = (end - start) / size
    count = round(exact_count)
    if count > 0 and abs(exact_count - count) <= _CELL_COUNT_TOLERANCE:
        return count
    suggestions = []
    lower_count = math.floor(exact_count)
    for suggested_count in (lower_count, lower_count + 1):
        if suggested_count > 0:
            suggestions.append(f"({start:g}, {start + suggested_count * size:g}, {size:g})")
    nearest = "the nearest that is"
    if len(suggestions) > 1:
        nearest = "the nearest that are"
    raise ConfigError(
        f"{name}: {start:g} to {end:g} m is not a whole number of cells of {size:g} m "
        f"({exact_count:.6g}); {nearest}: {' and '.join(suggestions)}"
    )


def to_orientation(
    array: AnyArray,
    *,
    vectors: bool,
    source: Orientation,
    target: Orientation,
    ignore: float | None = None,
) -> AnyArray:
    """Convert maps (…, H, W) from the orientation `source` to the orientation `target`.

    The result is a view if no value changes.

    Args:
        array: Maps (…, H, W), or vectors (…, 2, H, W) with components down the rows and along the
            columns.
        vectors: Whether the maps hold vectors, whose components are converted as well.
        source: Orientation of the maps.
        target: Orientation of the result.
        ignore: Vectors with this value in both components are left unchanged; None converts all
            vectors.

    Raises:
        GeometryError: If the array has the wrong shape.
        ChoiceError: If the orientation is unknown.
    """
    source = choice("orientation", source, ORIENTATIONS)
    target = choice("orientation", target, ORIENTATIONS)
    if source == target:
        return array
    devkit_array = _reorient(array, source)
    if not vectors:
        return _reorient(devkit_array, target)
    if array.ndim < 3 or array.shape[-3] != 2:
        raise GeometryError(f"vectors: expected shape (…, 2, H, W), found {array.shape}")
    down = devkit_array[..., 0, :, :]
    along = devkit_array[..., 1, :, :]
    turned_vectors = np.stack(vectors_in(down, along, source, target), axis=-3)
    if ignore is not None:
        is_ignored = (down == ignore) & (along == ignore)
        np.copyto(turned_vectors, ignore, where=is_ignored[..., None, :, :])
    return _reorient(turned_vectors, target)


def vectors_in(
    down: AnyArray, along: AnyArray, source: Orientation, target: Orientation
) -> tuple[AnyArray, AnyArray]:
    """Convert the components of vectors to another orientation.

    Args:
        down: Components down the rows.
        along: Components along the columns.
        source: Orientation of the arguments.
        target: Orientation of the result.
    """
    if source == "fiery":
        down, along = along, down
    if (source == "released") != (target == "released"):
        down = 0 - down  # 0 must not become −0.0
    if target == "fiery":
        return along, down
    return down, along


def axes_of(grid: BevGrid) -> tuple[Axis, Axis]:
    """Return (start, end, cell size) of the row axis and of the column axis of an array.

    In the orientation `released`, rows run along a left-handed y, so start and end are the negated
    end and start of the grid's y.
    """
    if grid.orientation == "fiery":
        return grid.x, grid.y
    if grid.orientation == "devkit":
        return grid.y, grid.x
    start, end, size = grid.y
    flipped_y = (-end, -start, size)
    return flipped_y, grid.x
