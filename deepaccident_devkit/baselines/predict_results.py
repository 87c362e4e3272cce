"""Results files of the baselines: predictions of many samples, written like those of a model.

Each scenario's samples are results of their own at first, beside the whole: a killed run loses the scenarios at hand
alone, and shards may be made anywhere.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import chain, groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from deepaccident_devkit._version import __version__
from deepaccident_devkit.baselines.outlook import MotionModel
from deepaccident_devkit.baselines.predict import predict_accidents, predict_detections, predict_motion
from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import ConfigError, DeepAccidentError, ResultsError
from deepaccident_devkit.evaluation import Accident, DetectedBoxes, MotionOutput
from deepaccident_devkit.evaluation.results import ResultsTask, ResultsWriter, read_results
from deepaccident_devkit.files import path_of
from deepaccident_devkit.motion import MotionLabelConfig
from deepaccident_devkit.parallel import (
    MERGE,
    Failure,
    Part,
    Places,
    Shard,
    ShardFiles,
    check_failures,
    check_whole,
    mine,
    part_of,
    run_batch,
)
from deepaccident_devkit.release.fingerprints import digest_of
from deepaccident_devkit.taxonomy import FRAME_PERIOD
from deepaccident_devkit.text import choice, settle_choices
from deepaccident_devkit.v2x import AgentConfig, Agents, Link, cooperating_agents

if TYPE_CHECKING:
    from concurrent.futures import Executor

Prediction = MotionOutput | list[Accident] | DetectedBoxes


@dataclass(frozen=True, slots=True, kw_only=True)
class Baseline:
    """Which agents see, and how seen actors go on.

    Attributes:
        agents: who cooperates, as of `v2x.cooperating_agents`.
        model: how actors go on.
        link: what happens to the partners' data; None for nothing.
        horizon: seconds to look ahead, of motion and accidents; a multiple of 0.5.
    """

    agents: Agents = "single"
    model: MotionModel = "constant_velocity"
    link: Link | None = None
    horizon: float = 2.0

    def __post_init__(self) -> None:
        """Check the model; raises ChoiceError."""
        settle_choices(self, {"model": get_args(MotionModel)})

    @property
    def config(self) -> MotionLabelConfig:
        """The released labels, this far ahead; raises ConfigError."""
        released = MotionLabelConfig()
        frames = self.horizon / (released.step * FRAME_PERIOD)
        if not (1 <= frames < float("inf") and abs(frames - round(frames)) < 1e-6):
            raise ConfigError(f"horizon: {self.horizon!r} s is no number of steps of 0.5 s; choose 0.5, 1, 1.5, …")
        return MotionLabelConfig(future_frames=round(frames))

    def predict(self, dataset: Dataset, task: ResultsTask, token: str) -> Prediction:
        """Its prediction of a sample; raises DeepAccidentError as the functions of `predict`."""
        seeing: dict[str, Any] = {"agents": self.agents, "link": self.link}
        if task == "motion":
            return predict_motion(dataset, token, model=self.model, config=self.config, **seeing)
        if task == "accident":
            return predict_accidents(dataset, token, model=self.model, horizon=self.horizon, **seeing)
        return predict_detections(dataset, token, **seeing)

    def meta(self) -> dict[str, Any]:
        """Its notes in a results file, as JSON holds them."""
        agents = self.agents.name if isinstance(self.agents, AgentConfig) else self.agents
        return {
            "method": f"baseline: what the agents see by the labels, {self.model.replace('_', ' ')}",
            "agents": agents if agents is None or isinstance(agents, str) else list(agents),
            "model": self.model,
            "link": None if self.link is None else asdict(self.link),
            "horizon": self.horizon,
        }


def predict_results(  # noqa: PLR0913 - what, where, and on what
    dataset: Dataset,
    task: ResultsTask,
    tokens: Sequence[str],
    out: str | os.PathLike[str],
    baseline: Baseline | None = None,
    *,
    workers: int | None = None,
    executor: Executor | None = None,
    part: Part | str = None,
    progress: bool = False,
) -> Path:
    """Write a baseline's predictions of samples to a results file (of motion, a folder); returns its path.

    The bytes do not depend on workers or parts. If a call is interrupted, the same call continues it: only the
    scenarios at hand are lost. Complete results of the same samples and settings are left as they are.

    Args:
        dataset: the release.
        task: `motion`, `accident` or `detection`.
        tokens: of the samples.
        out: the file or folder to write.
        baseline: None for a single vehicle and constant velocity.
        workers: processes; None takes what the work is worth.
        executor: any executor of `concurrent.futures` to run on, in place of own workers.
        part: `3/8` for the third of eight parts of the scenarios; `merge` to write the whole once all are there.
        progress: whether to show a bar.

    Raises:
        ChoiceError: no such task or part.
        NotAvailableError: an agent that cooperates is not in this (partial) release.
        ResultsError: a token comes twice, something else stands at `out`, or nothing can be written.
        SomeFailedError: samples of some scenarios cannot be predicted; the others are done.
        UnfinishedError: `part` is `merge`, and some samples are not predicted.
        WorkerError: a worker was killed, or cannot do the work.
    """
    part = part_of(part)
    work = _Work(dataset, choice("task", task, get_args(ResultsTask)), baseline or Baseline())
    path = path_of(out).absolute()
    files, jobs = work.jobs(path, tokens)
    if not work.is_done(path, tokens):
        whole = work.writer(path)  # refuses what stands there
        if part != MERGE:
            own = mine(part, jobs)
            for job in own:
                cooperating_agents(dataset, job.tokens[0], work.baseline.agents)  # fails now, and not in every worker
            places = Places(reads=dataset.places, writes=(files.folder,))
            how: dict[str, Any] = {"workers": workers, "executor": executor, "progress": progress}
            results = run_batch(_predict, own, label=work.task, places=places, **how)
            check_failures([(job.scenario, result) for job, result in zip(own, results, strict=True)], str(path))
        if isinstance(part, Shard):
            return files.folder
        _join(whole, jobs)
    files.remove()
    return path


def is_predicted(
    dataset: Dataset,
    task: ResultsTask,
    tokens: Sequence[str],
    out: str | os.PathLike[str],
    baseline: Baseline | None = None,
) -> bool:
    """Whether `predict_results` has written its results with these arguments before."""
    return _Work(dataset, task, baseline or Baseline()).is_done(path_of(out).absolute(), tokens)


def samples_by_scenario(tokens: Sequence[str]) -> list[tuple[str, ...]]:
    """The samples of each scenario, in the given order; of lists in another order than a release's, runs of them."""
    return [tuple(run) for _, run in groupby(tokens, lambda token: token.rsplit("/", 2)[0])]


@dataclass(frozen=True, slots=True)
class _Work:
    """What is predicted; cheap to pickle."""

    dataset: Dataset
    task: ResultsTask
    baseline: Baseline

    @property
    def meta(self) -> dict[str, Any]:
        """The notes in its results."""
        release = {"version": self.dataset.version, "index": self.dataset.tables_folder.name}
        return {**self.baseline.meta(), "release": release, "devkit": __version__}

    def jobs(self, path: Path, tokens: Sequence[str]) -> tuple[ShardFiles, list[_Job]]:
        """One for each scenario, and the files that they write; raises ResultsError if a token comes twice."""
        if len(set(tokens)) < len(tokens):
            twice = next(token for token, often in Counter(tokens).items() if often > 1)
            raise ResultsError(f"{path}: {twice}: comes twice; give each sample once")
        scenarios = samples_by_scenario(tokens)
        decisive = {"baseline": repr(self.baseline), "task": self.task, "tokens": list(tokens), "meta": self.meta}
        files = ShardFiles(path, digest_of(decisive), "" if self.task == "motion" else ".json")
        places = [files.path(Shard(number, len(scenarios))) for number in range(1, len(scenarios) + 1)]
        return files, [_Job(self, each, place) for each, place in zip(scenarios, places, strict=True)]

    def is_done(self, path: Path, tokens: Sequence[str]) -> bool:
        """Whether its results of these samples are there."""
        try:
            results = read_results(path)
        except ResultsError:  # nothing, or something else
            return False
        return (results.task, results.meta, results.tokens) == (self.task, self.meta, tuple(tokens))

    def writer(self, path: Path) -> ResultsWriter:
        """A writer of its results; raises ResultsError if something stands there."""
        if self.task != "motion":
            return ResultsWriter(path, self.task, meta=self.meta)
        config = self.baseline.config
        step = config.step * FRAME_PERIOD
        return ResultsWriter(path, self.task, meta=self.meta, grid=config.grid, step=step, labels="released")


@dataclass(frozen=True, slots=True)
class _Job:
    """The samples of a scenario, and where their results are kept until all are there."""

    work: _Work
    tokens: tuple[str, ...]
    path: Path

    @property
    def scenario(self) -> str:
        return self.tokens[0].rsplit("/", 2)[0]


def _predict(job: _Job) -> Failure | None:
    """Write the results of a scenario, unless they are there; what cannot be written ends it all."""
    work = job.work
    if job.path.exists():
        return None
    try:
        with work.writer(job.path) as writer:
            for token in job.tokens:
                writer.add(token, work.baseline.predict(work.dataset, work.task, token))
    except ResultsError:
        if not job.path.exists():  # else another process has just written the same
            raise
    except DeepAccidentError as error:
        return Failure(str(error))
    return None


def _join(whole: ResultsWriter, jobs: Sequence[_Job]) -> None:
    """Write the results of all scenarios as one; raises UnfinishedError if some are missing."""
    there = chain.from_iterable(job.tokens for job in jobs if job.path.exists())
    check_whole(list(chain.from_iterable(job.tokens for job in jobs)), set(there), whole.path)
    with whole:
        for job in jobs:
            results = read_results(job.path)
            for token in job.tokens:
                whole.add(token, results.prediction(token))
