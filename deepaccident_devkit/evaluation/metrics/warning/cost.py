"""What false alarms cost: time in alarm, and seconds of braking by a driver who obeys after a reaction time."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from deepaccident_devkit.arrays import BoolArray, FloatArray, FrozenArrays, IntArray, ShortRepr
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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AlarmRuns(FrozenArrays):
    """The R runs of alarmed frames of N recordings; arrays are read-only.

    Attributes:
        row: (R,) int64 which recording.
        begin: (R,) int64 first column.
        length: (R,) int64 columns.
        shape: N recordings and T columns.
        fps: columns a second.
    """

    row: IntArray
    begin: IntArray
    length: IntArray
    shape: tuple[int, int]
    fps: float

    @classmethod
    def of(cls, alarm: BoolArray, fps: float) -> AlarmRuns:
        """The runs in (N, T) alarms: a row a recording, False also where a frame is missing, which ends a run."""
        edges = np.diff(alarm.astype(np.int8), axis=1, prepend=0, append=0)
        row, begin = np.nonzero(edges == 1)
        _, end = np.nonzero(edges == -1)
        count, columns = alarm.shape
        return cls(row=row, begin=begin, length=end - begin, shape=(count, columns), fps=fps)

    def braking_seconds(self, reaction: float) -> FloatArray:
        """(N,) seconds in which a driver brakes who obeys: of each run max(0, its duration − the reaction time)."""
        left = np.maximum(self.length / self.fps - reaction, 0.0)
        seconds: FloatArray = np.bincount(self.row, left, self.shape[0]).astype(np.float64)
        return seconds

    def first_lasting(self, reaction: float) -> IntArray:
        """(N,) first column of the first run that outlasts the reaction, so that it costs something; T for none."""
        lasting = self.length / self.fps > reaction
        first = np.full(self.shape[0], self.shape[1], dtype=np.int64)
        np.minimum.at(first, self.row[lasting], self.begin[lasting])
        return first


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
    runs = AlarmRuns.of(raised, fps)
    alarmed = int(runs.length.sum())
    count = int(there.sum())
    minutes = count / fps / MINUTE
    braking = math.fsum(runs.braking_seconds(reaction).tolist())
    return AlarmCost(
        episodes=len(runs.row),
        alarm_seconds=alarmed / fps,
        time_share=ratio(alarmed, count),
        episodes_per_minute=ratio(len(runs.row), minutes),
        braking_seconds=braking,
        braking_seconds_per_minute=ratio(braking, minutes),
    )
