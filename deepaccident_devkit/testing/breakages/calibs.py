"""Calib files that cannot be read, must not be run, or give sensors wrong places."""

from pathlib import Path

import numpy as np

from deepaccident_devkit.errors import BrokenReleaseError, CalibError
from deepaccident_devkit.testing.breakages.kinds import Group, Victim

FORM = Group("calib", opening=BrokenReleaseError, reading=CalibError)
MEANING = Group("calib")


@FORM.enter("calib-unreadable")
def calib_empty(victim: Victim) -> Path:
    """A calib file has no bytes."""
    return victim.replace("calib", lambda _: b"")


@FORM.enter("calib-unreadable")
def calib_cut(victim: Victim) -> Path:
    """A calib file ends in the middle."""
    return victim.replace("calib", lambda content: content[: len(content) // 2])


@FORM.enter("calib-unreadable")
def calib_code(victim: Victim) -> Path:
    """A calib file is a pickle that runs a program: it makes a folder, `marker`, beside the release."""
    name = str(victim.marker).encode("raw_unicode_escape")
    return victim.replace("calib", lambda _: b"cos\nmkdir\n(V" + name + b"\ntR.")


@FORM.enter("calib-unreadable")
def calib_key_missing(victim: Victim) -> Path:
    """A calib file lacks a camera's intrinsic."""
    calib = victim.editor.calib(victim.agent, victim.frame)
    del calib["intrinsic_Camera_Front"]
    victim.editor.write_calib(victim.agent, victim.frame, calib)
    return victim.file("calib")


@FORM.enter("calib-unreadable")
def calib_wrong_shape(victim: Victim) -> Path:
    """A pose has three rows."""
    victim.editor.edit_calib(victim.agent, [victim.frame], "ego_to_world", lambda pose: pose[:3])
    return victim.file("calib")


@FORM.enter("calib-unreadable")
def calib_nan(victim: Victim) -> Path:
    """A pose contains NaN."""
    victim.editor.edit_calib(victim.agent, [victim.frame], "ego_to_world", lambda pose: pose * np.nan)
    return victim.file("calib")


@FORM.enter("calib-unreadable")
def calib_mirrored(victim: Victim) -> Path:
    """A pose is a reflection: its determinant is −1."""
    mirror = np.diag([1.0, -1.0, 1.0, 1.0])
    victim.editor.edit_calib(victim.agent, [victim.frame], "ego_to_world", lambda pose: pose @ mirror)
    return victim.file("calib")


@MEANING.enter("intrinsic-form")
def calib_wrong_k(victim: Victim) -> Path:
    """A camera's raw K has the usual order of axes, not that of the release."""

    def ordinary(raw: np.ndarray) -> np.ndarray:
        return np.array([[raw[0, 1], 0, raw[0, 0]], [0, raw[0, 1], raw[1, 0]], [0, 0, 1]])

    victim.editor.edit_calib(victim.agent, victim.editor.frames, "intrinsic_Camera_Front", ordinary)
    return victim.editor.folder(victim.agent, "calib")


@MEANING.enter("headings-differ", "own-box-apart", "positions-differ", "speed-off", "velocity-off")
def calib_inverse(victim: Victim) -> Path:
    """An agent's poses are inverted: `ego_from_world`."""
    victim.editor.edit_calib(victim.agent, victim.editor.frames, "ego_to_world", np.linalg.inv)
    return victim.editor.folder(victim.agent, "calib")


@MEANING.enter("camera-misplaced")
def calib_cameras_swapped(victim: Victim) -> Path:
    """The extrinsics of two cameras of one agent are swapped."""
    keys = ("lidar_to_Camera_FrontLeft", "lidar_to_Camera_BackRight")
    for frame in victim.editor.frames:
        calib = victim.editor.calib(victim.agent, frame)
        swapped = dict(zip(keys, (calib[keys[1]], calib[keys[0]]), strict=True))
        victim.editor.write_calib(victim.agent, frame, {**calib, **swapped})
    return victim.editor.folder(victim.agent, "calib")
