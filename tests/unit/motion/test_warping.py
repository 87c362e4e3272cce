"""Warps: the three rules on small grids, labels to the present, and maps of past moments and of
agents.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from refusals import assert_refused

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
RELEASED, CLEAN, FIERY = (LABEL_PROTOCOLS[name] for name in ("released", "clean", "fiery"))
RULES = pytest.mark.parametrize("rules", LABEL_PROTOCOLS.values(), ids=LABEL_PROTOCOLS)
ORIENTATIONS = pytest.mark.parametrize("orientation", ["devkit", "released", "fiery"])
ONE_AHEAD = [1.0, 0, 0, 0, 0, 0]
QUARTER_LEFT = [0, 0, 0, 0, 0, np.pi / 2]


def at(x: float, y: float, grid: BevGrid = GRID, value: float = 1) -> np.ndarray:
    """A raster with one cell filled, that of a point x forward, y left."""
    raster = np.zeros(grid.shape, dtype=np.float32)
    raster[tuple(grid.index_of([[x, y]])[0][0])] = value
    return raster


@ORIENTATIONS
@pytest.mark.parametrize("protocol", ["clean", "fiery"])
def test_an_agent_that_stands_ahead_sees_things_further_ahead(
    protocol: str, orientation: Any
) -> None:
    grid = GRID.with_orientation(orientation)
    maps = np.stack([at(0.5, 1.5, grid), at(0.5, 1.5, grid)])
    assert_array_equal(
        agents_to_ego(maps, [[0] * 6, ONE_AHEAD], grid=grid, protocol=protocol),
        [maps[0], at(1.5, 1.5, grid)],
    )


@ORIENTATIONS
def test_an_agent_that_looks_left_sees_ahead_what_the_ego_sees_on_its_left(
    orientation: Any,
) -> None:
    grid = GRID.with_orientation(orientation)
    for protocol in ("clean", "fiery"):
        found = agents_to_ego(
            np.stack([at(2.5, 0.5, grid)] * 2),
            [[0] * 6, QUARTER_LEFT],
            grid=grid,
            protocol=protocol,
        )
        assert_array_equal(found[1], at(-0.5, 2.5, grid), protocol)


def test_fierys_sideways_shift_has_the_wrong_sign() -> None:
    to_the_left, maps = [[0] * 6, [0, 1.0, 0, 0, 0, 0]], np.stack([at(0.5, 0.5)] * 2)
    assert_array_equal(
        agents_to_ego(maps, to_the_left, grid=GRID, protocol="clean")[1], at(0.5, 1.5)
    )
    assert_array_equal(
        agents_to_ego(maps, to_the_left, grid=GRID, protocol="fiery")[1], at(0.5, -0.5)
    )


@RULES
def test_indices_outside_are_minus_one_and_warps_fill_there(rules: LabelProtocol) -> None:
    far = np.eye(4)
    far[0, 3] = 1e7
    assert_array_equal(nearest_indices(far, GRID, rules), np.full(64, -1))
    for mode in ("nearest", "bilinear"):
        assert_array_equal(
            warp(np.ones((2, 8, 8)), far, GRID, rules, mode, fill=7), np.full((2, 8, 8), 7)
        )  # type: ignore[arg-type]


@RULES
def test_oblong_grids_that_are_not_centred_keep_their_cells_where_nothing_moves(
    rules: LabelProtocol,
) -> None:
    for grid in (BevGrid((0, 30, 0.5), (-10, 20, 1.5)), BevGrid((-1, 0, 1), (-20, 20, 0.1))):
        for orientation in (None, "devkit", "released", "fiery"):
            assert_array_equal(
                nearest_indices(np.eye(4), grid, rules, orientation=orientation),
                np.arange(grid.cells),
                str(grid),
            )


def test_released_bilinear_sampling_blurs_without_motion_and_the_exact_one_does_not() -> None:
    raster = np.random.default_rng(0).random(GRID.shape).astype(np.float32)
    assert_array_equal(warp(raster, np.eye(4), GRID, CLEAN, "bilinear"), raster)
    assert not np.allclose(warp(raster, np.eye(4), GRID, RELEASED, "bilinear"), raster, atol=0.05)
    assert warp(raster.astype(np.int16), np.eye(4), GRID, RELEASED).dtype == np.int16


def test_what_does_not_fit_is_refused() -> None:
    raster = np.zeros(GRID.shape)
    assert_refused(
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
            "more than a warp can number",
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
    first, second = ONE_AHEAD, QUARTER_LEFT
    exact = present_from_past([first, second], CLEAN)
    released = present_from_past([first, second], RELEASED)
    # left-handed: turning is the other way round
    ahead, turn = (
        conventions.matrices_of_six(first),
        conventions.matrices_of_six(np.negative(second)),
    )
    np.testing.assert_allclose(exact, [turn @ ahead, turn], atol=1e-12)
    np.testing.assert_allclose(released, [ahead @ turn, turn], atol=1e-6)
    assert present_from_past(np.zeros((0, 6)), RELEASED).shape == (0, 4, 4)


def test_one_moment_alone_and_the_ego_alone_stay_as_they_are() -> None:
    raster = np.arange(64.0).reshape(1, 8, 8)
    assert_array_equal(past_to_present(raster, np.zeros((0, 6)), grid=GRID), raster)
    assert_array_equal(agents_to_ego(raster, np.ones((1, 6)), grid=GRID), raster)


def test_augmented_maps_move_along_the_augmented_axes() -> None:
    """Mirrored maps of an agent one metre to the left stand one metre to the right."""
    augmentation, pose = Augmentation(flip=True), [[0] * 6, [0, 1.0, 0, 0, 0, 0]]
    found = agents_to_ego(
        np.stack([at(0.5, 0.5)] * 2), pose, grid=GRID, protocol="clean", augmentation=augmentation
    )
    assert_array_equal(found[1], at(0.5, -0.5))


def test_single_precision_inverses_are_inverses() -> None:
    six = np.random.default_rng(1).normal(0, (8, 8, 1, 0.1, 0.1, 1), (50, 6))
    matrices = single_precision.pose_matrices(six)
    assert matrices.dtype == np.float32
    np.testing.assert_allclose(matrices, conventions.matrices_of_six(six), atol=1e-6)
    for inverse in (single_precision.inverse, single_precision.rigid_inverse):
        np.testing.assert_allclose(
            single_precision.product(inverse(matrices), matrices),
            np.tile(np.eye(4), (50, 1, 1)),
            atol=1e-5,
        )
    scaled = matrices * np.float32([[1.05], [-1.05], [1.05], [1]])
    np.testing.assert_allclose(
        sampling_matrix(scaled, RELEASED) @ scaled, np.tile(np.eye(4), (50, 1, 1)), atol=1e-5
    )


def test_sines_are_torchs_and_not_the_nearest_float32() -> None:
    """As torch 2.13 gave them on a processor; most of these are chosen to be the nearest's
    neighbours.
    """
    angles = np.array([-2.86, -2.84, -2.8, -2.9, -2.85, -2.74, 0.0, 3.1], dtype=np.float32)
    assert_array_equal(
        single_precision.sines_and_cosines(angles)[1],
        np.array(
            [
                -0.9606141,
                -0.9548646,
                -0.94222236,
                -0.9709582,
                -0.9577872,
                -0.9204396,
                1.0,
                -0.99913514,
            ],
            dtype=np.float32,
        ),
    )
    assert_array_equal(
        single_precision.sines_and_cosines(angles)[0],
        np.array(
            [
                -0.27788603,
                -0.29704145,
                -0.3349882,
                -0.23924924,
                -0.28747812,
                -0.3908848,
                0.0,
                0.04158076,
            ],
            dtype=np.float32,
        ),
    )
    assert (
        single_precision.sines_and_cosines(angles)[1]
        != np.cos(angles.astype(np.float64)).astype(np.float32)
    ).any()


def make_labels(config: MotionLabelConfig, step: list[float]) -> MotionLabels:
    """One cell of an instance, 2.5 m ahead and 0.5 m to the left of each frame's own ego, which
    moves by `step`.
    """
    mask = np.broadcast_to(at(2.5, 0.5, config.grid) > 0, (config.label_frames, *config.grid.shape))
    ahead = {"devkit": (0, 1), "released": (0, 1), "fiery": (1, 0)}[config.grid.orientation]
    vectors = np.where(mask[:, None], np.reshape(ahead, (1, 2, 1, 1)), config.ignore_index).astype(
        np.float32
    )
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
    labels = make_labels(config, np.negative(QUARTER_LEFT).tolist())
    present = labels.to_present()
    assert present.at_present
    assert present.id_map == {7: 1}
    assert not labels.at_present
    grid = config.grid
    assert_array_equal(present.instance, [at(2.5, 0.5, grid), at(-0.5, 2.5, grid)])
    assert_array_equal(present.segmentation, present.instance)
    assert_array_equal(present.centerness[:, 0], present.instance)
    # what pointed ahead points to the left
    left = {"devkit": (1, 0), "released": (-1, 0), "fiery": (0, 1)}[orientation]
    here = present.instance[1] > 0
    np.testing.assert_allclose(present.offset[1][:, here][:, 0], left, atol=1e-6)
    np.testing.assert_allclose(present.flow[1][:, ~here], config.ignore_index)


@pytest.mark.parametrize(("protocol", "beside"), [("released", 0), ("clean", 255)])
def test_what_comes_in_from_beside_the_grid(protocol: str, beside: int) -> None:
    labels = make_labels(
        MotionLabelConfig(grid=GRID, protocol=protocol, future_frames=1), [-3.0, 0, 0, 0, 0, 0]
    )
    present = labels.to_present(centerness="bilinear")
    assert_array_equal(present.flow[1][:, :, :2], beside)
    assert_array_equal(present.offset[1][:, :, 4:7], 255)
    assert_array_equal(present.instance[1], 0)
    assert_array_equal(present.flow[0], labels.flow[0])


def test_released_vectors_keep_their_values_when_the_frame_turns() -> None:
    present = make_labels(
        MotionLabelConfig(grid=GRID, future_frames=1), np.negative(QUARTER_LEFT).tolist()
    ).to_present()
    assert_array_equal(present.offset[1][:, present.instance[1] > 0][:, 0], [0, 1])


def test_what_is_unknown_of_an_instance_stays_unknown_when_the_frame_turns() -> None:
    config = MotionLabelConfig(grid=GRID, protocol="clean", future_frames=1)
    labels = make_labels(config, np.negative(QUARTER_LEFT).tolist())
    flow = np.full_like(labels.flow, config.ignore_index)
    present = replace(labels, flow=flow).to_present()
    assert present.instance[1].any()
    assert_array_equal(present.flow, flow)


def test_labels_at_the_present_are_not_warped_again() -> None:
    present = make_labels(MotionLabelConfig(grid=GRID), ONE_AHEAD).to_present()
    assert_refused(
        (present.to_present, NotAvailableError, "in the present frame already"),
        (
            lambda: make_labels(MotionLabelConfig(grid=GRID), ONE_AHEAD).to_present(
                centerness="linear"
            ),
            ChoiceError,
            "mode: expected one of nearest, bilinear",
        ),
    )


def test_a_chain_of_frames_starts_at_the_identity() -> None:
    chain = present_from_frames([ONE_AHEAD, QUARTER_LEFT, ONE_AHEAD], FIERY)
    assert chain.dtype == np.float32
    assert_array_equal(chain[0], np.eye(4))
    np.testing.assert_allclose(chain[1][:3, 3], [-1, 0, 0])
    np.testing.assert_allclose(chain[2][:2, :2], [[0, 1], [-1, 0]], atol=1e-7)


@pytest.mark.parametrize("shape", [(0, 3, 4, 4), (4, 4)])
def test_no_map_is_no_feature(shape: tuple[int, ...]) -> None:
    assert_refused(
        (
            lambda: agents_to_ego(np.zeros(shape), np.zeros((shape[0], 6))),
            GeometryError,
            "features: expected at least one map",
        ),
    )
