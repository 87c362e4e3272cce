"""All sensors of a scenario's agents, and what each of them records at a moment."""

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

# Row and column of the agent.
_MIDDLE = (BEV_SHAPE[0] - 1) / 2
_TAG_OF_CATEGORY = np.array(
    [TAGS["pedestrian" if category == "pedestrian" else "vehicle"] for category in CATEGORIES],
    dtype=np.uint8,
)


def bev_picture(scene: Scene, top: GroundMap, ground_from_ego: SE3) -> BevImage:
    """The picture around an agent; higher road users cover lower ones."""
    import cv2

    x, y = ground_from_ego.translation[:2].tolist()
    semantic = np.asarray(
        cv2.LUT(_map_around(top, x, y, ground_from_ego.yaw), tag_of_code()), dtype=np.uint8
    )
    instance = np.zeros(BEV_SHAPE, dtype=np.uint16)
    poses = _relative_poses(scene.snapshot.poses, x, y, ground_from_ego.yaw)
    actors = scene.actors
    reach = BEV_RESOLUTION * BEV_SHAPE[0] / 2 + np.hypot(actors.size[:, 0], actors.size[:, 1]) / 2
    near = np.flatnonzero(np.abs(poses[:, :2]).max(axis=1) < reach)
    for row in near[np.argsort(actors.size[near, 2], kind="stable")].tolist():
        window, inside = _footprint(poses[row], actors.size[row])
        semantic[window][inside] = _TAG_OF_CATEGORY[actors.category[row]]
        instance[window][inside] = actors.object_id[row]
    return BevImage(semantic, instance)


def _map_around(top: GroundMap, x: float, y: float, yaw: float) -> ByteArray:
    """Codes of the map resampled to the agent's grid, nearest cell."""
    import cv2

    cos, sin = np.cos(yaw), np.sin(yaw)
    column, row = ((value + MAP_EXTENT) / MAP_RESOLUTION - 0.5 for value in (x, y))
    map_from_picture = np.array(
        [[sin, -cos, column + _MIDDLE * (cos - sin)], [-cos, -sin, row + _MIDDLE * (cos + sin)]]
    )
    flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    return np.asarray(
        cv2.warpAffine(
            top.codes,
            map_from_picture,
            BEV_SHAPE,
            flags=flags,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=(TERRAIN,),
        )
    )


def _relative_poses(poses: FloatArray, x: float, y: float, yaw: float) -> FloatArray:
    """Poses (A, 3) in the ground frame, converted to the frame of an agent."""
    dx, dy = poses[:, 0] - x, poses[:, 1] - y
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.column_stack([cos * dx + sin * dy, cos * dy - sin * dx, poses[:, 2] - yaw])


def _footprint(pose: FloatArray, size: FloatArray) -> tuple[tuple[slice, slice], NDArray[np.bool_]]:
    """The pixels whose middle lies on a box, seen from above: a window of the picture, and a mask of it."""
    x, y, yaw = pose.tolist()
    length, width, _ = size.tolist()
    radius = np.hypot(length, width) / 2 / BEV_RESOLUTION
    rows, columns = (_window(_MIDDLE - value / BEV_RESOLUTION, radius) for value in (x, y))
    ahead = ((_MIDDLE - np.arange(rows.start, rows.stop)) * BEV_RESOLUTION - x)[:, None]
    left = ((_MIDDLE - np.arange(columns.start, columns.stop)) * BEV_RESOLUTION - y)[None, :]
    cos, sin = np.cos(yaw), np.sin(yaw)
    inside = (np.abs(cos * ahead + sin * left) <= length / 2) & (
        np.abs(cos * left - sin * ahead) <= width / 2
    )
    return (rows, columns), inside


def _window(middle: float, radius: float) -> slice:
    low, high = int(np.floor(middle - radius)), int(np.ceil(middle + radius)) + 1
    return slice(min(max(low, 0), BEV_SHAPE[0]), max(min(high, BEV_SHAPE[0]), 0))


# Pixels, and as a share of white: of the optics of the rig `road`.
_BLUR, _NOISE = 0.7, 0.03
_GAMMA, _CONTRAST, _TINT = 0.8, 0.8, np.array([1.05, 1.0, 0.88], dtype=np.float32)
# The purposes of random numbers.
_LOOK, _LIDAR, _CAMERAS = range(3)


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """What an agent records at a moment, except its images.

    Attributes:
        labels: its label file.
        calib: its calib file.
        points: its point cloud; if the rig makes none, only the points that may lie in a box, as in `lidar.scan`.
    """

    labels: Labels
    calib: Calib
    points: Scan


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rig:
    """The sensors of a scenario.

    Attributes:
        setting: what stands still, and who moves.
        agents: the agents.
        lidars: their LiDARs.
        air: what the weather does to the LiDARs' rays.
        clouds: whether it makes whole point clouds, not only the points that labels count.
        studio: it makes the images; None if there are none.
        seed: seed of all noise, so that the noise of a moment does not depend on what was recorded before.
        exact: whether calib files are ideal, and numbers of points exact.
        decimals: to how many decimals labels and calib are rounded; None for all.
        name: of how it is mounted, and of its optics (`plan.SynthConfig`).
    """

    setting: Setting
    agents: tuple[Agent, ...]
    lidars: Mapping[AgentName, Lidar]
    air: Air
    clouds: bool
    studio: Studio | None
    seed: tuple[int, ...]
    exact: bool
    decimals: int | None = None
    name: RigName = "released"

    def scene(self, time: float) -> Scene:
        """The scene at a time, seconds since the first recorded frame."""
        return make_scene(self.setting, time)

    def sighting(self, scene: Scene, agent: Agent, frame: int) -> Sighting:
        """Labels, calib and points of an agent; `frame` seeds the noise."""
        world_from_ground = self.setting.world.world_from_ground
        ground_from_ego = agent.ground_from_ego(scene)
        ground_from_lidar = ground_from_ego @ agent.ego_from_lidar
        rng = self._random(_LIDAR, frame, agent)
        points = scan(
            scene, self.lidars[agent.name], ground_from_lidar, self.air, rng, boxed=not self.clouds
        )
        labels = annotate(scene, agent, world_from_ground, points, exact=self.exact)
        calib = agent.calib(world_from_ground @ ground_from_ego)
        calib = calib if self.exact else with_single_precision(calib)
        if self.decimals is not None:
            labels, calib = (
                _rounded_labels(labels, self.decimals),
                _rounded_calib(calib, self.decimals),
            )
        return Sighting(labels, calib, points)

    def bev(self, scene: Scene, agent: Agent) -> BevImage:
        """The picture of an agent's BEV camera."""
        return bev_picture(scene, self.setting.world.top, agent.ground_from_ego(scene))

    def surroundings(self, scene: Scene, signals: Mapping[Arm, int]) -> Surroundings | None:
        """What the images of all agents at a moment have in common; None if no images are made.

        `signals` are the states of the traffic lights, as for `light.lit_lamps`.
        """
        return self.studio.surroundings(scene, signals) if self.studio else None

    def images(
        self, scene: Scene, around: Surroundings, agent: Agent, frame: int
    ) -> Iterator[tuple[str, ByteArray]]:
        """Channel and picture (H, W, 3) of each camera of an agent, one at a time."""
        rng = self._random(_CAMERAS, frame, agent)
        ground_from_lidar = agent.ground_from_lidar(scene)
        for camera in agent.cameras:
            picture = camera_picture(
                scene, around, camera, ground_from_lidar @ camera.lidar_from_camera, rng
            )
            yield (
                camera.channel,
                picture if self.name == "released" else _by_other_optics(picture, rng),
            )

    def _random(self, purpose: int, frame: int, agent: Agent) -> np.random.Generator:
        return np.random.default_rng([*self.seed, purpose, frame, AGENTS.index(agent.name)])


def make_rig(  # noqa: PLR0913 - where, who, under which sky, and what is recorded how
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
    """The sensors of a scenario; `ids` are the actors of the four agents that are vehicles.

    `sky` is weather and time of day, as in the taxonomy; `image_size` width and height, pixels; `seed` that of noise,
    clouds and the ground's grain. Labels do not depend on `sensors` (`SynthConfig`), points do, as in `Sighting`.
    """
    weather, time_of_day = sky
    setting = Setting(world, actors)
    agents = make_agents(world, actors, ids, image_size, MOUNTS[name])
    rng = np.random.default_rng([*seed, _LOOK])
    return Rig(
        setting=setting,
        agents=agents,
        lidars={agent.name: make_lidar(setting, agent) for agent in agents},
        air=AIR_OF_WEATHER[weather],
        clouds=sensors in ("all", "clouds"),
        studio=None
        if sensors in ("clouds", "none")
        else Studio(setting, weather, time_of_day, rng),
        seed=seed,
        exact=exact,
        decimals=decimals,
        name=name,
    )


def _rounded_labels(labels: Labels, decimals: int) -> Labels:
    names = ("agent_velocity", "center", "size", "yaw", "velocity")
    return replace(labels, **{name: getattr(labels, name).round(decimals) for name in names})


def _rounded_calib(calib: Calib, decimals: int) -> Calib:
    def rounded(pose: SE3) -> SE3:
        return trusted_se3(pose.matrix.round(decimals))

    return Calib(
        ego_from_lidar=rounded(calib.ego_from_lidar),
        world_from_ego=rounded(calib.world_from_ego),
        camera_from_lidar={
            channel: rounded(pose) for channel, pose in calib.camera_from_lidar.items()
        },
        intrinsic={channel: matrix.round(decimals) for channel, matrix in calib.intrinsic.items()},
    )


def _by_other_optics(picture: ByteArray, rng: np.random.Generator) -> ByteArray:
    """A picture (H, W, 3) that is softer, warmer, of less contrast, and noisier."""
    import cv2

    soft = cv2.GaussianBlur(picture, (0, 0), _BLUR).astype(np.float32) / 255
    toned = (soft**_GAMMA - 0.5) * _CONTRAST + 0.5
    noise = rng.standard_normal(picture.shape, dtype=np.float32) * _NOISE
    return np.asarray(np.clip(np.rint((toned * _TINT + noise) * 255), 0, 255), dtype=np.uint8)
