"""`Plan`: a path that an agent plans to drive."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.evaluation.predictions import ascending_times
from deepaccident_devkit.support.arrays import FloatArray, FrozenArrays, checked, checked_number


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Plan(FrozenArrays):
    """A path that the sample's agent plans to drive; arrays are read-only.

    Attributes:
        times: (T,) seconds after the present, ascending.
        path: (T, 2) where its ego frame is, x forward, y left, metres in the present ego frame.
        score: how good the plan is, the more the higher.
        yaw: (T,) its headings, radians, counter-clockwise; None for the directions of the steps.
    """

    times: FloatArray
    path: FloatArray
    score: float = 1.0
    yaw: FloatArray | None = None

    def __post_init__(self) -> None:
        """Check and freeze; raises GeometryError."""
        times = ascending_times(self.times)
        path = checked("path", self.path, (len(times), 2)).copy()
        yaw = None if self.yaw is None else checked("yaw", self.yaw, (len(times),)).copy()
        if not np.isfinite(path).all() or (yaw is not None and not np.isfinite(yaw).all()):
            raise GeometryError("path: not all numbers are finite; leave out what is not planned")
        for name, value in {
            "times": times,
            "path": path,
            "yaw": yaw,
            "score": checked_number("score", self.score),
        }.items():
            object.__setattr__(self, name, value)
        FrozenArrays.__post_init__(self)
