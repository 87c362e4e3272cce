"""The golden warps (tests/data/golden: a_labels, g_poses, h_fiery): to the present, from the past
and other agents.

Made by the released functions and by FIERY's own under torch 2.13 (tests/data/golden/README.md);
the rules are docs/released_code.md, Warps, and FIERY's own labels. No cell of a nearest warp of
labels may differ; a dense field may in 10 cells of 80,000, a bilinear warp in 1.5 % of the cells
that are not zero, by one step of float16 or 3e-4.
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
    stored = scene_of(golden)
    present = labels_of(stored, orientation).to_present()
    for name in MAPS:
        expected = stored["w_centerness_nearest" if name == "centerness" else f"w_{name}"]
        assert cells_that_differ(released(present, name), expected) == 0, name


@ORIENTATIONS
@pytest.mark.golden_cases("a_labels", "scenes")
def test_bilinear_centres_are_the_released_codes(golden, orientation) -> None:
    """From float32 centres: the stored ones are rounded to float16."""
    stored = scene_of(golden)
    stored["centerness"] = centres_of(stored["instance"], stored["offset"])
    present = labels_of(stored, orientation).to_present(centerness="bilinear")
    assert_bilinear(released(present, "centerness"), stored["w_centerness_bilinear"])
    assert cells_that_differ(released(present, "offset"), stored["w_offset"]) == 0


@pytest.mark.golden_cases("h_fiery", "cases")
def test_labels_equal_fierys(golden) -> None:
    stored = {name: golden[name] for name in ("instance", "centerness", "offset", "flow")}
    stored["segmentation"] = stored["instance"] > 0
    config = MotionLabelConfig.preset("fiery")
    present = record(stored, config, golden["egomotion"]).to_present()
    for name in ("instance", "centerness", "offset", "flow"):
        assert cells_that_differ(getattr(present, name), golden[f"w_{name}"]) == 0, name


@MODES
@pytest.mark.golden_rows("g_poses", "identity_warp_nearest")
def test_standing_still_samples_as_the_released_code(golden_row, mode) -> None:
    channel = whole(golden_row)["warp_pattern"][golden_row.index].astype(np.float32)
    warped = warp(channel, np.eye(4), RELEASED, PROTOCOL, mode)
    assert_warped(warped, golden_row[f"identity_warp_{mode}"], mode)


@pytest.mark.golden_rows("g_poses", "identity_warp_nearest")
def test_sample_points_equal_the_released_codes(golden_row) -> None:
    """To the last bit: points are where M leads, and with M = 1, in units of half the grid, where
    they stand.
    """
    expected = whole(golden_row)["bev_grid_x"]
    steps = (expected / np.float32(50) + np.float32(1)) * np.float32(99.5)
    row, column = sample_points(np.eye(4), RELEASED, PROTOCOL)
    assert cells_that_differ(row, np.broadcast_to(steps[:, None], row.shape)) == 0
    assert cells_that_differ(column, np.broadcast_to(steps, column.shape)) == 0


@MODES
@pytest.mark.golden_rows("g_poses", "future_warp_nearest")
def test_future_frames_are_warped_as_by_the_released_code(golden_row, mode) -> None:
    arrays, frame = whole(golden_row), golden_row.index
    pattern = arrays["warp_pattern"].astype(np.float32)
    transform = present_from_frames(flip_six_vector(chain_of(golden_row)[2:]), PROTOCOL)[frame]
    warped = warp(pattern, sampling_matrix(transform[None], PROTOCOL)[0], RELEASED, PROTOCOL, mode)
    assert_warped(warped if frame else pattern, golden_row[f"future_warp_{mode}"], mode)


@MODES
@ORIENTATIONS
@pytest.mark.golden_rows("g_poses", "past_warp_nearest")
def test_past_frames_are_warped_as_by_the_released_code(golden_row, mode, orientation) -> None:
    grid = BevGrid(orientation=orientation)
    pattern = RELEASED.reorient(whole(golden_row)["warp_pattern"].astype(np.float32), orientation)
    motion = flip_six_vector(chain_of(golden_row))
    warped = past_to_present(
        np.stack([pattern] * len(whole(golden_row)["past_warp_nearest"])),
        motion,
        grid=grid,
        mode=mode,
    )[golden_row.index]
    assert_warped(grid.reorient(warped, "released"), golden_row[f"past_warp_{mode}"], mode)


@MODES
@ORIENTATIONS
@pytest.mark.golden_rows("g_poses", "v2x_warp_nearest_0")
def test_agents_maps_are_warped_as_by_the_released_code(golden_row, mode, orientation) -> None:
    grid = BevGrid(orientation=orientation)
    arrays = whole(golden_row)
    pattern = RELEASED.reorient(arrays["warp_pattern"].astype(np.float32), orientation)
    for name in (each for each in arrays if each.startswith("v2x_warp_pose_")):
        pose = flip_six_vector(arrays[name])
        warped = agents_to_ego(np.stack([pattern] * len(pose)), pose, grid=grid, mode=mode)[
            golden_row.index
        ]
        assert_warped(
            grid.reorient(warped, "released"), golden_row[name.replace("pose", mode)], mode
        )


def scene_of(golden) -> dict[str, np.ndarray]:
    """The arrays of one scene of a_labels: a file a scene."""
    assert golden.index is not None, f"{golden.folder}: no scene in a_labels.json"
    with np.load(golden.folder / f"a_labels_{golden.index:02d}.npz") as archive:
        return dict(archive)


def whole(golden_row) -> dict[str, np.ndarray]:
    """All arrays of the part."""
    assert golden_row.index is not None, (
        f"{golden_row.folder}: no array {golden_row.key} in {golden_row.part}.npz"
    )
    with np.load(golden_row.folder / f"{golden_row.part}.npz") as archive:
        return dict(archive)


def chain_of(golden_row) -> np.ndarray:
    """(7, 6) the raw egomotion that the warps of g_poses take."""
    part = json.loads((golden_row.folder / "g_poses.json").read_text(encoding="utf-8"))
    return whole(golden_row)[f"egomotion_{part['chains'].index(part['warp_chain']):03d}"]


def labels_of(stored: dict[str, np.ndarray], orientation) -> MotionLabels:
    """The labels of a scene, each frame in its own frame, as a record in an orientation."""
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
    config = MotionLabelConfig(
        orientation=orientation, augmentation=augmentation_of(stored.get("aug_transform"))
    )
    return record(turned, config, flip_six_vector(stored["future_egomotions"][2:]))


def record(
    maps: dict[str, np.ndarray], config: MotionLabelConfig, egomotion: np.ndarray
) -> MotionLabels:
    dtypes = {"segmentation": np.uint8, "instance": np.int32}
    typed: dict[str, Any] = {
        name: np.array(values, dtypes.get(name, np.float32)) for name, values in maps.items()
    }
    motion = np.concatenate([np.zeros((config.receptive_field - 1, 6)), egomotion]).astype(
        np.float32
    )
    return MotionLabels(
        config=config, future_egomotion=motion, valid=np.ones(len(motion), bool), id_map={}, **typed
    )


def augmentation_of(matrix: np.ndarray | None) -> Augmentation | None:
    """What makes the left-handed matrix that the released code drew; A = flip · scale ·
    rotation.
    """
    if matrix is None:
        return None
    given = flip_pose(matrix)
    scale, flip = given[2, 2], bool(np.linalg.det(given[:2, :2]) < 0)
    turn = np.diag([1, -1 if flip else 1]) @ given[:2, :2] / scale
    found = Augmentation(rotation=np.arctan2(turn[1, 0], turn[0, 0]), scale=scale, flip=flip)
    np.testing.assert_allclose(found.matrix, given, rtol=0, atol=1e-6)
    return found


def released(labels: MotionLabels, name: str) -> np.ndarray:
    """A map of the labels in the released orientation."""
    return to_orientation(
        getattr(labels, name),
        vectors=name in VECTORS,
        source=labels.config.grid.orientation,
        target="released",
        ignore=IGNORE,
    )


def centres_of(instance: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """(T, 1, H, W) float32 centerness of the instances' centres, as docs/released_code.md, Motion
    labels, has it.
    """
    rows, columns = np.indices(instance.shape[1:])
    result = np.zeros((len(instance), 1, *instance.shape[1:]), dtype=np.float32)
    for frame, ids in enumerate(instance):
        for number in np.unique(ids[ids > 0]):
            row, column = np.argwhere(ids == number)[0]
            center = np.array([row, column]) + offset[frame, :, row, column]
            squared = ((center[0] - rows) ** 2 + (center[1] - columns) ** 2).astype(np.float32)
            np.maximum(result[frame, 0], np.exp(-squared / np.float32(9)), out=result[frame, 0])
    return result


def cells_that_differ(found: np.ndarray, expected: np.ndarray) -> int:
    assert found.shape == expected.shape
    return int((found.astype(expected.dtype) != expected).sum())


def assert_warped(found: np.ndarray, expected: np.ndarray, mode: str) -> None:
    if mode == "bilinear":
        assert_bilinear(found, expected)
    else:
        assert cells_that_differ(found, expected) <= 10 * expected.size / 80_000


def assert_bilinear(found: np.ndarray, expected: np.ndarray) -> None:
    rounded = found.astype(np.float16)
    differ = cells_that_differ(rounded, expected)
    assert differ <= 0.015 * np.count_nonzero(expected), f"{differ} cells differ"
    step = np.maximum(np.abs(np.spacing(expected)).astype(np.float32), 3e-4)
    distance = np.abs(rounded.astype(np.float32) - expected.astype(np.float32))
    assert (distance <= step * 1.001).all(), f"by up to {distance.max()}"
