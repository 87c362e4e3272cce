"""Breakages of folders and of sensors' files."""

from pathlib import Path

import numpy as np

from deepaccident_devkit.errors import BrokenReleaseError, MissingFileError, SensorFileError, SplitFileError
from deepaccident_devkit.release import read_image, write_image
from deepaccident_devkit.release.store import real_path
from deepaccident_devkit.taxonomy import BEV_CAMERA, LIDAR, SPLITS
from deepaccident_devkit.testing.breakages.kinds import Group, Victim
from deepaccident_devkit.testing.editing import ENDINGS

BROKEN = Group("release", opening=BrokenReleaseError)
ODD = Group("release")
SPLIT_FILES = Group("release", opening=SplitFileError, reading=SplitFileError)


@BROKEN.enter("frames-missing")
def label_missing(victim: Victim) -> Path:
    """A label file of one frame is missing."""
    victim.editor.remove(victim.file("label"))
    return victim.file("label")


@BROKEN.enter("frames-missing")
def calib_missing(victim: Victim) -> Path:
    """A calib file of one frame is missing."""
    victim.editor.remove(victim.file("calib"))
    return victim.file("calib")


@BROKEN.enter("frames-missing", "sensor-frames-missing")
def frame_lost(victim: Victim) -> Path:
    """An agent lacks all files of a frame."""
    for kind in ENDINGS:
        if victim.file(kind).exists():
            victim.editor.remove(victim.file(kind))
    return victim.file("calib")


@BROKEN.enter("frames-missing", "odd-name")
def frame_number_short(victim: Victim) -> Path:
    """A label file's name has two digits for the frame."""
    path = victim.file("label")
    victim.editor.rename(path, path.name.replace(f"_{victim.frame:03d}.", f"_{victim.frame:02d}."))
    return path


@BROKEN.enter("agent-unlabelled", "folder-unreadable")
def folder_is_a_file(victim: Victim) -> Path:
    """A file is where an agent's folder of labels must be."""
    folder = victim.editor.folder(victim.agent, "label")
    victim.editor.remove_folder(folder)
    victim.editor.write(folder, b"")
    return folder


@BROKEN.enter("two-places")
def scenario_twice(victim: Victim) -> Path:
    """A scenario is also in the folder of a second split."""
    scenario = victim.editor.scenario
    root = real_path(scenario.root)
    start = root / scenario.folder
    copy = root / ("val" if scenario.folder != "val" else "train")
    for path in sorted((start / scenario.scenario_type).rglob(f"{scenario.name}*")):
        if path.is_file():
            victim.editor.write(copy / path.relative_to(start), path.read_bytes())
    return copy / scenario.scenario_type


@ODD.enter("labels-without-calib")
def agent_half_unpacked(victim: Victim) -> Path:
    """An agent has labels and sensor files, but no calib files."""
    folder = victim.editor.folder(victim.agent, "calib")
    victim.editor.remove_folder(folder)
    return folder


@ODD.enter("agent-unlabelled")
def agent_unlabelled(victim: Victim) -> Path:
    """An agent has no labels, but the others have."""
    folder = victim.editor.folder(victim.agent, "label")
    victim.editor.remove_folder(folder)
    return folder


@ODD.enter("ids-differ", "meta-pair", "own-box-apart", "sizes-differ")
def agents_swapped(victim: Victim) -> Path:
    """All folders of two vehicles are swapped."""
    for kind in ENDINGS:
        for frame in victim.editor.frames:
            files = [victim.editor.file(agent, kind, frame) for agent in (victim.agent, victim.other)]
            if all(path.exists() for path in files):
                victim.editor.exchange(*files)
    return victim.editor.folder(victim.agent, "calib").parents[1]


@ODD.enter("positions-differ", "velocity-off")
def frames_swapped(victim: Victim) -> Path:
    """Two frames' label files of an agent are swapped."""
    frames = victim.editor.frames
    victim.editor.exchange(*(victim.editor.file(victim.agent, "label", frame) for frame in (frames[0], frames[-1])))
    return victim.editor.folder(victim.agent, "label")


@SPLIT_FILES.enter("split-file-unreadable")
def split_file_garbled(victim: Victim) -> Path:
    """A split file has a line of one word."""
    path = victim.editor.root / "val.txt"
    victim.editor.write(path, path.read_bytes() + b"Town03\n")
    return path


@ODD.enter("split-file-repeats")
def split_line_twice(victim: Victim) -> Path:
    """A split file lists a scenario twice."""
    files = (victim.editor.root / f"{split}.txt" for split in SPLITS)
    path = max(files, key=lambda path: path.stat().st_size)  # files of splits that were not made are empty
    victim.editor.write(path, path.read_bytes() * 2)
    return path


SENSOR_FORM = Group("sensor", reading=SensorFileError, deep=True)
SENSOR_MEANING = Group("sensor", deep=True)
SENSOR_MISSING = Group("sensor", reading=MissingFileError)
CAMERA = "Camera_Front"


def _half(content: bytes) -> bytes:
    return content[: len(content) // 2]


@SENSOR_FORM.enter("sensor-unreadable", channel=CAMERA)
def image_cut(victim: Victim) -> Path:
    """An image file ends in the middle."""
    return victim.replace(CAMERA, _half)


@SENSOR_FORM.enter("sensor-empty", "sensor-unreadable", channel=CAMERA)
def image_empty(victim: Victim) -> Path:
    """An image file has no bytes."""
    return victim.replace(CAMERA, lambda _: b"")


@SENSOR_MISSING.enter("sensor-frames-missing", channel=CAMERA)
def image_missing(victim: Victim) -> Path:
    """An image file is missing."""
    victim.editor.remove(victim.file(CAMERA))
    return victim.file(CAMERA)


@SENSOR_MEANING.enter("image-size", channel=CAMERA)
def image_wrong_size(victim: Victim) -> Path:
    """An image is twice as large as its K says."""
    path = victim.file(CAMERA)
    image = read_image(path)
    victim.editor.changing(path)
    write_image(path, np.ascontiguousarray(image.repeat(2, axis=0).repeat(2, axis=1)))
    return path


@SENSOR_FORM.enter("sensor-unreadable", channel=LIDAR)
def lidar_cut(victim: Victim) -> Path:
    """An npz file of points ends in the middle."""
    return victim.replace(LIDAR, _half)


@SENSOR_FORM.enter("sensor-unreadable", channel=LIDAR)
def lidar_three_columns(victim: Victim) -> Path:
    """A point cloud lacks the intensity."""
    points = victim.editor.array(victim.agent, LIDAR, victim.frame)
    victim.editor.write_array(victim.agent, LIDAR, victim.frame, points[:, :3])
    return victim.file(LIDAR)


@SENSOR_FORM.enter("sensor-unreadable", channel=LIDAR)
def lidar_objects(victim: Victim) -> Path:
    """A point cloud is an array of Python objects, which only a pickle can load."""
    points = victim.editor.array(victim.agent, LIDAR, victim.frame)
    victim.editor.write_array(victim.agent, LIDAR, victim.frame, points.astype(object))
    return victim.file(LIDAR)


@SENSOR_MEANING.enter("points-differ", channel=LIDAR)
def lidar_right_handed(victim: Victim) -> Path:
    """A point cloud has the other handedness."""
    points = victim.editor.array(victim.agent, LIDAR, victim.frame)
    victim.editor.write_array(victim.agent, LIDAR, victim.frame, points * np.array([1, -1, 1, 1], dtype=np.float32))
    return victim.file(LIDAR)


@SENSOR_FORM.enter("sensor-unreadable", channel=BEV_CAMERA)
def bev_cut(victim: Victim) -> Path:
    """An npz file of the BEV camera ends in the middle."""
    return victim.replace(BEV_CAMERA, _half)


@SENSOR_FORM.enter("sensor-unreadable", channel=BEV_CAMERA)
def bev_half_size(victim: Victim) -> Path:
    """A BEV array has 600 rows and columns."""
    picture = victim.editor.array(victim.agent, BEV_CAMERA, victim.frame)
    victim.editor.write_array(victim.agent, BEV_CAMERA, victim.frame, picture[::2, ::2])
    return victim.file(BEV_CAMERA)


@SENSOR_MEANING.enter("bev-orientation", channel=BEV_CAMERA)
def bev_mirrored(victim: Victim) -> Path:
    """An agent's BEV arrays are mirrored, left to right."""
    for frame in victim.editor.frames:
        picture = victim.editor.array(victim.agent, BEV_CAMERA, frame)
        victim.editor.write_array(victim.agent, BEV_CAMERA, frame, picture[:, ::-1])
    return victim.editor.folder(victim.agent, BEV_CAMERA)
