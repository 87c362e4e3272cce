"""How many bytes the agents have to send."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import DTypeLike

from deepaccident_devkit.arrays import checked_whole
from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.release.missing_files import MissingFiles
from deepaccident_devkit.taxonomy import CAMERAS, LIDAR, OnError
from deepaccident_devkit.v2x.configurations import Agents
from deepaccident_devkit.v2x.link import Link
from deepaccident_devkit.v2x.messages import messages

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
