"""Casting rays against solids and the ground, with Embree if it is installed, otherwise numpy."""

import importlib.util
from functools import lru_cache
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from deepaccident_devkit.errors import MissingExtraError
from deepaccident_devkit.plugins.synth.roads import Terrain
from deepaccident_devkit.plugins.synth.solids import FACES, FACES_A_SOLID, face_corners, face_planes
from deepaccident_devkit.support.arrays import AnyArray, BoolArray, FloatArray, IntArray

NO_HIT = -1
"""The face of a ray that hits nothing."""
GROUND = -2
"""The face of a ray that hits the ground."""
# A number that is larger than any distance, in lengths of a ray.
_MAX_DISTANCE = 1e30
_CORNERS_A_SOLID = 8
# Corners of a face that make its two triangles.
_TRIANGLES_OF_FACE = [[0, 1, 2], [0, 2, 3]]
_PARALLEL_TOLERANCE = 1e-12
_ROUNDING = 1e-9
_SOLIDS_A_BLOCK = 64
# Steps along a ray over a terrain: their length, their number, and how often the last is halved.
_MARCH_STEP_M = 0.7
_NUM_MARCH_STEPS = 250
_NUM_HALVINGS = 12


class Caster(Protocol):
    """Surfaces that rays can be cast against."""

    def cast(
        self, origin: FloatArray, directions: AnyArray, reach: AnyArray | None = None
    ) -> tuple[AnyArray, AnyArray]:
        """Find the first face that each of N rays hits.

        Args:
            origin: Origin of the rays, shape (3,) or (N, 3), metres.
            directions: Directions of any length, shape (N, 3).
            reach: Largest distances, shape (N,), in lengths of the direction; None for no limit.

        Returns:
            Distances (N,) in lengths of the direction, in single precision, infinite where nothing
            is hit; and the faces (N,), six for each solid in the order of `solids.FACES`, or
            `GROUND` or `NO_HIT`.
        """
        ...


def make_caster(corners: FloatArray, terrain: Terrain | None = None) -> Caster:
    """Make the fastest installed caster.

    Args:
        corners: Corners of the solids, shape (P, 8, 3), metres.
        terrain: Shape of the ground; None for rays that do not hit the ground.
    """
    if has_embree():
        return EmbreeCaster(corners, terrain)
    return NumpyCaster(corners, terrain)


def has_embree() -> bool:
    """Return whether the package embreex, of the extra `synth`, is installed."""
    return importlib.util.find_spec("embreex") is not None


def require_embree() -> None:
    """Raise MissingExtraError if images and point clouds cannot be made."""
    if not has_embree():
        raise MissingExtraError(
            "images and point clouds need the package embreex; run pip install '.[synth]' in a "
            'checkout, or make a release without them (--sensors none; SynthConfig(sensors="none"))'
        )


class EmbreeCaster:
    """A caster of rays that uses Intel's Embree, in single precision."""

    def __init__(self, corners: FloatArray, terrain: Terrain | None = None) -> None:
        from embreex import mesh_construction, rtcore_scene

        vertices = corners.reshape(-1, 3).astype(np.float32)
        triangles = _list_triangles(len(corners))
        self._num_faces = len(corners) * FACES_A_SOLID
        self._has_plane = terrain is not None and terrain.is_flat
        if terrain is not None and not terrain.is_flat:
            ground_vertices = terrain.triangles().reshape(-1, 3)
            rows = np.arange(len(ground_vertices)).reshape(-1, 3) + len(vertices)
            vertices = np.concatenate([vertices, ground_vertices])
            triangles = np.concatenate([triangles, _to_tuples(rows)])
        self._is_empty = len(triangles) == 0
        self._scene: Any = rtcore_scene.EmbreeScene()
        if not self._is_empty:
            # Embree reads the numbers one by one: with Python's own it takes half the time.
            self._mesh: Any = mesh_construction.TriangleMesh(
                self._scene, vertices.astype(object), triangles
            )

    def cast(
        self, origin: FloatArray, directions: AnyArray, reach: AnyArray | None = None
    ) -> tuple[AnyArray, AnyArray]:
        """Find the first face that each ray hits, as described for `Caster`."""
        rays = np.ascontiguousarray(directions, dtype=np.float32)
        if self._is_empty or not len(rays):
            distance = np.full(len(rays), np.inf, np.float32)
            face = np.full(len(rays), NO_HIT, np.int32)
        else:
            starts = np.broadcast_to(origin.astype(np.float32), rays.shape)
            limits = None
            if reach is not None:
                limits = reach.astype(np.float32)  # a copy, because Embree writes into it
            hits = self._scene.run(starts, rays, limits, query="INTERSECT", output=True)
            face = hits["primID"] >> 1
            distance = hits["tfar"]
            distance[face < 0] = np.inf
            face[face >= self._num_faces] = GROUND
        if self._has_plane:
            to_ground = plane_distance(origin[..., 2], rays[:, 2])
            limit = distance if reach is None else np.minimum(distance, reach)
            hits_ground = to_ground < limit
            distance[hits_ground] = to_ground[hits_ground]
            face[hits_ground] = GROUND
        return distance, face


@lru_cache(maxsize=4)
def _list_triangles(count: int) -> NDArray[np.object_]:
    """Return the rows of each triangle's three corners: two triangles for each face of the solids.

    Returns:
        Tuples (count · 12,), in the order of `solids.FACES`.
    """
    first_rows = np.arange(count)[:, None, None, None] * _CORNERS_A_SOLID
    rows = first_rows + FACES[:, _TRIANGLES_OF_FACE]
    return _to_tuples(rows.reshape(-1, 3))


def _to_tuples(rows: IntArray) -> NDArray[np.object_]:
    """Convert the rows of an array into tuples."""
    tuples = np.empty(len(rows), dtype=object)
    tuples[:] = list(map(tuple, rows.tolist()))
    return tuples


class NumpyCaster:
    """A caster of rays that intersects them with the planes of solids, in double precision.

    It is slow, but needs no Embree.
    """

    def __init__(self, corners: FloatArray, terrain: Terrain | None = None) -> None:
        normals, offsets = face_planes(face_corners(corners))
        self._normals = normals.reshape(-1, FACES_A_SOLID, 3)
        self._offsets = offsets.reshape(-1, FACES_A_SOLID)
        self._middle = corners.mean(axis=1)
        to_corners = corners - self._middle[:, None]
        distances = np.linalg.norm(to_corners, axis=2)
        self._radius = distances.max(axis=1, initial=0.0)
        self._terrain = terrain

    def cast(
        self, origin: FloatArray, directions: AnyArray, reach: AnyArray | None = None
    ) -> tuple[AnyArray, AnyArray]:
        """Find the first face that each ray hits, as described for `Caster`."""
        rays = np.asarray(directions, dtype=np.float64)
        if origin.ndim == 2:
            distance, face = self._cast_from_each(origin, rays)
        else:
            distance, face = self._cast_from(origin, rays)
        if reach is not None:
            is_beyond = distance > reach
            distance[is_beyond] = np.inf
            face[is_beyond] = NO_HIT
        return distance, face

    def _cast_from(self, origin: FloatArray, rays: FloatArray) -> tuple[FloatArray, IntArray]:
        """Cast rays (N, 3) from one point."""
        directions = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        distance = np.full(len(rays), np.inf)
        face = np.full(len(rays), NO_HIT)
        if self._terrain is not None:
            distance = ground_distance(self._terrain, origin, rays)
            face[np.isfinite(distance)] = GROUND
        num_solids = len(self._radius)
        for start in range(0, num_solids, _SOLIDS_A_BLOCK):
            end = min(start + _SOLIDS_A_BLOCK, num_solids)
            solids = np.arange(start, end)
            masks = self._mark_near(solids, origin, directions)
            for solid, mask in zip(solids.tolist(), masks, strict=True):
                rows = np.flatnonzero(mask)
                entry, entry_face = self._find_entry(solid, origin, rays[rows])
                is_closer = entry < distance[rows]
                closer_rows = rows[is_closer]
                distance[closer_rows] = entry[is_closer]
                face[closer_rows] = FACES_A_SOLID * solid + entry_face[is_closer]
        return distance, face

    def _cast_from_each(self, origins: FloatArray, rays: FloatArray) -> tuple[AnyArray, AnyArray]:
        """Cast rays (N, 3) from points (N, 3); many points are equal."""
        distance = np.full(len(rays), np.inf)
        face = np.full(len(rays), NO_HIT)
        distinct_origins, numbers = np.unique(origins, axis=0, return_inverse=True)
        for number, origin in enumerate(distinct_origins):
            rows = np.flatnonzero(numbers.reshape(-1) == number)
            distance[rows], face[rows] = self._cast_from(origin, rays[rows])
        return distance, face

    def _mark_near(self, solids: IntArray, origin: FloatArray, directions: FloatArray) -> BoolArray:
        """Mark the rays that pass near the bounding sphere of each solid.

        Args:
            solids: Numbers of the solids, shape (S,).
            origin: Origin of the rays, shape (3,), metres.
            directions: Unit vectors of the rays, shape (N, 3).

        Returns:
            Whether each ray passes near each solid, shape (S, N), bool.
        """
        to_middle = self._middle[solids] - origin
        radius = self._radius[solids] * (1 + _ROUNDING)
        along = to_middle @ directions.T
        square_distance = (to_middle**2).sum(axis=1)
        square_tangent = square_distance - radius**2
        tangent_length = np.sqrt(np.maximum(square_tangent, 0.0))
        # All rays meet a sphere around the origin; another one is met only by rays that have it
        # ahead by the length of its tangent.
        encloses_origin = square_distance <= radius**2
        is_ahead = along >= tangent_length[:, None]
        return np.asarray(is_ahead | encloses_origin[:, None])

    def _find_entry(
        self, solid: int, origin: FloatArray, rays: FloatArray
    ) -> tuple[FloatArray, IntArray]:
        """Find where rays enter a solid.

        Args:
            solid: Number of the solid.
            origin: Origin of the rays, shape (3,), metres.
            rays: Directions, shape (N, 3).

        Returns:
            Distances (infinite for rays that do not enter it), and the faces through which they
            enter, shape (N,) each.
        """
        normals = self._normals[solid]
        outward_speed = rays @ normals.T
        height = self._offsets[solid] - normals @ origin
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = height / outward_speed
        entering = np.where(outward_speed < -_PARALLEL_TOLERANCE, distance, -_MAX_DISTANCE)
        leaving = np.where(outward_speed > _PARALLEL_TOLERANCE, distance, _MAX_DISTANCE)
        is_parallel = np.abs(outward_speed) <= _PARALLEL_TOLERANCE
        passes_by = (is_parallel & (height < 0)).any(axis=1)
        entry = entering.max(axis=1)
        entry_face = entering.argmax(axis=1)
        enters = (entry <= leaving.min(axis=1)) & (entry > 0) & ~passes_by
        return np.where(enters, entry, np.inf), entry_face


def ground_distance(terrain: Terrain, origin: FloatArray, rays: FloatArray) -> FloatArray:
    """Return the distances (N,) from a point above the ground to the ground along rays (N, 3).

    They are in lengths of the ray, and infinite if a ray does not meet the ground.
    """
    if terrain.is_flat:
        return plane_distance(origin[2], rays[:, 2])
    step = _MARCH_STEP_M / np.linalg.norm(rays, axis=1)
    before = np.zeros(len(rays))
    after = np.full(len(rays), np.inf)
    under_way = np.arange(len(rays))
    for number in range(1, _NUM_MARCH_STEPS + 1):
        reached = number * step[under_way]
        is_below = _is_below_ground(terrain, origin, rays[under_way], reached)
        after[under_way[is_below]] = reached[is_below]
        under_way = under_way[~is_below]
        before[under_way] = reached[~is_below]
    rows = np.flatnonzero(np.isfinite(after))
    low = before[rows]
    high = after[rows]
    for _ in range(_NUM_HALVINGS):
        middle = (low + high) / 2
        is_below = _is_below_ground(terrain, origin, rays[rows], middle)
        low = np.where(is_below, low, middle)
        high = np.where(is_below, middle, high)
    after[rows] = (low + high) / 2
    return after


def plane_distance(height: float | FloatArray, upwards: NDArray[Any]) -> NDArray[Any]:
    """Return the distance from a height to z = 0 along rays.

    Args:
        height: Height of the origin, metres.
        upwards: Components z of the rays, shape (N,).

    Returns:
        Distances (N,) in lengths of the ray; infinite if they do not fall.
    """
    falling = upwards < 0
    descent = -np.where(falling, upwards, -1.0)
    return np.where(falling, height / descent, np.inf)


def _is_below_ground(
    terrain: Terrain, origin: FloatArray, rays: FloatArray, distance: FloatArray
) -> BoolArray:
    """Return which points on rays (N, 3), at distances (N,), are on or below the ground."""
    points = origin + rays * distance[:, None]
    ground_height = terrain.height(points[:, :2])
    height_above = points[:, 2] - ground_height
    return np.asarray(height_above <= 0)
