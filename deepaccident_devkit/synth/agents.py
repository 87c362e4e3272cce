"""The five recording agents: their frames and how their sensors are mounted."""

from dataclasses import dataclass

import numpy as np

from deepaccident_devkit.geometry import SE3, PinholeCamera, handedness
from deepaccident_devkit.release import Calib
from deepaccident_devkit.synth.actors import Actor, Snapshot
from deepaccident_devkit.synth.scenario import Scenario
from deepaccident_devkit.taxonomy import CAMERAS, INFRASTRUCTURE, AgentName

LIDAR_HEIGHT = 1.94
"""Of a vehicle's LiDAR above its ego origin on the road, metres."""
_BELOW_LIDAR = 0.3
_CAMERA_YAW = dict(zip(CAMERAS, np.deg2rad([0.0, 55.0, -55.0, 180.0, 110.0, -110.0]).tolist(), strict=True))
_FIELD_OF_VIEW = {camera: float(np.deg2rad(110.0 if camera == "Camera_Back" else 70.0)) for camera in CAMERAS}
_FRONT, _BACK = 2.337, 2.096
"""Where the real release has its front and back cameras, metres ahead of and behind the LiDAR."""
_CLEAR_OF_HULL = 0.06
_POLE_RADIUS = 0.3
_OPTICAL_FROM_FORWARD = SE3(handedness.camera_from_lidar(np.eye(4)))
"""A frame with x forward, y left, z up → the optical one."""


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """A camera of an agent; it looks level, along the ground.

    Attributes:
        channel: one of `taxonomy.CAMERAS`.
        camera_from_lidar: LiDAR frame → optical frame.
        optics: the pinhole camera.
    """

    channel: str
    camera_from_lidar: SE3
    optics: PinholeCamera


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

    def ground_from_ego(self, snapshot: Snapshot) -> SE3:
        """The agent's pose at a moment."""
        if self.row is None:
            return self.box_from_ego
        x, y, yaw = snapshot.poses[self.row].tolist()
        return SE3.from_yaw(yaw, (x, y, 0.0)) @ self.box_from_ego

    def calib(self, world_from_ego: SE3) -> Calib:
        """What the calib file of one frame says."""
        return Calib(
            ego_from_lidar=self.ego_from_lidar,
            world_from_ego=world_from_ego,
            camera_from_lidar={camera.channel: camera.camera_from_lidar for camera in self.cameras},
            intrinsic={camera.channel: camera.optics.intrinsic for camera in self.cameras},
        )


def make_agents(scenario: Scenario, image_size: tuple[int, int]) -> tuple[Agent, ...]:
    """The five agents of a scenario, in the order of `taxonomy.AGENTS`; images of width, height pixels."""
    rows = {name: scenario.actors.row_of(actor_id) for name, actor_id in scenario.agents.items()}
    vehicles = [_vehicle(name, row, scenario.actors.all[row], image_size) for name, row in rows.items()]
    pole = Agent(
        name=INFRASTRUCTURE,
        row=None,
        box_from_ego=scenario.world.lidar_pole,
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
        ego_from_lidar=SE3.from_rotation(np.eye(3), (0.0, 0.0, LIDAR_HEIGHT)),
        cameras=_cameras(_vehicle_places(actor), image_size),
    )


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
