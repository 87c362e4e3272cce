"""`TownMapConfig`: how fine a town's map is, and how many of the recorded pictures it is made from."""

from __future__ import annotations

import math
from dataclasses import dataclass

from deepaccident_devkit.arrays import checked_number
from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.taxonomy import BEV_RESOLUTION


@dataclass(frozen=True, slots=True, kw_only=True)
class TownMapConfig:
    """A map's cells, and which pictures are read; checked when made, raises ConfigError.

    A picture shows 60 m to each side, so that neighbouring frames show nearly the same. Of each recording the first and
    the last picture are read, and one whenever the agent has gone on by `travel` or `period` has passed: what a vehicle
    hides now, a later picture may show.

    Attributes:
        resolution: side of a cell, metres; at least 0.1, the side of a picture's pixel.
        travel: metres from one picture that is read to the next.
        period: seconds from one to the next, at most.
    """

    resolution: float = 0.25
    travel: float = 10.0
    period: float = 2.0

    def __post_init__(self) -> None:
        """Check the numbers."""
        for name, least in (("resolution", BEV_RESOLUTION), ("travel", 0.0), ("period", 0.0)):
            value = checked_number(name, getattr(self, name), error=ConfigError)
            if not (math.isfinite(value) and value >= least and value > 0):
                above = f"of at least {least:g}" if least else "above 0"
                raise ConfigError(f"{name}: expected a number {above}, found {value:g}")
            object.__setattr__(self, name, value)
