"""Breakages of label, calib, meta and sensor files: missing, unreadable, dangerous or wrong."""

from pathlib import Path

import numpy as np

from deepaccident_devkit.errors import (
    BrokenReleaseError,
    CalibError,
    LabelError,
    MetaError,
    MissingFileError,
    SensorFileError,
)
from deepaccident_devkit.release import read_image, write_image
from deepaccident_devkit.release.store import real_path
from deepaccident_devkit.taxonomy import BEV_CAMERA, LIDAR, OWN_ACTOR_ID
from deepaccident_devkit.testing.breakages.breakage import FIELD, BreakageGroup, Victim

LABEL_FORM = BreakageGroup("label", opening=BrokenReleaseError, reading=LabelError)
LABEL_MEANING = BreakageGroup("label")


def _first_half(content: bytes) -> bytes:
    return content[: len(content) // 2]


def _set_field(victim: Victim, name: str, word: str) -> Path:
    """Replace one word of the last box line."""
    rows = victim.read_rows()
    rows[-1][FIELD[name]] = word
    return victim.write_rows(rows)


@LABEL_FORM.enter("label-unreadable")
def label_empty(victim: Victim) -> Path:
    """A label file has no bytes."""
    return victim.overwrite("label", b"")


@LABEL_FORM.enter("label-unreadable")
def label_garbage(victim: Victim) -> Path:
    """A label file contains a picture's bytes."""
    return victim.overwrite("label", b"\xff\xd8\xff\xe0\x00\x10JFIF\x00\x01" * 20)


@LABEL_FORM.enter("label-unreadable")
def label_cut(victim: Victim) -> Path:
    """A label file ends within a line."""
    return victim.replace("label", lambda content: content[:-25])


@LABEL_FORM.enter("label-unreadable")
def label_zeros(victim: Victim) -> Path:
    """The second half of a label file is zero bytes, as after a write to a full disk."""

    def clear_second_half(content: bytes) -> bytes:
        half = len(content) // 2
        return content[:half] + bytes(half)

    return victim.replace("label", clear_second_half)


@LABEL_FORM.enter("label-unreadable")
def label_no_header(victim: Victim) -> Path:
    """A label file lacks its first line, the agent's velocity."""

    def remove_first_line(content: bytes) -> bytes:
        _, other_lines = content.split(b"\n", 1)
        return other_lines

    return victim.replace("label", remove_first_line)


@LABEL_FORM.enter("label-unreadable")
def label_field_missing(victim: Victim) -> Path:
    """A box line has 12 fields instead of 13."""
    rows = victim.read_rows()
    del rows[-1][FIELD["num_lidar_pts"]]
    return victim.write_rows(rows)


@LABEL_FORM.enter("label-unreadable")
def label_class_unknown(victim: Victim) -> Path:
    """A box line names a class that does not exist."""
    return _set_field(victim, "class", "lorry")


@LABEL_FORM.enter("label-unreadable")
def label_number_garbled(victim: Victim) -> Path:
    """A coordinate has two decimal points."""
    return _set_field(victim, "x", "1.2.3")


@LABEL_FORM.enter("label-unreadable")
def label_nan(victim: Victim) -> Path:
    """A position is NaN."""
    return _set_field(victim, "y", "nan")


@LABEL_MEANING.enter("own-row-missing")
def label_own_row_missing(victim: Victim) -> Path:
    """A vehicle's label lacks the row of the vehicle itself (id −100)."""
    header, *rows = victim.read_rows()
    own_id = str(OWN_ACTOR_ID)
    other_rows = [row for row in rows if row[FIELD["id"]] != own_id]
    return victim.write_rows([header, *other_rows])


@LABEL_MEANING.enter("duplicate-box", "duplicate-id")
def label_line_twice(victim: Victim) -> Path:
    """The box line of a tracked actor appears twice."""
    rows = victim.read_rows()
    tracked_row = rows[2]
    return victim.write_rows([*rows, tracked_row])


@LABEL_MEANING.enter("headings-differ", "own-velocity", "positions-differ", "velocity-off")
def label_right_handed(victim: Victim) -> Path:
    """One agent's labels have the other handedness: y, yaw and vy with the wrong sign."""

    def flip(row: list[str]) -> None:
        for name in ("y", "yaw", "vy"):
            column = FIELD[name]
            row[column] = repr(-float(row[column]))

    return victim.editor.edit_rows(victim.agent, victim.editor.frames, flip)


@LABEL_MEANING.enter("meta-pair", "positions-differ", "sizes-differ")
def labels_of_two_agents_swapped(victim: Victim) -> Path:
    """Two vehicles' labels are swapped at all frames."""
    for frame in victim.editor.frames:
        path = victim.editor.file(victim.agent, "label", frame)
        other_path = victim.editor.file(victim.other, "label", frame)
        victim.editor.exchange(path, other_path)
    return victim.folder("label")


CALIB_FORM = BreakageGroup("calib", opening=BrokenReleaseError, reading=CalibError)
CALIB_MEANING = BreakageGroup("calib")


@CALIB_FORM.enter("calib-unreadable")
def calib_empty(victim: Victim) -> Path:
    """A calib file has no bytes."""
    return victim.overwrite("calib", b"")


@CALIB_FORM.enter("calib-unreadable")
def calib_cut(victim: Victim) -> Path:
    """A calib file ends in the middle."""
    return victim.replace("calib", _first_half)


@CALIB_FORM.enter("calib-unreadable")
def calib_code(victim: Victim) -> Path:
    """A calib file is a pickle that runs a program: it makes a folder, `marker`, beside the release."""  # noqa: E501
    folder = str(victim.marker).encode("raw_unicode_escape")
    pickled = b"cos\nmkdir\n(V" + folder + b"\ntR."
    return victim.overwrite("calib", pickled)


@CALIB_FORM.enter("calib-unreadable")
def calib_key_missing(victim: Victim) -> Path:
    """A calib file lacks a camera's intrinsic."""
    calib = victim.editor.calib(victim.agent, victim.frame)
    del calib["intrinsic_Camera_Front"]
    return victim.editor.write_calib(victim.agent, victim.frame, calib)


@CALIB_FORM.enter("calib-unreadable")
def calib_wrong_shape(victim: Victim) -> Path:
    """A pose has three rows."""
    return victim.replace_pose(lambda pose: pose[:3])


@CALIB_FORM.enter("calib-unreadable")
def calib_nan(victim: Victim) -> Path:
    """A pose contains NaN."""
    return victim.replace_pose(lambda pose: pose * np.nan)


@CALIB_FORM.enter("calib-unreadable")
def calib_mirrored(victim: Victim) -> Path:
    """A pose is a reflection: its determinant is −1."""
    mirror = np.diag([1.0, -1.0, 1.0, 1.0])
    return victim.replace_pose(lambda pose: pose @ mirror)


@CALIB_MEANING.enter("intrinsic-form")
def calib_wrong_k(victim: Victim) -> Path:
    """A camera's raw K has the usual order of axes, not that of the release."""

    def usual_matrix(raw: np.ndarray) -> np.ndarray:
        (cx, focal), (cy, _) = raw[:2, :2].tolist()
        first_row = [focal, 0, cx]
        second_row = [0, focal, cy]
        return np.array([first_row, second_row, [0, 0, 1]])

    return victim.editor.edit_calib(
        victim.agent, victim.editor.frames, "intrinsic_Camera_Front", usual_matrix
    )


@CALIB_MEANING.enter(
    "headings-differ", "own-box-apart", "positions-differ", "speed-off", "velocity-off"
)
def calib_inverse(victim: Victim) -> Path:
    """An agent's poses are inverted: `ego_from_world`."""
    return victim.editor.edit_calib(
        victim.agent, victim.editor.frames, "ego_to_world", np.linalg.inv
    )


@CALIB_MEANING.enter("camera-misplaced")
def calib_cameras_swapped(victim: Victim) -> Path:
    """The extrinsics of two cameras of one agent are swapped."""
    front_left = "lidar_to_Camera_FrontLeft"
    back_right = "lidar_to_Camera_BackRight"
    for frame in victim.editor.frames:
        calib = victim.editor.calib(victim.agent, frame)
        calib[front_left], calib[back_right] = calib[back_right], calib[front_left]
        victim.editor.write_calib(victim.agent, frame, calib)
    return victim.folder("calib")


META_FORM = BreakageGroup("meta", opening=BrokenReleaseError, reading=MetaError)
META_MEANING = BreakageGroup("meta")


def _edit_first_line(victim: Victim, index: int, word: str) -> Path:
    """Replace one word of the first line of the meta file."""
    first_line, *other_lines = victim.editor.meta_lines()
    words = first_line.split()
    words[index] = word
    return victim.editor.write_meta_lines([" ".join(words), *other_lines])


@META_FORM.enter("meta-unreadable")
def meta_empty(victim: Victim) -> Path:
    """A meta file has no bytes."""
    return victim.editor.write_meta_lines([])


@META_FORM.enter("meta-unreadable")
def meta_cut(victim: Victim) -> Path:
    """A meta file ends within its first line."""
    first_line = victim.editor.meta_lines()[0]
    return victim.editor.write_meta_lines([first_line[:20]])


@META_FORM.enter("meta-unreadable")
def meta_id_no_number(victim: Victim) -> Path:
    """A colliding actor's id is a word."""
    return _edit_first_line(victim, 1, "ego")


@META_MEANING.enter("meta-missing")
def meta_missing(victim: Victim) -> Path:
    """A labelled scenario has no meta file."""
    path = real_path(victim.editor.scenario.meta_path)
    return victim.editor.remove(path)


@META_MEANING.enter("meta-frames")
def meta_frames_wrong(victim: Victim) -> Path:
    """The number of frames in meta is not that of the recorded frames."""
    return _edit_first_line(victim, 8, "99")


@META_MEANING.enter("meta-pair", "counterpart-unknown")
def meta_pair_wrong(victim: Victim) -> Path:
    """Meta names a colliding actor that is in no label."""
    return _edit_first_line(victim, 1, "7777")


SENSOR_FORM = BreakageGroup("sensor", reading=SensorFileError, deep=True)
SENSOR_MEANING = BreakageGroup("sensor", deep=True)
SENSOR_MISSING = BreakageGroup("sensor", reading=MissingFileError)
CAMERA = "Camera_Front"


@SENSOR_FORM.enter("sensor-unreadable", channel=CAMERA)
def image_cut(victim: Victim) -> Path:
    """An image file ends in the middle."""
    return victim.replace(CAMERA, _first_half)


@SENSOR_FORM.enter("sensor-empty", "sensor-unreadable", channel=CAMERA)
def image_empty(victim: Victim) -> Path:
    """An image file has no bytes."""
    return victim.overwrite(CAMERA, b"")


@SENSOR_MISSING.enter("sensor-frames-missing", channel=CAMERA)
def image_missing(victim: Victim) -> Path:
    """An image file is missing."""
    return victim.editor.remove(victim.file(CAMERA))


@SENSOR_MEANING.enter("image-size", channel=CAMERA)
def image_wrong_size(victim: Victim) -> Path:
    """An image is twice as large as its K says."""
    path = victim.file(CAMERA)
    image = read_image(path).repeat(2, axis=0)
    victim.editor.changing(path)
    write_image(path, np.ascontiguousarray(image.repeat(2, axis=1)))
    return path


@SENSOR_FORM.enter("sensor-unreadable", channel=LIDAR)
def lidar_cut(victim: Victim) -> Path:
    """An npz file of points ends in the middle."""
    return victim.replace(LIDAR, _first_half)


@SENSOR_FORM.enter("sensor-unreadable", channel=LIDAR)
def lidar_three_columns(victim: Victim) -> Path:
    """A point cloud lacks the intensity."""
    return victim.replace_array(LIDAR, lambda points: points[:, :3])


@SENSOR_FORM.enter("sensor-unreadable", channel=LIDAR)
def lidar_objects(victim: Victim) -> Path:
    """A point cloud is an array of Python objects, which only a pickle can load."""
    return victim.replace_array(LIDAR, lambda points: points.astype(object))


@SENSOR_MEANING.enter("points-differ", channel=LIDAR)
def lidar_right_handed(victim: Victim) -> Path:
    """A point cloud has the other handedness."""
    signs = np.array([1, -1, 1, 1], dtype=np.float32)
    return victim.replace_array(LIDAR, lambda points: points * signs)


@SENSOR_FORM.enter("sensor-unreadable", channel=BEV_CAMERA)
def bev_cut(victim: Victim) -> Path:
    """An npz file of the BEV camera ends in the middle."""
    return victim.replace(BEV_CAMERA, _first_half)


@SENSOR_FORM.enter("sensor-unreadable", channel=BEV_CAMERA)
def bev_half_size(victim: Victim) -> Path:
    """A BEV array has 600 rows and columns."""
    return victim.replace_array(BEV_CAMERA, lambda picture: picture[::2, ::2])


@SENSOR_MEANING.enter("bev-orientation", channel=BEV_CAMERA)
def bev_mirrored(victim: Victim) -> Path:
    """An agent's BEV arrays are mirrored, left to right."""
    for frame in victim.editor.frames:
        picture = victim.editor.array(victim.agent, BEV_CAMERA, frame)
        victim.editor.write_array(victim.agent, BEV_CAMERA, frame, picture[:, ::-1])
    return victim.folder(BEV_CAMERA)
