"""Casting rays against solids: Embree where it is installed, numpy otherwise."""

import importlib.util
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from deepaccident_devkit.arrays import AnyArray, BoolArray, FloatArray, IntArray
from deepaccident_devkit.errors import MissingExtraError
from deepaccident_devkit.synth.solids import FACES_A_SOLID, face_corners, face_planes

NOTHING = -1
"""The face that a ray hits which hits none."""
_FAR = 1e30
_PARALLEL = 1e-12
_ROUNDING = 1e-9
_SOLIDS_AT_ONCE = 64


class Caster(Protocol):
    """Solids that rays can be cast against."""

    def cast(self, origin: FloatArray, directions: AnyArray) -> tuple[AnyArray, IntArray]:
        """The first face that each of many rays from one point hits.

        Args:
            origin: (3,) metres.
            directions: (N, 3) of any length.

        Returns:
            (N,) distances in lengths of the direction, infinite where nothing is hit, to single precision; and (N,)
            the faces, six a solid in the order of `solids.FACES`, or `NOTHING`.
        """
        ...


def make_caster(corners: FloatArray) -> Caster:
    """The best caster there is for solids (P, 8, 3), metres."""
    return EmbreeCaster(corners) if has_embree() else NumpyCaster(corners)


def has_embree() -> bool:
    """Whether the extra `synth` is installed."""
    return importlib.util.find_spec("embreex") is not None


def require_embree() -> None:
    """Raise MissingExtraError if images and point clouds cannot be made."""
    if not has_embree():
        raise MissingExtraError(
            "images and point clouds need the package embreex: pip install 'deepaccident_devkit[synth]', "
            "or make a release without them (--no-sensors; SynthConfig(sensors=False))"
        )


class EmbreeCaster:
    """Rays cast by Intel's Embree, in single precision."""

    def __init__(self, corners: FloatArray) -> None:
        from embreex import mesh_construction, rtcore_scene

        quads = face_corners(corners).astype(np.float32)
        triangles = np.ascontiguousarray(quads[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3, 3))
        self._scene: Any = rtcore_scene.EmbreeScene()
        self._mesh: Any = mesh_construction.TriangleMesh(self._scene, triangles)

    def cast(self, origin: FloatArray, directions: AnyArray) -> tuple[AnyArray, IntArray]:
        """See `Caster`."""
        rays = np.ascontiguousarray(directions, dtype=np.float32)
        starts = np.empty_like(rays)
        starts[:] = origin
        hits = self._scene.run(starts, rays, query="INTERSECT", output=True)
        triangle: NDArray[np.int32] = hits["primID"]
        missed = triangle < 0
        distance = hits["tfar"]
        distance[missed] = np.inf
        face = triangle >> 1
        face[missed] = NOTHING
        return distance, face


class NumpyCaster:
    """Rays cut with the planes of the solids near them, in double precision: slow, and needs nothing."""

    def __init__(self, corners: FloatArray) -> None:
        normals, offsets = face_planes(face_corners(corners))
        self._normals = normals.reshape(-1, FACES_A_SOLID, 3)
        self._offsets = offsets.reshape(-1, FACES_A_SOLID)
        self._middle = corners.mean(axis=1)
        self._radius = np.linalg.norm(corners - self._middle[:, None], axis=2).max(axis=1)

    def cast(self, origin: FloatArray, directions: AnyArray) -> tuple[AnyArray, IntArray]:
        """See `Caster`."""
        rays = np.asarray(directions, dtype=np.float64)
        units = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        distance = np.full(len(rays), np.inf)
        face = np.full(len(rays), NOTHING)
        for first in range(0, len(self._radius), _SOLIDS_AT_ONCE):
            solids = np.arange(first, min(first + _SOLIDS_AT_ONCE, len(self._radius)))
            for solid, is_near in zip(solids.tolist(), self._near(solids, origin, units), strict=True):
                near = np.flatnonzero(is_near)
                entry, entered = self._entry(solid, origin, rays[near])
                closer = entry < distance[near]
                distance[near[closer]] = entry[closer]
                face[near[closer]] = FACES_A_SOLID * solid + entered[closer]
        return distance, face

    def _near(self, solids: IntArray, origin: FloatArray, units: FloatArray) -> BoolArray:
        """Which rays (N,) pass through which solids' (S,) bounding spheres: (S, N)."""
        towards = self._middle[solids] - origin
        radius = self._radius[solids] * (1 + _ROUNDING)
        along = towards @ units.T
        least = np.sqrt(np.maximum((towards**2).sum(axis=1) - radius**2, 0.0))
        # a sphere around the origin is met by every ray, any other by those that reach its tangents' length ahead
        around = (towards**2).sum(axis=1) <= radius**2
        return np.asarray((along >= least[:, None]) | around[:, None])

    def _entry(self, solid: int, origin: FloatArray, rays: FloatArray) -> tuple[FloatArray, IntArray]:
        """Where rays enter a solid, infinite where they do not, and by which face."""
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
