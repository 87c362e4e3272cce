"""Warps: the three rules on small grids, labels to the present, and maps of past moments and of
agents.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import ChoiceError, GeometryError, NotAvailableError
from deepaccident_devkit.geometry import BevGrid, conventions
from deepaccident_devkit.motion.augmentation import Augmentation
from deepaccident_devkit.motion.config import LABEL_PROTOCOLS, LabelProtocol, MotionLabelConfig
from deepaccident_devkit.motion.labels import MotionLabels
from deepaccident_devkit.motion.reference_arithmetic import single_precision
from deepaccident_devkit.motion.warping import (
    agents_to_ego,
    nearest_indices,
    past_to_present,
    present_from_frames,
    present_from_past,
    sampling_matrix,
    warp,
)

GRID = BevGrid((-4, 4, 1), (-4, 4, 1))
RELEASED = LABEL_PROTOCOLS["released"]
CLEAN = LABEL_PROTOCOLS["clean"]
FIERY = LABEL_PROTOCOLS["fiery"]
RULES = pytest.mark.parametrize("rules", LABEL_PROTOCOLS.values(), ids=LABEL_PROTOCOLS)
ORIENTATIONS = pytest.mark.parametrize("orientation", ["devkit", "released", "fiery"])
STILL = [0.0] * 6
ONE_AHEAD = [1.0, 0, 0, 0, 0, 0]
ONE_LEFT = [0, 1.0, 0, 0, 0, 0]
QUARTER_LEFT = [0, 0, 0, 0, 0, np.pi / 2]
QUARTER_RIGHT = [0, 0, 0, 0, 0, -np.pi / 2]


def raster_at(x: float, y: float, grid: BevGrid = GRID) -> np.ndarray:
    """Return a raster with one filled cell, that of a point x forward, y left."""
    (cell,), _ = grid.index_of([[x, y]])
    raster = np.zeros(grid.shape, dtype=np.float32)
    raster[tuple(cell)] = 1
    return raster


@ORIENTATIONS
@pytest.mark.parametrize("protocol", ["clean", "fiery"])
def test_an_agent_that_stands_ahead_sees_things_further_ahead(
    protocol: str, orientation: Any
) -> None:
    grid = GRID.with_orientation(orientation)
    raster = raster_at(0.5, 1.5, grid)

    warped = agents_to_ego([raster, raster], [STILL, ONE_AHEAD], grid=grid, protocol=protocol)

    assert_array_equal(warped, [raster, raster_at(1.5, 1.5, grid)])


@ORIENTATIONS
def test_an_agent_that_looks_left_sees_ahead_what_the_ego_sees_on_its_left(
    orientation: Any,
) -> None:
    grid = GRID.with_orientation(orientation)
    raster = raster_at(2.5, 0.5, grid)
    for protocol in ("clean", "fiery"):
        warped = agents_to_ego(
            [raster, raster], [STILL, QUARTER_LEFT], grid=grid, protocol=protocol
        )
        assert_array_equal(warped[1], raster_at(-0.5, 2.5, grid), protocol)


def test_fierys_sideways_shift_has_the_wrong_sign() -> None:
    maps = [raster_at(0.5, 0.5)] * 2
    poses = [STILL, ONE_LEFT]

    clean = agents_to_ego(maps, poses, grid=GRID, protocol="clean")
    fiery = agents_to_ego(maps, poses, grid=GRID, protocol="fiery")

    assert_array_equal(clean[1], raster_at(0.5, 1.5))
    assert_array_equal(fiery[1], raster_at(0.5, -0.5))


@RULES
def test_indices_outside_are_minus_one_and_warps_fill_there(rules: LabelProtocol) -> None:
    far = np.eye(4)
    far[0, 3] = 1e7

    assert_array_equal(nearest_indices(far, GRID, rules), np.full(64, -1))

    raster = np.ones((2, 8, 8))
    for mode in ("nearest", "bilinear"):
        warped = warp(raster, far, GRID, rules, mode, fill=7)  # type: ignore[arg-type]
        assert_array_equal(warped, np.full((2, 8, 8), 7))


@RULES
def test_oblong_grids_that_are_not_centred_keep_their_cells_where_nothing_moves(
    rules: LabelProtocol,
) -> None:
    coarse = BevGrid((0, 30, 0.5), (-10, 20, 1.5))
    narrow = BevGrid((-1, 0, 1), (-20, 20, 0.1))
    for grid in (coarse, narrow):
        for orientation in (None, "devkit", "released", "fiery"):
            indices = nearest_indices(np.eye(4), grid, rules, orientation=orientation)
            assert_array_equal(indices, np.arange(grid.cells), str(grid))


def test_released_bilinear_sampling_blurs_without_motion_and_the_exact_one_does_not() -> None:
    raster = np.random.default_rng(0).random(GRID.shape).astype(np.float32)
    unmoved = np.eye(4)

    exact = warp(raster, unmoved, GRID, CLEAN, "bilinear")
    released = warp(raster, unmoved, GRID, RELEASED, "bilinear")
    whole_numbers = warp(raster.astype(np.int16), unmoved, GRID, RELEASED)

    assert_array_equal(exact, raster)
    assert not np.allclose(released, raster, atol=0.05)
    assert whole_numbers.dtype == np.int16


def test_what_does_not_fit_is_refused() -> None:
    raster = np.zeros(GRID.shape)
    assert_raises(
        (
            lambda: warp(raster[:, :7], np.eye(4), GRID, CLEAN),
            GeometryError,
            r"raster: expected shape \(…, 8, 8\), found \(8, 7\)",
        ),
        (
            lambda: warp(raster, np.eye(3), GRID, CLEAN),
            GeometryError,
            r"source_from_target: expected shape \(4, 4\)",
        ),
        (
            lambda: warp(raster, np.full((4, 4), np.nan), GRID, RELEASED),
            GeometryError,
            "not all numbers are finite",
        ),
        (
            lambda: warp(raster, np.eye(4), GRID, CLEAN, "cubic"),
            ChoiceError,
            "mode: expected one of nearest, bilinear, found 'cubic'",
        ),
        (
            lambda: nearest_indices(np.eye(4), BevGrid((-50, 50, 0.02), (-50, 50, 0.02)), CLEAN),
            GeometryError,
            "more than a warp supports",
        ),
        (
            lambda: past_to_present(np.zeros((3, 8, 8)), np.zeros((1, 6)), grid=GRID),
            GeometryError,
            "egomotion: expected at least 2 rows for 3 maps",
        ),
        (
            lambda: agents_to_ego(np.zeros((3, 8, 8)), np.zeros((2, 6)), grid=GRID),
            GeometryError,
            r"relative_pose: expected shape \(3, 6\)",
        ),
    )


def test_past_motions_are_multiplied_in_the_order_of_time_as_released_and_rightly_if_exact() -> (
    None
):
    motions = [ONE_AHEAD, QUARTER_LEFT]
    exact = present_from_past(motions, CLEAN)
    released = present_from_past(motions, RELEASED)

    ahead = conventions.matrices_of_six(ONE_AHEAD)
    # left-handed: turning is the other way round
    turn = conventions.matrices_of_six(np.negative(QUARTER_LEFT))
    np.testing.assert_allclose(exact, [turn @ ahead, turn], atol=1e-12)
    np.testing.assert_allclose(released, [ahead @ turn, turn], atol=1e-6)
    assert present_from_past(np.zeros((0, 6)), RELEASED).shape == (0, 4, 4)


def test_a_single_moment_and_a_single_agent_stay_as_they_are() -> None:
    raster = np.arange(64.0).reshape(1, 8, 8)

    moments = past_to_present(raster, np.zeros((0, 6)), grid=GRID)
    agents = agents_to_ego(raster, np.ones((1, 6)), grid=GRID)

    assert_array_equal(moments, raster)
    assert_array_equal(agents, raster)


def test_augmented_maps_move_along_the_augmented_axes() -> None:
    """Mirrored maps of an agent one metre to the left stand one metre to the right."""
    raster = raster_at(0.5, 0.5)
    warped = agents_to_ego(
        [raster, raster],
        [STILL, ONE_LEFT],
        grid=GRID,
        protocol="clean",
        augmentation=Augmentation(flip=True),
    )
    assert_array_equal(warped[1], raster_at(0.5, -0.5))


def test_single_precision_inverses_are_inverses() -> None:
    motions = np.random.default_rng(1).normal(0, (8, 8, 1, 0.1, 0.1, 1), (50, 6))
    identities = np.tile(np.eye(4), (50, 1, 1))

    matrices = single_precision.pose_matrices(motions)
    assert matrices.dtype == np.float32
    np.testing.assert_allclose(matrices, conventions.matrices_of_six(motions), atol=1e-6)

    for invert in (single_precision.inverse, single_precision.rigid_inverse):
        product = single_precision.product(invert(matrices), matrices)
        np.testing.assert_allclose(product, identities, atol=1e-5)

    scaled = matrices * np.float32([[1.05], [-1.05], [1.05], [1]])
    product = sampling_matrix(scaled, RELEASED) @ scaled
    np.testing.assert_allclose(product, identities, atol=1e-5)


def test_sines_are_torchs_and_not_the_nearest_float32() -> None:
    """Torch 2.13 gave these values on a processor; most angles are chosen so that its result is a
    neighbour of the nearest float32.
    """
    angles = np.array([-2.86, -2.84, -2.8, -2.9, -2.85, -2.74, 0.0, 3.1], dtype=np.float32)
    expected_cosines = [
        -0.9606141,
        -0.9548646,
        -0.94222236,
        -0.9709582,
        -0.9577872,
        -0.9204396,
        1.0,
        -0.99913514,
    ]
    expected_sines = [
        -0.27788603,
        -0.29704145,
        -0.3349882,
        -0.23924924,
        -0.28747812,
        -0.3908848,
        0.0,
        0.04158076,
    ]

    sines, cosines = single_precision.sines_and_cosines(angles)

    assert_array_equal(cosines, np.array(expected_cosines, dtype=np.float32))
    assert_array_equal(sines, np.array(expected_sines, dtype=np.float32))
    nearest_cosines = np.cos(angles.astype(np.float64)).astype(np.float32)
    assert (cosines != nearest_cosines).any()


def make_labels(config: MotionLabelConfig, step: list[float]) -> MotionLabels:
    """Make labels with one cell of an instance, 2.5 m ahead and 0.5 m to the left of each frame's
    own ego, which moves by `step`.
    """
    cell = raster_at(2.5, 0.5, config.grid) > 0
    mask = np.broadcast_to(cell, (config.label_frames, *config.grid.shape))
    ahead = {"devkit": (0, 1), "released": (0, 1), "fiery": (1, 0)}[config.grid.orientation]
    vectors = np.where(mask[:, None], np.reshape(ahead, (1, 2, 1, 1)), config.ignore_index)
    vectors = vectors.astype(np.float32)
    return MotionLabels(
        config=config,
        segmentation=mask.astype(np.uint8),
        instance=mask.astype(np.int32),
        centerness=mask[:, None].astype(np.float32),
        offset=vectors,
        flow=vectors,
        future_egomotion=np.tile(step, (config.frames, 1)).astype(np.float32),
        valid=np.ones(config.frames, dtype=bool),
        id_map={7: 1},
    )


@ORIENTATIONS
def test_what_is_ahead_of_an_ego_that_turned_left_is_on_the_presents_left(orientation: Any) -> None:
    """Points of a frame seen from the next: turning left turns them right."""
    config = MotionLabelConfig(
        grid=GRID, orientation=orientation, protocol="clean", future_frames=1
    )
    labels = make_labels(config, QUARTER_RIGHT)

    present = labels.to_present()

    assert present.at_present
    assert present.id_map == {7: 1}
    assert not labels.at_present
    grid = config.grid
    expected = [raster_at(2.5, 0.5, grid), raster_at(-0.5, 2.5, grid)]
    assert_array_equal(present.instance, expected)
    assert_array_equal(present.segmentation, present.instance)
    assert_array_equal(present.centerness[:, 0], present.instance)
    # what pointed ahead points to the left
    left = {"devkit": (1, 0), "released": (-1, 0), "fiery": (0, 1)}[orientation]
    actor = present.instance[1] > 0
    np.testing.assert_allclose(present.offset[1][:, actor][:, 0], left, atol=1e-6)
    np.testing.assert_allclose(present.flow[1][:, ~actor], config.ignore_index)


@pytest.mark.parametrize(("protocol", "beside"), [("released", 0), ("clean", 255)])
def test_what_comes_in_from_beside_the_grid(protocol: str, beside: int) -> None:
    config = MotionLabelConfig(grid=GRID, protocol=protocol, future_frames=1)
    labels = make_labels(config, [-3.0, 0, 0, 0, 0, 0])

    present = labels.to_present(centerness="bilinear")

    assert_array_equal(present.flow[1][:, :, :2], beside)
    assert_array_equal(present.offset[1][:, :, 4:7], 255)
    assert_array_equal(present.instance[1], 0)
    assert_array_equal(present.flow[0], labels.flow[0])


def test_released_vectors_keep_their_values_when_the_frame_turns() -> None:
    config = MotionLabelConfig(grid=GRID, future_frames=1)
    present = make_labels(config, QUARTER_RIGHT).to_present()
    actor = present.instance[1] > 0
    assert_array_equal(present.offset[1][:, actor][:, 0], [0, 1])


def test_what_is_unknown_of_an_instance_stays_unknown_when_the_frame_turns() -> None:
    config = MotionLabelConfig(grid=GRID, protocol="clean", future_frames=1)
    labels = make_labels(config, QUARTER_RIGHT)
    unknown_flow = np.full_like(labels.flow, config.ignore_index)

    present = replace(labels, flow=unknown_flow).to_present()

    assert present.instance[1].any()
    assert_array_equal(present.flow, unknown_flow)


def test_labels_at_the_present_are_not_warped_again() -> None:
    labels = make_labels(MotionLabelConfig(grid=GRID), ONE_AHEAD)
    present = labels.to_present()
    assert_raises(
        (present.to_present, NotAvailableError, "already in the present frame"),
        (
            lambda: labels.to_present(centerness="linear"),
            ChoiceError,
            "mode: expected one of nearest, bilinear",
        ),
    )


def test_a_chain_of_frames_starts_at_the_identity() -> None:
    first, second, third = present_from_frames([ONE_AHEAD, QUARTER_LEFT, ONE_AHEAD], FIERY)
    assert first.dtype == np.float32
    assert_array_equal(first, np.eye(4))
    np.testing.assert_allclose(second[:3, 3], [-1, 0, 0])
    np.testing.assert_allclose(third[:2, :2], [[0, 1], [-1, 0]], atol=1e-7)


@pytest.mark.parametrize("shape", [(0, 3, 4, 4), (4, 4)])
def test_no_map_is_no_feature(shape: tuple[int, ...]) -> None:
    assert_raises(
        (
            lambda: agents_to_ego(np.zeros(shape), np.zeros((shape[0], 6))),
            GeometryError,
            "features: expected at least one map",
        ),
    )
