"""Casting rays against solids and the ground: with Embree if it is installed, if not with numpy."""

import importlib.util
from functools import lru_cache
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from deepaccident_devkit.errors import MissingExtraError
from deepaccident_devkit.plugins.synth.roads import Terrain
from deepaccident_devkit.plugins.synth.solids import FACES, FACES_A_SOLID, face_corners, face_planes
from deepaccident_devkit.support.arrays import AnyArray, BoolArray, FloatArray, IntArray

# Stands for the face if a ray hits nothing.
NOTHING = -1
# Stands for the face if a ray hits the ground.
GROUND = -2
_FAR = 1e30
_CORNERS_A_SOLID = 8
# Corners of a face that make its two triangles.
_HALVES = [[0, 1, 2], [0, 2, 3]]
_PARALLEL = 1e-12
_ROUNDING = 1e-9
_SOLIDS_AT_ONCE = 64
# Steps along a ray over a terrain: their length in metres, their number, and how often the last one is halved.
_MARCH, _MARCHES, _HALVINGS = 0.7, 250, 12


class Caster(Protocol):
    """Surfaces that rays can be cast against."""

    def cast(
        self, origin: FloatArray, directions: AnyArray, reach: AnyArray | None = None
    ) -> tuple[AnyArray, AnyArray]:
        """The first face that each of N rays hits, from an origin (3,), metres, or (N, 3), up to their `reach`.

        Returns (N,) distances in lengths of the direction (of any length, as `reach`), in single precision, infinite
        where nothing is hit; and (N,) the faces, six for each solid in the order of `solids.FACES`, or `GROUND` or
        `NOTHING`.
        """
        ...


def make_caster(corners: FloatArray, terrain: Terrain | None = None) -> Caster:
    """The fastest installed caster, for solids (P, 8, 3), metres, and the ground, if `terrain` is given."""
    return EmbreeCaster(corners, terrain) if has_embree() else NumpyCaster(corners, terrain)


def has_embree() -> bool:
    """Whether the extra `synth` is installed."""
    return importlib.util.find_spec("embreex") is not None


def require_embree() -> None:
    """Raise MissingExtraError if images and point clouds cannot be made."""
    if not has_embree():
        raise MissingExtraError(
            "images and point clouds need the package embreex (in a checkout, pip install '.[synth]'), "
            'or make a release without them (--sensors none; SynthConfig(sensors="none"))'
        )


class EmbreeCaster:
    """Rays cast by Intel's Embree, in single precision."""

    def __init__(self, corners: FloatArray, terrain: Terrain | None = None) -> None:
        from embreex import mesh_construction, rtcore_scene

        vertices, triangles = (
            corners.reshape(-1, 3).astype(np.float32),
            _triangles_of_solids(len(corners)),
        )
        self._faces = len(corners) * FACES_A_SOLID
        self._plane = terrain is not None and terrain.is_flat
        if terrain is not None and not terrain.is_flat:
            ground = terrain.triangles().reshape(-1, 3)
            numbers = np.arange(len(ground)).reshape(-1, 3) + len(vertices)
            vertices, triangles = (
                np.concatenate([vertices, ground]),
                np.concatenate([triangles, _as_tuples(numbers)]),
            )
        self._is_empty = len(triangles) == 0
        self._scene: Any = rtcore_scene.EmbreeScene()
        if not self._is_empty:
            # Embree reads the numbers one by one: with Python's own it takes half the time
            self._mesh: Any = mesh_construction.TriangleMesh(
                self._scene, vertices.astype(object), triangles
            )

    def cast(
        self, origin: FloatArray, directions: AnyArray, reach: AnyArray | None = None
    ) -> tuple[AnyArray, AnyArray]:
        """See `Caster`."""
        rays = np.ascontiguousarray(directions, dtype=np.float32)
        if self._is_empty or not len(rays):
            distance, face = (
                np.full(len(rays), np.inf, np.float32),
                np.full(len(rays), NOTHING, np.int32),
            )
        else:
            starts = np.broadcast_to(origin.astype(np.float32), rays.shape)
            ends = (
                None if reach is None else reach.astype(np.float32)
            )  # a copy, because Embree writes into it
            hits = self._scene.run(starts, rays, ends, query="INTERSECT", output=True)
            face, distance = hits["primID"] >> 1, hits["tfar"]
            distance[face < 0] = np.inf
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


class NumpyCaster:
    """Rays intersected with the planes of the solids near them, in double precision: slow, but without Embree."""

    def __init__(self, corners: FloatArray, terrain: Terrain | None = None) -> None:
        normals, offsets = face_planes(face_corners(corners))
        self._normals = normals.reshape(-1, FACES_A_SOLID, 3)
        self._offsets = offsets.reshape(-1, FACES_A_SOLID)
        self._middle = corners.mean(axis=1)
        self._radius = np.linalg.norm(corners - self._middle[:, None], axis=2).max(
            axis=1, initial=0.0
        )
        self._terrain = terrain

    def cast(
        self, origin: FloatArray, directions: AnyArray, reach: AnyArray | None = None
    ) -> tuple[AnyArray, AnyArray]:
        """See `Caster`."""
        rays = np.asarray(directions, dtype=np.float64)
        distance, face = (
            self._cast_in_turn(origin, rays) if origin.ndim == 2 else self._cast_from(origin, rays)
        )
        if reach is not None:
            beyond = distance > reach
            distance[beyond], face[beyond] = np.inf, NOTHING
        return distance, face

    def _cast_from(self, origin: FloatArray, rays: FloatArray) -> tuple[FloatArray, IntArray]:
        """Rays (N, 3) from one point."""
        units = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        distance = np.full(len(rays), np.inf)
        face = np.full(len(rays), NOTHING)
        if self._terrain is not None:
            distance = ground_distance(self._terrain, origin, rays)
            face[np.isfinite(distance)] = GROUND
        for first in range(0, len(self._radius), _SOLIDS_AT_ONCE):
            solids = np.arange(first, min(first + _SOLIDS_AT_ONCE, len(self._radius)))
            for solid, is_near in zip(
                solids.tolist(), self._near(solids, origin, units), strict=True
            ):
                near = np.flatnonzero(is_near)
                entry, entered = self._entry(solid, origin, rays[near])
                closer = entry < distance[near]
                distance[near[closer]] = entry[closer]
                face[near[closer]] = FACES_A_SOLID * solid + entered[closer]
        return distance, face

    def _cast_in_turn(self, origins: FloatArray, rays: FloatArray) -> tuple[AnyArray, AnyArray]:
        """Rays (N, 3) from points (N, 3), many of which are equal."""
        distance, face = np.full(len(rays), np.inf), np.full(len(rays), NOTHING)
        places, place = np.unique(origins, axis=0, return_inverse=True)
        for number, origin in enumerate(places):
            rows = np.flatnonzero(place.reshape(-1) == number)
            distance[rows], face[rows] = self._cast_from(origin, rays[rows])
        return distance, face

    def _near(self, solids: IntArray, origin: FloatArray, units: FloatArray) -> BoolArray:
        """Whether each ray (N,) passes near the bounding sphere of each solid (S,): (S, N)."""
        towards = self._middle[solids] - origin
        radius = self._radius[solids] * (1 + _ROUNDING)
        along = towards @ units.T
        least = np.sqrt(np.maximum((towards**2).sum(axis=1) - radius**2, 0.0))
        # all rays meet a sphere around the origin; another one, only those that are ahead by its tangent's length
        around = (towards**2).sum(axis=1) <= radius**2
        return np.asarray((along >= least[:, None]) | around[:, None])

    def _entry(
        self, solid: int, origin: FloatArray, rays: FloatArray
    ) -> tuple[FloatArray, IntArray]:
        """Where rays enter a solid (infinite if they do not), and the face through which they enter."""
        towards = rays @ self._normals[solid].T
        height = self._offsets[solid] - self._normals[solid] @ origin
        with np.errstate(divide="ignore", invalid="ignore"):
            cut = height / towards
        entering = np.where(towards < -_PARALLEL, cut, -_FAR)
        leaving = np.where(towards > _PARALLEL, cut, _FAR)
        outside = (np.abs(towards) <= _PARALLEL) & (height < 0)
        entry, entered = entering.max(axis=1), entering.argmax(axis=1)
        hit = (entry <= leaving.min(axis=1)) & (entry > 0) & ~outside.any(axis=1)
        return np.where(hit, entry, np.inf), entered


def ground_distance(terrain: Terrain, origin: FloatArray, rays: FloatArray) -> FloatArray:
    """Where rays (N, 3) from a point above the ground meet it, in lengths of the ray; infinite if they do not."""
    if terrain.is_flat:
        return plane_distance(origin[2], rays[:, 2])
    step = _MARCH / np.linalg.norm(rays, axis=1)
    before, after = np.zeros(len(rays)), np.full(len(rays), np.inf)
    under_way = np.arange(len(rays))
    for number in range(1, _MARCHES + 1):
        reached = number * step[under_way]
        below = _height_above(terrain, origin, rays[under_way], reached) <= 0
        after[under_way[below]] = reached[below]
        under_way = under_way[~below]
        before[under_way] = reached[~below]
    met = np.flatnonzero(np.isfinite(after))
    low, high = before[met], after[met]
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        below = _height_above(terrain, origin, rays[met], middle) <= 0
        low, high = np.where(below, low, middle), np.where(below, middle, high)
    after[met] = (low + high) / 2
    return after


def plane_distance(height: float | FloatArray, upwards: NDArray[Any]) -> NDArray[Any]:
    """The distance from a height to z = 0 along rays with z components `upwards` (N,); infinite if they do not fall."""
    falling = upwards < 0
    return np.where(falling, height / -np.where(falling, upwards, -1.0), np.inf)


def _height_above(
    terrain: Terrain, origin: FloatArray, rays: FloatArray, reached: FloatArray
) -> FloatArray:
    points = origin + rays * reached[:, None]
    return np.asarray(points[:, 2] - terrain.height(points[:, :2]))
