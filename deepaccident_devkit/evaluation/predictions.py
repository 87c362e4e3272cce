"""What a model says about a sample, from any framework."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.arrays import AnyArray, FloatArray, FrozenArrays, as_numbers, checked
from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion import MotionHeads


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MotionOutput(FrozenArrays):
    """K predictions of one sample's motion, in the present ego frame; give either heads or instances.

    The released order counts: five samples, then the mean; VPQ and IoU take the last one. A single prediction is fine.

    Attributes:
        grid: the cells; its orientation is how the maps lie.
        heads: K times a model's maps of T frames, the present first; None if `instances` are given.
        instances: (K, T, H, W) int32, ids from 1 that stay the same over the frames, 0 elsewhere; None with heads.
    """

    grid: BevGrid
    heads: tuple[MotionHeads, ...] | None = None
    instances: AnyArray | None = None

    def __post_init__(self) -> None:
        """Check and freeze.

        Raises:
            GeometryError: both or none are given, nothing is predicted, or a shape is not the grid's.
        """
        if (self.heads is None) == (self.instances is None):
            raise GeometryError("motion output: give heads, or instances, and not both")
        if self.instances is not None:
            maps = checked("instances", self.instances, (None, None, *self.grid.shape), np.int32)
            if not len(maps):
                raise GeometryError("instances: expected at least one prediction, found none")
            object.__setattr__(self, "instances", maps)
        else:
            object.__setattr__(self, "heads", _checked_heads(self.heads or (), self.grid))
        FrozenArrays.__post_init__(self)

    def __len__(self) -> int:
        """Number of predictions, K."""
        return len(self.heads) if self.heads is not None else len(self.instances if self.instances is not None else ())


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Accident(FrozenArrays):
    """An accident that is said to come.

    Attributes:
        positions: (2, 2) x forward, y left of the two that collide, metres in the present ego frame.
        time: seconds after the present.
        score: how sure the model is, the more the higher.
        ids: their actor ids, in the order of `positions`; None if the model has none.
    """

    positions: FloatArray
    time: float
    score: float = 1.0
    ids: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        """Check and freeze; raises GeometryError."""
        positions = checked("accident positions", self.positions, (2, 2)).copy()
        if not np.isfinite(positions).all():
            raise GeometryError("accident positions: not all numbers are finite; leave out what is not predicted")
        if not (math.isfinite(self.time) and math.isfinite(self.score)):
            raise GeometryError(f"accident: time {self.time} and score {self.score} must be finite")
        object.__setattr__(self, "positions", positions)
        FrozenArrays.__post_init__(self)


def _checked_heads(heads: Sequence[MotionHeads], grid: BevGrid) -> tuple[MotionHeads, ...]:
    if not heads:
        raise GeometryError("heads: expected at least one prediction, found none")
    for each in heads:
        if each.segmentation.shape[-2:] != grid.shape or each.orientation != grid.orientation:
            raise GeometryError(
                f"heads: expected maps of {grid.shape} cells in orientation {grid.orientation}, found "
                f"{each.segmentation.shape[-2:]} in {each.orientation}"
            )
    return tuple(heads)


def instances_of(values: ArrayLike, grid: BevGrid) -> MotionOutput:
    """One prediction (T, H, W), or K of them (K, T, H, W), given as instance maps; raises GeometryError."""
    maps = as_numbers("instances", values, dtype=None)
    return MotionOutput(grid=grid, instances=maps[None] if maps.ndim == 3 else maps)
