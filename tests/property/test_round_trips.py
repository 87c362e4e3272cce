"""read(write(x)) == x for every kind of file."""

import json
from dataclasses import fields
from pathlib import Path

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.testing import assert_allclose, assert_array_equal
from strategies import boxes, calibs, clouds, labels, metas

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


def assert_same_labels(have: Labels, want: Labels) -> None:
    """Equal to the bit (0.0 and −0.0 apart), types included."""
    for field in fields(Labels):
        mine, theirs = getattr(have, field.name), getattr(want, field.name)
        assert np.asarray(mine).dtype == np.asarray(theirs).dtype, field.name
        assert_array_equal(mine, theirs, err_msg=field.name)


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
    for name, y in {
        "center": [1, -1, 1],
        "velocity": [1, -1],
        "agent_velocity": [1, -1],
        "yaw": -1,
        "size": 1,
    }.items():
        assert_array_equal(getattr(other, name), getattr(given_labels, name) * y)


@given(st.lists(labels(), max_size=4))
def test_many_labels_are_the_files_one_after_another(scratch: Path, several: list[Labels]) -> None:
    paths = [scratch / f"label_{number}.txt" for number in range(len(several))]
    for path, one in zip(paths, several, strict=True):
        write_label(path, one)
    together = read_labels(paths)
    apart = [read_label(path) for path in paths]
    for field in fields(Labels):
        if field.name != "raw":
            have = getattr(together, field.name)
            assert_array_equal(
                have, np.concatenate([have[:0], *[getattr(one, field.name) for one in apart]])
            )


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
    cameras = [[calib.camera_from_lidar[camera].matrix for camera in CAMERAS] for calib in several]
    assert_array_equal(stacked.camera_from_lidar, cameras)
    assert_array_equal(
        stacked.intrinsic, [[calib.intrinsic[camera] for camera in CAMERAS] for calib in several]
    )


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
    down, right = np.linspace(0, 1, 24)[:, None, None], np.linspace(0, 1, 40)[None, :, None]
    top, bottom = (corners[row, 0] * (1 - right) + corners[row, 1] * right for row in (0, 1))
    image = (top * (1 - down) + bottom * down).round().astype(np.uint8)
    write_image(scratch / "image.jpg", image)
    read = read_image(scratch / "image.jpg")
    assert read.shape == image.shape
    assert read.dtype == np.uint8
    # chroma is stored at half resolution, so edges of saturated colours are off by more than the
    # middle
    assert np.abs(read.astype(int) - image).mean() < 4
    assert np.abs(read.astype(int) - image).max() < 40


@given(given_boxes=boxes(), number=st.integers(0, 69))
def test_detections_through_a_nuscenes_file(
    scratch: Path, da_motion: DeepAccident, given_boxes: Boxes, number: int
) -> None:
    """From an agent's LiDAR to the world, through the file, and back."""
    sample = da_motion.samples("train", "all")[number]
    world_from_lidar = da_motion.world_from(sample, "lidar")
    world = given_boxes.transform(world_from_lidar, "world")
    theirs, scores = token("sample", sample), np.linspace(-1, 2, len(world))
    entries = detection_entries(theirs, DetectedBoxes(boxes=world, scores=scores))
    (scratch / "nuscenes.json").write_text(json.dumps({"results": {theirs: entries}}))
    found = results_from_nuscenes(da_motion, scratch / "nuscenes.json").boxes[sample]
    assert_array_equal(found.scores, scores)
    for name in ("center", "size", "category"):
        assert_array_equal(getattr(found.boxes, name), getattr(world, name), err_msg=name)
    assert_array_equal(found.boxes.velocity[:, :2], world.velocity[:, :2])
    back = found.boxes.transform(world_from_lidar.inverse(), "lidar")
    assert_allclose(back.center, given_boxes.center, rtol=0, atol=1e-9)
    rotations = (quaternions.to_matrix(each.rotation) for each in (back, given_boxes))
    assert_allclose(*rotations, rtol=0, atol=1e-9)
