"""How accidents would have ended (`OutcomeTable`), and which of them braking prevents.

`AlarmOutcomes` computes how accidents end at any threshold on a predictor's scores.
`PreventedResult` contains the figures.
"""

import math
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import repeat
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
"""Names of the ways of braking (reaction time and deceleration), in the order of `BRAKINGS`."""
NOMINAL: Final = SETTINGS[BRAKINGS.index(Braking(reaction=1.0, deceleration=6.0))]
"""The setting used for the headline; the middle of the nine."""
BUDGET: Final = 1.0
"""Largest cost that the headline allows: braking seconds per minute without an accident."""
CURVE_ROWS: Final = 101
"""Largest number of thresholds on a curve, not counting the row without an alarm."""
# A number that no frame has.
_NO_FRAME = np.iinfo(np.int64).min
# The R distinct reaction times in seconds.
_REACTIONS = tuple(dict.fromkeys(braking.reaction for braking in BRAKINGS))
# Index into `_REACTIONS` for each way of braking, shape (K,).
_REACTION_INDEX = np.array([_REACTIONS.index(braking.reaction) for braking in BRAKINGS])
_NOMINAL_REACTION = int(_REACTION_INDEX[SETTINGS.index(NOMINAL)])
# Rounding error in seconds by which a sum of braking seconds may exceed the budget.
_BUDGET_TOLERANCE_S = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OutcomeTable(FrozenArrays):
    """Outcomes of one accident by the time of the first alarm; arrays are read-only.

    Attributes:
        frame: Frame numbers of possible first alarms, shape (W,), int64, ascending.
        outcome: Indices into `collisions.OUTCOMES`, shape (L, W + 1, K), int8, by latency, first
            alarm and setting; the last column (W) is the outcome without an alarm.
        extrapolated: Whether the two only touch after the recording's end, where both are assumed
            to go straight on, shape (L, W + 1, K), bool.
        latencies: The L latencies: seconds from the alarm until the drivers are warned.
        pedestrian: Whether one of the two colliders is a pedestrian.
    """

    frame: IntArray
    outcome: IntArray
    extrapolated: BoolArray
    latencies: tuple[float, ...]
    pedestrian: bool = False

    def __post_init__(self) -> None:
        """Raise an EvaluationError if shapes or values of the arrays do not fit together."""
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
        """Return the index, 0..W, of the first alarm that is raised in each frame, shape (C,).

        Frames without a sample get W, which means no alarm.
        """
        position = np.searchsorted(self.frame, frames)
        has_sample = np.append(self.frame, _NO_FRAME)[position] == frames
        return np.where(has_sample, position, len(self.frame))


@dataclass(frozen=True, slots=True, kw_only=True)
class AccidentOutcomes(ShortRepr):
    """The outcomes of accidents, and the scenarios whose outcomes are unknown.

    Attributes:
        tables: Recording, such as `type1_subtype1_accident/Town03_…/ego_vehicle` → outcomes of its
            accident if that agent raises the alarm.
        dropped: Scenarios that are not judged because their labels do not show the two colliders
            near each other at the impact.
        skipped: Scenarios that are not judged because their labels or meta file do not show how the
            two move.
    """

    tables: Mapping[str, OutcomeTable] = field(default_factory=dict)
    dropped: tuple[Skipped, ...] = ()
    skipped: tuple[Skipped, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class OutcomeFigures(FrozenMappings):
    """How the accidents of one group end with one way of braking, at one threshold.

    Values are NaN if there is nothing to count.

    Attributes:
        warned: Share of the accidents with an alarm that warns a driver.
        shares: Outcome of `collisions.OUTCOMES` → share of the accidents; accidents without an
            alarm end as they were recorded.
        counts: Outcome → number of accidents; empty if the shares are means over draws.
        extrapolated: Share of the accidents with contact only after the recording's end, if both go
            straight on; they would count as avoided if the replay ended with the recording.
        braking_seconds_per_minute: Cost on recordings without an accident, in which each run of
            alarmed frames costs its length less the reaction time.
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
    """What the alarms of one predictor prevent in one group of recordings.

    Attributes:
        threshold: Lowest score that counts as an alarm; NaN if unknown, infinite if every alarm is
            too costly.
        quiet_braking: Lowest threshold that costs at most one braking second per minute at a
            reaction time of 1 s; pass it when another split is evaluated.
        accidents: Number of judged accidents.
        recordings: Number of recordings without an accident.
        minutes: Counted duration of these recordings, in minutes.
        right: Figures if the first right alarm warns the drivers.
        any_alarm: Figures if the first alarm warns the drivers, even if it names other actors or
            another time.
        lasting: Figures if the first alarm that lasts longer than the reaction time warns the
            drivers. Shorter alarms cost nothing; here they prevent nothing either, so flickering
            (such as random) alarms gain nothing for free.
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
    """Shares prevented and costs at decreasing thresholds, without latency; read-only arrays.

    Attributes:
        threshold: Thresholds, shape (C,), descending; the first is infinite (no alarm).
        braking_seconds_per_minute: Cost by threshold and setting (`SETTINGS`), shape (C, K); it
            never decreases along C.
        avoided: Share of the accidents that are avoided, shape (C, K).
        mitigated: Share of the accidents whose delta-v falls by at least a tenth, shape (C, K).
    """

    threshold: FloatArray
    braking_seconds_per_minute: FloatArray
    avoided: FloatArray
    mitigated: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class PreventedResult(FrozenMappings):
    """Prevented accidents by group (`recordings.GROUPS`).

    Accidents with a pedestrian are in separate groups.

    Attributes:
        operating_by: `given` if the caller passed the threshold, `budget` if it was chosen on these
            same recordings to cost at most one braking second per minute.
        alarms: Kind of alarm used for the headline and the curves, `right` or `any_alarm`.
        groups: Group → figures of the predictions.
        references: Reference predictor of `recordings.PREDICTORS` (random ones also at their own
            `quiet_braking` threshold) → group → figures; empty for resamples.
        curves: Group → curve of the predictions; empty for resamples.
        dropped: Accidents that are not judged because their labels do not show the two colliders
            near each other, and the reasons.
        skipped: Accidents in which the motion is unknown, and the reasons.
        notes: Sentences that a reader of the figures should know.
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
        """Return the headline: the share avoided at `NOMINAL` with no latency; NaN if unknown."""
        figures_by_latency: FiguresByLatency = getattr(self.groups[group], self.alarms)
        for figures_by_setting in figures_by_latency.values():
            return figures_by_setting[NOMINAL].shares[OUTCOMES[0]]
        return math.nan


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Alarms(FrozenArrays):
    """The alarms at one threshold, for P accidents and M recordings without one.

    Attributes:
        first_column: Column of the scores at which the first alarm is raised, by accident and
            reaction time, shape (P, R).
        lasting_column: Columns of the first alarm that lasts longer than the reaction time.
        seconds: Braking seconds by reaction time and accident-free recording, shape (R, M).
    """

    first_column: IntArray
    lasting_column: IntArray
    seconds: FloatArray


class AlarmOutcomes:
    """Outcomes of accidents at any threshold on a predictor's scores, for N recordings.

    The methods take weights of the recordings, so that resamples can be evaluated.

    Attributes:
        part: Index of the group of samples that each recording is in, shape (N,).
        accident: Indices of the recordings with a judged accident, shape (P,).
        normal: Indices of the recordings without an accident, shape (M,).
        levels: The distinct scores, ascending; these are the possible thresholds.
    """

    def __init__(
        self,
        recordings: Sequence[Recording],
        predictor: str,
        scores_of: ScoresOf,
        outcomes: Mapping[str, OutcomeTable],
        draw: int = 0,
    ) -> None:
        """Collect the scores and outcomes.

        Args:
            recordings: The recordings.
            predictor: Name of the predictor.
            scores_of: Kind of scores to use.
            outcomes: Recording → outcomes of its accident; accidents without an entry
                are not judged.
            draw: Index of the draw, for a random predictor.
        """
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
        outcome = []
        extrapolated = []
        for table, recording in zip(tables, accidents, strict=True):
            rows = table.rows(self._frame_numbers(recording))
            outcome.append(table.outcome[:, rows])
            extrapolated.append(table.extrapolated[:, rows])
        columns = self._series.scores.shape[1] + 1
        shape = (len(tables), len(self._latencies), columns, len(BRAKINGS))
        self._outcome = np.array(outcome).reshape(shape)
        self._extrapolated = np.array(extrapolated).reshape(shape)
        self._alarms_by_threshold: dict[float, _Alarms] = {}

    def __repr__(self) -> str:
        """Return the numbers of accidents and of other recordings, and the kind of scores."""
        accidents = len(self.accident)
        others = len(self.normal)
        return f"AlarmOutcomes({accidents:,} accidents, {others:,} others, {self._series!r})"

    def minutes(self, weight: FloatArray) -> float:
        """Return the weighted duration of the recordings without an accident, in minutes."""
        seconds = (self._seconds * weight[self.normal]).sum()
        return float(seconds) / MINUTE

    def costs(self, threshold: float, weight: FloatArray) -> FloatArray:
        """Return the braking seconds per minute at each setting, shape (K,).

        All are NaN if every recording has an accident.
        """
        minutes = self.minutes(weight)
        seconds = self._alarms_at(threshold).seconds @ weight[self.normal]
        by_reaction = np.array([ratio(value, minutes) for value in seconds.tolist()])
        return np.asarray(by_reaction[_REACTION_INDEX])

    def quiet_braking(self, weight: FloatArray) -> float:
        """Return the lowest threshold that is within the budget at the nominal reaction time.

        It is infinite if no threshold is, and NaN if no recording shows the cost. The cost never
        rises with the threshold: a higher one only splits and shortens runs of alarmed frames.
        """
        minutes = self.minutes(weight)
        if not minutes:
            return math.nan
        max_seconds = BUDGET * minutes + _BUDGET_TOLERANCE_S

        def is_quiet(threshold: float) -> int:
            """Return 1 if a threshold is within the budget, otherwise 0."""
            by_recording = self._alarms_at(threshold).seconds[_NOMINAL_REACTION]
            seconds = float(by_recording @ weight[self.normal])
            return int(seconds <= max_seconds)

        levels: list[float] = [*self.levels.tolist(), math.inf]
        position = bisect_left(levels, 1, hi=len(self.levels), key=is_quiet)
        return levels[position]

    def ends(
        self, threshold: float, weight: FloatArray, *, lasting: bool = False
    ) -> FiguresByLatency:
        """Return the figures at a threshold by latency and setting; all NaN if `threshold` is NaN.

        Args:
            threshold: Lowest score that counts as an alarm.
            weight: Weight of each recording, shape (N,).
            lasting: Whether only alarms that last longer than the reaction time warn the drivers.
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
        warned = warned_by_reaction[_REACTION_INDEX]
        total = float(accident_weight.sum())
        figures_by_latency = {}
        for index, latency in enumerate(self._latencies):
            sums, extrapolated = self._sum_outcomes(index, columns, accident_weight)
            figures = map(_make_figures, sums, extrapolated, warned, costs, repeat(total))
            figures_by_latency[latency] = dict(zip(SETTINGS, figures, strict=True))
        return figures_by_latency

    def curve(self) -> PreventionCurve:
        """Compute the curve over all possible thresholds, or over `CURVE_ROWS` of them if more."""
        weight = np.ones(len(self.part))
        positions = np.linspace(0, len(self.levels) - 1, CURVE_ROWS)
        rows = np.unique(np.rint(positions).astype(np.int64))
        levels = [math.inf]
        if len(self.levels):
            levels += self.levels[rows][::-1].tolist()
        accident_weight = weight[self.accident]
        sums = []
        costs = []
        for level in levels:
            columns = self._alarms_at(level).first_column
            outcome_sums, _ = self._sum_outcomes(0, columns, accident_weight)
            sums.append(outcome_sums)
            costs.append(self.costs(level, weight))
        shares = np.array(sums) / (len(accident_weight) or math.nan)
        return PreventionCurve(
            threshold=np.array(levels),
            braking_seconds_per_minute=np.array(costs),
            avoided=shares[:, :, OUTCOMES.index("avoided")],
            mitigated=shares[:, :, OUTCOMES.index("mitigated")],
        )

    def _frame_numbers(self, recording: Recording) -> IntArray:
        """Return the frame number of each column of the scores, shape (T + 1,).

        The additional last column means no alarm; its value is −1.
        """
        step = round(1 / (self._series.fps * FRAME_PERIOD))
        columns = np.arange(self._series.scores.shape[1])
        return np.append(recording.frame[0] + step * columns, -1)

    def _alarms_at(self, threshold: float) -> _Alarms:
        """Return the alarms at a threshold; the result is cached."""
        if threshold not in self._alarms_by_threshold:
            fps = self._series.fps
            is_alarm = self._scores >= threshold
            accident_runs = AlarmRuns.of(is_alarm[self.accident], fps)
            normal_runs = AlarmRuns.of(is_alarm[self.normal], fps)
            first_column = self._series.first(np.array([threshold]))[self.accident]
            lasting_columns = [accident_runs.first_lasting(reaction) for reaction in _REACTIONS]
            seconds = [normal_runs.braking_seconds(reaction) for reaction in _REACTIONS]
            self._alarms_by_threshold[threshold] = _Alarms(
                first_column=np.repeat(first_column, len(_REACTIONS), axis=1),
                lasting_column=np.stack(lasting_columns, axis=1),
                seconds=np.stack(seconds),
            )
        return self._alarms_by_threshold[threshold]

    def _sum_outcomes(
        self, latency_index: int, columns: IntArray, weight: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Sum the weights of accidents by setting and outcome, and of extrapolated contacts.

        The shapes are (K, 5) and (K,).
        """
        index = (
            np.arange(len(self.accident))[:, None],
            latency_index,
            columns[:, _REACTION_INDEX],
            np.arange(len(BRAKINGS)),
        )
        codes = self._outcome[index]
        column_weight = weight[:, None]
        sums = []
        for code in range(len(OUTCOMES)):
            has_outcome = codes == code
            sums.append((has_outcome * column_weight).sum(axis=0))
        extrapolated = (self._extrapolated[index] * column_weight).sum(axis=0)
        return np.stack(sums, axis=1), extrapolated


def _make_figures(
    sums: FloatArray, extrapolated: float, warned: float, cost: float, accidents: float
) -> OutcomeFigures:
    """Turn weighted sums into the figures for one way of braking.

    Args:
        sums: Summed weight of the accidents by outcome, shape (5,).
        extrapolated: Summed weight of the accidents with contact only after the recording's end.
        warned: Summed weight of the accidents with an alarm.
        cost: Braking seconds per minute.
        accidents: Summed weight of all accidents.
    """
    shares = {}
    counts = {}
    for name, value in zip(OUTCOMES, sums.tolist(), strict=True):
        shares[name] = ratio(value, accidents)
        if not math.isnan(accidents):
            counts[name] = round(value)
    return OutcomeFigures(
        warned=ratio(float(warned), accidents),
        shares=shares,
        counts=counts,
        extrapolated=ratio(float(extrapolated), accidents),
        braking_seconds_per_minute=float(cost),
    )
