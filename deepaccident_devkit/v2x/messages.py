"""Messages between agents: their sizes, and a real link's pose errors, delay and loss."""

import hashlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import DTypeLike

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ChoiceError, ConfigError
from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.release.layout import MissingFiles
from deepaccident_devkit.support.arrays import (
    FloatArray,
    checked_count,
    checked_number,
    checked_whole,
)
from deepaccident_devkit.support.text import choice
from deepaccident_devkit.support.values import NamedValues
from deepaccident_devkit.tables.tokens import sample_token
from deepaccident_devkit.taxonomy import CAMERAS, FRAME_PERIOD, LIDAR, AgentName, OnError
from deepaccident_devkit.v2x.agents import Agents, cooperating_agents

POINT_BYTES = 4 * 4
"""Bytes of x, y, z and intensity in single precision."""
BOX_BYTES = 9 * 4 + 4 + 1 + 4
"""Bytes of centre, size, yaw and horizontal velocity in single precision, an id, a class and a
score."""
POSE_BYTES = 6 * 4
"""Bytes of a 6-vector in single precision, which is part of every message."""
# Default BEV features: channels, rows, columns.
_BEV_SHAPE = (64, 200, 200)
Payload = Literal["images", "cloud", "boxes", "bev"]
"""The kinds of data that a message can contain; `MessageSize` describes them."""
_NORMAL_DISTRIBUTION = NormalDist()
# Largest budget and largest message, bytes.
_MAX_BYTES = 2**50
# No scenario is longer, so a longer latency must be in milliseconds.
_MAX_LATENCY_S = 20.0
# Largest difference between a latency and a whole number of frames, in frames.
_FRAME_TOLERANCE = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseNoise:
    """The error of a partner's pose estimate, drawn once for each partner and frame.

    The length of the position error is normally distributed with `mean` and `std`. The paper
    studies means of 0.1 to 0.5 m with σ = 0.02 m, and does not state the direction; here it is
    horizontal and uniformly distributed.

    Attributes:
        mean: Mean of the distance, metres.
        std: Standard deviation of the distance, metres.
        heading_std: Standard deviation of the heading error about the vertical, radians; its mean
            is 0.
    """

    mean: float = 0.0
    std: float = 0.02
    heading_std: float = 0.0

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ConfigError: A number is out of range.
        """
        for name in ("mean", "std", "heading_std"):
            field_name = f"pose noise: {name}"
            value = getattr(self, name)
            number = checked_number(field_name, value, "a number from 0", ConfigError)
            if not 0 <= number < math.inf:
                raise ConfigError(
                    f"{field_name} is {number:g}; choose a finite number of at least 0"
                )
            object.__setattr__(self, name, number)
        if self.heading_std > math.pi:
            radians = math.radians(self.heading_std)
            raise ConfigError(
                f"pose noise: heading_std is {self.heading_std:g} radians, over half a turn; "
                f"if these are degrees, give {radians:.4g}"
            )

    def draw(self, key: str) -> tuple[float, float, float]:
        """Draw the error of one partner at one frame.

        Args:
            key: Text that seeds the draw.

        Returns:
            Errors of x and y in world, metres, and error of the heading, radians.
        """
        direction_draw, distance_draw, _, heading_draw = uniforms(f"{key}/pose")
        distance = self.mean + self.std * _NORMAL_DISTRIBUTION.inv_cdf(distance_draw)
        direction = 2 * math.pi * direction_draw
        x = distance * math.cos(direction)
        y = distance * math.sin(direction)
        heading = self.heading_std * _NORMAL_DISTRIBUTION.inv_cdf(heading_draw)
        return x, y, heading


@dataclass(frozen=True, slots=True, kw_only=True)
class Link:
    """The effects of a radio link on partners' data; the ego's own data never change.

    Every draw depends only on the seed, the scenario, the partner and the frame in which the ego
    receives the data. It does not depend on the order of calls, other agents or other effects.

    Attributes:
        latency: Delay of partners' data, seconds, a multiple of 0.1 (the paper: 0.1 to 0.5). The
            ego receives the data of an earlier frame, placed with the partner's pose at that time.
            So stationary actors are correct, and moving ones are at their earlier positions.
        pose_noise: Mean position error of partners' poses, metres. A number is `PoseNoise(mean=…)`;
            None for exact poses.
        packet_loss: Probability in [0, 1] that a partner's data do not arrive in a frame.
        seed: Seed of all draws.
        budget: Bytes per frame that all partners together can send to the ego. None means no limit.
            In the order of `cooperating_agents`, each partner sends its message if it still fits.
            Lost messages use no bytes.
        payload: Data that a partner sends, which the budget counts: a kind of data from
            `MessageSize`, or the bytes of every message (for example, features of constant size);
            None without a budget.
    """

    latency: float = 0.0
    pose_noise: PoseNoise | float | None = None
    packet_loss: float = 0.0
    seed: int = 0
    budget: int | None = None
    payload: Payload | int | None = None

    def __post_init__(self) -> None:
        """Check the numbers and convert them to Python's types.

        Raises:
            ConfigError: A number is out of range.
            ChoiceError: The payload is unknown.
        """
        packet_loss = checked_number(
            "packet_loss", self.packet_loss, "a probability from 0 to 1", ConfigError
        )
        if not 0 <= packet_loss <= 1:
            raise ConfigError(
                f"packet_loss: {packet_loss:g} is not a probability; choose a number from 0 to 1"
            )
        checked_values: dict[str, object] = {
            "latency": _check_latency(self.latency),
            "pose_noise": _check_pose_noise(self.pose_noise),
            "packet_loss": packet_loss,
            "seed": checked_whole("seed", self.seed, "a whole number", ConfigError),
        }
        if self.budget is not None:
            budget = checked_count("budget", self.budget, "bytes per frame", _MAX_BYTES)
            checked_values["budget"] = budget
        checked_values["payload"] = _check_payload(self.payload)
        if self.budget is not None and self.payload is None:
            raise ConfigError(
                "budget: needs the kind of data that partners send; give payload='boxes' or "
                f"another of {', '.join(get_args(Payload))}, or the bytes of every message"
            )
        for name, value in checked_values.items():
            object.__setattr__(self, name, value)

    @property
    def latency_frames(self) -> int:
        """The latency in frames of 0.1 s."""
        return round(self.latency / FRAME_PERIOD)

    def frame_sent(self, scenario: str, index: int) -> int:
        """Return the number of the frame whose data arrive in frame `index` of a scenario.

        Raises:
            ConfigError: That frame is before the start of the recording.
        """
        sent_index = index - self.latency_frames
        if sent_index < 1:
            raise ConfigError(
                f"latency: {self.latency} s reaches back from frame {index:03d} to before the "
                f"first frame of {scenario}; the longest possible latency is {(index - 1) / 10} "
                f"s; choose a shorter latency, or frame {self.latency_frames + 1:03d} or a later "
                "one"
            )
        return sent_index

    def loses(self, scenario: str, partner: str, index: int) -> bool:
        """Return whether a partner's data for frame number `index` are lost."""
        if self.packet_loss <= 0:
            return False
        key = self._draw_key(scenario, partner, index)
        loss_draw = uniforms(f"{key}/loss")[0]
        return loss_draw < self.packet_loss

    def pose_error(
        self, scenario: str, partner: str, index: int, position: FloatArray
    ) -> SE3 | None:
        """Return `claimed_from_world`, which maps true positions of partner data to claimed ones.

        Args:
            scenario: Token of the scenario.
            partner: Name of the agent.
            index: Number of the frame in which the ego receives the data.
            position: True position (3,) of the partner in world, metres; the heading error rotates
                about this point.

        Returns:
            None without pose noise.
        """
        if not isinstance(self.pose_noise, PoseNoise):
            return None
        key = self._draw_key(scenario, partner, index)
        x, y, heading = self.pose_noise.draw(key)
        turn = SE3.from_yaw(heading)
        shift = np.array([x, y, 0.0])
        translation = position + shift - turn.rotate(position)
        return SE3.from_rotation(turn.rotation, translation)

    def _draw_key(self, scenario: str, partner: str, index: int) -> str:
        """Return the text that seeds the draws for one partner in one frame."""
        return f"{self.seed}/{scenario}/{partner}/{index}"


def checked_link(link: object) -> Link | None:
    """Check a `link=` argument.

    Raises:
        ConfigError: The argument is neither a Link nor None.
    """
    if link is None or isinstance(link, Link):
        return link
    raise ConfigError(
        f"link: expected a Link, such as Link(latency=0.2, pose_noise=0.3), or None, found {link!r}"
    )


def _check_latency(latency: object) -> float:
    """Return a latency in seconds, rounded to a whole number of frames.

    Raises:
        ConfigError: The latency is out of range, or not a multiple of the frame period.
    """
    seconds = checked_number("latency", latency, "seconds from 0", ConfigError)
    if not 0 <= seconds < math.inf:
        raise ConfigError(
            f"latency: {seconds} is not possible; choose a finite number of seconds from 0"
        )
    if seconds > _MAX_LATENCY_S:
        raise ConfigError(
            f"latency: {seconds:g} s is longer than any scenario; "
            f"if these are milliseconds, give {seconds / 1000:g}"
        )
    num_frames = seconds / FRAME_PERIOD
    if abs(num_frames - round(num_frames)) > _FRAME_TOLERANCE:
        shorter = math.floor(num_frames) / 10
        longer = math.ceil(num_frames) / 10
        raise ConfigError(
            f"latency: {seconds} s is not a multiple of a frame ({FRAME_PERIOD} s); "
            f"the nearest are {shorter} s and {longer} s"
        )
    return round(num_frames) / 10


def _check_pose_noise(noise: object) -> PoseNoise | None:
    """Return a link's pose noise (a number is its mean in metres); raise ConfigError if invalid."""
    if noise is None or isinstance(noise, PoseNoise):
        return noise
    mean = checked_number("pose_noise", noise, "metres or a PoseNoise", ConfigError)
    return PoseNoise(mean=mean)


def _check_payload(payload: Payload | int | None) -> Payload | int | None:
    """Return the payload; raise ConfigError (number of bytes) or ChoiceError (name) if invalid."""
    if payload is None or isinstance(payload, str):
        kind: Payload | None = choice("payload", payload, (None, *get_args(Payload)))
        return kind
    return checked_count("payload", payload, "bytes of every message", _MAX_BYTES)


def uniforms(key: str) -> tuple[float, float, float, float]:
    """Draw four numbers between 0 and 1 (both exclusive), seeded by a text.

    The numbers are the same on every machine and with every version of numpy.
    """
    digest = hashlib.sha256(key.encode()).digest()
    draws = []
    for start in range(0, 32, 8):
        number = int.from_bytes(digest[start : start + 8], "big") >> 12
        draws.append((number + 0.5) / 2**52)
    return draws[0], draws[1], draws[2], draws[3]


@dataclass(frozen=True, slots=True, kw_only=True)
class MessageSize:
    """The uncompressed bytes of one agent's message in one frame, for each kind of data.

    Each number includes a pose (24 bytes).

    Attributes:
        images: Bytes of the six cameras' pixels, 3 bytes each, at the image size in the calib file.
        cloud: Bytes of the LiDAR points, 16 bytes each; None if points were not counted, or the
            file is missing.
        boxes: Bytes of the boxes that the agent annotated, including its own, 45 bytes each.
        bev: Bytes of a BEV feature map of the requested shape and type.
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
    bev_shape: tuple[int, int, int] = _BEV_SHAPE,
    bev_dtype: DTypeLike = np.float32,
    clouds: bool = True,
    link: Link | None = None,
    on_missing: OnError = "raise",
) -> dict[str, MessageSize]:
    """Return the bytes that each agent sends in a sample's frame, for each kind of data.

    Args:
        dataset: The release.
        sample: Token or record of a sample; its agent is the ego, its frame the current one.
        agents: Names of agents, a configuration or its name relative to the ego, or None for all
            available agents.
        bev_shape: Shape of the BEV features: channels, rows, columns.
        bev_dtype: Type of the BEV features.
        clouds: Whether to read the point clouds, to count their points.
        link: Effects of the link on the partners' data; None for a perfect link. With latency,
            sizes come from the earlier frame that arrives; pose noise does not change sizes.
        on_missing: What to do about point clouds that were not downloaded: `raise`, or `skip` their
            sizes (`cloud` is None) and log how many.

    Returns:
        Agent → size of its message. The sample's agent (which sends nothing to itself) comes first
            if it is one of `agents`. A partner is left out if its message is lost or does not fit
            into the budget; to get its size nevertheless, call the function without `link`.

    Raises:
        TokenError: The sample is unknown.
        ChoiceError: An agent, the configuration or `on_missing` is unknown, or `bev_shape` is not a
            shape, or `bev_dtype` is not a type.
        NotAvailableError: An agent is not in this (partial) release.
        ConfigError: `link` is not a Link, or its latency reaches back before the recording.
        MissingFileError: `clouds` is true, `on_missing` is `raise`, and a point cloud was not
            downloaded.
        SensorFileError: `clouds` is true and a point cloud cannot be read.
    """
    bev = POSE_BYTES + _count_bev_bytes(bev_shape, bev_dtype)
    files = MissingFiles(dataset.dataroot, on_missing)
    sizes: dict[str, MessageSize] = {}
    for message in messages(dataset, sample, agents, link):
        sent_sample = message.sample
        has_cloud = False
        if clouds:
            has_cloud = files.has(dataset.sensor_path(f"{sent_sample}/{LIDAR}"), LIDAR)
        images = message_bytes(dataset, sent_sample, "images")
        cloud = None
        if has_cloud:
            cloud = message_bytes(dataset, sent_sample, "cloud")
        boxes = message_bytes(dataset, sent_sample, "boxes")
        sizes[message.agent] = MessageSize(images=images, cloud=cloud, boxes=boxes, bev=bev)
    files.tell()
    return sizes


def message_bytes(dataset: Dataset, sample: str, payload: Payload | int | None) -> int:
    """Return the bytes of the message that a sample's agent sends in the sample's frame.

    `MessageSize` describes the kinds of data; the result is 0 for None. Only `cloud` reads a file.
    `bev` has the default shape and type of `message_sizes`; for other features, pass their bytes.

    Raises:
        TokenError: The sample is unknown.
        MissingFileError: A point cloud was not downloaded.
        SensorFileError: A point cloud cannot be read.
    """
    if not isinstance(payload, str):
        return payload or 0
    if payload == "images":
        num_pixels = 0
        for camera in CAMERAS:
            image = dataset.get("sample_data", f"{sample}/{camera}")
            num_pixels += int(image["width"]) * int(image["height"])
        return POSE_BYTES + 3 * num_pixels
    if payload == "cloud":
        cloud = dataset.load_point_cloud(sample, "lidar")
        return POSE_BYTES + POINT_BYTES * len(cloud)
    row = dataset.getind("sample", sample)
    if payload == "boxes":
        num_boxes = dataset.columns("sample")["num_annotations"].item(row)
        return POSE_BYTES + BOX_BYTES * int(num_boxes)
    return POSE_BYTES + _count_bev_bytes(_BEV_SHAPE, np.float32)


def traffic(
    dataset: Dataset, sample: RowArgument, agents: Agents, link: Link | None, payload: Payload | int
) -> tuple[int, int]:
    """Return how many bytes arrive in a sample's frame, and from how many partners.

    The errors are as in `messages` and `message_bytes`.
    """
    own_sample = dataset.get("sample", sample)["token"]
    exact_link = None
    if link is not None:
        # Pose noise does not affect sizes, and takes time.
        exact_link = replace(link, pose_noise=None)
    sizes = []
    for message in messages(dataset, own_sample, agents, exact_link):
        if message.sample != own_sample:
            sizes.append(message_bytes(dataset, message.sample, payload))
    return sum(sizes), len(sizes)


def traffic_note(
    traffic_by_sample: Sequence[tuple[int, int]],
    link: Link | None,
    payload: Payload | int,
    **more: Any,
) -> NamedValues:
    """Return the results' metadata about the bytes that partners send.

    Args:
        traffic_by_sample: `traffic` of each sample: bytes and number of partners.
        link: The link.
        payload: Data that a partner sends, as in `Link.payload`.
        **more: Further entries of the metadata.
    """
    num_samples = len(traffic_by_sample)
    total_bytes = sum(size for size, _ in traffic_by_sample)
    num_partners = sum(count for _, count in traffic_by_sample)
    return {
        "payload": payload,
        **more,
        "samples": num_samples,
        "mean": total_bytes / max(num_samples, 1),
        "link": total_bytes / max(num_partners, 1),
        "partners": num_partners / max(num_samples, 1),
        "budget": None if link is None else link.budget,
    }


def _count_bev_bytes(shape: Sequence[int], dtype: DTypeLike) -> int:
    """Return the bytes of BEV features; raise ChoiceError if the shape or the type is invalid."""
    expected = "(channels, rows, columns), whole numbers from 1"
    if np.shape(shape) != (3,):
        raise ChoiceError(f"bev_shape: expected {expected}, found {shape!r}")
    lengths = [checked_whole("bev_shape", length, expected, ChoiceError) for length in shape]
    if min(lengths) < 1:
        raise ChoiceError(f"bev_shape: expected {expected}, found {shape!r}")
    try:
        return math.prod(lengths) * np.dtype(dtype).itemsize
    except TypeError as error:
        raise ChoiceError(
            f"bev_dtype: expected a type such as 'float32', found {dtype!r} ({error})"
        ) from error


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Message:
    """One agent's data as the ego receives them.

    Attributes:
        agent: Name of the sender.
        sample: Token of the sample that the data come from; with latency, an earlier one.
        pose_error: Transform `claimed_from_world`; None without pose noise.
    """

    agent: AgentName
    sample: str
    pose_error: SE3 | None

    def target_from(self, dataset: Dataset, frame: str, target_from_world: SE3) -> SE3:
        """Return the transform from the sender's `frame` to the target, as the ego computes it.

        The result includes the pose noise.
        """
        world_from_frame = dataset.world_from(self.sample, frame)
        if self.pose_error is not None:
            world_from_frame = self.pose_error @ world_from_frame
        return target_from_world @ world_from_frame


def messages(
    dataset: Dataset,
    sample: RowArgument,
    agents: Agents = None,
    link: Link | None = None,
    *,
    sweeps: int = 1,
) -> Iterator[Message]:
    """Yield the messages that arrive in a sample's frame and in the `sweeps` − 1 frames before it.

    Messages that are lost or exceed the budget are left out. The order is by frame, the current one
    first and then backwards; within a frame by agent, the sample's own agent first. The errors are
    as in `cooperating_agents`, `Link.frame_sent` and, with a budget, `message_bytes`.
    """
    link = checked_link(link)
    names = cooperating_agents(dataset, sample, agents)
    scenario, ego, number = dataset.get("sample", sample)["token"].rsplit("/", 2)
    present = int(number)
    for index in range(present, max(present - sweeps, 0), -1):
        budget_left = math.inf
        if link is not None and link.budget is not None:
            budget_left = link.budget
        for agent in names:
            if link is None or agent == ego:
                token = sample_token(scenario, agent, index)
                yield Message(agent=agent, sample=token, pose_error=None)
                continue
            if index != present and index <= link.latency_frames:
                continue
            message = _receive_message(dataset, scenario, agent, index, link)
            if message is None:
                continue
            size = 0
            if link.budget is not None:
                size = message_bytes(dataset, message.sample, link.payload)
            if size <= budget_left:
                budget_left -= size
                yield message


def _receive_message(
    dataset: Dataset, scenario: str, agent: AgentName, index: int, link: Link
) -> Message | None:
    """Return the partner's message that the ego receives in frame `index`; None if it is lost."""
    sent_sample = sample_token(scenario, agent, link.frame_sent(scenario, index))
    if link.loses(scenario, agent, index):
        return None
    pose_error = None
    if link.pose_noise is not None:
        position = dataset.world_from(sent_sample, "ego").translation
        pose_error = link.pose_error(scenario, agent, index, position)
    return Message(agent=agent, sample=sent_sample, pose_error=pose_error)
