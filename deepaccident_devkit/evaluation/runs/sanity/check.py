"""`check_sanity`: is 0 the score of a bad model, or of good predictions whose files do not keep the format?"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import ConfigError, EvaluationError
from deepaccident_devkit.evaluation.metrics.accident import AccidentContext
from deepaccident_devkit.evaluation.metrics.detection import DetectedBoxes
from deepaccident_devkit.evaluation.metrics.evaluator import Counts, Evaluator
from deepaccident_devkit.evaluation.metrics.headlines import headline_numbers, headlines
from deepaccident_devkit.evaluation.metrics.predictions import MotionOutput
from deepaccident_devkit.evaluation.results import Results
from deepaccident_devkit.evaluation.runs.many_samples import evaluate_samples
from deepaccident_devkit.evaluation.runs.sanity.accidents import (
    AccidentMoment,
    accident_moment,
    accident_suspicions,
    accident_tallies,
)
from deepaccident_devkit.evaluation.runs.sanity.box_facts import box_counts, box_warnings
from deepaccident_devkit.evaluation.runs.sanity.classes import class_candidate, class_warning
from deepaccident_devkit.evaluation.runs.sanity.detection import (
    DetectionMoments,
    detection_moments,
    detection_suspicions,
    detection_tallies,
)
from deepaccident_devkit.evaluation.runs.sanity.facts import (
    all_empty,
    facts_of,
    is_ranked,
    path_warnings,
    plain_warnings,
)
from deepaccident_devkit.evaluation.runs.sanity.foregrounds import foreground_warnings, post_processing_of
from deepaccident_devkit.evaluation.runs.sanity.motion import motion_suspicions, motion_tallies
from deepaccident_devkit.evaluation.runs.sanity.perfect import Arguments, empty, perfect
from deepaccident_devkit.evaluation.runs.sanity.probes import Suspicion, candidates_of, warning_of
from deepaccident_devkit.evaluation.runs.sanity.report import SanityReport, verdict_of
from deepaccident_devkit.evaluation.runs.sanity.samples import telling_samples
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup, SampleLoader

if TYPE_CHECKING:
    from concurrent.futures import Executor

_SAMPLES: Final = 20
_LISTS: Final = 60
"""Samples that are looked at, of maps and boxes, and of accident lists."""
_NOT_IN_MAPS: Final = (
    "offset, flow and the heads' channels, which instance maps do not hold; to have them checked, write heads of a few "
    "samples (34 MB each) with ResultsWriter(path, 'motion', store='heads')"
)


def check_sanity(
    dataset: Dataset,
    results: Results,
    setup: EvaluationSetup,
    tokens: Collection[str],
    *,
    samples: int | None = None,
    workers: int | None = 1,
    executor: Executor | None = None,
) -> SanityReport:
    """The scores of perfect and empty predictions, and whether the given ones look mirrored, turned, shifted and so on.

    Each suspicion is tried on samples spread over all: the predictions are corrected as if it were true, and
    compared with the truth. It is told if they then fit twice as well. Correct predictions, and bad ones, raise none.

    Args:
        dataset: the release.
        results: the predictions.
        setup: the rules that the scores are of.
        tokens: the samples that are evaluated, each with a prediction.
        samples: how many of them are looked at; None for 20, or 60 of accident lists, which are short.
        workers: processes.
        executor: any executor of `concurrent.futures` to run on, in place of own workers.

    Raises:
        ConfigError: `samples` is less than 1.
        EvaluationError: the results are not of a kind that the task takes, there is no sample, or one cannot be
            evaluated.
    """
    lists = results.task == "accident"
    count = (_LISTS if lists else _SAMPLES) if samples is None else samples
    if count < 1:
        raise ConfigError(f"samples: expected at least 1, found {samples}")
    if not tokens:
        raise EvaluationError("tokens: there is no sample to look at")
    chosen = telling_samples(dataset, tokens, count, setup.horizon, _says_something(results), varied=lists)
    evaluator = _SanityEvaluator(setup, _suspicions(results), _unchecked(results))
    load = _Loader(SampleLoader(dataset, results, setup))
    wanted = {token: token for token in chosen}
    evaluate_samples(evaluator, wanted, load, workers=workers, executor=executor, places=load.loader.places)
    return evaluator.compute()


@dataclass(frozen=True, slots=True, eq=False)
class _Sample:
    """What is counted of a sample: what its evaluator takes, and for lists what more they are compared with."""

    arguments: Arguments
    raw: DetectedBoxes | None = None
    moments: DetectionMoments | AccidentMoment | None = None


@dataclass(frozen=True, slots=True)
class _Loader:
    loader: SampleLoader

    def __call__(self, token: str) -> tuple[_Sample]:
        arguments = self.loader(token)
        dataset, raw = self.loader.dataset, self.loader.results.prediction(token)
        if isinstance(raw, DetectedBoxes):
            return (_Sample(arguments, raw, detection_moments(dataset, token, arguments[1])),)
        if isinstance(raw, MotionOutput):
            return (_Sample(arguments),)
        return (_Sample(arguments, moments=accident_moment(dataset, token, self.loader.setup.horizon)),)


class _SanityEvaluator(Evaluator[SanityReport]):
    """Counts each sample three times by a setup's own rules, and what it says of each suspicion."""

    def __init__(self, setup: EvaluationSetup, suspicions: list[Suspicion], unchecked: tuple[str, ...]) -> None:
        """Start without samples."""
        super().__init__()
        self._setup, self._suspicions, self._unchecked = setup, suspicions, unchecked
        self._rules, self._heads_rule = setup.evaluator(), post_processing_of(setup.rules)

    @property
    def settings(self) -> dict[str, Any]:
        """The setup's."""
        return self._setup.as_dict()

    def update(self, token: str, sample: _Sample) -> None:
        """Count one sample."""
        given = sample.arguments
        sides = {"given": given, "perfect": perfect(given, self._setup.rules), "empty": empty(given)}
        self.add(
            token,
            {
                **{name: self._counted(token, arguments) for name, arguments in sides.items()},
                "tallies": _tallies(sample),
                "facts": self._facts(sample),
            },
        )

    def result_of(self, counts: Collection[Counts]) -> SanityReport:
        """The report on some samples."""
        task = self._setup.task
        results = {
            side: self._rules.result_of([each[side] for each in counts]) for side in ("perfect", "empty", "given")
        }
        candidates = candidates_of(self._suspicions, [each["tallies"] for each in counts])
        by_name = {each.name: each for each in self._suspicions}
        suspected = [warning_of(by_name[each.name], each) for each in candidates if each.suspected]
        facts = [each["facts"] for each in counts]
        if task == "detection":
            misplaced = any(each.suspected for each in candidates if by_name[each.name].group == "place")
            classes = class_candidate(np.sum([each["classes"] for each in facts], axis=0))
            classes = replace(classes, suspected=classes.suspected and not misplaced)
            candidates = (*candidates, classes)
            suspected += [class_warning(classes)] * classes.suspected
        misread = foreground_warnings(facts, self._heads_rule)
        plain = plain_warnings(facts, ranked=is_ranked(task, results["given"])) + misread + box_warnings(facts)
        plain += path_warnings(results["given"], results["perfect"])
        numbers = {side: headline_numbers(task, result) for side, result in results.items()}
        return SanityReport(
            samples=len(counts),
            **numbers,
            units={each.name: each.unit for each in headlines(task, results["given"])},
            candidates=candidates,
            warnings=(*suspected, *plain),
            unchecked=self._unchecked,
            verdict=verdict_of(
                headlines(task, results["given"]),
                numbers["empty"],
                numbers["perfect"],
                explained=bool(suspected or (misread and task != "motion")) or all_empty(facts),
                warned=bool(plain),
                checks=len(candidates),
            ),
        )

    def _facts(self, sample: _Sample) -> dict[str, Any]:
        prediction, truth, *_ = sample.arguments
        facts = facts_of(prediction, truth, self._heads_rule)
        return facts if sample.raw is None else facts | {"boxes": box_counts(sample.raw)}

    def _counted(self, token: str, arguments: Arguments) -> Counts:
        one = self._rules.fresh()
        one.update(token, *arguments)
        return one.counts[token]


def _says_something(results: Results) -> Callable[[str], bool]:
    """Whether a sample has a prediction that can be compared: of accidents, of which a model may foresee few, an alarm.

    Maps and boxes nearly always show an actor, and maps take long to read.
    """
    return lambda token: results.task != "accident" or bool(results.prediction(token))


def _suspicions(results: Results) -> list[Suspicion]:
    if results.form is not None:
        return motion_suspicions(results.form.grid.orientation, heads=results.form.stored == "heads")
    return detection_suspicions() if results.task == "detection" else accident_suspicions()


def _unchecked(results: Results) -> tuple[str, ...]:
    """What results of this form do not hold."""
    if results.form is None or results.form.stored == "heads":
        return ()
    return (_NOT_IN_MAPS,)


def _tallies(sample: _Sample) -> dict[str, list[float]]:
    prediction, truth, *more = sample.arguments
    if isinstance(prediction, MotionOutput):
        return motion_tallies(prediction, truth)
    if sample.raw is not None and isinstance(sample.moments, DetectionMoments):
        return detection_tallies(sample.raw, prediction, sample.moments)
    context = next((each for each in more if isinstance(each, AccidentContext)), AccidentContext())
    moment = sample.moments if isinstance(sample.moments, AccidentMoment) else None
    return {} if context.truth is None else accident_tallies(prediction, context.truth, moment)
