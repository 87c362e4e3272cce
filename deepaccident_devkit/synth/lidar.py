"""The rotating LiDAR: 32 channels, 30° of height, 70 m."""

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from deepaccident_devkit.arrays import FloatArray, IntArray, readonly
from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.synth.scene import Scene

CHANNELS = 32
ELEVATION = (-20.0, 10.0)
"""Degrees of the lowest and the highest channel."""
AZIMUTHS = 1300
RANGE = 70.0
_ATTENUATION = 0.004
"""Of the intensity, a metre: CARLA's default."""


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """N points of one turn.

    Attributes:
        xyz: (N, 3) float32, metres, in the LiDAR frame: as they are stored.
        intensity: (N,) float32.
        owner: (N,) int64, row of the actor that each lies on; `scene.NOBODY` for the ground and things.
    """

    xyz: NDArray[np.float32]
    intensity: NDArray[np.float32]
    owner: IntArray


def scan(scene: Scene, ground_from_lidar: SE3) -> Scan:
    """What a LiDAR at this pose measures, without noise."""
    directions = ray_directions()
    distance, face = scene.cast(ground_from_lidar.translation, ground_from_lidar.rotate(directions))
    hit = np.flatnonzero(distance <= RANGE)
    reach = distance[hit]
    return Scan(
        (directions[hit] * reach[:, None]).astype(np.float32),
        np.exp(-_ATTENUATION * reach).astype(np.float32),
        scene.owner_of(face[hit]),
    )


@cache
def ray_directions() -> FloatArray:
    """Unit vectors of all rays of a turn in the LiDAR frame, (32 · 1300, 3), channel after channel from the top."""
    elevation = np.deg2rad(np.linspace(ELEVATION[1], ELEVATION[0], CHANNELS))[:, None]
    azimuth = np.linspace(np.pi, -np.pi, AZIMUTHS, endpoint=False)[None, :]
    directions = [
        np.cos(elevation) * np.cos(azimuth),
        np.cos(elevation) * np.sin(azimuth),
        np.broadcast_to(np.sin(elevation), (CHANNELS, AZIMUTHS)),
    ]
    return readonly(np.stack(directions, axis=-1).reshape(-1, 3))
