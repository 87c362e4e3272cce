"""The masks' contours, hulls and rectangles, against OpenCV 4.7.0's; whatever OpenCV is installed,
which none asks.
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
scraps) and what
OpenCV 4.7.0 said of each: findContours(…, RETR_TREE, CHAIN_APPROX_SIMPLE)[0][0], its convexHull and
    its minAreaRect."""
SIDE = 24
EIGHT_NEIGHBOURS = np.ones((3, 3))


@pytest.fixture(scope="module")
def oracle() -> dict[str, np.ndarray]:
    with np.load(ORACLE) as archive:
        return dict(archive)


@pytest.fixture(scope="module")
def masks(oracle) -> np.ndarray:
    return np.unpackbits(oracle["masks"], axis=1)[:, : SIDE * SIDE].reshape(-1, SIDE, SIDE)


def split(points: np.ndarray, lengths: np.ndarray) -> list[list[tuple[int, int]]]:
    return [list(map(tuple, part.tolist())) for part in np.split(points, np.cumsum(lengths)[:-1])]


def test_contours_and_hulls_are_opencvs(oracle, masks) -> None:
    contours = [first_contour(*np.nonzero(mask)) for mask in masks]
    assert contours == split(oracle["contour"], oracle["contour_length"])
    assert [convex_hull(contour) for contour in contours] == split(
        oracle["hull"], oracle["hull_length"]
    )


def test_rectangles_are_opencvs_to_the_last_bit(oracle) -> None:
    size, angle = min_area_rects(split(oracle["hull"], oracle["hull_length"]))
    assert_array_equal(size, oracle["size"])
    assert_array_equal(angle, oracle["angle"])
    assert len(angle) == 2400


def test_masks_said_to_be_one_part_are(masks) -> None:
    instance, rows, columns = np.nonzero(masks)
    said = are_one_part(rows, columns, instance, len(masks))
    parts = np.array([label(mask, EIGHT_NEIGHBOURS)[1] for mask in masks])
    assert (parts[said] == 1).all()
    assert said.sum() > (parts == 1).sum() / 2
    for mask in masks[said][::20]:
        assert first_contour(*np.nonzero(mask), one_part=True) == first_contour(*np.nonzero(mask))


def test_the_part_that_comes_last_outside_of_all_holes_counts() -> None:
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
    size, angle = min_area_rects([])
    assert (size.shape, angle.shape, are_one_part(*[np.zeros(0, dtype=int)] * 3, 0).shape) == (
        (0, 2),
        (0,),
        (0,),
    )
