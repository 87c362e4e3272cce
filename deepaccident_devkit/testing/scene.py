"""The content of the test kit's small releases: sensor setup, road users, sensors, and files."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from deepaccident_devkit.geometry import SE3, Boxes, BoxVisibility, PinholeCamera
from deepaccident_devkit.release import (
    Calib,
    Labels,
    ScenarioFolder,
    label_from_world_velocity,
    write_bev,
    write_calib,
    write_image,
    write_label,
    write_lidar,
)
from deepaccident_devkit.release.npz import TAGS
from deepaccident_devkit.release.store import real_path
from deepaccident_devkit.support.arrays import BoolArray, ByteArray, FloatArray, as_floats
from deepaccident_devkit.taxonomy import (
    AGENTS,
    BEV_CAMERA,
    BEV_RESOLUTION,
    BEV_SHAPE,
    CAMERAS,
    CATEGORIES,
    FRAME_PERIOD,
    INFRASTRUCTURE,
    LIDAR,
    OWN_ACTOR_ID,
    POLE_HEIGHT,
    UNTRACKED_ID,
    VEHICLE_AGENTS,
    AgentName,
)

AGENT_IDS = (1223, 1236, 1212, 1237)
"""Actor ids of `taxonomy.VEHICLE_AGENTS`."""
FAR_ACTOR_ID = 1399
"""The pedestrian that is untracked (−1) in every label."""
PAIR: tuple[AgentName, AgentName] = ("ego_vehicle", "other_vehicle")
"""The colliding agents."""
_LIDAR_HEIGHT_M = 1.94
_CAMERA_YAW_RAD = dict(
    zip(CAMERAS, np.deg2rad([0.0, 55.0, -55.0, 180.0, 110.0, -110.0]).tolist(), strict=True)
)
# Distance of a camera from the LiDAR's axis, and under the LiDAR.
_CAMERA_RADIUS_M = 1.0
_CAMERA_DROP_M = 0.3
_OPTICAL_FROM_FORWARD = SE3.from_rotation([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
# Distance that the other vehicle and its follower are farther back in a normal scenario.
_NORMAL_OFFSET_M = 15.0
# Points on a box 1 m away; their number decreases with the distance.
_POINTS_AT_1_M = 120.0
_MAX_BOX_POINTS = 20
_GROUND_RADII_M = (6.0, 12.0, 24.0)
_POINTS_PER_RING = 12
_LIDAR_RANGE_M = 65.0
_MIN_DEPTH_M = 0.5
# RGB of each of `taxonomy.CATEGORIES`.
_COLORS = np.array(
    [(200, 40, 40), (40, 80, 200), (40, 160, 60), (220, 180, 40), (160, 60, 180), (240, 120, 40)]
)
# Row and column of the agent in a BEV array.
_AGENT_PIXEL = (BEV_SHAPE[0] - 1) / 2
# The file has a quarter of the bytes of the writer's default, which is faster.
_BEV_COMPRESSION = 6


def _cameras(image_size: tuple[int, int]) -> dict[str, PinholeCamera]:
    """Return channel → camera for images of a (width, height), with fields of view of 70°.

    The back camera has 110°.
    """
    cameras = {}
    for channel in CAMERAS:
        field = np.deg2rad(110.0 if channel == "Camera_Back" else 70.0)
        cameras[channel] = PinholeCamera.from_field_of_view(*image_size, field)
    return cameras


def calib_of(agent: AgentName, world_from_ego: SE3, image_size: tuple[int, int]) -> Calib:
    """Return an agent's calibration for one frame."""
    lidar_height = 0.0 if agent == INFRASTRUCTURE else _LIDAR_HEIGHT_M
    cameras = _cameras(image_size)
    return Calib(
        ego_from_lidar=SE3.from_yaw(0.0, (0.0, 0.0, lidar_height)),
        world_from_ego=world_from_ego,
        camera_from_lidar={
            channel: _camera_from_lidar(yaw) for channel, yaw in _CAMERA_YAW_RAD.items()
        },
        intrinsic={channel: camera.intrinsic for channel, camera in cameras.items()},
    )


def _camera_from_lidar(yaw: float) -> SE3:
    position = (_CAMERA_RADIUS_M * np.cos(yaw), _CAMERA_RADIUS_M * np.sin(yaw), -_CAMERA_DROP_M)
    return _OPTICAL_FROM_FORWARD @ SE3.from_yaw(yaw, position).inverse()


@dataclass(frozen=True, slots=True, kw_only=True)
class _MovingBox:
    """A box on the ground that moves straight ahead; ground frame, right-handed, metres.

    Attributes:
        actor_id: CARLA's id.
        category: Class name.
        size: Length, width, height.
        end: x and y of its centre at the last frame.
        yaw: Heading, radians, counter-clockwise.
        speed: Speed, m/s.
    """

    actor_id: int
    category: str
    size: tuple[float, float, float]
    end: tuple[float, float]
    yaw: float
    speed: float


_SOUTH_TO_NORTH = np.pi / 2
_EAST_TO_WEST = np.pi
_CAR = (4.6, 1.9, 1.5)
_VAN = (4.5, 2.0, 2.0)
# At the last frame the ego's front touches the left side of the other vehicle, by 0.1 m of overlap.
_AGENTS = (
    _MovingBox(actor_id=1223, category="car", size=_CAR, end=(-1.4, -1.75), yaw=0.0, speed=9.0),
    _MovingBox(actor_id=1236, category="van", size=_VAN, end=(-11.4, -1.75), yaw=0.0, speed=9.0),
    _MovingBox(
        actor_id=1212, category="car", size=_CAR, end=(1.75, -1.75), yaw=_SOUTH_TO_NORTH, speed=7.0
    ),
    _MovingBox(
        actor_id=1237, category="car", size=_CAR, end=(1.75, -12.0), yaw=_SOUTH_TO_NORTH, speed=7.0
    ),
)
_TRAFFIC = (
    _MovingBox(
        actor_id=1301,
        category="truck",
        size=(8.4, 2.6, 3.6),
        end=(18.0, 1.75),
        yaw=_EAST_TO_WEST,
        speed=6.0,
    ),
    _MovingBox(
        actor_id=1302,
        category="cyclist",
        size=(1.64, 0.5, 1.77),
        end=(5.5, 12.0),
        yaw=np.pi / 2,
        speed=4.0,
    ),
    _MovingBox(
        actor_id=1303,
        category="motorcycle",
        size=(2.2, 0.86, 1.5),
        end=(-1.75, 20.0),
        yaw=-np.pi / 2,
        speed=7.0,
    ),
    _MovingBox(
        actor_id=1304,
        category="pedestrian",
        size=(0.4, 0.4, 1.86),
        end=(-8.0, 6.0),
        yaw=0.0,
        speed=1.2,
    ),
    _MovingBox(actor_id=20001, category="car", size=_CAR, end=(-24.0, -5.5), yaw=0.0, speed=0.0),
    _MovingBox(
        actor_id=FAR_ACTOR_ID,
        category="pedestrian",
        size=(0.4, 0.4, 1.86),
        end=(70, 8),
        yaw=2.2,
        speed=0.0,
    ),
)
_POLE_POSITION = (8.0, 8.0, POLE_HEIGHT)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SmallScene:
    """Motion of all road users in one scenario.

    Attributes:
        world_from_ground: Pose of the junction in its town.
        users: All road users, starting with the four vehicle agents.
        frames: Number of recorded frames.
    """

    world_from_ground: SE3
    users: Sequence[_MovingBox]
    frames: int

    def boxes(self, frame: int) -> Boxes:
        """Return the boxes of all users at a frame (from 1), world frame.

        They have neither points nor visibility yet.
        """
        seconds = (self.frames - frame) * FRAME_PERIOD
        yaw = np.array([user.yaw for user in self.users])
        size = np.array([user.size for user in self.users])
        speed = np.array([user.speed for user in self.users])
        velocity = speed[:, None] * np.column_stack([np.cos(yaw), np.sin(yaw), np.zeros(len(yaw))])
        end_xy = np.array([user.end for user in self.users])
        ends = np.column_stack([end_xy, size[:, 2] / 2])
        centers = ends - velocity * seconds
        return Boxes.from_arrays(
            self.world_from_ground.apply(centers),
            size,
            yaw + self.world_from_ground.yaw,
            frame="world",
            category=[user.category for user in self.users],
            velocity=velocity @ self.world_from_ground.rotation.T,
            actor_id=[user.actor_id for user in self.users],
        )

    def world_from_ego(self, agent: AgentName, frame: int) -> SE3:
        """Return an agent's pose at a frame: on the road under its box, or at the pole's LiDAR."""
        if agent not in VEHICLE_AGENTS:
            return self.world_from_ground @ SE3.from_yaw(0.0, _POLE_POSITION)
        boxes = self.boxes(frame)
        row = VEHICLE_AGENTS.index(agent)
        position = boxes.center[row] - (0.0, 0.0, boxes.size[row, 2] / 2)
        return SE3.from_yaw(float(boxes.yaw[row]), position)


def small_scene(rng: np.random.Generator, *, frames: int, accident: bool) -> SmallScene:
    """Return a scene with a random position in its town and random speeds.

    They are the same with and without the accident.
    """
    x = rng.uniform(-200.0, 200.0)
    y = rng.uniform(-200.0, 200.0)
    yaw = rng.uniform(-np.pi, np.pi)
    ego_speed, other_speed = rng.uniform(0.8, 1.2, 2).tolist()
    factors = (ego_speed, ego_speed, other_speed, other_speed)
    agents = []
    for user, factor in zip(_AGENTS, factors, strict=True):
        agents.append(replace(user, speed=user.speed * factor))
    if not accident:
        for index in (2, 3):
            end_x, end_y = agents[index].end
            agents[index] = replace(agents[index], end=(end_x, end_y - _NORMAL_OFFSET_M))
    return SmallScene(
        world_from_ground=SE3.from_yaw(yaw, (x, y, 0.3)), users=(*agents, *_TRAFFIC), frames=frames
    )


def cloud_of(boxes: Boxes, lidar_height: float) -> FloatArray:
    """Return points in the LiDAR frame, shape (N, 3), metres, in its boxes and on the ground.

    They are rounded to the file's float32.
    """
    parts = [_ground_points(lidar_height)]
    distance = np.linalg.norm(boxes.center[:, :2], axis=1)
    points = np.clip(_POINTS_AT_1_M / np.maximum(distance, 1.0), 1, _MAX_BOX_POINTS)
    counts = points.astype(int) * (distance < _LIDAR_RANGE_M)
    for center, size, yaw, count in zip(
        boxes.center, boxes.size, boxes.yaw, counts.tolist(), strict=True
    ):
        box_points = _spread_points(count) * size
        turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
        parts.append(center + box_points @ turn.T)
    return np.concatenate(parts).astype(np.float32).astype(np.float64)


def _picture_of(
    boxes: Boxes, camera: PinholeCamera, *, sky: tuple[int, int, int], road: tuple[int, int, int]
) -> ByteArray:
    """Return a picture (H, W, 3), RGB: sky, road, and outlines of boxes in their classes' colours.

    Boxes are in the optical frame, and distant ones are drawn first. Sky and road should differ
    between all pictures, so that no two files are equal.
    """
    import cv2

    picture = np.empty((camera.height, camera.width, 3), dtype=np.uint8)
    horizon = camera.height // 2
    picture[:horizon], picture[horizon:] = sky, road
    corners = boxes.corners()
    for row in np.argsort(-boxes.center[:, 2]).tolist():
        pixels, depth = camera.project(corners[row])
        if (depth > _MIN_DEPTH_M).all():
            outline = cv2.convexHull(np.rint(np.clip(pixels, -1e4, 1e4)).astype(np.int32))
            cv2.fillConvexPoly(picture, outline, _COLORS[boxes.category[row]].tolist())
    return picture


def top_view_of(
    boxes: Boxes, object_ids: NDArray[np.uint16]
) -> tuple[ByteArray, NDArray[np.uint16]]:
    """Return CARLA's tags, uint8, and object ids, uint16, around an agent, shape (1200, 1200) each.

    Forward is up, and left is left.
    """
    import cv2

    semantic = np.full(BEV_SHAPE, TAGS["road"], dtype=np.uint8)
    instance = np.zeros(BEV_SHAPE, dtype=np.uint16)
    rows = zip(boxes.bottom_corners(), boxes.category.tolist(), object_ids.tolist(), strict=True)
    for corners, code, number in rows:
        xy = corners[:, :2]
        if np.abs(xy).max() * 2 < BEV_RESOLUTION * BEV_SHAPE[0]:
            # OpenCV takes column, row.
            outline = np.rint(_AGENT_PIXEL - xy[:, ::-1] / BEV_RESOLUTION).astype(np.int32)
            tag = TAGS["pedestrian" if CATEGORIES[code] == "pedestrian" else "vehicle"]
            cv2.fillConvexPoly(semantic, outline, tag)
            cv2.fillConvexPoly(instance, outline, number)
    return semantic, instance


def _spread_points(count: int) -> FloatArray:
    """Return points (count, 3) in a box with edges of 1 around 0, evenly distributed.

    They are a little away from its faces.
    """
    # The R3 sequence.
    steps = np.arange(1, count + 1)[:, None] * (0.8191725, 0.6710436, 0.5497005)
    return as_floats((steps % 1.0 - 0.5) * 0.9)


def _ground_points(lidar_height: float) -> FloatArray:
    angle = np.linspace(0.0, 2 * np.pi, _POINTS_PER_RING, endpoint=False)
    rings = []
    for radius in _GROUND_RADII_M:
        rings.append(np.column_stack([radius * np.cos(angle), radius * np.sin(angle)]))
    xy = np.concatenate(rings)
    return np.column_stack([xy, np.full(len(xy), -lidar_height)])


class Recorder:
    """Writes an agent's recording at a frame (from 1), file by file; image sizes are in pixels."""

    def __init__(
        self,
        folder: ScenarioFolder,
        scene: SmallScene,
        agent: AgentName,
        frame: int,
        image_size: tuple[int, int],
    ) -> None:
        self._folder = folder
        self._agent = agent
        self._frame = frame
        self._cameras = _cameras(image_size)
        self._calib = calib_of(agent, scene.world_from_ego(agent, frame), image_size)
        world = scene.boxes(frame)
        # The own row, if any, comes first.
        self._own = np.arange(len(world)) < (agent in VEHICLE_AGENTS)
        if agent in VEHICLE_AGENTS:
            own = VEHICLE_AGENTS.index(agent)
            world = world.select([own, *(row for row in range(len(world)) if row != own)])
        self._velocity = world.velocity[:, :2]
        world_from_lidar = self._calib.world_from_ego @ self._calib.ego_from_lidar
        self._boxes = world.transform(world_from_lidar.inverse(), "lidar")
        height = self._calib.ego_from_lidar.translation[2] if self._own.any() else POLE_HEIGHT
        self._cloud = cloud_of(self._boxes.select(~self._own), float(height))

    def write_calib(self) -> None:
        """Write the poses and cameras."""
        path = real_path(self._folder.calib_path(self._agent, self._frame))
        write_calib(path, self._calib)

    def write_label(self) -> None:
        """Write the boxes, the own row first; the distant pedestrian is not tracked."""
        labels = self._labels()
        points = labels.boxes().count_points(self._cloud)
        path = real_path(self._folder.label_path(self._agent, self._frame))
        write_label(path, replace(labels, num_lidar_pts=points))

    def write_channel(self, channel: str) -> None:
        """Write the file of one sensor."""
        path = real_path(self._folder.channel_path(self._agent, channel, self._frame))
        if channel == LIDAR:
            write_lidar(path, self._cloud, np.linspace(0.0, 1.0, len(self._cloud)))
        elif channel == BEV_CAMERA:
            object_ids = np.arange(1, len(self._boxes) + 1, dtype=np.uint16)
            write_bev(path, *top_view_of(self._boxes, object_ids), level=_BEV_COMPRESSION)
        else:
            write_image(path, self._picture(channel))

    def _picture(self, channel: str) -> ByteArray:
        others = self._boxes.select(~self._own)
        boxes = others.transform(self._calib.camera_from_lidar[channel], channel)
        sky = (120 + 12 * AGENTS.index(self._agent), 130 + 12 * CAMERAS.index(channel), 200)
        road = (40 + self._frame, 40 + self._frame, 45 + self._frame)
        return _picture_of(boxes, self._cameras[channel], sky=sky, road=road)

    def _labels(self) -> Labels:
        """Return the content of the label, without numbers of points."""
        boxes = self._boxes
        yaw = np.where(self._own, 0.0, boxes.yaw)
        return Labels(
            raw=False,
            num_boxes=np.array([len(boxes)]),
            agent_velocity=self._velocity[self._own] if self._own.any() else np.zeros((1, 2)),
            category=boxes.category,
            center=boxes.center,
            size=boxes.size,
            yaw=yaw,
            velocity=label_from_world_velocity(self._velocity, yaw),
            actor_id=np.select(
                [self._own, boxes.actor_id == FAR_ACTOR_ID],
                [OWN_ACTOR_ID, UNTRACKED_ID],
                boxes.actor_id,
            ),
            num_lidar_pts=np.zeros(len(boxes), dtype=np.int64),
            camera_visible=self._visible(),
        )

    def _visible(self) -> BoolArray:
        """Return whether a corner of the box is in any picture, shape (N,).

        No actor hides another.
        """
        visible = np.zeros(len(self._boxes), dtype=bool)
        for channel, camera in self._cameras.items():
            boxes = self._boxes.transform(self._calib.camera_from_lidar[channel], channel)
            visible |= camera.boxes_in_image(boxes, BoxVisibility.ANY)
        return visible & ~self._own
