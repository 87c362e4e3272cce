"""How many bytes each agent would have to send."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import DTypeLike

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.taxonomy import CAMERAS
from deepaccident_devkit.v2x.configurations import Agents, cooperating_agents

POINT_BYTES: Final = 4 * 4
"""x, y, z and intensity in single precision."""
BOX_BYTES: Final = 9 * 4 + 4 + 1 + 4
"""Centre, size, yaw and horizontal velocity in single precision, an id, a class and a score."""
POSE_BYTES: Final = 6 * 4
"""A 6-vector in single precision, which goes with every message."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MessageSize:
    """Bytes of one agent's message at one moment, by what it shares; each with a pose (24 bytes), uncompressed.

    Attributes:
        images: the six cameras' pixels, 3 bytes each, in the size that calib gives.
        cloud: the LiDAR's points, 16 bytes each; None if points were not counted.
        boxes: the boxes it annotated but its own, 45 bytes each, and its own.
        bev: a BEV feature map of the shape and type asked for.
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
) -> dict[str, MessageSize]:
    """Bytes that each agent would send at a sample's moment, by modality; what a link does to them changes nothing.

    Args:
        dataset: the release.
        sample: token or record: its frame is the moment.
        agents: names of agents, a configuration or its name as seen from the ego, or None for all that are there.
        bev_shape: channels, rows, columns of the BEV features.
        bev_dtype: their type.
        clouds: whether to read the point clouds in order to count their points.

    Returns:
        Agent → sizes, the sample's own agent (who sends nothing to itself) first, if it is among them.

    Raises:
        TokenError: no such sample.
        ChoiceError: no such agent or configuration, or `bev_shape` is no shape.
        NotAvailableError: an agent is not in this (partial) release.
        MissingFileError: a point cloud was not downloaded (and is to be counted).
    """
    if np.shape(bev_shape) != (3,) or min(bev_shape) < 1:
        raise ChoiceError(f"bev_shape: expected (channels, rows, columns) from 1, found {bev_shape!r}")
    scenario, _, number = dataset.get("sample", sample)["token"].rsplit("/", 2)
    bev = int(np.prod(bev_shape)) * np.dtype(bev_dtype).itemsize
    sizes: dict[str, MessageSize] = {}
    for agent in cooperating_agents(dataset, sample, agents):
        token = f"{scenario}/{agent}/{number}"
        images = [dataset.get("sample_data", f"{token}/{camera}") for camera in CAMERAS]
        points = len(dataset.load_point_cloud(token, "lidar")) if clouds else None
        sizes[agent] = MessageSize(
            images=POSE_BYTES + sum(3 * image["width"] * image["height"] for image in images),
            cloud=None if points is None else POSE_BYTES + POINT_BYTES * points,
            boxes=POSE_BYTES + BOX_BYTES * len(dataset.boxes(token, "lidar")),
            bev=POSE_BYTES + bev,
        )
    return sizes
