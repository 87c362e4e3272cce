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
"""For each past frame, the present last: sender → its message, if it arrived."""
# Name → rows and columns.
_MATRICES: Final = {"intrinsics": 3, "ego_from_camera": 4, "image_from_ego": 4}


def participants(dataset: Dataset, sample: str, agents: Agents) -> tuple[AgentName, ...]:
    """Return the sample's own agent and the agents that cooperate with it.

    Errors are as in `v2x.cooperating_agents`.
    """
    own_agent = cooperating_agents(dataset, sample, "single")
    return tuple(dict.fromkeys([*own_agent, *cooperating_agents(dataset, sample, agents)]))


def received_messages(
    dataset: Dataset, sample: str, names: tuple[AgentName, ...], config: V2XConfig
) -> Received:
    """Return the messages that arrive at a sample and at the `config.past` − 1 moments before it.

    Each moment's messages come through the link. A moment before the recording has no messages. If
    latency asks for data from before the recording, the moment has no messages of partners; at the
    sample itself that raises ConfigError.
    """
    scenario, ego, number = sample.rsplit("/", 2)
    received: list[dict[AgentName, Message]] = []
    for steps_back in range(config.past - 1, -1, -1):
        index = int(number) - steps_back * (config.step or 1)
        if index < 1:
            received.append({})
            continue
        senders = names if not steps_back or _reaches(config.link, index) else names[:1]
        moment = sample_token(scenario, ego, index)
        moment_messages = messages(dataset, moment, senders, config.link)
        received.append({message.agent: message for message in moment_messages})
    return received


def _reaches(link: Link | None, index: int) -> bool:
    """Return whether data that arrive at a frame (from 1) are from the recording."""
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
    """Return the messages with all their sensor files, and the number of missing files (A, P).

    The numbers are of each agent and frame. With a cache, images exist if the cache has them.

    Raises:
        MissingFileError: A file is missing and `on_missing` forbids it; or a file of the sample's
            own agent at the present is missing, and it `needs_own`.
    """
    channels: list[str] = [LIDAR] if config.points else []
    if config.images is not None:
        channels += config.images.cameras
    skippable = MissingFiles(dataset.dataroot, config.on_missing)
    necessary = MissingFiles(dataset.dataroot, "skip")  # their error has another remedy

    def lacks(token: str, channel: str, *, is_own: bool) -> bool:
        if cache is not None and channel != LIDAR:
            # Otherwise loading the image raises the error.
            return (is_own or config.on_missing == "skip") and not cache.has(token)
        files = necessary if is_own else skippable
        return not files.has(dataset.sensor_path(token), channel)

    missing_counts = np.zeros((len(names), len(arrived)), dtype=np.int64)
    # The present comes first, because its missing files are an error.
    for frame in reversed(range(len(arrived))):
        for name, message in arrived[frame].items():
            is_own = needs_own and message.sample == sample
            missing = []
            for channel in channels:
                if lacks(f"{message.sample}/{channel}", channel, is_own=is_own):
                    missing.append(channel)
            if is_own and missing:
                location = "" if cache is None or missing[0] == LIDAR else " in the cache of images"
                raise MissingFileError(
                    f"{dataset.sensor_path(f'{sample}/{missing[0]}')}: no such file{location}; "
                    f"{sample} lacks {len(missing)} of the {len(channels)} files of its own agent, "
                    "which cannot be skipped; unpack the archives that hold them, choose other "
                    "sensors, or take only samples that have them: "
                    f"da.training_samples(split, sensors={channels})"
                )
            missing_counts[names.index(name), frame] = len(missing)
    complete = []
    for frame, moment in enumerate(arrived):
        complete.append(
            {
                name: message
                for name, message in moment.items()
                if not missing_counts[names.index(name), frame]
            }
        )
    return complete, missing_counts


def valid_mask(names: Sequence[AgentName], arrived: Received) -> BoolArray:
    """Return whether each message arrived, (A, P) bool."""
    return np.array([[name in moment for moment in arrived] for name in names])


def relative_poses(
    dataset: Dataset,
    sample: str,
    names: Sequence[AgentName],
    arrived: Received,
    augmentation: Augmentation,
) -> AnyArray:
    """Return `ego_from_agent` (A, P, 4, 4) float32: augmented, with the link's errors.

    It is the identity without a message.
    """
    ego_from_world = dataset.world_from(sample, "ego").inverse()
    poses = np.tile(np.eye(4), (len(names), len(arrived), 1, 1))
    for agent, name in enumerate(names):
        for frame, moment in enumerate(arrived):
            if name in moment and moment[name].sample != sample:
                pose = moment[name].target_from(dataset, "ego", ego_from_world).matrix
                poses[agent, frame] = augmented_pose(pose, augmentation)
    return poses.astype(np.float32)


def own_motions(
    dataset: Dataset, names: Sequence[AgentName], arrived: Received, augmentation: Augmentation
) -> AnyArray:
    """Return `agent_from_past` (A, P, 4, 4) float32: augmented, exact.

    It is the identity without a message.
    """
    poses = np.tile(np.eye(4), (len(names), len(arrived), 1, 1))
    for agent, name in enumerate(names):
        if name not in arrived[-1]:
            continue
        agent_from_world = dataset.world_from(arrived[-1][name].sample, "ego").inverse()
        for frame, moment in enumerate(arrived[:-1]):
            if name in moment:
                pose = (agent_from_world @ dataset.world_from(moment[name].sample, "ego")).matrix
                poses[agent, frame] = augmented_pose(pose, augmentation)
    return poses.astype(np.float32)


def point_clouds(
    dataset: Dataset, names: Sequence[AgentName], arrived: Received, augmentation: Augmentation
) -> list[list[AnyArray]]:
    """Return the cloud (N, 4) float32 of each agent and moment; empty without a message.

    The columns are x y z in the sender's own augmented ego frame, and intensity.
    """
    clouds = []
    for name in names:
        agent_clouds: list[AnyArray] = []
        for moment in arrived:
            cloud = _NO_POINTS
            if name in moment:
                points = dataset.load_point_cloud(moment[name].sample, "ego")
                cloud = augmented_points(points, augmentation)
            agent_clouds.append(cloud)
        clouds.append(agent_clouds)
    return clouds


def camera_arrays(
    dataset: Dataset,
    names: Sequence[AgentName],
    arrived: Received,
    augmentation: Augmentation,
    config: ImageConfig,
    cache: ImageCache | None,
) -> dict[str, AnyArray]:
    """Return the arrays of all agents' C cameras.

    Without a message, images are 0 and matrices are the identity. The arrays are `images` (A, P, C,
    3, h, w) as configured, and, all float32, `intrinsics` (A, P, C, 3, 3), `ego_from_camera` (A, P,
    C, 4, 4) and `image_from_ego` (A, P, C, 4, 4), with the senders' own augmented ego frames.
    Raises ConfigError if images have different sizes, or the crop reaches beyond them.
    """
    from torch.utils.data import get_worker_info

    load = partial(config.load, dataset) if cache is None else partial(cache.load, config, dataset)
    map_function = map if cache is not None or get_worker_info() is not None else _map_in_threads
    shape = (len(names), len(arrived), len(config.cameras))
    keep_freed()
    images: ByteArray = np.zeros((*shape, 3, 0, 0), dtype=np.uint8)  # until the size is known
    matrices = {
        key: np.tile(np.eye(size, dtype=np.float32), (*shape, 1, 1))
        for key, size in _MATRICES.items()
    }
    for frame, moment in enumerate(arrived):
        for name, message in moment.items():
            agent, intrinsics = names.index(name), []
            tokens = [f"{message.sample}/{channel}" for channel in config.cameras]
            for camera, (pixels, intrinsic) in enumerate(map_function(load, tokens)):
                if not images.size:
                    images = np.zeros((*shape, 3, *pixels.shape[:2]), dtype=np.uint8)
                if images.shape[4:] != pixels.shape[:2]:
                    raise ConfigError(
                        f"images have different sizes, {images.shape[4:]} and {pixels.shape[:2]}; "
                        "choose resize="
                    )
                images[agent, frame, camera] = pixels.transpose(2, 0, 1)
                intrinsics.append(intrinsic)
            message_matrices = _camera_matrices(
                dataset, message.sample, augmentation, config, np.stack(intrinsics)
            )
            for key, matrix in message_matrices.items():
                matrices[key][agent, frame] = matrix
    return {"images": config.values(images, valid_mask(names, arrived)), **matrices}


def _map_in_threads(function: Callable[[str], Any], values: Iterable[str]) -> list[Any]:
    """Map in threads, for decoding if no workers share the cores.

    Decoding runs outside of the interpreter's lock.
    """
    with own_threads() as pool:
        return list(pool.map(function, values))


def _camera_matrices(
    dataset: Dataset,
    sample: str,
    augmentation: Augmentation,
    config: ImageConfig,
    intrinsics: FloatArray,
) -> dict[str, AnyArray]:
    """Return the matrices of `camera_arrays` of one agent at a moment, without two axes."""
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
