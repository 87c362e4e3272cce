"""`OutcomeTable`: how an accident would have ended, by the frame at which those who brake are first warned."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from deepaccident_devkit.arrays import BoolArray, FrozenArrays, IntArray, ShortRepr
from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.safety import BRAKINGS, OUTCOMES, Braking, Skipped

SETTINGS: Final = tuple(f"{each.reaction:g} s, {each.deceleration:g} m/s²" for each in BRAKINGS)
"""Names of the ways of braking, in the order of `BRAKINGS`: reaction time and deceleration."""
NOMINAL: Final = SETTINGS[BRAKINGS.index(Braking(reaction=1.0, deceleration=6.0))]
"""The setting of the headline, in the middle of the nine."""
_NO_FRAME: Final = np.iinfo(np.int64).min


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OutcomeTable(FrozenArrays):
    """How one accident ends for each moment of the first alarm; arrays are read-only.

    Attributes:
        frame: (W,) int64 frame numbers of possible first alarms, ascending.
        outcome: (L, W + 1, K) int8 positions in `safety.OUTCOMES` after each latency, for each first alarm and setting;
            the last of the W + 1 is that without an alarm.
        extrapolated: (L, W + 1, K) bool, whether the two touch only after the recording's end, where both go
            straight on.
        latencies: L seconds from the alarm to the warning of those who brake.
        pedestrian: whether one of the two that collide is a pedestrian.
    """

    frame: IntArray
    outcome: IntArray
    extrapolated: BoolArray
    latencies: tuple[float, ...]
    pedestrian: bool = False

    def __post_init__(self) -> None:
        """Check the arrays against each other; raises EvaluationError."""
        FrozenArrays.__post_init__(self)
        shape = (len(self.latencies), len(self.frame) + 1, len(BRAKINGS))
        for name in ("outcome", "extrapolated"):
            found = np.shape(getattr(self, name))
            if found != shape:
                raise EvaluationError(f"OutcomeTable.{name}: expected shape {shape}, found {found}")
        if np.any(np.diff(self.frame) <= 0):
            raise EvaluationError("OutcomeTable.frame: expected ascending frame numbers; sort them")
        if not np.isin(self.outcome, range(len(OUTCOMES))).all():
            raise EvaluationError(f"OutcomeTable.outcome: expected positions in OUTCOMES, 0 to {len(OUTCOMES) - 1}")

    def rows(self, frames: IntArray) -> IntArray:
        """(C,) which of the W + 1 rows a first alarm at each frame has; the last one for frames of no sample."""
        place = np.searchsorted(self.frame, frames)
        there = np.append(self.frame, _NO_FRAME)[place] == frames
        rows: IntArray = np.where(there, place, len(self.frame))
        return rows


@dataclass(frozen=True, slots=True, kw_only=True)
class AccidentOutcomes(ShortRepr):
    """The tables of accidents, and the scenarios without one.

    Attributes:
        tables: recording, such as `type1_subtype1_accident/Town03_…/ego_vehicle` → its accident's table, with those
            braking whom this agent warns.
        dropped: scenarios whose labels do not show the two near each other at the impact, so that no braking is judged.
        skipped: scenarios of which the labels or the meta file do not say who moves how.
    """

    tables: Mapping[str, OutcomeTable] = field(default_factory=dict)
    dropped: tuple[Skipped, ...] = ()
    skipped: tuple[Skipped, ...] = ()
