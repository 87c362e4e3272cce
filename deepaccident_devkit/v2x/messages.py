"""Messages between agents, and how large they are."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import DTypeLike

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.release.layout import MissingFiles
from deepaccident_devkit.support.arrays import checked_whole
from deepaccident_devkit.tables.tokens import sample_token
from deepaccident_devkit.taxonomy import CAMERAS, LIDAR, AgentName, OnError
from deepaccident_devkit.v2x.configurations import Agents, cooperating_agents
from deepaccident_devkit.v2x.link import Link, checked_link

POINT_BYTES: Final = 4 * 4
"""x, y, z and intensity in single precision."""
BOX_BYTES: Final = 9 * 4 + 4 + 1 + 4
"""Centre, size, yaw and horizontal velocity in single precision, an id, a class and a score."""
POSE_BYTES: Final = 6 * 4
"""A 6-vector in single precision, which goes with every message."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MessageSize:
    """Bytes of one agent's message at one moment, uncompressed, for each kind of data; each includes a pose (24 bytes).

    Attributes:
        images: the six cameras' pixels, 3 bytes each, in the size that calib gives.
        cloud: the LiDAR's points, 16 bytes each; None if points were not counted, or the file is not there.
        boxes: the boxes that it annotated, its own included, 45 bytes each.
        bev: a BEV feature map of the given shape and type.
    """

    images: int
    cloud: int | None
    boxes: int
    bev: int


def message_sizes(
    dataset: Dataset,
    sample: RowArgument,
    *,
    agents: Agents = None,
    bev_shape: tuple[int, int, int] = (64, 200, 200),
    bev_dtype: DTypeLike = np.float32,
    clouds: bool = True,
    link: Link | None = None,
    on_missing: OnError = "raise",
) -> dict[str, MessageSize]:
    """Bytes that each agent sends for a sample's moment, for each kind of data.

    Args:
        dataset: the release.
        sample: token or record: its frame is the moment.
        agents: names of agents, a configuration or its name as seen from the ego, or None for all that are there.
        bev_shape: channels, rows, columns of the BEV features.
        bev_dtype: type of the BEV features.
        clouds: whether to read the point clouds, to count their points.
        link: what happens to the partners' data; None for nothing. With latency, sizes are those of the earlier frame
            that arrives; pose noise does not change the size of a message.
        on_missing: of point clouds that were not downloaded: `raise`, or `skip` leaves their size out (`cloud` is None)
            and logs how many.

    Returns:
        Agent → sizes of what arrives. The sample's own agent (which sends nothing to itself) is first, if it is among
        them. A partner whose message is lost is left out; a call without `link` gives the size of that message.

    Raises:
        TokenError: no such sample.
        ChoiceError: no such agent, configuration or `on_missing`, or `bev_shape` is no shape or `bev_dtype` no type.
        NotAvailableError: an agent is not in this (partial) release.
        ConfigError: `link` is no Link, or its latency is longer than the scenario's past.
        MissingFileError: `clouds` is true, `on_missing` is `raise`, and a point cloud was not downloaded.
        SensorFileError: `clouds` is true and a point cloud cannot be read.
    """
    bev = _bev_bytes(bev_shape, bev_dtype)
    files = MissingFiles(dataset.dataroot, on_missing)
    sizes: dict[str, MessageSize] = {}
    for message in messages(dataset, sample, agents, link):
        images = [dataset.get("sample_data", f"{message.sample}/{camera}") for camera in CAMERAS]
        path = dataset.sensor_path(f"{message.sample}/{LIDAR}")
        counted = clouds and files.has(path, LIDAR)
        points = len(dataset.load_point_cloud(message.sample, "lidar")) if counted else None
        sizes[message.agent] = MessageSize(
            images=POSE_BYTES + sum(3 * image["width"] * image["height"] for image in images),
            cloud=None if points is None else POSE_BYTES + POINT_BYTES * points,
            boxes=POSE_BYTES + BOX_BYTES * len(dataset.boxes(message.sample, "lidar")),
            bev=POSE_BYTES + bev,
        )
    files.tell()
    return sizes


def _bev_bytes(shape: Sequence[int], dtype: DTypeLike) -> int:
    expected = "(channels, rows, columns), whole numbers from 1"
    if np.shape(shape) != (3,):
        raise ChoiceError(f"bev_shape: expected {expected}, found {shape!r}")
    lengths = [checked_whole("bev_shape", length, expected, ChoiceError) for length in shape]
    if min(lengths) < 1:
        raise ChoiceError(f"bev_shape: expected {expected}, found {shape!r}")
    try:
        return math.prod(lengths) * np.dtype(dtype).itemsize
    except TypeError as error:
        raise ChoiceError(f"bev_dtype: expected a type such as 'float32', found {dtype!r} ({error})") from error


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Message:
    """One agent's data as the ego receives them.

    Attributes:
        agent: the agent that sent them.
        sample: token of the sample of the data: with latency an earlier one.
        pose_error: `claimed_from_world`; None without pose noise.
    """

    agent: AgentName
    sample: str
    pose_error: SE3 | None

    def target_from(self, dataset: Dataset, frame: str, target_from_world: SE3) -> SE3:
        """Where the ego places coordinates of the sender's `frame`: `target_from_frame`, pose noise included."""
        world_from_frame = dataset.world_from(self.sample, frame)
        if self.pose_error is not None:
            world_from_frame = self.pose_error @ world_from_frame
        return target_from_world @ world_from_frame


def messages(
    dataset: Dataset, sample: RowArgument, agents: Agents = None, link: Link | None = None, *, sweeps: int = 1
) -> Iterator[Message]:
    """What the agents contribute at a sample and at the frames before it, the sample's own agent first.

    Args:
        dataset: the release.
        sample: token or record: its agent is the ego, its frame the present.
        agents: who cooperates (`cooperating_agents`).
        link: what happens to the partners' data; None for nothing.
        sweeps: number of frames, the present included; those before the recording began are left out.

    Yields:
        By frame, the present first and then backwards, and for each frame by agent; nothing for a lost message.

    Raises:
        TokenError, ChoiceError, NotAvailableError: as in `cooperating_agents`.
        ConfigError: `link` is no Link, or its latency is longer than the scenario's past at the present.
    """
    link = checked_link(link)
    names = cooperating_agents(dataset, sample, agents)
    scenario, ego, number = dataset.get("sample", sample)["token"].rsplit("/", 2)
    for index in range(int(number), max(int(number) - sweeps, 0), -1):
        for agent in names:
            if link is None or agent == ego:
                yield Message(agent=agent, sample=sample_token(scenario, agent, index), pose_error=None)
            elif index == int(number) or index > link.latency_frames:
                message = _received(dataset, scenario, agent, index, link)
                if message is not None:
                    yield message


def _received(dataset: Dataset, scenario: str, agent: AgentName, index: int, link: Link) -> Message | None:
    sent = sample_token(scenario, agent, link.frame_sent(scenario, index))
    if link.loses(scenario, agent, index):
        return None
    error = None
    if link.pose_noise is not None:
        error = link.pose_error(scenario, agent, index, dataset.world_from(sent, "ego").translation)
    return Message(agent=agent, sample=sent, pose_error=error)
