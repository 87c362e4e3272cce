"""Traffic lights: the colour that each arm has at a time."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.arrays import IntArray
from deepaccident_devkit.synth.roads import Arm

RED, AMBER, GREEN = range(3)
Axis = Literal["west-east", "south-north"]
AXIS_OF_ARM: dict[Arm, Axis] = {
    "west": "west-east",
    "east": "west-east",
    "south": "south-north",
    "north": "south-north",
}
AMBER_TIME = 3.0
CLEARANCE_TIME = 1.5
"""Seconds of red for all between one axis' amber and the other's green."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SignalPlan:
    """Two phases that alternate without end: one axis has green, then the other.

    Attributes:
        first: the axis that gets green at `start`.
        start: when it gets green, seconds since the first recorded frame.
        green: how long each axis has green, seconds.
    """

    first: Axis
    start: float
    green: float

    def state(self, arm: Arm, times: ArrayLike) -> IntArray:
        """`RED`, `AMBER` or `GREEN` of an arm at times (…), seconds."""
        half = self.green + AMBER_TIME + CLEARANCE_TIME
        shift = 0.0 if AXIS_OF_ARM[arm] == self.first else half
        phase = (np.asarray(times, dtype=np.float64) - self.start - shift) % (2 * half)
        colors = np.where(phase < self.green, GREEN, np.where(phase < self.green + AMBER_TIME, AMBER, RED))
        return np.asarray(colors, dtype=np.int64)

    def shifted(self, seconds: float) -> "SignalPlan":
        """The same plan, some seconds later."""
        return replace(self, start=self.start + seconds)


def plan_with_green(axis: Axis, time: float, green: float, share: float) -> SignalPlan:
    """A plan in which an axis has green at a time.

    Args:
        axis: the axis with green.
        time: when it has green, seconds.
        green: how long each axis has green, seconds.
        share: the share of this green that is over at `time`, from 0 to 1.
    """
    return SignalPlan(first=axis, start=time - share * green, green=green)
