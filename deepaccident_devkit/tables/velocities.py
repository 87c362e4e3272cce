"""Velocities of boxes: decoded from the labels, derived from displacements, and which convention the labels follow.

A velocity is over the ground, three numbers in world. Arrays are over the N boxes of one scenario, right-handed.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from deepaccident_devkit.geometry import quaternions
from deepaccident_devkit.release.labels import turned
from deepaccident_devkit.support.arrays import BoolArray, FloatArray, IntArray, ShortRepr
from deepaccident_devkit.tables.boxes import ScenarioBoxes, world_rotations
from deepaccident_devkit.taxonomy import (
    FRAME_PERIOD,
    OWN_ACTOR_ID,
    RELEASED_VELOCITY_FRAME,
    STATIC_ACTOR_ID,
    UNTRACKED_ID,
    VELOCITY_FRAMES,
)

LEAST_BOXES: Final = 20
"""With fewer moving boxes it is not known how a scenario's velocities are written."""
_LEAST_SPEED = 1.0
"""m/s; slower actors are not used."""
_FITS = (0.5, 0.15)
"""m/s, and as a share of the speed, within which a velocity fits."""
_LEAST_SHARE = 0.5
_AS_GOOD = 0.95
"""Share of the best frame's boxes from which the release's own frame is taken instead."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VelocityFit(ShortRepr):
    """How many boxes' velocities fit their displacement in each of `VELOCITY_FRAMES`; adds up over scenarios.

    Attributes:
        boxes: moving, tracked boxes of others that have both velocities.
        fits: frame → boxes that fit.
    """

    boxes: int
    fits: Mapping[str, int]

    @property
    def best(self) -> str | None:
        """The frame that fits most boxes; None if there are too few, or none fits half of them.

        The release's own counts where it fits nearly as many: on a straight road along x all frames are alike.
        """
        name = max(self.fits, key=lambda frame: self.fits[frame])
        if self.fits[RELEASED_VELOCITY_FRAME] >= _AS_GOOD * self.fits[name]:
            name = RELEASED_VELOCITY_FRAME
        return name if self.boxes >= LEAST_BOXES and self.fits[name] >= _LEAST_SHARE * self.boxes else None


def total_fit(fits: list[VelocityFit]) -> VelocityFit:
    """The sum over scenarios."""
    return VelocityFit(
        boxes=sum(fit.boxes for fit in fits),
        fits={name: sum(fit.fits[name] for fit in fits) for name in VELOCITY_FRAMES},
    )


def displacement_velocities(centers: FloatArray, agent: IntArray, label_id: IntArray, frame: IntArray) -> FloatArray:
    """(N, 3) m/s in world from displacements at 10 Hz, NaN where unknown.

    A track is one agent's rows of one label id (−100 is its own track): central differences where the frames before
    and after are there, one-sided where one is, NaN where none is and for untracked rows.

    Args:
        centers: (N, 3) box centres in world, metres.
        agent: (N,) which agent's.
        label_id: (N,) ids as the labels say.
        frame: (N,) frame numbers.
    """
    keys = np.column_stack([agent, label_id, frame])
    steps, first, step_of = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    position = centers[first]
    follows = (steps[1:, :2] == steps[:-1, :2]).all(axis=1) & (steps[1:, 2] == steps[:-1, 2] + 1)
    before = np.concatenate([[False], follows])[: len(steps)]
    after = np.concatenate([follows, [False]])[: len(steps)]
    index = np.arange(len(steps))
    span = (before.astype(np.float64) + after) * FRAME_PERIOD
    known = (before | after) & (steps[:, 1] != UNTRACKED_ID)
    velocity = np.full((len(steps), 3), np.nan)
    with np.errstate(over="ignore"):  # labels may hold the largest numbers
        moved = position[index + after] - position[index - before]
        velocity[known] = moved[known] / span[known, None]
    return velocity[step_of.reshape(-1)]


def fit_velocities(boxes: ScenarioBoxes, displacement: FloatArray) -> VelocityFit:
    """Which of `VELOCITY_FRAMES` the labels' velocities are in, by the displacements (N, 3) of the same boxes."""
    rows, fits = velocities_that_fit(boxes, displacement)
    return VelocityFit(boxes=len(rows), fits={name: int(fit.sum()) for name, fit in fits.items()})


def velocities_that_fit(boxes: ScenarioBoxes, displacement: FloatArray) -> tuple[IntArray, dict[str, BoolArray]]:
    """The rows (M,) of boxes that are used, and which of them fit each frame."""
    label_id, said = boxes.labels.actor_id, boxes.labels.velocity
    speed = np.linalg.norm(displacement[:, :2], axis=1)
    telling = (label_id != OWN_ACTOR_ID) & (label_id != UNTRACKED_ID) & (label_id < STATIC_ACTOR_ID)
    rows = np.flatnonzero(telling & (speed > _LEAST_SPEED) & np.isfinite(said).all(axis=1))
    angles = _angles(boxes)
    fits = {}
    for name in VELOCITY_FRAMES:
        off = np.linalg.norm(turned(said[rows], angles[name][rows]) - displacement[rows, :2], axis=1)
        fits[name] = off < _FITS[0] + _FITS[1] * speed[rows]
    return rows, fits


def decoded_velocities(boxes: ScenarioBoxes, displacement: FloatArray, frame: str | None) -> FloatArray:
    """(N, 3) m/s in world: the labels' own velocities where they have any, the displacements (N, 3) elsewhere.

    A label has no vertical velocity: it is taken from the displacement, and is 0 without one.

    Args:
        boxes: the boxes.
        displacement: of each, as of `displacement_velocities`.
        frame: what the labels' velocities are in; None for the release's own way.
    """
    over_ground = turned(boxes.labels.velocity, _angles(boxes)[frame or RELEASED_VELOCITY_FRAME])
    own = boxes.labels.actor_id == OWN_ACTOR_ID
    over_ground[own] = boxes.labels.velocity[own]  # in world, whatever the others' are in
    velocity = np.column_stack([over_ground, np.nan_to_num(displacement[:, 2])])
    unknown = np.flatnonzero(np.isnan(over_ground[:, 0] + over_ground[:, 1]))
    velocity[unknown] = displacement[unknown]
    return velocity


def _angles(boxes: ScenarioBoxes) -> dict[str, FloatArray]:
    """Frame → the angles (N,) that turn the labels' velocities into world."""
    pose = boxes.world_from_lidar[boxes.sample]
    heading = np.arctan2(pose[:, 1, 0], pose[:, 0, 0])
    return {
        "released": -boxes.labels.yaw,
        "lidar": heading,
        "world": np.zeros(len(boxes)),
        "turned-wrong": -heading,
        "box": quaternions.yaw_of(world_rotations(boxes)),
    }
