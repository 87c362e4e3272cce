"""Results files of the baselines: predictions of many samples, in the format of model results.

The results of each scenario are first written to a separate file. A killed run thus only loses the
scenarios that it was working on, and several processes can share the scenarios.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, get_args

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import ResultsError
from deepaccident_devkit.evaluation.results import (
    RESULTS_NAMES,
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
    predict_tracks,
)
from deepaccident_devkit.release.fingerprints import digest_of
from deepaccident_devkit.support.parallel import Places, Store, unfinished_folder
from deepaccident_devkit.support.text import PathType, choice, path_of, settle_choices
from deepaccident_devkit.support.values import NamedValues
from deepaccident_devkit.support.version import __version__
from deepaccident_devkit.taxonomy import FRAME_PERIOD
from deepaccident_devkit.v2x import Agents, Link, cooperating_agents
from deepaccident_devkit.v2x.agents import agents_note
from deepaccident_devkit.v2x.messages import Payload, checked_link, traffic, traffic_note

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.support.parallel import Engine

# Tasks that baselines predict; labels contain no map to segment.
PREDICTED_TASKS: Final = tuple(task for task in RESULTS_NAMES if task != "segmentation")


@dataclass(frozen=True, slots=True, kw_only=True)
class Baseline:
    """A baseline: the agents that see, and the motion model of the actors that they see.

    Attributes:
        agents: Agents that cooperate; see `v2x.cooperating_agents`.
        model: Motion model of the actors.
        link: Degradation of the partners' data; None for none. Partners send boxes unless the link
            sets another payload.
        horizon: Seconds to look ahead for motion and accidents; a multiple of 0.5. Plans and
            forecasts look at least 3 s ahead.
    """

    agents: Agents = "single"
    model: MotionModel = "constant_velocity"
    link: Link | None = None
    horizon: float = 2.0

    def __post_init__(self) -> None:
        """Raise a ChoiceError or ConfigError if the model or the link is not allowed."""
        checked_link(self.link)
        settle_choices(self, {"model": get_args(MotionModel)})

    @property
    def config(self) -> MotionLabelConfig:
        """The config of the released labels with this horizon; raise ConfigError if not allowed."""
        times = path_times(self.horizon)
        return MotionLabelConfig(future_frames=len(times))

    def predict(self, dataset: Dataset, task: ResultsTask, token: str) -> Prediction:
        """Predict a sample for a task; errors are as in the functions of `predict`."""
        cooperation: NamedValues = {"agents": self.agents, "link": self.link}
        if task == "detection":
            return predict_detections(dataset, token, **cooperation)
        if task == "tracking":
            return predict_tracks(dataset, token, **cooperation)
        if task == "motion":
            return predict_motion(
                dataset, token, model=self.model, config=self.config, **cooperation
            )
        extrapolation: NamedValues = {"model": self.model, "horizon": self.horizon_of(task)}
        if task == "accident":
            return predict_accidents(dataset, token, **extrapolation, **cooperation)
        if task == "planning":
            return [predict_plan(dataset, token, **extrapolation)]
        return predict_forecasts(dataset, token, **extrapolation, **cooperation)

    def horizon_of(self, task: ResultsTask) -> float:
        """Return how far predictions for a task look ahead, in seconds."""
        if task in ("planning", "forecasting"):
            return max(self.horizon, PATH_HORIZON)
        return self.horizon

    def meta(self) -> dict[str, Any]:
        """Return notes on the baseline for a results file, as JSON values."""
        model_text = self.model.replace("_", " ")
        return {
            "method": f"baseline: what the agents see by the labels, {model_text}",
            "agents": agents_note(self.agents),
            "model": self.model,
            "link": None if self.link is None else asdict(self.link),
            "horizon": self.horizon,
        }


def predict_results(
    dataset: Dataset,
    task: ResultsTask,
    tokens: Sequence[str],
    out: PathType,
    baseline: Baseline | None = None,
    **engine: Unpack[Engine],
) -> Path:
    """Write a baseline's predictions of samples to a results file (a folder for motion).

    The file lists one scenario after another, in the order in which `tokens` first contains them.
    `bytes` in its notes is how much partners send.

    The content does not depend on the number of workers. If a call is interrupted, the same call
    resumes it: only the current scenarios are lost. Several processes with the same `out` share the
    scenarios. Complete results of the same samples and settings are left unchanged.

    Args:
        dataset: The release.
        task: A task in `PREDICTED_TASKS`; for planning, all samples must be of vehicles.
        tokens: Tokens of the samples.
        out: File or folder to write.
        baseline: The baseline; None for a single vehicle and constant velocity.
        **engine: `workers`, `executor` and `progress`; see `parallel.Engine`.

    Returns:
        Path of the results.

    Raises:
        ChoiceError: If `task` is unknown.
        NotAvailableError: If the (partial) release lacks a cooperating agent.
        ResultsError: If a token occurs twice, something else exists at `out`, or nothing can be
            written.
        SomeFailedError: If samples of some scenarios cannot be predicted; the others are finished.
        WorkerError: If a worker was killed, or cannot do the work.
    """
    task = choice("task", task, PREDICTED_TASKS)
    path = path_of(out).absolute()
    scenarios = samples_by_scenario(path, tokens)
    work = _Work(dataset, task, baseline or Baseline(), tuple(scenarios))
    name = work.digest(scenarios)
    store = Store(unfinished_folder(path), path, "is predicting", ResultsError, name)
    if work.is_done(path, scenarios):
        store.remove()  # left behind by a process that was killed just before this
        return path
    work.writer(path)  # raises if there is other content at the path
    for scenario_tokens in scenarios.values():
        # so that a missing agent fails here, and not in every worker
        cooperating_agents(dataset, scenario_tokens[0], work.baseline.agents)
    jobs = {}
    for scenario, scenario_tokens in scenarios.items():
        scenario_work = replace(work, scenarios=(scenario,))
        jobs[scenario] = _Job(scenario_work, scenario_tokens, store, f"{name}/{scenario}")
    places = Places(reads=dataset.places, writes=(store.folder,))
    with store.shared() as turn:
        if not work.is_done(path, scenarios):  # another process may have finished meanwhile
            store.run(
                _predict_scenario, jobs, label=f"Predicting ({work.task})", places=places, **engine
            )
        if turn.alone() and not work.is_done(path, scenarios):
            sent_bytes: list[Any] = []
            for job in jobs.values():
                sent_bytes += read_results(job.path).meta["bytes"]
            note = traffic_note(sent_bytes, work.baseline.link, work.payload)
            with work.writer(path, note) as writer:
                for job in jobs.values():
                    writer.add_part(read_results(job.path))
            store.remove()
    return path


def is_predicted(
    dataset: Dataset,
    task: ResultsTask,
    tokens: Sequence[str],
    out: PathType,
    baseline: Baseline | None = None,
) -> bool:
    """Return whether `predict_results` has already written results with these arguments.

    Raises:
        ResultsError: If a token occurs twice.
    """
    path = path_of(out).absolute()
    scenarios = samples_by_scenario(path, tokens)
    work = _Work(dataset, task, baseline or Baseline(), tuple(scenarios))
    return work.is_done(path, scenarios)


def samples_by_scenario(path: Path, tokens: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Group samples by scenario, in the order of `tokens`.

    Raises:
        ResultsError: If a sample occurs twice; the message names `path`.
    """
    scenarios: dict[str, dict[str, None]] = {}
    for token in tokens:
        scenario_tokens = scenarios.setdefault(scenario_of(token), {})
        if token in scenario_tokens:
            raise ResultsError(f"{path}: {token}: appears twice; give each sample once")
        scenario_tokens[token] = None
    return {scenario: tuple(scenario_tokens) for scenario, scenario_tokens in scenarios.items()}


@dataclass(frozen=True, slots=True)
class _Work:
    """The settings of predictions; cheap to pickle."""

    dataset: Dataset
    task: ResultsTask
    baseline: Baseline
    scenarios: tuple[str, ...]

    @property
    def payload(self) -> Payload | int:
        """What each partner sends."""
        link = self.baseline.link
        if link is None:
            return "boxes"
        return link.payload or "boxes"

    @property
    def meta(self) -> NamedValues:
        """The notes in the results, except the number of bytes that partners send.

        That number is determined by these notes and the samples.
        """
        return {
            **self.baseline.meta(),
            "horizon": self.baseline.horizon_of(self.task),
            "release": release_note(self.dataset, self.scenarios),
            "devkit": __version__,
        }

    def digest(self, scenarios: Mapping[str, tuple[str, ...]]) -> str:
        """Return a digest of everything that determines the results of these samples."""
        tokens = list(chain(*scenarios.values()))
        return digest_of(
            {
                "baseline": repr(self.baseline),
                "task": self.task,
                "tokens": tokens,
                "meta": self.meta,
                "payload": self.payload,  # each scenario's results note its bytes
            }
        )

    def is_done(self, path: Path, scenarios: Mapping[str, tuple[str, ...]]) -> bool:
        """Return whether complete results of these samples exist."""
        try:
            results = read_results(path)
        except ResultsError:  # there are no results there, or something else
            return False
        meta = {name: value for name, value in results.meta.items() if name != "bytes"}
        tokens = tuple(chain(*scenarios.values()))
        return (results.task, meta, results.tokens) == (self.task, self.meta, tokens)

    def writer(self, path: Path, sent_bytes: object = None) -> ResultsWriter:
        """Return a writer for the results, with a note on the bytes that partners send.

        Raises:
            ResultsError: If something else exists at the path.
        """
        meta = self.meta | {"bytes": sent_bytes}
        if self.task != "motion":
            return ResultsWriter(path, self.task, meta=meta)
        config = self.baseline.config
        step = config.step * FRAME_PERIOD
        return ResultsWriter(
            path, self.task, meta=meta, grid=config.grid, step=step, labels="released"
        )


@dataclass(frozen=True, slots=True)
class _Job:
    """The samples of one scenario, and the store of their results until all are finished."""

    work: _Work
    tokens: tuple[str, ...]
    store: Store
    name: str

    @property
    def path(self) -> Path:
        suffix = ""
        if self.work.task != "motion":
            suffix = ".json"
        return self.store.path(f"{self.name}{suffix}")


def _predict_scenario(job: _Job) -> None:
    """Write the results of a scenario if they are missing.

    If writing fails, an OSError is raised, which ends all work.
    """
    work = job.work
    baseline = work.baseline
    dataset = work.dataset
    if job.path.exists():
        return
    try:
        sent_bytes = []
        for token in job.tokens:
            sent_bytes.append(traffic(dataset, token, baseline.agents, baseline.link, work.payload))
        with work.writer(job.path, sent_bytes) as writer:
            for token in job.tokens:
                prediction = baseline.predict(dataset, work.task, token)
                writer.add(token, prediction)
    except ResultsError as error:
        if isinstance(error.__cause__, OSError):
            raise error.__cause__ from None
        raise
