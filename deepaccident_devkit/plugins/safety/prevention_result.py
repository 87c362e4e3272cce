"""How accidents would have ended (`OutcomeTable`), and `PreventedResult`: those that braking after alarms prevents.

`AlarmOutcomes` asks one predictor's scores how accidents end as the threshold of an alarm moves.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Final

import numpy as np

from deepaccident_devkit.collisions.outcomes import BRAKINGS, OUTCOMES, Braking
from deepaccident_devkit.collisions.recorded import Skipped
from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.evaluator import ratio
from deepaccident_devkit.evaluation.task import FrozenMappings, Row
from deepaccident_devkit.evaluation.warning.recordings import (
    MINUTE,
    AlarmRuns,
    Recording,
    ScoresOf,
    series_of,
)
from deepaccident_devkit.support.arrays import (
    BoolArray,
    FloatArray,
    FrozenArrays,
    IntArray,
    ShortRepr,
)
from deepaccident_devkit.taxonomy import FRAME_PERIOD

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
            raise EvaluationError(
                f"OutcomeTable.outcome: expected positions in OUTCOMES, 0 to {len(OUTCOMES) - 1}"
            )

    def rows(self, frames: IntArray) -> IntArray:
        """(C,) which of the W + 1 rows a first alarm at each frame has; the last one for frames of no sample."""
        place = np.searchsorted(self.frame, frames)
        there = np.append(self.frame, _NO_FRAME)[place] == frames
        return np.where(there, place, len(self.frame))


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


FiguresByLatency = Mapping[float, Mapping[str, OutcomeFigures]]
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
    right: FiguresByLatency
    any_alarm: FiguresByLatency
    lasting: FiguresByLatency


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
    """Prevented accidents, by group (`recordings.GROUPS`); accidents of pedestrians are groups of their own.

    Attributes:
        operating_by: `given` threshold, or `budget`: at most one braking second a minute on these very recordings.
        alarms: `right` or `any_alarm`: which of these the headline and the curves are of.
        groups: group → figures of the predictions.
        references: predictor (of `recordings.PREDICTORS` but the given one; a random one also at its own
            `quiet_braking`) → the same; empty for resamples.
        curves: group → curve of the predictions; empty for resamples.
        dropped: accidents that no braking is judged of, and why: their labels do not show the two near each other.
        skipped: accidents whose motion is not known, and why.
        notes: sentences that a reader of the numbers should know.
    """

    rows: ClassVar[tuple[Row, ...]] = (
        Row("shares/*", "share", "neither", is_headline=False),
        Row("warned", "share", "higher", is_headline=False),
        Row("extrapolated", "share", "neither", is_headline=False),
        Row("braking_seconds_per_minute", "1/min", is_headline=False),
    )
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
        ends: FiguresByLatency = getattr(self.groups[group], self.alarms)
        return next((each[NOMINAL].shares[OUTCOMES[0]] for each in ends.values()), math.nan)


CURVE_ROWS: Final = 101
"""Thresholds of a curve, at most, beside that without an alarm."""
_REACTIONS: Final = tuple(dict.fromkeys(each.reaction for each in BRAKINGS))
_REACTION_OF: Final = np.array([_REACTIONS.index(each.reaction) for each in BRAKINGS])
_NOMINAL_REACTION: Final = int(_REACTION_OF[SETTINGS.index(NOMINAL)])
_SLACK: Final = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Alarms(FrozenArrays):
    """At one threshold: (P, R) column of the first alarm in each accident by reaction, and of the first that lasts.

    And (R, M) braking seconds in the recordings without an accident.
    """

    first: IntArray
    first_lasting: IntArray
    seconds: FloatArray


class AlarmOutcomes:
    """One predictor's scores of one group of recordings with the ends of its accidents, to be asked with any weights.

    Attributes:
        part: (N,) which group of samples each recording is of.
        accident: (P,) rows of the accidents that are judged.
        normal: (M,) rows of the recordings without an accident.
        levels: scores, ascending: all thresholds that differ.
    """

    def __init__(
        self,
        recordings: Sequence[Recording],
        predictor: str,
        scores_of: ScoresOf,
        outcomes: Mapping[str, OutcomeTable],
        draw: int = 0,
    ) -> None:
        """Count what figures at any threshold need; accidents without a table are not judged."""
        self._series = series_of(recordings, predictor, scores_of, draw)
        self.part = np.array([each.part for each in recordings], dtype=np.int64)
        judged = [each.kind == "accident" and each.name in outcomes for each in recordings]
        self.accident, self.normal = np.flatnonzero(judged), np.flatnonzero(~self._series.positive)
        valid = self._series.valid
        self._scores = np.where(valid, self._series.scores, -np.inf)
        self._seconds = valid[self.normal].sum(axis=1) / self._series.fps
        counting = self._scores[np.concatenate([self.accident, self.normal])]
        self.levels = np.unique(counting[np.isfinite(counting)])
        own = [outcomes[recordings[row].name] for row in self.accident.tolist()]
        self._latencies = own[0].latencies if own else (0.0,)
        rows = [
            table.rows(self._frames(recordings[row]))
            for table, row in zip(own, self.accident.tolist(), strict=True)
        ]
        shape = (len(own), len(self._latencies), self._series.scores.shape[1] + 1, len(BRAKINGS))
        self._outcome, self._extrapolated = (
            np.array(
                [getattr(table, name)[:, each] for table, each in zip(own, rows, strict=True)]
            ).reshape(shape)
            for name in ("outcome", "extrapolated")
        )
        self._found: dict[float, _Alarms] = {}

    def __repr__(self) -> str:
        return f"AlarmOutcomes({len(self.accident):,} accidents, {len(self.normal):,} others, {self._series!r})"

    def minutes(self, weight: FloatArray) -> float:
        """Of the recordings without an accident."""
        return float((self._seconds * weight[self.normal]).sum()) / MINUTE

    def costs(self, threshold: float, weight: FloatArray) -> FloatArray:
        """(K,) braking seconds a minute of each setting; NaN without a recording that has no accident."""
        minutes = self.minutes(weight)
        seconds = self._at(threshold).seconds @ weight[self.normal]
        return np.asarray(
            np.array([ratio(each, minutes) for each in seconds.tolist()])[_REACTION_OF]
        )

    def quiet_braking(self, weight: FloatArray) -> float:
        """The lowest threshold within the budget at the nominal reaction; infinite if there is none, NaN without cost.

        A higher threshold splits and shortens runs of alarmed frames alone, so that the cost never rises with it.
        """
        minutes = self.minutes(weight)
        if not minutes:
            return math.nan
        most = BUDGET * minutes + _SLACK

        def is_quiet(threshold: float) -> int:
            return int(
                float(self._at(threshold).seconds[_NOMINAL_REACTION] @ weight[self.normal]) <= most
            )

        place = bisect_left(self.levels.tolist(), 1, key=is_quiet)
        return float(self.levels[place]) if place < len(self.levels) else math.inf

    def ends(
        self, threshold: float, weight: FloatArray, *, lasting: bool = False
    ) -> FiguresByLatency:
        """Latency → setting → figures at a threshold, with (N,) weights of the recordings; all NaN at NaN.

        If `lasting`, alarms warn only if they outlast the reaction time.
        """
        unknown = math.isnan(threshold)
        alarms = self._at(math.inf if unknown else threshold)
        columns = alarms.first_lasting if lasting else alarms.first
        costs = np.full(len(BRAKINGS), math.nan) if unknown else self.costs(threshold, weight)
        counting = weight[self.accident] * (math.nan if unknown else 1.0)
        warned = (
            (counting[:, None] * (columns < self._series.scores.shape[1]))
            .sum(axis=0)[_REACTION_OF]
            .tolist()
        )
        found: dict[float, dict[str, OutcomeFigures]] = {}
        for place, latency in enumerate(self._latencies):
            sums, beyond = self._sums(place, columns, counting)
            found[latency] = {
                setting: _figures(
                    sums[row],
                    float(beyond[row]),
                    warned[row],
                    float(counting.sum()),
                    float(costs[row]),
                )
                for row, setting in enumerate(SETTINGS)
            }
        return found

    def curve(self) -> PreventionCurve:
        """The curve over the thresholds that differ, or over some of them spread evenly."""
        weight = np.ones(len(self.part))
        rows = np.unique(np.rint(np.linspace(0, len(self.levels) - 1, CURVE_ROWS)).astype(np.int64))
        levels = [math.inf, *(self.levels[rows][::-1].tolist() if len(self.levels) else [])]
        counting = weight[self.accident]
        sums = np.array([self._sums(0, self._at(level).first, counting)[0] for level in levels])
        shares = sums / (len(counting) or math.nan)
        return PreventionCurve(
            threshold=np.array(levels),
            braking_seconds_per_minute=np.array([self.costs(level, weight) for level in levels]),
            avoided=shares[:, :, OUTCOMES.index("avoided")],
            mitigated=shares[:, :, OUTCOMES.index("mitigated")],
        )

    def _frames(self, recording: Recording) -> IntArray:
        """(T + 1,) frame number of each column of the scores; −1, no frame, of the one after the last."""
        step = round(1 / (self._series.fps * FRAME_PERIOD))
        return np.append(recording.frame[0] + step * np.arange(self._series.scores.shape[1]), -1)

    def _at(self, threshold: float) -> _Alarms:
        """The alarms at a threshold; kept."""
        if threshold not in self._found:
            alarm, fps = self._scores >= threshold, self._series.fps
            accidents, normal = (
                AlarmRuns.of(alarm[rows], fps) for rows in (self.accident, self.normal)
            )
            first = self._series.first(np.array([threshold]))[self.accident]
            self._found[threshold] = _Alarms(
                first=np.repeat(first, len(_REACTIONS), axis=1),
                first_lasting=np.stack(
                    [accidents.first_lasting(each) for each in _REACTIONS], axis=1
                ),
                seconds=np.stack([normal.braking_seconds(each) for each in _REACTIONS]),
            )
        return self._found[threshold]

    def _sums(
        self, latency: int, columns: IntArray, weight: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """(K, C) weights of the accidents of each class and setting, and (K,) of those that are extrapolated."""
        at = (
            np.arange(len(self.accident))[:, None],
            latency,
            columns[:, _REACTION_OF],
            np.arange(len(BRAKINGS)),
        )
        codes = self._outcome[at]
        sums = [((codes == code) * weight[:, None]).sum(axis=0) for code in range(len(OUTCOMES))]
        return np.stack(sums, axis=1), (self._extrapolated[at] * weight[:, None]).sum(axis=0)


def _figures(
    sums: FloatArray, beyond: float, warned: float, accidents: float, cost: float
) -> OutcomeFigures:
    known = {name: float(each) for name, each in zip(OUTCOMES, sums, strict=True)}
    return OutcomeFigures(
        warned=ratio(warned, accidents),
        shares={name: ratio(each, accidents) for name, each in known.items()},
        counts={} if math.isnan(accidents) else {name: round(each) for name, each in known.items()},
        extrapolated=ratio(beyond, accidents),
        braking_seconds_per_minute=cost,
    )
