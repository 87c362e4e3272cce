"""The sensor data of cooperating agents for a sample, as arrays (agents, past frames, …)."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

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
from deepaccident_devkit.v2x import Agents, cooperating_agents
from deepaccident_devkit.v2x.messages import Message, messages

_NO_POINTS = np.zeros((0, 4), dtype=np.float32)
Received = Sequence[Mapping[AgentName, Message]]
"""For each past frame, the present last: sender → the message that arrived from it."""
# Name of a square matrix → number of its rows.
_MATRICES = {"intrinsics": 3, "ego_from_camera": 4, "image_from_ego": 4}


def participants(dataset: Dataset, sample: str, agents: Agents) -> tuple[AgentName, ...]:
    """Return the sample's own agent and the agents that cooperate with it.

    Errors are as in `v2x.cooperating_agents`.
    """
    own_agent = cooperating_agents(dataset, sample, "single")
    cooperating = cooperating_agents(dataset, sample, agents)
    return tuple(dict.fromkeys([*own_agent, *cooperating]))


def received_messages(
    dataset: Dataset, sample: str, names: tuple[AgentName, ...], config: V2XConfig
) -> Received:
    """Return the messages that arrive at a sample and at the `config.past` − 1 moments before it.

    Each moment's messages come through the link. A moment before the recording has no messages. If
    partners' data would be from before the recording because of the latency, the moment has no
    messages of partners; at the sample itself that is an error.

    Raises:
        ConfigError: If partners' data for the sample itself would be from before the recording.
    """
    scenario, ego, number = sample.rsplit("/", 2)
    latency_frames = 0
    if config.link is not None:
        latency_frames = config.link.latency_frames
    received: list[dict[AgentName, Message]] = []
    for steps_back in range(config.past - 1, -1, -1):
        frame = int(number) - steps_back * (config.step or 1)
        if frame < 1:
            received.append({})
            continue
        senders = names
        if steps_back and frame <= latency_frames:
            senders = names[:1]
        moment = sample_token(scenario, ego, frame)
        moment_messages = messages(dataset, moment, senders, config.link)
        received.append({message.agent: message for message in moment_messages})
    return received


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
    """Return the messages that have all their sensor files, and the numbers of missing files.

    With a cache, images exist if the cache has them.

    Args:
        dataset: The release.
        sample: Token of the sample.
        names: Names of the A agents.
        arrived: Messages of P frames.
        config: Contents of the sample's item.
        cache: Cache of images; None for the release's own images.
        needs_own: Whether the sample's own agent must have its files of the present.

    Returns:
        The messages, and the number of missing files of each agent and frame, (A, P).

    Raises:
        MissingFileError: If a file is missing and `on_missing` forbids that, or a file that the
            sample's own agent must have is missing.
    """
    channels: list[str] = [LIDAR] if config.points else []
    if config.images is not None:
        channels += config.images.cameras
    skippable = MissingFiles(dataset.dataroot, config.on_missing)
    necessary = MissingFiles(dataset.dataroot, "skip")  # their error has another remedy

    def is_missing(token: str, channel: str, *, is_own: bool) -> bool:
        if cache is not None and channel != LIDAR:
            # otherwise loading the image raises the error
            is_checked = is_own or config.on_missing == "skip"
            return is_checked and not cache.has(token)
        files = necessary if is_own else skippable
        return not files.has(dataset.sensor_path(token), channel)

    missing_counts = np.zeros((len(names), len(arrived)), dtype=np.int64)
    complete: list[dict[AgentName, Message]] = []
    # the present comes first, because its missing files are an error
    for frame in reversed(range(len(arrived))):
        complete.insert(0, {})
        for name, message in arrived[frame].items():
            is_own = needs_own and message.sample == sample
            missing_channels = []
            for channel in channels:
                if is_missing(f"{message.sample}/{channel}", channel, is_own=is_own):
                    missing_channels.append(channel)
            if not missing_channels:
                complete[0][name] = message
            elif is_own:
                path = dataset.sensor_path(f"{sample}/{missing_channels[0]}")
                is_cached = cache is not None and missing_channels[0] != LIDAR
                location = " in the cache of images" if is_cached else ""
                raise MissingFileError(
                    f"{path}: no such file{location}; {sample} lacks {len(missing_channels)} of "
                    f"the {len(channels)} files of its own agent, which cannot be skipped; unpack "
                    "the archives that contain them, choose other sensors, or use only samples "
                    f"with them: da.training_samples(split, sensors={channels})"
                )
            missing_counts[names.index(name), frame] = len(missing_channels)
    return complete, missing_counts


def valid_mask(names: Sequence[AgentName], arrived: Received) -> BoolArray:
    """Return whether each agent's message arrived at each frame, (A, P) bool."""
    valid = np.zeros((len(names), len(arrived)), dtype=bool)
    for agent, name in enumerate(names):
        valid[agent] = [name in moment for moment in arrived]
    return valid


def relative_poses(
    dataset: Dataset,
    sample: str,
    names: Sequence[AgentName],
    arrived: Received,
    augmentation: Augmentation,
) -> AnyArray:
    """Return the augmented `ego_from_agent` (A, P, 4, 4) float32, with the link's errors.

    Without a message it is the identity.
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
    """Return the augmented `agent_from_past` (A, P, 4, 4) float32, without the link's errors.

    Without a message it is the identity.
    """
    poses = np.tile(np.eye(4), (len(names), len(arrived), 1, 1))
    *past_moments, present = arrived
    for agent, name in enumerate(names):
        if name not in present:
            continue
        agent_from_world = dataset.world_from(present[name].sample, "ego").inverse()
        for frame, moment in enumerate(past_moments):
            if name in moment:
                world_from_past = dataset.world_from(moment[name].sample, "ego")
                agent_from_past = agent_from_world @ world_from_past
                poses[agent, frame] = augmented_pose(agent_from_past.matrix, augmentation)
    return poses.astype(np.float32)


def point_clouds(
    dataset: Dataset, names: Sequence[AgentName], arrived: Received, augmentation: Augmentation
) -> list[list[AnyArray]]:
    """Return the points (N, 4) float32 of each agent and moment; empty without a message.

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

    Without a message, images are 0 and matrices are the identity.

    Returns:
        `images` (A, P, C, 3, h, w) as configured, and, all float32, `intrinsics` (A, P, C, 3, 3),
        `ego_from_camera` (A, P, C, 4, 4) and `image_from_ego` (A, P, C, 4, 4), with the senders'
        own augmented ego frames.

    Raises:
        ConfigError: If images have different sizes, or are smaller than the crop.
    """
    from torch.utils.data import get_worker_info

    load = partial(config.load, dataset) if cache is None else partial(cache.load, config, dataset)
    has_free_cores = cache is None and get_worker_info() is None
    map_function = _map_in_threads if has_free_cores else map
    shape = (len(names), len(arrived), len(config.cameras))
    keep_freed()
    images: ByteArray = np.zeros((*shape, 3, 0, 0), dtype=np.uint8)  # until the size is known
    matrices = {}
    for key, size in _MATRICES.items():
        identity = np.eye(size, dtype=np.float32)
        matrices[key] = np.tile(identity, (*shape, 1, 1))
    for frame, moment in enumerate(arrived):
        for name, message in moment.items():
            agent = names.index(name)
            intrinsics = []
            tokens = [f"{message.sample}/{channel}" for channel in config.cameras]
            for camera, (image, intrinsic) in enumerate(map_function(load, tokens)):
                image_size = image.shape[:2]
                if not images.size:
                    images = np.zeros((*shape, 3, *image_size), dtype=np.uint8)
                if images.shape[4:] != image_size:
                    raise ConfigError(
                        f"images have different sizes, {images.shape[4:]} and {image_size}; "
                        "choose resize="
                    )
                images[agent, frame, camera] = image.transpose(2, 0, 1)
                intrinsics.append(intrinsic)
            message_matrices = _camera_matrices(
                dataset, message.sample, augmentation, config, np.stack(intrinsics)
            )
            for key, message_matrix in message_matrices.items():
                matrices[key][agent, frame] = message_matrix
    values = config.values(images, valid_mask(names, arrived))
    return {"images": values, **matrices}


def _map_in_threads(function: Callable[[str], Any], values: Iterable[str]) -> list[Any]:
    """Map values in threads, for decoding where no workers share the cores.

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
    """Return the matrices of `camera_arrays` for one agent at one moment, (C, …)."""
    ego_from_world = dataset.world_from(sample, "ego").inverse()
    matrices = []
    for channel in config.cameras:
        pose = ego_from_world @ dataset.world_from(sample, channel)
        matrices.append(pose.matrix)
    ego_from_camera: FloatArray = augmentation.matrix @ np.stack(matrices)
    projection = np.tile(np.eye(4), (len(matrices), 1, 1))
    projection[:, :3, :3] = intrinsics
    return {
        "intrinsics": intrinsics,
        "ego_from_camera": ego_from_camera,
        "image_from_ego": projection @ np.linalg.inv(ego_from_camera),
    }
