"""read(write(x)) == x for every kind of file."""

import json
from dataclasses import fields
from pathlib import Path

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.testing import assert_allclose, assert_array_equal
from support.strategies import boxes, calibs, clouds, labels, metas

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation import DetectedBoxes
from deepaccident_devkit.evaluation.results.writer import detection_entries
from deepaccident_devkit.export.nuscenes.detections import results_from_nuscenes
from deepaccident_devkit.export.nuscenes.scenes import token
from deepaccident_devkit.geometry import Boxes, LidarPointCloud, quaternions
from deepaccident_devkit.release import (
    Calib,
    Labels,
    Meta,
    read_bev,
    read_calib,
    read_calibs,
    read_image,
    read_label,
    read_labels,
    read_lidar,
    read_meta,
    read_split_file,
    write_bev,
    write_calib,
    write_image,
    write_label,
    write_lidar,
    write_meta,
    write_split_file,
)
from deepaccident_devkit.taxonomy import BEV_SHAPE, CAMERAS


def assert_same_labels(actual: Labels, expected: Labels) -> None:
    """Check that values are equal to the bit (except 0.0 and −0.0) and have the same types."""
    for field in fields(Labels):
        value = getattr(actual, field.name)
        expected_value = getattr(expected, field.name)
        assert np.asarray(value).dtype == np.asarray(expected_value).dtype, field.name
        assert_array_equal(value, expected_value, err_msg=field.name)


@given(labels())
def test_label(scratch: Path, given_labels: Labels) -> None:
    write_label(scratch / "label.txt", given_labels)
    assert_same_labels(read_label(scratch / "label.txt", raw=given_labels.raw), given_labels)


@given(labels())
def test_label_in_the_other_handedness_is_the_same_boxes(
    scratch: Path, given_labels: Labels
) -> None:
    write_label(scratch / "label.txt", given_labels)
    other = read_label(scratch / "label.txt", raw=not given_labels.raw)
    signs_by_field = {
        "center": [1, -1, 1],
        "velocity": [1, -1],
        "agent_velocity": [1, -1],
        "yaw": -1,
        "size": 1,
    }
    for name, signs in signs_by_field.items():
        assert_array_equal(getattr(other, name), getattr(given_labels, name) * signs)


@given(st.lists(labels(), max_size=4))
def test_many_labels_are_the_files_one_after_another(scratch: Path, several: list[Labels]) -> None:
    paths = [scratch / f"label_{number}.txt" for number in range(len(several))]
    for path, file_labels in zip(paths, several, strict=True):
        write_label(path, file_labels)
    stacked = read_labels(paths)
    labels_by_file = [read_label(path) for path in paths]
    for field in fields(Labels):
        if field.name != "raw":
            values = getattr(stacked, field.name)
            file_values = [getattr(file_labels, field.name) for file_labels in labels_by_file]
            assert_array_equal(values, np.concatenate([values[:0], *file_values]))


@given(metas())
def test_meta(scratch: Path, meta: Meta) -> None:
    write_meta(scratch / "meta.txt", meta)
    assert read_meta(scratch / "meta.txt") == meta


@settings(max_examples=25)
@given(st.lists(calibs(), min_size=1, max_size=2))
def test_calib(scratch: Path, several: list[Calib]) -> None:
    paths = [scratch / f"{number}.pkl" for number in range(len(several))]
    for path, calib in zip(paths, several, strict=True):
        write_calib(path, calib)
        read = read_calib(path)
        assert_array_equal(read.ego_from_lidar.matrix, calib.ego_from_lidar.matrix)
        assert_array_equal(read.world_from_ego.matrix, calib.world_from_ego.matrix)
        for camera in CAMERAS:
            assert_array_equal(
                read.camera_from_lidar[camera].matrix, calib.camera_from_lidar[camera].matrix
            )
            assert_array_equal(read.intrinsic[camera], calib.intrinsic[camera])
    stacked = read_calibs(paths)
    assert len(stacked) == len(several)
    assert_array_equal(stacked.ego_from_lidar, [calib.ego_from_lidar.matrix for calib in several])
    assert_array_equal(stacked.world_from_ego, [calib.world_from_ego.matrix for calib in several])
    camera_poses = [
        [calib.camera_from_lidar[camera].matrix for camera in CAMERAS] for calib in several
    ]
    assert_array_equal(stacked.camera_from_lidar, camera_poses)
    intrinsics = [[calib.intrinsic[camera] for camera in CAMERAS] for calib in several]
    assert_array_equal(stacked.intrinsic, intrinsics)


@given(clouds())
def test_lidar(scratch: Path, cloud: LidarPointCloud) -> None:
    write_lidar(scratch / "points.npz", cloud.xyz, cloud.intensity)
    read = read_lidar(scratch / "points.npz")
    assert read.frame == "lidar"
    assert_array_equal(read.xyz, cloud.xyz)
    assert_array_equal(read.intensity, cloud.intensity)
    assert_array_equal(read_lidar(scratch / "points.npz", raw=True), cloud.points * [1, -1, 1, 1])


@settings(max_examples=3)
@given(st.integers(0, 2**32 - 1))
def test_bev(scratch: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    semantic = rng.integers(0, 23, BEV_SHAPE, dtype=np.uint8)
    instance = rng.integers(0, 2**16, BEV_SHAPE, dtype=np.uint16)
    write_bev(scratch / "bev.npz", semantic, instance)
    read = read_bev(scratch / "bev.npz")
    assert_array_equal(read.semantic, semantic)
    assert_array_equal(read.instance, instance)
    assert (read.semantic.dtype, read.instance.dtype) == (np.uint8, np.uint16)
    raw = read_bev(scratch / "bev.npz", raw=True)
    assert_array_equal(raw[..., 2], semantic)
    assert_array_equal(raw[..., 1] + 256 * raw[..., 0].astype(int), instance)


_words = st.text("abcTown0123456789_", min_size=1, max_size=12)


@given(st.lists(st.tuples(_words, _words), unique=True, max_size=6))
def test_split_file(scratch: Path, pairs: list[tuple[str, str]]) -> None:
    tokens = ["/".join(pair) for pair in pairs]
    write_split_file(scratch / "train.txt", tokens)
    assert read_split_file(scratch / "train.txt") == tokens


@given(hnp.arrays(np.float64, (2, 2, 3), elements=st.floats(0, 255)))
def test_image_within_jpegs_tolerance(scratch: Path, corners: np.ndarray) -> None:
    """A smooth picture comes back within a few levels; colours and sides keep their places."""
    down = np.linspace(0, 1, 24)[:, None, None]
    right = np.linspace(0, 1, 40)[None, :, None]
    left_edge = corners[0, 0] * (1 - down) + corners[1, 0] * down
    right_edge = corners[0, 1] * (1 - down) + corners[1, 1] * down
    image = (left_edge * (1 - right) + right_edge * right).round().astype(np.uint8)
    write_image(scratch / "image.jpg", image)
    read = read_image(scratch / "image.jpg")
    assert read.shape == image.shape
    assert read.dtype == np.uint8
    # chroma is stored at half resolution, so edges of saturated colours are off by more
    errors = np.abs(read.astype(int) - image)
    assert errors.mean() < 4
    assert errors.max() < 40


@given(given_boxes=boxes(), number=st.integers(0, 69))
def test_detections_through_a_nuscenes_file(
    scratch: Path, da_motion: DeepAccident, given_boxes: Boxes, number: int
) -> None:
    """The boxes go from an agent's LiDAR to the world, through the file, and back."""
    sample = da_motion.samples("train", "all")[number]
    world_from_lidar = da_motion.world_from(sample, "lidar")
    world_boxes = given_boxes.transform(world_from_lidar, "world")
    scores = np.linspace(-1, 2, len(world_boxes))
    nuscenes_token = token("sample", sample)
    entries = detection_entries(nuscenes_token, DetectedBoxes(boxes=world_boxes, scores=scores))
    path = scratch / "nuscenes.json"
    path.write_text(json.dumps({"results": {nuscenes_token: entries}}))

    detections = results_from_nuscenes(da_motion, path).boxes[sample]
    assert_array_equal(detections.scores, scores)
    read_boxes = detections.boxes
    for name in ("center", "size", "category"):
        assert_array_equal(getattr(read_boxes, name), getattr(world_boxes, name), err_msg=name)
    assert_array_equal(read_boxes.velocity[:, :2], world_boxes.velocity[:, :2])
    lidar_boxes = read_boxes.transform(world_from_lidar.inverse(), "lidar")
    assert_allclose(lidar_boxes.center, given_boxes.center, rtol=0, atol=1e-9)
    rotation = quaternions.to_matrix(lidar_boxes.rotation)
    expected_rotation = quaternions.to_matrix(given_boxes.rotation)
    assert_allclose(rotation, expected_rotation, rtol=0, atol=1e-9)
