"""Who waits for whom where ways cross: priority, gaps that are long enough, and those who cannot stop any more."""

import numpy as np

from deepaccident_devkit.arrays import BoolArray, FloatArray
from deepaccident_devkit.synth.traffic.rights import Rights

_ACCELERATION = (1.5, 1.0)
"""m/s²: how others may speed up towards a zone, and how one speeds up oneself to leave it."""
_GAP_BEFORE, _GAP_AFTER = 1.2, 0.6
"""Seconds that must pass between one's leaving a zone and the other's coming, and the other way round."""
_CREEPING = 0.5
"""m/s: who is slower counts as so fast."""
_HARD_BRAKING = 4.5
"""m/s²: who would have to brake harder than this before a zone drives on."""
_BEFORE_ZONE = 1.0
"""Metres before a zone at which one waits."""


def waiting_gap(
    rights: Rights, front: FloatArray, rear: FloatArray, speed: FloatArray, top_speed: FloatArray, held: BoolArray
) -> FloatArray:
    """(A,) metres to where each has to stop for others, infinite for those who may go.

    Args:
        rights: of all pairs.
        front: (A,) how far along its path the front of each is, metres.
        rear: (A,) and its rear.
        speed: (A,) m/s.
        top_speed: (A,) m/s, which each does not exceed.
        held: (A,) bool, whether it stands or will stand before a red light.
    """
    to_enter = rights.zones.enter - front[:, None]
    to_leave = rights.zones.leave - rear[:, None]
    with np.errstate(invalid="ignore"):
        comes = _earliest(np.maximum(to_enter, 0.0), speed[:, None], top_speed[:, None], _ACCELERATION[0])
        goes = _earliest(np.maximum(to_leave, 0.0), speed[:, None], top_speed[:, None], _ACCELERATION[1])
        gone = np.maximum(to_leave, 0.0) / np.maximum(speed[:, None], _CREEPING)
    inside = (to_enter <= 0) & (to_leave > 0)
    cannot_stop = (to_enter > 0) & (speed[:, None] ** 2 > 2 * _HARD_BRAKING * np.maximum(to_enter - 0.3, 0.0))
    coming = (to_leave.T > 0) & (np.isfinite(to_enter.T)) & ~held[None, :]
    first = goes + _GAP_BEFORE < comes.T
    reaching = to_enter / np.maximum(speed[:, None], _CREEPING)
    second = reaching > gone.T + _GAP_AFTER
    matters = coming & ~first & ~second & (to_enter > 0) & ~cannot_stop & rights.sees
    must = rights.waits | inside.T | (cannot_stop & ~inside).T
    gap = np.where(matters & must, np.maximum(to_enter - _BEFORE_ZONE, 0.0), np.inf)
    return np.asarray(gap.min(axis=1))


def _earliest(distance: FloatArray, speed: FloatArray, top_speed: FloatArray, acceleration: float) -> FloatArray:
    """Seconds until someone is so many metres on, who speeds up as much as is likely, up to a top speed."""
    speeding_up = (np.sqrt(speed**2 + 2 * acceleration * distance) - speed) / acceleration
    return np.asarray(np.maximum(speeding_up, distance / top_speed))
