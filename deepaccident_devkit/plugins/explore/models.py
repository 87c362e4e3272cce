"""`Model`: what a model predicts, and what an evaluation says of it: its scores and its worst samples."""

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

# Kind of results → the protocol by which they are looked at without a bundle; `clean` of others.
_PROTOCOL_OF: Final[Mapping[str, str]] = {
    "motion": "released",
    "accident": "boxes",
    "detection": "released",
}
# Results that a replay can show.
FORESEEN: Final = ("motion", "accident")


class Score(NamedTuple):
    """The main number of some samples.

    Attributes:
        value: None where there is nothing to count.
        text: with its unit.
    """

    value: float | None
    text: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Scores:
    """A bundle's main number.

    Attributes:
        name: of the number, such as `apa`.
        higher_is_better: whether more is better.
        samples: token → its own; the worst first, those with nothing to count last.
        scenarios: scenario → of its samples.
    """

    name: str
    higher_is_better: bool
    samples: Mapping[str, Score]
    scenarios: Mapping[str, Score]


@dataclass(frozen=True, kw_only=True, eq=False)
class Model:
    """A model's results, an evaluation's bundle, or both; safe to read from several threads.

    Attributes:
        name: in addresses and for readers: of the bundle's folder or the results' file.
        bundle: None for results without one.
        results: None for a bundle without a copy of its results, if these were not given.
        jobs: where scores are computed.
    """

    name: str
    bundle: Bundle | None
    results: Results | None
    jobs: Jobs

    @cached_property
    def setup(self) -> EvaluationSetup:
        """The rules: of the bundle, or those by which such results are looked at without one."""
        if self.bundle is not None:
            return self.bundle.setup
        task = self.results.task if self.results is not None else "accident"
        form = None if self.results is None else self.results.form
        horizon = 2.0 if form is None else min(2.0, (form.frames - 1) * form.step)
        return EvaluationSetup(
            task=task, protocol=_PROTOCOL_OF.get(task, "clean"), horizon=horizon or 0.5
        )

    @cached_property
    def rows(self) -> Mapping[str, Mapping[str, Any]]:
        """Token → the row of `samples.parquet`; empty without a bundle."""
        return {} if self.bundle is None else self.bundle.rows()

    @property
    def tokens(self) -> Iterable[str]:
        """The samples that it tells of."""
        return self.rows if self.results is None else self.results.tokens

    def has(self, token: str) -> bool:
        """Whether it predicts something for a sample."""
        return self.results is not None and token in self.results

    @cached_property
    def scenarios(self) -> frozenset[str]:
        """The scenarios that it tells of."""
        return frozenset(map(scenario_of, self.tokens))

    @property
    def job(self) -> Job:
        """The work that gives the scores, begun if it is not; its result is `Scores`, or None without a bundle."""
        return self.jobs.ask(f"scores {self.name}", f"scores of {self.name}", self._scores)

    @property
    def scores(self) -> Scores | None:
        """The scores; None until they are computed, and without a bundle."""
        return None if self.bundle is None else self.job.result

    def numbers(self, scenarios: Scenarios) -> FloatArray | None:
        """(N,) the score of each scenario, NaN where there is none; None until they are computed."""
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
        known = {each.path: each for each in headlines(evaluator.compute())}
        paths = evaluator.main_numbers
        main = next((known[path] for path in paths if path in known), None)
        if main is None:  # this protocol has no such number
            return Scores(
                name=paths[0] if paths else "", higher_is_better=True, samples={}, scenarios={}
            )
        higher = main.higher_is_better is not False

        def score(tokens: Sequence[str]) -> Score:
            result = evaluator.compute(tokens)
            value = next((each.value for each in headlines(result) if each.path == main.path), None)
            return Score(value, value_text(value, main.unit))

        by_scenario: dict[str, list[str]] = {}
        for token in sorted(evaluator.tokens):
            by_scenario.setdefault(scenario_of(token), []).append(token)
        samples = {token: score([token]) for tokens in by_scenario.values() for token in tokens}
        return Scores(
            name=main.name,
            higher_is_better=higher,
            samples=dict(
                sorted(samples.items(), key=lambda item: _badness(item[1].value, higher=higher))
            ),
            scenarios={scenario: score(tokens) for scenario, tokens in by_scenario.items()},
        )


def _badness(value: float | None, *, higher: bool) -> tuple[bool, float]:
    """The worst first, unknown last."""
    return value is None, 0.0 if value is None else value if higher else -value


def open_models(bundles: Iterable[Path], results: Iterable[Path], jobs: Jobs) -> dict[str, Model]:
    """The models of bundles and results, by name in the order given; raises ResultsError.

    A bundle's results are its own copy, or those of the given ones that have its fingerprint: the path that it names is
    not opened, since a bundle may come from anywhere.
    """
    given = {str(path): read_results(path) for path in results}
    models: dict[str, Model] = {}
    paired: set[str] = set()
    for folder in bundles:
        bundle = read_bundle(folder)
        copy = bundle.results_copy()
        found = read_results(copy) if copy is not None else None
        for path, each in given.items():
            if each.fingerprint == bundle.summary["results"].get("fingerprint"):
                paired.add(path)
                found = found or each
        name = _free(Path(os.path.abspath(folder)).name, models)  # noqa: PTH100 - `resolve` would follow links
        models[name] = Model(name=name, bundle=bundle, results=found, jobs=jobs)
    for path, each in given.items():
        if path not in paired:
            name = _free(Path(os.path.abspath(path)).stem, models)  # noqa: PTH100
            models[name] = Model(name=name, bundle=None, results=each, jobs=jobs)
    return models


def _free(name: str, taken: Mapping[str, object]) -> str:
    """The name, or with a number if another one has it; one of dots alone would be no part of an address."""
    name = name if name.strip(".") else "model"
    names = [name, *(f"{name}-{number}" for number in range(2, len(taken) + 3))]
    return next(each for each in names if each not in taken)


def sample_values_job(jobs: Jobs, model: Model) -> Job:
    """The work that gives the `sample_values` of a model that has a bundle, after that which gives its scores."""
    _ = model.job  # which comes first
    return jobs.ask(
        f"order {model.name}", f"the worst samples of {model.name}", lambda: sample_values(model)
    )


def sample_values(model: Model) -> dict[str, float | None]:
    """Sample → its main number, the worst first; raises EvaluationError if the model has no scores.

    Some protocols have no such number of a sample where there is nothing to find. It counts as 0 if something is
    predicted there, so that false alarms are among the worst; a sample with nothing at all has None, and is last.
    """
    scores = scores_of(model)
    found = {token: score.value for token, score in scores.samples.items()}
    for token, value in found.items():
        if value is None and _is_false(model.rows.get(token, {})):
            found[token] = 0.0
    sign = 1 if scores.higher_is_better else -1
    return dict(
        sorted(found.items(), key=lambda item: (item[1] is None, sign * (item[1] or 0.0), item[0]))
    )


def scores_of(model: Model) -> Scores:
    """A model's scores; raises EvaluationError if it has none."""
    scores = model.scores
    if scores is None:
        raise EvaluationError(
            f"{model.name}: has no scores ({model.job.error or 'it has no evaluation'})"
        )
    return scores


def _is_false(row: Mapping[str, Any]) -> bool:
    """Whether something is predicted at a sample where nothing is to be found."""
    return any(
        (finite(row[name]) or 0) > 0
        for name in row
        if name.startswith("fp_") or name == "detections"
    )
