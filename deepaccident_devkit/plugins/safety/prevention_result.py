"""How accidents would have ended (`OutcomeTable`), and which of them braking prevents.

`AlarmOutcomes` returns how accidents end for one predictor's scores, as the threshold of an alarm
moves; `PreventedResult` holds the figures.
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

SETTINGS: Final = tuple(
    f"{braking.reaction:g} s, {braking.deceleration:g} m/s²" for braking in BRAKINGS
)
"""Names of the ways of braking, in the order of `BRAKINGS`: reaction time and deceleration."""
NOMINAL: Final = SETTINGS[BRAKINGS.index(Braking(reaction=1.0, deceleration=6.0))]
"""The setting of the headline, in the middle of the nine."""
BUDGET: Final = 1.0
"""Braking seconds a minute, on recordings without an accident, that the headline allows."""
CURVE_ROWS: Final = 101
"""Largest number of thresholds of a curve, besides the row without an alarm."""
_NO_FRAME: Final = np.iinfo(np.int64).min
_REACTIONS: Final = tuple(dict.fromkeys(braking.reaction for braking in BRAKINGS))
# (K,) index in `_REACTIONS` of each way of braking.
_REACTION_INDEX: Final = np.array([_REACTIONS.index(braking.reaction) for braking in BRAKINGS])
_NOMINAL_REACTION: Final = int(_REACTION_INDEX[SETTINGS.index(NOMINAL)])
# Braking seconds by which a sum of floats may exceed the budget.
_BUDGET_TOLERANCE_S: Final = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OutcomeTable(FrozenArrays):
    """How one accident ends for each moment of the first alarm; arrays are read-only.

    Attributes:
        frame: Frame numbers of possible first alarms, shape (W,), int64, ascending.
        outcome: Indices in `collisions.OUTCOMES`, shape (L, W + 1, K), int8, by latency, first
            alarm and setting; the last of the W + 1 is the outcome without an alarm.
        extrapolated: Whether the two touch only after the recording's end, where both go straight
            on, shape (L, W + 1, K), bool.
        latencies: L seconds from the alarm to the warning of the drivers that brake.
        pedestrian: Whether one of the colliding pair is a pedestrian.
    """

    frame: IntArray
    outcome: IntArray
    extrapolated: BoolArray
    latencies: tuple[float, ...]
    pedestrian: bool = False

    def __post_init__(self) -> None:
        """Check the arrays against each other; raise EvaluationError."""
        FrozenArrays.__post_init__(self)
        shape = (len(self.latencies), len(self.frame) + 1, len(BRAKINGS))
        for name in ("outcome", "extrapolated"):
            actual = np.shape(getattr(self, name))
            if actual != shape:
                raise EvaluationError(
                    f"OutcomeTable.{name}: expected shape {shape}, found {actual}"
                )
        if np.any(np.diff(self.frame) <= 0):
            raise EvaluationError("OutcomeTable.frame: expected ascending frame numbers; sort them")
        if not np.isin(self.outcome, range(len(OUTCOMES))).all():
            raise EvaluationError(
                f"OutcomeTable.outcome: expected positions in OUTCOMES, 0 to {len(OUTCOMES) - 1}"
            )

    def rows(self, frames: IntArray) -> IntArray:
        """Return which of the W + 1 rows a first alarm at each frame has, shape (C,).

        Frames without a sample have the last row.
        """
        position = np.searchsorted(self.frame, frames)
        has_sample = np.append(self.frame, _NO_FRAME)[position] == frames
        return np.where(has_sample, position, len(self.frame))


@dataclass(frozen=True, slots=True, kw_only=True)
class AccidentOutcomes(ShortRepr):
    """The tables of accidents, and the scenarios without one.

    Attributes:
        tables: Recording, such as `type1_subtype1_accident/Town03_…/ego_vehicle` → its accident's
            table, for the drivers that this agent warns.
        dropped: Scenarios that are not judged, as their labels do not show the two near each other
            at the impact.
        skipped: Scenarios with labels or a meta file that do not show how the two move.
    """

    tables: Mapping[str, OutcomeTable] = field(default_factory=dict)
    dropped: tuple[Skipped, ...] = ()
    skipped: tuple[Skipped, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class OutcomeFigures(FrozenMappings):
    """How the accidents of one group end, for one way of braking and one threshold.

    NaN where there is nothing to count.

    Attributes:
        warned: Share of the accidents with an alarm that counts.
        shares: Class of `collisions.OUTCOMES` → share of the accidents; missed ones end as they
            were recorded.
        counts: Class → accidents; empty where the shares are means over draws.
        extrapolated: Share that touches only after the recording's end, where both are assumed to
            go straight on; if the replay ended there, these would count as avoided.
        braking_seconds_per_minute: Cost on recordings without an accident: the length of each run
            of alarmed frames less the reaction time.
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
        threshold: Lowest score that is an alarm; NaN if unknown, infinite if any alarm costs too
            much.
        quiet_braking: Lowest threshold with at most one braking second a minute at a reaction of 1
            s; to be passed when another split is evaluated.
        accidents: Number of judged accidents.
        recordings: Number of recordings without an accident.
        minutes: Their duration, up to where they count.
        right: Figures if the first right alarm warns the drivers.
        any_alarm: Figures if the very first alarm warns them, even if it names other actors or
            another moment.
        lasting: Figures if the first alarm that lasts longer than the reaction warns them. Only
            such alarms cost anything, so alarms that flicker, such as random ones, prevent nothing
            for free.
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
    """Shares prevented against the cost as the threshold falls, without latency.

    The arrays are read-only.

    Attributes:
        threshold: Thresholds, shape (C,), descending; the first is infinite: no alarm.
        braking_seconds_per_minute: Cost in the order of `SETTINGS`, shape (C, K); never falls along
            C.
        avoided: Share of the accidents that do not happen, shape (C, K).
        mitigated: Share of the accidents with a change of speed that is smaller by a tenth or more,
            shape (C, K).
    """

    threshold: FloatArray
    braking_seconds_per_minute: FloatArray
    avoided: FloatArray
    mitigated: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class PreventedResult(FrozenMappings):
    """Prevented accidents, by group (`recordings.GROUPS`).

    Accidents of pedestrians are groups of their own.

    Attributes:
        operating_by: `given` threshold, or `budget`: at most one braking second a minute on these
            very recordings.
        alarms: `right` or `any_alarm`: the kind of alarm of the headline and the curves.
        groups: Group → figures of the predictions.
        references: Reference predictor of `recordings.PREDICTORS` (a random one also at its own
            `quiet_braking`) → group → figures; empty for resamples.
        curves: Group → curve of the predictions; empty for resamples.
        dropped: Accidents without a judgement of braking, and why: their labels do not show the two
            near each other.
        skipped: Accidents with unknown motion, and why.
        notes: Sentences that a reader of the numbers should know.
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
        """Return the headline: the share avoided at `NOMINAL` without latency; NaN for none."""
        by_latency: FiguresByLatency = getattr(self.groups[group], self.alarms)
        for figures in by_latency.values():
            return figures[NOMINAL].shares[OUTCOMES[0]]
        return math.nan


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Alarms(FrozenArrays):
    """The alarms at one threshold.

    Attributes:
        first_column: Column of the first alarm in each accident by reaction, shape (P, R).
        lasting_column: Column of the first alarm that lasts longer than the reaction, shape (P, R).
        seconds: Braking seconds in the recordings without an accident, shape (R, M).
    """

    first_column: IntArray
    lasting_column: IntArray
    seconds: FloatArray


class AlarmOutcomes:
    """One predictor's scores of a group of recordings, with the outcomes of its accidents.

    Every method takes weights of the recordings, so that resamples can be evaluated.

    Attributes:
        part: Group of samples of each recording, shape (N,).
        accident: Rows of the judged accidents, shape (P,).
        normal: Rows of the recordings without an accident, shape (M,).
        levels: All different scores, ascending: the possible thresholds.
    """

    def __init__(
        self,
        recordings: Sequence[Recording],
        predictor: str,
        scores_of: ScoresOf,
        outcomes: Mapping[str, OutcomeTable],
        draw: int = 0,
    ) -> None:
        """Prepare what figures at any threshold need; accidents without a table are not judged."""
        self._series = series_of(recordings, predictor, scores_of, draw)
        self.part = np.array([recording.part for recording in recordings], dtype=np.int64)
        is_judged = [
            recording.kind == "accident" and recording.name in outcomes for recording in recordings
        ]
        self.accident = np.flatnonzero(is_judged)
        self.normal = np.flatnonzero(~self._series.positive)
        valid = self._series.valid
        self._scores = np.where(valid, self._series.scores, -np.inf)
        self._seconds = valid[self.normal].sum(axis=1) / self._series.fps
        counted_scores = self._scores[np.concatenate([self.accident, self.normal])]
        self.levels = np.unique(counted_scores[np.isfinite(counted_scores)])
        accidents = [recordings[row] for row in self.accident.tolist()]
        tables = [outcomes[recording.name] for recording in accidents]
        self._latencies = tables[0].latencies if tables else (0.0,)
        outcome, extrapolated = [], []
        for table, recording in zip(tables, accidents, strict=True):
            rows = table.rows(self._frames(recording))
            outcome.append(table.outcome[:, rows])
            extrapolated.append(table.extrapolated[:, rows])
        columns = self._series.scores.shape[1] + 1
        shape = (len(tables), len(self._latencies), columns, len(BRAKINGS))
        self._outcome = np.array(outcome).reshape(shape)
        self._extrapolated = np.array(extrapolated).reshape(shape)
        self._alarms_by_threshold: dict[float, _Alarms] = {}

    def __repr__(self) -> str:
        accidents, normal = len(self.accident), len(self.normal)
        return f"AlarmOutcomes({accidents:,} accidents, {normal:,} others, {self._series!r})"

    def minutes(self, weight: FloatArray) -> float:
        """Return the weighted duration of the recordings without an accident."""
        return float((self._seconds * weight[self.normal]).sum()) / MINUTE

    def costs(self, threshold: float, weight: FloatArray) -> FloatArray:
        """Return the braking seconds a minute of each setting, shape (K,).

        NaN if every recording has an accident.
        """
        minutes = self.minutes(weight)
        seconds = self._alarms_at(threshold).seconds @ weight[self.normal]
        by_reaction = np.array([ratio(value, minutes) for value in seconds.tolist()])
        return np.asarray(by_reaction[_REACTION_INDEX])

    def quiet_braking(self, weight: FloatArray) -> float:
        """Return the lowest threshold within the budget at the nominal reaction.

        Infinite if there is none, NaN without recordings to measure the cost. A higher threshold
        only splits and shortens runs of alarmed frames, so the cost never rises with it.
        """
        minutes = self.minutes(weight)
        if not minutes:
            return math.nan
        max_seconds = BUDGET * minutes + _BUDGET_TOLERANCE_S

        def is_quiet(threshold: float) -> int:
            by_recording = self._alarms_at(threshold).seconds[_NOMINAL_REACTION]
            return int(float(by_recording @ weight[self.normal]) <= max_seconds)

        position = bisect_left(self.levels.tolist(), 1, key=is_quiet)
        if position < len(self.levels):
            return float(self.levels[position])
        return math.inf

    def ends(
        self, threshold: float, weight: FloatArray, *, lasting: bool = False
    ) -> FiguresByLatency:
        """Return the figures at a threshold, by latency and setting; all NaN at NaN.

        Args:
            threshold: Lowest score that is an alarm.
            weight: Weights of the recordings, shape (N,).
            lasting: Whether only alarms that outlast the reaction time warn.
        """
        is_unknown = math.isnan(threshold)
        alarms = self._alarms_at(math.inf if is_unknown else threshold)
        columns = alarms.lasting_column if lasting else alarms.first_column
        accident_weight = weight[self.accident] * (math.nan if is_unknown else 1.0)
        if is_unknown:
            costs = np.full(len(BRAKINGS), math.nan)
        else:
            costs = self.costs(threshold, weight)
        has_alarm = columns < self._series.scores.shape[1]
        warned_by_reaction = (accident_weight[:, None] * has_alarm).sum(axis=0)
        warned = warned_by_reaction[_REACTION_INDEX].tolist()
        total = float(accident_weight.sum())
        by_latency: dict[float, dict[str, OutcomeFigures]] = {}
        for index, latency in enumerate(self._latencies):
            sums, extrapolated = self._sums(index, columns, accident_weight)
            by_latency[latency] = {
                setting: _figures(
                    sums[row], float(extrapolated[row]), warned[row], total, float(costs[row])
                )
                for row, setting in enumerate(SETTINGS)
            }
        return by_latency

    def curve(self) -> PreventionCurve:
        """Return the curve over all different thresholds, or over some of them spread evenly."""
        weight = np.ones(len(self.part))
        positions = np.linspace(0, len(self.levels) - 1, CURVE_ROWS)
        rows = np.unique(np.rint(positions).astype(np.int64))
        levels = [math.inf]
        if len(self.levels):
            levels += self.levels[rows][::-1].tolist()
        accident_weight = weight[self.accident]
        sums = []
        for level in levels:
            class_sums, _ = self._sums(0, self._alarms_at(level).first_column, accident_weight)
            sums.append(class_sums)
        shares = np.array(sums) / (len(accident_weight) or math.nan)
        return PreventionCurve(
            threshold=np.array(levels),
            braking_seconds_per_minute=np.array([self.costs(level, weight) for level in levels]),
            avoided=shares[:, :, OUTCOMES.index("avoided")],
            mitigated=shares[:, :, OUTCOMES.index("mitigated")],
        )

    def _frames(self, recording: Recording) -> IntArray:
        """Return the frame number of each column of the scores, shape (T + 1,).

        The column after the last one has −1, which is no frame.
        """
        step = round(1 / (self._series.fps * FRAME_PERIOD))
        return np.append(recording.frame[0] + step * np.arange(self._series.scores.shape[1]), -1)

    def _alarms_at(self, threshold: float) -> _Alarms:
        """Return the alarms at a threshold, which are cached."""
        if threshold not in self._alarms_by_threshold:
            alarm, fps = self._scores >= threshold, self._series.fps
            accident_runs = AlarmRuns.of(alarm[self.accident], fps)
            normal_runs = AlarmRuns.of(alarm[self.normal], fps)
            first_column = self._series.first(np.array([threshold]))[self.accident]
            lasting_columns = [accident_runs.first_lasting(reaction) for reaction in _REACTIONS]
            seconds = [normal_runs.braking_seconds(reaction) for reaction in _REACTIONS]
            self._alarms_by_threshold[threshold] = _Alarms(
                first_column=np.repeat(first_column, len(_REACTIONS), axis=1),
                lasting_column=np.stack(lasting_columns, axis=1),
                seconds=np.stack(seconds),
            )
        return self._alarms_by_threshold[threshold]

    def _sums(
        self, latency_index: int, columns: IntArray, weight: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the weights of the accidents by setting and class, and of the extrapolated ones.

        Shapes are (K, C) and (K,).
        """
        index = (
            np.arange(len(self.accident))[:, None],
            latency_index,
            columns[:, _REACTION_INDEX],
            np.arange(len(BRAKINGS)),
        )
        codes = self._outcome[index]
        column_weight = weight[:, None]
        sums = [((codes == code) * column_weight).sum(axis=0) for code in range(len(OUTCOMES))]
        extrapolated = (self._extrapolated[index] * column_weight).sum(axis=0)
        return np.stack(sums, axis=1), extrapolated


def _figures(
    sums: FloatArray, extrapolated: float, warned: float, accidents: float, cost: float
) -> OutcomeFigures:
    by_class = {name: float(value) for name, value in zip(OUTCOMES, sums, strict=True)}
    counts: dict[str, int] = {}
    if not math.isnan(accidents):
        counts = {name: round(value) for name, value in by_class.items()}
    return OutcomeFigures(
        warned=ratio(warned, accidents),
        shares={name: ratio(value, accidents) for name, value in by_class.items()},
        counts=counts,
        extrapolated=ratio(extrapolated, accidents),
        braking_seconds_per_minute=cost,
    )
