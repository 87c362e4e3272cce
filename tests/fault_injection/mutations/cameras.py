"""Calib files: where the cameras are and how they see."""

from collections.abc import Sequence

import numpy as np

from deepaccident_devkit.taxonomy import CAMERAS
from fault_injection.kinds import Group, Matrix, in_calib
from fault_injection.place import Place

GROUP = Group("calib, cameras")
EXTRINSIC, INTRINSIC = "lidar_to_{}", "intrinsic_{}"
_LONGER = np.array([[1, 1.3, 1], [1, 1, 1.3], [1, 1, 1]])
_CORNER = np.array([[0, 1, 1], [0, 1, 1], [1, 1, 1]])
_LARGER = np.array([[2, 2, 1], [2, 1, 2], [1, 1, 1]])


def _exchange(place: Place, rng: np.random.Generator, agent: str, frames: Sequence[int]) -> None:
    one, other = (f"lidar_to_{camera}" for camera in rng.choice(CAMERAS, size=2, replace=False))
    for frame in frames:
        calib = place.calib(agent, frame)
        place.write_calib(agent, frame, {**calib, one: calib[other], other: calib[one]})


def _turned(rng: np.random.Generator) -> Matrix:
    angle, turn = np.deg2rad(float(rng.choice([-10.0, 10.0]))), np.eye(4)
    turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return lambda pose: turn @ pose


def _moved(rng: np.random.Generator) -> Matrix:
    move = np.zeros((4, 4))
    move[:3, 3] = rng.permutation([0.5, 0.0, 0.0])
    return lambda pose: pose + move


def _ordinary(intrinsic: np.ndarray) -> np.ndarray:
    focal, center_x, center_y = intrinsic[0, 1], intrinsic[0, 0], intrinsic[1, 0]
    return np.array([[focal, 0, center_x], [0, focal, center_y], [0, 0, 1]])


GROUP.add(
    {
        "extrinsics_exchanged": (
            "Two cameras' extrinsics are exchanged in an agent.",
            lambda place, rng: _exchange(place, rng, place.any_agent(rng), place.frames),
        ),
        "extrinsics_exchanged_in_a_frame": (
            "Two cameras' extrinsics are exchanged in an agent at one frame.",
            lambda place, rng: _exchange(place, rng, place.any_agent(rng), [place.any_frame(rng)]),
        ),
        "extrinsic_inverted": (
            "A camera's extrinsic is its inverse (camera to LiDAR) in an agent.",
            in_calib(EXTRINSIC, np.linalg.inv, always=True),
        ),
        "camera_turned": (
            "A camera of an agent is turned by 10° to one side.",
            in_calib(EXTRINSIC, drawn=_turned, always=True),
        ),
        "camera_moved_in_a_frame": (
            "A camera of an agent is 0.5 m away from its place at one frame.",
            in_calib(EXTRINSIC, drawn=_moved, always=False),
        ),
        "focal_scaled": (
            "A camera's focal length is 30 % too long in an agent.",
            in_calib(INTRINSIC, lambda intrinsic: intrinsic * _LONGER, always=True),
        ),
        "focal_scaled_in_a_frame": (
            "A camera's focal length is 30 % too long at one frame.",
            in_calib(INTRINSIC, lambda intrinsic: intrinsic * _LONGER, always=False),
        ),
        "intrinsic_ordinary": (
            "A camera's intrinsic has the usual order of axes in an agent.",
            in_calib(INTRINSIC, _ordinary, always=True),
        ),
        "principal_point_moved": (
            "A camera's principal point lies at the picture's corner in an agent.",
            in_calib(INTRINSIC, lambda intrinsic: intrinsic * _CORNER, always=True),
        ),
    },
)


def _of_larger_images(place: Place, rng: np.random.Generator) -> None:
    agent = place.any_agent(rng)
    for camera in CAMERAS:
        place.edit_calib(
            agent, place.frames, f"intrinsic_{camera}", lambda intrinsic: intrinsic * _LARGER
        )


GROUP.add(
    {
        "image_size_of_another_release": (
            "All intrinsics of an agent are those of images twice as large.",
            _of_larger_images,
        ),
    },
    deep=True,
)
