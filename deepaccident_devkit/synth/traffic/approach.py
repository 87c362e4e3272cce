"""Driving up alone: when someone comes to a place if nobody is in the way, and where it is before that."""

from dataclasses import dataclass, replace

import numpy as np

from deepaccident_devkit.arrays import FloatArray
from deepaccident_devkit.synth.traffic.following import free_acceleration
from deepaccident_devkit.synth.traffic.kinematics import DECISION_STEPS, PERIOD
from deepaccident_devkit.synth.traffic.tracks import Tracks
from deepaccident_devkit.synth.traffic.users import RoadUser, temper_of

_LONGEST = 24.0
"""Seconds that a drive lasts."""


@dataclass(frozen=True, slots=True, eq=False)
class Approach:
    """A drive over a free road, from standing or from a given speed.

    Attributes:
        user: who drives, as at the start of the drive.
        along: (S,) metres of its box's centre along its path, `kinematics.PERIOD` apart.
        speed: (S,) m/s.
    """

    user: RoadUser
    along: FloatArray
    speed: FloatArray

    def time_to(self, place: float) -> float:
        """Seconds until the centre is `place` metres along the path; the last moment if it never gets there."""
        row = min(int(np.searchsorted(self.along, place)), len(self.along) - 1)
        return row * PERIOD

    def at(self, time: float) -> RoadUser:
        """The road user as it is `time` seconds into the drive.

        Before its beginning one that starts from standing waits, another comes from farther back.
        """
        if time < 0 and self.user.start_speed == 0:
            return replace(self.user, delay=-time)
        if time < 0:
            return replace(self.user, start=self.user.start + self.user.start_speed * time)
        row = min(round(time / PERIOD), len(self.along) - 1)
        return replace(self.user, start=float(self.along[row]), start_speed=float(self.speed[row]), delay=0.0)


def drive_alone(user: RoadUser) -> Approach:
    """The drive of one who is alone on its path: as in a simulation, but that it never leaves its path."""
    tracks = Tracks([user.path], np.array([user.manner.lateral]), np.array([user.walks]))
    temper, back = temper_of([user]), user.wheelbase / 2
    along, speed = np.array([user.start - back]), np.array([user.start_speed])
    steps = PERIOD * np.arange(1, DECISION_STEPS + 1)
    places, speeds = [along], [speed]
    for _ in range(round(_LONGEST / (PERIOD * DECISION_STEPS))):
        acceleration = free_acceleration(temper, speed, tracks.allowed_speed(along))
        moving = np.maximum(speed + acceleration * steps, 0.0)
        before = np.append(speed, moving[:-1])
        moved = along + PERIOD * np.cumsum((before + moving) / 2)
        places.append(moved)
        speeds.append(moving)
        along, speed = moved[-1:], moving[-1:]
    return Approach(user, np.concatenate(places) + back, np.concatenate(speeds))
