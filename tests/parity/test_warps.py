"""The golden warps (tests/data/golden: a_labels, g_poses, h_fiery): to the present, from the past
and from other agents.

The released functions and FIERY's own made them under torch 2.13 (tests/data/golden/README.md); the
rules are in docs/released_code.md, Warps, and FIERY's own labels. No cell of a nearest warp of
labels may differ. A dense field may differ in 10 of 80,000 cells, a bilinear warp in 1.5 % of the
cells that are not zero, by one step of float16 or 3e-4.
"""

import json
from typing import Any

import numpy as np
import pytest

from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.geometry.bev_grid import to_orientation
from deepaccident_devkit.geometry.conventions import flip_pose, flip_six_vector
from deepaccident_devkit.motion.augmentation import Augmentation
from deepaccident_devkit.motion.config import LABEL_PROTOCOLS, MotionLabelConfig
from deepaccident_devkit.motion.labels import MotionLabels
from deepaccident_devkit.motion.warping import (
    agents_to_ego,
    past_to_present,
    present_from_frames,
    sample_points,
    sampling_matrix,
    warp,
)

RELEASED = BevGrid(orientation="released")
PROTOCOL = LABEL_PROTOCOLS["released"]
IGNORE = 255
MAPS = ("segmentation", "instance", "centerness", "offset", "flow")
VECTORS = ("offset", "flow")
ORIENTATIONS = pytest.mark.parametrize("orientation", ["devkit", "released", "fiery"])
MODES = pytest.mark.parametrize("mode", ["nearest", "bilinear"])


@ORIENTATIONS
@pytest.mark.golden_cases("a_labels", "scenes")
def test_nearest_labels_equal_the_released_codes(golden, orientation) -> None:
    stored = read_scene(golden)
    expected = {name: stored[f"w_{name}"] for name in MAPS if name != "centerness"}
    expected["centerness"] = stored["w_centerness_nearest"]

    labels = make_labels(stored, orientation).to_present()

    for name, expected_map in expected.items():
        assert count_differing_cells(released_map(labels, name), expected_map) == 0, name


@ORIENTATIONS
@pytest.mark.golden_cases("a_labels", "scenes")
def test_bilinear_centres_are_the_released_codes(golden, orientation) -> None:
    """Warp float32 centres, since the stored ones are rounded to float16."""
    stored = read_scene(golden)
    stored["centerness"] = draw_centres(stored["instance"], stored["offset"])

    labels = make_labels(stored, orientation).to_present(centerness="bilinear")

    assert_bilinear(released_map(labels, "centerness"), stored["w_centerness_bilinear"])
    assert count_differing_cells(released_map(labels, "offset"), stored["w_offset"]) == 0


@pytest.mark.golden_cases("h_fiery", "cases")
def test_labels_equal_fierys(golden) -> None:
    names = ("instance", "centerness", "offset", "flow")
    stored = {name: golden[name] for name in names}
    stored["segmentation"] = stored["instance"] > 0
    config = MotionLabelConfig.preset("fiery")

    labels = make_record(stored, config, golden["egomotion"]).to_present()

    for name in names:
        assert count_differing_cells(getattr(labels, name), golden[f"w_{name}"]) == 0, name


@MODES
@pytest.mark.golden_rows("g_poses", "identity_warp_nearest")
def test_standing_still_samples_as_the_released_code(golden_row, mode) -> None:
    channel = read_pattern(golden_row)[golden_row.index]
    warped = warp(channel, np.eye(4), RELEASED, PROTOCOL, mode)
    assert_warped(warped, golden_row[f"identity_warp_{mode}"], mode)


@pytest.mark.golden_rows("g_poses", "identity_warp_nearest")
def test_sample_points_equal_the_released_codes(golden_row) -> None:
    """Compare the points to the last bit: the identity leaves each cell where it is."""
    grid_x = read_part(golden_row)["bev_grid_x"]
    steps = (grid_x / np.float32(50) + np.float32(1)) * np.float32(99.5)

    row, column = sample_points(np.eye(4), RELEASED, PROTOCOL)

    expected_row = np.broadcast_to(steps[:, None], row.shape)
    expected_column = np.broadcast_to(steps, column.shape)
    assert count_differing_cells(row, expected_row) == 0
    assert count_differing_cells(column, expected_column) == 0


@MODES
@pytest.mark.golden_rows("g_poses", "future_warp_nearest")
def test_future_frames_are_warped_as_by_the_released_code(golden_row, mode) -> None:
    frame = golden_row.index
    warped = read_pattern(golden_row)
    if frame > 0:
        motion = flip_six_vector(read_egomotion(golden_row)[2:])
        transform = present_from_frames(motion, PROTOCOL)[frame]
        matrix = sampling_matrix(transform[None], PROTOCOL)[0]
        warped = warp(warped, matrix, RELEASED, PROTOCOL, mode)
    assert_warped(warped, golden_row[f"future_warp_{mode}"], mode)


@MODES
@ORIENTATIONS
@pytest.mark.golden_rows("g_poses", "past_warp_nearest")
def test_past_frames_are_warped_as_by_the_released_code(golden_row, mode, orientation) -> None:
    grid = BevGrid(orientation=orientation)
    pattern = RELEASED.reorient(read_pattern(golden_row), orientation)
    num_frames = len(read_part(golden_row)["past_warp_nearest"])
    motion = flip_six_vector(read_egomotion(golden_row))

    maps = past_to_present(np.stack([pattern] * num_frames), motion, grid=grid, mode=mode)

    warped = grid.reorient(maps[golden_row.index], "released")
    assert_warped(warped, golden_row[f"past_warp_{mode}"], mode)


@MODES
@ORIENTATIONS
@pytest.mark.golden_rows("g_poses", "v2x_warp_nearest_0")
def test_agents_maps_are_warped_as_by_the_released_code(golden_row, mode, orientation) -> None:
    grid = BevGrid(orientation=orientation)
    pattern = RELEASED.reorient(read_pattern(golden_row), orientation)
    for name, vectors in read_part(golden_row).items():
        if not name.startswith("v2x_warp_pose_"):
            continue
        poses = flip_six_vector(vectors)
        maps = agents_to_ego(np.stack([pattern] * len(poses)), poses, grid=grid, mode=mode)
        warped = grid.reorient(maps[golden_row.index], "released")
        assert_warped(warped, golden_row[name.replace("pose", mode)], mode)


def read_scene(golden) -> dict[str, np.ndarray]:
    """Read the arrays of one scene of a_labels, which has a file for each scene."""
    assert golden.index is not None, f"{golden.folder}: no scene in a_labels.json"
    with np.load(golden.folder / f"a_labels_{golden.index:02d}.npz") as archive:
        return dict(archive)


def read_part(golden_row) -> dict[str, np.ndarray]:
    """Read all arrays of the row's part."""
    assert golden_row.index is not None, (
        f"{golden_row.folder}: no array {golden_row.key} in {golden_row.part}.npz"
    )
    with np.load(golden_row.folder / f"{golden_row.part}.npz") as archive:
        return dict(archive)


def read_pattern(golden_row) -> np.ndarray:
    """Read the map that the warps of g_poses start from."""
    return read_part(golden_row)["warp_pattern"].astype(np.float32)


def read_egomotion(golden_row) -> np.ndarray:
    """Read the raw egomotion of the warps of g_poses, shape (7, 6)."""
    part = json.loads((golden_row.folder / "g_poses.json").read_text(encoding="utf-8"))
    index = part["chains"].index(part["warp_chain"])
    return read_part(golden_row)[f"egomotion_{index:03d}"]


def make_labels(stored: dict[str, np.ndarray], orientation) -> MotionLabels:
    """Return a scene's labels in an orientation, each frame in its own ego frame."""
    turned = {
        name: to_orientation(
            stored[name].astype(np.float32),
            vectors=name in VECTORS,
            source="released",
            target=orientation,
            ignore=IGNORE,
        )
        for name in MAPS
    }
    augmentation = make_augmentation(stored.get("aug_transform"))
    config = MotionLabelConfig(orientation=orientation, augmentation=augmentation)
    return make_record(turned, config, flip_six_vector(stored["future_egomotions"][2:]))


def make_record(
    maps: dict[str, np.ndarray], config: MotionLabelConfig, egomotion: np.ndarray
) -> MotionLabels:
    dtypes = {"segmentation": np.uint8, "instance": np.int32}
    typed: dict[str, Any] = {
        name: np.array(values, dtypes.get(name, np.float32)) for name, values in maps.items()
    }
    past = np.zeros((config.receptive_field - 1, 6))
    motion = np.concatenate([past, egomotion]).astype(np.float32)
    valid = np.ones(len(motion), bool)
    return MotionLabels(config=config, future_egomotion=motion, valid=valid, id_map={}, **typed)


def make_augmentation(matrix: np.ndarray | None) -> Augmentation | None:
    """Split the left-handed matrix that the released code drew into flip · scale · rotation."""
    if matrix is None:
        return None
    right_handed = flip_pose(matrix)
    linear = right_handed[:2, :2]
    scale = right_handed[2, 2]
    flip = bool(np.linalg.det(linear) < 0)
    turn = np.diag([1, -1 if flip else 1]) @ linear / scale
    rotation = np.arctan2(turn[1, 0], turn[0, 0])
    augmentation = Augmentation(rotation=rotation, scale=scale, flip=flip)
    np.testing.assert_allclose(augmentation.matrix, right_handed, rtol=0, atol=1e-6)
    return augmentation


def released_map(labels: MotionLabels, name: str) -> np.ndarray:
    """Return a map of the labels in the released orientation."""
    return to_orientation(
        getattr(labels, name),
        vectors=name in VECTORS,
        source=labels.config.grid.orientation,
        target="released",
        ignore=IGNORE,
    )


def draw_centres(instance: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Return the float32 centerness (T, 1, H, W) of the instances' centres.

    The formula is in docs/released_code.md, Motion labels.
    """
    rows, columns = np.indices(instance.shape[1:])
    centerness = np.zeros(instance.shape, dtype=np.float32)
    for frame, ids in enumerate(instance):
        for number in np.unique(ids[ids > 0]):
            row, column = np.argwhere(ids == number)[0]
            row_offset, column_offset = offset[frame, :, row, column]
            row_distance = row + row_offset - rows
            column_distance = column + column_offset - columns
            squared = (row_distance**2 + column_distance**2).astype(np.float32)
            peak = np.exp(-squared / np.float32(9))
            centerness[frame] = np.maximum(centerness[frame], peak)
    return centerness[:, None]


def count_differing_cells(cells: np.ndarray, expected: np.ndarray) -> int:
    assert cells.shape == expected.shape
    differing = cells.astype(expected.dtype) != expected
    return int(differing.sum())


def assert_warped(warped: np.ndarray, expected: np.ndarray, mode: str) -> None:
    if mode == "bilinear":
        assert_bilinear(warped, expected)
    else:
        assert count_differing_cells(warped, expected) <= 10 * expected.size / 80_000


def assert_bilinear(warped: np.ndarray, expected: np.ndarray) -> None:
    rounded = warped.astype(np.float16)
    num_differing = count_differing_cells(rounded, expected)
    assert num_differing <= 0.015 * np.count_nonzero(expected), f"{num_differing} cells differ"

    float16_step = np.abs(np.spacing(expected)).astype(np.float32)
    tolerance = np.maximum(float16_step, 3e-4) * 1.001
    difference = np.abs(rounded.astype(np.float32) - expected.astype(np.float32))
    assert (difference <= tolerance).all(), f"by up to {difference.max()}"
