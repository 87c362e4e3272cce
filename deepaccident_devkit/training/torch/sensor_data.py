"""The sensor data of cooperating agents for a sample, as arrays (agents × past frames × …)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any, Final

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import ConfigError, MissingFileError
from deepaccident_devkit.export.images import ImageConfig
from deepaccident_devkit.motion import Augmentation
from deepaccident_devkit.release.layout import MissingFiles
from deepaccident_devkit.support.arrays import (
    AnyArray,
    BoolArray,
    ByteArray,
    FloatArray,
    IntArray,
    keep_freed,
)
from deepaccident_devkit.support.parallel.executors import own_threads
from deepaccident_devkit.tables.tokens import sample_token
from deepaccident_devkit.taxonomy import LIDAR, AgentName
from deepaccident_devkit.training.image_cache import ImageCache
from deepaccident_devkit.training.torch.config import V2XConfig, augmented_points, augmented_pose
from deepaccident_devkit.v2x import Agents, Link, cooperating_agents
from deepaccident_devkit.v2x.messages import Message, messages

_NO_POINTS: Final = np.zeros((0, 4), dtype=np.float32)
Received = Sequence[Mapping[AgentName, Message]]
"""For each past frame, the present last: sender → its message, for messages that arrived."""
# Name → rows and columns.
_MATRICES: Final = {"intrinsics": 3, "ego_from_camera": 4, "image_from_ego": 4}


def participants(dataset: Dataset, sample: str, agents: Agents) -> tuple[AgentName, ...]:
    """The sample's own agent and those that cooperate with it; the errors are those of `v2x.cooperating_agents`."""
    own = cooperating_agents(dataset, sample, "single")
    return tuple(dict.fromkeys([*own, *cooperating_agents(dataset, sample, agents)]))


def received(
    dataset: Dataset, sample: str, names: tuple[AgentName, ...], config: V2XConfig
) -> Received:
    """The messages that arrive at a sample and at the `config.past` − 1 moments before it, each through the link.

    A moment before the recording has no messages. If latency asks for data from before the recording, the moment has no
    messages of partners; at the sample itself that raises ConfigError.
    """
    scenario, ego, number = sample.rsplit("/", 2)
    result: list[dict[AgentName, Message]] = []
    for steps_back in range(config.past - 1, -1, -1):
        index = int(number) - steps_back * (config.step or 1)
        if index < 1:
            result.append({})
            continue
        heard = names if not steps_back or _reaches(config.link, index) else names[:1]
        then = sample_token(scenario, ego, index)
        result.append(
            {message.agent: message for message in messages(dataset, then, heard, config.link)}
        )
    return result


def _reaches(link: Link | None, index: int) -> bool:
    return link is None or index > link.latency_frames


def with_files(
    dataset: Dataset,
    sample: str,
    names: Sequence[AgentName],
    arrived: Received,
    config: V2XConfig,
    cache: ImageCache | None,
    *,
    needs_own: bool = True,
) -> tuple[Received, IntArray]:
    """The messages whose sensor files are all there, and how many files each agent and frame (A, P) lacks.

    With a cache, images are there if it has them.

    Raises:
        MissingFileError: a file is not there, by `on_missing`; or one of the sample's own at the present is not, and it
            `needs_own`.
    """
    channels = (*[LIDAR] * config.points, *(() if config.images is None else config.images.cameras))
    skippable = MissingFiles(dataset.dataroot, config.on_missing)
    necessary = MissingFiles(
        dataset.dataroot, "skip"
    )  # their error has another remedy than skipping

    def lacks(token: str, channel: str, *, own: bool) -> bool:
        if cache is not None and channel != LIDAR:
            return (own or config.on_missing == "skip") and not cache.has(
                token
            )  # else the error comes from loading it
        return not (necessary if own else skippable).has(dataset.sensor_path(token), channel)

    lacking = np.zeros((len(names), len(arrived)), dtype=np.int64)
    for p in reversed(range(len(arrived))):  # the present first, whose lack cannot be helped
        for name, message in arrived[p].items():
            own = needs_own and message.sample == sample
            absent = [
                channel
                for channel in channels
                if lacks(f"{message.sample}/{channel}", channel, own=own)
            ]
            if own and absent:
                where = "" if cache is None or absent[0] == LIDAR else " in the cache of images"
                raise MissingFileError(
                    f"{dataset.sensor_path(f'{sample}/{absent[0]}')}: no such file{where}; {sample} lacks "
                    f"{len(absent)} of the {len(channels)} files of its own agent, which cannot be skipped; unpack the "
                    "archives that hold them, choose other sensors, or take only samples that have them: "
                    f"da.training_samples(split, sensors={list(channels)})"
                )
            lacking[names.index(name), p] = len(absent)
    there = [
        {name: message for name, message in moment.items() if not lacking[names.index(name), p]}
        for p, moment in enumerate(arrived)
    ]
    return there, lacking


def valid_mask(names: Sequence[AgentName], arrived: Received) -> BoolArray:
    """(A, P) bool, which messages arrived."""
    return np.array([[name in moment for moment in arrived] for name in names])


def relative_poses(
    dataset: Dataset,
    sample: str,
    names: Sequence[AgentName],
    arrived: Received,
    augmentation: Augmentation,
) -> AnyArray:
    """`ego_from_agent` (A, P, 4, 4) float32: augmented, with the link's errors; the identity without a message."""
    ego_from_world = dataset.world_from(sample, "ego").inverse()
    poses = np.tile(np.eye(4), (len(names), len(arrived), 1, 1))
    for a, name in enumerate(names):
        for p, moment in enumerate(arrived):
            if name in moment and moment[name].sample != sample:
                pose = moment[name].target_from(dataset, "ego", ego_from_world).matrix
                poses[a, p] = augmented_pose(pose, augmentation)
    return poses.astype(np.float32)


def own_motions(
    dataset: Dataset, names: Sequence[AgentName], arrived: Received, augmentation: Augmentation
) -> AnyArray:
    """`agent_from_past` (A, P, 4, 4) float32: augmented, exact; the identity without a message."""
    poses = np.tile(np.eye(4), (len(names), len(arrived), 1, 1))
    for a, name in enumerate(names):
        if name not in arrived[-1]:
            continue
        agent_from_world = dataset.world_from(arrived[-1][name].sample, "ego").inverse()
        for p, moment in enumerate(arrived[:-1]):
            if name in moment:
                pose = (agent_from_world @ dataset.world_from(moment[name].sample, "ego")).matrix
                poses[a, p] = augmented_pose(pose, augmentation)
    return poses.astype(np.float32)


def point_clouds(
    dataset: Dataset, names: Sequence[AgentName], arrived: Received, augmentation: Augmentation
) -> list[list[AnyArray]]:
    """For each agent and moment (N, 4) float32: x y z in the sender's own augmented ego frame, intensity."""

    def cloud(message: Message) -> AnyArray:
        return augmented_points(dataset.load_point_cloud(message.sample, "ego"), augmentation)

    return [
        [cloud(moment[name]) if name in moment else _NO_POINTS for moment in arrived]
        for name in names
    ]


def camera_arrays(
    dataset: Dataset,
    names: Sequence[AgentName],
    arrived: Received,
    augmentation: Augmentation,
    config: ImageConfig,
    cache: ImageCache | None,
) -> dict[str, AnyArray]:
    """All agents' C cameras; without a message, images are 0 and matrices are the identity.

    `images` (A, P, C, 3, h, w) as the configuration says, and, all float32, `intrinsics` (A, P, C, 3, 3),
    `ego_from_camera` (A, P, C, 4, 4) and `image_from_ego` (A, P, C, 4, 4), with the senders' own augmented ego frames.
    Raises ConfigError if images have different sizes, or the crop reaches beyond them.
    """
    from torch.utils.data import get_worker_info

    load = partial(config.load, dataset) if cache is None else partial(cache.load, config, dataset)
    mapped = map if cache is not None or get_worker_info() is not None else _by_threads
    shape = (len(names), len(arrived), len(config.cameras))
    keep_freed()
    images: ByteArray = np.zeros(
        (*shape, 3, 0, 0), dtype=np.uint8
    )  # until the first one tells the size
    result = {
        key: np.tile(np.eye(size, dtype=np.float32), (*shape, 1, 1))
        for key, size in _MATRICES.items()
    }
    for p, moment in enumerate(arrived):
        for name, message in moment.items():
            a, intrinsics = names.index(name), []
            for c, (pixels, intrinsic) in enumerate(
                mapped(load, [f"{message.sample}/{each}" for each in config.cameras])
            ):
                if not images.size:
                    images = np.zeros((*shape, 3, *pixels.shape[:2]), dtype=np.uint8)
                if images.shape[4:] != pixels.shape[:2]:
                    raise ConfigError(
                        f"images have different sizes, {images.shape[4:]} and {pixels.shape[:2]}; choose resize="
                    )
                images[a, p, c] = pixels.transpose(2, 0, 1)
                intrinsics.append(intrinsic)
            matrices = _matrices(
                dataset, message.sample, augmentation, config, np.stack(intrinsics)
            )
            for key, each in matrices.items():
                result[key][a, p] = each
    return {"images": config.values(images, valid_mask(names, arrived)), **result}


def _by_threads(function: Callable[[str], Any], values: Iterable[str]) -> list[Any]:
    """As `map`, for decoding where no workers share the cores: it is done outside of the interpreter's lock."""
    with own_threads() as pool:
        return list(pool.map(function, values))


def _matrices(
    dataset: Dataset,
    sample: str,
    augmentation: Augmentation,
    config: ImageConfig,
    intrinsics: FloatArray,
) -> dict[str, AnyArray]:
    """One agent's cameras at one moment: the matrices of `camera_arrays` without the first two axes."""
    ego_from_world = dataset.world_from(sample, "ego").inverse()
    poses = [
        (ego_from_world @ dataset.world_from(sample, channel)).matrix for channel in config.cameras
    ]
    ego_from_camera: FloatArray = augmentation.matrix @ np.stack(poses)
    projection = np.tile(np.eye(4), (len(poses), 1, 1))
    projection[:, :3, :3] = intrinsics
    return {
        "intrinsics": intrinsics,
        "ego_from_camera": ego_from_camera,
        "image_from_ego": projection @ np.linalg.inv(ego_from_camera),
    }
