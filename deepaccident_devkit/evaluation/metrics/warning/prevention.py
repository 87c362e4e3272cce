"""How accidents would have ended (`OutcomeTable`), and `PreventedResult`: those that braking after alarms prevents."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from deepaccident_devkit.arrays import BoolArray, FloatArray, FrozenArrays, IntArray, ShortRepr
from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.metrics.frozen_mappings import FrozenMappings
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


BUDGET: Final = 1.0
"""Braking seconds a minute, on recordings without an accident, that the headline allows."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OutcomeFigures(FrozenMappings):
    """How the accidents of one group end, for one way of braking and one threshold. NaN: nothing to count.

    Attributes:
        warned: share of the accidents with an alarm that counts.
        shares: class of `safety.OUTCOMES` → share of the accidents; missed ones end as they were recorded.
        counts: class → accidents; empty where the shares are means over draws.
        extrapolated: share that touches only after the recording's end, where both are taken to go straight on: if the
            replay ended there, these would count as avoided.
        braking_seconds_per_minute: the cost, on recordings without an accident: of each run of alarmed frames what is
            left after the reaction time.
    """

    warned: float
    shares: Mapping[str, float]
    counts: Mapping[str, int]
    extrapolated: float
    braking_seconds_per_minute: float


Ends = Mapping[float, Mapping[str, OutcomeFigures]]
"""Latency in seconds → setting (`SETTINGS`) → figures."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PreventionFigures(FrozenMappings):
    """What one predictor's alarms prevent in one group of recordings.

    Attributes:
        threshold: the lowest score that is an alarm; NaN where none is known, infinite where any alarm costs too much.
        quiet_braking: the lowest threshold with at most one braking second a minute at a reaction of 1 s; to be given
            when another split is evaluated.
        accidents: how many are judged.
        recordings: those without an accident.
        minutes: of these, up to where they count.
        right: who brakes is warned by the first right alarm.
        any_alarm: likewise by the first alarm of all, which may be of others or of another moment.
        lasting: likewise by the first alarm that lasts longer than the reaction, as those do that cost anything. So
            alarms that flicker, such as random ones, prevent nothing for free.
    """

    threshold: float
    quiet_braking: float
    accidents: int
    recordings: int
    minutes: float
    right: Ends
    any_alarm: Ends
    lasting: Ends


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PreventionCurve(FrozenArrays):
    """Shares prevented against the cost as the threshold falls, without latency; arrays are read-only.

    Attributes:
        threshold: (C,) descending; the first is infinite: no alarm.
        braking_seconds_per_minute: (C, K) the cost in the order of `SETTINGS`; never falls along C.
        avoided: (C, K) share of the accidents that do not happen.
        mitigated: (C, K) share of those with a change of speed that is smaller by a tenth or more.
    """

    threshold: FloatArray
    braking_seconds_per_minute: FloatArray
    avoided: FloatArray
    mitigated: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class PreventedResult(FrozenMappings):
    """Prevented accidents, by group of recordings (`drives.GROUPS`); accidents of pedestrians are groups of their own.

    Attributes:
        operating_by: `given` threshold, or `budget`: at most one braking second a minute on these very recordings.
        alarms: `right` or `any_alarm`: which of these the headline and the curves are of.
        groups: group → figures of the predictions.
        references: predictor (of `drives.PREDICTORS` but the given one; a random one also at its own `quiet_braking`)
            → the same; empty for resamples.
        curves: group → curve of the predictions; empty for resamples.
        dropped: accidents that no braking is judged of, and why: their labels do not show the two near each other.
        skipped: accidents whose motion is not known, and why.
        notes: sentences that a reader of the numbers should know.
    """

    operating_by: str
    alarms: str
    groups: Mapping[str, PreventionFigures]
    references: Mapping[str, Mapping[str, PreventionFigures]]
    curves: Mapping[str, PreventionCurve]
    dropped: tuple[Skipped, ...]
    skipped: tuple[Skipped, ...]
    notes: tuple[str, ...] = ()

    def avoided(self, group: str) -> float:
        """The headline: the share avoided in the setting `NOMINAL`, without latency; NaN for none."""
        ends: Ends = getattr(self.groups[group], self.alarms)
        return next((each[NOMINAL].shares[OUTCOMES[0]] for each in ends.values()), math.nan)
