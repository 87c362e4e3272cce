"""Files of sensors that cannot be read, are missing, or show something else than the labels."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from deepaccident_devkit.errors import MissingFileError, SensorFileError
from deepaccident_devkit.release import read_image, write_image
from deepaccident_devkit.support.arrays import AnyArray
from deepaccident_devkit.taxonomy import BEV_CAMERA, LIDAR
from deepaccident_devkit.testing.breakages.kinds import Group, Victim

FORM = Group("sensor", reading=SensorFileError, deep=True)
MEANING = Group("sensor", deep=True)
MISSING = Group("sensor", reading=MissingFileError)
CAMERA = "Camera_Front"


def _half(content: bytes) -> bytes:
    return content[: len(content) // 2]


def _rewritten(victim: Victim, channel: str, change: Callable[[AnyArray], AnyArray]) -> Path:
    """The file of the victim's array, which is another one now."""
    array = victim.editor.array(victim.agent, channel, victim.frame)
    victim.editor.write_array(victim.agent, channel, victim.frame, change(array))
    return victim.file(channel)


@FORM.enter("sensor-unreadable", channel=CAMERA)
def image_cut(victim: Victim) -> Path:
    """An image file ends in the middle."""
    return victim.replace(CAMERA, _half)


@FORM.enter("sensor-empty", "sensor-unreadable", channel=CAMERA)
def image_empty(victim: Victim) -> Path:
    """An image file has no bytes."""
    return victim.replace(CAMERA, lambda _: b"")


@MISSING.enter("sensor-frames-missing", channel=CAMERA)
def image_missing(victim: Victim) -> Path:
    """An image file is missing."""
    victim.editor.remove(victim.file(CAMERA))
    return victim.file(CAMERA)


@MEANING.enter("image-size", channel=CAMERA)
def image_wrong_size(victim: Victim) -> Path:
    """An image is twice as large as its K says."""
    path = victim.file(CAMERA)
    image = read_image(path)
    victim.editor.changing(path)
    write_image(path, np.ascontiguousarray(image.repeat(2, axis=0).repeat(2, axis=1)))
    return path


@FORM.enter("sensor-unreadable", channel=LIDAR)
def lidar_cut(victim: Victim) -> Path:
    """An npz file of points ends in the middle."""
    return victim.replace(LIDAR, _half)


@FORM.enter("sensor-unreadable", channel=LIDAR)
def lidar_three_columns(victim: Victim) -> Path:
    """A point cloud lacks the intensity."""
    return _rewritten(victim, LIDAR, lambda points: points[:, :3])


@FORM.enter("sensor-unreadable", channel=LIDAR)
def lidar_objects(victim: Victim) -> Path:
    """A point cloud is an array of Python objects, which only a pickle can load."""
    return _rewritten(victim, LIDAR, lambda points: points.astype(object))


@MEANING.enter("points-differ", channel=LIDAR)
def lidar_right_handed(victim: Victim) -> Path:
    """A point cloud has the other handedness."""
    return _rewritten(victim, LIDAR, lambda points: points * np.array([1, -1, 1, 1], dtype=np.float32))


@FORM.enter("sensor-unreadable", channel=BEV_CAMERA)
def bev_cut(victim: Victim) -> Path:
    """An npz file of the BEV camera ends in the middle."""
    return victim.replace(BEV_CAMERA, _half)


@FORM.enter("sensor-unreadable", channel=BEV_CAMERA)
def bev_half_size(victim: Victim) -> Path:
    """A BEV array has 600 rows and columns."""
    return _rewritten(victim, BEV_CAMERA, lambda picture: picture[::2, ::2])


@MEANING.enter("bev-orientation", channel=BEV_CAMERA)
def bev_mirrored(victim: Victim) -> Path:
    """An agent's BEV arrays are mirrored, left to right."""
    for frame in victim.editor.frames:
        picture = victim.editor.array(victim.agent, BEV_CAMERA, frame)
        victim.editor.write_array(victim.agent, BEV_CAMERA, frame, picture[:, ::-1])
    return victim.editor.folder(victim.agent, BEV_CAMERA)
