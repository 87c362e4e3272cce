"""Messages between agents: their sizes, and the wrong poses, delay and loss of a real link."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import Any, Final, Literal, get_args

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
from deepaccident_devkit.tables.tokens import sample_token
from deepaccident_devkit.taxonomy import CAMERAS, FRAME_PERIOD, LIDAR, AgentName, OnError
from deepaccident_devkit.v2x.agents import Agents, cooperating_agents

POINT_BYTES: Final = 4 * 4
"""Bytes of x, y, z and intensity in single precision."""
BOX_BYTES: Final = 9 * 4 + 4 + 1 + 4
"""Bytes of centre, size, yaw and horizontal velocity in single precision, an id, a class and a
score."""
POSE_BYTES: Final = 6 * 4
"""Bytes of a 6-vector in single precision, which goes with every message."""
_BEV_SHAPE: Final = (64, 200, 200)
Payload = Literal["images", "cloud", "boxes", "bev"]
"""The kinds of data that a message can have; `MessageSize` describes them."""
_NORMAL_DISTRIBUTION: Final = NormalDist()
_MAX_BYTES: Final = 2**50
# No scenario is longer, so a longer latency must be in milliseconds.
_MAX_LATENCY_S: Final = 20.0
# Largest difference between a latency and a whole number of frames, in frames.
_FRAME_TOLERANCE: Final = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseNoise:
    """The error of a partner's own pose: one draw for each partner and frame.

    The error of the position is a distance from a normal distribution of `mean` and `std`. The
    paper studies means of 0.1 to 0.5 m with σ = 0.02 m and does not name the direction; here it is
    horizontal and uniform over all directions.

    Attributes:
        mean: Mean of the distance, metres.
        std: Standard deviation of the distance, metres.
        heading_std: Standard deviation of the heading about the vertical, radians; its mean is 0.
    """

    mean: float = 0.0
    std: float = 0.02
    heading_std: float = 0.0

    def __post_init__(self) -> None:
        """Check the numbers; raises ConfigError."""
        for name in ("mean", "std", "heading_std"):
            value = checked_number(
                f"pose noise: {name}", getattr(self, name), "a number from 0", ConfigError
            )
            if not 0 <= value < math.inf:
                raise ConfigError(
                    f"pose noise: {name} is {value:g}; choose a finite number of at least 0"
                )
            object.__setattr__(self, name, value)
        if self.heading_std > math.pi:
            radians = math.radians(self.heading_std)
            raise ConfigError(
                f"pose noise: heading_std is {self.heading_std:g} radians, over half a turn; "
                f"if these are degrees, give {radians:.4g}"
            )

    def draw(self, key: str) -> tuple[float, float, float]:
        """Draw the error of one partner at one frame.

        Args:
            key: Text that decides the draw.

        Returns:
            Errors of x and y in world, metres, and of the heading, radians.
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
    """The effects of a link on partners' data; the ego's own data are never changed.

    Every draw depends only on the seed, the scenario, the partner and the frame at which the ego
    receives: not on the order of calls, on other agents or on the other effects.

    Attributes:
        latency: Delay of partners' data, seconds, a multiple of 0.1 (the paper: 0.1 to 0.5). The
            data of an earlier frame arrive, placed by the pose at that time: standing actors are
            right, moving ones are at their earlier positions.
        pose_noise: Mean position error of partners' poses, metres. A number is `PoseNoise(mean=…)`;
            None for exact poses.
        packet_loss: Probability in [0, 1] that a partner's data do not arrive at a frame.
        seed: Seed of all draws.
        budget: Bytes a frame that all partners together can send to the ego. None is no limit. In
            the order of `cooperating_agents`, each partner sends if its message still fits; a
            message that is lost on its way takes no bytes.
        payload: Data that a partner sends, for the budget: a kind of `MessageSize`, or the bytes of
            every message, such as of features that all have one size; None without a budget.
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
            ConfigError: A number is out of its range.
            ChoiceError: There is no such payload.
        """
        packet_loss = checked_number(
            "packet_loss", self.packet_loss, "a probability from 0 to 1", ConfigError
        )
        if not 0 <= packet_loss <= 1:
            raise ConfigError(
                f"packet_loss: {packet_loss:g} is no probability; choose a number from 0 to 1"
            )
        checked_values = {
            "latency": _whole_frames(self.latency),
            "pose_noise": _pose_noise(self.pose_noise),
            "packet_loss": packet_loss,
            "seed": checked_whole("seed", self.seed, "a whole number", ConfigError),
            "budget": _checked_budget(self.budget),
            "payload": _checked_payload(self.payload),
        }
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
        """Return the number of the frame from which the data at frame `index` of a scenario come.

        Raises:
            ConfigError: That frame would be before the recording began.
        """
        sent_index = index - self.latency_frames
        if sent_index < 1:
            raise ConfigError(
                f"latency: {self.latency} s reaches back before the first frame of {scenario} "
                f"from frame {index:03d}; the longest possible is {(index - 1) / 10} s; "
                f"choose a shorter latency, or a frame that has {self.latency_frames} others "
                "before it"
            )
        return sent_index

    def loses(self, scenario: str, partner: str, index: int) -> bool:
        """Return whether a partner's data are lost at frame number `index`."""
        if self.packet_loss <= 0:
            return False
        loss_draw = uniforms(f"{self._key(scenario, partner, index)}/loss")[0]
        return loss_draw < self.packet_loss

    def pose_error(
        self, scenario: str, partner: str, index: int, position: FloatArray
    ) -> SE3 | None:
        """Return `claimed_from_world`, from true to claimed positions of a partner's data.

        Args:
            scenario: Token of the scenario.
            partner: Name of the agent.
            index: Number of the frame at which the ego receives.
            position: True position (3,) of the partner, world, metres: the error of the heading
                turns about this point.

        Returns:
            None without pose noise.
        """
        if not isinstance(self.pose_noise, PoseNoise):
            return None
        x, y, heading = self.pose_noise.draw(self._key(scenario, partner, index))
        turn = SE3.from_yaw(heading)
        translation = position + np.array([x, y, 0.0]) - turn.rotate(position)
        return SE3.from_rotation(turn.rotation, translation)

    def _key(self, scenario: str, partner: str, index: int) -> str:
        """Return the text that decides the draws for one partner at one frame."""
        return f"{self.seed}/{scenario}/{partner}/{index}"


def checked_link(link: object) -> Link | None:
    """Check a `link=` argument.

    Raises:
        ConfigError: It is neither a Link nor None.
    """
    if link is None or isinstance(link, Link):
        return link
    raise ConfigError(
        f"link: expected a Link, such as Link(latency=0.2, pose_noise=0.3), or None, found {link!r}"
    )


def _whole_frames(latency: object) -> float:
    """Return a latency in seconds as exactly a whole number of frames; raises ConfigError."""
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
    frames = seconds / FRAME_PERIOD
    if abs(frames - round(frames)) > _FRAME_TOLERANCE:
        shorter = math.floor(frames) / 10
        longer = math.ceil(frames) / 10
        raise ConfigError(
            f"latency: {seconds} s is no multiple of a frame ({FRAME_PERIOD} s); "
            f"the nearest are {shorter} s and {longer} s"
        )
    return round(frames) / 10


def _pose_noise(noise: object) -> PoseNoise | None:
    """Return the pose noise of a link, a number as its mean in metres; raises ConfigError."""
    if noise is None or isinstance(noise, PoseNoise):
        return noise
    mean = checked_number("pose_noise", noise, "metres or a PoseNoise", ConfigError)
    return PoseNoise(mean=mean)


def _checked_budget(budget: int | None) -> int | None:
    """Check the budget of a link, bytes a frame; raises ConfigError."""
    if budget is None:
        return None
    return checked_count("budget", budget, "bytes a frame", _MAX_BYTES)


def _checked_payload(payload: Payload | int | None) -> Payload | int | None:
    """Check the payload of a link; raises ConfigError or ChoiceError."""
    if payload is None or isinstance(payload, str):
        kind: Payload | None = choice("payload", payload, (None, *get_args(Payload)))
        return kind
    return checked_count("payload", payload, "bytes of every message", _MAX_BYTES)


def uniforms(key: str) -> tuple[float, float, float, float]:
    """Draw four numbers between 0 and 1 (both excluded) from a text.

    They are the same on every machine and with every version of numpy.
    """
    digest = hashlib.sha256(key.encode()).digest()
    numbers = [int.from_bytes(digest[start : start + 8], "big") >> 12 for start in range(0, 32, 8)]
    draw_1, draw_2, draw_3, draw_4 = ((number + 0.5) / 2**52 for number in numbers)
    return draw_1, draw_2, draw_3, draw_4


@dataclass(frozen=True, slots=True, kw_only=True)
class MessageSize:
    """The bytes of one agent's message at one moment, uncompressed, for each kind of data.

    Each number includes a pose (24 bytes).

    Attributes:
        images: Bytes of the six cameras' pixels, 3 bytes each, in the size that calib gives.
        cloud: Bytes of the LiDAR's points, 16 bytes each; None if points were not counted, or the
            file is missing.
        boxes: Bytes of the boxes that the agent annotated, its own included, 45 bytes each.
        bev: Bytes of a BEV feature map of the given shape and type.
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
    """Return the bytes that each agent sends for a sample's moment, for each kind of data.

    Args:
        dataset: The release.
        sample: Token or record of a sample; its frame is the moment.
        agents: Names of agents, a configuration or its name relative to the ego, or None for all
            available agents.
        bev_shape: Shape of the BEV features: channels, rows, columns.
        bev_dtype: Type of the BEV features.
        clouds: Whether to read the point clouds, to count their points.
        link: Effects of the link on the partners' data; None for a perfect link. With latency,
            sizes are of the earlier frame that arrives; pose noise does not change the size
            of a message.
        on_missing: Treatment of point clouds that were not downloaded: `raise`, or `skip`, which
            leaves their size out (`cloud` is None) and logs how many.

    Returns:
        Sizes of the arriving messages by agent. The sample's own agent (which sends nothing to
        itself) is first, if it is among them. A partner is left out if its message is lost or does
        not fit into the budget; a call without `link` returns the size of that message.

    Raises:
        TokenError: There is no such sample.
        ChoiceError: There is no such agent, configuration or `on_missing`, or `bev_shape` is no
            shape or `bev_dtype` no type.
        NotAvailableError: An agent is not in this (partial) release.
        ConfigError: `link` is no Link, or its latency is longer than the scenario's past.
        MissingFileError: `clouds` is true, `on_missing` is `raise`, and a point cloud was not
            downloaded.
        SensorFileError: `clouds` is true and a point cloud cannot be read.
    """
    bev = POSE_BYTES + _bev_bytes(bev_shape, bev_dtype)
    files = MissingFiles(dataset.dataroot, on_missing)
    sizes: dict[str, MessageSize] = {}
    for message in messages(dataset, sample, agents, link):
        sender = message.sample
        readable = clouds and files.has(dataset.sensor_path(f"{sender}/{LIDAR}"), LIDAR)
        sizes[message.agent] = MessageSize(
            images=message_bytes(dataset, sender, "images"),
            cloud=message_bytes(dataset, sender, "cloud") if readable else None,
            boxes=message_bytes(dataset, sender, "boxes"),
            bev=bev,
        )
    files.tell()
    return sizes


def message_bytes(dataset: Dataset, sample: str, payload: Payload | int | None) -> int:
    """Return the bytes of the message that a sample's own agent sends at its frame.

    The sizes are described in `MessageSize`; the size is 0 for None. Only for `cloud` a file is
    read. `bev` has the default shape and type of `message_sizes`; for other features give their
    bytes.

    Raises:
        TokenError: There is no such sample.
        MissingFileError: A point cloud was not downloaded.
        SensorFileError: A point cloud cannot be read.
    """
    if not isinstance(payload, str):
        return payload or 0
    if payload == "images":
        images = [dataset.get("sample_data", f"{sample}/{camera}") for camera in CAMERAS]
        pixel_bytes = [3 * int(image["width"]) * int(image["height"]) for image in images]
        return POSE_BYTES + sum(pixel_bytes)
    if payload == "cloud":
        return POSE_BYTES + POINT_BYTES * len(dataset.load_point_cloud(sample, "lidar"))
    boxes = dataset.columns("sample")["num_annotations"].item(dataset.getind("sample", sample))
    if payload == "boxes":
        return POSE_BYTES + BOX_BYTES * int(boxes)
    return POSE_BYTES + _bev_bytes(_BEV_SHAPE, np.float32)


def traffic(
    dataset: Dataset, sample: RowArgument, agents: Agents, link: Link | None, payload: Payload | int
) -> tuple[int, int]:
    """Return the bytes that arrive from all partners at a sample's frame, and their number.

    It raises the errors of `messages` and `message_bytes`.
    """
    own_sample = dataset.get("sample", sample)["token"]
    exact_link = None
    if link is not None:
        # Pose noise changes no size, and takes time.
        exact_link = replace(link, pose_noise=None)
    sizes = [
        message_bytes(dataset, message.sample, payload)
        for message in messages(dataset, own_sample, agents, exact_link)
        if message.sample != own_sample
    ]
    return sum(sizes), len(sizes)


def traffic_note(
    traffic_by_sample: Sequence[tuple[int, int]],
    link: Link | None,
    payload: Payload | int,
    **more: Any,
) -> dict[str, Any]:
    """Return the note about the bytes that partners send, for results.

    Args:
        traffic_by_sample: The `traffic` of each sample: bytes and number of partners.
        link: The link.
        payload: Data that a partner sends, as in `Link.payload`.
        **more: Further entries of the note.
    """
    samples = len(traffic_by_sample)
    total = sum(size for size, _ in traffic_by_sample)
    partners = sum(count for _, count in traffic_by_sample)
    return {
        "payload": payload,
        **more,
        "samples": samples,
        "mean": total / max(samples, 1),
        "link": total / max(partners, 1),
        "partners": partners / max(samples, 1),
        "budget": None if link is None else link.budget,
    }


def _bev_bytes(shape: Sequence[int], dtype: DTypeLike) -> int:
    """Return the bytes of BEV features; raises ChoiceError."""
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
    """The data of one agent as the ego receives them.

    Attributes:
        agent: Name of the sender.
        sample: Token of the sample of the data: with latency an earlier one.
        pose_error: Transform `claimed_from_world`; None without pose noise.
    """

    agent: AgentName
    sample: str
    pose_error: SE3 | None

    def target_from(self, dataset: Dataset, frame: str, target_from_world: SE3) -> SE3:
        """Return `target_from_frame` for the sender's `frame`, as the ego computes it.

        The pose noise is included.
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
    """Yield the messages that arrive at a sample and at the `sweeps` − 1 frames before it.

    Nothing is yielded for a lost message or, with a budget, for a message that does not fit.

    Messages are ordered by frame, the present first and then backwards, and for each frame by
    agent, the sample's own first. Raises the errors of `cooperating_agents`, ConfigError of the
    link, and with a budget the errors of `message_bytes`.
    """
    link = checked_link(link)
    names = cooperating_agents(dataset, sample, agents)
    scenario, ego, number = dataset.get("sample", sample)["token"].rsplit("/", 2)
    present = int(number)
    for index in range(present, max(present - sweeps, 0), -1):
        budget_left = math.inf if link is None or link.budget is None else link.budget
        for agent in names:
            if link is None or agent == ego:
                token = sample_token(scenario, agent, index)
                yield Message(agent=agent, sample=token, pose_error=None)
                continue
            if index != present and index <= link.latency_frames:
                continue
            message = _received(dataset, scenario, agent, index, link)
            if message is None:
                continue
            size = 0
            if link.budget is not None:
                size = message_bytes(dataset, message.sample, link.payload)
            if size <= budget_left:
                budget_left -= size
                yield message


def _received(
    dataset: Dataset, scenario: str, agent: AgentName, index: int, link: Link
) -> Message | None:
    """Return a partner's message that the ego receives at frame `index`; None if it is lost."""
    sent_sample = sample_token(scenario, agent, link.frame_sent(scenario, index))
    if link.loses(scenario, agent, index):
        return None
    pose_error = None
    if link.pose_noise is not None:
        position = dataset.world_from(sent_sample, "ego").translation
        pose_error = link.pose_error(scenario, agent, index, position)
    return Message(agent=agent, sample=sent_sample, pose_error=pose_error)
