"""Sensor data, reduced to fit a replay page, and the cameras that show the pair best."""

import base64
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
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

# Cost of switching the camera; it equals about ten frames without the pair in the picture.
_SWITCH_COST = 1.0
# Weight of the last moment, which is the impact; each other moment has weight 1.
_IMPACT_WEIGHT = 5.0
# Weight of an actor that the agent does not see, because something hides it.
_HIDDEN_WEIGHT = 0.2
# Share of the image's width above which the size of an actor matters less.
_LARGE_SHARE = 0.1
# Scales of nested boxes, which are projected by their corners; 1 is the actor's own box.
_BOX_SCALES = as_floats([1, 2, 3]) / 3
FRONT: Final = CAMERAS[0]
# Widths in pixels and JPEG qualities of pictures; the first pair that fits is used.
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
# Frames per picture of the other cameras, for each step of the ladder; the last one also counts for
# all further steps.
OTHER_FRAME_STEPS: Final = (1, 2, 2, 2, 4)
# Minimum width in pixels of the other cameras' pictures, which are half as wide as the large ones.
MIN_OTHER_WIDTH_PX: Final = 256
# Number of pictures from which the total size is estimated.
_PROBE_COUNT = 12
# Side of a cube in metres; one point of each cube is kept.
_CUBE_SIDE_M = 0.3
# A cube's hash is the sum of its coordinates times these factors, mixed and reduced to slots. This
# is quicker than sorting, and neighbouring cubes get distant slots.
_HASH_FACTORS = as_floats([73_856_093, 19_349_669, 83_492_791])
_HASH_MIXER = 0x9E3779B1
_HASH_SLOTS = 1 << 16
# Bytes of a point in base64: three int16.
_POINT_BYTES = 8
# Bytes of a page that are kept for its clouds; they also get what the pictures leave.
PAGE_CLOUD_BYTES: Final = 5_000_000
# Largest distance from the page's origin, in centimetres, along each axis.
_MAX_COORDINATE = 2**15 - 1
# Metres above the ground below which points belong to the road.
_MIN_HEIGHT_M = 0.3
# Step between the points that are used to estimate the ground's height.
_GROUND_POINT_STEP = 8
# Percentile of the points' heights that counts as the ground's height, because the origin of the
# infrastructure's ego frame is not on the ground.
_GROUND_PERCENTILE = 5.0
# One file for each frame, by agent and camera; None for a missing file.
CameraFiles = dict[tuple[str, str], list[ReleasePath | None]]
# One picture for each frame, by agent, then by camera; None for a missing picture. Cameras without
# any picture are left out.
Jpegs = dict[str, dict[str, tuple[bytes | None, ...]]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Followed:
    """The cameras that follow the colliding pair.

    Without a collision, these are the front cameras and the first agent.

    Attributes:
        channels: For each agent (by name), its camera that shows the pair best in each frame.
        agents: For each frame, the agent whose camera shows the pair best.
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
        seen: Bit masks over the recording's agents, one per frame, by actor id.
        present: Whether there is a picture, per frame, by agent and camera.
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
    """Return scores, shape (frames, cameras), for how well an agent's cameras show the pair.

    The agent itself does not count as a part of the pair. A score is −1 if there is no picture.
    """
    agent = recording.agents[bit]
    tracks = scenario_tracks(recording.dataset, recording.scenario)
    actors = set(recording.pair) - {recording.actor_of(agent)}
    rows = np.flatnonzero(np.isin(tracks.actor_id, [*actors]))
    boxes = tracks.boxes.select(rows)
    frame = tracks.index[rows] - 1
    weights = np.full(len(rows), _HIDDEN_WEIGHT)
    for row, (actor, index) in enumerate(zip(boxes.actor_id.tolist(), frame.tolist(), strict=True)):
        if seen[actor][index] >> bit & 1:
            weights[row] = 1.0
    scores = np.zeros((len(recording.frames), len(CAMERAS)))
    for column, channel in enumerate(CAMERAS):
        shares = _visible_shares(recording, agent, channel, boxes, frame)
        np.add.at(scores[:, column], frame, weights * shares)
        has_picture = np.array(present[agent, channel])
        scores[~has_picture, column] = -1.0
    scores[-1] *= _IMPACT_WEIGHT
    return scores


def _visible_shares(
    recording: ReplayRecording, agent: str, channel: str, boxes: Boxes, frame: IntArray
) -> FloatArray:
    """Return how well a camera's picture shows each box, shape (N,), from 0 to 1.

    The value is the share of the box that is in the picture, times a factor that is smaller for
    small boxes.

    Args:
        recording: Scenario and shown agents.
        agent: Name of the agent.
        channel: Name of the camera; the lens of the first frame is used for all frames.
        boxes: N boxes in the world frame.
        frame: Frame of each box, shape (N,), from 0.
    """
    samples = [recording.sample(agent, number) for number in recording.frames]
    lens = recording.dataset.camera(samples[0], channel)
    matrices = [recording.dataset.world_from(sample, channel).matrix for sample in samples]
    world_from_camera = np.array(matrices)[frame]
    rotation = world_from_camera[:, :3, :3]
    translation = world_from_camera[:, :3, 3]
    center = boxes.center[:, None]
    corners = boxes.corners() - center
    nested_corners = center[:, None] + _BOX_SCALES[:, None, None] * corners[:, None]
    box_count, scale_count, corner_count, _ = nested_corners.shape
    points = nested_corners.reshape(box_count, scale_count * corner_count, 3)
    optical = (points - translation[:, None]) @ rotation
    pixels, depth = lens.project(optical.reshape(-1, 3))
    in_image = lens.in_image(pixels, depth, min_depth=IN_FRONT_DEPTH)
    share = in_image.reshape(points.shape[:2]).mean(axis=1)
    distance = np.linalg.norm(boxes.center - translation, axis=1).clip(1.0)
    length = boxes.size[:, 0]
    width_share = lens.intrinsic[0, 0] / lens.width * length / distance
    return as_floats(share * width_share / (width_share + _LARGE_SHARE))


def steady_choice(scores: AnyArray) -> list[int]:
    """Choose a column for each row, such that the sum of scores minus costs is largest.

    Each change of the column from one row to the next has a cost.
    """
    total = scores[0]
    predecessors = []
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
        frame_step: Number of frames for each large picture.
        other_frame_step: Number of frames for each picture of the other cameras; 0 for no pictures.
    """

    width: int
    quality: int
    frame_step: int = 1
    other_frame_step: int = 1

    @property
    def other_width(self) -> int:
        """Width of the other cameras' pictures, pixels."""
        half_width = self.width // 2
        return min(self.width, max(half_width, MIN_OTHER_WIDTH_PX))


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
            paths: list[ReleasePath | None] = []
            for frame in recording.frames:
                path = recording.dataset.sensor_path(f"{recording.sample(agent, frame)}/{channel}")
                if frame in frames:
                    paths.append(path)
                else:
                    paths.append(None)
            files[agent, channel] = paths
    return files


def camera_pictures(
    files: CameraFiles,
    followed: Followed,
    limit: float,
    *,
    progress: bool = False,
) -> tuple[PictureSettings | None, Jpegs]:
    """Return the settings of the largest pictures within a limit of bytes, and these pictures.

    If even the smallest pictures do not fit, there are fewer of them. While a camera follows the
    pair, its pictures are as large as the front cameras'. The settings are None if there
    are no pictures.

    Raises:
        SensorFileError: An image cannot be read.
    """
    images: _Images = {}
    for (agent, channel), paths in files.items():
        images[agent, channel] = []
        for path, followed_channel in zip(paths, followed.channels[agent], strict=True):
            image = None
            if path is not None:
                image = _Image(path=path, large=channel in (FRONT, followed_channel))
            images[agent, channel].append(image)
    frames = max(map(len, files.values()))
    return _fitting_pictures(images, limit, _possible_settings(frames), progress=progress)


def _possible_settings(frames: int) -> Iterator[PictureSettings]:
    """Yield settings, each with smaller or fewer pictures than the previous one."""
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
    images: _Images, limit: float, possible: Iterator[PictureSettings], *, progress: bool
) -> tuple[PictureSettings | None, Jpegs]:
    """Return the first settings with which all pictures fit the limit, and these pictures."""
    probes = probes_of(images)
    if not probes:
        return None, {}
    for settings in possible:
        pictured = _pictured_images(images, settings)
        selected_images = _present_images(pictured)
        if _estimate_bytes(selected_images, probes, settings) > limit:
            continue
        encoded = _encode_images(selected_images, settings, progress=progress)
        if sum(map(len, encoded)) <= limit:
            return settings, _by_agent(pictured, encoded)
    return None, {}


def _estimate_bytes(
    images: Sequence[_Image], probes: Sequence[ByteArray], settings: PictureSettings
) -> float:
    """Estimate the size in bytes of all images as JPEG from some of them (the probes)."""
    large_bytes = 0
    small_bytes = 0
    for probe in probes:
        large_bytes += len(_encode_jpeg(probe, settings, large=True))
        small_bytes += len(_encode_jpeg(probe, settings, large=False))
    large_count = sum(image.large for image in images)
    small_count = len(images) - large_count
    total = large_count * large_bytes + small_count * small_bytes
    num_probes = len(probes)
    return total / num_probes


def _present_images(images: _Images) -> list[_Image]:
    present_images: list[_Image] = []
    for row in images.values():
        present_images.extend(filter(None, row))
    return present_images


def probes_of(images: _Images) -> list[ByteArray]:
    """Return the pictures from which the total size is estimated."""
    present_images = _present_images(images)
    step = max(1, len(present_images) // _PROBE_COUNT)
    return [read_image(image.path) for image in present_images[::step]]


def _pictured_images(images: _Images, settings: PictureSettings) -> _Images:
    """Return the images that get a picture with these settings; the others are None."""
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


def _encode_images(
    images: Sequence[_Image], settings: PictureSettings, *, progress: bool
) -> list[bytes]:
    """Encode the images as JPEG.

    This happens in threads, because the libraries that do most of the work release the interpreter
    lock.
    """

    def work(image: _Image) -> bytes:
        return _encode_jpeg(read_image(image.path), settings, large=image.large)

    with own_threads() as threads:
        return run_batch(
            work, images, executor=threads, label="Rendering pictures", progress=progress
        )


def _by_agent(pictured: _Images, encoded: Sequence[bytes]) -> Jpegs:
    """Group JPEG pictures by agent and camera; `encoded` has one for each image, in order."""
    remaining = iter(encoded)
    jpegs: Jpegs = {}
    for (agent, channel), images in pictured.items():
        pictures = tuple(None if image is None else next(remaining) for image in images)
        if any(pictures):
            agent_jpegs = jpegs.setdefault(agent, {})
            agent_jpegs[channel] = pictures
    return jpegs


def _encode_jpeg(image: ByteArray, settings: PictureSettings, *, large: bool) -> bytes:
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
    """Return how many points each cloud may have for all clouds to fit into `limit` bytes."""
    return int(limit / (_POINT_BYTES * max(1, clouds)))


def cloud_size(points: int) -> int:
    """Return the size in bytes of a cloud of some points, encoded as by `cloud_text`."""
    return _POINT_BYTES * points


def lidar_points(
    recording: ReplayRecording, max_points: int
) -> list[list[str | None] | None] | None:
    """Return the clouds of each agent and frame, encoded as by `cloud_text`.

    A missing file is None. The entry of an agent without any clouds is None. The result is None if
    no agent has any.

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


def cloud_text(
    recording: ReplayRecording, agent: str, frame: int, max_points: int | None = None
) -> str | None:
    """Encode the points of a cloud as text; return None if there is no file.

    The text is base64 of little-endian int16 values x, y, z, x, y, z, …, in centimetres from the
    page's origin; z is measured in world. Points above the road come first, and of these one for
    each cube that contains any, so that any first part of the points is spread over the cloud.

    Args:
        recording: Scenario and shown agents.
        agent: Name of the agent.
        frame: Number from 1.
        max_points: Maximum number of points, of which the first are kept; None for all points.

    Raises:
        SensorFileError: The file cannot be read.
    """
    dataset = recording.dataset
    sample = recording.sample(agent, frame)
    try:
        cloud = dataset.load_point_cloud(sample, "ego")
    except MissingFileError:
        return None
    height = cloud.xyz[:, 2]
    ground = 0.0
    if len(height):
        ground = np.percentile(height[::_GROUND_POINT_STEP], _GROUND_PERCENTILE)
    is_raised = height > ground + _MIN_HEIGHT_M
    origin = np.append(recording.origin, 0.0)
    points = dataset.world_from(sample, "ego").apply(cloud.xyz) - origin
    raised_rows = np.flatnonzero(is_raised)
    rows_of_cubes = raised_rows[_spread_rows(points[raised_rows])]
    road_rows = np.flatnonzero(~is_raised)
    rows = np.concatenate(
        [rows_of_cubes, raised_rows, road_rows[_spread_rows(points[road_rows])], road_rows]
    )
    _, first = np.unique(rows, return_index=True)
    ordered_rows = rows[np.sort(first)]
    centimetres = np.rint(points[ordered_rows] * 100)
    is_near = (np.abs(centimetres) <= _MAX_COORDINATE).all(axis=1)
    kept = centimetres[is_near][:max_points].astype("<i2")
    return base64.b64encode(kept.tobytes()).decode("ascii")


def _spread_rows(points: FloatArray) -> IntArray:
    """Return rows of points (N, 3): one for each cube that contains any, in a mixed order."""
    cubes = np.floor(points / _CUBE_SIDE_M)
    hashes = (cubes @ _HASH_FACTORS).astype(np.int64)
    mixed = (hashes ^ (hashes >> 15)) * _HASH_MIXER
    slots = (mixed >> 16) % _HASH_SLOTS
    point_of_slot = np.full(_HASH_SLOTS, -1)
    point_of_slot[slots] = np.arange(len(points))
    return point_of_slot[point_of_slot >= 0]
