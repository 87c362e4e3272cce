"""`CleanWarnings`: metrics in which a siren, silence or chance cannot win (protocol `clean`)."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
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
# Threshold at which every alarm with a score counts.
_LOWEST_THRESHOLD: Final = float(np.nextafter(0.0, 1.0))
_TRIVIAL_THRESHOLDS: Final[Mapping[str, float]] = {
    "always": 1.0,
    "never": 1.0,
    "random per frame": 0.5,
    "random per recording": 0.5,
}


def reference_threshold(predictor: str) -> float:
    """Return the operating point of a reference predictor.

    For the predictors that know the present any alarm counts.

    Args:
        predictor: One of `PREDICTORS` except the given one.
    """
    return _TRIVIAL_THRESHOLDS.get(predictor, _LOWEST_THRESHOLD)


@dataclass(frozen=True, slots=True, kw_only=True)
class AnticipationFigures(FrozenMappings):
    """How well one predictor foresees a group's accidents. NaN: nothing to count.

    Attributes:
        auc_ahead: Headline: the probability that an accident recording's score exceeds another
            recording's at the same time before the end, ties half, mean over the moments of the
            last 3 seconds. 0.5 for always and never, and on average for chance.
        twin_wins: Probability that an accident recording's highest score exceeds its twin's, ties
            half; a twin is cut to the accident's length.
        average_precision: AP over recordings, by their highest scores; depends on the numbers of
            accident and other recordings.
        area_under_curve: AUC, the same up to the impact.
        mean_time: mTTA over the curve of recall, seconds; a missed recording adds no time, so read
            it beside the AP.
        operating: Figures at the operating point: at the threshold of the protocol; without one at
            the threshold of `at_r80`, or of the highest recall where 0.8 is not reached.
        at_r80: Figures at the highest threshold with a recall of 0.8; NaN where no threshold has
            it.
        at_p80: Figures at the threshold of the highest recall with a precision of 0.8.
        best_f1: Threshold of the best F1 over these recordings, for evaluations of another split.
        quiet: Lowest threshold with at most one second per minute in alarm without a coming
            accident, for evaluations of another split.
        tta0_after: For agents that see an accident of others: latency → seconds of `operating.tta0`
            that are left when the colliding pair receives the warning, at least 0; empty for
            `ego_involved`.
        recordings: Number of recordings by kind: `accident`, `twins`, `others`.
        twins: Number of pairs of an accident recording and its twin.
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
        samples: Number of samples.
        operating_by: Where the operating point comes from: a `given` threshold, or `recall`.
        groups: Involvement of the agent → figures; agents of one scenario are never pooled.
        references: Predictor (of `PREDICTORS` except the given one) → the same figures; empty for
            resamples.
        beyond: Alarms for later than the horizon, which do not count.
        notes: Sentences that a reader of the numbers should know.
    """

    samples: int
    operating_by: str
    groups: Mapping[str, AnticipationFigures]
    references: Mapping[str, Mapping[str, AnticipationFigures]]
    beyond: int
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class CleanWarnings:
    """Foreseen accidents by recording, without the quirks of published anticipation metrics.

    A recording's score at a sample is that of its surest alarm, lower than all thresholds without
    one; from the impact on nothing counts.

    Attributes:
        scores_of: Alarms that count where somebody collides: the ones of the colliding `pair`
            (right ones), or all of the `recording`, for predictors that name nobody. Where nobody
            collides, all alarms count.
        threshold: Lowest score that is an alarm, chosen on another split (`best_f1` or `quiet` of
            that split); None if none was chosen.
    """

    scores_of: ScoresOf = "pair"
    threshold: float | None = None

    def __post_init__(self) -> None:
        """Check the values; raises ChoiceError or ConfigError."""
        settle_choices(self, {"scores_of": get_args(ScoresOf)})
        if self.threshold is not None and not math.isfinite(self.threshold):
            raise ConfigError(f"threshold: expected a number, or None, found {self.threshold!r}")

    def result(self, counts: Collection[Counts], *, references: bool = False) -> AnticipationResult:
        """Return the metrics of some samples' counts, with or without the reference predictors."""
        parts = parts_of(counts)
        recordings = recordings_of(parts)
        samples = [sample for part in parts for sample in part]
        groups = dict(by_group(recordings))
        figures: dict[str, dict[str, AnticipationFigures]] = {}
        for predictor in PREDICTORS:
            if references or predictor == GIVEN:
                figures[predictor] = {
                    group: _figures(members, predictor, self) for group, members in groups.items()
                }
        return AnticipationResult(
            samples=len(samples),
            operating_by="recall" if self.threshold is None else "given",
            groups=figures.pop(GIVEN),
            references=figures,
            beyond=sum(sample["beyond"] for sample in samples),
            notes=tuple(_notes(samples, recordings, self)),
        )

    def resampled(
        self, parts: Sequence[Sequence[Counts]], times: IntArray
    ) -> Iterator[AnticipationResult]:
        """Yield the result of each draw, without references; see `Evaluator.resampled`."""
        tables = {}
        for group, recordings in by_group(recordings_of(parts)):
            tables[group] = _Table(recordings, GIVEN, self)
        samples = np.array([len(part) for part in parts], dtype=np.int64)
        beyond = np.array(
            [sum(sample["beyond"] for sample in part) for part in parts], dtype=np.int64
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
    """Scores of one predictor in one group of recordings, for figures with any weights."""

    def __init__(
        self, recordings: Sequence[Recording], predictor: str, rules: CleanWarnings, draw: int = 0
    ) -> None:
        self._predictor = predictor
        self._rules = rules
        series = series_of(recordings, predictor, rules.scores_of, draw)
        any_alarm = None
        if rules.scores_of != "recording":
            any_alarm = series_of(recordings, predictor, "recording", draw).highest()
        self._scores = CleanScores(series, any_alarm)
        self._pairs = twin_pairs(recordings)
        self._part = np.array([recording.part for recording in recordings], dtype=np.int64)
        self._kind = np.array([recording.kind for recording in recordings])
        self._sees_others = recordings[0].group not in (GROUPS[0], GROUPS[-1])

    def figures(self, draw: IntArray | None = None) -> AnticipationFigures:
        """Return the figures of recordings that count as often as their part is drawn.

        Args:
            draw: How often each part is drawn; None for once each.
        """
        weight = np.ones(len(self._part)) if draw is None else draw[self._part].astype(np.float64)
        scores = self._scores
        r80 = scores.threshold_of_recall(weight)
        threshold = self._operating_threshold(r80, weight)
        tta0_after = {}
        if self._sees_others:
            for latency in LATENCIES:
                tta0_after[latency] = scores.tta0_after(threshold, weight, latency)
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
            tta0_after=tta0_after,
            recordings={kind: int(weight[self._kind == kind].sum()) for kind in KINDS},
            twins=int(weight[self._pairs[:, 0]].sum()),
        )

    def _operating_threshold(self, r80: float, weight: FloatArray) -> float:
        """Return the operating point; without a fixed one it is `r80`, or the highest recall's."""
        threshold = self._rules.threshold
        if self._predictor != GIVEN:
            threshold = reference_threshold(self._predictor)
        if threshold is not None:
            return threshold
        return self._scores.threshold_of_highest_recall(weight) if math.isnan(r80) else r80

    def _twin_wins(self, weight: FloatArray) -> float:
        """Return the share of accidents with a higher score than their twin, ties half."""
        highest = self._scores.highest
        accident = highest[self._pairs[:, 0]]
        twin = highest[self._pairs[:, 1]]
        pairs = weight[self._pairs[:, 0]]
        won = np.where(accident == twin, 0.5, accident > twin)
        return ratio(float((won * pairs).sum()), float(pairs.sum()))


def _figures(
    recordings: Sequence[Recording], predictor: str, rules: CleanWarnings
) -> AnticipationFigures:
    """Return one predictor's figures, for a random one their means over some draws."""
    drawn = []
    for draw in range(draws_of(predictor)):
        drawn.append(_Table(recordings, predictor, rules, draw).figures())
    return drawn[0] if len(drawn) == 1 else mean_of(drawn)


def draws_of(predictor: str) -> int:
    """Return the number of draws that a predictor's figures are means of.

    Figures of a random predictor are means of several draws, so that no luck ranks it.
    """
    return RANDOM_DRAWS if predictor.startswith("random") else 1


def mean_of(parts: Sequence[Any]) -> Any:
    """Return the means of floats, also of the floats in mappings and dataclasses of one form.

    NaN is left out. Anything but floats is taken from the first of the parts.
    """
    head = parts[0]
    if isinstance(head, float):
        known_values = [value for value in parts if not math.isnan(value)]
        return math.fsum(known_values) / len(known_values) if known_values else math.nan
    if isinstance(head, Mapping):
        return {name: mean_of([part[name] for part in parts]) for name in head}
    if is_dataclass(head) and not isinstance(head, type):
        means = {}
        for field in fields(head):
            means[field.name] = mean_of([getattr(part, field.name) for part in parts])
        return replace(head, **means)
    return head


def _notes(
    counts: Collection[Counts], recordings: Sequence[Recording], rules: CleanWarnings
) -> Iterator[str]:
    """Yield sentences on what was not evaluated, and on the operating point."""
    kinds = {recording.kind for recording in recordings}
    if recordings and "accident" not in kinds:
        yield "no recording of an accident was evaluated; give accident scenarios too for warnings"
    if recordings and kinds == {"accident"}:
        yield (
            "no recording without an accident was evaluated; give normal scenarios too for false "
            "alarms"
        )
    if recordings and rules.threshold is None:
        yield (
            "the operating point is that of a recall of 0.8, or the highest, on these very "
            "recordings; choose it on another split with --threshold-from, or give it with "
            "--switch threshold=…"
        )
    yield from left_out_notes(counts)
    if recordings and not any(sample["references"] for sample in counts):
        yield (
            "the rows 'TTC < 3 s' need what constant velocities lead to: accident_context(…, "
            "references=True)"
        )
