"""Calib files: form and poses of agents."""

import os
import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np

from fault_injection.kinds import Group, cut, garbage
from fault_injection.place import Place

GROUP = Group("calib, form")
POSES = Group("calib, poses")
KEYS = ("lidar_to_ego", "ego_to_world", "lidar_to_Camera_Front", "intrinsic_Camera_Back", "lidar_to_Camera_BackLeft")
_LEFT_TO_RIGHT = np.diag([1.0, -1.0, 1.0, 1.0])


class Bomb:
    """Makes a folder when it is unpickled."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple[Callable[[str], None], tuple[str]]:
        return os.mkdir, (str(self.marker),)


def marker(root: Path) -> Path:
    """What a calib file's code makes if somebody runs it."""
    return root.with_name(f"{root.name} - a pickle has run")


def _shift(x: float = 0.0, y: float = 0.0, z: float = 0.0, yaw: float = 0.0) -> np.ndarray:
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.array([[cos, -sin, 0, x], [sin, cos, 0, y], [0, 0, 1, z], [0, 0, 0, 1.0]])


def _any_file(place: Place, rng: np.random.Generator) -> tuple[str, int]:
    return place.any_agent(rng), place.any_frame(rng)


def _replace_file(place: Place, rng: np.random.Generator, change: Callable[[bytes], bytes]) -> str:
    agent, frame = _any_file(place, rng)
    path = place.file(agent, "calib", frame)
    place.write(path, change(path.read_bytes()))
    return f"{agent} {frame}: {path.stat().st_size} bytes"


def _edit_key(place: Place, rng: np.random.Generator, edit: Callable[[np.ndarray], np.ndarray]) -> str:
    (agent, frame), key = _any_file(place, rng), str(rng.choice(KEYS))
    place.edit_calib(agent, [frame], key, edit)
    return f"{agent} {frame}: {key}"


GROUP.add(
    {
        "calib_cut": (
            "A calib file ends at a random byte.",
            lambda place, rng: _replace_file(place, rng, lambda content: cut(content, rng)),
        ),
        "calib_emptied": ("A calib file is empty.", lambda place, rng: _replace_file(place, rng, lambda _: b"")),
        "calib_garbage": (
            "A calib file holds random bytes.",
            lambda place, rng: _replace_file(place, rng, lambda content: garbage(rng, len(content))),
        ),
    },
)


@GROUP.kind()
def calib_key_dropped(place: Place, rng: np.random.Generator) -> str:
    """A calib file lacks a key."""
    (agent, frame), key = _any_file(place, rng), str(rng.choice(KEYS))
    calib = place.calib(agent, frame)
    del calib[key]
    place.write_calib(agent, frame, calib)
    return f"{agent} {frame}: {key}"


@GROUP.kind()
def calib_wrong_shape(place: Place, rng: np.random.Generator) -> str:
    """A matrix lacks its last row."""
    return _edit_key(place, rng, lambda array: array[:-1])


@GROUP.kind()
def calib_nan(place: Place, rng: np.random.Generator) -> str:
    """A matrix contains NaN."""

    def edit(array: np.ndarray) -> np.ndarray:
        broken = array.copy()
        broken[rng.integers(3), rng.integers(3)] = np.nan
        return broken

    return _edit_key(place, rng, edit)


@GROUP.kind()
def calib_malicious(place: Place, rng: np.random.Generator) -> str:
    """A calib file is a pickle that runs a command."""
    bomb = pickle.dumps({**dict.fromkeys(KEYS, np.eye(4)), "extra": Bomb(marker(place.root))}, protocol=3)
    return _replace_file(place, rng, lambda _: bomb)


@GROUP.kind()
def calib_no_dict(place: Place, rng: np.random.Generator) -> str:
    """A calib file is the pickle of a bare array."""
    return _replace_file(place, rng, lambda _: pickle.dumps(np.eye(4), protocol=3))


@POSES.kind()
def pose_mirrored(place: Place, rng: np.random.Generator) -> str:
    """A pose's rotation is a reflection (determinant −1) at one frame."""
    agent, frame = _any_file(place, rng)
    place.edit_calib(agent, [frame], "ego_to_world", lambda pose: pose @ _LEFT_TO_RIGHT)
    return f"{agent} {frame}"


@POSES.kind()
def poses_mirrored(place: Place, rng: np.random.Generator) -> str:
    """All poses of an agent are reflections."""
    agent = place.any_agent(rng)
    place.edit_calib(agent, place.frames, "ego_to_world", lambda pose: pose @ _LEFT_TO_RIGHT)
    return agent


@POSES.kind()
def poses_right_handed(place: Place, rng: np.random.Generator) -> str:
    """All poses of an agent have the other sign of y and yaw, properly right-handed."""
    agent = place.any_agent(rng)
    place.edit_calib(agent, place.frames, "ego_to_world", lambda pose: _LEFT_TO_RIGHT @ pose @ _LEFT_TO_RIGHT)
    return agent


@POSES.kind()
def all_poses_right_handed(place: Place, rng: np.random.Generator) -> str:
    """All poses of all agents are right-handed, but the labels are not."""
    for agent in place.agents:
        place.edit_calib(agent, place.frames, "ego_to_world", lambda pose: _LEFT_TO_RIGHT @ pose @ _LEFT_TO_RIGHT)
    return "all agents"


@POSES.kind()
def pose_inverted(place: Place, rng: np.random.Generator) -> str:
    """An agent's ego_to_world is its inverse."""
    agent = place.any_agent(rng)
    place.edit_calib(agent, place.frames, "ego_to_world", np.linalg.inv)
    return agent


@POSES.kind()
def pose_transposed(place: Place, rng: np.random.Generator) -> str:
    """A pose is written for row vectors (transposed) at one frame."""
    agent, frame = _any_file(place, rng)
    place.edit_calib(agent, [frame], "ego_to_world", np.transpose)
    return f"{agent} {frame}"


@POSES.kind()
def rotation_scaled(place: Place, rng: np.random.Generator) -> str:
    """A pose's rotation is 5 % too long at one frame."""
    agent, frame = _any_file(place, rng)
    place.edit_calib(agent, [frame], "ego_to_world", lambda pose: pose * np.array([1.05, 1.05, 1.05, 1.0]))
    return f"{agent} {frame}"


@POSES.kind()
def pose_moved(place: Place, rng: np.random.Generator) -> str:
    """A pose is 1 m too far to one side at one frame."""
    agent, frame = _any_file(place, rng)
    angle = rng.uniform(0, 2 * np.pi)
    place.edit_calib(agent, [frame], "ego_to_world", lambda pose: _shift(np.cos(angle), np.sin(angle)) @ pose)
    return f"{agent} {frame}"


@POSES.kind()
def pose_rolled(place: Place, rng: np.random.Generator) -> str:
    """A pose's axes are exchanged (the agent lies on its side) at one frame."""
    agent, frame = _any_file(place, rng)
    roll = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    place.edit_calib(agent, [frame], "ego_to_world", lambda pose: pose @ roll)
    return f"{agent} {frame}"


@POSES.kind()
def poses_moved(place: Place, rng: np.random.Generator) -> str:
    """All poses of an agent are 1 m too far to one side."""
    agent, angle = place.any_agent(rng), rng.uniform(0, 2 * np.pi)
    place.edit_calib(agent, place.frames, "ego_to_world", lambda pose: _shift(np.cos(angle), np.sin(angle)) @ pose)
    return agent


@POSES.kind()
def poses_turned(place: Place, rng: np.random.Generator) -> str:
    """All poses of an agent are turned by 3°."""
    agent, angle = place.any_agent(rng), np.deg2rad(float(rng.choice([-3.0, 3.0])))
    place.edit_calib(agent, place.frames, "ego_to_world", lambda pose: pose @ _shift(yaw=angle))
    return agent


@POSES.kind(harmless="the world's origin is arbitrary: nothing else in a release says where it is")
def world_moved(place: Place, rng: np.random.Generator) -> str:
    """All poses of all agents are 100 m too far to one side."""
    for agent in place.agents:
        place.edit_calib(agent, place.frames, "ego_to_world", lambda pose: _shift(100.0, -50.0) @ pose)
    return "all agents"


@POSES.kind()
def lidar_height(place: Place, rng: np.random.Generator) -> str:
    """The LiDAR of an agent is 1 m too high on it at all frames."""
    agent, more = place.any_agent(rng), float(rng.choice([-1.0, 1.0]))
    place.edit_calib(agent, place.frames, "lidar_to_ego", lambda pose: pose @ _shift(z=more))
    return f"{agent}: {more}"


@POSES.kind()
def lidar_height_in_a_frame(place: Place, rng: np.random.Generator) -> str:
    """The LiDAR of an agent is 1 m too high on it at one frame."""
    (agent, frame), more = _any_file(place, rng), float(rng.choice([-1.0, 1.0]))
    place.edit_calib(agent, [frame], "lidar_to_ego", lambda pose: pose @ _shift(z=more))
    return f"{agent} {frame}: {more}"


@POSES.kind()
def calib_of_next_frame(place: Place, rng: np.random.Generator) -> str:
    """A moving agent's calib file is replaced by the next frame's."""
    frame = int(rng.choice(place.frames[:-1]))
    return place.take_next(place.moving_agent(rng, frame), "calib", frame)


@POSES.kind()
def calibs_shifted(place: Place, rng: np.random.Generator) -> str:
    """All calib files of a moving agent are one frame early; the last one is there twice."""
    return place.one_frame_early(place.moving_agent(rng), "calib")


@POSES.kind()
def calibs_of_two_agents_exchanged(place: Place, rng: np.random.Generator) -> str:
    """Two agents' calib files are exchanged at one frame."""
    (one, other), frame = place.two_agents(rng), place.any_frame(rng)
    place.exchange(place.file(one, "calib", frame), place.file(other, "calib", frame))
    return f"{one} and {other} {frame}"
