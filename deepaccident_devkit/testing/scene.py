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
# Distance of a camera from the LiDAR's axis, and below the LiDAR.
_CAMERA_RADIUS_M = 1.0
_CAMERA_DROP_M = 0.3
_OPTICAL_FROM_FORWARD = SE3.from_rotation([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
# Additional distance of the other vehicle and its follower from the junction in a normal scenario.
_NORMAL_OFFSET_M = 15.0
# Number of points on a box 1 m away; the number decreases with distance.
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
    """Return channel → camera, for images of `image_size` (width, height) in pixels.

    The horizontal field of view is 110° for the back camera, and 70° for the others.
    """
    cameras = {}
    for channel in CAMERAS:
        degrees = 110.0 if channel == "Camera_Back" else 70.0
        cameras[channel] = PinholeCamera.from_field_of_view(*image_size, np.deg2rad(degrees))
    return cameras


def calib_of(agent: AgentName, world_from_ego: SE3, image_size: tuple[int, int]) -> Calib:
    """Return an agent's calibration for one frame."""
    lidar_height = _LIDAR_HEIGHT_M
    if agent == INFRASTRUCTURE:
        lidar_height = 0.0
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
    x = _CAMERA_RADIUS_M * np.cos(yaw)
    y = _CAMERA_RADIUS_M * np.sin(yaw)
    lidar_from_forward = SE3.from_yaw(yaw, (x, y, -_CAMERA_DROP_M))
    return _OPTICAL_FROM_FORWARD @ lidar_from_forward.inverse()


@dataclass(frozen=True, slots=True, kw_only=True)
class _MovingBox:
    """A box on the ground that moves straight ahead; right-handed ground frame, in metres.

    Attributes:
        actor_id: CARLA id.
        category: Name of the class.
        size: Length, width and height.
        end: x and y of its centre in the last frame.
        yaw: Heading in radians, counter-clockwise.
        speed: Speed in m/s.
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
# In the last frame, the ego's front overlaps the left side of the other vehicle by 0.1 m.
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
        yaw=_SOUTH_TO_NORTH,
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
        users: All road users; the four vehicle agents come first.
        frames: Number of recorded frames.
    """

    world_from_ground: SE3
    users: Sequence[_MovingBox]
    frames: int

    def boxes(self, frame: int) -> Boxes:
        """Return the boxes of all road users in a frame (counted from 1), in the world frame.

        Their points are not counted yet, and their visibility is not set.
        """
        seconds = (self.frames - frame) * FRAME_PERIOD
        yaw = np.array([user.yaw for user in self.users])
        size = np.array([user.size for user in self.users])
        speed = np.array([user.speed for user in self.users])
        heading = np.column_stack([np.cos(yaw), np.sin(yaw), np.zeros(len(yaw))])
        velocity = speed[:, None] * heading
        end_xy = np.array([user.end for user in self.users])
        half_height = size[:, 2] / 2
        centers = np.column_stack([end_xy, half_height]) - velocity * seconds
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
        """Return an agent's pose in a frame: on the road under its box, or at the pole's LiDAR."""
        if agent not in VEHICLE_AGENTS:
            return self.world_from_ground @ SE3.from_yaw(0.0, _POLE_POSITION)
        boxes = self.boxes(frame)
        row = VEHICLE_AGENTS.index(agent)
        _, _, height = boxes.size[row]
        position = boxes.center[row] - (0.0, 0.0, height / 2)
        return SE3.from_yaw(float(boxes.yaw[row]), position)


def small_scene(rng: np.random.Generator, *, frames: int, accident: bool) -> SmallScene:
    """Return a scene at a random position in its town, with random speeds.

    Both are the same with and without the accident.
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
    """Return the LiDAR's points on boxes and ground, shape (N, 3), in metres, LiDAR frame.

    They are rounded to float32, like in the file.
    """
    points = [_ground_points(lidar_height)]
    distance = np.linalg.norm(boxes.center[:, :2], axis=1)
    density = np.clip(_POINTS_AT_1_M / np.maximum(distance, 1.0), 1, _MAX_BOX_POINTS)
    counts = density.astype(int) * (distance < _LIDAR_RANGE_M)
    for row, count in enumerate(counts.tolist()):
        box_points = _spread_points(count) * boxes.size[row]
        sine = np.sin(boxes.yaw[row])
        cosine = np.cos(boxes.yaw[row])
        rotation = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
        offsets = box_points @ rotation.T
        points.append(boxes.center[row] + offsets)
    return np.concatenate(points).astype(np.float32).astype(np.float64)


def _picture_of(
    boxes: Boxes, camera: PinholeCamera, *, sky: tuple[int, int, int], road: tuple[int, int, int]
) -> ByteArray:
    """Draw an RGB image (H, W, 3): sky, road, and outlines of boxes in their classes' colours.

    Boxes are in the optical frame; distant ones are drawn first. Callers should pass different
    colours for each image, so that no two files are equal.
    """
    import cv2

    picture = np.empty((camera.height, camera.width, 3), dtype=np.uint8)
    horizon = camera.height // 2
    picture[:horizon] = sky
    picture[horizon:] = road
    corners = boxes.corners()
    depths = boxes.center[:, 2]
    for row in np.argsort(-depths).tolist():
        pixels, depth = camera.project(corners[row])
        if (depth > _MIN_DEPTH_M).all():
            corner_pixels = np.rint(pixels.clip(-1e4, 1e4)).astype(np.int32)
            outline = cv2.convexHull(corner_pixels)
            cv2.fillConvexPoly(picture, outline, _COLORS[boxes.category[row]].tolist())
    return picture


def top_view_of(
    boxes: Boxes, object_ids: NDArray[np.uint16]
) -> tuple[ByteArray, NDArray[np.uint16]]:
    """Return CARLA's tags (uint8) and object ids (uint16) around an agent, (1200, 1200) each.

    Forward is up, and left is left.
    """
    import cv2

    semantic = np.full(BEV_SHAPE, TAGS["road"], dtype=np.uint8)
    instance = np.zeros(BEV_SHAPE, dtype=np.uint16)
    footprints = boxes.bottom_corners()[..., :2]
    actors = zip(footprints, boxes.category_names, object_ids.tolist(), strict=True)
    for footprint, category, object_id in actors:
        if np.abs(footprint).max() * 2 < BEV_RESOLUTION * BEV_SHAPE[0]:
            # OpenCV expects (column, row).
            pixels = _AGENT_PIXEL - footprint[:, ::-1] / BEV_RESOLUTION
            outline = np.rint(pixels).astype(np.int32)
            tag = TAGS["pedestrian" if category == "pedestrian" else "vehicle"]
            cv2.fillConvexPoly(semantic, outline, tag)
            cv2.fillConvexPoly(instance, outline, object_id)
    return semantic, instance


def _spread_points(count: int) -> FloatArray:
    """Return points, shape (count, 3), spread evenly over a unit cube around the origin.

    They keep a small distance from its faces.
    """
    # The R3 low-discrepancy sequence.
    numbers = np.arange(1, count + 1)[:, None]
    fractions = numbers * (0.8191725, 0.6710436, 0.5497005) % 1.0
    return as_floats((fractions - 0.5) * 0.9)


def _ground_points(lidar_height: float) -> FloatArray:
    angle = np.linspace(0.0, 2 * np.pi, _POINTS_PER_RING, endpoint=False)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    xy = np.concatenate([radius * circle for radius in _GROUND_RADII_M])
    z = np.full(len(xy), -lidar_height)
    return np.column_stack([xy, z])


class Recorder:
    """Writes an agent's recording in one frame (counted from 1), file by file; sizes in pixels."""

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
        # The agent's own row, if any, comes first.
        self._is_own = np.arange(len(world)) < (agent in VEHICLE_AGENTS)
        if agent in VEHICLE_AGENTS:
            own_row = VEHICLE_AGENTS.index(agent)
            other_rows = [row for row in range(len(world)) if row != own_row]
            world = world.select([own_row, *other_rows])
        self._velocity = world.velocity[:, :2]
        world_from_lidar = self._calib.world_from_ego @ self._calib.ego_from_lidar
        self._boxes = world.transform(world_from_lidar.inverse(), "lidar")
        height = self._calib.ego_from_lidar.translation[2] if self._is_own.any() else POLE_HEIGHT
        self._cloud = cloud_of(self._boxes.select(~self._is_own), float(height))

    def write_calib(self) -> None:
        """Write the poses and cameras."""
        path = real_path(self._folder.calib_path(self._agent, self._frame))
        write_calib(path, self._calib)

    def write_label(self) -> None:
        """Write the boxes, the agent's own row first; the distant pedestrian is untracked."""
        labels = self._make_labels()
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
            write_image(path, self._draw_picture(channel))

    def _draw_picture(self, channel: str) -> ByteArray:
        others = self._boxes.select(~self._is_own)
        boxes = others.transform(self._calib.camera_from_lidar[channel], channel)
        red = 120 + 12 * AGENTS.index(self._agent)
        green = 130 + 12 * CAMERAS.index(channel)
        grey = 40 + self._frame
        road = (grey, grey, grey + 5)
        return _picture_of(boxes, self._cameras[channel], sky=(red, green, 200), road=road)

    def _make_labels(self) -> Labels:
        """Make the content of the label, with all point counts 0."""
        boxes = self._boxes
        yaw = np.where(self._is_own, 0.0, boxes.yaw)
        agent_velocity = np.zeros((1, 2))
        if self._is_own.any():
            agent_velocity = self._velocity[self._is_own]
        is_far = boxes.actor_id == FAR_ACTOR_ID
        return Labels(
            raw=False,
            num_boxes=np.array([len(boxes)]),
            agent_velocity=agent_velocity,
            category=boxes.category,
            center=boxes.center,
            size=boxes.size,
            yaw=yaw,
            velocity=label_from_world_velocity(self._velocity, yaw),
            actor_id=np.select(
                [self._is_own, is_far], [OWN_ACTOR_ID, UNTRACKED_ID], boxes.actor_id
            ),
            num_lidar_pts=np.zeros(len(boxes), dtype=np.int64),
            camera_visible=self._find_visible_boxes(),
        )

    def _find_visible_boxes(self) -> BoolArray:
        """Return which boxes have a corner in any image, shape (N,).

        Occlusion is ignored.
        """
        is_visible = np.zeros(len(self._boxes), dtype=bool)
        for channel, camera in self._cameras.items():
            boxes = self._boxes.transform(self._calib.camera_from_lidar[channel], channel)
            is_visible |= camera.boxes_in_image(boxes, BoxVisibility.ANY)
        return is_visible & ~self._is_own
