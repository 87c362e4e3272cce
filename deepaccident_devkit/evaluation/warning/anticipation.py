"""`CleanWarnings`: metrics on which constant alarm, silence or chance cannot win (`clean`)."""

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
    GIVEN_SCORES,
    GROUPS,
    KINDS,
    PREDICTORS,
    Recording,
    ScoresOf,
    group_recordings,
    left_out_notes,
    recordings_of,
    series_of,
    split_counts,
    twin_pairs,
)
from deepaccident_devkit.evaluation.warning.result import WarningResult
from deepaccident_devkit.support.arrays import FloatArray, IntArray
from deepaccident_devkit.support.text import settle_choices

# The figures of a random predictor are averaged over this number of draws.
RANDOM_DRAWS: Final = 20
# Possible delays of a warning, in seconds, from the agent that sees the danger to the two actors
# that collide.
LATENCIES: Final = (0.0, 0.1, 0.3)
# Threshold at which every alarm with a score counts.
_LOWEST_THRESHOLD = float(np.nextafter(0.0, 1.0))
_TRIVIAL_THRESHOLDS = {
    "always": 1.0,
    "never": 1.0,
    "random per frame": 0.5,
    "random per recording": 0.5,
}


def reference_threshold(predictor: str) -> float:
    """Return the threshold at which a reference predictor is evaluated.

    For the predictors that know the current frame, any alarm counts.

    Args:
        predictor: One of `PREDICTORS` except `GIVEN_SCORES`.
    """
    return _TRIVIAL_THRESHOLDS.get(predictor, _LOWEST_THRESHOLD)


@dataclass(frozen=True, slots=True, kw_only=True)
class AnticipationFigures(FrozenMappings):
    """How well one predictor foresees the accidents of a group of recordings.

    A figure is NaN if there is nothing to count.

    Attributes:
        auc_ahead: The main metric: the probability that an accident recording's score exceeds that
            of another recording at the same time before the end, averaged over the time steps of
            the last 3 seconds. Ties count half. It is 0.5 for `always` and `never`, and 0.5 on
            average for random scores.
        twin_wins: Probability that an accident recording's highest score exceeds its twin's. Ties
            count half; the twin is cut to the accident's length.
        average_precision: AP when recordings are ranked by their highest scores; it depends on how
            many recordings end in an accident and how many do not.
        area_under_curve: AUC when recordings are ranked by their highest scores up to the impact.
        mean_time: mTTA averaged over the recall curve, seconds. A missed recording adds no time, so
            read it together with the AP.
        operating: Figures at the operating point: the protocol's threshold if it has one; otherwise
            the threshold of `at_r80`, or the threshold of the highest recall if none reaches 0.8.
        at_r80: Figures at the highest threshold with a recall of at least 0.8; NaN if no threshold
            reaches it.
        at_p80: Figures at the threshold that has the highest recall among those with a precision of
            at least 0.8; NaN if no threshold has that precision.
        best_f1: Threshold with the best F1 over these recordings; use it to evaluate another split.
        quiet: Lowest threshold that causes at most one second of alarm per minute when no accident
            is coming; use it to evaluate another split.
        tta0_after: For agents that see an accident of others: latency in seconds → what is left of
            `operating.tta0` (seconds, at least 0) when the warning reaches the colliding pair;
            empty for `ego_involved`.
        recordings: Number of recordings of each kind: `accident`, `twins`, `others`.
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
        operating_by: How the operating point was chosen: `given` if the protocol has a threshold,
            `recall` otherwise.
        groups: Involvement of the agent → figures; agents of one scenario are never pooled.
        references: Figures of each reference predictor (`PREDICTORS` except `GIVEN_SCORES`) by
            group; empty for resamples.
        beyond: Number of alarms that predict an accident beyond the horizon; these are ignored.
        notes: Caveats that belong next to the numbers, one sentence each.
    """

    samples: int
    operating_by: str
    groups: Mapping[str, AnticipationFigures]
    references: Mapping[str, Mapping[str, AnticipationFigures]]
    beyond: int
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class CleanWarnings:
    """Rules that count foreseen accidents by recording, without the quirks of published metrics.

    A recording's score at a sample is the highest score of its alarms; if there is no alarm, the
    score is below all thresholds. Samples at or after the impact do not count.

    Attributes:
        scores_of: Which alarms count in a recording with a collision: with `pair` only the correct
            ones, which name the colliding pair; with `recording` all alarms, for predictors that do
            not name actors. In recordings without a collision, all alarms count.
        threshold: Lowest score that raises an alarm, chosen on another split (its `best_f1` or
            `quiet`); None if no threshold was chosen.
    """

    scores_of: ScoresOf = "pair"
    threshold: float | None = None

    def __post_init__(self) -> None:
        """Check the fields; raise ChoiceError or ConfigError if one is invalid."""
        settle_choices(self, {"scores_of": get_args(ScoresOf)})
        if self.threshold is not None and not math.isfinite(self.threshold):
            raise ConfigError(f"threshold: expected a number or None, found {self.threshold!r}")

    def result(self, counts: Collection[Counts], *, references: bool = False) -> AnticipationResult:
        """Compute the metrics from the counts of samples; reference predictors are optional."""
        parts = split_counts(counts)
        recordings = recordings_of(parts)
        samples = [sample for part in parts for sample in part]
        figures: dict[str, dict[str, AnticipationFigures]] = {}
        for predictor in PREDICTORS if references else [GIVEN_SCORES]:
            figures[predictor] = {}
            for group, members in group_recordings(recordings):
                figures[predictor][group] = _figures(members, predictor, self)
        return AnticipationResult(
            samples=len(samples),
            operating_by=self._operating_by,
            groups=figures.pop(GIVEN_SCORES),
            references=figures,
            beyond=sum(sample["beyond"] for sample in samples),
            notes=tuple(_notes(samples, recordings, self)),
        )

    @property
    def _operating_by(self) -> str:
        """How the operating point is chosen; see `AnticipationResult.operating_by`."""
        return "recall" if self.threshold is None else "given"

    def resampled(
        self, parts: Sequence[Sequence[Counts]], times: IntArray
    ) -> Iterator[AnticipationResult]:
        """Yield the result of each draw, without references; see `Evaluator.resampled`."""
        scores_by_group = {}
        for group, recordings in group_recordings(recordings_of(parts)):
            scores_by_group[group] = _GroupScores(recordings, GIVEN_SCORES, self)
        sample_counts = np.zeros(len(parts), dtype=np.int64)
        late_alarm_counts = np.zeros(len(parts), dtype=np.int64)
        for index, part in enumerate(parts):
            sample_counts[index] = len(part)
            late_alarm_counts[index] = sum(sample["beyond"] for sample in part)
        for draw in times:
            yield AnticipationResult(
                samples=int(sample_counts @ draw),
                operating_by=self._operating_by,
                groups={name: scores.figures(draw) for name, scores in scores_by_group.items()},
                references={},
                beyond=int(late_alarm_counts @ draw),
            )


class _GroupScores:
    """Scores of one predictor on one group of recordings, which can be weighted in any way."""

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
        self._twin_pairs = twin_pairs(recordings)
        self._part = np.array([recording.part for recording in recordings], dtype=np.int64)
        self._kind = np.array([recording.kind for recording in recordings])
        self._sees_others = recordings[0].group not in (GROUPS[0], GROUPS[-1])

    def figures(self, draw: IntArray | None = None) -> AnticipationFigures:
        """Compute the figures; each recording is weighted by how often its part is drawn.

        Args:
            draw: (P,) how often each part is drawn; None to draw each part once.
        """
        recording_weights = np.ones(len(self._part))
        if draw is not None:
            recording_weights = draw[self._part].astype(np.float64)
        scores = self._scores
        threshold_at_recall_80 = scores.threshold_of_recall(recording_weights)
        threshold = self._operating_threshold(threshold_at_recall_80, recording_weights)
        tta0_after = {}
        if self._sees_others:
            for latency in LATENCIES:
                tta0_after[latency] = scores.tta0_after(threshold, recording_weights, latency)
        return AnticipationFigures(
            auc_ahead=scores.area_at_moments(recording_weights),
            twin_wins=self._twin_wins(recording_weights),
            average_precision=scores.average_precision(recording_weights),
            area_under_curve=scores.area_under_curve(recording_weights),
            mean_time=scores.mean_time(recording_weights),
            operating=scores.at(threshold, recording_weights),
            at_r80=scores.at(threshold_at_recall_80, recording_weights),
            at_p80=scores.at(scores.threshold_of_precision(recording_weights), recording_weights),
            best_f1=scores.threshold_of_best_f1(recording_weights),
            quiet=scores.threshold_of_alarm_time(recording_weights),
            tta0_after=tta0_after,
            recordings={kind: int(recording_weights[self._kind == kind].sum()) for kind in KINDS},
            twins=int(recording_weights[self._twin_pairs[:, 0]].sum()),
        )

    def _operating_threshold(
        self, threshold_at_recall_80: float, recording_weights: FloatArray
    ) -> float:
        """Return the protocol's or predictor's own threshold if it has one.

        Otherwise, return the threshold of 80 % recall or, if that recall is not reached, of the
        highest recall.

        Args:
            threshold_at_recall_80: Threshold of 80 % recall; NaN if it is not reached.
            recording_weights: (N,) weights of the recordings.
        """
        threshold = self._rules.threshold
        if self._predictor != GIVEN_SCORES:
            threshold = reference_threshold(self._predictor)
        if threshold is not None:
            return threshold
        if math.isnan(threshold_at_recall_80):
            return self._scores.threshold_of_highest_recall(recording_weights)
        return threshold_at_recall_80

    def _twin_wins(self, recording_weights: FloatArray) -> float:
        """Return the share of accidents that score higher than their twins; ties count half.

        Args:
            recording_weights: (N,) weights of the recordings.
        """
        accident_row, twin_row = self._twin_pairs.T
        accident_score = self._scores.highest[accident_row]
        twin_score = self._scores.highest[twin_row]
        wins = np.where(accident_score == twin_score, 0.5, accident_score > twin_score)
        pair_weights = recording_weights[accident_row]
        return ratio(float((wins * pair_weights).sum()), float(pair_weights.sum()))


def _figures(
    recordings: Sequence[Recording], predictor: str, rules: CleanWarnings
) -> AnticipationFigures:
    """Return one predictor's figures; a random predictor's are averaged over draws."""
    drawn_figures = []
    for draw in range(draws_of(predictor)):
        scores = _GroupScores(recordings, predictor, rules, draw)
        drawn_figures.append(scores.figures())
    if len(drawn_figures) == 1:
        return drawn_figures[0]
    mean_figures: AnticipationFigures = mean_of_records(drawn_figures)
    return mean_figures


def draws_of(predictor: str) -> int:
    """Return over how many draws a predictor's figures are averaged.

    It is more than one for random predictors, so that their rank does not depend on luck.
    """
    return RANDOM_DRAWS if predictor.startswith("random") else 1


def mean_of_records(parts: Sequence[Any]) -> Any:
    """Average floats, or mappings or dataclasses with the same fields, value by value.

    NaN is ignored. Values that are not floats are taken from the first of the parts.
    """
    first_part = parts[0]
    if isinstance(first_part, float):
        known_values = [value for value in parts if not math.isnan(value)]
        if not known_values:
            return math.nan
        return math.fsum(known_values) / len(known_values)
    means = {}
    if isinstance(first_part, Mapping):
        for name in first_part:
            means[name] = mean_of_records([part[name] for part in parts])
        return means
    if is_dataclass(first_part) and not isinstance(first_part, type):
        for field in fields(first_part):
            means[field.name] = mean_of_records([getattr(part, field.name) for part in parts])
        return replace(first_part, **means)
    return first_part


def _notes(
    counts: Collection[Counts], recordings: Sequence[Recording], rules: CleanWarnings
) -> Iterator[str]:
    """Yield sentences that say what was not evaluated and how the operating point was chosen."""
    kinds = {recording.kind for recording in recordings}
    if recordings and "accident" not in kinds:
        yield (
            "no recording of an accident was evaluated; to measure warnings, also evaluate "
            "accident scenarios"
        )
    if recordings and kinds == {"accident"}:
        yield (
            "no recording without an accident was evaluated; to measure false alarms, also "
            "evaluate normal scenarios"
        )
    if recordings and rules.threshold is None:
        yield (
            "the operating point has a recall of 0.8, or the highest recall, on these very "
            "recordings; choose the operating point on another split with --threshold-from, or "
            "set it with --switch threshold=…"
        )
    yield from left_out_notes(counts)
    if recordings and not any(sample["references"] for sample in counts):
        yield (
            "the rows 'TTC < 3 s' need predictions at constant velocity; give "
            "accident_context(…, references=True)"
        )
