"""Casting rays against solids and the ground."""

import importlib.util
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepaccident_devkit.arrays import AnyArray, FloatArray, IntArray
from deepaccident_devkit.errors import MissingExtraError
from deepaccident_devkit.synth.roads import Terrain
from deepaccident_devkit.synth.solids import FACES, FACES_A_SOLID

NOTHING = -1
"""Stands for the face if a ray hits nothing."""
GROUND = -2
"""Stands for the face if a ray hits the ground."""
_CORNERS_A_SOLID = 8
_HALVES = [[0, 1, 2], [0, 2, 3]]
"""Corners of a face that make its two triangles."""


def require_embree() -> None:
    """Raise MissingExtraError if nothing can cast rays."""
    if importlib.util.find_spec("embreex") is None:
        raise MissingExtraError("the generator needs the package embreex: in a checkout, pip install '.[synth]'")


class Caster:
    """Surfaces that rays can be cast against, by Intel's Embree in single precision.

    Args:
        corners: (P, 8, 3) corners of solids, metres.
        terrain: the ground; None without ground.
    """

    def __init__(self, corners: FloatArray, terrain: Terrain | None = None) -> None:
        from embreex import mesh_construction, rtcore_scene

        vertices, triangles = corners.reshape(-1, 3).astype(np.float32), _triangles_of_solids(len(corners))
        self._faces = len(corners) * FACES_A_SOLID
        self._plane = terrain is not None and terrain.is_flat
        if terrain is not None and not terrain.is_flat:
            ground = terrain.triangles().reshape(-1, 3)
            numbers = np.arange(len(ground)).reshape(-1, 3) + len(vertices)
            vertices, triangles = np.concatenate([vertices, ground]), np.concatenate([triangles, _as_tuples(numbers)])
        self._is_empty = len(triangles) == 0
        self._scene: Any = rtcore_scene.EmbreeScene()
        if not self._is_empty:
            # Embree reads the numbers one by one: with Python's own it takes half the time
            self._mesh: Any = mesh_construction.TriangleMesh(self._scene, vertices.astype(object), triangles)

    def cast(
        self, origin: FloatArray, directions: AnyArray, reach: AnyArray | None = None
    ) -> tuple[AnyArray, AnyArray]:
        """The first face that each of many rays hits.

        Args:
            origin: (3,) metres, or (N, 3), one for each ray.
            directions: (N, 3) of any length.
            reach: (N,) float32: how far each ray is followed, in lengths of its direction; None for no limit.

        Returns:
            (N,) distances in lengths of the direction, in single precision, infinite where nothing is hit; and (N,)
            the faces, six for each solid in the order of `solids.FACES`, or `GROUND` or `NOTHING`.
        """
        rays = np.ascontiguousarray(directions, dtype=np.float32)
        if self._is_empty or not len(rays):
            distance, face = np.full(len(rays), np.inf, np.float32), np.full(len(rays), NOTHING, np.int32)
        else:
            starts = np.empty_like(rays)
            starts[:] = origin
            ends = None if reach is None else reach.astype(np.float32)  # a copy, because Embree writes into it
            hits = self._scene.run(starts, rays, ends, query="INTERSECT", output=True)
            face, distance = hits["primID"] >> 1, hits["tfar"]
            missed = face < 0
            distance[missed] = np.inf
            face[face >= self._faces] = GROUND
        if self._plane:
            below = plane_distance(origin[..., 2], rays[:, 2])
            nearer = below < (distance if reach is None else np.minimum(distance, reach))
            distance[nearer], face[nearer] = below[nearer], GROUND
        return distance, face


@lru_cache(maxsize=4)
def _triangles_of_solids(count: int) -> NDArray[np.object_]:
    """The rows of each triangle's three corners, (count · 12,) tuples: two for each face, as in `solids.FACES`."""
    rows = np.arange(count)[:, None, None, None] * _CORNERS_A_SOLID + FACES[:, _HALVES]
    return _as_tuples(rows.reshape(-1, 3))


def _as_tuples(rows: IntArray) -> NDArray[np.object_]:
    tuples = np.empty(len(rows), dtype=object)
    tuples[:] = list(map(tuple, rows.tolist()))
    return tuples


def plane_distance(height: float | FloatArray, upwards: NDArray[Any]) -> NDArray[Any]:
    """The distance from a height to z = 0 along rays with z components `upwards` (N,); infinite if they do not fall."""
    falling = upwards < 0
    return np.where(falling, height / -np.where(falling, upwards, -1.0), np.inf)
