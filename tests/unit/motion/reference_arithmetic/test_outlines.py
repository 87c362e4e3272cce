"""Compare outlines with stored results of scikit-image, whatever version is installed, and check
the distances between them.
"""

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.ndimage import find_objects

from deepaccident_devkit.motion.reference_arithmetic.outlines import (
    NO_OUTLINE,
    TOLERANCE,
    first_outline,
    pair_gaps,
    simplified_outlines,
)

ORACLE = Path(__file__).parents[3] / "data" / "outlines_skimage_0_20.npz"
"""1,200 masks of 24 × 24 cells (boxes at all angles, whole or cut, noise, discs with holes, scraps;
some at the border), an id for each, and the results of scikit-image 0.20.0 with numpy 1.23.5:
outline = find_contours(mask * id, 0.1)[0], and kept, a mask of its points that
approximate_polygon(outline, 0.5) keeps."""
SIDE_CELLS = 24


@pytest.fixture(scope="module")
def oracle() -> dict[str, np.ndarray]:
    with np.load(ORACLE) as archive:
        return dict(archive)


@pytest.fixture(scope="module")
def expected(oracle) -> list[np.ndarray]:
    ends = np.cumsum(oracle["outline_length"])[:-1]
    return np.split(oracle["outline"], ends)


def find_outline(image: np.ndarray, instance: int) -> np.ndarray:
    window = find_objects(image)[instance - 1]
    return first_outline(image, instance, window)


def test_outlines_are_scikit_images_to_the_last_bit(oracle, expected) -> None:
    masks = np.unpackbits(oracle["masks"], axis=1).reshape(-1, SIDE_CELLS, SIDE_CELLS)
    instances = oracle["ids"].tolist()

    for mask, instance, expected_outline in zip(masks, instances, expected, strict=True):
        outline = find_outline(mask * np.int32(instance), instance)
        assert outline.shape == expected_outline.shape
        assert np.array_equal(outline, expected_outline)


def test_simplified_outlines_are_scikit_images_but_for_ties(oracle, expected) -> None:
    """A point exactly half a cell off stays or goes in scikit-image by the last bit of a sine; here
    it goes.
    """
    ends = np.cumsum(oracle["outline_length"])[:-1]
    masks_of_kept_points = np.split(oracle["kept"], ends)

    simplified = simplified_outlines(expected)

    equal = [
        np.array_equal(chain, points[mask])
        for chain, points, mask in zip(simplified, expected, masks_of_kept_points, strict=True)
    ]
    assert np.mean(equal) > 0.95
    for chain, points in zip(simplified, expected, strict=True):
        assert_array_equal(chain[[0, -1]], points[[0, -1]])
        assert largest_distance(points, chain) <= TOLERANCE + 1e-9


def largest_distance(points: np.ndarray, chain: np.ndarray) -> float:
    """Return the largest distance of a point from a chain of line segments."""
    start = chain[:-1]
    along = np.diff(chain, axis=0)
    squared_length = np.maximum((along**2).sum(axis=1), 1e-30)

    from_start = points[:, None] - start
    fraction = (from_start * along).sum(axis=-1) / squared_length
    fraction = np.clip(fraction, 0, 1)

    offset = from_start - fraction[..., None] * along
    distances = np.sqrt((offset**2).sum(axis=-1))
    return float(distances.min(axis=1).max())


def test_the_first_of_ties_is_kept_whatever_the_machine() -> None:
    """Two points are equally far off, except for the rounding of one of them."""
    outline = np.array([[0.0, 0.0], [1.0, 1.0], [1.0 + 1e-13, 3.0], [0.0, 4.0]])
    [simplified] = simplified_outlines([outline])
    assert_array_equal(simplified, outline)

    flat = np.array([[0.0, 0.0], [0.5 + 1e-12, 2.0], [0.0, 4.0]])
    [simplified] = simplified_outlines([flat])
    assert_array_equal(simplified, flat[[0, 2]])


def test_no_outlines_are_simplified() -> None:
    empty = np.zeros((0, 2))

    simplified = simplified_outlines([empty, np.eye(2), empty])

    assert simplified_outlines([]) == []
    assert [len(outline) for outline in simplified] == [0, 2, 0]


def test_an_outline_is_found_wherever_it_is() -> None:
    image = np.zeros((40, 40), dtype=np.int32)
    image[20:24, 10:19] = 3

    outline = find_outline(image, 3)

    margin = 29 / 30
    assert_allclose(outline.min(axis=0), [20 - margin, 10 - margin])
    assert_allclose(outline.max(axis=0), [23 + margin, 18 + margin])


def test_the_part_with_the_first_cell_counts() -> None:
    image = np.zeros((30, 30), dtype=np.int32)
    image[5:8, 20:24] = 1
    image[7:20, 3:9] = 1
    assert find_outline(image, 1)[:, 1].min() > 18


def test_an_instance_that_fills_the_image_has_no_outline() -> None:
    image = np.ones((5, 6), dtype=np.int32)
    assert len(find_outline(image, 1)) == 0


def measure_gaps(image: np.ndarray, *ids: int, **options) -> dict[tuple[int, ...], float]:
    pairs, gaps = pair_gaps(image, np.array(ids, dtype=np.int64), **options)
    return {tuple(pair): gap for pair, gap in zip(pairs.tolist(), gaps.tolist(), strict=True)}


@pytest.fixture
def boxes() -> np.ndarray:
    """Draw three boxes: seven empty columns between 1 and 2; 2 and 3 touch."""
    image = np.zeros((60, 60), dtype=np.int32)
    image[10:14, 5:13] = 1
    image[10:14, 20:28] = 2
    image[14:18, 20:28] = 3
    return image


def test_instances_are_nearer_than_they_are_drawn(boxes) -> None:
    """By 0.9 and 0.95 cells: each outline runs where the interpolated id is 0.1."""
    gaps = measure_gaps(boxes, 1, 2, 3)
    assert list(gaps) == [(1, 2), (1, 3), (2, 3)]
    assert gaps[1, 2] == pytest.approx(8 - 0.9 - 0.95)
    assert gaps[2, 3] == 0
    assert find_outline(boxes, 2)[:, 1].min() == 20 - 0.95


def test_pairs_that_cannot_be_near_are_left_out(boxes) -> None:
    all_gaps = measure_gaps(boxes, 1, 2, 3)
    for below in (0.001, 5.0, 6.1, 6.5):
        near = measure_gaps(boxes, 1, 2, 3, below=below)
        assert near == {pair: all_gaps[pair] for pair in near}
        assert {pair for pair, gap in all_gaps.items() if gap < below} <= set(near)
    assert list(measure_gaps(boxes, 1, 2, 3, below=0.001)) == [(2, 3)]


def test_instances_that_are_absent_or_too_small_are_far_away(boxes) -> None:
    boxes[0, 0] = 4

    gaps = measure_gaps(boxes, 1, 4, 5)

    assert gaps == {(1, 4): NO_OUTLINE, (1, 5): NO_OUTLINE, (4, 5): NO_OUTLINE}
    assert measure_gaps(boxes, 1, 4, 5, below=np.inf) != {}
    assert measure_gaps(boxes, 1, 5, below=5.0) == {}


def test_without_pairs_or_outlines_there_are_no_distances(boxes) -> None:
    assert measure_gaps(boxes) == {}
    assert measure_gaps(boxes, 2) == {}
    assert measure_gaps(np.zeros_like(boxes), 1, 2) == {(1, 2): NO_OUTLINE}


def test_ids_keep_their_order(boxes) -> None:
    pairs = list(measure_gaps(boxes, 3, 1, 2))
    assert pairs == [(3, 1), (3, 2), (1, 2)]
