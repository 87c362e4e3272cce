"""What the sensors recorded, made small enough for the page, and the cameras that show the colliding pair best."""

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

# What a change of the camera costs: as much as the pair's whole loss from a picture for about ten frames.
_SWITCH: Final = 1.0
# How many moments the last one counts for: it is the impact.
_END: Final = 5.0
# What an actor counts for that the agent does not see: something stands before it.
_HIDDEN: Final = 0.2
# Share of the image's width from which on the size of an actor matters less.
_LARGE: Final = 0.1
# Sizes of the nested boxes at whose corners an actor is looked for; 1 is the actor's own.
_LAYERS: Final = as_floats([1, 2, 3]) / 3
FRONT: Final = CAMERAS[0]
# Width in pixels and JPEG quality; the first pair that fits is taken.
LADDER: Final = (
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
# For each step of the ladder, one of how many frames has a picture of the other cameras; the last is for the rest.
OTHERS: Final = (1, 2, 2, 2, 4)
# Pixels: the other cameras' pictures are half as wide as the others, but not smaller than this.
LEAST_OTHER: Final = 256
# The number of pictures from which the size of all is estimated.
_PROBED: Final = 12
# Metres: side of a cube; of the points in it one is kept.
_CELL: Final = 0.3
_NUMBERED: Final = as_floats([73_856_093, 19_349_669, 83_492_791])
_MIXED: Final = 0x9E3779B1
# A cube's number is the sum of its places times `_NUMBERED`, mixed: quicker than sorting, and neighbours lie apart.
_SLOTS: Final = 1 << 16
# Points of a cloud.
_MOST: Final = 4000
# Of a point in base64: three int16.
_POINT_BYTES: Final = 8
# Bytes of all clouds of a page that has its pictures too.
PAGE_POINTS: Final = 3_000_000
# Bytes of all clouds of a scenario that a server gives, so that with data and scripts it keeps to 15 MB.
SERVED_POINTS: Final = 13_000_000
# Metres above the ground: lower points are on the road.
_LEAST_HEIGHT: Final = 0.3
# Of so many points the height of one is looked at for the ground's.
_SOME: Final = 8
# Percentile of the points' heights that counts as the ground: the infrastructure's ego frame is not on the ground.
_GROUND: Final = 5.0
# Agent and camera → one file for each frame; None where there is none.
CameraFiles = Mapping[tuple[str, str], Sequence[ReleasePath | None]]
# Agent → camera → one picture for each frame; None where there is none. Cameras without any are left out.
Jpegs = dict[str, dict[str, tuple[bytes | None, ...]]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Followed:
    """What is shown of the colliding pair; if nobody collides, the front cameras and the first agent.

    Attributes:
        channels: agent → the camera that shows the pair best, for each frame.
        agents: the agent whose camera shows the pair best, for each frame.
    """

    channels: Mapping[str, tuple[str, ...]]
    agents: tuple[AgentName, ...]


def follow_pair(
    recording: ReplayRecording,
    seen: Mapping[int, Sequence[int]],
    there: Mapping[tuple[str, str], Sequence[bool]],
) -> Followed:
    """Choose cameras so that most of the pair is in the picture, large and not hidden, and changes are few.

    `seen` has for an actor id and a frame a bit mask over the recording's agents, `there` for an agent, a camera and a
    frame whether there is a picture.
    """
    scores = {
        agent: _scores(recording, bit, seen, there) for bit, agent in enumerate(recording.agents)
    }
    chosen = {agent: steady(each) for agent, each in scores.items()}
    best = [each[np.arange(len(each)), chosen[agent]] for agent, each in scores.items()]
    return Followed(
        channels={
            agent: tuple(CAMERAS[channel] for channel in channels)
            for agent, channels in chosen.items()
        },
        agents=tuple(recording.agents[number] for number in steady(np.stack(best, axis=1))),
    )


def _scores(
    recording: ReplayRecording,
    bit: int,
    seen: Mapping[int, Sequence[int]],
    there: Mapping[tuple[str, str], Sequence[bool]],
) -> FloatArray:
    """(frames, cameras) how well an agent's cameras show the pair, without itself; −1 where there is no picture."""
    agent = recording.agents[bit]
    tracks = scenario_tracks(recording.dataset, recording.scenario)
    others = set(recording.pair) - {recording.actor_of(agent)}
    chosen = np.flatnonzero(np.isin(tracks.actor_id, [*others]))
    boxes, row = tracks.boxes.select(chosen), tracks.index[chosen] - 1
    states = zip(boxes.actor_id.tolist(), row.tolist(), strict=True)
    weight = as_floats([1.0 if seen[actor][at] >> bit & 1 else _HIDDEN for actor, at in states])
    scores = np.zeros((len(recording.frames), len(CAMERAS)))
    for column, channel in enumerate(CAMERAS):
        np.add.at(scores[:, column], row, weight * _shown(recording, agent, channel, boxes, row))
        scores[~np.array(there[agent, channel]), column] = -1.0
    scores[-1] *= _END
    return scores


def _shown(
    recording: ReplayRecording, agent: str, channel: str, boxes: Boxes, row: IntArray
) -> FloatArray:
    """(N,) from 0 to 1: the share of boxes, in world, that a camera's picture has, less if they are small.

    `row` (N,) says at which frame, from 0, each box is. The lens is that of the first frame.
    """
    samples = [recording.sample(agent, frame) for frame in recording.frames]
    lens = recording.dataset.camera(samples[0], channel)
    poses = np.array([recording.dataset.world_from(sample, channel).matrix for sample in samples])[
        row
    ]
    center = boxes.center[:, None]
    layers = center[:, None] + _LAYERS[:, None, None] * (boxes.corners() - center)[:, None]
    world = layers.reshape(len(boxes), layers.shape[1] * layers.shape[2], 3) - poses[:, None, :3, 3]
    places = (world @ poses[:, :3, :3]).reshape(-1, 3)
    inside = (
        lens.in_image(*lens.project(places), min_depth=IN_FRONT_DEPTH)
        .reshape(world.shape[:2])
        .mean(axis=1)
    )
    away = np.linalg.norm(boxes.center - poses[:, :3, 3], axis=1).clip(1.0)
    size = lens.intrinsic[0, 0] / lens.width * boxes.size[:, 0] / away
    return as_floats(inside * size / (size + _LARGE))


def steady(scores: AnyArray) -> list[int]:
    """The choice of columns, one for each row, with the largest sum of scores less the cost of changes."""
    total, before = scores[0], []
    for each in scores[1:]:
        best = int(total.argmax())
        stays = total >= total[best] - _SWITCH
        before.append(np.where(stays, np.arange(len(total)), best))
        total = np.where(stays, total, total[best] - _SWITCH) + each
    path = [int(total.argmax())]
    for columns in reversed(before):
        path.append(int(columns[path[-1]]))
    return path[::-1]


@dataclass(frozen=True, slots=True, kw_only=True)
class PictureSettings:
    """How pictures are written: those of the front cameras, and of the cameras while they follow the pair, are larger.

    Attributes:
        width: pixels; narrower images stay as they are.
        quality: of JPEG.
        every: one of so many frames has a picture.
        others: one of so many frames has a picture of the other cameras; 0 for none.
    """

    width: int
    quality: int
    every: int = 1
    others: int = 1

    @property
    def other_width(self) -> int:
        """Of the other cameras' pictures, pixels."""
        return min(self.width, max(self.width // 2, LEAST_OTHER))


@dataclass(frozen=True, slots=True, kw_only=True)
class _Image:
    """An image file, and whether its picture is one of the larger ones."""

    path: ReleasePath
    large: bool


_Images = dict[tuple[str, str], list[_Image | None]]


def camera_files(recording: ReplayRecording) -> CameraFiles:
    """The image files of all cameras of the agents."""
    there = recording.dataset.sensor_frames(recording.scenario["token"])
    return {
        (agent, channel): [
            path if frame in there[agent, channel] else None
            for frame, path in zip(recording.frames, _paths(recording, agent, channel), strict=True)
        ]
        for agent in recording.agents
        for channel in CAMERAS
    }


def camera_pictures(
    files: CameraFiles,
    followed: Followed,
    limit: float,
    *,
    progress: bool = False,
) -> tuple[PictureSettings | None, Jpegs]:
    """The largest pictures of the agents' cameras within a limit of bytes, and how they are written; None if none is.

    If the smallest ones do not fit, there are fewer. While cameras follow the pair, their pictures are as large as the
    front cameras'. Raises SensorFileError.
    """
    images: _Images = {
        (agent, channel): [
            None if path is None else _Image(path=path, large=channel in (FRONT, follows))
            for path, follows in zip(paths, followed.channels[agent], strict=True)
        ]
        for (agent, channel), paths in files.items()
    }
    return _fitting(images, limit, _ladder(max(map(len, files.values()))), progress=progress)


def _paths(recording: ReplayRecording, agent: str, channel: str) -> Iterator[ReleasePath]:
    samples = (recording.sample(agent, frame) for frame in recording.frames)
    return (recording.dataset.sensor_path(f"{sample}/{channel}") for sample in samples)


def _ladder(frames: int) -> Iterator[PictureSettings]:
    """Ways to write pictures, each smaller than the one before."""
    for number, (width, quality) in enumerate(LADDER):
        yield PictureSettings(
            width=width, quality=quality, others=OTHERS[min(number, len(OTHERS) - 1)]
        )
    every = 1
    while every < 2 * frames:
        yield PictureSettings(width=width, quality=quality, every=every, others=0)
        every *= 2


def _fitting(
    images: _Images, limit: float, ladder: Iterator[PictureSettings], *, progress: bool
) -> tuple[PictureSettings | None, Jpegs]:
    probes = probes_of(images)
    for settings in ladder if probes else ():
        kept = _kept(images, settings)
        written = [image for each in kept.values() for image in each if image is not None]
        weight = {
            large: sum(len(_jpeg(each, settings, large=large)) for each in probes)
            for large in (True, False)
        }
        if sum(weight[image.large] for image in written) / len(probes) > limit:
            continue
        encoded = _encoded(written, settings, progress=progress)
        if sum(map(len, encoded)) <= limit:
            return settings, _by_agent(kept, encoded)
    return None, {}


def probes_of(images: _Images) -> list[ByteArray]:
    """The pictures from which the size of all is estimated."""
    there = [image for each in images.values() for image in each if image is not None]
    return [read_image(image.path) for image in there[:: max(1, len(there) // _PROBED)]]


def _kept(images: _Images, settings: PictureSettings) -> _Images:
    """The images that have pictures; the others are None."""

    def kept(image: _Image | None, frame: int) -> _Image | None:
        every = settings.every if image is not None and image.large else settings.others
        return image if every and frame % every == 0 else None

    return {
        key: [kept(image, frame) for frame, image in enumerate(each)]
        for key, each in images.items()
    }


def _encoded(images: Sequence[_Image], settings: PictureSettings, *, progress: bool) -> list[bytes]:
    """The pictures as JPEG; made in threads, because the libraries that do most of the work let other threads run."""
    work = partial(_jpeg_of, settings=settings)
    with own_threads() as threads:
        return run_batch(work, images, executor=threads, label="pictures", progress=progress)


def _by_agent(kept: _Images, encoded: Sequence[bytes]) -> Jpegs:
    following = iter(encoded)
    jpegs: Jpegs = {}
    for (agent, channel), images in kept.items():
        pictures = tuple(None if image is None else next(following) for image in images)
        if any(pictures):
            jpegs.setdefault(agent, {})[channel] = pictures
    return jpegs


def _jpeg_of(image: _Image, settings: PictureSettings) -> bytes:
    return _jpeg(read_image(image.path), settings, large=image.large)


def _jpeg(image: ByteArray, settings: PictureSettings, *, large: bool) -> bytes:
    from PIL import Image

    height, width = image.shape[:2]
    most = settings.width if large else settings.other_width
    picture = Image.fromarray(image)
    if width > most:
        picture = picture.resize((most, max(1, round(height * most / width))), reducing_gap=2.0)
    return picture_bytes(picture, "JPEG", quality=settings.quality, optimize=True)


def most_points(clouds: int, limit: float) -> int:
    """How many points each of so many clouds may have so that all keep a limit of bytes."""
    return min(_MOST, int(limit / (_POINT_BYTES * max(1, clouds))))


def lidar_points(recording: ReplayRecording, most: int) -> list[list[str | None] | None] | None:
    """For each agent a cloud for each frame, as `cloud_text` has it, of at most so many points.

    None stands for a missing file; an agent of which all are missing has no list, and without any there is none.
    Raises SensorFileError.
    """
    clouds = [
        [cloud_text(recording, agent, frame, most) for frame in recording.frames]
        for agent in recording.agents
    ]
    shown = [each if set(each) != {None} else None for each in clouds]
    return shown if any(shown) else None


def served_points(recording: ReplayRecording) -> int:
    """How many points a cloud may have that a server gives, if all files are there."""
    return most_points(len(recording.agents) * len(recording.frames), SERVED_POINTS)


def cloud_text(
    recording: ReplayRecording, agent: str, frame: int, most: int | None = None
) -> str | None:
    """A cloud above the road: int16 x, y, z, x, y, z, …, little-endian, decimetres from the origin, as base64.

    z is that of world. At most so many points, by default `served_points`, spread evenly over the
    cubes that have any. None if there is no file; raises SensorFileError.
    """
    dataset, sample = recording.dataset, recording.sample(agent, frame)
    try:
        cloud = dataset.load_point_cloud(sample, "ego")
    except MissingFileError:
        return None
    height = cloud.xyz[:, 2]
    ground = np.percentile(height[::_SOME], _GROUND) if len(height) else 0.0
    raised = cloud.xyz[height > ground + _LEAST_HEIGHT]
    world = dataset.world_from(sample, "ego").apply(raised) - np.append(recording.origin, 0.0)
    cubes, chosen = (np.floor(world / _CELL) @ _NUMBERED).astype(np.int64), np.full(_SLOTS, -1)
    chosen[((cubes ^ (cubes >> 15)) * _MIXED >> 16) % _SLOTS] = np.arange(len(world))
    kept = world[chosen[chosen >= 0][: served_points(recording) if most is None else most]]
    decimetres = np.clip(np.rint(kept * 10), -(2**15), 2**15 - 1)
    return base64.b64encode(decimetres.astype("<i2").tobytes()).decode("ascii")
