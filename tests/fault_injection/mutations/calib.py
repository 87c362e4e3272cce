"""Calib files: form and poses of agents."""

import os
import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np

from fault_injection.editor import UndoableEditor
from fault_injection.kinds import (
    Apply,
    Group,
    MatrixEdit,
    cut,
    edit_file,
    edit_matrix,
    empty,
    garbage,
)

GROUP = Group("calib, form")
POSES = Group("calib, poses")
MATRIX_KEYS = (
    "lidar_to_ego",
    "ego_to_world",
    "lidar_to_Camera_Front",
    "intrinsic_Camera_Back",
    "lidar_to_Camera_BackLeft",
)
_MIRROR_Y = np.diag([1.0, -1.0, 1.0, 1.0])
_ROLL_90_DEGREES = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
POSE_KEY = "ego_to_world"


class Bomb:
    """Makes a folder when it is unpickled."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple[Callable[[str], None], tuple[str]]:
        return os.mkdir, (str(self.marker),)


def marker(root: Path) -> Path:
    """Return the folder that a calib file's code makes if somebody runs it."""
    return root.with_name(f"{root.name} - a pickle has run")


def _pickle_with_bomb(editor: UndoableEditor) -> bytes:
    calib: dict[str, object] = dict.fromkeys(MATRIX_KEYS, np.eye(4))
    calib["extra"] = Bomb(marker(editor.root))
    return pickle.dumps(calib, protocol=3)


def _edit_any_matrix(edit: Callable[[np.ndarray, np.random.Generator], np.ndarray]) -> Apply:
    def apply(editor: UndoableEditor, rng: np.random.Generator) -> None:
        agent, frame = editor.any_agent(rng), editor.any_frame(rng)
        key = str(rng.choice(MATRIX_KEYS))
        editor.edit_calib(agent, [frame], key, lambda matrix: edit(matrix, rng))

    return apply


def _drop_key(editor: UndoableEditor, rng: np.random.Generator) -> None:
    agent, frame = editor.any_agent(rng), editor.any_frame(rng)
    calib = editor.calib(agent, frame)
    del calib[str(rng.choice(MATRIX_KEYS))]
    editor.write_calib(agent, frame, calib)


def _add_nan(matrix: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    broken_matrix = matrix.copy()
    broken_matrix[rng.integers(3), rng.integers(3)] = np.nan
    return broken_matrix


GROUP.add(
    {
        "calib_cut": ("A calib file ends at a random byte.", edit_file("calib", cut)),
        "calib_emptied": ("A calib file is empty.", edit_file("calib", empty)),
        "calib_garbage": ("A calib file holds random bytes.", edit_file("calib", garbage)),
        "calib_key_dropped": ("A calib file lacks a key.", _drop_key),
        "calib_wrong_shape": (
            "A matrix lacks its last row.",
            _edit_any_matrix(lambda matrix, _: matrix[:-1]),
        ),
        "calib_nan": ("A matrix contains NaN.", _edit_any_matrix(_add_nan)),
        "calib_malicious": (
            "A calib file is a pickle that runs a command.",
            lambda editor, rng: edit_file("calib", lambda *_: _pickle_with_bomb(editor))(
                editor, rng
            ),
        ),
        "calib_no_dict": (
            "A calib file is the pickle of a bare array.",
            edit_file("calib", lambda *_: pickle.dumps(np.eye(4), protocol=3)),
        ),
    },
)


def _make_transform(x: float = 0.0, y: float = 0.0, z: float = 0.0, yaw: float = 0.0) -> np.ndarray:
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.array(
        [
            [cos, -sin, 0, x],
            [sin, cos, 0, y],
            [0, 0, 1, z],
            [0, 0, 0, 1.0],
        ]
    )


def _reflect(pose: np.ndarray) -> np.ndarray:
    return pose @ _MIRROR_Y


def _make_right_handed(pose: np.ndarray) -> np.ndarray:
    return _MIRROR_Y @ pose @ _MIRROR_Y


def _draw_shift(rng: np.random.Generator) -> MatrixEdit:
    angle = rng.uniform(0, 2 * np.pi)
    shift = _make_transform(np.cos(angle), np.sin(angle))
    return lambda pose: shift @ pose


def _draw_turn(rng: np.random.Generator) -> MatrixEdit:
    angle = np.deg2rad(rng.choice([-3.0, 3.0]))
    return lambda pose: pose @ _make_transform(yaw=angle)


def _draw_lift(rng: np.random.Generator) -> MatrixEdit:
    height = float(rng.choice([-1.0, 1.0]))
    return lambda pose: pose @ _make_transform(z=height)


def _edit_all_poses(editor: UndoableEditor, edit: MatrixEdit) -> None:
    for agent in editor.agents:
        editor.edit_calib(agent, editor.frames, POSE_KEY, edit)


POSES.add(
    {
        "pose_mirrored": (
            "A pose's rotation is a reflection (determinant −1) at one frame.",
            edit_matrix(POSE_KEY, _reflect, always=False),
        ),
        "poses_mirrored": (
            "All poses of an agent are reflections.",
            edit_matrix(POSE_KEY, _reflect, always=True),
        ),
        "poses_right_handed": (
            "All poses of an agent have the other sign of y and yaw, properly right-handed.",
            edit_matrix(POSE_KEY, _make_right_handed, always=True),
        ),
        "all_poses_right_handed": (
            "All poses of all agents are right-handed, but the labels are not.",
            lambda editor, _: _edit_all_poses(editor, _make_right_handed),
        ),
        "pose_inverted": (
            "An agent's ego_to_world is its inverse.",
            edit_matrix(POSE_KEY, np.linalg.inv, always=True),
        ),
        "pose_transposed": (
            "A pose is written for row vectors (transposed) at one frame.",
            edit_matrix(POSE_KEY, np.transpose, always=False),
        ),
        "rotation_scaled": (
            "A pose's rotation is 5 % too long at one frame.",
            edit_matrix(
                POSE_KEY, lambda pose: pose * np.array([1.05, 1.05, 1.05, 1.0]), always=False
            ),
        ),
        "pose_moved": (
            "A pose is 1 m too far to one side at one frame.",
            edit_matrix(POSE_KEY, draw_edit=_draw_shift, always=False),
        ),
        "pose_rolled": (
            "A pose's axes are exchanged (the agent lies on its side) at one frame.",
            edit_matrix(POSE_KEY, lambda pose: pose @ _ROLL_90_DEGREES, always=False),
        ),
        "poses_moved": (
            "All poses of an agent are 1 m too far to one side.",
            edit_matrix(POSE_KEY, draw_edit=_draw_shift, always=True),
        ),
        "poses_turned": (
            "All poses of an agent are turned by 3°.",
            edit_matrix(POSE_KEY, draw_edit=_draw_turn, always=True),
        ),
    },
)
POSES.add(
    {
        "world_moved": (
            "All poses of all agents are 100 m too far to one side.",
            lambda editor, _: _edit_all_poses(
                editor, lambda pose: _make_transform(100.0, -50.0) @ pose
            ),
        ),
    },
    harmless="the world's origin is arbitrary: nothing else in a release says where it is",
)
POSES.add(
    {
        "lidar_height": (
            "The LiDAR of an agent is 1 m too high on it at all frames.",
            edit_matrix("lidar_to_ego", draw_edit=_draw_lift, always=True),
        ),
        "lidar_height_in_a_frame": (
            "The LiDAR of an agent is 1 m too high on it at one frame.",
            edit_matrix("lidar_to_ego", draw_edit=_draw_lift, always=False),
        ),
        "calib_of_next_frame": (
            "A moving agent's calib file is replaced by the next frame's.",
            lambda editor, rng: editor.take_next_of_moving_agent(rng, "calib"),
        ),
        "calibs_shifted": (
            "All calib files of a moving agent are one frame early; the last one appears twice.",
            lambda editor, rng: editor.shift_one_frame_early(editor.moving_agent(rng), "calib"),
        ),
        "calibs_of_two_agents_exchanged": (
            "Two agents' calib files are exchanged at one frame.",
            lambda editor, rng: editor.exchange_agents(
                editor.two_agents(rng), "calib", [editor.any_frame(rng)]
            ),
        ),
    },
)
