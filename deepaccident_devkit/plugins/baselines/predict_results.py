"""Results files of the baselines: predictions of many samples, written like those of a model.

Each scenario's samples are results of their own at first, beside the whole: a killed run loses the scenarios at hand
alone, and several processes share the scenarios.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import ResultsError
from deepaccident_devkit.evaluation.results import (
    Prediction,
    ResultsTask,
    ResultsWriter,
    read_results,
)
from deepaccident_devkit.evaluation.runs.setups import release_note, scenario_of
from deepaccident_devkit.motion import MotionLabelConfig
from deepaccident_devkit.plugins.baselines.outlook import MotionModel
from deepaccident_devkit.plugins.baselines.predict import (
    PATH_HORIZON,
    path_times,
    predict_accidents,
    predict_detections,
    predict_forecasts,
    predict_motion,
    predict_plan,
)
from deepaccident_devkit.release.fingerprints import digest_of
from deepaccident_devkit.support.parallel import Places, Store, unfinished_folder
from deepaccident_devkit.support.text import choice, path_of, settle_choices
from deepaccident_devkit.support.version import __version__
from deepaccident_devkit.taxonomy import FRAME_PERIOD
from deepaccident_devkit.v2x import Agents, Link, cooperating_agents
from deepaccident_devkit.v2x.agents import agents_note
from deepaccident_devkit.v2x.messages import Payload, checked_link, traffic, traffic_note

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.support.parallel import Engine


@dataclass(frozen=True, slots=True, kw_only=True)
class Baseline:
    """Which agents see, and how seen actors go on.

    Attributes:
        agents: who cooperates, as of `v2x.cooperating_agents`.
        model: how actors go on.
        link: what happens to the partners' data; None for nothing. They send boxes if it does not say another payload.
        horizon: seconds to look ahead, of motion and accidents; a multiple of 0.5. Plans and forecasts look at least
            3 s ahead.
    """

    agents: Agents = "single"
    model: MotionModel = "constant_velocity"
    link: Link | None = None
    horizon: float = 2.0

    def __post_init__(self) -> None:
        """Check the model and the link; raises ChoiceError or ConfigError."""
        checked_link(self.link)
        settle_choices(self, {"model": get_args(MotionModel)})

    @property
    def config(self) -> MotionLabelConfig:
        """The released labels, this far ahead; raises ConfigError."""
        return MotionLabelConfig(future_frames=len(path_times(self.horizon)))

    def predict(self, dataset: Dataset, task: ResultsTask, token: str) -> Prediction:
        """Its prediction of a sample; raises DeepAccidentError as the functions of `predict`."""
        seeing: dict[str, Any] = {"agents": self.agents, "link": self.link}
        if task == "motion":
            return predict_motion(dataset, token, model=self.model, config=self.config, **seeing)
        if task == "accident":
            return predict_accidents(
                dataset, token, model=self.model, horizon=self.horizon, **seeing
            )
        if task == "detection":
            return predict_detections(dataset, token, **seeing)
        going: dict[str, Any] = {"model": self.model, "horizon": self.horizon_of(task)}
        if task == "planning":
            return [predict_plan(dataset, token, **going)]
        return predict_forecasts(dataset, token, **going, **seeing)

    def horizon_of(self, task: ResultsTask) -> float:
        """Seconds that its predictions for a task look ahead."""
        return (
            max(self.horizon, PATH_HORIZON) if task in ("planning", "forecasting") else self.horizon
        )

    def meta(self) -> dict[str, Any]:
        """Its notes in a results file, as JSON holds them."""
        return {
            "method": f"baseline: what the agents see by the labels, {self.model.replace('_', ' ')}",
            "agents": agents_note(self.agents),
            "model": self.model,
            "link": None if self.link is None else asdict(self.link),
            "horizon": self.horizon,
        }


def predict_results(
    dataset: Dataset,
    task: ResultsTask,
    tokens: Sequence[str],
    out: str | os.PathLike[str],
    baseline: Baseline | None = None,
    **how: Unpack[Engine],
) -> Path:
    """Write a baseline's predictions of samples to a results file (of motion, a folder); returns its path.

    Scenario follows scenario there, in the order in which the samples name them. Their notes have, as `bytes`, how much
    partners send.

    The bytes do not depend on workers. If a call is interrupted, the same call continues it: only the scenarios at hand
    are lost. Several processes that are given the same `out` share the scenarios. Complete results of the same samples
    and settings are left as they are.

    Args:
        dataset: the release.
        task: of `RESULTS_NAMES`; of planning, samples of vehicles alone.
        tokens: of the samples.
        out: the file or folder to write.
        baseline: None for a single vehicle and constant velocity.
        **how: `workers`, `executor` and `progress`, as `parallel.Engine` says.

    Raises:
        ChoiceError: no such task.
        NotAvailableError: an agent that cooperates is not in this (partial) release.
        ResultsError: a token comes twice, something else stands at `out`, or nothing can be written.
        SomeFailedError: samples of some scenarios cannot be predicted; the others are done.
        WorkerError: a worker was killed, or cannot do the work.
    """
    task, path = choice("task", task, get_args(ResultsTask)), path_of(out).absolute()
    scenarios = samples_by_scenario(path, tokens)
    work = _Work(dataset, task, baseline or Baseline(), tuple(scenarios))
    name = work.digest(scenarios)
    store = Store(unfinished_folder(path), path, "predicts for it", ResultsError, name)
    if work.is_done(path, scenarios):
        store.remove()  # of a process that was killed just before
        return path
    work.writer(path)  # refuses what stands there
    for own in scenarios.values():
        cooperating_agents(
            dataset, own[0], work.baseline.agents
        )  # fails now, and not in every worker
    jobs = {
        scenario: _Job(replace(work, scenarios=(scenario,)), own, store, f"{name}/{scenario}")
        for scenario, own in scenarios.items()
    }
    places = Places(reads=dataset.places, writes=(store.folder,))
    with store.shared() as turn:
        if not work.is_done(path, scenarios):  # by another process meanwhile
            store.run(_predict, jobs, label=work.task, places=places, **how)
        if turn.alone() and not work.is_done(path, scenarios):
            sent = [each for job in jobs.values() for each in read_results(job.path).meta["bytes"]]
            with work.writer(path, traffic_note(sent, work.baseline.link, work.payload)) as whole:
                for job in jobs.values():
                    whole.add_part(read_results(job.path))
            store.remove()
    return path


def is_predicted(
    dataset: Dataset,
    task: ResultsTask,
    tokens: Sequence[str],
    out: str | os.PathLike[str],
    baseline: Baseline | None = None,
) -> bool:
    """Whether `predict_results` has written its results with these arguments before; raises ResultsError as it."""
    path = path_of(out).absolute()
    scenarios = samples_by_scenario(path, tokens)
    work = _Work(dataset, task, baseline or Baseline(), tuple(scenarios))
    return work.is_done(path, scenarios)


def samples_by_scenario(path: Path, tokens: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """The samples of each scenario, in the given order; raises ResultsError, which names `path`, if one comes twice."""
    found: dict[str, dict[str, None]] = {}
    for token in tokens:
        own = found.setdefault(scenario_of(token), {})
        if token in own:
            raise ResultsError(f"{path}: {token}: comes twice; give each sample once")
        own[token] = None
    return {scenario: tuple(own) for scenario, own in found.items()}


@dataclass(frozen=True, slots=True)
class _Work:
    """What is predicted; cheap to pickle."""

    dataset: Dataset
    task: ResultsTask
    baseline: Baseline
    scenarios: tuple[str, ...]

    @property
    def payload(self) -> Payload | int:
        """What partners send."""
        return (self.baseline.link and self.baseline.link.payload) or "boxes"

    @property
    def meta(self) -> dict[str, Any]:
        """The notes in its results, but the bytes that partners send, which follow from these and the samples."""
        horizon, release = (
            self.baseline.horizon_of(self.task),
            release_note(self.dataset, self.scenarios),
        )
        return {
            **self.baseline.meta(),
            "horizon": horizon,
            "release": release,
            "devkit": __version__,
        }

    def digest(self, scenarios: Mapping[str, tuple[str, ...]]) -> str:
        """Of all that decides the results of these samples."""
        tokens = list(chain(*scenarios.values()))
        return digest_of(
            {
                "baseline": repr(self.baseline),
                "task": self.task,
                "tokens": tokens,
                "meta": self.meta,
                "payload": self.payload,  # whose bytes each scenario's results note
            }
        )

    def is_done(self, path: Path, scenarios: Mapping[str, tuple[str, ...]]) -> bool:
        """Whether its results of these samples are there."""
        try:
            results = read_results(path)
        except ResultsError:  # nothing, or something else
            return False
        wanted = self.task, self.meta, tuple(chain(*scenarios.values()))
        there = {name: value for name, value in results.meta.items() if name != "bytes"}
        return (results.task, there, results.tokens) == wanted

    def writer(self, path: Path, sent: object = None) -> ResultsWriter:
        """A writer of its results, with a note on the bytes; raises ResultsError if something stands there."""
        meta = self.meta | {"bytes": sent}
        if self.task != "motion":
            return ResultsWriter(path, self.task, meta=meta)
        config = self.baseline.config
        step = config.step * FRAME_PERIOD
        return ResultsWriter(
            path, self.task, meta=meta, grid=config.grid, step=step, labels="released"
        )


@dataclass(frozen=True, slots=True)
class _Job:
    """The samples of a scenario, and where their results are kept until all are there."""

    work: _Work
    tokens: tuple[str, ...]
    store: Store
    name: str

    @property
    def path(self) -> Path:
        return self.store.path(self.name if self.work.task == "motion" else f"{self.name}.json")


def _predict(job: _Job) -> None:
    """Write the results of a scenario, unless they are there; what cannot be written ends it all."""
    work = job.work
    if job.path.exists():
        return
    try:
        with work.writer(
            job.path,
            [
                traffic(work.dataset, token, work.baseline.agents, work.baseline.link, work.payload)
                for token in job.tokens
            ],
        ) as writer:
            for token in job.tokens:
                writer.add(token, work.baseline.predict(work.dataset, work.task, token))
    except ResultsError as error:
        if isinstance(error.__cause__, OSError):
            raise error.__cause__ from None
        raise
