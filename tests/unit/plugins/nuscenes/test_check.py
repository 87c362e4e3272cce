"""The check of a source accepts good sources, and names a mistake where the data are sufficient."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyquaternion import Quaternion
from support.nuscenes_dataroots import Dataroot, Images, write_dataroot

from deepaccident_devkit.errors import NotAvailableError, SourceError
from deepaccident_devkit.plugins.nuscenes import open_nuscenes
from deepaccident_devkit.plugins.nuscenes.check import SourceCheck, check_source, look_at
from deepaccident_devkit.plugins.nuscenes.sensor_setups import sensor_setup_report
from deepaccident_devkit.taxonomy import CAMERAS

pytestmark = pytest.mark.slow

IMAGES_UNCHECKED = "whether the images of"


def check_folder(folder: Path) -> SourceCheck:
    return look_at(open_nuscenes(folder))


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("images", ["noise", "fractal"])
def test_a_good_source_with_uninformative_images_is_not_refused(
    tmp_path: Path, images: Images, seed: int
) -> None:
    dataroot = write_dataroot(tmp_path / "road", images=images, points=True, seed=seed)
    check = check_folder(dataroot.folder)
    assert list(check.faults()) == []
    [unchecked] = check.unchecked()
    assert unchecked.startswith(f"{IMAGES_UNCHECKED} {', '.join(CAMERAS)}")


@pytest.mark.parametrize("keyframes", [1, 2, 3])
def test_few_keyframes_decide_nothing(tmp_path: Path, keyframes: int) -> None:
    dataroot = write_dataroot(
        tmp_path / "road", keyframes=keyframes, splits=("train",), points=True, images="noise"
    )
    mirror_boxes(dataroot)
    dataroot.write()
    check = check_folder(dataroot.folder)
    assert [fault for fault in check.faults() if "mirrored" not in fault] == []
    assert len(list(check.unchecked())) >= 3


def mirror_boxes(dataroot: Dataroot) -> None:
    """Change the sign of each box's y in its sample's ego frame."""
    poses = {pose["token"]: pose for pose in dataroot.tables["ego_pose"]}
    pose_of_sample = {
        row["sample_token"]: poses[row["ego_pose_token"]]
        for row in dataroot.tables["sample_data"]
        if "/LIDAR_TOP/" in row["filename"] and row["is_key_frame"]
    }
    for box in dataroot.tables["sample_annotation"]:
        pose = pose_of_sample[box["sample_token"]]
        rotation = Quaternion(pose["rotation"])
        ego_yaw = rotation.yaw_pitch_roll[0]
        x, y, z = rotation.inverse.rotate(np.subtract(box["translation"], pose["translation"]))
        box["translation"] = np.add(rotation.rotate([x, -y, z]), pose["translation"]).tolist()
        yaw = 2 * ego_yaw - Quaternion(box["rotation"]).yaw_pitch_roll[0]
        box["rotation"] = Quaternion(axis=[0, 0, 1], radians=yaw).elements.tolist()


def turn_axes(dataroot: Dataroot) -> None:
    """Turn the ego frame so that its y points forward."""
    turn = Quaternion(axis=[0, 0, 1], degrees=-90)
    back = turn.inverse
    for pose in dataroot.tables["ego_pose"]:
        pose["rotation"] = (Quaternion(pose["rotation"]) * turn).elements.tolist()
    for mount in dataroot.tables["calibrated_sensor"]:
        mount["rotation"] = (back * Quaternion(mount["rotation"])).elements.tolist()
        mount["translation"] = back.rotate(np.array(mount["translation"])).tolist()


def sink_everything(dataroot: Dataroot) -> None:
    for pose in dataroot.tables["ego_pose"]:
        pose["translation"][2] += 1.2
    for mount in dataroot.tables["calibrated_sensor"]:
        mount["translation"][2] -= 1.2


def swap_cameras(dataroot: Dataroot) -> None:
    names = {"CAM_FRONT_LEFT": "CAM_FRONT_RIGHT", "CAM_FRONT_RIGHT": "CAM_FRONT_LEFT"}
    for sensor in dataroot.tables["sensor"]:
        sensor["channel"] = names.get(sensor["channel"], sensor["channel"])


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed) for seed in (1, 2))])
@pytest.mark.parametrize(
    ("plant_mistake", "message"),
    [
        (mirror_boxes, r"y is mirrored: \d+% of the boxes contain points"),
        (turn_axes, "x is not forward: the ego moves"),
        (sink_everything, r"everything lies 1\.2 m too low"),
        (
            swap_cameras,
            "cameras are in another order: Camera_FrontLeft looks where Camera_FrontRight should",
        ),
    ],
)
def test_a_mistake_is_named_and_no_other(
    tmp_path: Path, plant_mistake, message: str, seed: int
) -> None:
    """Images of noise must not outweigh what points and poses show."""
    dataroot = write_dataroot(
        tmp_path / "road", images="noise", points=True, seed=seed, keyframes=6, boxes=24
    )
    plant_mistake(dataroot)
    dataroot.write()
    [fault] = check_folder(dataroot.folder).faults()
    assert re.search(message, fault)
    with pytest.raises(SourceError, match=r"correct this before you train"):
        check_source(open_nuscenes(dataroot.folder))


def test_unchecked_facts_are_logged(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    folder = write_dataroot(tmp_path / "road", splits=("train",), keyframes=3).folder
    check_source(open_nuscenes(folder))
    for part in (
        str(folder),
        "could not be checked",
        "x is forward",
        "how high",
        "y is to the left",
        IMAGES_UNCHECKED,
    ):
        assert part in caplog.text


def make_check(**changes: Any) -> SourceCheck:
    """Make the check of a good source of 24 samples with uninformative images, apart from
    changes.
    """
    values = {
        "turns": np.zeros(24),
        "road": np.zeros(24),
        "boxes": np.zeros(24),
        "lidar": 1.8,
        "looks": np.array([0.0, 55, -55, 180, 110, -110]),
        "occupied": np.ones((50, 2)),
        "contrasts": np.full((24, 6, 6), np.nan),
    }
    return SourceCheck(**{**values, **changes})


def test_images_reveal_an_order_that_nothing_else_reveals() -> None:
    """In all samples, a camera's boxes stand out in the image of another camera."""
    rng = np.random.default_rng(0)
    contrasts = rng.normal(size=(24, 6, 6))
    contrasts[:, range(6), [0, 2, 1, 3, 4, 5]] += 3
    [fault] = make_check(contrasts=contrasts).faults()
    assert "Camera_FrontRight shows what Camera_FrontLeft should" in fault
    assert fault.count(" shows ") == 2


def test_a_car_that_reverses_is_no_turned_axis() -> None:
    turns = np.where(np.arange(60) % 2, 179.0, 1.0)
    assert list(make_check(turns=turns).faults()) == []


def test_without_labels_nothing_can_be_checked(tmp_path: Path) -> None:
    release = open_nuscenes(write_dataroot(tmp_path / "road", boxes=0).folder)
    for examine in (look_at, sensor_setup_report):
        with pytest.raises(NotAvailableError, match=r"ego_vehicle has no labels"):
            examine(release)
