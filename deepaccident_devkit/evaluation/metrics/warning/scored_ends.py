"""`ScoredEnds`: how the accidents of one group end as the threshold of an alarm moves, and the braking for nothing."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from deepaccident_devkit.arrays import FloatArray, FrozenArrays, IntArray
from deepaccident_devkit.evaluation.metrics.evaluator import ratio
from deepaccident_devkit.evaluation.metrics.warning.cost import MINUTE, AlarmRuns
from deepaccident_devkit.evaluation.metrics.warning.prevention import (
    BUDGET,
    NOMINAL,
    SETTINGS,
    Ends,
    OutcomeFigures,
    OutcomeTable,
    PreventionCurve,
)
from deepaccident_devkit.evaluation.metrics.warning.recordings import Drive, ScoresOf, series_of
from deepaccident_devkit.safety import BRAKINGS, OUTCOMES
from deepaccident_devkit.taxonomy import FRAME_PERIOD

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


class ScoredEnds:
    """One predictor's scores of one group of recordings with the ends of its accidents, to be asked with any weights.

    Attributes:
        part: (N,) which group of samples each recording is of.
        accident: (P,) rows of the accidents that are judged.
        normal: (M,) rows of the recordings without an accident.
        levels: scores, ascending: all thresholds that differ.
    """

    def __init__(
        self,
        drives: Sequence[Drive],
        predictor: str,
        scores_of: ScoresOf,
        outcomes: Mapping[str, OutcomeTable],
        draw: int = 0,
    ) -> None:
        """Count what figures at any threshold need.

        Args:
            drives: the recordings.
            predictor: of `PREDICTORS`.
            scores_of: whose alarms count where somebody collides.
            outcomes: recording → how its accident ends; accidents without a table are not judged.
            draw: of a random predictor.
        """
        self._series = series_of(drives, predictor, scores_of, draw)
        self.part = np.array([each.part for each in drives], dtype=np.int64)
        judged = [each.kind == "accident" and each.name in outcomes for each in drives]
        self.accident, self.normal = np.flatnonzero(judged), np.flatnonzero(~self._series.positive)
        valid = self._series.valid
        self._scores = np.where(valid, self._series.scores, -np.inf)
        self._seconds = valid[self.normal].sum(axis=1) / self._series.fps
        counting = self._scores[np.concatenate([self.accident, self.normal])]
        self.levels = np.unique(counting[np.isfinite(counting)])
        own = [outcomes[drives[row].name] for row in self.accident.tolist()]
        self._latencies = own[0].latencies if own else (0.0,)
        rows = [table.rows(self._frames(drives[row])) for table, row in zip(own, self.accident.tolist(), strict=True)]
        shape = (len(own), len(self._latencies), self._series.scores.shape[1] + 1, len(BRAKINGS))
        self._outcome, self._extrapolated = (
            np.array([getattr(table, name)[:, each] for table, each in zip(own, rows, strict=True)]).reshape(shape)
            for name in ("outcome", "extrapolated")
        )
        self._found: dict[float, _Alarms] = {}

    def __repr__(self) -> str:
        return f"ScoredEnds({len(self.accident):,} accidents, {len(self.normal):,} others, {self._series!r})"

    def minutes(self, weight: FloatArray) -> float:
        """Of the recordings without an accident."""
        return float((self._seconds * weight[self.normal]).sum()) / MINUTE

    def costs(self, threshold: float, weight: FloatArray) -> FloatArray:
        """(K,) braking seconds a minute of each setting; NaN without a recording that has no accident."""
        minutes = self.minutes(weight)
        seconds = self._at(threshold).seconds @ weight[self.normal]
        costs: FloatArray = np.array([ratio(each, minutes) for each in seconds.tolist()])[_REACTION_OF]
        return costs

    def quiet_braking(self, weight: FloatArray) -> float:
        """The lowest threshold within the budget at the nominal reaction; infinite if there is none, NaN without cost.

        A higher threshold splits and shortens runs of alarmed frames alone, so that the cost never rises with it.
        """
        minutes = self.minutes(weight)
        if not minutes:
            return math.nan
        most = BUDGET * minutes + _SLACK

        def is_quiet(threshold: float) -> int:
            return int(float(self._at(threshold).seconds[_NOMINAL_REACTION] @ weight[self.normal]) <= most)

        place = bisect_left(self.levels.tolist(), 1, key=is_quiet)
        return float(self.levels[place]) if place < len(self.levels) else math.inf

    def ends(self, threshold: float, weight: FloatArray, *, lasting: bool = False) -> Ends:
        """Latency → setting → figures at a threshold; all NaN at NaN.

        Args:
            threshold: the lowest score that is an alarm.
            weight: (N,) how often each recording counts.
            lasting: whether alarms warn only if they outlast the reaction time.
        """
        unknown = math.isnan(threshold)
        alarms = self._at(math.inf if unknown else threshold)
        columns = alarms.first_lasting if lasting else alarms.first
        costs = np.full(len(BRAKINGS), math.nan) if unknown else self.costs(threshold, weight)
        counting = weight[self.accident] * (math.nan if unknown else 1.0)
        warned = (counting[:, None] * (columns < self._series.scores.shape[1])).sum(axis=0)[_REACTION_OF].tolist()
        found: dict[float, dict[str, OutcomeFigures]] = {}
        for place, latency in enumerate(self._latencies):
            sums, beyond = self._sums(place, columns, counting)
            found[latency] = {
                setting: _figures(sums[row], float(beyond[row]), warned[row], float(counting.sum()), float(costs[row]))
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

    def _frames(self, drive: Drive) -> IntArray:
        """(T + 1,) frame number of each column of the scores; −1, no frame, of the one after the last."""
        step = round(1 / (self._series.fps * FRAME_PERIOD))
        columns = self._series.scores.shape[1]
        return np.append(drive.frame[0] + step * np.arange(columns), -1)

    def _at(self, threshold: float) -> _Alarms:
        """The alarms at a threshold; kept."""
        if threshold not in self._found:
            alarm, fps = self._scores >= threshold, self._series.fps
            accidents, normal = (AlarmRuns.of(alarm[rows], fps) for rows in (self.accident, self.normal))
            first = self._series.first(np.array([threshold]))[self.accident]
            self._found[threshold] = _Alarms(
                first=np.repeat(first, len(_REACTIONS), axis=1),
                first_lasting=np.stack([accidents.first_lasting(each) for each in _REACTIONS], axis=1),
                seconds=np.stack([normal.braking_seconds(each) for each in _REACTIONS]),
            )
        return self._found[threshold]

    def _sums(self, latency: int, columns: IntArray, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(K, C) weights of the accidents of each class and setting, and (K,) of those that are extrapolated."""
        at = (np.arange(len(self.accident))[:, None], latency, columns[:, _REACTION_OF], np.arange(len(BRAKINGS)))
        codes = self._outcome[at]
        sums = [((codes == code) * weight[:, None]).sum(axis=0) for code in range(len(OUTCOMES))]
        return np.stack(sums, axis=1), (self._extrapolated[at] * weight[:, None]).sum(axis=0)


def _figures(sums: FloatArray, beyond: float, warned: float, accidents: float, cost: float) -> OutcomeFigures:
    known = {name: float(each) for name, each in zip(OUTCOMES, sums, strict=True)}
    return OutcomeFigures(
        warned=ratio(warned, accidents),
        shares={name: ratio(each, accidents) for name, each in known.items()},
        counts={} if math.isnan(accidents) else {name: round(each) for name, each in known.items()},
        extrapolated=ratio(beyond, accidents),
        braking_seconds_per_minute=cost,
    )
