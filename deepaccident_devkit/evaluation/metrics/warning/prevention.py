"""`PreventedResult`: the accidents that a driver's braking after the alarm prevents, beside the braking for nothing."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from deepaccident_devkit.arrays import FloatArray, FrozenArrays
from deepaccident_devkit.evaluation.metrics.frozen_mappings import FrozenMappings
from deepaccident_devkit.evaluation.metrics.warning.outcome_tables import NOMINAL
from deepaccident_devkit.safety import OUTCOMES, Skipped

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
"""Latency in seconds → setting (`outcome_tables.SETTINGS`) → figures."""


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
        braking_seconds_per_minute: (C, K) the cost in the order of `outcome_tables.SETTINGS`; never falls along C.
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
        """The headline: the share avoided in the setting `outcome_tables.NOMINAL`, without latency; NaN for none."""
        ends: Ends = getattr(self.groups[group], self.alarms)
        return next((each[NOMINAL].shares[OUTCOMES[0]] for each in ends.values()), math.nan)
