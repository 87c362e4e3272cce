"""`Model`: what a model predicts, and how an evaluation scores it, with its worst samples."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.results import Results, read_results
from deepaccident_devkit.evaluation.runs import Bundle, read_bundle
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup, scenario_of
from deepaccident_devkit.evaluation.task import headlines, value_text
from deepaccident_devkit.plugins.explore.background import Job, Jobs
from deepaccident_devkit.plugins.explore.evaluations import finite
from deepaccident_devkit.support.arrays import FloatArray

if TYPE_CHECKING:
    from deepaccident_devkit.plugins.explore.scenarios import Scenarios

# Kind of results → the protocol that pages use without a bundle; `clean` for other kinds.
_PROTOCOL_BY_TASK: Final[Mapping[str, str]] = {
    "motion": "released",
    "accident": "boxes",
    "detection": "released",
}
# Kinds of results that a replay can show.
FORESEEN: Final = ("motion", "accident")


class Score(NamedTuple):
    """The main number of some samples.

    Attributes:
        value: The number; None where there is nothing to count.
        text: The number with its unit.
    """

    value: float | None
    text: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Scores:
    """A bundle's main number.

    Attributes:
        name: Name of the number, such as `apa`.
        higher_is_better: Whether more is better.
        samples: Token → score of the sample; the worst first, samples with nothing to count last.
        scenarios: Scenario → score of its samples.
    """

    name: str
    higher_is_better: bool
    samples: Mapping[str, Score]
    scenarios: Mapping[str, Score]


@dataclass(frozen=True, kw_only=True, eq=False)
class Model:
    """A model's results, an evaluation's bundle, or both; safe to read from several threads.

    Attributes:
        name: Name in addresses and for readers, from the bundle's folder or the results' file.
        bundle: Bundle of the evaluation; None for results without one.
        results: Results; None for a bundle without a copy of its results, if these were not passed.
        jobs: Background work, which computes the scores.
    """

    name: str
    bundle: Bundle | None
    results: Results | None
    jobs: Jobs

    @cached_property
    def setup(self) -> EvaluationSetup:
        """Rules of the evaluation: of the bundle, or the rules for results without one."""
        if self.bundle is not None:
            return self.bundle.setup
        task, form = "accident", None
        if self.results is not None:
            task, form = self.results.task, self.results.form
        horizon = 2.0
        if form is not None:
            horizon = min(2.0, (form.frames - 1) * form.step)
        protocol = _PROTOCOL_BY_TASK.get(task, "clean")
        return EvaluationSetup(task=task, protocol=protocol, horizon=horizon or 0.5)

    @cached_property
    def rows(self) -> Mapping[str, Mapping[str, Any]]:
        """Token → the row of `samples.parquet`; empty without a bundle."""
        if self.bundle is None:
            return {}
        return self.bundle.rows()

    @property
    def tokens(self) -> Iterable[str]:
        """Samples with predictions or scores."""
        if self.results is None:
            return self.rows
        return self.results.tokens

    def has(self, token: str) -> bool:
        """Return whether the model predicts something for a sample."""
        return self.results is not None and token in self.results

    @cached_property
    def scenarios(self) -> frozenset[str]:
        """Scenarios with predictions or scores."""
        return frozenset(map(scenario_of, self.tokens))

    @property
    def job(self) -> Job:
        """The job that computes the scores, begun if necessary.

        Its result is `Scores`, or None without a bundle.
        """
        return self.jobs.ask(f"scores {self.name}", f"scores of {self.name}", self._scores)

    @property
    def scores(self) -> Scores | None:
        """The scores; None until they are computed, and without a bundle."""
        return None if self.bundle is None else self.job.result

    def numbers(self, scenarios: Scenarios) -> FloatArray | None:
        """Return the score of each scenario, shape (N,), NaN without one.

        None until the scores are computed.
        """
        scores = self.scores
        if scores is None:
            return None
        numbers = np.full(len(scenarios), math.nan)
        for token, score in scores.scenarios.items():
            if token in scenarios.row_of and score.value is not None:
                numbers[scenarios.row_of[token]] = score.value
        return numbers

    def _scores(self) -> Scores | None:
        if self.bundle is None:
            return None
        evaluator = self.bundle.evaluator()
        by_path = {headline.path: headline for headline in headlines(evaluator.compute())}
        paths = [path for path in evaluator.main_numbers if path in by_path]
        if not paths:  # this protocol has no such number
            name = next(iter(evaluator.main_numbers), "")
            return Scores(name=name, higher_is_better=True, samples={}, scenarios={})
        main = by_path[paths[0]]
        higher_is_better = main.higher_is_better is not False

        def score(tokens: Sequence[str]) -> Score:
            value = None
            for headline in headlines(evaluator.compute(tokens)):
                if headline.path == main.path:
                    value = headline.value
                    break
            return Score(value, value_text(value, main.unit))

        def badness(item: tuple[str, Score]) -> tuple[bool, float]:
            return _badness(item[1].value, higher_is_better=higher_is_better)

        by_scenario: dict[str, list[str]] = {}
        for token in sorted(evaluator.tokens):
            by_scenario.setdefault(scenario_of(token), []).append(token)
        samples = {token: score([token]) for tokens in by_scenario.values() for token in tokens}
        return Scores(
            name=main.name,
            higher_is_better=higher_is_better,
            samples=dict(sorted(samples.items(), key=badness)),
            scenarios={scenario: score(tokens) for scenario, tokens in by_scenario.items()},
        )


def _badness(value: float | None, *, higher_is_better: bool) -> tuple[bool, float]:
    """Return a key that sorts the worst first, and unknown values last."""
    if value is None:
        return True, 0.0
    return False, value if higher_is_better else -value


def open_models(bundles: Iterable[Path], results: Iterable[Path], jobs: Jobs) -> dict[str, Model]:
    """Return the models of bundles and results, by name in the order given; raise ResultsError.

    A bundle's results are its own copy, or the passed results with its fingerprint: the path that
    it names is not opened, since a bundle may come from anywhere.
    """
    results_by_path = {str(path): read_results(path) for path in results}
    models: dict[str, Model] = {}
    paired_paths: set[str] = set()
    for folder in bundles:
        bundle = read_bundle(folder)
        copy = bundle.results_copy()
        own_results = None
        if copy is not None:
            own_results = read_results(copy)
        fingerprint = bundle.summary["results"].get("fingerprint")
        for path, candidate in results_by_path.items():
            if candidate.fingerprint == fingerprint:
                paired_paths.add(path)
                own_results = own_results or candidate
        # `resolve` would follow links.
        name = _unused_name(Path(os.path.abspath(folder)).name, models)  # noqa: PTH100
        models[name] = Model(name=name, bundle=bundle, results=own_results, jobs=jobs)
    for path, unpaired in results_by_path.items():
        if path not in paired_paths:
            name = _unused_name(Path(os.path.abspath(path)).stem, models)  # noqa: PTH100
            models[name] = Model(name=name, bundle=None, results=unpaired, jobs=jobs)
    return models


def _unused_name(name: str, used_names: Mapping[str, object]) -> str:
    """Return the name, with a number if another model has it.

    A name made only of dots would be no part of an address.
    """
    name = name if name.strip(".") else "model"
    names = [name, *(f"{name}-{number}" for number in range(2, len(used_names) + 3))]
    return next(candidate for candidate in names if candidate not in used_names)


def sample_values_job(jobs: Jobs, model: Model) -> Job:
    """Return the job that computes the `sample_values` of a model with a bundle.

    It runs after the job that computes the model's scores.
    """
    _ = model.job  # begins first
    title = f"the worst samples of {model.name}"
    return jobs.ask(f"order {model.name}", title, lambda: sample_values(model))


def sample_values(model: Model) -> dict[str, float | None]:
    """Return sample → its main number, the worst first; raise EvaluationError without scores.

    Some protocols have no such number for a sample where there is nothing to detect. It counts as 0
    if something is predicted there, so that false alarms are among the worst; a sample with nothing
    at all has None, and is last.
    """
    scores = scores_of(model)
    values = {token: score.value for token, score in scores.samples.items()}
    for token, value in values.items():
        if value is None and _has_false_alarm(model.rows.get(token, {})):
            values[token] = 0.0
    sign = 1 if scores.higher_is_better else -1

    def badness(item: tuple[str, float | None]) -> tuple[bool, float, str]:
        token, value = item
        return value is None, sign * (value or 0.0), token

    return dict(sorted(values.items(), key=badness))


def scores_of(model: Model) -> Scores:
    """Return a model's scores; raise EvaluationError if it has none."""
    scores = model.scores
    if scores is None:
        raise EvaluationError(
            f"{model.name}: has no scores ({model.job.error or 'it has no evaluation'})"
        )
    return scores


def _has_false_alarm(row: Mapping[str, Any]) -> bool:
    """Return whether something is predicted at a sample where there is nothing to detect."""
    for name in row:
        if name.startswith("fp_") or name == "detections":
            if (finite(row[name]) or 0) > 0:
                return True
    return False
