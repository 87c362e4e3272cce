"""`CleanWarnings`: anticipation metrics in which a siren, silence or chance cannot win (protocol `clean`)."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import partial
from typing import Any, Final, get_args

import numpy as np

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.evaluation.evaluator import Counts, ratio
from deepaccident_devkit.evaluation.task import FrozenMappings
from deepaccident_devkit.evaluation.warning.clean import CleanScores, OperatingPoint
from deepaccident_devkit.evaluation.warning.recordings import (
    GIVEN,
    GROUPS,
    KINDS,
    PREDICTORS,
    Recording,
    ScoresOf,
    by_group,
    left_out_notes,
    parts_of,
    recordings_of,
    series_of,
    twin_pairs,
)
from deepaccident_devkit.evaluation.warning.result import WarningResult
from deepaccident_devkit.support.arrays import FloatArray, IntArray
from deepaccident_devkit.support.text import settle_choices

RANDOM_DRAWS: Final = 20
# Seconds that a warning may need from an agent that sees the danger to the two that collide.
LATENCIES: Final = (0.0, 0.1, 0.3)
_ANY: Final = float(np.nextafter(0.0, 1.0))
_FIXED: Final[Mapping[str, float]] = {
    "always": 1.0,
    "never": 1.0,
    "random per frame": 0.5,
    "random per recording": 0.5,
}


def reference_threshold(predictor: str) -> float:
    """The operating point of one of `PREDICTORS` but the given one: of those that know the present any alarm is one."""
    return _FIXED.get(predictor, _ANY)


@dataclass(frozen=True, slots=True, kw_only=True)
class AnticipationFigures(FrozenMappings):
    """How well one predictor foresees the accidents of one group of recordings. NaN: nothing to count.

    Attributes:
        auc_ahead: the headline: the chance that an accident recording's score is above another recording's as long
            before the end, ties half, mean over the moments of the last 3 seconds. 0.5 for always and never, and
            on average for chance.
        twin_wins: the chance that an accident recording's highest score is above its twin's, ties half; a twin is cut
            to the accident's length.
        average_precision: AP over recordings, by their highest scores; depends on how many of each there are.
        area_under_curve: AUC, likewise up to the impact.
        mean_time: mTTA over the curve of recall, seconds; a missed recording is in no time, so read it beside the AP.
        operating: the figures at the operating point: the threshold that was given; without one that of `at_r80`, or of
            the highest recall where 0.8 is not reached.
        at_r80: at the highest threshold with a recall of 0.8; NaN where none has it.
        at_p80: at the threshold of the highest recall with a precision of 0.8.
        best_f1: threshold: of the best F1 over these recordings; to be given when another split is evaluated.
        quiet: threshold: the lowest with at most one second a minute in alarm without an accident to come; likewise.
        tta0_after: for agents that see an accident of others: latency → seconds of `operating.tta0` that are left when
            the two that collide receive the warning, at least 0; empty for `ego_involved`.
        recordings: by kind: `accident`, `twins`, `others`.
        twins: pairs of an accident recording and its twin.
    """

    auc_ahead: float
    twin_wins: float
    average_precision: float
    area_under_curve: float
    mean_time: float
    operating: OperatingPoint
    at_r80: OperatingPoint
    at_p80: OperatingPoint
    best_f1: float
    quiet: float
    tta0_after: Mapping[float, float]
    recordings: Mapping[str, int]
    twins: int


@dataclass(frozen=True, slots=True, kw_only=True)
class AnticipationResult(WarningResult):
    """The result of the protocol `clean`.

    Attributes:
        samples: how many.
        operating_by: `given` threshold, or `recall`.
        groups: involvement of the agent → figures; agents of one scenario are never pooled.
        references: predictor (of `PREDICTORS` but the given one) → the same; empty for resamples.
        beyond: alarms for later than the horizon, which do not count.
        notes: sentences that a reader of the numbers should know.
    """

    samples: int
    operating_by: str
    groups: Mapping[str, AnticipationFigures]
    references: Mapping[str, Mapping[str, AnticipationFigures]]
    beyond: int
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class CleanWarnings:
    """The accidents that are foreseen, recording by recording, without the quirks of published anticipation metrics.

    A recording's score at a sample is that of its surest alarm, below all thresholds without one; from the impact on
    nothing counts.

    Attributes:
        scores_of: whose alarms count where somebody collides: those of the `pair` that does (right ones), or all of the
            `recording`, for predictors that name nobody. Where nobody collides, all do.
        threshold: the lowest score that is an alarm, chosen on another split (`best_f1` or `quiet` there); None if none
            was.
    """

    scores_of: ScoresOf = "pair"
    threshold: float | None = None

    def __post_init__(self) -> None:
        """Check the values; raises ChoiceError or ConfigError."""
        settle_choices(self, {"scores_of": get_args(ScoresOf)})
        if self.threshold is not None and not math.isfinite(self.threshold):
            raise ConfigError(f"threshold: expected a number, or None, found {self.threshold!r}")

    def result(self, counts: Collection[Counts], *, references: bool = False) -> AnticipationResult:
        """The metrics of some samples' counts, with those of the reference predictors or without."""
        parts = parts_of(counts)
        recordings, samples = recordings_of(parts), [sample for part in parts for sample in part]
        groups = dict(by_group(recordings))
        made = {
            predictor: {group: _figures(those, predictor, self) for group, those in groups.items()}
            for predictor in (PREDICTORS if references else PREDICTORS[:1])
        }
        return AnticipationResult(
            samples=len(samples),
            operating_by="recall" if self.threshold is None else "given",
            groups=made.pop(GIVEN),
            references=made,
            beyond=sum(each["beyond"] for each in samples),
            notes=tuple(_notes(samples, recordings, self)),
        )

    def resampled(
        self, parts: Sequence[Sequence[Counts]], times: IntArray
    ) -> Iterator[AnticipationResult]:
        """The result of each draw, without references; see `Evaluator.resampled`."""
        tables = {
            group: _Table(those, GIVEN, self) for group, those in by_group(recordings_of(parts))
        }
        samples, beyond = (
            np.array([sum(count(each) for each in part) for part in parts], dtype=np.int64)
            for count in (lambda _: 1, lambda each: each["beyond"])
        )
        for draw in times:
            yield AnticipationResult(
                samples=int(samples @ draw),
                operating_by="recall" if self.threshold is None else "given",
                groups={group: table.figures(draw) for group, table in tables.items()},
                references={},
                beyond=int(beyond @ draw),
            )


class _Table:
    """One predictor's scores of one group of recordings, to be asked with any weights."""

    def __init__(
        self, recordings: Sequence[Recording], predictor: str, rules: CleanWarnings, draw: int = 0
    ) -> None:
        self._predictor, self._rules = predictor, rules
        series = series_of(recordings, predictor, rules.scores_of, draw)
        everyone = (
            None
            if rules.scores_of == "recording"
            else series_of(recordings, predictor, "recording", draw).highest()
        )
        self._scores = CleanScores(series, everyone)
        self._pairs = twin_pairs(recordings)
        self._part = np.array([each.part for each in recordings], dtype=np.int64)
        self._kind = np.array([each.kind for each in recordings])
        self._sees_others = recordings[0].group not in (GROUPS[0], GROUPS[-1])

    def figures(self, draw: IntArray | None = None) -> AnticipationFigures:
        """The figures of recordings that count as often as their part is drawn; None for once each."""
        weight = np.ones(len(self._part)) if draw is None else draw[self._part].astype(np.float64)
        scores = self._scores
        r80 = scores.threshold_of_recall(weight)
        operating = self._rules.threshold
        if self._predictor != GIVEN:
            operating = reference_threshold(self._predictor)
        if operating is None:
            threshold = scores.threshold_of_highest_recall(weight) if math.isnan(r80) else r80
        else:
            threshold = operating
        after = partial(scores.tta0_after, threshold, weight)
        return AnticipationFigures(
            auc_ahead=scores.area_at_moments(weight),
            twin_wins=self._twin_wins(weight),
            average_precision=scores.average_precision(weight),
            area_under_curve=scores.area_under_curve(weight),
            mean_time=scores.mean_time(weight),
            operating=scores.at(threshold, weight),
            at_r80=scores.at(r80, weight),
            at_p80=scores.at(scores.threshold_of_precision(weight), weight),
            best_f1=scores.threshold_of_best_f1(weight),
            quiet=scores.threshold_of_alarm_time(weight),
            tta0_after={latency: after(latency) for latency in LATENCIES}
            if self._sees_others
            else {},
            recordings={kind: int(weight[self._kind == kind].sum()) for kind in KINDS},
            twins=int(weight[self._pairs[:, 0]].sum()),
        )

    def _twin_wins(self, weight: FloatArray) -> float:
        accident, twin = (self._scores.highest[self._pairs[:, side]] for side in (0, 1))
        pairs = weight[self._pairs[:, 0]]
        won = np.where(accident == twin, 0.5, accident > twin)
        return ratio(float((won * pairs).sum()), float(pairs.sum()))


def _figures(
    recordings: Sequence[Recording], predictor: str, rules: CleanWarnings
) -> AnticipationFigures:
    """One predictor's figures; of a random one their means over some draws, so that no luck ranks it."""
    drawn = [
        _Table(recordings, predictor, rules, draw).figures() for draw in range(draws_of(predictor))
    ]
    return drawn[0] if len(drawn) == 1 else mean_of(drawn)


def draws_of(predictor: str) -> int:
    """How many draws a predictor's figures are means of: several of a random one, so that no luck ranks it."""
    return RANDOM_DRAWS if predictor.startswith("random") else 1


def mean_of(parts: Sequence[Any]) -> Any:
    """Of floats, and of those in mappings and dataclasses of one form, NaN left out. All else is as in the first."""
    first = parts[0]
    if isinstance(first, float):
        known = [each for each in parts if not math.isnan(each)]
        return math.fsum(known) / len(known) if known else math.nan
    if isinstance(first, Mapping):
        return {name: mean_of([each[name] for each in parts]) for name in first}
    if is_dataclass(first) and not isinstance(first, type):
        return replace(
            first,
            **{
                each.name: mean_of([getattr(part, each.name) for part in parts])
                for each in fields(first)
            },
        )
    return first


def _notes(
    counts: Collection[Counts], recordings: Sequence[Recording], rules: CleanWarnings
) -> Iterator[str]:
    kinds = {each.kind for each in recordings}
    if recordings and "accident" not in kinds:
        yield "no recording of an accident was evaluated; give accident scenarios too for warnings"
    if recordings and kinds == {"accident"}:
        yield "no recording without an accident was evaluated; give normal scenarios too for false alarms"
    if recordings and rules.threshold is None:
        yield (
            "the operating point is that of a recall of 0.8, or the highest, on these very recordings; choose it on "
            "another split with --threshold-from, or give it with --switch threshold=…"
        )
    yield from left_out_notes(counts)
    if recordings and not any(each["references"] for each in counts):
        yield "the rows 'TTC < 3 s' need what constant velocities lead to: accident_context(…, references=True)"
