"""All sensors of a scenario's agents, and what each records at a moment."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.geometry.se3 import trusted_se3
from deepaccident_devkit.plugins.synth.actors import Actors
from deepaccident_devkit.plugins.synth.plan import RigName, Sensors
from deepaccident_devkit.plugins.synth.roads import (
    MAP_EXTENT,
    MAP_RESOLUTION,
    TERRAIN,
    Arm,
    GroundMap,
    tag_of_code,
)
from deepaccident_devkit.plugins.synth.roads.paths import ahead_and_left
from deepaccident_devkit.plugins.synth.sensors.agents import (
    MOUNTS,
    Agent,
    make_agents,
    with_single_precision,
)
from deepaccident_devkit.plugins.synth.sensors.annotate import annotate
from deepaccident_devkit.plugins.synth.sensors.lidar import (
    AIR_OF_WEATHER,
    Air,
    Lidar,
    Scan,
    make_lidar,
    scan,
)
from deepaccident_devkit.plugins.synth.sensors.render import Studio, Surroundings, camera_picture
from deepaccident_devkit.plugins.synth.sensors.scene import Scene, Setting, make_scene
from deepaccident_devkit.plugins.synth.world import World
from deepaccident_devkit.release import BevImage, Calib, Labels
from deepaccident_devkit.release.npz import TAGS
from deepaccident_devkit.support.arrays import ByteArray, FloatArray
from deepaccident_devkit.taxonomy import AGENTS, BEV_RESOLUTION, BEV_SHAPE, CATEGORIES, AgentName

# Row and column of the agent in a BEV picture, pixels.
_MIDDLE_PIXEL = (BEV_SHAPE[0] - 1) / 2
_TAG_OF_CATEGORY = np.array(
    [TAGS["pedestrian" if category == "pedestrian" else "vehicle"] for category in CATEGORIES],
    dtype=np.uint8,
)
# Blur of the optics of the rig `road`, pixels, and its noise as a share of white.
_BLUR_PIXELS = 0.7
_NOISE_STD = 0.03
_GAMMA, _CONTRAST, _TINT = 0.8, 0.8, np.array([1.05, 1.0, 0.88], dtype=np.float32)
# Purposes of random numbers, each with its own stream.
_LOOK_STREAM, _LIDAR_STREAM, _CAMERA_STREAM = range(3)


def draw_ground_image(scene: Scene, top: GroundMap, ground_from_ego: SE3) -> BevImage:
    """Draw the BEV picture around an agent; higher road users cover lower ones."""
    import cv2

    x, y = ground_from_ego.translation[:2].tolist()
    yaw = ground_from_ego.yaw
    codes = _resample_map(top, x, y, yaw)
    semantic = np.asarray(cv2.LUT(codes, tag_of_code()), dtype=np.uint8)
    instance = np.zeros(BEV_SHAPE, dtype=np.uint16)
    poses = scene.snapshot.poses
    ahead, lateral = ahead_and_left(poses[:, 0] - x, poses[:, 1] - y, yaw)
    ego_poses = np.column_stack([ahead, lateral, poses[:, 2] - yaw])
    actors = scene.actors
    radius = np.hypot(actors.size[:, 0], actors.size[:, 1]) / 2
    max_distance = BEV_RESOLUTION * BEV_SHAPE[0] / 2 + radius
    near_rows = np.flatnonzero(np.abs(ego_poses[:, :2]).max(axis=1) < max_distance)
    by_height = near_rows[np.argsort(actors.size[near_rows, 2], kind="stable")]
    for row in by_height.tolist():
        window, mask = _find_footprint(ego_poses[row], actors.size[row])
        semantic[window][mask] = _TAG_OF_CATEGORY[actors.category[row]]
        instance[window][mask] = actors.object_id[row]
    return BevImage(semantic, instance)


def _resample_map(top: GroundMap, x: float, y: float, yaw: float) -> ByteArray:
    """Resample the codes of the map to an agent's grid, nearest cell.

    Args:
        top: Map of the ground with everything on it.
        x: Position x of the agent, metres.
        y: Position y of the agent, metres.
        yaw: Heading of the agent, radians.
    """
    import cv2

    cos = np.cos(yaw)
    sin = np.sin(yaw)
    column = (x + MAP_EXTENT) / MAP_RESOLUTION - 0.5
    row = (y + MAP_EXTENT) / MAP_RESOLUTION - 0.5
    map_from_picture = np.array(
        [
            [sin, -cos, column + _MIDDLE_PIXEL * (cos - sin)],
            [-cos, -sin, row + _MIDDLE_PIXEL * (cos + sin)],
        ]
    )
    codes = cv2.warpAffine(
        top.codes,
        map_from_picture,
        BEV_SHAPE,
        flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=(TERRAIN,),
    )
    return np.asarray(codes)


def _find_footprint(
    pose: FloatArray, size: FloatArray
) -> tuple[tuple[slice, slice], NDArray[np.bool_]]:
    """Return the pixels with their middle on a box, seen from above.

    Args:
        pose: x, y (metres), yaw (radians) of the box in the agent's frame, shape (3,).
        size: Length, width, height, shape (3,), metres.

    Returns:
        A window of the picture, and a mask of it.
    """
    x, y, yaw = pose.tolist()
    length, width, _ = size.tolist()
    radius = np.hypot(length, width) / 2 / BEV_RESOLUTION
    rows = _find_pixel_span(_MIDDLE_PIXEL - x / BEV_RESOLUTION, radius)
    columns = _find_pixel_span(_MIDDLE_PIXEL - y / BEV_RESOLUTION, radius)
    row_x = (_MIDDLE_PIXEL - np.arange(rows.start, rows.stop)) * BEV_RESOLUTION
    column_y = (_MIDDLE_PIXEL - np.arange(columns.start, columns.stop)) * BEV_RESOLUTION
    dx = (row_x - x)[:, None]
    dy = (column_y - y)[None, :]
    ahead, lateral = ahead_and_left(dx, dy, yaw)
    is_within_length = np.abs(ahead) <= length / 2
    is_within_width = np.abs(lateral) <= width / 2
    return (rows, columns), is_within_length & is_within_width


def _find_pixel_span(middle: float, radius: float) -> slice:
    """Return the rows or columns of the BEV picture up to a radius from a middle, pixels."""
    start = int(np.floor(middle - radius))
    stop = int(np.ceil(middle + radius)) + 1
    last_stop = BEV_SHAPE[0]
    return slice(min(max(start, 0), last_stop), max(min(stop, last_stop), 0))


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """The recordings of an agent at a moment, except its images.

    Attributes:
        labels: Label file.
        calib: Calib file.
        points: Point cloud; if the rig makes none, only the points that may lie in a box, as in
            `lidar.scan`.
    """

    labels: Labels
    calib: Calib
    points: Scan


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rig:
    """The sensors of a scenario.

    Attributes:
        setting: The static world, and the road users that move.
        agents: The agents.
        lidars: LiDARs of the agents.
        air: Effect of the weather on the LiDARs' rays.
        clouds: Whether it makes complete point clouds, not only the points that labels count.
        studio: Maker of the images; None if there are none.
        seed: Seed of all noise, so that the noise of a moment does not depend on earlier
            recordings.
        exact: Whether calib files are ideal, and numbers of points exact.
        decimals: Number of decimals to which labels and calib are rounded; None for all.
        name: Name of the mounting and the optics of its sensors (`plan.SynthConfig`).
    """

    # the world and its agents
    setting: Setting
    agents: tuple[Agent, ...]
    # sensors
    lidars: Mapping[AgentName, Lidar]
    air: Air
    clouds: bool
    studio: Studio | None
    # noise and rounding
    seed: tuple[int, ...]
    exact: bool
    decimals: int | None = None
    name: RigName = "released"

    def scene(self, time: float) -> Scene:
        """Make the scene at a time, seconds since the first recorded frame."""
        return make_scene(self.setting, time)

    def sighting(self, scene: Scene, agent: Agent, frame: int) -> Sighting:
        """Record labels, calib and points of an agent; `frame` seeds the noise."""
        world_from_ground = self.setting.world.world_from_ground
        ground_from_ego = agent.ground_from_ego(scene)
        ground_from_lidar = ground_from_ego @ agent.ego_from_lidar
        lidar = self.lidars[agent.name]
        rng = self._make_rng(_LIDAR_STREAM, frame, agent)
        points = scan(scene, lidar, ground_from_lidar, self.air, rng, boxed=not self.clouds)
        labels = annotate(scene, agent, world_from_ground, points, exact=self.exact)
        calib = agent.calib(world_from_ground @ ground_from_ego)
        if not self.exact:
            calib = with_single_precision(calib)
        if self.decimals is not None:
            labels = _round_labels(labels, self.decimals)
            calib = _round_calib(calib, self.decimals)
        return Sighting(labels, calib, points)

    def bev(self, scene: Scene, agent: Agent) -> BevImage:
        """Return the picture of an agent's BEV camera."""
        ground_from_ego = agent.ground_from_ego(scene)
        return draw_ground_image(scene, self.setting.world.top, ground_from_ego)

    def surroundings(self, scene: Scene, signals: Mapping[Arm, int]) -> Surroundings | None:
        """Return what the images of all agents share at a moment.

        Args:
            scene: The scene.
            signals: States of the traffic lights, as for `light.find_lit_lamps`.

        Returns:
            None if no images are made.
        """
        if self.studio is None:
            return None
        return self.studio.surroundings(scene, signals)

    def images(
        self, scene: Scene, surroundings: Surroundings, agent: Agent, frame: int
    ) -> Iterator[tuple[str, ByteArray]]:
        """Yield channel and picture (H, W, 3) of each camera of an agent, one at a time."""
        rng = self._make_rng(_CAMERA_STREAM, frame, agent)
        ground_from_lidar = agent.ground_from_lidar(scene)
        for camera in agent.cameras:
            ground_from_camera = ground_from_lidar @ camera.lidar_from_camera
            picture = camera_picture(scene, surroundings, camera, ground_from_camera, rng)
            if self.name != "released":
                picture = _apply_road_optics(picture, rng)
            yield camera.channel, picture

    def _make_rng(self, purpose: int, frame: int, agent: Agent) -> np.random.Generator:
        """Return the generator of random numbers for a purpose at a frame of an agent."""
        agent_number = AGENTS.index(agent.name)
        return np.random.default_rng([*self.seed, purpose, frame, agent_number])


def make_rig(  # noqa: PLR0913 - the place, the agents, the sky, and the recordings
    world: World,
    actors: Actors,
    ids: Mapping[AgentName, int],
    *,
    sky: tuple[str, str],
    image_size: tuple[int, int],
    seed: tuple[int, ...],
    sensors: Sensors = "all",
    exact: bool = False,
    decimals: int | None = None,
    name: RigName = "released",
) -> Rig:
    """Make the sensors of a scenario.

    Labels do not depend on `sensors`, points do, as described for `Sighting`.

    Args:
        world: The static world.
        actors: The road users.
        ids: Actor ids of the four vehicle agents.
        sky: Weather and time of day, as in the taxonomy.
        image_size: Width and height of images, pixels.
        seed: Seed of noise, clouds and the ground's grain.
        sensors: Sensors' files to make (`SynthConfig`).
        exact: Whether calib files are ideal, and numbers of points exact.
        decimals: Number of decimals to which labels and calib are rounded; None for all.
        name: Name of the mounting and the optics.
    """
    weather, time_of_day = sky
    setting = Setting(world, actors)
    agents = make_agents(world, actors, ids, image_size, MOUNTS[name])
    rng = np.random.default_rng([*seed, _LOOK_STREAM])
    lidars = {agent.name: make_lidar(setting, agent) for agent in agents}
    studio = None
    if sensors not in ("clouds", "none"):
        studio = Studio(setting, weather, time_of_day, rng)
    return Rig(
        setting=setting,
        agents=agents,
        lidars=lidars,
        air=AIR_OF_WEATHER[weather],
        clouds=sensors in ("all", "clouds"),
        studio=studio,
        seed=seed,
        exact=exact,
        decimals=decimals,
        name=name,
    )


def _round_labels(labels: Labels, decimals: int) -> Labels:
    """Return labels with rounded numbers."""
    rounded = {}
    for name in ("agent_velocity", "center", "size", "yaw", "velocity"):
        rounded[name] = getattr(labels, name).round(decimals)
    return replace(labels, **rounded)


def _round_calib(calib: Calib, decimals: int) -> Calib:
    """Return a calib with rounded numbers."""

    def round_pose(pose: SE3) -> SE3:
        rounded_matrix = pose.matrix.round(decimals)
        return trusted_se3(rounded_matrix)

    camera_poses = calib.camera_from_lidar.items()
    return Calib(
        ego_from_lidar=round_pose(calib.ego_from_lidar),
        world_from_ego=round_pose(calib.world_from_ego),
        camera_from_lidar={channel: round_pose(pose) for channel, pose in camera_poses},
        intrinsic={channel: matrix.round(decimals) for channel, matrix in calib.intrinsic.items()},
    )


def _apply_road_optics(picture: ByteArray, rng: np.random.Generator) -> ByteArray:
    """Render a picture (H, W, 3) as the optics of the rig `road` would record it.

    The result is softer, warmer, noisier and lower in contrast.
    """
    import cv2

    blurred = cv2.GaussianBlur(picture, (0, 0), _BLUR_PIXELS)
    brightness = blurred.astype(np.float32) / 255
    toned = (brightness**_GAMMA - 0.5) * _CONTRAST + 0.5
    noise = rng.standard_normal(picture.shape, dtype=np.float32) * _NOISE_STD
    values = np.rint((toned * _TINT + noise) * 255)
    return np.asarray(np.clip(values, 0, 255), dtype=np.uint8)
