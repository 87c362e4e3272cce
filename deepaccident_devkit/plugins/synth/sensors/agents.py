"""The five agents: their coordinate frames, their sensors, and their calib files."""

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

# Length and width of a vehicle, metres. The pole's cameras are placed as on this vehicle, with the
# x and y axes exchanged.
POLE_LENGTH, POLE_WIDTH = 4.9373, 8.9666
_CAMERA_YAW = dict(
    zip(CAMERAS, np.deg2rad([0.0, 55.0, -55.0, 180.0, 110.0, -110.0]).tolist(), strict=True)
)
# Position of each camera on the box, along and across it: 1 is the front or the left, −1 the back
# or the right, 0 the middle.
_CAMERA_SIDES = dict(
    zip(CAMERAS, ((1, 0), (1, 1), (1, -1), (-1, 0), (-1, 1), (-1, -1)), strict=True)
)
# Distance from the face of the box to a camera, so that its rays do not begin in the vehicle.
_HULL_CLEARANCE_M = 0.001
# Transform from a coordinate frame with x forward, y left, z up to the optical frame.
_OPTICAL_FROM_FORWARD = SE3(conventions.camera_from_lidar(np.eye(4)))


@dataclass(frozen=True, slots=True)
class Mount:
    """The mounting of a vehicle's sensors.

    Attributes:
        above_roof: Height of its LiDAR above its label box, which stands on the road, metres.
        below_lidar: Distance of its cameras below its LiDAR, metres; the pole's cameras are as high
            as its LiDAR.
        field_of_view: Field of view of all cameras except the rear one, degrees.
        rear_field_of_view: Field of view of the rear camera, degrees.
    """

    above_roof: float
    below_lidar: float
    field_of_view: float
    rear_field_of_view: float


MOUNTS: Mapping[RigName, Mount] = {
    "released": Mount(0.5, 0.3, 70.0, 110.0),
    "road": Mount(0.2, 0.4, 64.6, 89.3),  # nuScenes' focal lengths: 1266 and 809 pixels of 1600
}


@dataclass(frozen=True, eq=False)
class Camera:
    """A camera of an agent; it looks along the LiDAR's x-y plane.

    Attributes:
        channel: One of `taxonomy.CAMERAS`.
        camera_from_lidar: Transform from the LiDAR frame to the optical frame.
        optics: The pinhole camera.
    """

    channel: str
    camera_from_lidar: SE3
    optics: PinholeCamera

    @cached_property
    def lidar_from_camera(self) -> SE3:
        """Transform from the optical frame to the LiDAR frame."""
        return self.camera_from_lidar.inverse()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Agent:
    """An agent with its sensors.

    Attributes:
        name: One of `taxonomy.AGENTS`.
        row: Row of its actor; None for the pole.
        box_from_ego: Transform from the ego frame to the frame of its own box, with the origin on
            the road; for the pole, `ground_from_ego`.
        ego_from_lidar: Pose of the LiDAR on the agent.
        cameras: All six cameras.
    """

    name: AgentName
    row: int | None
    box_from_ego: SE3
    ego_from_lidar: SE3
    cameras: tuple[Camera, ...]

    def ground_from_ego(self, scene: Scene) -> SE3:
        """Return the agent's pose at a moment, with the tilt of the ground."""
        if self.row is None:
            return self.box_from_ego
        return SE3(scene.frames[self.row]) @ self.box_from_ego

    def ground_from_lidar(self, scene: Scene) -> SE3:
        """Return the LiDAR's pose at a moment."""
        ground_from_ego = self.ground_from_ego(scene)
        return ground_from_ego @ self.ego_from_lidar

    def calib(self, world_from_ego: SE3) -> Calib:
        """Return the calib of one frame."""
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
    """Make the five agents, in the order of `taxonomy.AGENTS`.

    Args:
        world: The static world.
        actors: The road users.
        ids: Actor ids of the four vehicle agents.
        image_size: Width and height of images, pixels.
        mount: Mounting of the sensors.
    """
    agents = []
    for name in VEHICLE_AGENTS:
        row = actors.row_of(ids[name])
        agents.append(_make_vehicle(name, row, actors.all[row], image_size, mount))
    pole = Agent(
        name=INFRASTRUCTURE,
        row=None,
        box_from_ego=world.lidar_pole,
        ego_from_lidar=SE3.identity(),
        cameras=_make_cameras(_place_pole_cameras(), 0.0, image_size, mount),
    )
    return (*agents, pole)


def _make_vehicle(
    name: AgentName, row: int, actor: Actor, image_size: tuple[int, int], mount: Mount
) -> Agent:
    """Make the agent of a vehicle.

    Args:
        name: Name of the agent.
        row: Row of the agent's actor.
        actor: The agent's actor.
        image_size: Width and height of images, pixels.
        mount: Mounting of the sensors.
    """
    x, y = actor.origin
    lidar_height = actor.size[2] + mount.above_roof
    no_rotation = np.eye(3)
    return Agent(
        name=name,
        row=row,
        box_from_ego=SE3.from_rotation(no_rotation, (x, y, 0.0)),
        ego_from_lidar=SE3.from_rotation(no_rotation, (0.0, 0.0, lidar_height)),
        cameras=_make_cameras(_place_vehicle_cameras(actor), -mount.below_lidar, image_size, mount),
    )


def _place_vehicle_cameras(actor: Actor) -> dict[str, tuple[float, float]]:
    """Return x, y of each camera in the LiDAR frame, metres.

    They are in the middle of the box's front and back, and at its corners.
    """
    length, width, _ = actor.size
    x, y = actor.origin
    half_length = length / 2 + _HULL_CLEARANCE_M
    half_width = width / 2 + _HULL_CLEARANCE_M
    positions = {}
    for camera, (along, across) in _CAMERA_SIDES.items():
        positions[camera] = (along * half_length - x, across * half_width - y)
    return positions


def _place_pole_cameras() -> dict[str, tuple[float, float]]:
    """Return x, y of each camera of the pole in the LiDAR frame, metres."""
    positions = {}
    for camera, (along, across) in _CAMERA_SIDES.items():
        positions[camera] = (-across * POLE_WIDTH / 2, along * POLE_LENGTH / 2)
    return positions


def _make_cameras(
    positions: dict[str, tuple[float, float]],
    height: float,
    image_size: tuple[int, int],
    mount: Mount,
) -> tuple[Camera, ...]:
    """Make all cameras of an agent.

    Args:
        positions: x, y of each camera in the LiDAR frame, metres.
        height: Height above the LiDAR, metres.
        image_size: Width and height of images, pixels.
        mount: Mounting of the sensors.
    """
    cameras = []
    for channel, (x, y) in positions.items():
        lidar_from_forward = SE3.from_yaw(_CAMERA_YAW[channel], (x, y, height))
        camera_from_lidar = _OPTICAL_FROM_FORWARD @ lidar_from_forward.inverse()
        degrees = mount.rear_field_of_view if channel == "Camera_Back" else mount.field_of_view
        field_of_view = float(np.deg2rad(degrees))
        optics = PinholeCamera.from_field_of_view(*image_size, field_of_view)
        cameras.append(Camera(channel, camera_from_lidar, optics))
    return tuple(cameras)


def with_single_precision(calib: Calib) -> Calib:
    """Return the calib of one frame as in the release: made from world poses of single precision.

    The simulator has each sensor's pose in the world in single precision, which at some hundred
    metres has steps of 0.03 mm, and the release's makers multiplied the inverse of one pose with
    another. So a transform between two sensors that never move relative to each other differs from
    frame to frame by up to 0.1 mm, and its rotation is rigid only to about 1e-7. This function does
    the same, without random numbers. Intrinsics do not change.
    """
    world_from_lidar = calib.world_from_ego.matrix @ calib.ego_from_lidar.matrix
    camera_matrices = [pose.matrix for pose in calib.camera_from_lidar.values()]
    lidar_from_camera = np.linalg.inv(np.stack(camera_matrices))
    single_world_from_ego = _round_to_single(calib.world_from_ego.matrix)
    single_world_from_lidar = _round_to_single(_convert_by_quaternion(world_from_lidar))
    single_world_from_camera = _round_to_single(world_from_lidar @ lidar_from_camera)
    camera_from_lidar = np.linalg.inv(single_world_from_camera) @ single_world_from_lidar
    camera_poses = [trusted_se3(pose) for pose in camera_from_lidar]
    ego_from_lidar = np.linalg.inv(single_world_from_ego) @ single_world_from_lidar
    return Calib(
        ego_from_lidar=trusted_se3(ego_from_lidar),
        world_from_ego=trusted_se3(single_world_from_ego),
        camera_from_lidar=dict(zip(calib.camera_from_lidar, camera_poses, strict=True)),
        intrinsic=calib.intrinsic,
    )


def _round_to_single(matrices: FloatArray) -> FloatArray:
    """Round matrices to single precision."""
    single = matrices.astype(np.float32)
    return single.astype(np.float64)


def _convert_by_quaternion(pose: FloatArray) -> FloatArray:
    """Convert the rotation of a pose (4, 4) to a quaternion of single precision and back.

    The rotation changes slightly, as in the release.
    """
    converted = pose.copy()
    exact_quaternion = quaternions.from_matrix(pose[:3, :3])
    quaternion = _round_to_single(exact_quaternion)
    converted[:3, :3] = quaternions.to_matrix(quaternion)
    return converted
