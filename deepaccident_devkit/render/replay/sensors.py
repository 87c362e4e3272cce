"""Sensor data made small enough for a replay page, and the cameras that show the pair best."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np

from deepaccident_devkit.errors import MissingFileError
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.geometry.camera import IN_FRONT_DEPTH
from deepaccident_devkit.release import read_image
from deepaccident_devkit.release.images import picture_bytes
from deepaccident_devkit.release.store import ReleasePath
from deepaccident_devkit.render.replay.entries import ReplayRecording
from deepaccident_devkit.support.arrays import AnyArray, ByteArray, FloatArray, IntArray, as_floats
from deepaccident_devkit.support.parallel import own_threads, run_batch
from deepaccident_devkit.taxonomy import CAMERAS, AgentName
from deepaccident_devkit.v2x.tracks import scenario_tracks

# Cost of a change of the camera: as much as losing the pair from a picture for about ten frames.
_SWITCH_COST: Final = 1.0
# Weight of the last moment, which is the impact; each other moment has weight 1.
_IMPACT_WEIGHT: Final = 5.0
# Weight of an actor that the agent does not see, because something hides it.
_HIDDEN_WEIGHT: Final = 0.2
# Share of the image's width above which the size of an actor matters less.
_LARGE_SHARE: Final = 0.1
# Scales of nested boxes, which are projected by their corners; 1 is the actor's own box.
_BOX_SCALES: Final = as_floats([1, 2, 3]) / 3
FRONT: Final = CAMERAS[0]
# Width in pixels and JPEG quality; the first pair that fits is used.
PICTURE_LADDER: Final = (
    (960, 80),
    (800, 75),
    (640, 75),
    (640, 65),
    (560, 60),
    (480, 60),
    (480, 50),
    (400, 50),
    (320, 45),
)
# Frames per picture of the other cameras, for each step of the ladder; the last also counts for
# all further steps.
OTHER_FRAME_STEPS: Final = (1, 2, 2, 2, 4)
# Pixels: pictures of the other cameras are half as wide as the large ones, but at least this wide.
MIN_OTHER_WIDTH_PX: Final = 256
# The number of pictures from which the total size is estimated.
_PROBE_COUNT: Final = 12
# Metres: side of a cube, from which one point is retained.
_CUBE_SIDE_M: Final = 0.3
# A cube's hash is the sum of its coordinates times these factors, mixed and reduced to slots. This
# is quicker than sorting, and neighbouring cubes get distant slots.
_HASH_FACTORS: Final = as_floats([73_856_093, 19_349_669, 83_492_791])
_HASH_MIXER: Final = 0x9E3779B1
_HASH_SLOTS: Final = 1 << 16
_MAX_CLOUD_POINTS: Final = 4000
# Bytes of a point in base64: three int16.
_POINT_BYTES: Final = 8
# Bytes of all clouds of a page that contains its pictures too.
PAGE_CLOUD_BYTES: Final = 3_000_000
# Bytes of all clouds of a served scenario, so that it stays below 15 MB with data and scripts.
SERVED_CLOUD_BYTES: Final = 13_000_000
# Metres above the ground: lower points are on the road.
_MIN_HEIGHT_M: Final = 0.3
# Step between the points that are used to estimate the ground's height.
_GROUND_POINT_STEP: Final = 8
# Percentile of the points' heights that counts as the ground's height, because the origin of the
# infrastructure's ego frame is not on the ground.
_GROUND_PERCENTILE: Final = 5.0
# Agent and camera → one file for each frame; None for a missing file.
CameraFiles = dict[tuple[str, str], list[ReleasePath | None]]
# Agent → camera → one picture for each frame; None for a missing picture. Cameras without any
# picture are left out.
Jpegs = dict[str, dict[str, tuple[bytes | None, ...]]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Followed:
    """The cameras that follow the colliding pair.

    If nobody collides, these are the front cameras and the first agent.

    Attributes:
        channels: Agent → the camera that shows the pair best, for each frame.
        agents: Agent with the camera that shows the pair best, for each frame.
    """

    channels: Mapping[str, tuple[str, ...]]
    agents: tuple[AgentName, ...]


def follow_pair(
    recording: ReplayRecording,
    seen: Mapping[int, Sequence[int]],
    present: Mapping[tuple[str, str], Sequence[bool]],
) -> Followed:
    """Choose cameras that show most of the pair, large and not hidden, with few changes.

    Args:
        recording: Scenario and shown agents.
        seen: Actor id → a bit mask over the recording's agents, for each frame.
        present: Agent and camera → whether there is a picture, for each frame.
    """
    channels: dict[str, tuple[str, ...]] = {}
    best_scores = []
    for bit, agent in enumerate(recording.agents):
        scores = _scores(recording, bit, seen, present)
        columns = steady_choice(scores)
        channels[agent] = tuple(CAMERAS[column] for column in columns)
        best_scores.append(scores[np.arange(len(scores)), columns])
    numbers = steady_choice(np.stack(best_scores, axis=1))
    agents = tuple(recording.agents[number] for number in numbers)
    return Followed(channels=channels, agents=agents)


def _scores(
    recording: ReplayRecording,
    bit: int,
    seen: Mapping[int, Sequence[int]],
    present: Mapping[tuple[str, str], Sequence[bool]],
) -> FloatArray:
    """Return how well an agent's cameras show the pair without itself, shape (frames, cameras).

    The score is −1 where there is no picture.
    """
    agent = recording.agents[bit]
    tracks = scenario_tracks(recording.dataset, recording.scenario)
    actors = set(recording.pair) - {recording.actor_of(agent)}
    rows = np.flatnonzero(np.isin(tracks.actor_id, [*actors]))
    boxes, frame = tracks.boxes.select(rows), tracks.index[rows] - 1
    weights = []
    for actor, index in zip(boxes.actor_id.tolist(), frame.tolist(), strict=True):
        is_seen = seen[actor][index] >> bit & 1
        weights.append(1.0 if is_seen else _HIDDEN_WEIGHT)
    weight = as_floats(weights)
    scores = np.zeros((len(recording.frames), len(CAMERAS)))
    for column, channel in enumerate(CAMERAS):
        shares = _visible_shares(recording, agent, channel, boxes, frame)
        np.add.at(scores[:, column], frame, weight * shares)
        scores[~np.array(present[agent, channel]), column] = -1.0
    scores[-1] *= _IMPACT_WEIGHT
    return scores


def _visible_shares(
    recording: ReplayRecording, agent: str, channel: str, boxes: Boxes, frame: IntArray
) -> FloatArray:
    """Return the shares of boxes that a camera's picture shows, shape (N,), less for small boxes.

    Args:
        recording: Scenario and shown agents.
        agent: Name of the agent.
        channel: Name of the camera; its lens is that of the first frame.
        boxes: N boxes in world.
        frame: Frame of each box, shape (N,), from 0.
    """
    samples = [recording.sample(agent, number) for number in recording.frames]
    lens = recording.dataset.camera(samples[0], channel)
    matrices = [recording.dataset.world_from(sample, channel).matrix for sample in samples]
    poses = np.array(matrices)[frame]
    rotation, translation = poses[:, :3, :3], poses[:, :3, 3]
    center = boxes.center[:, None]
    corners = boxes.corners() - center
    layers = center[:, None] + _BOX_SCALES[:, None, None] * corners[:, None]
    corner_count = layers.shape[1] * layers.shape[2]
    offsets = layers.reshape(len(boxes), corner_count, 3) - translation[:, None]
    optical = (offsets @ rotation).reshape(-1, 3)
    in_image = lens.in_image(*lens.project(optical), min_depth=IN_FRONT_DEPTH)
    share = in_image.reshape(offsets.shape[:2]).mean(axis=1)
    distance = np.linalg.norm(boxes.center - translation, axis=1).clip(1.0)
    size = lens.intrinsic[0, 0] / lens.width * boxes.size[:, 0] / distance
    return as_floats(share * size / (size + _LARGE_SHARE))


def steady_choice(scores: AnyArray) -> list[int]:
    """Return one column for each row, with the largest sum of scores less the cost of changes."""
    total, predecessors = scores[0], []
    for row in scores[1:]:
        best = int(total.argmax())
        total_after_switch = total[best] - _SWITCH_COST
        stays = total >= total_after_switch
        predecessors.append(np.where(stays, np.arange(len(total)), best))
        total = np.where(stays, total, total_after_switch) + row
    path = [int(total.argmax())]
    for columns in reversed(predecessors):
        path.append(int(columns[path[-1]]))
    return path[::-1]


@dataclass(frozen=True, slots=True, kw_only=True)
class PictureSettings:
    """How pictures are written.

    Pictures of the front cameras, and of cameras while they follow the pair, are the large ones.

    Attributes:
        width: Width of large pictures, pixels; narrower images keep their size.
        quality: JPEG quality.
        frame_step: Frames per large picture.
        other_frame_step: Frames per picture of the other cameras; 0 for no pictures.
    """

    width: int
    quality: int
    frame_step: int = 1
    other_frame_step: int = 1

    @property
    def other_width(self) -> int:
        """Width of the other cameras' pictures, pixels."""
        return min(self.width, max(self.width // 2, MIN_OTHER_WIDTH_PX))


@dataclass(frozen=True, slots=True, kw_only=True)
class _Image:
    """An image file, and whether its picture is a large one."""

    path: ReleasePath
    large: bool


_Images = dict[tuple[str, str], list[_Image | None]]


def camera_files(recording: ReplayRecording) -> CameraFiles:
    """Return the image files of all cameras of the agents."""
    present = recording.dataset.sensor_frames(recording.scenario["token"])
    files: CameraFiles = {}
    for agent in recording.agents:
        for channel in CAMERAS:
            frames = present[agent, channel]
            paths = zip(recording.frames, _paths(recording, agent, channel), strict=True)
            files[agent, channel] = [path if frame in frames else None for frame, path in paths]
    return files


def camera_pictures(
    files: CameraFiles,
    followed: Followed,
    limit: float,
    *,
    progress: bool = False,
) -> tuple[PictureSettings | None, Jpegs]:
    """Return the largest pictures of the cameras within a limit of bytes, and their settings.

    If the smallest pictures do not fit, there are fewer of them. While cameras follow the pair,
    their pictures are as large as the front cameras' pictures. The settings are None if there is no
    picture.

    Raises:
        SensorFileError: An image cannot be read.
    """
    images: _Images = {}
    for (agent, channel), paths in files.items():
        followed_channels = zip(paths, followed.channels[agent], strict=True)
        images[agent, channel] = [
            None if path is None else _Image(path=path, large=channel in (FRONT, followed_channel))
            for path, followed_channel in followed_channels
        ]
    frames = max(map(len, files.values()))
    return _fitting_pictures(images, limit, _ladder(frames), progress=progress)


def _paths(recording: ReplayRecording, agent: str, channel: str) -> Iterator[ReleasePath]:
    samples = (recording.sample(agent, frame) for frame in recording.frames)
    return (recording.dataset.sensor_path(f"{sample}/{channel}") for sample in samples)


def _ladder(frames: int) -> Iterator[PictureSettings]:
    """Yield settings, each for smaller pictures than the one before."""
    for number, (width, quality) in enumerate(PICTURE_LADDER):
        step = OTHER_FRAME_STEPS[min(number, len(OTHER_FRAME_STEPS) - 1)]
        yield PictureSettings(width=width, quality=quality, other_frame_step=step)
    frame_step = 1
    while frame_step < 2 * frames:
        yield PictureSettings(
            width=width, quality=quality, frame_step=frame_step, other_frame_step=0
        )
        frame_step *= 2


def _fitting_pictures(
    images: _Images, limit: float, ladder: Iterator[PictureSettings], *, progress: bool
) -> tuple[PictureSettings | None, Jpegs]:
    probes = probes_of(images)
    if not probes:
        return None, {}
    for settings in ladder:
        pictured = _pictured_images(images, settings)
        selection = _present_images(pictured)
        if _estimated_bytes(selection, probes, settings) > limit:
            continue
        encoded = _encoded(selection, settings, progress=progress)
        if sum(map(len, encoded)) <= limit:
            return settings, _by_agent(pictured, encoded)
    return None, {}


def _estimated_bytes(
    images: Sequence[_Image], probes: Sequence[ByteArray], settings: PictureSettings
) -> float:
    large_bytes = sum(len(_jpeg(probe, settings, large=True)) for probe in probes)
    small_bytes = sum(len(_jpeg(probe, settings, large=False)) for probe in probes)
    total = sum(large_bytes if image.large else small_bytes for image in images)
    return total / len(probes)


def _present_images(images: _Images) -> list[_Image]:
    return [image for row in images.values() for image in row if image is not None]


def probes_of(images: _Images) -> list[ByteArray]:
    """Return the pictures from which the total size is estimated."""
    present = _present_images(images)
    step = max(1, len(present) // _PROBE_COUNT)
    return [read_image(image.path) for image in present[::step]]


def _pictured_images(images: _Images, settings: PictureSettings) -> _Images:
    """Return the images that have pictures; the others are None."""
    pictured: _Images = {}
    for key, row in images.items():
        pictured[key] = []
        for frame, image in enumerate(row):
            step = settings.other_frame_step
            if image is not None and image.large:
                step = settings.frame_step
            has_picture = step and frame % step == 0
            pictured[key].append(image if has_picture else None)
    return pictured


def _encoded(images: Sequence[_Image], settings: PictureSettings, *, progress: bool) -> list[bytes]:
    """Return the pictures as JPEG.

    They are made in threads, because the libraries that do most of the work release the interpreter
    lock.
    """
    work = partial(_jpeg_of, settings=settings)
    with own_threads() as threads:
        return run_batch(work, images, executor=threads, label="pictures", progress=progress)


def _by_agent(pictured: _Images, encoded: Sequence[bytes]) -> Jpegs:
    remaining = iter(encoded)
    jpegs: Jpegs = {}
    for (agent, channel), images in pictured.items():
        pictures = tuple(None if image is None else next(remaining) for image in images)
        if any(pictures):
            jpegs.setdefault(agent, {})[channel] = pictures
    return jpegs


def _jpeg_of(image: _Image, settings: PictureSettings) -> bytes:
    return _jpeg(read_image(image.path), settings, large=image.large)


def _jpeg(image: ByteArray, settings: PictureSettings, *, large: bool) -> bytes:
    from PIL import Image

    height, width = image.shape[:2]
    max_width = settings.other_width
    if large:
        max_width = settings.width
    picture = Image.fromarray(image)
    if width > max_width:
        max_height = max(1, round(height * max_width / width))
        picture = picture.resize((max_width, max_height), reducing_gap=2.0)
    return picture_bytes(picture, "JPEG", quality=settings.quality, optimize=True)


def max_cloud_points(clouds: int, limit: float) -> int:
    """Return how many points each of several clouds may have to keep a limit of bytes together."""
    return min(_MAX_CLOUD_POINTS, int(limit / (_POINT_BYTES * max(1, clouds))))


def lidar_points(
    recording: ReplayRecording, max_points: int
) -> list[list[str | None] | None] | None:
    """Return the clouds of each agent and frame, in the form of `cloud_text`.

    None stands for a missing file. An agent without clouds has an empty entry, which is None. The
    result is None if no agent has a cloud.

    Raises:
        SensorFileError: A point cloud cannot be read.
    """
    clouds_of_agents: list[list[str | None] | None] = []
    for agent in recording.agents:
        clouds = [cloud_text(recording, agent, frame, max_points) for frame in recording.frames]
        clouds_of_agents.append(clouds if set(clouds) != {None} else None)
    if any(clouds_of_agents):
        return clouds_of_agents
    return None


def max_served_points(recording: ReplayRecording) -> int:
    """Return how many points a served cloud may have if all files are present."""
    return max_cloud_points(len(recording.agents) * len(recording.frames), SERVED_CLOUD_BYTES)


def cloud_text(
    recording: ReplayRecording, agent: str, frame: int, max_points: int | None = None
) -> str | None:
    """Return a cloud above the road as text; None if there is no file.

    The text is base64 of int16 x, y, z, x, y, z, …, little-endian, decimetres from the origin; z is
    that of world. The points are spread evenly over the cubes that contain any.

    Args:
        recording: Scenario and shown agents.
        agent: Name of the agent.
        frame: Number from 1.
        max_points: Maximum number of points; None for `max_served_points`.

    Raises:
        SensorFileError: The file cannot be read.
    """
    dataset, sample = recording.dataset, recording.sample(agent, frame)
    try:
        cloud = dataset.load_point_cloud(sample, "ego")
    except MissingFileError:
        return None
    height = cloud.xyz[:, 2]
    samples = height[::_GROUND_POINT_STEP]
    ground = np.percentile(samples, _GROUND_PERCENTILE) if len(height) else 0.0
    raised = cloud.xyz[height > ground + _MIN_HEIGHT_M]
    origin = np.append(recording.origin, 0.0)
    points = dataset.world_from(sample, "ego").apply(raised) - origin
    cubes = (np.floor(points / _CUBE_SIDE_M) @ _HASH_FACTORS).astype(np.int64)
    slots = ((cubes ^ (cubes >> 15)) * _HASH_MIXER >> 16) % _HASH_SLOTS
    point_of_slot = np.full(_HASH_SLOTS, -1)
    point_of_slot[slots] = np.arange(len(points))
    rows = point_of_slot[point_of_slot >= 0]
    if max_points is None:
        max_points = max_served_points(recording)
    decimetres = np.rint(points[rows[:max_points]] * 10)
    clipped = np.clip(decimetres, -(2**15), 2**15 - 1)
    return base64.b64encode(clipped.astype("<i2").tobytes()).decode("ascii")
