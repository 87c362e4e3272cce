"""`Forecast`: how an actor may go on; and how far such paths are from the recorded one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.evaluation.predictions import ascending_times
from deepaccident_devkit.support.arrays import FloatArray, FrozenArrays, checked, checked_whole


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Forecast(FrozenArrays):
    """How an actor may go on: K modes; arrays are read-only.

    Attributes:
        actor_id: its CARLA id.
        times: (T,) seconds after the present, ascending.
        paths: (K, T, 2) where its box's centre is, x forward, y left, metres in the present ego frame.
        probabilities: (K,) of the modes; they are not normalised.
    """

    actor_id: int
    times: FloatArray
    paths: FloatArray
    probabilities: FloatArray

    def __post_init__(self) -> None:
        """Check and freeze; raises GeometryError."""
        times = ascending_times(self.times)
        probabilities = checked("probabilities", self.probabilities, (None,)).copy()
        paths = checked("paths", self.paths, (len(probabilities), len(times), 2)).copy()
        if not len(paths) or not np.isfinite(paths).all():
            raise GeometryError("paths: expected one mode or more of finite numbers; leave out what is not predicted")
        if not ((probabilities >= 0) & (probabilities <= 1)).all():
            raise GeometryError(f"probabilities: expected numbers from 0 to 1, found {probabilities.tolist()}")
        object.__setattr__(self, "actor_id", checked_whole("actor id", self.actor_id))
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "paths", paths)
        object.__setattr__(self, "probabilities", probabilities)
        FrozenArrays.__post_init__(self)
