"""Calib files: where the cameras are and how they see."""

from collections.abc import Sequence

import numpy as np

from deepaccident_devkit.taxonomy import CAMERAS
from fault_injection.editor import UndoableEditor
from fault_injection.kinds import Group, MatrixEdit, edit_matrix

GROUP = Group("calib, cameras")
EXTRINSIC_KEY, INTRINSIC_KEY = "lidar_to_{}", "intrinsic_{}"
_LONGER_FOCAL_LENGTH = np.array([[1, 1.3, 1], [1, 1, 1.3], [1, 1, 1]])
_PRINCIPAL_POINT_IN_CORNER = np.array([[0, 1, 1], [0, 1, 1], [1, 1, 1]])
_TWICE_THE_SIZE = np.array([[2, 2, 1], [2, 1, 2], [1, 1, 1]])


def _exchange_extrinsics(
    editor: UndoableEditor, rng: np.random.Generator, agent: str, frames: Sequence[int]
) -> None:
    cameras = rng.choice(CAMERAS, size=2, replace=False)
    key, other_key = map(EXTRINSIC_KEY.format, cameras)
    for frame in frames:
        calib = editor.calib(agent, frame)
        exchanged = {key: calib[other_key], other_key: calib[key]}
        editor.write_calib(agent, frame, {**calib, **exchanged})


def _draw_turn(rng: np.random.Generator) -> MatrixEdit:
    angle = np.deg2rad(rng.choice([-10.0, 10.0]))
    cos, sin = np.cos(angle), np.sin(angle)
    rotation = np.eye(4)
    rotation[:2, :2] = [[cos, -sin], [sin, cos]]
    return lambda pose: rotation @ pose


def _draw_shift(rng: np.random.Generator) -> MatrixEdit:
    shift = np.zeros((4, 4))
    shift[:3, 3] = rng.permutation([0.5, 0.0, 0.0])
    return lambda pose: pose + shift


def _make_ordinary(intrinsic: np.ndarray) -> np.ndarray:
    center_x, focal_length = intrinsic[0, :2]
    center_y = intrinsic[1, 0]
    return np.array(
        [
            [focal_length, 0, center_x],
            [0, focal_length, center_y],
            [0, 0, 1],
        ]
    )


GROUP.add(
    {
        "extrinsics_exchanged": (
            "Two cameras' extrinsics are exchanged in an agent.",
            lambda editor, rng: _exchange_extrinsics(
                editor, rng, editor.any_agent(rng), editor.frames
            ),
        ),
        "extrinsics_exchanged_in_a_frame": (
            "Two cameras' extrinsics are exchanged in an agent at one frame.",
            lambda editor, rng: _exchange_extrinsics(
                editor, rng, editor.any_agent(rng), [editor.any_frame(rng)]
            ),
        ),
        "extrinsic_inverted": (
            "A camera's extrinsic is its inverse (camera to LiDAR) in an agent.",
            edit_matrix(EXTRINSIC_KEY, np.linalg.inv, always=True),
        ),
        "camera_turned": (
            "A camera of an agent is turned by 10° to one side.",
            edit_matrix(EXTRINSIC_KEY, draw_edit=_draw_turn, always=True),
        ),
        "camera_moved_in_a_frame": (
            "A camera of an agent is 0.5 m away from its place at one frame.",
            edit_matrix(EXTRINSIC_KEY, draw_edit=_draw_shift, always=False),
        ),
        "focal_scaled": (
            "A camera's focal length is 30 % too long in an agent.",
            edit_matrix(
                INTRINSIC_KEY, lambda intrinsic: intrinsic * _LONGER_FOCAL_LENGTH, always=True
            ),
        ),
        "focal_scaled_in_a_frame": (
            "A camera's focal length is 30 % too long at one frame.",
            edit_matrix(
                INTRINSIC_KEY, lambda intrinsic: intrinsic * _LONGER_FOCAL_LENGTH, always=False
            ),
        ),
        "intrinsic_ordinary": (
            "A camera's intrinsic has the usual order of axes in an agent.",
            edit_matrix(INTRINSIC_KEY, _make_ordinary, always=True),
        ),
        "principal_point_moved": (
            "A camera's principal point lies at the picture's corner in an agent.",
            edit_matrix(
                INTRINSIC_KEY, lambda intrinsic: intrinsic * _PRINCIPAL_POINT_IN_CORNER, always=True
            ),
        ),
    },
)


def _enlarge_intrinsics(editor: UndoableEditor, rng: np.random.Generator) -> None:
    agent = editor.any_agent(rng)
    for camera in CAMERAS:
        key = INTRINSIC_KEY.format(camera)
        editor.edit_calib(agent, editor.frames, key, lambda intrinsic: intrinsic * _TWICE_THE_SIZE)


GROUP.add(
    {
        "image_size_of_another_release": (
            "All intrinsics of an agent are those of images twice as large.",
            _enlarge_intrinsics,
        ),
    },
    deep=True,
)
