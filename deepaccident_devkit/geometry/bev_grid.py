"""`BevGrid`: the cells of a raster seen from above, in three orientations, and rasters turned from one to another.

Each turn goes through the devkit's orientation. `released` has its rows in reverse order, so vectors down the rows
change their sign. `fiery` is its transpose, so rows and columns, and the two channels, change places.
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
# The largest distance of a range from a whole number of cells, because decimal cell sizes are not exact in binary.
_WHOLE = 1e-6


@dataclass(frozen=True, slots=True)
class BevGrid:
    """Square or rectangular cells over a part of the ground; equal grids compare equal and have equal hashes.

    Ranges are always right-handed metres, x forward and y **left**. The orientation only says how the cells lie in an
    array (for the default ranges, 200 × 200):

    - `"devkit"`: row = y index, column = x index, both rising: row 0 is the far right (y = −50), column 0 the far
      rear (x = −50).
    - `"released"`: the released labels' left-handed rows, column = x index: row 0 is the far **left** (y = 50).
      Exactly the devkit's rows in reverse order: `released[..., ::-1, :]` is the devkit's array.
    - `"fiery"`: row = x index, column = y index, both rising: row 0 is the far rear, column 0 the far right. Exactly
      the devkit's array, transposed.

    Attributes:
        x: start, end and cell size along x, metres.
        y: start, end and cell size along y, metres.
        orientation: how the cells lie in an array.
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
        """Rows and columns of an array in this orientation: (y cells, x cells), for `"fiery"` (x cells, y cells)."""
        along_x, along_y = self._counts
        return (along_x, along_y) if self.orientation == "fiery" else (along_y, along_x)

    @property
    def cells(self) -> int:
        """Number of cells."""
        return math.prod(self._counts)

    @property
    def text(self) -> str:
        """`200 × 200 cells of 0.5 m`: rows, columns and the size of a cell along x and y."""
        sizes = dict.fromkeys(f"{axis[2]:g}" for axis in (self.x, self.y))
        return f"{' × '.join(map(str, self.shape))} cells of {' × '.join(sizes)} m"

    def with_orientation(self, orientation: Orientation) -> BevGrid:
        """The same cells with another order in an array. Raises ChoiceError."""
        if orientation in ORIENTATIONS:
            return _with_orientation(self, orientation)
        return replace(self, orientation=orientation)  # the new grid checks it

    def index_of(self, points: ArrayLike) -> tuple[IntArray, BoolArray]:
        """The cells in which points (N, 2) or (N, 3) lie; x forward, y left, metres.

        In every orientation, a cell includes its lower edges in x and y. (Label rasters round polygon corners by
        another rule, docs/released_code.md, Motion labels; this one is for points.)

        Returns:
            (N, 2) int64 row and column in this orientation, −1 −1 for points outside the grid; and (N,) bool, which
            points are in it (NaN is not).

        Raises:
            GeometryError: `points` has another shape.
        """
        given = as_numbers("points", points, "points of shape (N, 2) or (N, 3)")
        if given.ndim != 2 or given.shape[1] not in (2, 3):
            raise GeometryError(f"points: expected shape (N, 2) or (N, 3), found {given.shape}")
        steps, inside = [], np.ones(len(given), dtype=bool)
        for values, (low, high, size), count in zip(
            given.T, (self.x, self.y), self._counts, strict=False
        ):
            within = (values >= low) & (values < high)
            cell = np.floor((np.where(within, values, low) - low) / size).astype(np.int64)
            steps.append(np.minimum(cell, count - 1))
            inside &= within
        along_x, along_y = steps
        index = np.stack(
            cells_in(along_y, along_x, self._counts[::-1], "devkit", self.orientation), axis=1
        )
        index[~inside] = -1
        return index, inside

    def centers(self) -> FloatArray:
        """The cells' centres, (rows, columns, 2) x forward, y left, metres, in this orientation."""
        across, along = (
            low + (np.arange(count) + 0.5) * size
            for (low, _, size), count in zip((self.x, self.y), self._counts, strict=True)
        )
        return self._laid_out(np.stack(np.meshgrid(across, along), axis=-1))

    def reorient(self, raster: AnyArray, orientation: Orientation) -> AnyArray:
        """A raster (…, rows, columns) of this grid as a view in another orientation.

        Only cells change places. The values of offset and flow channels point along rows and columns: the caller has
        to negate or swap them.

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
        """An array (rows, columns, …) in the devkit's orientation, changed to this one."""
        if self.orientation == "fiery":
            return devkit.swapaxes(0, 1)
        return devkit if self.orientation == "devkit" else devkit[::-1]


def _turned(raster: AnyArray, orientation: Orientation) -> AnyArray:
    """A raster (…, rows, columns) from the devkit's orientation to another, or back: each is its own inverse."""
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
    """Row and column in another orientation, of cells of one orientation with `shape` (rows, columns)."""
    rows, columns = shape
    if source == "fiery":
        row, column, rows, columns = column, row, columns, rows
    if (source == "released") != (target == "released"):
        row = rows - 1 - row
    return (column, row) if target == "fiery" else (row, column)


@functools.lru_cache(maxsize=256)
def _with_orientation(grid: BevGrid, orientation: Orientation) -> BevGrid:
    """The grid in another orientation, cached, because labels need the same few many times for each sample."""
    return replace(grid, orientation=orientation)


def _axis(name: str, given: Axis) -> Axis:
    try:
        low, high, size = (float(number) for number in given)
    except (TypeError, ValueError, OverflowError) as error:
        raise ConfigError(
            f"{name}: expected start, end and cell size in metres, found {given!r}"
        ) from error
    if not (low < high and 0 < size < math.inf and math.isfinite((high - low) / size)):
        raise ConfigError(
            f"{name}: expected start < end and a cell size above 0 in metres, found {given!r}"
        )
    return low, high, size


def _cell_count(name: str, axis: Axis) -> int:
    low, high, size = axis
    cells = (high - low) / size
    count = round(cells)
    if count > 0 and abs(cells - count) <= _WHOLE:
        return count
    shorter, longer = math.floor(cells), math.floor(cells) + 1
    ends = [
        f"({low:g}, {low + number * size:g}, {size:g})"
        for number in (shorter, longer)
        if number > 0
    ]
    raise ConfigError(
        f"{name}: {low:g} to {high:g} m is not a whole number of cells of {size:g} m ({cells:.6g}); "
        f"{'the nearest that are' if len(ends) > 1 else 'the nearest that is'}: {' and '.join(ends)}"
    )


def to_orientation(
    array: AnyArray,
    *,
    vectors: bool,
    source: Orientation,
    target: Orientation,
    ignore: float | None = None,
) -> AnyArray:
    """Maps (…, H, W) of the orientation `source` in the orientation `target`; a view if no value changes.

    `vectors` are (…, 2, H, W), down the rows and along the columns, and turn too, where not both are `ignore`. Raises
    GeometryError of another shape, ChoiceError.
    """
    source, target = (choice("orientation", name, ORIENTATIONS) for name in (source, target))
    if source == target:
        return array
    devkit = _turned(array, source)
    if not vectors:
        return _turned(devkit, target)
    if array.ndim < 3 or array.shape[-3] != 2:
        raise GeometryError(f"vectors: expected shape (…, 2, H, W), found {array.shape}")
    down, along = devkit[..., 0, :, :], devkit[..., 1, :, :]
    result = np.stack(vectors_in(down, along, source, target), axis=-3)
    if ignore is not None:
        np.copyto(result, ignore, where=((down == ignore) & (along == ignore))[..., None, :, :])
    return _turned(result, target)


def vectors_in(
    down: AnyArray, along: AnyArray, source: Orientation, target: Orientation
) -> tuple[AnyArray, AnyArray]:
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
