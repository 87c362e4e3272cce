"""What the LiDAR of one agent hits, thinned out so that it fits into a page."""

from __future__ import annotations

import base64
from typing import Any, Final

import numpy as np

from deepaccident_devkit.errors import MissingFileError
from deepaccident_devkit.render.replay.recording import Recording

_CELL: Final = 0.4
"""Metres: of the points in such a square one is kept."""
_MOST: Final = 1500
_LEAST_HEIGHT: Final = 0.3
"""Metres above the ground: the road itself says nothing from above."""
_GROUND: Final = 5.0
"""Percentile of the points' heights that is the ground: the ego frame of the pole is not on it."""


def lidar_points(recording: Recording, agent: str) -> list[str | None] | None:
    """A cloud a frame: int16 x and y in turn, little-endian, in decimetres from the origin, as base64.

    Returns:
        None where files are missing; None as a whole if all are.

    Raises:
        SensorFileError: a file cannot be read.
    """
    clouds = [_cloud(recording, recording.sample(agent, frame)) for frame in recording.frames]
    return clouds if any(cloud is not None for cloud in clouds) else None


def _cloud(recording: Recording, sample: str) -> str | None:
    dataset = recording.dataset
    try:
        cloud = dataset.load_point_cloud(sample, "ego")
    except MissingFileError:
        return None
    height = cloud.xyz[:, 2]
    ground = np.percentile(height, _GROUND) if len(height) else 0.0
    raised = cloud.xyz[height > ground + _LEAST_HEIGHT]
    world = dataset.world_from(sample, "ego").apply(raised)[:, :2] - recording.origin
    cells = np.floor(world / _CELL).astype(np.int64)
    _, first = np.unique(cells, axis=0, return_index=True)
    kept = world[first[:: max(1, -(-len(first) // _MOST))]]
    return _coded(np.clip(np.rint(kept * 10), -(2**15), 2**15 - 1))


def _coded(decimetres: Any) -> str:
    return base64.b64encode(decimetres.astype("<i2").tobytes()).decode("ascii")
