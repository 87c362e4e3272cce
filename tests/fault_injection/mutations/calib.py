"""Calib files: form and poses of agents."""

import os
import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np

from fault_injection.kinds import Apply, Group, Matrix, cut, emptied, garbage, in_calib, in_file
from fault_injection.place import Place

GROUP = Group("calib, form")
POSES = Group("calib, poses")
KEYS = (
    "lidar_to_ego",
    "ego_to_world",
    "lidar_to_Camera_Front",
    "intrinsic_Camera_Back",
    "lidar_to_Camera_BackLeft",
)
_LEFT_TO_RIGHT = np.diag([1.0, -1.0, 1.0, 1.0])
_ON_ITS_SIDE = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
POSE = "ego_to_world"


class Bomb:
    """Makes a folder when it is unpickled."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple[Callable[[str], None], tuple[str]]:
        return os.mkdir, (str(self.marker),)


def marker(root: Path) -> Path:
    """What a calib file's code makes if somebody runs it."""
    return root.with_name(f"{root.name} - a pickle has run")


def _bomb(place: Place) -> bytes:
    return pickle.dumps(
        {**dict.fromkeys(KEYS, np.eye(4)), "extra": Bomb(marker(place.root))}, protocol=3
    )


def _of_any_key(edit: Callable[[np.ndarray, np.random.Generator], np.ndarray]) -> Apply:
    def apply(place: Place, rng: np.random.Generator) -> None:
        agent, frame, key = place.any_agent(rng), place.any_frame(rng), str(rng.choice(KEYS))
        place.edit_calib(agent, [frame], key, lambda array: edit(array, rng))

    return apply


def _drop_key(place: Place, rng: np.random.Generator) -> None:
    agent, frame, key = place.any_agent(rng), place.any_frame(rng), str(rng.choice(KEYS))
    place.write_calib(
        agent,
        frame,
        {name: value for name, value in place.calib(agent, frame).items() if name != key},
    )


def _with_nan(array: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    broken = array.copy()
    broken[rng.integers(3), rng.integers(3)] = np.nan
    return broken


GROUP.add(
    {
        "calib_cut": ("A calib file ends at a random byte.", in_file("calib", cut)),
        "calib_emptied": ("A calib file is empty.", in_file("calib", emptied)),
        "calib_garbage": ("A calib file holds random bytes.", in_file("calib", garbage)),
        "calib_key_dropped": ("A calib file lacks a key.", _drop_key),
        "calib_wrong_shape": (
            "A matrix lacks its last row.",
            _of_any_key(lambda array, _: array[:-1]),
        ),
        "calib_nan": ("A matrix contains NaN.", _of_any_key(_with_nan)),
        "calib_malicious": (
            "A calib file is a pickle that runs a command.",
            lambda place, rng: in_file("calib", lambda *_: _bomb(place))(place, rng),
        ),
        "calib_no_dict": (
            "A calib file is the pickle of a bare array.",
            in_file("calib", lambda *_: pickle.dumps(np.eye(4), protocol=3)),
        ),
    },
)


def _shift(x: float = 0.0, y: float = 0.0, z: float = 0.0, yaw: float = 0.0) -> np.ndarray:
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.array([[cos, -sin, 0, x], [sin, cos, 0, y], [0, 0, 1, z], [0, 0, 0, 1.0]])


def _reflected(pose: np.ndarray) -> np.ndarray:
    return pose @ _LEFT_TO_RIGHT


def _right_handed(pose: np.ndarray) -> np.ndarray:
    return _LEFT_TO_RIGHT @ pose @ _LEFT_TO_RIGHT


def _moved(rng: np.random.Generator) -> Matrix:
    angle = rng.uniform(0, 2 * np.pi)
    return lambda pose: _shift(np.cos(angle), np.sin(angle)) @ pose


def _turned(rng: np.random.Generator) -> Matrix:
    angle = np.deg2rad(float(rng.choice([-3.0, 3.0])))
    return lambda pose: pose @ _shift(yaw=angle)


def _higher(rng: np.random.Generator) -> Matrix:
    more = float(rng.choice([-1.0, 1.0]))
    return lambda pose: pose @ _shift(z=more)


def _of_all(place: Place, edit: Matrix) -> None:
    for agent in place.agents:
        place.edit_calib(agent, place.frames, POSE, edit)


POSES.add(
    {
        "pose_mirrored": (
            "A pose's rotation is a reflection (determinant −1) at one frame.",
            in_calib(POSE, _reflected, always=False),
        ),
        "poses_mirrored": (
            "All poses of an agent are reflections.",
            in_calib(POSE, _reflected, always=True),
        ),
        "poses_right_handed": (
            "All poses of an agent have the other sign of y and yaw, properly right-handed.",
            in_calib(POSE, _right_handed, always=True),
        ),
        "all_poses_right_handed": (
            "All poses of all agents are right-handed, but the labels are not.",
            lambda place, _: _of_all(place, _right_handed),
        ),
        "pose_inverted": (
            "An agent's ego_to_world is its inverse.",
            in_calib(POSE, np.linalg.inv, always=True),
        ),
        "pose_transposed": (
            "A pose is written for row vectors (transposed) at one frame.",
            in_calib(POSE, np.transpose, always=False),
        ),
        "rotation_scaled": (
            "A pose's rotation is 5 % too long at one frame.",
            in_calib(POSE, lambda pose: pose * np.array([1.05, 1.05, 1.05, 1.0]), always=False),
        ),
        "pose_moved": (
            "A pose is 1 m too far to one side at one frame.",
            in_calib(POSE, drawn=_moved, always=False),
        ),
        "pose_rolled": (
            "A pose's axes are exchanged (the agent lies on its side) at one frame.",
            in_calib(POSE, lambda pose: pose @ _ON_ITS_SIDE, always=False),
        ),
        "poses_moved": (
            "All poses of an agent are 1 m too far to one side.",
            in_calib(POSE, drawn=_moved, always=True),
        ),
        "poses_turned": (
            "All poses of an agent are turned by 3°.",
            in_calib(POSE, drawn=_turned, always=True),
        ),
    },
)
POSES.add(
    {
        "world_moved": (
            "All poses of all agents are 100 m too far to one side.",
            lambda place, _: _of_all(place, lambda pose: _shift(100.0, -50.0) @ pose),
        ),
    },
    harmless="the world's origin is arbitrary: nothing else in a release says where it is",
)
POSES.add(
    {
        "lidar_height": (
            "The LiDAR of an agent is 1 m too high on it at all frames.",
            in_calib("lidar_to_ego", drawn=_higher, always=True),
        ),
        "lidar_height_in_a_frame": (
            "The LiDAR of an agent is 1 m too high on it at one frame.",
            in_calib("lidar_to_ego", drawn=_higher, always=False),
        ),
        "calib_of_next_frame": (
            "A moving agent's calib file is replaced by the next frame's.",
            lambda place, rng: place.moving_takes_next(rng, "calib"),
        ),
        "calibs_shifted": (
            "All calib files of a moving agent are one frame early; the last one is there twice.",
            lambda place, rng: place.one_frame_early(place.moving_agent(rng), "calib"),
        ),
        "calibs_of_two_agents_exchanged": (
            "Two agents' calib files are exchanged at one frame.",
            lambda place, rng: place.exchange_agents(
                place.two_agents(rng), "calib", [place.any_frame(rng)]
            ),
        ),
    },
)
