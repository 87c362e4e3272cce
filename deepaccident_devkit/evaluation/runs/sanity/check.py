"""`check_sanity`: is 0 the score of a bad model, or of good predictions that lie otherwise than they say?"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import ConfigError, EvaluationError
from deepaccident_devkit.evaluation.metrics.accident import AccidentContext
from deepaccident_devkit.evaluation.metrics.detection import DetectedBoxes
from deepaccident_devkit.evaluation.metrics.evaluator import Counts, Evaluator
from deepaccident_devkit.evaluation.metrics.frames import frames_there
from deepaccident_devkit.evaluation.metrics.frozen_mappings import FrozenMappings
from deepaccident_devkit.evaluation.metrics.headlines import Unit, headline_numbers, headlines, value_text
from deepaccident_devkit.evaluation.metrics.predictions import MotionOutput
from deepaccident_devkit.evaluation.results import Results
from deepaccident_devkit.evaluation.runs.many_samples import evaluate_samples
from deepaccident_devkit.evaluation.runs.sanity.accidents import accident_suspicions, accident_tallies
from deepaccident_devkit.evaluation.runs.sanity.detection import (
    DetectionMoments,
    detection_moments,
    detection_suspicions,
    detection_tallies,
)
from deepaccident_devkit.evaluation.runs.sanity.motion import ids_kept, is_empty, motion_suspicions, motion_tallies
from deepaccident_devkit.evaluation.runs.sanity.perfect import Arguments, empty, perfect
from deepaccident_devkit.evaluation.runs.sanity.probes import Candidate, Suspicion, candidates_of, warning_of
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup, SampleLoader
from deepaccident_devkit.taxonomy import FRAME_PERIOD
from deepaccident_devkit.text import columns_text


@dataclass(frozen=True, slots=True, kw_only=True)
class SanityReport(FrozenMappings):
    """What a few samples say of predictions as a whole.

    Attributes:
        samples: how many were looked at.
        perfect: headline → value if the truth were predicted, in the form of the results: the most there is to reach.
        empty: headline → value if nothing were predicted.
        given: headline → value of the predictions, of these samples alone.
        units: headline → unit.
        candidates: all that was looked for, suspected or not.
        warnings: sentences; none if nothing looks wrong.
    """

    samples: int
    perfect: Mapping[str, float | None]
    empty: Mapping[str, float | None]
    given: Mapping[str, float | None]
    units: Mapping[str, Unit]
    candidates: tuple[Candidate, ...]
    warnings: tuple[str, ...]

    def to_text(self) -> str:
        """A table of the three, then the warnings."""
        rows = [["", "nothing predicted", "given", "perfect"]]
        for name, value in self.given.items():
            texts = [value_text(each, self.units[name]) for each in (self.empty[name], value, self.perfect[name])]
            rows.append([name, *texts])
        head = f"Sanity, of {self.samples} samples; what the protocol gives to nothing and to the truth itself:"
        looked = f"{len(self.candidates)} mistakes were looked for: mirrored, turned, shifted, scaled and others."
        found = [f"WARNING: {each}" for each in self.warnings] or ["Nothing looks wrong with the predictions."]
        return "\n".join([head, columns_text(rows), looked, *found])


_FEWEST_KEPT: Final = 0.2
"""Share of ids that stay from frame to frame below which nobody has linked them."""
_RANKED: Final = {"mAP", "average_precision"}
"""Headlines that are of the order of scores."""
_PAIRS: Final = 10
"""Instances found in two frames on end that say something of it."""


def check_sanity(
    dataset: Dataset,
    results: Results,
    setup: EvaluationSetup,
    tokens: Collection[str],
    *,
    samples: int = 20,
    workers: int | None = 1,
) -> SanityReport:
    """What perfect and empty predictions score, and whether the given ones look mirrored, turned, shifted and so on.

    Each suspicion is tried on samples spread over all: the predictions are set right as though it were true, and
    compared with the truth. It is told if they fit twice as well then. Correct predictions, and bad ones, raise none.

    Args:
        dataset: the release.
        results: the predictions.
        setup: the rules that the scores are of.
        tokens: the samples that are evaluated, each with a prediction.
        samples: how many of them are looked at.
        workers: processes.

    Raises:
        ConfigError: `samples` is less than 1.
        EvaluationError: the results are not of a kind that the task takes, there is no sample, or one cannot be
            evaluated.
    """
    if samples < 1:
        raise ConfigError(f"samples: expected at least 1, found {samples}")
    if not tokens:
        raise EvaluationError("tokens: there is no sample to look at")
    chosen = telling_samples(dataset, tokens, samples, setup.horizon, _says_something(results))
    evaluator = _SanityEvaluator(setup, _suspicions(results))
    load = _Loader(SampleLoader(dataset, results, setup))
    evaluate_samples(evaluator, {token: token for token in chosen}, load, workers=workers)
    return evaluator.compute()


@dataclass(frozen=True, slots=True, eq=False)
class _Sample:
    """What is counted of a sample: what its evaluator takes, and for detections what more they are compared with."""

    arguments: Arguments
    raw: DetectedBoxes | None = None
    moments: DetectionMoments | None = None


@dataclass(frozen=True, slots=True)
class _Loader:
    loader: SampleLoader

    def __call__(self, token: str) -> tuple[_Sample]:
        arguments = self.loader(token)
        raw = self.loader.results.prediction(token)
        if not isinstance(raw, DetectedBoxes):
            return (_Sample(arguments),)
        return (_Sample(arguments, raw, detection_moments(self.loader.dataset, token, arguments[1])),)


class _SanityEvaluator(Evaluator[SanityReport]):
    """Counts each sample three times by a setup's own rules, and what it says of each suspicion."""

    def __init__(self, setup: EvaluationSetup, suspicions: list[Suspicion]) -> None:
        """Start without samples."""
        super().__init__()
        self._setup, self._suspicions, self._rules = setup, suspicions, setup.evaluator()

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
                "facts": _facts(given[0], given[1]),
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
        return SanityReport(
            samples=len(counts),
            **{side: headline_numbers(task, result) for side, result in results.items()},
            units={each.name: each.unit for each in headlines(task, results["given"])},
            candidates=candidates,
            warnings=(
                *(warning_of(by_name[each.name], each) for each in candidates if each.suspected),
                *_plain_warnings([each["facts"] for each in counts], ranked=_is_ranked(task, results["given"])),
            ),
        )

    def _counted(self, token: str, arguments: Arguments) -> Counts:
        one = self._rules.fresh()
        one.update(token, *arguments)
        return one.counts[token]


def _says_something(results: Results) -> Callable[[str], bool]:
    """Whether a sample has a prediction that can be compared: of accidents, of which a model may foresee few, an alarm.

    Maps and boxes nearly always show somebody, and maps take long to read.
    """
    return lambda token: results.task != "accident" or bool(results.prediction(token))


def _suspicions(results: Results) -> list[Suspicion]:
    if results.form is not None:
        return motion_suspicions(results.form.grid.orientation, heads=results.form.stored == "heads")
    return detection_suspicions() if results.task == "detection" else accident_suspicions()


def _tallies(sample: _Sample) -> dict[str, list[float]]:
    prediction, truth, *more = sample.arguments
    if isinstance(prediction, MotionOutput):
        return motion_tallies(prediction, truth)
    if sample.raw is not None and sample.moments is not None:
        return detection_tallies(sample.raw, prediction, sample.moments)
    context = next((each for each in more if isinstance(each, AccidentContext)), AccidentContext())
    return {} if context.truth is None else accident_tallies(prediction, context.truth)


def _facts(prediction: Any, truth: Any) -> dict[str, Any]:
    """What shows without a suspicion: whether nothing is predicted, which ids stay, and which scores there are."""
    if isinstance(prediction, MotionOutput):
        return {"empty": is_empty(prediction, frames_there(truth)), "ids": ids_kept(prediction, truth), "scores": []}
    if isinstance(prediction, DetectedBoxes):
        scores = prediction.scores.tolist()
    else:
        scores = [each.score for each in prediction]
    return {"empty": not scores, "ids": [0, 0], "scores": scores}


def _is_ranked(task: str, result: object) -> bool:
    """Whether some number of a result is of the order of scores."""
    return task == "warning" or bool(_RANKED & {each.name for each in headlines(task, result)})


def _plain_warnings(facts: Collection[Mapping[str, Any]], *, ranked: bool) -> list[str]:
    warnings = []
    if all(each["empty"] for each in facts):
        warnings.append(f"all {len(facts)} predictions looked at are empty: nothing is predicted in them")
    kept, pairs = (sum(each["ids"][index] for each in facts) for index in (0, 1))
    if pairs >= _PAIRS and kept < _FEWEST_KEPT * pairs:
        warnings.append(
            f"ids are not linked over time: of {pairs} instances found in two frames on end {kept} keep their id; VPQ "
            "counts the others as missed, so give an instance the same id in all frames"
        )
    scores = [score for each in facts for score in each["scores"]]
    if ranked and len(scores) > 1 and len(set(scores)) == 1:
        warnings.append(
            f"all {len(scores)} scores are {scores[0]:g}: what is taken in the order of scores, such as an average "
            "precision, says little then; give the surer ones higher scores"
        )
    return warnings


_LOOKED_AT = 25
"""Neighbours among which the most telling one is taken."""


def telling_samples(
    dataset: Dataset,
    tokens: Collection[str],
    count: int,
    horizon: float,
    says_something: Callable[[str], bool] = lambda _: True,
) -> list[str]:
    """At most `count` samples, one of each of as many parts of equal length of all tokens, sorted.

    Of a part that is taken which shows most: an accident to come within the horizon, then the longest future within
    it, then the most boxes. Nothing is drawn by chance.

    Args:
        dataset: the release.
        tokens: of the samples.
        count: how many.
        horizon: seconds.
        says_something: whether a sample's prediction does; of samples with an accident to come those that do are taken
            first.

    Raises:
        TokenError: there is no such sample.
    """
    ordered = sorted(tokens)
    count = min(count, len(ordered))
    bounds = [round(number * len(ordered) / count) for number in range(count + 1)] if count else []
    return [
        max(_spread(ordered[first:last]), key=lambda token: _telling(dataset, token, horizon, says_something))
        for first, last in pairwise(bounds)
    ]


def _spread(tokens: list[str]) -> list[str]:
    return tokens[:: max(1, len(tokens) // _LOOKED_AT)]


def _telling(
    dataset: Dataset, token: str, horizon: float, says_something: Callable[[str], bool]
) -> tuple[bool, bool, float, int]:
    sample = dataset.get("sample", token)
    to_impact = sample["time_to_impact"]
    comes = to_impact is not None and to_impact <= horizon + FRAME_PERIOD / 2
    return comes, comes and says_something(token), min(sample["time_to_end"], horizon), sample["num_annotations"]
