"""One moment of a scenario, ready to be looked at: all surfaces where they are, and a caster over them."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from deepaccident_devkit.arrays import AnyArray, BoolArray, FloatArray, IntArray
from deepaccident_devkit.synth.actors import Actors, Snapshot, place
from deepaccident_devkit.synth.caster import Caster, make_caster
from deepaccident_devkit.synth.solids import BOTTOM, FACES_A_SOLID, face_corners, face_planes
from deepaccident_devkit.synth.world import World

NOBODY = -1
"""Owner of what stands still."""
GROUND = -2
"""The face of the ground, z = 0, which is no solid's."""
_SAMPLE_STEPS = (0.06, 0.5, 0.94)


@dataclass(frozen=True, eq=False)
class Scene:
    """Everything at one moment, in the ground frame.

    Attributes:
        actors: the road users.
        snapshot: where they are.
        owner: (P,) int64, row of the actor that each solid belongs to, or `NOBODY`.
        corners: (P, 8, 3) float64, of all solids, actors' first, metres.
        quads: (F, 4, 3) float64, the corners of all faces, metres.
        normals: (F, 3) float64, outward.
        offsets: (F,) float64, normal · p on the face.
        main: (F,) bool, faces by which one sees their owner.
        caster: for rays against the solids.
    """

    actors: Actors
    snapshot: Snapshot
    owner: IntArray
    corners: FloatArray
    quads: FloatArray
    normals: FloatArray
    offsets: FloatArray
    main: BoolArray
    caster: Caster

    @cached_property
    def samples(self) -> "SurfacePoints":
        """Points all over the actors, by which cameras see them."""
        low = np.array(_SAMPLE_STEPS)
        a, b = (grid.ravel() for grid in np.meshgrid(low, low))
        weights = np.stack([(1 - a) * (1 - b), a * (1 - b), a * b, (1 - a) * b], axis=1)
        faces = np.flatnonzero(self.main)
        points = np.einsum("kc,fcd->fkd", weights, self.quads[faces]).reshape(-1, 3)
        face = np.repeat(faces, len(weights))
        return SurfacePoints(points, self.normals[face], self.owner_of(face))

    def owner_of(self, face: AnyArray) -> IntArray:
        """Row of the actor that faces (N,) belong to; `NOBODY` for the ground, things and no face."""
        owners = self.owner[np.maximum(face, 0) // FACES_A_SOLID]
        return np.where(face >= 0, owners, NOBODY)

    def cast(self, origin: FloatArray, directions: FloatArray) -> tuple[FloatArray, NDArray[np.int32]]:
        """Where rays from one point first meet a surface or the ground, to double precision.

        Args:
            origin: (3,) metres, above the ground.
            directions: (N, 3) float64, of any length.

        Returns:
            (N,) distances in lengths of the direction, infinite where nothing is met; and (N,) the faces met,
            `GROUND` or `caster.NOTHING`.
        """
        _, face = self.caster.cast(origin, directions)
        known = np.flatnonzero(face >= 0)
        plane = self.normals[face[known]]
        distance = np.full(len(directions), np.inf)
        height = self.offsets[face[known]] - plane @ origin
        distance[known] = height / np.einsum("nk,nk->n", plane, directions[known])
        to_ground = ground_distance(origin[2], directions[:, 2])
        grounded = to_ground < distance
        return np.where(grounded, to_ground, distance), np.where(grounded, GROUND, face)


@dataclass(frozen=True, slots=True, eq=False)
class SurfacePoints:
    """Points on actors: position (N, 3) metres, outward normal (N, 3), owner (N,) row of the actor."""

    position: FloatArray
    normal: FloatArray
    owner: IntArray


def make_scene(world: World, actors: Actors, time: float) -> Scene:
    """The scene at a time, seconds since the first recorded frame."""
    snapshot = actors.at(time)
    moved = place(actors.solids.corners, snapshot.poses[actors.solid_actor])
    corners = np.concatenate([moved, world.props.corners])
    owner = np.concatenate([actors.solid_actor, np.full(len(world.props), NOBODY)])
    quads = face_corners(corners)
    normals, offsets = face_planes(quads)
    main = np.zeros((len(corners), FACES_A_SOLID), dtype=bool)
    main[: len(moved)] = actors.solids.main[:, None]
    main[:, BOTTOM] = False
    return Scene(
        actors=actors,
        snapshot=snapshot,
        owner=owner,
        corners=corners,
        quads=quads,
        normals=normals,
        offsets=offsets,
        main=main.ravel(),
        caster=make_caster(corners),
    )


def ground_distance(height: float, downwards: FloatArray) -> FloatArray:
    """From a point above the ground along rays with the z components `downwards` (N,); infinite where they rise."""
    falling = downwards < 0
    return np.where(falling, height / -np.where(falling, downwards, -1.0), np.inf)
