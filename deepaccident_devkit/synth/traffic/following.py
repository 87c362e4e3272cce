"""How fast to drive: the intelligent driver model, with its reaction to what is ahead."""

from dataclasses import dataclass

import numpy as np

from deepaccident_devkit.arrays import FloatArray
from deepaccident_devkit.synth.traffic.kinematics import HARDEST_BRAKING

_STIFFNESS = 2.5
"""1/s: the braking for each m/s above the allowed speed."""
_SLOWING = 4.0
"""m/s²: the hardest braking to the speed that a bend allows."""
_GENTLE_STOP = (3.0, 1.0)
"""The hardest braking near standstill, m/s², and how much harder it can be for each m/s of speed."""
_NO_GAP = 0.1
"""Metres: a smaller gap counts as this."""


@dataclass(frozen=True, slots=True, eq=False)
class Temper:
    """How road users drive, one row each (Treiber, Hennecke and Helbing 2000 name the parameters).

    Attributes:
        max_speed: (A,) speed on a free straight road, m/s.
        acceleration: (A,) acceleration from standstill, m/s².
        braking: (A,) comfortable braking, m/s².
        time_gap: (A,) seconds to the road user ahead.
        min_gap: (A,) metres, bumper to bumper, when standing.
    """

    max_speed: FloatArray
    acceleration: FloatArray
    braking: FloatArray
    time_gap: FloatArray
    min_gap: FloatArray


def free_acceleration(temper: Temper, speed: FloatArray, allowed: FloatArray) -> FloatArray:
    """The acceleration (A,) m/s² if nobody is in the way.

    Args:
        temper: how they drive.
        speed: (A,) m/s.
        allowed: (A,) m/s, the speed that the bends ahead allow.
    """
    own = temper.acceleration * (1.0 - (speed / temper.max_speed) ** 4)
    bend = np.maximum(_STIFFNESS * (allowed - speed), -_SLOWING)
    return np.asarray(np.clip(np.minimum(own, bend), -HARDEST_BRAKING, None))


def hardest_braking(speed: FloatArray) -> FloatArray:
    """The hardest braking (A,) m/s² at a speed (A,) m/s: at low speed nobody brakes hard."""
    return np.minimum(_GENTLE_STOP[0] + _GENTLE_STOP[1] * speed, HARDEST_BRAKING)


def interaction(temper: Temper, speed: FloatArray, gap: FloatArray, leader_speed: FloatArray) -> FloatArray:
    """The acceleration (A,) m/s², 0 or less, that each adds because of the road user ahead.

    Args:
        temper: how they drive.
        speed: (A,) m/s.
        gap: (A,) metres to the road user ahead, infinite if there is none.
        leader_speed: (A,) m/s, its speed along the same path.
    """
    return _interaction(temper, speed, gap, leader_speed, temper.min_gap, temper.time_gap)


def stopping(temper: Temper, speed: FloatArray, gap: FloatArray) -> FloatArray:
    """The acceleration (A,) m/s² to stop before a line `gap` (A,) metres ahead; `gap` is infinite if there is none."""
    return _interaction(temper, speed, gap, np.zeros_like(speed), np.full_like(speed, 0.5), 0.3 * temper.time_gap)


def can_stop(temper: Temper, speed: FloatArray, gap: FloatArray) -> FloatArray:
    """(A,) bool, whether braking a little harder than comfortably stops it before a line `gap` (A,) metres ahead."""
    return np.asarray(speed**2 <= 2 * 1.5 * temper.braking * gap)


def _interaction(
    temper: Temper,
    speed: FloatArray,
    gap: FloatArray,
    leader_speed: FloatArray,
    min_gap: FloatArray,
    time_gap: FloatArray,
) -> FloatArray:
    closing = speed * (speed - leader_speed) / (2 * np.sqrt(temper.acceleration * temper.braking))
    wanted = min_gap + np.maximum(speed * time_gap + closing, 0.0)
    return np.asarray(-temper.acceleration * (wanted / np.maximum(gap, _NO_GAP)) ** 2)
