"""The five recording agents: their frames and how their sensors are mounted."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from deepaccident_devkit.geometry import SE3, PinholeCamera, handedness
from deepaccident_devkit.release import Calib
from deepaccident_devkit.synth.actors import Actor, Actors
from deepaccident_devkit.synth.sensors.scene import Scene
from deepaccident_devkit.synth.stage import World
from deepaccident_devkit.taxonomy import CAMERAS, INFRASTRUCTURE, VEHICLE_AGENTS, AgentName

LIDAR_HEIGHT = 1.94
"""Of a vehicle's LiDAR above its ego origin on the road, metres; more on a vehicle too tall for it."""
_LEAST_ABOVE_ROOF, _ABOVE_ROOF = 0.25, 0.45
"""Metres: a LiDAR that would be lower than the first above the roof is put as high above it as the second."""
_BELOW_LIDAR = 0.3
_CAMERA_YAW = dict(zip(CAMERAS, np.deg2rad([0.0, 55.0, -55.0, 180.0, 110.0, -110.0]).tolist(), strict=True))
_FIELD_OF_VIEW = {camera: float(np.deg2rad(110.0 if camera == "Camera_Back" else 70.0)) for camera in CAMERAS}
_FRONT, _BACK = 2.337, 2.096
"""Where the real release has its front and back cameras, metres ahead of and behind the LiDAR."""
_CLEAR_OF_HULL = 0.06
_POLE_RADIUS = 0.3
_OPTICAL_FROM_FORWARD = SE3(handedness.camera_from_lidar(np.eye(4)))
"""A frame with x forward, y left, z up → the optical one."""


@dataclass(frozen=True, eq=False)
class Camera:
    """A camera of an agent; it looks along the LiDAR's x-y plane.

    Attributes:
        channel: one of `taxonomy.CAMERAS`.
        camera_from_lidar: LiDAR frame → optical frame.
        optics: the pinhole camera.
    """

    channel: str
    camera_from_lidar: SE3
    optics: PinholeCamera

    @cached_property
    def lidar_from_camera(self) -> SE3:
        """Optical frame → LiDAR frame."""
        return self.camera_from_lidar.inverse()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Agent:
    """Who records.

    Attributes:
        name: one of `taxonomy.AGENTS`.
        row: of its own actor, None for the pole.
        box_from_ego: the ego frame in the frame of the own box's centre on the road; of the pole, in the ground frame.
        ego_from_lidar: the LiDAR's pose on the agent.
        cameras: all six.
    """

    name: AgentName
    row: int | None
    box_from_ego: SE3
    ego_from_lidar: SE3
    cameras: tuple[Camera, ...]

    def ground_from_ego(self, scene: Scene) -> SE3:
        """The agent's pose at a moment, as the ground tilts it."""
        return self.box_from_ego if self.row is None else SE3(scene.frames[self.row]) @ self.box_from_ego

    def ground_from_lidar(self, scene: Scene) -> SE3:
        """The LiDAR's pose at a moment."""
        return self.ground_from_ego(scene) @ self.ego_from_lidar

    def calib(self, world_from_ego: SE3) -> Calib:
        """What the calib file of one frame says."""
        return Calib(
            ego_from_lidar=self.ego_from_lidar,
            world_from_ego=world_from_ego,
            camera_from_lidar={camera.channel: camera.camera_from_lidar for camera in self.cameras},
            intrinsic={camera.channel: camera.optics.intrinsic for camera in self.cameras},
        )


def make_agents(
    world: World, actors: Actors, ids: Mapping[AgentName, int], image_size: tuple[int, int]
) -> tuple[Agent, ...]:
    """The five agents of a scenario, in the order of `taxonomy.AGENTS`.

    Args:
        world: where the pole stands.
        actors: the road users.
        ids: actor ids of the four vehicle agents.
        image_size: width and height, pixels.
    """
    rows = {name: actors.row_of(ids[name]) for name in VEHICLE_AGENTS}
    vehicles = [_vehicle(name, row, actors.all[row], image_size) for name, row in rows.items()]
    pole = Agent(
        name=INFRASTRUCTURE,
        row=None,
        box_from_ego=world.lidar_pole,
        ego_from_lidar=SE3.identity(),
        cameras=_cameras(_pole_places(), image_size),
    )
    return (*vehicles, pole)


def _vehicle(name: AgentName, row: int, actor: Actor, image_size: tuple[int, int]) -> Agent:
    x, y = actor.origin
    return Agent(
        name=name,
        row=row,
        box_from_ego=SE3.from_rotation(np.eye(3), (x, y, 0.0)),
        ego_from_lidar=SE3.from_rotation(np.eye(3), (0.0, 0.0, _lidar_height(actor))),
        cameras=_cameras(_vehicle_places(actor), image_size),
    )


def _lidar_height(actor: Actor) -> float:
    roof = actor.size[2]
    return LIDAR_HEIGHT if roof + _LEAST_ABOVE_ROOF <= LIDAR_HEIGHT else roof + _ABOVE_ROOF


def _vehicle_places(actor: Actor) -> dict[str, tuple[float, float]]:
    """x, y of each camera in the LiDAR frame, metres: outside the hull, so that it is in no picture."""
    length, width, _ = actor.size
    x, y = actor.origin
    front, back = length / 2 - x + _CLEAR_OF_HULL, -length / 2 - x - _CLEAR_OF_HULL
    left, right = width / 2 - y + _CLEAR_OF_HULL, -width / 2 - y - _CLEAR_OF_HULL
    places = (
        (max(front, _FRONT), 0.0),
        (0.8, left),
        (0.8, right),
        (min(back, -_BACK), 0.0),
        (-0.6, left),
        (-0.6, right),
    )
    return dict(zip(CAMERAS, places, strict=True))


def _pole_places() -> dict[str, tuple[float, float]]:
    return {
        camera: (_POLE_RADIUS * float(np.cos(yaw)), _POLE_RADIUS * float(np.sin(yaw)))
        for camera, yaw in _CAMERA_YAW.items()
    }


def _cameras(places: dict[str, tuple[float, float]], image_size: tuple[int, int]) -> tuple[Camera, ...]:
    return tuple(
        Camera(
            channel,
            _OPTICAL_FROM_FORWARD @ SE3.from_yaw(_CAMERA_YAW[channel], (x, y, -_BELOW_LIDAR)).inverse(),
            PinholeCamera.from_field_of_view(*image_size, _FIELD_OF_VIEW[channel]),
        )
        for channel, (x, y) in places.items()
    )
