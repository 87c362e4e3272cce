"""A model: its predictions, the scores of an evaluation, and its worst samples."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from deepaccident_devkit.errors import EvaluationError, ResultsError
from deepaccident_devkit.evaluation.results import Results, read_results
from deepaccident_devkit.evaluation.runs import Bundle, read_bundle
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup, evaluator_class, scenario_of
from deepaccident_devkit.evaluation.task import headlines, value_text
from deepaccident_devkit.plugins.explore.background import Job, Jobs
from deepaccident_devkit.plugins.explore.evaluations import read_finite
from deepaccident_devkit.support.arrays import FloatArray

if TYPE_CHECKING:
    from deepaccident_devkit.plugins.explore.scenarios import Scenarios


class Score(NamedTuple):
    """The main number of one or several samples.

    Attributes:
        value: The number; None if there is nothing to count.
        text: The number with its unit.
    """

    value: float | None
    text: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Scores:
    """The main numbers of a bundle's samples and scenarios.

    Attributes:
        name: Name of the number, such as `apa`.
        higher_is_better: Whether a higher number is better.
        samples: Score of each sample by token, the worst first; samples with nothing to count are
            last.
        scenarios: Score over each scenario's samples, by scenario.
    """

    name: str
    higher_is_better: bool
    samples: Mapping[str, Score]
    scenarios: Mapping[str, Score]


@dataclass(frozen=True, kw_only=True, eq=False)
class Model:
    """A model's results, the bundle of an evaluation, or both; safe to read from several threads.

    Attributes:
        name: Name in addresses and for readers, from the bundle's folder or the results' file.
        bundle: Bundle of the evaluation; None for results without one.
        results: Results; None if those of the bundle were not found.
        jobs: Background work, which computes the scores.
    """

    name: str
    bundle: Bundle | None
    results: Results | None
    jobs: Jobs

    @cached_property
    def setup(self) -> EvaluationSetup:
        """Rules of the evaluation: the bundle's or, without one, those for the kind of results."""
        if self.bundle is not None:
            return self.bundle.setup
        task = "accident"
        form = None
        if self.results is not None:
            task = self.results.task
            form = self.results.form
        horizon = 2.0
        if form is not None:
            horizon = min(2.0, form.lookahead)
        protocol = next(iter(evaluator_class(task).protocols), "")
        if task == "accident":
            protocol = "boxes"  # the first protocol compares only motion
        return EvaluationSetup(task=task, protocol=protocol, horizon=horizon or 0.5)

    @property
    def missing_results(self) -> str:
        """A sentence with the remedy if the results of the bundle were not found; empty if not."""
        if self.bundle is None or self.results is not None:
            return ""
        path = self.bundle.summary["results"]["path"]
        return (
            f"The predictions are not shown: the bundle has no copy of them, and {path} is missing "
            "or has changed. Pass them with --results PATH, or evaluate with --include-results."
        )

    @cached_property
    def rows(self) -> Mapping[str, Mapping[str, Any]]:
        """Rows of `samples.parquet` by sample token; empty without a bundle."""
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
        """Job that computes the scores; it is started if necessary.

        Its result is `Scores`, or None without a bundle.
        """
        name = f"scores {self.name}"
        title = f"scores of {self.name}"
        return self.jobs.ask(name, title, self._compute_scores)

    @property
    def scores(self) -> Scores | None:
        """The scores; None until they are computed, and always None without a bundle."""
        return None if self.bundle is None else self.job.result

    def numbers(self, scenarios: Scenarios) -> FloatArray | None:
        """Return the score of each scenario, shape (N,), with NaN for scenarios without one.

        Return None until the scores are computed.
        """
        scores = self.scores
        if scores is None:
            return None
        numbers = np.full(len(scenarios), math.nan)
        for token, score in scores.scenarios.items():
            if token in scenarios.row_of and score.value is not None:
                numbers[scenarios.row_of[token]] = score.value
        return numbers

    def _compute_scores(self) -> Scores | None:
        if self.bundle is None:
            return None
        evaluator = self.bundle.evaluator()
        by_path = {headline.path: headline for headline in headlines(evaluator.compute())}
        paths = [path for path in evaluator.main_numbers if path in by_path]
        if not paths:  # This protocol has no such number.
            name = next(iter(evaluator.main_numbers), "")
            return Scores(name=name, higher_is_better=True, samples={}, scenarios={})
        main = by_path[paths[0]]
        higher_is_better = main.higher_is_better is not False

        sign = 1 if higher_is_better else -1

        def score(tokens: Sequence[str]) -> Score:
            value = None
            for headline in headlines(evaluator.compute(tokens)):
                if headline.path == main.path:
                    value = headline.value
                    break
            return Score(value, value_text(value, main.unit))

        def sort_key(item: tuple[str, Score]) -> tuple[bool, float]:
            value = item[1].value
            return value is None, sign * (value or 0.0)

        by_scenario: dict[str, list[str]] = {}
        samples = {}
        for token in sorted(evaluator.tokens):
            by_scenario.setdefault(scenario_of(token), []).append(token)
            samples[token] = score([token])
        return Scores(
            name=main.name,
            higher_is_better=higher_is_better,
            samples=dict(sorted(samples.items(), key=sort_key)),
            scenarios={scenario: score(tokens) for scenario, tokens in by_scenario.items()},
        )


def open_models(bundles: Iterable[Path], results: Iterable[Path], jobs: Jobs) -> dict[str, Model]:
    """Open the models of bundles and results; return them by name, in the order passed.

    The results of a bundle are its own copy or, without one, the results with its fingerprint among
    `results` or at the path that it names. Raises ResultsError if a bundle or other results cannot
    be read.
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
        if own_results is None:
            own_results = _find_named_results(bundle)
        # `resolve` would follow links.
        name = _choose_name(Path(os.path.abspath(folder)).name, models)  # noqa: PTH100
        models[name] = Model(name=name, bundle=bundle, results=own_results, jobs=jobs)
    for path, unpaired in results_by_path.items():
        if path not in paired_paths:
            name = _choose_name(Path(os.path.abspath(path)).stem, models)  # noqa: PTH100
            models[name] = Model(name=name, bundle=None, results=unpaired, jobs=jobs)
    return models


def _find_named_results(bundle: Bundle) -> Results | None:
    """Return the results at the path that a bundle names, if they still have its fingerprint.

    A bundle may come from anywhere, so nothing else at this path is shown, not even its fault.
    """
    named = bundle.summary["results"]
    try:
        results = read_results(named["path"])
    except ResultsError:
        return None
    return results if results.fingerprint == named.get("fingerprint") else None


def _choose_name(name: str, used_names: Mapping[str, object]) -> str:
    """Choose a model's name; a number is appended if another model already has the name.

    A name that consists only of dots is replaced, since it cannot be part of an address.
    """
    base_name = name if name.strip(".") else "model"
    unused_name = base_name
    number = 2
    while unused_name in used_names:
        unused_name = f"{base_name}-{number}"
        number += 1
    return unused_name


def request_sample_values(jobs: Jobs, model: Model) -> Job:
    """Return the job that computes `rank_samples` of a model that has a bundle.

    It runs after the job that computes the scores of the model.
    """
    _ = model.job  # This job begins first.
    title = f"the worst samples of {model.name}"
    return jobs.ask(f"order {model.name}", title, lambda: rank_samples(model))


def rank_samples(model: Model) -> dict[str, float | None]:
    """Return the main number of each sample by token, the worst first.

    Some protocols have no main number for a sample where there is nothing to detect. If something
    is predicted there, its number is 0, so that false alarms are among the worst samples. If
    nothing is, its number is None, and the sample is last. Raises EvaluationError if the model has
    no scores.
    """
    scores = require_scores(model)
    values = {token: score.value for token, score in scores.samples.items()}
    for token, value in values.items():
        if value is None and _has_false_alarm(model.rows.get(token, {})):
            values[token] = 0.0
    sign = 1 if scores.higher_is_better else -1

    def sort_key(item: tuple[str, float | None]) -> tuple[bool, float, str]:
        token, value = item
        return value is None, sign * (value or 0.0), token

    return dict(sorted(values.items(), key=sort_key))


def require_scores(model: Model) -> Scores:
    """Return the scores of a model; raise EvaluationError if it has none."""
    scores = model.scores
    if scores is None:
        raise EvaluationError(
            f"{model.name}: has no scores ({model.job.error or 'it has no evaluation'})"
        )
    return scores


def _has_false_alarm(row: Mapping[str, Any]) -> bool:
    """Return whether anything is predicted at a sample where there is nothing to detect."""
    for name, value in row.items():
        is_count = name.startswith("fp_") or name == "detections"
        if is_count and (read_finite(value) or 0) > 0:
            return True
    return False
