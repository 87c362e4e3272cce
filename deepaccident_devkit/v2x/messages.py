"""Messages between agents: how large they are, and what a real link does to them: wrong poses, delay, loss."""

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
"""x, y, z and intensity in single precision."""
BOX_BYTES: Final = 9 * 4 + 4 + 1 + 4
"""Centre, size, yaw and horizontal velocity in single precision, an id, a class and a score."""
POSE_BYTES: Final = 6 * 4
"""A 6-vector in single precision, which goes with every message."""
_BEV_SHAPE: Final = (64, 200, 200)
Payload = Literal["images", "cloud", "boxes", "bev"]
"""The kinds of data that a message can have; `MessageSize` describes them."""
_NORMAL: Final = NormalDist()
# Bytes that can be asked for.
_MOST: Final = 2**50
# Seconds: no scenario is longer, so a longer latency is in milliseconds.
_LONGEST: Final = 20.0
# The largest distance of a latency from a whole number of frames, in frames.
_FRAME_TOLERANCE: Final = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseNoise:
    """The error of a partner's own pose: one draw for each partner and frame.

    The error of the position is a distance from a normal distribution of `mean` and `std`. The paper studies means of
    0.1 to 0.5 m with σ = 0.02 m and does not name the direction; ours is horizontal and uniform over all directions.

    Attributes:
        mean: metres.
        std: standard deviation, metres.
        heading_std: standard deviation of the heading about the vertical, radians; its mean is 0.
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
                f"pose noise: heading_std is {self.heading_std:g} radians, over half a turn; if these are degrees, "
                f"give {radians:.4g}"
            )

    def draw(self, key: str) -> tuple[float, float, float]:
        """The error of one partner at one frame: x and y in world, metres, and heading, radians; `key` decides it."""
        turn, distance, _, heading = uniforms(f"{key}/pose")
        off, direction = self.mean + self.std * _NORMAL.inv_cdf(distance), 2 * math.pi * turn
        return (
            off * math.cos(direction),
            off * math.sin(direction),
            self.heading_std * _NORMAL.inv_cdf(heading),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Link:
    """What happens to the data of partners on their way to the ego; the ego's own data are never changed.

    Every draw depends only on the seed, the scenario, the partner and the frame at which the ego receives: not on the
    order of calls, on other agents or on the other effects.

    Attributes:
        latency: delay of partners' data, seconds, a multiple of 0.1 (the paper: 0.1 to 0.5). They are those of an
            earlier frame, placed by the pose at that time: standing actors are right, moving ones are where they were.
        pose_noise: mean position error of partners' poses, metres. A number is `PoseNoise(mean=…)`; None for exact
            poses.
        packet_loss: probability in [0, 1] that a partner's data do not arrive at a frame.
        seed: seed of all that is drawn.
        budget: bytes a frame that all partners together can send to the ego. None is no limit. Each partner sends whose
            message still fits, in the order of `cooperating_agents`; what is lost on its way takes no bytes.
        payload: what a partner sends, for the budget: a kind of `MessageSize`, or the bytes of every message, such as
            of features that all have one size; None without a budget.
    """

    latency: float = 0.0
    pose_noise: PoseNoise | float | None = None
    packet_loss: float = 0.0
    seed: int = 0
    budget: int | None = None
    payload: Payload | int | None = None

    def __post_init__(self) -> None:
        """Check the numbers and convert them to Python's types; raises ConfigError, or ChoiceError of the payload."""
        loss = checked_number(
            "packet_loss", self.packet_loss, "a probability from 0 to 1", ConfigError
        )
        if not 0 <= loss <= 1:
            raise ConfigError(
                f"packet_loss: {loss:g} is no probability; choose a number from 0 to 1"
            )
        checked = {
            "latency": _whole_frames(self.latency),
            "pose_noise": _noise(self.pose_noise),
            "packet_loss": loss,
            "seed": checked_whole("seed", self.seed, "a whole number", ConfigError),
            "budget": None
            if self.budget is None
            else checked_count("budget", self.budget, "bytes a frame", _MOST),
            "payload": (
                choice("payload", self.payload, (None, *get_args(Payload)))
                if self.payload is None or isinstance(self.payload, str)
                else checked_count("payload", self.payload, "bytes of every message", _MOST)
            ),
        }
        if self.budget is not None and self.payload is None:
            raise ConfigError(
                "budget: needs the kind of data that partners send; give payload='boxes' or another of "
                f"{', '.join(get_args(Payload))}, or the bytes of every message"
            )
        for name, value in checked.items():
            object.__setattr__(self, name, value)

    @property
    def latency_frames(self) -> int:
        """The latency in frames of 0.1 s."""
        return round(self.latency / FRAME_PERIOD)

    def frame_sent(self, scenario: str, index: int) -> int:
        """The number of the frame whose data arrive at frame `index` of a scenario.

        Raises:
            ConfigError: that frame would be before the recording began.
        """
        sent = index - self.latency_frames
        if sent < 1:
            raise ConfigError(
                f"latency: {self.latency} s reaches back before the first frame of {scenario} from frame {index:03d}; "
                f"the longest possible is {(index - 1) / 10} s; choose a shorter latency, or a frame that has "
                f"{self.latency_frames} others before it"
            )
        return sent

    def loses(self, scenario: str, partner: str, index: int) -> bool:
        """Whether a partner's data do not arrive at frame number `index`."""
        return (
            self.packet_loss > 0
            and uniforms(f"{self._key(scenario, partner, index)}/loss")[0] < self.packet_loss
        )

    def pose_error(
        self, scenario: str, partner: str, index: int, position: FloatArray
    ) -> SE3 | None:
        """From true places to those where the ego puts the partner's data: `claimed_from_world`; None without noise.

        Args:
            scenario: token.
            partner: the agent's name.
            index: number of the frame at which the ego receives.
            position: (3,) the partner's true position, world, metres: the error of the heading turns about this point.
        """
        if not isinstance(self.pose_noise, PoseNoise):
            return None
        x, y, heading = self.pose_noise.draw(self._key(scenario, partner, index))
        turn = SE3.from_yaw(heading)
        return SE3.from_rotation(
            turn.rotation, position + np.array([x, y, 0.0]) - turn.rotate(position)
        )

    def _key(self, scenario: str, partner: str, index: int) -> str:
        return f"{self.seed}/{scenario}/{partner}/{index}"


def checked_link(link: object) -> Link | None:
    """The `link=` of a call, checked; raises ConfigError."""
    if link is None or isinstance(link, Link):
        return link
    raise ConfigError(
        f"link: expected a Link, such as Link(latency=0.2, pose_noise=0.3), or None, found {link!r}"
    )


def _whole_frames(latency: object) -> float:
    """The latency in seconds, as exactly a whole number of frames."""
    seconds = checked_number("latency", latency, "seconds from 0", ConfigError)
    if not 0 <= seconds < math.inf:
        raise ConfigError(
            f"latency: {seconds} is not possible; choose a finite number of seconds from 0"
        )
    if seconds > _LONGEST:
        raise ConfigError(
            f"latency: {seconds:g} s is longer than any scenario; if these are milliseconds, give {seconds / 1000:g}"
        )
    frames = seconds / FRAME_PERIOD
    if abs(frames - round(frames)) > _FRAME_TOLERANCE:
        below, above = math.floor(frames) / 10, math.ceil(frames) / 10
        raise ConfigError(
            f"latency: {seconds} s is no multiple of a frame ({FRAME_PERIOD} s); "
            f"the nearest are {below} s and {above} s"
        )
    return round(frames) / 10


def _noise(noise: object) -> PoseNoise | None:
    if noise is None or isinstance(noise, PoseNoise):
        return noise
    return PoseNoise(mean=checked_number("pose_noise", noise, "metres or a PoseNoise", ConfigError))


def uniforms(key: str) -> tuple[float, float, float, float]:
    """Four numbers between 0 and 1 (both excluded) from a text, the same on every machine and with every numpy."""
    digest = hashlib.sha256(key.encode()).digest()
    numbers = [int.from_bytes(digest[start : start + 8], "big") >> 12 for start in range(0, 32, 8)]
    first, second, third, fourth = ((number + 0.5) / 2**52 for number in numbers)
    return first, second, third, fourth


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
    bev_shape: tuple[int, int, int] = _BEV_SHAPE,
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
        them. A partner whose message is lost, or does not fit into the budget, is left out; a call without `link` gives
        the size of that message.

    Raises:
        TokenError: no such sample.
        ChoiceError: no such agent, configuration or `on_missing`, or `bev_shape` is no shape or `bev_dtype` no type.
        NotAvailableError: an agent is not in this (partial) release.
        ConfigError: `link` is no Link, or its latency is longer than the scenario's past.
        MissingFileError: `clouds` is true, `on_missing` is `raise`, and a point cloud was not downloaded.
        SensorFileError: `clouds` is true and a point cloud cannot be read.
    """
    bev = POSE_BYTES + _bev_bytes(bev_shape, bev_dtype)
    files = MissingFiles(dataset.dataroot, on_missing)
    sizes: dict[str, MessageSize] = {}
    for message in messages(dataset, sample, agents, link):
        counted = clouds and files.has(dataset.sensor_path(f"{message.sample}/{LIDAR}"), LIDAR)
        sizes[message.agent] = MessageSize(
            images=message_bytes(dataset, message.sample, "images"),
            cloud=message_bytes(dataset, message.sample, "cloud") if counted else None,
            boxes=message_bytes(dataset, message.sample, "boxes"),
            bev=bev,
        )
    files.tell()
    return sizes


def message_bytes(dataset: Dataset, sample: str, payload: Payload | int | None) -> int:
    """Bytes of the message that a sample's own agent sends at its frame, as `MessageSize` says; 0 for None.

    Only for `cloud` a file is read. `bev` is of the shape and type that `message_sizes` takes without being told; for
    other features give their bytes.

    Raises:
        TokenError: no such sample.
        MissingFileError: a point cloud was not downloaded.
        SensorFileError: a point cloud cannot be read.
    """
    if not isinstance(payload, str):
        return payload or 0
    if payload == "images":
        images = (dataset.get("sample_data", f"{sample}/{camera}") for camera in CAMERAS)
        return POSE_BYTES + sum(3 * int(image["width"]) * int(image["height"]) for image in images)
    if payload == "cloud":
        return POSE_BYTES + POINT_BYTES * len(dataset.load_point_cloud(sample, "lidar"))
    boxes = dataset.columns("sample")["num_annotations"].item(dataset.getind("sample", sample))
    return POSE_BYTES + (
        BOX_BYTES * int(boxes) if payload == "boxes" else _bev_bytes(_BEV_SHAPE, np.float32)
    )


def traffic(
    dataset: Dataset, sample: RowArgument, agents: Agents, link: Link | None, payload: Payload | int
) -> tuple[int, int]:
    """Bytes that arrive from all partners at a sample's frame, and the number of these partners.

    Raises what `messages` and `message_bytes` do.
    """
    own = dataset.get("sample", sample)["token"]
    exact = (
        None if link is None else replace(link, pose_noise=None)
    )  # which changes no size, and takes time
    sent = [
        message_bytes(dataset, message.sample, payload)
        for message in messages(dataset, own, agents, exact)
        if message.sample != own
    ]
    return sum(sent), len(sent)


def traffic_note(
    found: Sequence[tuple[int, int]], link: Link | None, payload: Payload | int, **more: Any
) -> dict[str, Any]:
    """What results note of the bytes that partners send: means of the `traffic` of each sample, and `more`."""
    total, partners = (sum(column) for column in zip(*found, strict=True)) if found else (0, 0)
    return {
        "payload": payload,
        **more,
        "samples": len(found),
        "mean": total / max(len(found), 1),
        "link": total / max(partners, 1),
        "partners": partners / max(len(found), 1),
        "budget": None if link is None else link.budget,
    }


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
        raise ChoiceError(
            f"bev_dtype: expected a type such as 'float32', found {dtype!r} ({error})"
        ) from error


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
    dataset: Dataset,
    sample: RowArgument,
    agents: Agents = None,
    link: Link | None = None,
    *,
    sweeps: int = 1,
) -> Iterator[Message]:
    """What the agents contribute at a sample and at the `sweeps` − 1 frames before it; nothing for a lost message.

    With a budget, partners whose message does not fit contribute nothing either.

    By frame, the present first and then backwards, and for each frame by agent, the sample's own first. Raises what
    `cooperating_agents` does, ConfigError of the link, and with a budget what `message_bytes` does.
    """
    link = checked_link(link)
    names = cooperating_agents(dataset, sample, agents)
    scenario, ego, number = dataset.get("sample", sample)["token"].rsplit("/", 2)
    for index in range(int(number), max(int(number) - sweeps, 0), -1):
        left = math.inf if link is None or link.budget is None else link.budget
        for agent in names:
            if link is None or agent == ego:
                yield Message(
                    agent=agent, sample=sample_token(scenario, agent, index), pose_error=None
                )
            elif index == int(number) or index > link.latency_frames:
                message = _received(dataset, scenario, agent, index, link)
                size = (
                    0
                    if message is None or link.budget is None
                    else message_bytes(dataset, message.sample, link.payload)
                )
                if message is not None and size <= left:
                    left -= size
                    yield message


def _received(
    dataset: Dataset, scenario: str, agent: AgentName, index: int, link: Link
) -> Message | None:
    sent = sample_token(scenario, agent, link.frame_sent(scenario, index))
    if link.loses(scenario, agent, index):
        return None
    error = None
    if link.pose_noise is not None:
        error = link.pose_error(scenario, agent, index, dataset.world_from(sent, "ego").translation)
    return Message(agent=agent, sample=sent, pose_error=error)
