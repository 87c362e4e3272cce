"""Calib files: where the cameras are and how they see."""

import numpy as np

from deepaccident_devkit.taxonomy import CAMERAS
from fault_injection.kinds import Group
from fault_injection.place import Place

GROUP = Group("calib, cameras")


def _camera(rng: np.random.Generator) -> str:
    return str(rng.choice(CAMERAS))


def _exchange(place: Place, agent: str, frames: list[int], rng: np.random.Generator) -> str:
    one, other = (str(camera) for camera in rng.choice(CAMERAS, size=2, replace=False))
    for frame in frames:
        calib = place.calib(agent, frame)
        keys = f"lidar_to_{one}", f"lidar_to_{other}"
        calib[keys[0]], calib[keys[1]] = calib[keys[1]], calib[keys[0]]
        place.write_calib(agent, frame, calib)
    return f"{agent} {frames[0]}..{frames[-1]}: {one} and {other}"


GROUP.add(
    {
        "extrinsics_exchanged": (
            "Two cameras' extrinsics are exchanged in an agent.",
            lambda place, rng: _exchange(place, place.any_agent(rng), place.frames, rng),
        ),
        "extrinsics_exchanged_in_a_frame": (
            "Two cameras' extrinsics are exchanged in an agent at one frame.",
            lambda place, rng: _exchange(place, place.any_agent(rng), [place.any_frame(rng)], rng),
        ),
    },
)


@GROUP.kind()
def extrinsic_inverted(place: Place, rng: np.random.Generator) -> str:
    """A camera's extrinsic is its inverse (camera to LiDAR) in an agent."""
    agent, camera = place.any_agent(rng), _camera(rng)
    place.edit_calib(agent, place.frames, f"lidar_to_{camera}", np.linalg.inv)
    return f"{agent}: {camera}"


@GROUP.kind()
def camera_turned(place: Place, rng: np.random.Generator) -> str:
    """A camera of an agent is turned by 10° to one side."""
    agent, camera = place.any_agent(rng), _camera(rng)
    angle = np.deg2rad(float(rng.choice([-10.0, 10.0])))
    turn = np.eye(4)
    turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    place.edit_calib(agent, place.frames, f"lidar_to_{camera}", lambda pose: turn @ pose)
    return f"{agent}: {camera}"


@GROUP.kind()
def camera_moved_in_a_frame(place: Place, rng: np.random.Generator) -> str:
    """A camera of an agent is 0.5 m away from its place at one frame."""
    agent, frame, camera = place.any_agent(rng), place.any_frame(rng), _camera(rng)
    move = np.zeros((4, 4))
    move[:3, 3] = rng.permutation([0.5, 0.0, 0.0])
    place.edit_calib(agent, [frame], f"lidar_to_{camera}", lambda pose: pose + move)
    return f"{agent} {frame}: {camera}"


@GROUP.kind()
def focal_scaled(place: Place, rng: np.random.Generator) -> str:
    """A camera's focal length is 30 % too long in an agent."""
    agent, camera = place.any_agent(rng), _camera(rng)
    longer = np.array([[1, 1.3, 1], [1, 1, 1.3], [1, 1, 1]])
    place.edit_calib(agent, place.frames, f"intrinsic_{camera}", lambda intrinsic: intrinsic * longer)
    return f"{agent}: {camera}"


@GROUP.kind()
def focal_scaled_in_a_frame(place: Place, rng: np.random.Generator) -> str:
    """A camera's focal length is 30 % too long at one frame."""
    agent, frame, camera = place.any_agent(rng), place.any_frame(rng), _camera(rng)
    longer = np.array([[1, 1.3, 1], [1, 1, 1.3], [1, 1, 1]])
    place.edit_calib(agent, [frame], f"intrinsic_{camera}", lambda intrinsic: intrinsic * longer)
    return f"{agent} {frame}: {camera}"


@GROUP.kind()
def intrinsic_ordinary(place: Place, rng: np.random.Generator) -> str:
    """A camera's intrinsic has the usual order of axes in an agent."""
    agent, camera = place.any_agent(rng), _camera(rng)

    def edit(intrinsic: np.ndarray) -> np.ndarray:
        focal, center_x, center_y = intrinsic[0, 1], intrinsic[0, 0], intrinsic[1, 0]
        return np.array([[focal, 0, center_x], [0, focal, center_y], [0, 0, 1]])

    place.edit_calib(agent, place.frames, f"intrinsic_{camera}", edit)
    return f"{agent}: {camera}"


@GROUP.kind()
def principal_point_moved(place: Place, rng: np.random.Generator) -> str:
    """A camera's principal point lies at the picture's corner in an agent."""
    agent, camera = place.any_agent(rng), _camera(rng)
    corner = np.array([[0, 1, 1], [0, 1, 1], [1, 1, 1]])
    place.edit_calib(agent, place.frames, f"intrinsic_{camera}", lambda intrinsic: intrinsic * corner)
    return f"{agent}: {camera}"


@GROUP.kind(deep=True)
def image_size_of_another_release(place: Place, rng: np.random.Generator) -> str:
    """All intrinsics of an agent are those of images twice as large."""
    agent = place.any_agent(rng)
    larger = np.array([[2, 2, 1], [2, 1, 2], [1, 1, 1]])
    for camera in CAMERAS:
        place.edit_calib(agent, place.frames, f"intrinsic_{camera}", lambda intrinsic: intrinsic * larger)
    return agent
