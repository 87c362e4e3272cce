"""Where the sensors of a small release's agents are mounted, and their calib files."""

import numpy as np

from deepaccident_devkit.geometry import SE3, PinholeCamera
from deepaccident_devkit.release import Calib
from deepaccident_devkit.taxonomy import CAMERAS, INFRASTRUCTURE, AgentName

_LIDAR_HEIGHT = 1.94
_CAMERA_YAW = dict(zip(CAMERAS, np.deg2rad([0.0, 55.0, -55.0, 180.0, 110.0, -110.0]).tolist(), strict=True))
_CAMERA_RADIUS, _CAMERA_DROP = 1.0, 0.3
"""Metres from the LiDAR's axis to a camera, and from the LiDAR down to it."""
_OPTICAL_FROM_FORWARD = SE3.from_rotation([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


def cameras(image_size: tuple[int, int]) -> dict[str, PinholeCamera]:
    """Channel → camera for images of `image_size` (width, height): the back camera has 110°, the others 70°."""
    fields = {channel: np.deg2rad(110.0 if channel == "Camera_Back" else 70.0) for channel in CAMERAS}
    return {channel: PinholeCamera.from_field_of_view(*image_size, field) for channel, field in fields.items()}


def calib_of(agent: AgentName, world_from_ego: SE3, image_size: tuple[int, int]) -> Calib:
    """An agent's calib of one frame."""
    height = 0.0 if agent == INFRASTRUCTURE else _LIDAR_HEIGHT
    return Calib(
        ego_from_lidar=SE3.from_yaw(0.0, (0.0, 0.0, height)),
        world_from_ego=world_from_ego,
        camera_from_lidar={channel: _camera_from_lidar(yaw) for channel, yaw in _CAMERA_YAW.items()},
        intrinsic={channel: camera.intrinsic for channel, camera in cameras(image_size).items()},
    )


def _camera_from_lidar(yaw: float) -> SE3:
    place = (_CAMERA_RADIUS * np.cos(yaw), _CAMERA_RADIUS * np.sin(yaw), -_CAMERA_DROP)
    return _OPTICAL_FROM_FORWARD @ SE3.from_yaw(yaw, place).inverse()
