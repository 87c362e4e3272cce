"""Check the masks' contours, hulls and rectangles against stored results of OpenCV 4.7.0, whatever
version is installed.
"""

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from scipy.ndimage import label

from deepaccident_devkit.motion.reference_arithmetic.contours import (
    are_one_part,
    convex_hull,
    first_contour,
    min_area_rects,
)

ORACLE = Path(__file__).parents[3] / "data" / "min_area_rect_opencv_4_7.npz"
"""2,400 masks of 24 × 24 cells (boxes at all angles, lines, blobs, noise, rings with dots in them,
scraps) and OpenCV 4.7.0's results for each mask:
findContours(…, RETR_TREE, CHAIN_APPROX_SIMPLE)[0][0], its convexHull and its minAreaRect."""
SIDE_CELLS = 24
EIGHT_NEIGHBOURS = np.ones((3, 3))


@pytest.fixture(scope="module")
def oracle() -> dict[str, np.ndarray]:
    with np.load(ORACLE) as archive:
        return dict(archive)


@pytest.fixture(scope="module")
def masks(oracle) -> np.ndarray:
    bits = np.unpackbits(oracle["masks"], axis=1)
    bits = bits[:, : SIDE_CELLS * SIDE_CELLS]
    return bits.reshape(-1, SIDE_CELLS, SIDE_CELLS)


def split_points(points: np.ndarray, lengths: np.ndarray) -> list[list[tuple[int, int]]]:
    ends = np.cumsum(lengths)[:-1]
    parts = np.split(points, ends)
    return [list(map(tuple, part.tolist())) for part in parts]


def test_contours_and_hulls_are_opencvs(oracle, masks) -> None:
    contours = [first_contour(*np.nonzero(mask)) for mask in masks]
    hulls = [convex_hull(contour) for contour in contours]

    assert contours == split_points(oracle["contour"], oracle["contour_length"])
    assert hulls == split_points(oracle["hull"], oracle["hull_length"])


def test_rectangles_are_opencvs_to_the_last_bit(oracle) -> None:
    hulls = split_points(oracle["hull"], oracle["hull_length"])

    size, angle = min_area_rects(hulls)

    assert_array_equal(size, oracle["size"])
    assert_array_equal(angle, oracle["angle"])
    assert len(angle) == 2400


def test_masks_reported_as_one_part_are_one_part(masks) -> None:
    instance, rows, columns = np.nonzero(masks)
    parts = np.array([label(mask, EIGHT_NEIGHBOURS)[1] for mask in masks])

    one_part = are_one_part(rows, columns, instance, len(masks))

    assert (parts[one_part] == 1).all()
    assert one_part.sum() > (parts == 1).sum() / 2
    for mask in masks[one_part][::20]:
        cells = np.nonzero(mask)
        assert first_contour(*cells, one_part=True) == first_contour(*cells)


def test_the_last_part_outside_all_holes_counts() -> None:
    mask = np.zeros((9, 12), dtype=bool)
    mask[1:6, 1:6] = True
    mask[2:5, 2:5] = False

    ring = [(1, 1), (1, 5), (5, 5), (5, 1)]
    assert first_contour(*np.nonzero(mask)) == ring

    mask[3, 3] = True
    assert first_contour(*np.nonzero(mask)) == ring

    mask[1, 8] = True
    assert first_contour(*np.nonzero(mask)) == [(8, 1)]


def test_no_hulls_no_rectangles() -> None:
    no_cells = np.zeros(0, dtype=int)

    size, angle = min_area_rects([])
    one_part = are_one_part(no_cells, no_cells, no_cells, 0)

    assert size.shape == (0, 2)
    assert angle.shape == (0,)
    assert one_part.shape == (0,)
