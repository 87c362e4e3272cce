"""How wheels move a body: the kinematic bicycle, and the steering that keeps it on its path."""

from dataclasses import dataclass

import numpy as np

from deepaccident_devkit.arrays import FloatArray

PERIOD = 0.02
"""Seconds of a simulated step."""
DECISION_STEPS = 5
"""Drivers look and decide every tenth of a second."""
WHEELBASE = 0.6
"""Of a body's length."""
MAX_STEER = np.deg2rad(38.0)
_MAX_TANGENT = np.tan(MAX_STEER)
MAX_STEER_RATE = 0.6
"""Radians a second, of the front wheels."""
HARDEST_BRAKING = 8.0
"""m/s², which dry asphalt gives."""
_LOOK_AHEAD = (2.5, 0.25)
"""Metres, and seconds of driving: how far the steering looks ahead for where it shall be on its path again."""


@dataclass(slots=True, eq=False)
class Wheels:
    """Where the road users are, one row each; the state that the simulation steps.

    Attributes:
        x: (A,) of the middle of the rear axle, metres.
        y: (A,) likewise.
        yaw: (A,) radians.
        speed: (A,) of the rear axle, m/s, at least 0.
        steer: (A,) of the front wheels, radians, positive to the left.
        along: (A,) how far the rear axle is along its path, metres.
    """

    x: FloatArray
    y: FloatArray
    yaw: FloatArray
    speed: FloatArray
    steer: FloatArray
    along: FloatArray


def step(wheels: Wheels, acceleration: FloatArray, on_path: FloatArray, wheelbase: FloatArray) -> None:
    """Move everyone by one period, in place; one without wheels only gets faster and farther along its path.

    Args:
        wheels: the state.
        acceleration: (A,) m/s².
        on_path: (4, A) x, y, yaw, curvature of the paths at `wheels.along`.
        wheelbase: (A,) metres; infinite for one without wheels.
    """
    distance = np.maximum(wheels.speed + acceleration * (PERIOD / 2), 0.0) * PERIOD
    wheels.speed = np.maximum(wheels.speed + acceleration * PERIOD, 0.0)
    lateral, turned = _off_path(wheels, on_path)
    wheels.along = wheels.along + distance * np.cos(turned) / (1.0 - on_path[3] * lateral)
    change = _wanted_steer(wheels.speed, lateral, turned, on_path[3], wheelbase) - wheels.steer
    room = MAX_STEER_RATE * PERIOD
    wheels.steer = wheels.steer + np.minimum(np.maximum(change, -room), room)
    turn = distance * np.tan(wheels.steer) / wheelbase
    middle = wheels.yaw + turn / 2
    wheels.x = wheels.x + distance * np.cos(middle)
    wheels.y = wheels.y + distance * np.sin(middle)
    wheels.yaw = wheels.yaw + turn


def _off_path(wheels: Wheels, on_path: FloatArray) -> tuple[FloatArray, FloatArray]:
    """How far left of its path each is, metres, and how far it is turned to the left of it, radians."""
    x, y, yaw, _ = on_path
    lateral = np.cos(yaw) * (wheels.y - y) - np.sin(yaw) * (wheels.x - x)
    turned = (wheels.yaw - yaw + np.pi) % (2 * np.pi) - np.pi
    return lateral, turned


def _wanted_steer(
    speed: FloatArray, lateral: FloatArray, turned: FloatArray, curvature: FloatArray, wheelbase: FloatArray
) -> FloatArray:
    """The angle that follows the path and brings back to it, critically damped over the distance looked ahead."""
    ahead = _LOOK_AHEAD[0] + _LOOK_AHEAD[1] * speed
    wanted = curvature - lateral / ahead**2 - 2 * turned / ahead
    most = _MAX_TANGENT / wheelbase
    steer: FloatArray = np.arctan(
        np.where(wheelbase < np.inf, wheelbase, 0.0) * np.minimum(np.maximum(wanted, -most), most)
    )
    return steer
