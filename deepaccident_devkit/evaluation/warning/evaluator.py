"""`WarningEvaluator`: how early an accident is warned of, and how often an alarm is false.

`PreventedEvaluator`: which accidents a predictor's alarms would have prevented, and for how much braking.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.accident_truth import AccidentContext, accident_context, checked_facts
from deepaccident_devkit.evaluation.evaluator import Counts, Evaluator
from deepaccident_devkit.evaluation.predictions import Prediction, compared_labels
from deepaccident_devkit.evaluation.task import Task, TaskResult, protocol_of
from deepaccident_devkit.evaluation.warning.anticipation import (
    AnticipationResult,
    CleanWarnings,
    draws_of,
    mean_of,
    reference_threshold,
)
from deepaccident_devkit.evaluation.warning.field import FieldResult, FieldWarnings
from deepaccident_devkit.evaluation.warning.prevention import (
    BUDGET,
    AccidentOutcomes,
    PreventedResult,
    PreventionCurve,
    PreventionFigures,
    ScoredEnds,
)
from deepaccident_devkit.evaluation.warning.recordings import (
    GIVEN,
    PART,
    PREDICTORS,
    TRIVIAL,
    Drive,
    ScoresOf,
    by_group,
    drives_of,
    parts_of,
    sample_counts,
)
from deepaccident_devkit.motion import MotionLabels
from deepaccident_devkit.support.arrays import FloatArray, IntArray

Protocol = CleanWarnings | FieldWarnings
Result = AnticipationResult | FieldResult
WARNING_PROTOCOLS: Final[Mapping[str, Protocol]] = MappingProxyType(
    {"clean": CleanWarnings(), "field": FieldWarnings()}
)
"""`clean` ranks predictors, recording by recording; `field` is what published codes print. Both compare with labels as
the accident protocol `boxes` does; the paper has no such metrics."""


class WarningEvaluator(Evaluator[Any]):
    """Numbers for users of an alarm: whether it knows accidents ahead, seconds of warning, time in false alarm.

    Give it whole recordings, normal scenarios among them: the metrics ignore the times of samples that are not given.

    `compute` gives an `AnticipationResult` or a `FieldResult`, by the protocol.

    >>> evaluator = WarningEvaluator()
    >>> evaluator.compute().samples
    0
    """

    def __init__(self, protocol: str | Protocol = "clean") -> None:
        """Start without samples.

        Args:
            protocol: of `WARNING_PROTOCOLS` by name, or your own.

        Raises:
            ChoiceError: no protocol has that name, or it is of another type.
        """
        super().__init__()
        self.protocol = protocol_of(protocol, Protocol, WARNING_PROTOCOLS)  # type: ignore[arg-type]  # a union is a kind too

    @property
    def settings(self) -> dict[str, Any]:
        """The protocol's choices."""
        return asdict(self.protocol)

    def update(
        self,
        token: str,
        prediction: Prediction,
        label: MotionLabels | None = None,
        context: AccidentContext | None = None,
    ) -> None:
        """Count one sample.

        Args:
            token: of the sample; it says of which scenario and agent, and when.
            prediction: what a model says: motion in maps, which is at most one alarm, or a list of alarms.
            label: says how far apart in time the maps of a prediction are, and how they lie in their cells; None for
                the released way. Alarms need none.
            context: the truth, from `accident_context(dataset, sample, horizon, references=True)`; the horizon says
                up to when actors can be named, and after which alarms do not count.

        Raises:
            EvaluationError: the token is no sample's, the context or something in it is missing, the prediction is
                neither, or the sample came before with another outcome.
        """
        self.add(token, _counts(token, prediction, label, context, self.protocol))

    def result_of(self, counts: Collection[Counts]) -> Result:
        """The metrics of some samples' counts, in any order; of what `pooled` gives, too."""
        return self.protocol.result(counts)

    def compute(self, tokens: Iterable[str] | None = None) -> Result:
        """The metrics of all samples, beside those of the reference predictors; or of some, without."""
        if tokens is None:
            return self.protocol.result(list(self._counts.values()), references=True)
        result: Result = super().compute(tokens)
        return result

    def pooled(self, counts: Collection[Counts]) -> Sequence[Counts]:
        """Counts with the same result, of which no recording is put together with others' recordings.

        So a scenario that is drawn twice counts twice.
        """
        return [{PART: [sample for part in parts_of(counts) for sample in part]}]

    def resampled(self, parts: Sequence[Sequence[Counts]], times: IntArray) -> Iterator[Any]:
        """The result of each draw, without references."""
        if isinstance(self.protocol, CleanWarnings):
            return self.protocol.resampled(parts, times)
        return super().resampled(parts, times)

    @property
    def has_intervals(self) -> bool:
        """The protocol `field` has none: its numbers take long, and are only for comparison with published ones."""
        return not isinstance(self.protocol, FieldWarnings)


def _counts(
    token: str,
    prediction: Prediction,
    label: MotionLabels | None,
    context: AccidentContext | None,
    _protocol: Protocol,
) -> Counts:
    checked_facts(label, context)
    return sample_counts(token, prediction, label, context or AccidentContext())


WARNING: Final = Task(
    name="warning",
    kinds=("motion", "accident"),
    protocols=WARNING_PROTOCOLS,
    evaluator=WarningEvaluator,
    truth=lambda dataset, token, rules, form, horizon: (
        compared_labels(dataset, token, rules, form, horizon),
        accident_context(dataset, token, horizon, references=True),
    ),
    counts=_counts,
    result=lambda counts, protocol: protocol.result(counts, references=True),
    summary=TaskResult.as_dict,
    whole_recordings=True,
    needs_meta=True,
)
_WALKING: Final = ", pedestrian"
_ALARMS: Final[Mapping[str, ScoresOf]] = {"right": "pair", "any_alarm": "recording"}
"""Which alarms warn → the scores that are of them."""
QUIET: Final = ", quiet"
"""End of the name of a random predictor at the threshold of at most one braking second a minute."""


class PreventedEvaluator(Evaluator[PreventedResult]):
    """What a `WarningEvaluator` of the protocol `clean` counts, as accidents prevented.

    `compute` gives a `PreventedResult`. `evaluation.runs.prevented_accidents` makes the tables and takes the counts.
    """

    def __init__(self, outcomes: AccidentOutcomes, protocol: str | CleanWarnings = "clean") -> None:
        """Start without samples.

        Args:
            outcomes: how each accident ends, by the frame of the first alarm.
            protocol: `clean`, or your own of its kind.

        Raises:
            EvaluationError: it is another protocol, which has no recordings with scores.
            ChoiceError: no protocol has that name.
        """
        super().__init__()
        self._warnings = WarningEvaluator(protocol)
        if not isinstance(self._warnings.protocol, CleanWarnings):
            raise EvaluationError(
                "protocol: prevented accidents are counted by the protocol clean, found "
                f"{type(self._warnings.protocol).__name__}"
            )
        self._rules, self._outcomes = self._warnings.protocol, outcomes

    @property
    def settings(self) -> dict[str, Any]:
        """The protocol's choices."""
        return self._warnings.settings

    def update(self, token: str, *arguments: Any) -> None:
        """Count one sample, as `WarningEvaluator.update` does; raises EvaluationError."""
        counting = self._warnings.fresh()
        counting.update(token, *arguments)
        self.add(token, counting.counts[token])

    def result_of(self, counts: Collection[Counts]) -> PreventedResult:
        """The figures of some samples' counts, in any order, without references and curves."""
        return self._result(parts_of(counts), references=False)

    def compute(self, tokens: Iterable[str] | None = None) -> PreventedResult:
        """The figures of all samples, with references and curves; or of some, without."""
        if tokens is not None:
            return super().compute(tokens)
        return self._result(parts_of(list(self._counts.values())), references=True)

    def resampled(self, parts: Sequence[Sequence[Counts]], times: IntArray) -> Iterator[PreventedResult]:
        """The result of each draw, without references and curves."""
        groups = dict(self._groups(drives_of(parts)))
        tables = {group: self._ends(those, GIVEN) for group, those in groups.items()}
        for draw in times:
            figures = {group: self._given(ends, draw) for group, ends in tables.items()}
            yield self._of_groups({GIVEN: figures})

    def _result(self, parts: Sequence[Collection[Counts]], *, references: bool) -> PreventedResult:
        groups = dict(self._groups(drives_of(parts)))
        given = {group: self._ends(those, GIVEN) for group, those in groups.items()}
        made = {GIVEN: {group: self._given(ends) for group, ends in given.items()}}
        if not references:
            return self._of_groups(made, tuple(self._notes(made[GIVEN])))
        for group, those in groups.items():
            for name, figures in self._references(those):
                made.setdefault(name, {})[group] = figures
        curves = {group: ends[self._alarms].curve() for group, ends in given.items()}
        return self._of_groups(made, tuple(self._notes(made[GIVEN])), curves)

    def _of_groups(
        self,
        made: Mapping[str, Mapping[str, PreventionFigures]],
        notes: tuple[str, ...] = (),
        curves: Mapping[str, PreventionCurve] | None = None,
    ) -> PreventedResult:
        return PreventedResult(
            operating_by="budget" if self._rules.threshold is None else "given",
            alarms=self._alarms,
            groups=made[GIVEN],
            references={name: each for name, each in made.items() if name != GIVEN},
            curves=curves or {},
            dropped=self._outcomes.dropped,
            skipped=self._outcomes.skipped,
            notes=notes,
        )

    @property
    def _alarms(self) -> str:
        """A predictor that names nobody has no right alarms."""
        return next(name for name, scores_of in _ALARMS.items() if scores_of == self._rules.scores_of)

    def _groups(self, drives: Sequence[Drive]) -> Iterator[tuple[str, list[Drive]]]:
        """Group → its recordings, accidents of pedestrians apart; those without an accident are in both."""
        tables = self._outcomes.tables
        for group, those in by_group(drives):
            walking = {each.name for each in those if each.name in tables and tables[each.name].pedestrian}
            yield group, [each for each in those if each.name not in walking]
            if walking:
                yield f"{group}{_WALKING}", [each for each in those if each.kind != "accident" or each.name in walking]

    def _ends(self, drives: Sequence[Drive], predictor: str, draw: int = 0) -> Mapping[str, ScoredEnds]:
        """Which alarms warn → one predictor's scores of a group of recordings, with the ends of its accidents."""
        tables = self._outcomes.tables
        right = ScoredEnds(drives, predictor, "pair", tables, draw)
        any_alarm = right if predictor in TRIVIAL else ScoredEnds(drives, predictor, "recording", tables, draw)
        return {"right": right, "any_alarm": any_alarm}

    def _given(self, ends: Mapping[str, ScoredEnds], draw: IntArray | None = None) -> PreventionFigures:
        main = ends[self._alarms]
        weight = np.ones(len(main.part)) if draw is None else draw[main.part].astype(np.float64)
        quiet = main.quiet_braking(weight)
        threshold = quiet if self._rules.threshold is None else self._rules.threshold
        return self._figures(ends, threshold, quiet, weight)

    def _figures(
        self, ends: Mapping[str, ScoredEnds], threshold: float, quiet: float, weight: FloatArray
    ) -> PreventionFigures:
        main = ends[self._alarms]
        return PreventionFigures(
            threshold=threshold,
            quiet_braking=quiet,
            accidents=int(weight[main.accident].sum()),
            recordings=int(weight[main.normal].sum()),
            minutes=main.minutes(weight),
            lasting=main.ends(threshold, weight, lasting=True),
            **{alarms: each.ends(threshold, weight) for alarms, each in ends.items()},
        )

    def _references(self, drives: Sequence[Drive]) -> Iterator[tuple[str, PreventionFigures]]:
        """Predictor → figures; of a random one the means over some draws, also at the threshold within the budget."""
        weight = np.ones(len(drives))
        for predictor in PREDICTORS[1:]:
            fixed = reference_threshold(predictor)
            if draws_of(predictor) == 1:
                yield predictor, self._figures(self._ends(drives, predictor), fixed, math.nan, weight)
                continue
            drawn = [self._ends(drives, predictor, draw) for draw in range(draws_of(predictor))]
            quiet = [each[self._alarms].quiet_braking(weight) for each in drawn]
            for name, thresholds in ((predictor, [fixed] * len(drawn)), (f"{predictor}{QUIET}", quiet)):
                yield (
                    name,
                    _mean([self._figures(*each, weight) for each in zip(drawn, thresholds, quiet, strict=True)]),
                )

    def _notes(self, groups: Mapping[str, PreventionFigures]) -> Iterator[str]:
        for group, figures in groups.items():
            if not figures.accidents:
                yield f"{group}: no accident is judged, so that no share prevented is known; give accident scenarios"
            if not figures.recordings:
                yield f"{group}: no recording without an accident, so that no braking for nothing is known; give some"
        if groups:
            yield (
                "an alarm that is over before the driver brakes costs nothing, but counts as a warning: compare with "
                "'random per frame, quiet', and with the share 'if lasting', where alarms must outlast the reaction"
            )
        if groups and self._rules.threshold is None:
            yield (
                f"the threshold is the lowest with at most {BUDGET:g} braking second a minute on these very "
                "recordings, which flatters; take it from another split, evaluated with --prevented: --threshold-from "
                "BUNDLE --threshold-by braking"
            )
        for why, left_out in (
            ("the self-check drops", self._outcomes.dropped),
            ("not judged", self._outcomes.skipped),
        ):
            for each in left_out:
                yield f"{why} {each.scenario}: {each.reason}"


def _mean(drawn: Sequence[PreventionFigures]) -> PreventionFigures:
    """The means, which have no counts."""
    figures: PreventionFigures = mean_of(drawn)
    ends: dict[str, Any] = {
        alarms: {
            latency: {setting: replace(each, counts={}) for setting, each in settings.items()}
            for latency, settings in getattr(figures, alarms).items()
        }
        for alarms in (*_ALARMS, "lasting")
    }
    return replace(figures, **ends)
