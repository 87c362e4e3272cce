"""Laws of the warps: standing still changes nothing but the documented blur, and there and back is
the way home.
"""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from strategies import grids

from deepaccident_devkit.geometry import BevGrid, conventions
from deepaccident_devkit.motion.augmentation import Augmentation
from deepaccident_devkit.motion.config import LABEL_PROTOCOLS
from deepaccident_devkit.motion.warping import (
    agents_to_ego,
    nearest_indices,
    present_from_frames,
    present_from_past,
    sample_points,
    sampling_matrix,
    warp,
)

RELEASED, CLEAN = LABEL_PROTOCOLS["released"], LABEL_PROTOCOLS["clean"]
RULES = st.sampled_from(list(LABEL_PROTOCOLS.values()))
ORIENTATIONS = st.sampled_from(("devkit", "released", "fiery"))
STEPS = st.tuples(
    *(st.floats(-5, 5) for _ in range(2)),
    st.just(0.0),
    st.just(0.0),
    st.just(0.0),
    st.floats(-3, 3),
)
"""Motions in the plane."""
AUGMENTATIONS = st.builds(
    Augmentation, rotation=st.floats(-3, 3), scale=st.floats(0.9, 1.1), flip=st.booleans()
)


def noise(grid: BevGrid) -> np.ndarray:
    return np.random.default_rng(0).random((2, *grid.shape)).astype(np.float32)


@given(grids(), RULES, ORIENTATIONS)
def test_standing_still_keeps_every_cell(grid, rules, orientation) -> None:
    grid = grid.with_orientation(orientation)
    raster = noise(grid)
    assert_array_equal(warp(raster, np.eye(4), grid, rules, orientation=orientation), raster)
    assert_array_equal(
        warp(raster, np.eye(4), grid, CLEAN, "bilinear", orientation=orientation), raster
    )


@given(grids())
def test_standing_still_samples_at_most_half_a_cell_away_as_released(grid) -> None:
    points = sample_points(np.eye(4), grid, RELEASED)
    assert (np.abs(points - np.indices(points[0].shape)) <= 0.5 + 1e-4).all()


@given(STEPS, RULES, ORIENTATIONS)
def test_all_orientations_warp_alike(step, rules, orientation) -> None:
    grid = BevGrid((-10, 10, 0.5), (-10, 10, 0.5))
    matrix = sampling_matrix(conventions.matrices_of_six(step)[None], rules)[0]
    native, raster = nearest_indices(matrix, grid, rules), noise(grid)
    lying = rules.native
    expected = warp(grid.reorient(raster, lying), matrix, grid, rules)
    found = warp(grid.reorient(raster, orientation), matrix, grid, rules, orientation=orientation)
    assert_array_equal(grid.with_orientation(orientation).reorient(found, lying), expected)
    assert ((native >= -1) & (native < grid.cells)).all()


@given(STEPS)
def test_there_and_back_brings_smooth_maps_home(step) -> None:
    """Within what half a cell of rounding, twice, changes in a map that rises by 1 a cell."""
    grid = BevGrid((-20, 20, 0.5), (-20, 20, 0.5), "released")
    there = conventions.matrices_of_six(step)
    column = np.broadcast_to(np.arange(grid.shape[1], dtype=np.float64) + 1000, grid.shape)
    away = warp(column, there, grid, CLEAN, orientation="released")
    home = warp(away, np.linalg.inv(there), grid, CLEAN, orientation="released")
    seen = home > 0
    assert (np.abs(home - column)[seen] <= 2).all()
    assert seen[30:50, 30:50].all()


@given(st.lists(STEPS, min_size=1, max_size=4), AUGMENTATIONS, RULES)
def test_past_and_future_undo_each_other(steps, augmentation, rules) -> None:
    """Of one motion: a past frame's transform is the inverse of the future frame's; augmented or
    not.
    """
    for given_one in (None, augmentation):
        forward = present_from_past(steps[:1], rules, given_one)[0]
        backward = present_from_frames([steps[0], steps[0]], rules, given_one)[1]
        assert_allclose(forward @ backward, np.eye(4), atol=1e-4)


@given(st.lists(STEPS, min_size=2, max_size=5))
def test_exact_chains_are_the_products_of_their_steps(steps) -> None:
    past = present_from_past(steps, CLEAN)
    assert_allclose(past[0], past[1] @ present_from_past(steps[:1], CLEAN)[0], atol=1e-9)
    future = present_from_frames(steps, CLEAN)
    assert_allclose(future[-1] @ present_from_past(steps[:-1], CLEAN)[0], np.eye(4), atol=1e-9)


@given(STEPS, ORIENTATIONS)
def test_a_cell_lands_where_its_centre_goes(step, orientation) -> None:
    """Right-handed metres in, right-handed metres out, in every orientation; a cell's neighbours at
    most.
    """
    grid = BevGrid((-20, 20, 0.5), (-20, 20, 0.5), orientation)
    blob = np.linalg.norm(grid.centers() - (3.25, -2.25), axis=-1) < 1.1
    found = agents_to_ego(np.stack([blob] * 2), [[0] * 6, step], grid=grid, protocol="clean")[1]
    expected = (conventions.matrices_of_six(step) @ [3.25, -2.25, 0, 1])[:2]
    assert_allclose(grid.centers()[found].mean(axis=0), expected, atol=0.26)
