"""The rules of an evaluation (`EvaluationSetup`), and its samples (`SampleSelection`)."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any, Final, Literal, get_args

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import (
    ConfigError,
    EvaluationError,
    NotAvailableError,
    ResultsError,
    TokenError,
)
from deepaccident_devkit.evaluation.accident import AccidentEvaluator
from deepaccident_devkit.evaluation.detection import DetectionEvaluator
from deepaccident_devkit.evaluation.evaluator import Evaluator
from deepaccident_devkit.evaluation.forecasting import ForecastingEvaluator
from deepaccident_devkit.evaluation.motion import MotionEvaluator
from deepaccident_devkit.evaluation.planning import PlanningEvaluator
from deepaccident_devkit.evaluation.predictions import compared_labels
from deepaccident_devkit.evaluation.results import Results
from deepaccident_devkit.evaluation.task import FrozenDict, switched
from deepaccident_devkit.evaluation.warning import WarningEvaluator
from deepaccident_devkit.motion import LABEL_PROTOCOLS, MotionLabels
from deepaccident_devkit.release.fingerprints import INDEX_REMEDY, digest_of
from deepaccident_devkit.selection.samples import no_samples_text, samples
from deepaccident_devkit.support.arrays import ShortRepr
from deepaccident_devkit.support.files import remove_in
from deepaccident_devkit.support.parallel import Places, Store, unfinished_folder
from deepaccident_devkit.support.plugins import offers
from deepaccident_devkit.support.text import (
    choice,
    choices,
    counted,
    meant_text,
    path_of,
    settle_choices,
    spelled,
)
from deepaccident_devkit.support.version import __version__
from deepaccident_devkit.taxonomy import AGENTS, FRAME_PERIOD, SPLIT_CHOICES, SPLITS, VEHICLE_AGENTS

__all__ = ["TASKS", "EvaluationSetup", "SampleLoader", "evaluator_class", "is_task"]

SampleList = Literal["evaluate", "all"]
ScopeName = Literal["accident", "all"]
# Number of samples that a message names.
_MAX_NAMED_SAMPLES: Final = 3
# Seconds between samples of a list.
LIST_STEP: Final = 0.5
# Tolerance of a horizon in steps.
_STEP_TOLERANCE: Final = 1e-6
# In seconds; recordings are shorter.
_MAX_HORIZON_S: Final = 100
# Folder of an unfinished evaluation's counts.
_COUNTS_FOLDER: Final = "counts"


@dataclass(frozen=True, slots=True, kw_only=True)
class SampleSelection:
    """A list of samples, as made by `motion.samples`.

    Attributes:
        split: `train`, `val`, … or the path of a split file.
        samples: `evaluate` for samples within the horizon before the end, `all` for two a second
            over the full scenarios.
        scope: `accident` for scenarios designed to end in an accident, `all` for normal ones, too.
        agents: Agents of the samples, in the order of `taxonomy.AGENTS`; None for all.
        horizon: Seconds before the end; used only by `evaluate`.
    """

    split: str
    samples: SampleList = "evaluate"
    scope: ScopeName = "accident"
    agents: tuple[str, ...] | None = None
    horizon: float = 2.0

    def __post_init__(self) -> None:
        """Check the choices and put the agents in order; raises ChoiceError."""
        object.__setattr__(self, "split", spelled(os.fspath(self.split), SPLIT_CHOICES))
        settle_choices(self, {"samples": get_args(SampleList), "scope": get_args(ScopeName)})
        if self.agents is not None:
            object.__setattr__(self, "agents", _agents(self.agents))

    def tokens(self, dataset: Dataset) -> list[str]:
        """Return the samples' tokens ordered by scenario, agent and time.

        Raises:
            ChoiceError: no such split.
            ConfigError: `evaluate` with a horizon that is not a multiple of 0.5 s.
            NotAvailableError: this release has no such samples with labels.
        """
        horizon = self.horizon if self.samples == "evaluate" else LIST_STEP
        steps = horizon / LIST_STEP
        if abs(steps - round(steps)) > _STEP_TOLERANCE:
            raise ConfigError(
                f"horizon: samples to evaluate are {LIST_STEP} s apart, so that {horizon:g} s "
                "does not say which; choose a multiple, or samples='all'"
            )
        tokens = samples(
            dataset, self.split, self.samples, "paper", horizon=horizon, scope=self.scope
        )
        if self.samples == "all" and self.scope == "accident":
            tokens = [token for token in tokens if token.partition("/")[0].endswith("_accident")]
        if self.agents is not None:
            tokens = [token for token in tokens if agent_of(token) in self.agents]
        if not tokens:
            of_agents = ""
            if self.agents is not None:
                of_agents = f" of {', '.join(self.agents)}"
            raise NotAvailableError(
                f"{self.split}: this release has no labelled samples{of_agents} there "
                f"({self.text()}); {no_samples_text(dataset, self.split, self.scope)}"
            )
        return tokens

    def as_dict(self) -> dict[str, Any]:
        """Return all choices in JSON form."""
        return asdict(self) | {"agents": None if self.agents is None else list(self.agents)}

    def text(self) -> str:
        """Return the selection in words.

        An example is `split val, samples evaluate (the last 2 s), scope accident, all agents`.
        """
        within = ""
        if self.samples == "evaluate":
            within = f" (the last {self.horizon:g} s)"
        agents = "all agents" if self.agents is None else f"agents {', '.join(self.agents)}"
        return f"split {self.split}, samples {self.samples}{within}, scope {self.scope}, {agents}"


def label_rules(task: str) -> dict[str, str]:
    """Return hints for protocols of labels that are given as a protocol of a task, by name."""
    hints = {}
    for name in LABEL_PROTOCOLS:
        remedy = ""
        if task == "motion":
            remedy = f"; choose the labels by the switch labels={name!r} (--switch labels={name})"
        hints[name] = f"; {name!r} is a protocol of labels{remedy}"
    return hints


def scenario_of(token: str) -> str:
    """Return the token of the scenario of a sample token."""
    return token.rsplit("/", 2)[0]


def agent_of(token: str) -> str:
    """Return the agent's name in a sample's token; empty if it is not a sample's token."""
    if token.count("/") > 1:
        return token.rsplit("/", 2)[1]
    return ""


def _agents(requested: Sequence[str]) -> tuple[str, ...]:
    names = choices("agents", requested, AGENTS)
    return tuple(name for name in AGENTS if name in names)


@dataclass(frozen=True, slots=True, kw_only=True)
class Coverage(ShortRepr):
    """Results compared with the list of samples that are evaluated; tokens are in order.

    Attributes:
        expected: Number of samples in the list.
        missing: Samples of the list without a prediction.
        extra: Samples of this release with a prediction that are not in the list.
        unknown: Tokens of predictions that are no samples of this release.
        splits: Splits of the predictions.
        agents: Agents of the predictions, in the order of `taxonomy.AGENTS`.
        options: Options of `deepaccident evaluate` that select exactly the predicted samples; empty
            if unknown.
    """

    expected: int
    missing: tuple[str, ...] = ()
    extra: tuple[str, ...] = ()
    unknown: tuple[str, ...] = ()
    splits: tuple[str, ...] = ()
    agents: tuple[str, ...] = ()
    options: str = ""

    @property
    def is_complete(self) -> bool:
        """Whether the results have each sample of the list, and no others."""
        return not (self.missing or self.extra or self.unknown)

    def to_text(self) -> str:
        """Return which options are missing, or how many samples, with three of each kind."""
        if self.is_complete:
            return f"all {self.expected} samples have a prediction, and nothing else has"
        parts = self._counts()
        if self.options:
            remedy = "evaluate with these options, too, or predict again without them"
            parts = [f"the predictions are of the samples of {self.options}: {remedy}"]
        elif self.agents:
            splits, agents = ", ".join(self.splits), ",".join(self.agents)
            parts.append(f"the predictions are of --split {splits} --agents {agents}")
        if self.extra and not (self.missing or self.unknown):
            parts.append(
                "leave them out with --allow-partial (allow_partial=True), or evaluate whole "
                "scenarios with --samples all; no sample lacks a prediction, so the numbers are "
                "not partial then"
            )
        return "; ".join(filter(None, parts))

    def _counts(self) -> list[str]:
        """Return how many samples are missing, extra or unknown, and some names; empty for none."""
        expected = counted(self.expected, "sample")
        extra = counted(len(self.extra), "prediction")
        unknown = counted(len(self.unknown), "prediction")
        return [
            _named(self.missing, f"without a prediction: {len(self.missing)} of {expected}"),
            _named(self.extra, f"{extra} of samples that are not evaluated"),
            _named(self.unknown, f"{unknown} of no sample of this release"),
        ]


def coverage(
    dataset: Dataset, results: Collection[str], selection: SampleSelection, *, explain: bool = True
) -> Coverage:
    """Compare the tokens of results with the samples of a selection.

    Args:
        dataset: The release.
        results: Tokens of the predictions.
        selection: The samples to evaluate.
        explain: Whether to look for `Coverage.options`, which lists the release's samples many
            times. This is always done if no sample has a prediction.

    Raises:
        ChoiceError: as in `SampleSelection.tokens`, for the selection itself.
        ConfigError: likewise.
        NotAvailableError: likewise.
    """
    expected, predicted = selection.tokens(dataset), set(results)
    unexpected = predicted.difference(expected)
    unknown = {token for token in unexpected if not _is_sample(dataset, token)}
    samples_of_release = predicted - unknown
    scenarios = set(map(scenario_of, samples_of_release))
    predicted_agents = set(map(agent_of, samples_of_release))
    predicted_splits = {dataset.get("scenario", name)["split"] for name in scenarios}
    splits = tuple(name for name in SPLITS if name in predicted_splits)
    agents = tuple(name for name in AGENTS if name in predicted_agents)
    options = ""
    if explain or predicted.isdisjoint(expected):
        if predicted and not unknown and predicted != set(expected):
            options = _missing_options(dataset, predicted, selection, splits, agents)
    return Coverage(
        expected=len(expected),
        missing=tuple(token for token in expected if token not in predicted),
        extra=tuple(sorted(unexpected - unknown)),
        unknown=tuple(sorted(unknown)),
        splits=splits,
        agents=agents,
        options=options,
    )


def _missing_options(
    dataset: Dataset,
    tokens: set[str],
    requested: SampleSelection,
    splits: Iterable[str],
    agents: tuple[str, ...],
) -> str:
    """Return the options that select exactly these samples, where they differ; empty for none."""
    horizon = max(dataset.get("sample", token)["time_to_end"] for token in tokens)
    values_by_option: dict[str, tuple[Any, ...]] = {
        "split": (requested.split, *splits),
        "samples": get_args(SampleList),
        "scope": get_args(ScopeName),
        "agents": (requested.agents, agents),
        "horizon": (requested.horizon, horizon),
    }
    for values in product(*map(dict.fromkeys, values_by_option.values())):
        selection = replace(requested, **dict(zip(values_by_option, values, strict=True)))
        with suppress(ConfigError, NotAvailableError):
            if set(selection.tokens(dataset)) == tokens:
                changed = asdict(selection).items() - asdict(requested).items()
                return _options_text(changed)
    return ""


def _options_text(options: Iterable[tuple[str, Any]]) -> str:
    """Return options as on a command line, in order of their names."""
    texts = []
    for name, value in sorted(options):
        text = ",".join(value) if name == "agents" else value
        texts.append(f"--{name} {text}")
    return " ".join(texts)


def release_note(dataset: Dataset, scenarios: Iterable[str]) -> dict[str, Any]:
    """Return the note on the release that results have in `meta` under `release`.

    Args:
        dataset: The release that was predicted.
        scenarios: Tokens of the scenarios that have a prediction.
    """
    return {
        "version": dataset.version,
        "index": dataset.tables_folder.name,
        "recordings": dataset.recordings(scenarios),
    }


def check_recordings(results: Results, dataset: Dataset) -> None:
    """Raise ResultsError if results are of other recordings than the release has under their names.

    Results without such a note, and scenarios that are unknown to one of the two, are not compared.
    """
    note = results.meta.get("release")
    if not isinstance(note, dict):
        return
    noted_hashes = note.get("recordings")
    if not isinstance(noted_hashes, dict):
        return
    hashes = dataset.recordings(noted_hashes)
    changed = [token for token, digest in hashes.items() if digest != noted_hashes[token]]
    if changed:
        raise ResultsError(
            f"{results.path}: are of other recordings than {dataset.dataroot} has "
            f"({dataset.version}; results of {note.get('version')}) for {len(changed)} of "
            f"{len(hashes)} scenarios, such as {changed[0]}, although they have the same names; "
            "evaluate with the release that was predicted, or predict this one. If files of the "
            f"release were restored or edited, the index may be out of date: {INDEX_REMEDY}"
        )


def _is_sample(dataset: Dataset, token: str) -> bool:
    try:
        dataset.getind("sample", token)
    except TokenError:
        return False
    return True


def _named(tokens: Sequence[str], text: str) -> str:
    """Return a text with some of the tokens it is about; empty without tokens."""
    if not tokens:
        return ""
    more = ""
    if len(tokens) > _MAX_NAMED_SAMPLES:
        more = ", …"
    return f"{text} ({', '.join(tokens[:_MAX_NAMED_SAMPLES])}{more})"


TASKS: Final[dict[str, type[Evaluator[Any]]]] = {
    evaluator_class.task: evaluator_class
    for evaluator_class in (
        MotionEvaluator,
        AccidentEvaluator,
        DetectionEvaluator,
        WarningEvaluator,
        PlanningEvaluator,
        ForecastingEvaluator,
    )
}
"""The devkit's own tasks by name. Plug-ins have further tasks: call `evaluator_class`."""


def is_task(name: str) -> bool:
    """Return whether the devkit or a plug-in has a task."""
    return name in TASKS or name in offers(lambda plugin: plugin.tasks, TASKS).by_name


def evaluator_class(task: str) -> type[Evaluator[Any]]:
    """Return the evaluator of a task, of the devkit or of a plug-in.

    Raises:
        ChoiceError: no such task; the message names a plug-in with this task that is not installed
            or left out.
    """
    name = spelled(task, TASKS)
    if name in TASKS:
        return TASKS[name]
    offered = offers(lambda plugin: plugin.tasks, TASKS)
    names = (*TASKS, *offered.by_name)
    remedy = f"; if a plug-in has this task, install it. {offered.refusals_text()}".rstrip()
    hint = meant_text(str(task), names) or remedy
    plugin_task = choice("task", task, names, elsewhere={str(task).lower(): hint})
    evaluator = offered.by_name[plugin_task].load()
    if not evaluator.protocols:
        raise ConfigError(
            f"{evaluator.__name__}: has no protocols; give it one, such as an empty frozen "
            "dataclass"
        )
    return evaluator


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluationSetup:
    """Task and rules of an evaluation; equal setups give comparable numbers.

    Attributes:
        task: Name of a task, of the devkit or of a plug-in.
        protocol: Name of one of the task's `protocols`.
        switches: Changed choices of the protocol, by name (`task.switch_names`).
        horizon: Seconds that the predictions look ahead; not used by detection.
    """

    task: str
    protocol: str = "released"
    switches: Mapping[str, Any] = field(default_factory=dict)
    horizon: float = 2.0

    def __post_init__(self) -> None:
        """Check all values; raises ChoiceError or ConfigError."""
        task = evaluator_class(self.task)
        object.__setattr__(self, "task", task.task)
        protocols = task.protocols
        protocol = choice(
            f"protocol of {self.task}", self.protocol, protocols, elsewhere=label_rules(self.task)
        )
        object.__setattr__(self, "protocol", protocol)
        if not 0 < self.horizon <= _MAX_HORIZON_S:
            raise ConfigError(
                f"horizon: expected seconds above 0, at most {_MAX_HORIZON_S}, found "
                f"{self.horizon!r}"
            )
        object.__setattr__(self, "switches", FrozenDict(self.switches))
        switched(protocols[protocol], self.switches)  # raises for impossible choices

    @property
    def rules(self) -> Any:
        """The protocol with the switches applied."""
        return switched(evaluator_class(self.task).protocols[self.protocol], self.switches)

    def evaluator(self) -> Evaluator[Any]:
        """Return a new evaluator with these rules."""
        return evaluator_class(self.task)(self.rules)

    def as_dict(self) -> dict[str, Any]:
        """Return all values in JSON form, with the evaluator's own `settings`: every choice."""
        return asdict(self) | {
            "switches": dict(self.switches),
            "settings": self.evaluator().settings,
        }


def default_selection(
    setup: EvaluationSetup,
    split: str | os.PathLike[str] = "val",
    *,
    samples: SampleList | None = None,
    scope: ScopeName | None = None,
    agents: Sequence[str] | None = None,
) -> SampleSelection:
    """Return the samples that a setup is evaluated at.

    Args:
        setup: Its task and horizon are used.
        split: `train`, `val`, … or the path of a split file.
        samples: None for `all` if the task follows full recordings, otherwise `evaluate`.
        scope: None for `all` where all samples are evaluated, otherwise `accident`.
        agents: Agents of the samples; None for all agents of the task.

    Raises:
        ChoiceError: no such list, scope or agent.
    """
    task = evaluator_class(setup.task)
    if agents is None and task.vehicles_only:
        agents = VEHICLE_AGENTS
    sample_list: SampleList = samples or ("all" if task.needs_whole_recordings else "evaluate")
    return SampleSelection(
        split=os.fspath(split),
        samples=sample_list,
        scope=scope or ("all" if sample_list == "all" else "accident"),
        agents=None if agents is None else _agents(agents),
        horizon=setup.horizon,
    )


@dataclass(frozen=True, slots=True)
class SampleLoader:
    """Makes the arguments of a setup's evaluator for a sample, except the token; cheap to pickle.

    Attributes:
        dataset: Dataset with the ground truth.
        results: Results with the predictions, of a kind that the task is evaluated from.
        setup: The rules.
    """

    dataset: Dataset
    results: Results
    setup: EvaluationSetup

    def __post_init__(self) -> None:
        """Raise EvaluationError if the rules do not take the results, or if they end too early."""
        kinds = evaluator_class(self.setup.task).result_kinds
        if self.results.task not in kinds:
            raise EvaluationError(
                f"{self.results.path}: holds {self.results.task} results; {self.setup.task} is "
                f"evaluated from {' or '.join(kinds)} results"
            )
        if self.results.task == "accident" and getattr(self.setup.rules, "maps_alone", False):
            raise EvaluationError(
                f"{self.results.path}: holds explicit accidents; the protocol "
                f"{self.setup.protocol!r} compares motion: give motion results, or choose "
                "protocol 'paper' or 'boxes'"
            )
        form = self.results.form
        if form is None:
            return
        seconds = (form.frames - 1) * form.step
        if seconds < self.setup.horizon - FRAME_PERIOD / 2:
            raise EvaluationError(
                f"{self.results.path}: its predictions look {seconds:g} s ahead ({form.frames} "
                f"frames, {form.step:g} s apart, from the present on), less than the horizon of "
                f"{self.setup.horizon:g} s; add the present frame if it is missing, or evaluate "
                "with a shorter horizon"
            )

    @property
    def places(self) -> Places:
        """The paths that workers must be able to read."""
        return Places(reads=(*self.dataset.places, self.results.path))

    def __call__(self, token: str) -> tuple[Any, ...]:
        """Return a sample's prediction and truth: the arguments of the evaluator's `update`."""
        evaluator = self.setup.evaluator()
        truth = evaluator.truth(self.dataset, token, self.results.form, self.setup.horizon)
        return self.prediction(token), *truth

    def prediction(self, token: str) -> Any:
        """Return the prediction of a sample, boxes in the protocol's frame."""
        return self.setup.evaluator().read(self.results, self.dataset, token)

    def label(self, token: str) -> MotionLabels | None:
        """Return the motion labels that a sample's results are compared with; None without any."""
        return compared_labels(
            self.dataset, token, self.setup.rules, self.results.form, self.setup.horizon
        )


def evaluation_store(out: str | os.PathLike[str], command: str = "") -> Store:
    """Return the store beside `out`; only the process with its lock writes the evaluation.

    It does so once all samples are counted.

    Args:
        out: Folder of the evaluation.
        command: Digest that identifies the evaluation.
    """
    target = path_of(out)
    return Store(unfinished_folder(target), target, "evaluates for it", ResultsError, command)


def checkpoint_path(
    out: str | os.PathLike[str],
    setup: EvaluationSetup,
    tokens: Collection[str],
    fingerprints: Mapping[str, str],
) -> Path:
    """Return the folder beside `out` in which a run stores its counts.

    Its name is a digest of everything that affects the counts: another setup, other samples, other
    predictions, other labels or another devkit have another folder, and so never continue with
    these counts.

    Args:
        out: Folder of the finished evaluation.
        setup: Task and rules.
        tokens: The samples.
        fingerprints: Fingerprints of the predictions and of the labels.
    """
    name = digest_of(
        {
            "devkit": __version__,
            "setup": setup.as_dict(),
            "tokens": sorted(tokens),
            "fingerprints": dict(fingerprints),
        }
    )
    return evaluation_store(out).folder / _COUNTS_FOLDER / name


def remove_checkpoints(out: str | os.PathLike[str]) -> None:
    """Remove all such folders beside `out`, once the evaluation is written."""
    store = evaluation_store(out)
    remove_in(store.folder, _COUNTS_FOLDER)
    store.remove()
