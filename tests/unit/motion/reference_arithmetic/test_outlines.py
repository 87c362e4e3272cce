"""Outlines against scikit-image's, and distances between them; whatever scikit-image is installed,
which none asks.
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
some at the border) with an id each, and what scikit-image 0.20.0 with numpy 1.23.5 said of each:
outline = find_contours(mask * id, 0.1)[0] and kept, which of its points
approximate_polygon(outline, 0.5) has."""
SIDE = 24


@pytest.fixture(scope="module")
def oracle() -> dict[str, np.ndarray]:
    with np.load(ORACLE) as archive:
        return dict(archive)


@pytest.fixture(scope="module")
def expected(oracle) -> list[np.ndarray]:
    return np.split(oracle["outline"], np.cumsum(oracle["outline_length"])[:-1])


def outline_of(image: np.ndarray, name: int) -> np.ndarray:
    return first_outline(image, name, find_objects(image)[name - 1])


def test_outlines_are_scikit_images_to_the_last_bit(oracle, expected) -> None:
    masks = np.unpackbits(oracle["masks"], axis=1).reshape(-1, SIDE, SIDE)
    differing = 0
    for mask, name, outline in zip(masks, oracle["ids"].tolist(), expected, strict=True):
        found = outline_of(mask * np.int32(name), name)
        differing += found.shape != outline.shape or not np.array_equal(found, outline)
    assert differing == 0


def test_simplified_outlines_are_scikit_images_but_for_ties(oracle, expected) -> None:
    """A point exactly half a cell off stays or goes in scikit-image by the last bit of a sine, here
    it goes.
    """
    kept = np.split(oracle["kept"], np.cumsum(oracle["outline_length"])[:-1])
    found = simplified_outlines(expected)
    assert (
        np.mean(
            [
                np.array_equal(ours, points[keep])
                for ours, points, keep in zip(found, expected, kept, strict=True)
            ]
        )
        > 0.95
    )
    for ours, points in zip(found, expected, strict=True):
        assert_array_equal(ours[[0, -1]], points[[0, -1]])
        assert largest_distance(points, ours) <= TOLERANCE + 1e-9


def largest_distance(points: np.ndarray, chain: np.ndarray) -> float:
    """How far points are from a chain of lines at most."""
    start, along = chain[:-1], np.diff(chain, axis=0)
    place = np.clip(
        ((points[:, None] - start) * along).sum(axis=-1)
        / np.maximum((along**2).sum(axis=1), 1e-30),
        0,
        1,
    )
    return float(
        np.sqrt(((points[:, None] - start - place[..., None] * along) ** 2).sum(axis=-1))
        .min(axis=1)
        .max()
    )


def test_the_first_of_ties_is_kept_whatever_the_machine() -> None:
    """Two points as far off as each other, but for what rounding does to one of them."""
    outline = np.array([[0.0, 0.0], [1.0, 1.0], [1.0 + 1e-13, 3.0], [0.0, 4.0]])
    [found] = simplified_outlines([outline])
    assert_array_equal(found, outline)
    flat = np.array([[0.0, 0.0], [0.5 + 1e-12, 2.0], [0.0, 4.0]])
    assert_array_equal(simplified_outlines([flat])[0], flat[[0, 2]])


def test_no_outlines_are_simplified() -> None:
    nothing = np.zeros((0, 2))
    assert (
        simplified_outlines([]),
        [len(each) for each in simplified_outlines([nothing, np.eye(2), nothing])],
    ) == (
        [],
        [0, 2, 0],
    )


def test_an_outline_is_found_wherever_it_is() -> None:
    image = np.zeros((40, 40), dtype=np.int32)
    image[20:24, 10:19] = 3
    there = outline_of(image, 3)
    assert_allclose(
        [there.min(axis=0), there.max(axis=0)],
        [[20 - 29 / 30, 10 - 29 / 30], [23 + 29 / 30, 18 + 29 / 30]],
    )


def test_the_part_with_the_first_cell_counts() -> None:
    image = np.zeros((30, 30), dtype=np.int32)
    image[5:8, 20:24] = 1
    image[7:20, 3:9] = 1
    assert outline_of(image, 1)[:, 1].min() > 18


def test_an_instance_that_fills_the_image_has_no_outline() -> None:
    assert len(outline_of(np.ones((5, 6), dtype=np.int32), 1)) == 0


def gaps_of(image: np.ndarray, *ids: int, **choices) -> dict[tuple[int, ...], float]:
    pairs, gaps = pair_gaps(image, np.array(ids, dtype=np.int64), **choices)
    return dict(zip(map(tuple, pairs.tolist()), gaps.tolist(), strict=True))


@pytest.fixture
def boxes() -> np.ndarray:
    """1 and 2 have seven empty columns between them, 2 and 3 touch."""
    image = np.zeros((60, 60), dtype=np.int32)
    image[10:14, 5:13] = 1
    image[10:14, 20:28] = 2
    image[14:18, 20:28] = 3
    return image


def test_instances_are_nearer_than_they_are_drawn(boxes) -> None:
    """By 0.9 and 0.95 cells: each outline runs where the interpolated id is 0.1."""
    gaps = gaps_of(boxes, 1, 2, 3)
    assert (list(gaps), gaps[1, 2], gaps[2, 3]) == (
        [(1, 2), (1, 3), (2, 3)],
        pytest.approx(8 - 0.9 - 0.95),
        0,
    )
    assert first_outline(boxes, 2, find_objects(boxes)[1])[:, 1].min() == 20 - 0.95


def test_pairs_that_cannot_be_near_are_left_out(boxes) -> None:
    whole = gaps_of(boxes, 1, 2, 3)
    for below in (0.001, 5.0, 6.1, 6.5):
        near = gaps_of(boxes, 1, 2, 3, below=below)
        assert near == {pair: whole[pair] for pair in near}
        assert {pair for pair, gap in whole.items() if gap < below} <= set(near)
    assert list(gaps_of(boxes, 1, 2, 3, below=0.001)) == [(2, 3)]


def test_who_is_not_there_or_too_small_is_far_away(boxes) -> None:
    boxes[0, 0] = 4
    assert gaps_of(boxes, 1, 4, 5) == {(1, 4): NO_OUTLINE, (1, 5): NO_OUTLINE, (4, 5): NO_OUTLINE}
    assert gaps_of(boxes, 1, 4, 5, below=np.inf) != {}
    assert gaps_of(boxes, 1, 5, below=5.0) == {}


def test_nobody_has_no_distances(boxes) -> None:
    assert (gaps_of(boxes), gaps_of(boxes, 2), gaps_of(np.zeros_like(boxes), 1, 2)) == (
        {},
        {},
        {(1, 2): NO_OUTLINE},
    )


def test_ids_keep_their_order(boxes) -> None:
    assert list(gaps_of(boxes, 3, 1, 2)) == [(3, 1), (3, 2), (1, 2)]
