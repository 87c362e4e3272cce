"""Laws of the warps: no motion changes only the documented blur, and inverses undo each other."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from support.strategies import grids

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


def make_noise(grid: BevGrid) -> np.ndarray:
    return np.random.default_rng(0).random((2, *grid.shape)).astype(np.float32)


@given(grids(), RULES, ORIENTATIONS)
def test_standing_still_keeps_every_cell(grid, rules, orientation) -> None:
    grid = grid.with_orientation(orientation)
    raster = make_noise(grid)
    nearest = warp(raster, np.eye(4), grid, rules, orientation=orientation)
    assert_array_equal(nearest, raster)
    bilinear = warp(raster, np.eye(4), grid, CLEAN, "bilinear", orientation=orientation)
    assert_array_equal(bilinear, raster)


@given(grids())
def test_standing_still_samples_at_most_half_a_cell_away_as_released(grid) -> None:
    points = sample_points(np.eye(4), grid, RELEASED)
    assert (np.abs(points - np.indices(points[0].shape)) <= 0.5 + 1e-4).all()


@given(STEPS, RULES, ORIENTATIONS)
def test_all_orientations_warp_alike(step, rules, orientation) -> None:
    grid = BevGrid((-10, 10, 0.5), (-10, 10, 0.5))
    matrix = sampling_matrix(conventions.matrices_of_six(step)[None], rules)[0]
    raster = make_noise(grid)
    expected = warp(grid.reorient(raster, rules.native), matrix, grid, rules)
    turned_raster = grid.reorient(raster, orientation)
    turned = warp(turned_raster, matrix, grid, rules, orientation=orientation)
    native = grid.with_orientation(orientation).reorient(turned, rules.native)
    assert_array_equal(native, expected)
    indices = nearest_indices(matrix, grid, rules)
    assert ((indices >= -1) & (indices < grid.cells)).all()


@given(STEPS)
def test_there_and_back_brings_smooth_maps_home(step) -> None:
    """Rounding half a cell twice changes little in a map that rises by 1 a cell."""
    grid = BevGrid((-20, 20, 0.5), (-20, 20, 0.5), "released")
    matrix = conventions.matrices_of_six(step)
    columns = np.arange(grid.shape[1], dtype=np.float64) + 1000
    raster = np.broadcast_to(columns, grid.shape)
    warped = warp(raster, matrix, grid, CLEAN, orientation="released")
    restored = warp(warped, np.linalg.inv(matrix), grid, CLEAN, orientation="released")
    is_seen = restored > 0
    assert (np.abs(restored - raster)[is_seen] <= 2).all()
    assert is_seen[30:50, 30:50].all()


@given(st.lists(STEPS, min_size=1, max_size=4), AUGMENTATIONS, RULES)
def test_past_and_future_undo_each_other(steps, augmentation, rules) -> None:
    """For one motion, a past frame's transform is the inverse of the future frame's.

    This holds with and without augmentation.
    """
    for optional_augmentation in (None, augmentation):
        from_past = present_from_past(steps[:1], rules, optional_augmentation)[0]
        from_future = present_from_frames([steps[0]] * 2, rules, optional_augmentation)[1]
        assert_allclose(from_past @ from_future, np.eye(4), atol=1e-4)


@given(st.lists(STEPS, min_size=2, max_size=5))
def test_exact_chains_are_the_products_of_their_steps(steps) -> None:
    past = present_from_past(steps, CLEAN)
    assert_allclose(past[0], past[1] @ present_from_past(steps[:1], CLEAN)[0], atol=1e-9)
    future = present_from_frames(steps, CLEAN)
    assert_allclose(future[-1] @ present_from_past(steps[:-1], CLEAN)[0], np.eye(4), atol=1e-9)


@given(STEPS, ORIENTATIONS)
def test_a_cell_lands_where_its_centre_goes(step, orientation) -> None:
    """Right-handed metres go in and come out in every orientation, within half a cell."""
    grid = BevGrid((-20, 20, 0.5), (-20, 20, 0.5), orientation)
    disc = np.linalg.norm(grid.centers() - (3.25, -2.25), axis=-1) < 1.1
    poses = [[0] * 6, step]
    warped_disc = agents_to_ego(np.stack([disc] * 2), poses, grid=grid, protocol="clean")[1]
    expected = (conventions.matrices_of_six(step) @ [3.25, -2.25, 0, 1])[:2]
    assert_allclose(grid.centers()[warped_disc].mean(axis=0), expected, atol=0.26)
