from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.motion.reference_arithmetic.polygon_fill import filled_cells

ORACLE = Path(__file__).parents[3] / "data" / "fill_poly_opencv_4_7.npz"
"""Random quadrangles, each drawn by OpenCV 4.7.0's fillPoly: cars and trucks, tiny, crossing,
degenerate and far-off ones, and some at the border; in images of 29 × 47 and 64 × 40 cells."""


@pytest.mark.parametrize("shape", [(29, 47), (64, 40)])
def test_every_cell_is_opencv_4_7s(shape) -> None:
    rows, columns = shape
    with np.load(ORACLE) as oracle:
        quads = oracle[f"quads_{rows}x{columns}"]
        packed_masks = oracle[f"masks_{rows}x{columns}"]
    expected = np.unpackbits(packed_masks, axis=1)[:, : rows * columns]

    cells, _ = filled_cells(quads, shape, np.arange(len(quads)), len(quads))

    drawn = np.zeros((len(quads), rows * columns), dtype=np.uint8)
    drawn.reshape(-1)[cells] = 1
    assert_array_equal(drawn, expected)
    assert len(quads) > 500
    assert expected.any(axis=1).mean() > 0.5


def draw_polygons(polygons, shape) -> np.ndarray:
    """Draw the polygons into one image: numbered from 1, and 0 where there is none."""
    raster = np.zeros(shape, dtype=np.int64)
    cells, owner = filled_cells(polygons, shape)
    raster.reshape(-1)[cells] = owner + 1
    return raster


def test_a_rectangle_has_its_border_and_a_point_is_a_cell() -> None:
    rectangle = [[1, 1], [4, 1], [4, 2], [1, 2]]
    point = [[5, 3]] * 4
    expected = np.zeros((4, 6))
    expected[1:3, 1:5] = 1
    expected[3, 5] = 2

    assert_array_equal(draw_polygons([rectangle, point], (4, 6)), expected)


def test_later_polygons_lie_on_top_and_every_image_has_its_own() -> None:
    square = np.array([[0, 0], [2, 0], [2, 2], [0, 2]])

    cells, owner = filled_cells([square, square + 1, square], (4, 4), [0, 0, 1], 2)

    assert_array_equal(cells, np.unique(cells))
    images = np.full((2, 4, 4), -1)
    images.reshape(-1)[cells] = owner
    assert_array_equal(
        images[0],
        [
            [0, 0, 0, -1],
            [0, 1, 1, 1],
            [0, 1, 1, 1],
            [-1, 1, 1, 1],
        ],
    )
    assert_array_equal(
        images[1],
        [
            [2, 2, 2, -1],
            [2, 2, 2, -1],
            [2, 2, 2, -1],
            [-1, -1, -1, -1],
        ],
    )


def test_triangles_and_stars_go_through_the_whole_rule() -> None:
    triangle = [[0, 0], [4, 0], [0, 4]]
    assert_array_equal(draw_polygons([triangle], (5, 5)), np.tri(5, dtype=int)[::-1])

    # turns one way, but twice around: empty in the middle
    star = [[5, 0], [2, 9], [10, 3], [0, 3], [8, 9]]
    filled = draw_polygons([star], (10, 11))
    assert filled[5, 5] == 0
    assert filled[2, 5] == 1


def test_nothing_to_draw() -> None:
    for polygons in (
        np.zeros((0, 4, 2)),
        [[[-9, 0], [-7, 0], [-7, 9], [-9, 9]]],
        [[[0, 70], [5, 70], [5, 71], [0, 71]]],
    ):
        cells, owner = filled_cells(polygons, (8, 8))
        assert (cells.shape, owner.shape) == ((0,), (0,))


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (
            lambda: filled_cells(np.zeros((4, 2)), (8, 8)),
            r"polygons: expected shape \(N, N, 2\), found \(4, 2\)",
        ),
        (
            lambda: filled_cells(np.zeros((1, 2, 2)), (8, 8)),
            "polygons: expected at least 3 corners, found 2",
        ),
        (
            lambda: filled_cells(np.zeros((2, 4, 2)), (8, 8), [0, 2], 2),
            "image: expected numbers from 0 to 1, found 0 to 2",
        ),
        (
            lambda: filled_cells(np.full((1, 4, 2), 0.5), (8, 8)),
            "polygons: expected whole numbers of int64",
        ),
    ],
)
def test_what_is_no_polygon_is_refused(make: Callable[[], object], sentence: str) -> None:
    assert_raises(
        (make, GeometryError, sentence),
    )
