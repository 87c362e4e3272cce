"""The check of a source: a good one is never refused, a mistake is named where the data suffice to
tell.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nuscenes_dataroots import Dataroot, Images, write_dataroot
from pyquaternion import Quaternion

from deepaccident_devkit.errors import NotAvailableError, SourceError
from deepaccident_devkit.plugins.nuscenes import open_nuscenes
from deepaccident_devkit.plugins.nuscenes.check import SourceCheck, check_source, look_at
from deepaccident_devkit.plugins.nuscenes.sensor_setups import sensor_setup_report
from deepaccident_devkit.taxonomy import CAMERAS

pytestmark = pytest.mark.slow

IMAGES_UNKNOWN = "whether the images are those of"


def looked(folder: Path) -> SourceCheck:
    return look_at(open_nuscenes(folder))


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("images", ["noise", "fractal"])
def test_a_good_source_with_images_that_say_nothing_is_not_refused(
    tmp_path: Path, images: Images, seed: int
) -> None:
    check = looked(write_dataroot(tmp_path / "road", images=images, points=True, seed=seed).folder)
    assert list(check.faults()) == []
    [unchecked] = check.unchecked()
    assert unchecked.startswith(f"{IMAGES_UNKNOWN} {', '.join(CAMERAS)}")


@pytest.mark.parametrize("keyframes", [1, 2, 3])
def test_few_keyframes_decide_nothing(tmp_path: Path, keyframes: int) -> None:
    made = write_dataroot(
        tmp_path / "road", keyframes=keyframes, splits=("train",), points=True, images="noise"
    )
    mirror(made)
    made.write()
    check = looked(made.folder)
    assert [fault for fault in check.faults() if "mirrored" not in fault] == []
    assert len(list(check.unchecked())) >= 3


def mirror(made: Dataroot) -> None:
    """Boxes of each sample have the other y in its ego frame."""
    poses = {row["token"]: row for row in made.tables["ego_pose"]}
    pose_of = {
        row["sample_token"]: poses[row["ego_pose_token"]]
        for row in made.tables["sample_data"]
        if "/LIDAR_TOP/" in row["filename"] and row["is_key_frame"]
    }
    for row in made.tables["sample_annotation"]:
        pose = pose_of[row["sample_token"]]
        turn = Quaternion(pose["rotation"])
        x, y, z = turn.inverse.rotate(np.subtract(row["translation"], pose["translation"]))
        row["translation"] = np.add(turn.rotate([x, -y, z]), pose["translation"]).tolist()
        yaw = turn.yaw_pitch_roll[0] - (
            Quaternion(row["rotation"]).yaw_pitch_roll[0] - turn.yaw_pitch_roll[0]
        )
        row["rotation"] = Quaternion(axis=[0, 0, 1], radians=yaw).elements.tolist()


def turn_axes(made: Dataroot) -> None:
    """The ego's y is forward."""
    for pose in made.tables["ego_pose"]:
        pose["rotation"] = (
            Quaternion(pose["rotation"]) * Quaternion(axis=[0, 0, 1], degrees=-90)
        ).elements.tolist()
    for mount in made.tables["calibrated_sensor"]:
        back = Quaternion(axis=[0, 0, 1], degrees=90)
        mount["rotation"] = (back * Quaternion(mount["rotation"])).elements.tolist()
        mount["translation"] = back.rotate(np.array(mount["translation"])).tolist()


def sink(made: Dataroot) -> None:
    for pose in made.tables["ego_pose"]:
        pose["translation"][2] += 1.2
    for mount in made.tables["calibrated_sensor"]:
        mount["translation"][2] -= 1.2


def swap_cameras(made: Dataroot) -> None:
    names = {"CAM_FRONT_LEFT": "CAM_FRONT_RIGHT", "CAM_FRONT_RIGHT": "CAM_FRONT_LEFT"}
    for sensor in made.tables["sensor"]:
        sensor["channel"] = names.get(sensor["channel"], sensor["channel"])


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed) for seed in (1, 2))])
@pytest.mark.parametrize(
    ("plant", "words"),
    [
        (mirror, "y is mirrored: points lie in"),
        (turn_axes, "x is not forward: the ego moves"),
        (sink, "sunk by 1.2 m"),
        (
            swap_cameras,
            "cameras are in another order: Camera_FrontLeft looks where Camera_FrontRight should",
        ),
    ],
)
def test_a_mistake_is_named_and_no_other(tmp_path: Path, plant, words: str, seed: int) -> None:
    """Images are noise: they do not speak against what points and poses say."""
    made = write_dataroot(
        tmp_path / "road", images="noise", points=True, seed=seed, keyframes=6, boxes=24
    )
    plant(made)
    made.write()
    [fault] = looked(made.folder).faults()
    assert words in fault
    with pytest.raises(SourceError, match=r"mend it first"):
        check_source(open_nuscenes(made.folder))


def test_what_could_not_be_checked_is_said(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = write_dataroot(tmp_path / "road", splits=("train",), keyframes=3).folder
    check_source(open_nuscenes(folder))
    for words in (
        str(folder),
        "could not be checked",
        "x is forward",
        "how high",
        "y is to the left",
        IMAGES_UNKNOWN,
    ):
        assert words in caplog.text


def check_of(**changes: Any) -> SourceCheck:
    """A good source of 24 samples whose images say nothing, but for some changes."""
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


def test_images_tell_an_order_that_nothing_else_tells() -> None:
    """A camera's boxes stand out in the image of another one, in all samples."""
    rng = np.random.default_rng(0)
    contrasts = rng.normal(size=(24, 6, 6))
    contrasts[:, range(6), [0, 2, 1, 3, 4, 5]] += 3
    [fault] = check_of(contrasts=contrasts).faults()
    assert "Camera_FrontRight shows what Camera_FrontLeft should" in fault
    assert fault.count(" shows ") == 2


def test_a_car_that_reverses_is_no_turned_axis() -> None:
    turns = np.where(np.arange(60) % 2, 179.0, 1.0)
    assert list(check_of(turns=turns).faults()) == []


def test_without_labels_nothing_can_be_seen(tmp_path: Path) -> None:
    road = open_nuscenes(write_dataroot(tmp_path / "road", boxes=0).folder)
    for look in (look_at, sensor_setup_report):
        with pytest.raises(NotAvailableError, match=r"ego_vehicle has no labels"):
            look(road)
