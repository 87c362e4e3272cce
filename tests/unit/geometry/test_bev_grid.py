import pickle
from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import ChoiceError, ConfigError, GeometryError
from deepaccident_devkit.geometry import BevGrid


def test_the_default_is_the_released_labels_grid() -> None:
    grid = BevGrid()
    assert grid == BevGrid(x=(-50, 50, 0.5), y=(-50, 50, 0.5), orientation="devkit")
    assert (grid.shape, grid.cells) == ((200, 200), 40_000)
    assert repr(grid) == "BevGrid(x=(-50.0, 50.0, 0.5), y=(-50.0, 50.0, 0.5), orientation='devkit')"


def test_rows_and_columns_of_each_orientation() -> None:
    """A point ahead and to the left has these cells in a grid of 10 × 4 m that is not centred."""
    point = [[6.5, 1.5]]
    for orientation, shape, cell, first_center in [
        ("devkit", (4, 10), [3, 6], [0.5, -1.5]),
        ("released", (4, 10), [0, 6], [0.5, 1.5]),
        ("fiery", (10, 4), [6, 3], [0.5, -1.5]),
    ]:
        grid = BevGrid((0, 10, 1), (-2, 2, 1), orientation)
        assert grid.shape == shape
        assert_array_equal(grid.index_of(point)[0], [cell])
        assert_allclose(grid.centers()[0, 0], first_center)
        assert_allclose(grid.centers()[tuple(cell)], point[0])


def test_the_devkits_raster_is_the_released_upside_down_and_fierys_transposed() -> None:
    devkit = BevGrid((0, 3, 1), (0, 2, 1))
    released = devkit.with_orientation("released")
    fiery = devkit.with_orientation("fiery")
    raster = np.arange(12).reshape(2, 2, 3)
    released_raster = raster[..., ::-1, :]
    fiery_raster = raster.swapaxes(1, 2)

    assert_array_equal(devkit.reorient(raster, "released"), released_raster)
    assert_array_equal(devkit.reorient(raster, "fiery"), fiery_raster)
    assert_array_equal(released.reorient(released_raster, "devkit"), raster)
    assert_array_equal(fiery.reorient(fiery_raster, "released"), released_raster)
    assert_raises(
        (
            lambda: fiery.reorient(raster, "devkit"),
            GeometryError,
            r"raster: expected shape \(…, 3, 2\), found \(2, 2, 3\)",
        ),
    )


def test_a_cell_owns_its_lower_edges_and_a_point_beside_the_grid_has_no_cell() -> None:
    grid = BevGrid((0, 1, 0.1), (-1, 1, 1))
    points = [
        [0, -1, 5],
        [0.1, 0, 5],
        [1, 0, 5],
        [np.nextafter(1, 0), 0.999, 5],
        [0.5, 1, 5],
        [np.nan, 0, 5],
    ]
    index, inside = grid.index_of(points)

    assert_array_equal(index, [[0, 0], [1, 1], [-1, -1], [1, 9], [-1, -1], [-1, -1]])
    assert_array_equal(inside, [True, True, False, True, False, False])
    last = np.nextafter(50, 0)  # 50 + this is 100 in floating point
    assert_array_equal(BevGrid().index_of([[last, last]])[0], [[199, 199]])
    assert_array_equal(BevGrid(orientation="released").index_of([[last, last]])[0], [[0, 199]])
    assert grid.index_of(np.zeros((0, 2)))[0].shape == (0, 2)
    assert_raises(
        *[
            (
                partial(grid.index_of, points),
                GeometryError,
                r"points: expected shape \(N, 2\) or \(N, 3\)",
            )
            for points in ([1, 2], np.zeros((2, 4)), 3)
        ],
    )


def test_equal_grids_have_one_hash() -> None:
    grids = {
        BevGrid(x=(-50, 50, 1)),
        BevGrid(x=(-50.0, 50.0, 1.0)),
        BevGrid(x=[-50, 50, 1]),
        BevGrid(),
    }  # type: ignore[arg-type]
    assert len(grids) == 2
    fiery = BevGrid(orientation="fiery")
    assert BevGrid() != fiery
    assert pickle.loads(pickle.dumps(fiery)) == fiery


def test_decimal_resolutions_are_whole() -> None:
    grid = BevGrid((-51.2, 51.2, 0.2), (-54, 54, 0.075))
    assert grid.shape == (1440, 512)


@pytest.mark.parametrize(
    ("x", "message"),
    [
        (
            (-50, 50, 0.3),
            (
                r"x: -50 to 50 m is not .*\(333.333\); the nearest that are: \(-50, "
                r"49.9, 0.3\) and \(-50, 50.2, 0.3"
            ),
        ),
        ((0, 1, 3), r"x: 0 to 1 m .*; the nearest that is: \(0, 3, 3\)"),
        ((0, 1e-9, 1), r"x: 0 to 1e-09 m .*; the nearest that is: \(0, 1, 1\)"),
        ((50, -50, 0.5), r"x: expected start < end and a cell size above 0"),
        ((-50, 50, 0), r"x: expected start < end and a cell size above 0"),
        ((-50, 50, -0.5), r"x: expected start < end and a cell size above 0"),
        ((-50, np.nan, 1), r"x: expected start < end and a cell size above 0"),
        ((-50, np.inf, 1), r"x: expected start < end and a cell size above 0"),
        ((-1e308, 1e308, 1), r"x: expected start < end and a cell size above 0"),
        ((0, 1, 1e-320), r"x: expected start < end and a cell size above 0"),
        ((-50, 50), r"x: expected start, end and cell size in metres, found \(-50, 50\)"),
        (7, r"x: expected start, end and cell size in metres, found 7"),
        ((0, 10**400, 1), r"x: expected start, end and cell size in metres, found \(0, 10+, 1\)"),
    ],
)
def test_ranges_that_do_not_divide_into_cells_are_refused(x: object, message: str) -> None:
    assert_raises((lambda: BevGrid(x=x), ConfigError, message))  # type: ignore[arg-type]


def test_unknown_orientations_and_values_that_are_no_points_are_refused() -> None:
    assert_raises(
        (
            lambda: BevGrid(orientation="up"),
            ChoiceError,
            ("one of devkit, released, fiery", "'up'"),
        ),  # type: ignore[arg-type]
        *[
            (
                partial(BevGrid().index_of, points),
                GeometryError,
                ("points: expected points of shape (N, 2) or (N, 3)",),
            )
            for points in ("a", None, [["1", "2"]], [[1, 2], [1, 2, 3]])
        ],
    )
