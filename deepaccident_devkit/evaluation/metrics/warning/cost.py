"""What false alarms cost: time in alarm, and seconds of braking by a driver who obeys after a reaction time."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from deepaccident_devkit.arrays import BoolArray, FloatArray, IntArray, ShortRepr
from deepaccident_devkit.errors import ConfigError, EvaluationError
from deepaccident_devkit.evaluation.metrics.evaluator import ratio

MINUTE: Final = 60.0


@dataclass(frozen=True, slots=True, kw_only=True)
class AlarmCost(ShortRepr):
    """What the alarms of recordings without an accident cost. NaN: no frame.

    Attributes:
        episodes: runs of alarmed frames.
        alarm_seconds: their time.
        time_share: share of the frames that are in alarm.
        episodes_per_minute: of recording.
        braking_seconds: what is left of each run after the reaction time.
        braking_seconds_per_minute: of recording.
    """

    episodes: int
    alarm_seconds: float
    time_share: float
    episodes_per_minute: float
    braking_seconds: float
    braking_seconds_per_minute: float


def alarm_runs(alarm: BoolArray) -> tuple[IntArray, IntArray]:
    """The runs of alarmed frames of recordings: (R,) the row of each, and (R,) how many columns it has.

    Args:
        alarm: (N, T) a row a recording; False also where a frame is missing, which ends a run.
    """
    edges = np.diff(np.pad(alarm.astype(np.int8), ((0, 0), (1, 1))), axis=1)
    row, begin = np.nonzero(edges == 1)
    _, end = np.nonzero(edges == -1)
    return row, end - begin


def braking_seconds(alarm: BoolArray, reaction: float, fps: float) -> FloatArray:
    """(N,) seconds in which a driver brakes who obeys alarms: of each run max(0, its duration − reaction).

    Args:
        alarm: (N, T) whether each frame is in alarm; a run lasts to a frame's length after its last one.
        reaction: seconds from the alarm to the brake.
        fps: columns a second.
    """
    row, length = alarm_runs(alarm)
    seconds: FloatArray = np.bincount(row, np.maximum(length / fps - reaction, 0.0), len(alarm)).astype(np.float64)
    return seconds


def false_alarm_cost(
    alarm: BoolArray, reaction: float, *, fps: float = 10.0, frames: BoolArray | None = None
) -> AlarmCost:
    """The cost of the alarms in recordings without an accident.

    Args:
        alarm: (N, T) whether each frame is in alarm.
        reaction: seconds from an alarm to the brake.
        fps: columns a second.
        frames: (N, T) which frames there are; None for all.

    Raises:
        EvaluationError: the arrays have other shapes, or a frame that is not there is in alarm.
        ConfigError: the reaction is below 0, or there is no frame a second.
    """
    raised = np.asarray(alarm, dtype=bool)
    there = np.ones_like(raised) if frames is None else np.asarray(frames, dtype=bool)
    if raised.ndim != 2 or there.shape != raised.shape:
        raise EvaluationError(f"alarm, frames: expected shape (N, T) each, found {raised.shape} and {there.shape}")
    if (raised & ~there).any():
        raise EvaluationError("alarm: expected alarms at frames that are there alone; set the others to False")
    if not (0 <= reaction < math.inf and 0 < fps < math.inf):
        raise ConfigError(f"reaction, fps: expected seconds from 0 and a rate above 0, found {reaction!r} and {fps!r}")
    _, length = alarm_runs(raised)
    count = int(there.sum())
    minutes = count / fps / MINUTE
    braking = math.fsum(braking_seconds(raised, reaction, fps).tolist())
    return AlarmCost(
        episodes=len(length),
        alarm_seconds=int(length.sum()) / fps,
        time_share=ratio(int(length.sum()), count),
        episodes_per_minute=ratio(len(length), minutes),
        braking_seconds=braking,
        braking_seconds_per_minute=ratio(braking, minutes),
    )
