"""The five agents: their coordinate frames, how their sensors are mounted, and their calib files."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from deepaccident_devkit.geometry import SE3, PinholeCamera, conventions, quaternions
from deepaccident_devkit.geometry.se3 import trusted_se3
from deepaccident_devkit.plugins.synth.actors import Actor, Actors
from deepaccident_devkit.plugins.synth.plan import RigName
from deepaccident_devkit.plugins.synth.sensors.scene import Scene
from deepaccident_devkit.plugins.synth.world import World
from deepaccident_devkit.release import Calib
from deepaccident_devkit.support.arrays import FloatArray
from deepaccident_devkit.taxonomy import CAMERAS, INFRASTRUCTURE, VEHICLE_AGENTS, AgentName

# The pole's cameras are placed as on a vehicle of this length and width (metres) with the x and y axes exchanged.
POLE_LENGTH, POLE_WIDTH = 4.9373, 8.9666
_CAMERA_YAW = dict(
    zip(CAMERAS, np.deg2rad([0.0, 55.0, -55.0, 180.0, 110.0, -110.0]).tolist(), strict=True)
)
# Camera → its place on the box: 1 front or left, −1 back or right, 0 neither.
_SIDES = dict(zip(CAMERAS, ((1, 0), (1, 1), (1, -1), (-1, 0), (-1, 1), (-1, -1)), strict=True))


@dataclass(frozen=True, slots=True)
class Mount:
    """How a vehicle's sensors are mounted.

    Attributes:
        above_roof: metres of its LiDAR above its label box, which stands on the road.
        below_lidar: how much lower its cameras are; the pole's cameras are as high as its LiDAR.
        field_of_view: degrees, of all cameras but the one that looks back.
        backwards: degrees, of that one.
    """

    above_roof: float
    below_lidar: float
    field_of_view: float
    backwards: float


MOUNTS: Mapping[RigName, Mount] = {
    "released": Mount(0.5, 0.3, 70.0, 110.0),
    "road": Mount(0.2, 0.4, 64.6, 89.3),  # nuScenes' focal lengths: 1266 and 809 pixels of 1600
}
# Metres from the face of the box to a camera, so that its rays do not begin inside the vehicle's body.
_CLEAR_OF_HULL = 0.001
# A coordinate frame with x forward, y left, z up → the optical frame.
_OPTICAL_FROM_FORWARD = SE3(conventions.camera_from_lidar(np.eye(4)))


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
    """An agent, as the one that records.

    Attributes:
        name: one of `taxonomy.AGENTS`.
        row: row of its own actor; None for the pole.
        box_from_ego: ego frame → frame of its own box, with the origin on the road; for the pole, `ground_from_ego`.
        ego_from_lidar: the LiDAR's pose on the agent.
        cameras: all six cameras.
    """

    name: AgentName
    row: int | None
    box_from_ego: SE3
    ego_from_lidar: SE3
    cameras: tuple[Camera, ...]

    def ground_from_ego(self, scene: Scene) -> SE3:
        """The agent's pose at a moment, with the tilt of the ground."""
        return (
            self.box_from_ego
            if self.row is None
            else SE3(scene.frames[self.row]) @ self.box_from_ego
        )

    def ground_from_lidar(self, scene: Scene) -> SE3:
        """The LiDAR's pose at a moment."""
        return self.ground_from_ego(scene) @ self.ego_from_lidar

    def calib(self, world_from_ego: SE3) -> Calib:
        """The calib of one frame."""
        return Calib(
            ego_from_lidar=self.ego_from_lidar,
            world_from_ego=world_from_ego,
            camera_from_lidar={camera.channel: camera.camera_from_lidar for camera in self.cameras},
            intrinsic={camera.channel: camera.optics.intrinsic for camera in self.cameras},
        )


def make_agents(
    world: World,
    actors: Actors,
    ids: Mapping[AgentName, int],
    image_size: tuple[int, int],
    mount: Mount = MOUNTS["released"],
) -> tuple[Agent, ...]:
    """The five agents, in the order of `taxonomy.AGENTS`; `ids` are the actors of the four that are vehicles."""
    rows = {name: actors.row_of(ids[name]) for name in VEHICLE_AGENTS}
    vehicles = [
        _vehicle(name, row, actors.all[row], image_size, mount) for name, row in rows.items()
    ]
    pole = Agent(
        name=INFRASTRUCTURE,
        row=None,
        box_from_ego=world.lidar_pole,
        ego_from_lidar=SE3.identity(),
        cameras=_cameras(_pole_places(), 0.0, image_size, mount),
    )
    return (*vehicles, pole)


def _vehicle(
    name: AgentName, row: int, actor: Actor, image_size: tuple[int, int], mount: Mount
) -> Agent:
    x, y = actor.origin
    return Agent(
        name=name,
        row=row,
        box_from_ego=SE3.from_rotation(np.eye(3), (x, y, 0.0)),
        ego_from_lidar=SE3.from_rotation(np.eye(3), (0.0, 0.0, actor.size[2] + mount.above_roof)),
        cameras=_cameras(_vehicle_places(actor), -mount.below_lidar, image_size, mount),
    )


def _vehicle_places(actor: Actor) -> dict[str, tuple[float, float]]:
    """x, y of each camera in the LiDAR frame, metres: in the middle of the box's front and back, and at its corners."""
    length, width, _ = actor.size
    x, y = actor.origin
    ahead, aside = length / 2 + _CLEAR_OF_HULL, width / 2 + _CLEAR_OF_HULL
    return {
        camera: (along * ahead - x, across * aside - y)
        for camera, (along, across) in _SIDES.items()
    }


def _pole_places() -> dict[str, tuple[float, float]]:
    """x, y of each camera in the LiDAR frame, metres."""
    return {
        camera: (-across * POLE_WIDTH / 2, along * POLE_LENGTH / 2)
        for camera, (along, across) in _SIDES.items()
    }


def _cameras(
    places: dict[str, tuple[float, float]], height: float, image_size: tuple[int, int], mount: Mount
) -> tuple[Camera, ...]:
    """All cameras at x, y in the LiDAR frame and at a height above the LiDAR, metres."""
    views = dict.fromkeys(CAMERAS, mount.field_of_view) | {"Camera_Back": mount.backwards}
    return tuple(
        Camera(
            channel,
            _OPTICAL_FROM_FORWARD @ SE3.from_yaw(_CAMERA_YAW[channel], (x, y, height)).inverse(),
            PinholeCamera.from_field_of_view(*image_size, float(np.deg2rad(views[channel]))),
        )
        for channel, (x, y) in places.items()
    )


def with_single_precision(calib: Calib) -> Calib:
    """The calib of one frame as in the release: made from world poses of single precision.

    The simulator has each sensor's pose in the world in single precision, which at some hundred metres has steps of
    0.03 mm, and the release's makers multiplied the inverse of one pose with another. So a transform between two
    sensors that never move relative to each other differs from frame to frame by up to 0.1 mm, and its rotation is
    rigid only to about 1e-7. This function does the same, without random numbers. Intrinsics do not change.
    """
    world_from_lidar = calib.world_from_ego.matrix @ calib.ego_from_lidar.matrix
    lidar_from_camera = np.linalg.inv(
        np.stack([pose.matrix for pose in calib.camera_from_lidar.values()])
    )
    world_from_ego, lidar = (
        _single(calib.world_from_ego.matrix),
        _single(_by_quaternion(world_from_lidar)),
    )
    camera_from_world = np.linalg.inv(_single(world_from_lidar @ lidar_from_camera))
    return Calib(
        ego_from_lidar=trusted_se3(np.linalg.inv(world_from_ego) @ lidar),
        world_from_ego=trusted_se3(world_from_ego),
        camera_from_lidar={
            channel: trusted_se3(pose)
            for channel, pose in zip(
                calib.camera_from_lidar, camera_from_world @ lidar, strict=True
            )
        },
        intrinsic=calib.intrinsic,
    )


def _single(matrices: FloatArray) -> FloatArray:
    return matrices.astype(np.float32).astype(np.float64)


def _by_quaternion(matrix: FloatArray) -> FloatArray:
    """A pose (4, 4) whose rotation was converted to a quaternion of single precision and back: it differs a little."""
    turned = matrix.copy()
    turned[:3, :3] = quaternions.to_matrix(_single(quaternions.from_matrix(matrix[:3, :3])))
    return turned
