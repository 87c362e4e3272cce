"""Results files of the baselines: predictions of many samples, written like those of a model."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, get_args

from deepaccident_devkit.baselines.motion_models import MotionModel
from deepaccident_devkit.baselines.predict import predict_accidents, predict_detections, predict_motion
from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.evaluation import Accident, DetectedBoxes, MotionOutput
from deepaccident_devkit.evaluation.results import ResultsTask, ResultsWriter
from deepaccident_devkit.motion import MotionLabelConfig
from deepaccident_devkit.parallel import run_unordered
from deepaccident_devkit.taxonomy import FRAME_PERIOD
from deepaccident_devkit.text import choice, settle_choices
from deepaccident_devkit.v2x import AgentConfig, Agents, Link

Prediction = MotionOutput | list[Accident] | DetectedBoxes
_BATCH: Final = 8
"""Samples that a worker predicts before it reports."""


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


def predict_results(
    dataset: Dataset,
    task: ResultsTask,
    tokens: Sequence[str],
    out: str | os.PathLike[str],
    baseline: Baseline | None = None,
    *,
    workers: int | None = None,
    progress: bool = False,
) -> Path:
    """Write a baseline's predictions of samples to a results file (of motion, a folder); returns its path.

    The bytes do not depend on the number of workers.

    Args:
        dataset: the release.
        task: `motion`, `accident` or `detection`.
        tokens: of the samples.
        out: the file or folder to write.
        baseline: None for a single vehicle and constant velocity.
        workers: processes; None takes what the work is worth.
        progress: whether to show a bar.

    Raises:
        ChoiceError: no such task.
        ResultsError: a token comes twice, or the file cannot be written.
        DeepAccidentError: a sample cannot be predicted.
        WorkerError: a worker was killed.
    """
    task = choice("task", task, get_args(ResultsTask))
    chosen = baseline or Baseline()
    config = chosen.config
    settings: Mapping[str, Any] = (
        {"grid": config.grid, "step": config.step * FRAME_PERIOD, "labels": "released"} if task == "motion" else {}
    )
    with ResultsWriter(out, task, meta=chosen.meta(), **settings) as writer:
        jobs = [_Job(dataset, task, tuple(tokens[at : at + _BATCH]), chosen) for at in range(0, len(tokens), _BATCH)]
        for token, prediction in _predicted(jobs, workers, progress=progress):
            writer.add(token, prediction)
    return Path(out)


@dataclass(frozen=True, slots=True)
class _Job:
    dataset: Dataset
    task: ResultsTask
    tokens: tuple[str, ...]
    baseline: Baseline


def _predict(job: _Job) -> list[Prediction]:
    return [job.baseline.predict(job.dataset, job.task, token) for token in job.tokens]


def _predicted(jobs: Sequence[_Job], workers: int | None, *, progress: bool) -> Iterator[tuple[str, Prediction]]:
    """Tokens and predictions in the order of the jobs."""
    waiting: dict[int, list[Prediction]] = {}
    following = 0
    sizes = [len(job.tokens) for job in jobs]
    done = run_unordered(_predict, jobs, workers=workers, label="samples", progress=progress, sizes=sizes)
    with closing(done):
        for position, predictions in done:
            waiting[position] = predictions
            while following in waiting:
                yield from zip(jobs[following].tokens, waiting.pop(following), strict=True)
                following += 1
