"""One moment of a scenario, ready to be recorded: where all road users are, and a caster for rays to them."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from deepaccident_devkit.arrays import AnyArray, FloatArray, IntArray
from deepaccident_devkit.geometry.boxes import CORNER_SIGNS
from deepaccident_devkit.synth.actors import Actors, Snapshot
from deepaccident_devkit.synth.sensors.caster import Caster, make_caster
from deepaccident_devkit.synth.sensors.setting import Setting, Surfaces, moved
from deepaccident_devkit.synth.shapes import BOX_CLEARANCE


@dataclass(frozen=True, eq=False)
class Scene:
    """Everything at one moment, in the ground frame.

    Attributes:
        setting: what stands still.
        snapshot: where the road users are, seen from above.
        frames: (A, 4, 4) their frames on the ground, as in `setting.placed_on`.
        movers: surfaces of those who are not parked.
        caster: casts rays against `movers`.
    """

    setting: Setting
    snapshot: Snapshot
    frames: FloatArray
    movers: Surfaces
    caster: Caster

    @property
    def actors(self) -> Actors:
        """The road users."""
        return self.setting.actors

    @cached_property
    def box_corners(self) -> FloatArray:
        """Corners of the label boxes on the ground, (A, 8, 3), metres."""
        offsets = self.actors.size[:, None, :] / 2 * CORNER_SIGNS
        offsets[:, :, 2] += self.actors.size[:, 2:] / 2 + BOX_CLEARANCE
        return moved(offsets, self.frames)

    @property
    def face_owner(self) -> IntArray:
        """The same as `Setting.face_owner`."""
        return self.setting.face_owner

    @cached_property
    def normals(self) -> FloatArray:
        """Outward unit normals of all faces, (F, 3)."""
        return np.concatenate([self.setting.still.planes[0], self.movers.planes[0]])

    def cast(
        self, origin: FloatArray, directions: AnyArray, *, near: IntArray | None = None
    ) -> tuple[AnyArray, AnyArray]:
        """Where rays first meet a surface or the ground.

        Args:
            origin: (3,) metres, above the ground; or (N, 3), one for each ray.
            directions: (N, 3), of any length.
            near: rows of the rays that can meet a moving road user; None for all.

        Returns:
            (N,) distances in lengths of the direction, infinite if a ray meets nothing; and (N,) the faces met,
            or `caster.GROUND` or `caster.NOTHING`.
        """
        rows = np.arange(len(directions)) if near is None else near
        reached, met = self._cast_at_movers(origin, directions, rows)
        reach = np.full(len(directions), np.inf, dtype=np.float32)
        reach[rows] = reached
        distance, face = self.setting.caster.cast(origin, directions, reach)
        ahead = np.flatnonzero(reached < distance[rows])
        distance[rows[ahead]], face[rows[ahead]] = reached[ahead], met[ahead]
        return distance, face

    def with_movers(
        self, origin: FloatArray, directions: AnyArray, still: tuple[AnyArray, AnyArray], near: IntArray
    ) -> tuple[AnyArray, AnyArray]:
        """What rays meet, given that they meet `still` without moving road users; all else is as in `cast`."""
        reached, met = self._cast_at_movers(origin, directions, near)
        ahead = np.flatnonzero(reached < still[0][near])
        distance, face = still[0].copy(), still[1].copy()
        distance[near[ahead]], face[near[ahead]] = reached[ahead], met[ahead]
        return distance, face

    def _cast_at_movers(self, origin: FloatArray, directions: AnyArray, rows: IntArray) -> tuple[AnyArray, AnyArray]:
        """How far the rays of `rows` go until they meet a moving road user, and the faces that they meet."""
        reached, met = self.caster.cast(origin if origin.ndim == 1 else origin[rows], directions[rows])
        return reached, met + self.setting.faces


def make_scene(setting: Setting, time: float) -> Scene:
    """The scene at a time, seconds since the first recorded frame."""
    snapshot = setting.actors.at(time)
    frames = setting.frames(snapshot.poses)
    corners = moved(setting.moving_shapes.corners, frames[setting.moving_owner])
    movers = Surfaces(setting.moving_shapes, corners, setting.moving_owner)
    return Scene(setting, snapshot, frames, movers, make_caster(corners))
