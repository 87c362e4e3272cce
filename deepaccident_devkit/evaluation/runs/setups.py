"""What is evaluated: by which rules (`EvaluationSetup`), and at which samples (`SampleSelection`)."""

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
# Samples that a message names.
_SHOWN: Final = 3
# Seconds from one sample of a list to the next.
LIST_STEP: Final = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class SampleSelection:
    """A list of samples, as `motion.samples` makes it.

    Attributes:
        split: `train`, `val`, … or the path of a split file.
        samples: `evaluate` for those within the horizon before the end, `all` for two a second of whole scenarios.
        scope: `accident` for scenarios designed to end in one, `all` for the normal ones, too.
        agents: whose samples, in the order of `taxonomy.AGENTS`; None for all.
        horizon: seconds before the end; only to `evaluate`.
    """

    split: str
    samples: SampleList = "evaluate"
    scope: ScopeName = "accident"
    agents: tuple[str, ...] | None = None
    horizon: float = 2.0

    def __post_init__(self) -> None:
        """Check and put the agents in order; raises ChoiceError."""
        object.__setattr__(self, "split", spelled(os.fspath(self.split), SPLIT_CHOICES))
        settle_choices(self, {"samples": get_args(SampleList), "scope": get_args(ScopeName)})
        if self.agents is not None:
            object.__setattr__(self, "agents", _agents(self.agents))

    def tokens(self, dataset: Dataset) -> list[str]:
        """The samples' tokens by scenario, agent and time.

        Raises:
            ChoiceError: no such split.
            ConfigError: `evaluate` with a horizon that is no number of steps of 0.5 s.
            NotAvailableError: this release has no such samples with labels.
        """
        horizon = self.horizon if self.samples == "evaluate" else LIST_STEP
        steps = horizon / LIST_STEP
        if abs(steps - round(steps)) > 1e-6:
            raise ConfigError(
                f"horizon: samples to evaluate are {LIST_STEP} s apart, so that {horizon:g} s does not say which; "
                f"choose a multiple, or samples='all'"
            )
        listed = samples(
            dataset, self.split, self.samples, "paper", horizon=horizon, scope=self.scope
        )
        if self.samples == "all" and self.scope == "accident":
            listed = [token for token in listed if token.partition("/")[0].endswith("_accident")]
        chosen = [
            token for token in listed if self.agents is None or agent_of(token) in self.agents
        ]
        if not chosen:
            whose = "" if self.agents is None else f" of {', '.join(self.agents)}"
            raise NotAvailableError(
                f"{self.split}: this release has no labelled samples{whose} there ({self.text()}); "
                f"{no_samples_text(dataset, self.split, self.scope)}"
            )
        return chosen

    def as_dict(self) -> dict[str, Any]:
        """All of it, as JSON holds it."""
        return asdict(self) | {"agents": None if self.agents is None else list(self.agents)}

    def text(self) -> str:
        """In words: `split val, samples evaluate (the last 2 s), scope accident, all agents`."""
        within = f" (the last {self.horizon:g} s)" if self.samples == "evaluate" else ""
        whose = "all agents" if self.agents is None else f"agents {', '.join(self.agents)}"
        return f"split {self.split}, samples {self.samples}{within}, scope {self.scope}, {whose}"


def label_rules(task: str) -> dict[str, str]:
    """What to say of the name of a protocol of labels that is given as a protocol of a task."""
    given = (
        "; choose the labels by the switch labels={0!r} (--switch labels={0})"
        if task == "motion"
        else ""
    )
    return {
        name: f"; {name!r} is a protocol of labels{given.format(name)}" for name in LABEL_PROTOCOLS
    }


def scenario_of(token: str) -> str:
    """The scenario's token in a sample's."""
    return token.rsplit("/", 2)[0]


def agent_of(token: str) -> str:
    """The agent's name in a sample's token; empty if it is no sample's token."""
    return token.rsplit("/", 2)[1] if token.count("/") > 1 else ""


def _agents(given: Sequence[str]) -> tuple[str, ...]:
    names = choices("agents", given, AGENTS)
    return tuple(name for name in AGENTS if name in names)


@dataclass(frozen=True, slots=True, kw_only=True)
class Coverage(ShortRepr):
    """Results against the list of samples that are evaluated; tokens in order.

    Attributes:
        expected: how many samples the list has.
        missing: of the list, without a prediction.
        extra: samples of this release with a prediction that are not in the list.
        unknown: tokens of predictions that are no samples of this release.
        splits: that the predictions are of.
        agents: likewise, in the order of `taxonomy.AGENTS`.
        options: of `deepaccident evaluate`, by which exactly the predicted samples are evaluated; empty if unknown.
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
        """Whether the results have each sample of the list, and no other."""
        return not (self.missing or self.extra or self.unknown)

    def to_text(self) -> str:
        """Say which options are missing; if that is unknown, how many samples, with three of each. Or that all fit."""
        if self.is_complete:
            return f"all {self.expected} samples have a prediction, and nothing else has"
        parts = [
            _named(
                self.missing,
                f"without a prediction: {len(self.missing)} of {counted(self.expected, 'sample')}",
            ),
            _named(
                self.extra,
                f"{counted(len(self.extra), 'prediction')} of samples that are not evaluated",
            ),
            _named(
                self.unknown,
                f"{counted(len(self.unknown), 'prediction')} of no sample of this release",
            ),
        ]
        if self.options:
            remedy = "evaluate with these options, too, or predict again without them"
            parts = [f"the predictions are of the samples of {self.options}: {remedy}"]
        elif self.agents:
            parts.append(
                f"the predictions are of --split {', '.join(self.splits)} --agents {','.join(self.agents)}"
            )
        if self.extra and not (self.missing or self.unknown):
            parts.append(
                "leave them out with --allow-partial (allow_partial=True), or evaluate whole scenarios with --samples "
                "all; no sample lacks a prediction, so the numbers are not partial then"
            )
        return "; ".join(part for part in parts if part)


def coverage(
    dataset: Dataset, results: Collection[str], selection: SampleSelection, *, explain: bool = True
) -> Coverage:
    """Compare the tokens of results with the samples that a selection has.

    Args:
        dataset: the release.
        results: tokens of the predictions.
        selection: what is to be evaluated.
        explain: whether to look for `Coverage.options`, which lists the release's samples many times. It is done anyway
            if no sample has a prediction.

    Raises:
        ChoiceError: as of `SampleSelection.tokens`, of the selection itself.
        ConfigError: likewise.
        NotAvailableError: likewise.
    """
    expected, given = selection.tokens(dataset), set(results)
    others = given.difference(expected)
    unknown = {token for token in others if not _is_sample(dataset, token)}
    present = set(map(agent_of, given - unknown))
    of_scenarios = {
        dataset.get("scenario", name)["split"] for name in set(map(scenario_of, given - unknown))
    }
    splits = tuple(name for name in SPLITS if name in of_scenarios)
    agents = tuple(name for name in AGENTS if name in present)
    is_sought = explain or given.isdisjoint(expected)
    is_known = given and not unknown and given != set(expected)
    return Coverage(
        expected=len(expected),
        missing=tuple(token for token in expected if token not in given),
        extra=tuple(sorted(others - unknown)),
        unknown=tuple(sorted(unknown)),
        splits=splits,
        agents=agents,
        options=_missing_options(dataset, given, selection, splits, agents)
        if is_sought and is_known
        else "",
    )


def _missing_options(
    dataset: Dataset,
    tokens: set[str],
    asked: SampleSelection,
    splits: Iterable[str],
    agents: tuple[str, ...],
) -> str:
    """Return the options that select exactly these samples, where they differ; empty if there are none."""
    horizon = max(dataset.get("sample", token)["time_to_end"] for token in tokens)
    possible: dict[str, tuple[Any, ...]] = {
        "split": (asked.split, *splits),
        "samples": get_args(SampleList),
        "scope": get_args(ScopeName),
        "agents": (asked.agents, agents),
        "horizon": (asked.horizon, horizon),
    }
    for values in product(*map(dict.fromkeys, possible.values())):
        made = replace(asked, **dict(zip(possible, values, strict=True)))
        with suppress(ConfigError, NotAvailableError):
            if set(made.tokens(dataset)) == tokens:
                changed = asdict(made).items() - asdict(asked).items()
                texts = {
                    name: ",".join(value) if name == "agents" else value
                    for name, value in sorted(changed)
                }
                return " ".join(f"--{name} {text}" for name, text in texts.items())
    return ""


def release_note(dataset: Dataset, scenarios: Iterable[str]) -> dict[str, Any]:
    """What results note of their release, in `meta` under `release`.

    Args:
        dataset: the release that was predicted.
        scenarios: tokens of the scenarios that have a prediction.
    """
    recordings = dataset.recordings(scenarios)
    return {
        "version": dataset.version,
        "index": dataset.tables_folder.name,
        "recordings": recordings,
    }


def check_recordings(results: Results, dataset: Dataset) -> None:
    """Raise ResultsError if results are of other recordings than the release has under these names.

    Results without such a note, and scenarios that one of the two does not know, are not compared.
    """
    note = results.meta.get("release")
    if not isinstance(note, dict) or not isinstance(stated := note.get("recordings"), dict):
        return
    here = dataset.recordings(stated)
    others = [token for token, hashed in here.items() if hashed != stated[token]]
    if others:
        raise ResultsError(
            f"{results.path}: are of other recordings than {dataset.dataroot} has ({dataset.version}; results of "
            f"{note.get('version')}) for {len(others)} of {len(here)} scenarios, such as {others[0]}, although "
            "they have the same names; evaluate with the release that was predicted, or predict this one. If files of "
            f"the release were restored or edited, the index may be out of date: {INDEX_REMEDY}"
        )


def _is_sample(dataset: Dataset, token: str) -> bool:
    try:
        dataset.getind("sample", token)
    except TokenError:
        return False
    return True


def _named(tokens: Sequence[str], what: str) -> str:
    if not tokens:
        return ""
    more = ", …" if len(tokens) > _SHOWN else ""
    return f"{what} ({', '.join(tokens[:_SHOWN])}{more})"


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
"""The devkit's own tasks by name; a new one has a line here. Plug-ins add theirs: ask `evaluator_class`."""


def is_task(name: str) -> bool:
    """Return whether the devkit or a plug-in has a task."""
    return name in TASKS or name in offers(lambda plugin: plugin.tasks, TASKS).by_name


def evaluator_class(task: str) -> type[Evaluator[Any]]:
    """Return the evaluator of a task, of the devkit or of a plug-in.

    Raises:
        ChoiceError: no such task; if it is one of a plug-in that is not installed, or left out, the message says so.
    """
    name = spelled(task, TASKS)
    if name in TASKS:
        return TASKS[name]
    found = offers(lambda plugin: plugin.tasks, TASKS)
    names = (*TASKS, *found.by_name)
    remedy = f"; if a plug-in has this task, install it. {found.refusals_text()}".rstrip()
    hint = meant_text(str(task), names) or remedy
    evaluator = found.by_name[
        choice("task", task, names, elsewhere={str(task).lower(): hint})
    ].load()
    if not evaluator.protocols:
        raise ConfigError(
            f"{evaluator.__name__}: has no protocols; give it one, such as an empty frozen dataclass"
        )
    return evaluator


# Seconds; recordings are shorter.
_LONGEST_HORIZON: Final = 100


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluationSetup:
    """What is evaluated, and by which rules; two of equal ones give comparable numbers.

    Attributes:
        task: Name of a task, of the devkit or of a plug-in.
        protocol: Name of one of the task's `protocols`.
        switches: choices of the protocol that are changed, by name (`task.switch_names`).
        horizon: seconds that the predictions look ahead; detection has none.
    """

    task: str
    protocol: str = "released"
    switches: Mapping[str, Any] = field(default_factory=dict)
    horizon: float = 2.0

    def __post_init__(self) -> None:
        """Check; raises ChoiceError or ConfigError."""
        task = evaluator_class(self.task)
        object.__setattr__(self, "task", task.task)
        protocols = task.protocols
        protocol = choice(
            f"protocol of {self.task}", self.protocol, protocols, elsewhere=label_rules(self.task)
        )
        object.__setattr__(self, "protocol", protocol)
        if not 0 < self.horizon <= _LONGEST_HORIZON:
            raise ConfigError(
                f"horizon: expected seconds above 0, at most {_LONGEST_HORIZON}, found {self.horizon!r}"
            )
        object.__setattr__(self, "switches", FrozenDict(self.switches))
        switched(protocols[protocol], self.switches)  # refuses impossible choices

    @property
    def rules(self) -> Any:
        """The protocol itself, with the switches."""
        return switched(evaluator_class(self.task).protocols[self.protocol], self.switches)

    def evaluator(self) -> Evaluator[Any]:
        """A new evaluator of these rules."""
        return evaluator_class(self.task)(self.rules)

    def as_dict(self) -> dict[str, Any]:
        """All of it, as JSON holds it, with the evaluator's own `settings`: every choice."""
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
    """The samples that a setup is evaluated at.

    Args:
        setup: its task and horizon.
        split: `train`, `val`, … or the path of a split file.
        samples: None for `all` of tasks that follow whole recordings, and else `evaluate`.
        scope: None for `all` where all samples are evaluated, and else `accident`.
        agents: whose; None for all that the task is for.

    Raises:
        ChoiceError: no such list, scope or agent.
    """
    if agents is None and evaluator_class(setup.task).vehicles_only:
        agents = VEHICLE_AGENTS
    listed: SampleList = samples or (
        "all" if evaluator_class(setup.task).needs_whole_recordings else "evaluate"
    )
    return SampleSelection(
        split=os.fspath(split),
        samples=listed,
        scope=scope or ("all" if listed == "all" else "accident"),
        agents=None if agents is None else _agents(agents),
        horizon=setup.horizon,
    )


@dataclass(frozen=True, slots=True)
class SampleLoader:
    """Makes the arguments of a setup's evaluator for a sample, except the token; cheap to pickle.

    Attributes:
        dataset: where the truth is.
        results: where the predictions are; of a kind that the task is evaluated from.
        setup: the rules.
    """

    dataset: Dataset
    results: Results
    setup: EvaluationSetup

    def __post_init__(self) -> None:
        """Check that the results are of a kind that the rules take, and look far enough; raises EvaluationError."""
        kinds = evaluator_class(self.setup.task).result_kinds
        if self.results.task not in kinds:
            raise EvaluationError(
                f"{self.results.path}: holds {self.results.task} results; {self.setup.task} is evaluated from "
                f"{' or '.join(kinds)} results"
            )
        if self.results.task == "accident" and getattr(self.setup.rules, "maps_alone", False):
            raise EvaluationError(
                f"{self.results.path}: holds explicit accidents; the protocol {self.setup.protocol!r} compares motion: "
                "give motion results, or choose protocol 'paper' or 'boxes'"
            )
        form = self.results.form
        if (
            form is not None
            and (ahead := (form.frames - 1) * form.step) < self.setup.horizon - FRAME_PERIOD / 2
        ):
            raise EvaluationError(
                f"{self.results.path}: its predictions look {ahead:g} s ahead "
                f"({form.frames} frames, {form.step:g} s apart, from the present on), less than the horizon of "
                f"{self.setup.horizon:g} s; add the present frame if it is missing, or evaluate with a shorter horizon"
            )

    @property
    def places(self) -> Places:
        """What workers must see."""
        return Places(reads=(*self.dataset.places, self.results.path))

    def __call__(self, token: str) -> tuple[Any, ...]:
        """Return the prediction of a sample and its truth, which the evaluator's `update` takes."""
        truth = self.setup.evaluator().truth(
            self.dataset, token, self.results.form, self.setup.horizon
        )
        return self.prediction(token), *truth

    def prediction(self, token: str) -> Any:
        """Return the prediction of a sample, boxes in the protocol's frame."""
        return self.setup.evaluator().read(self.results, self.dataset, token)

    def label(self, token: str) -> MotionLabels | None:
        """The sample's motion labels that the results are compared with; None where there is none."""
        return compared_labels(
            self.dataset, token, self.setup.rules, self.results.form, self.setup.horizon
        )


_COUNTS: Final = "counts"


def evaluation_store(out: str | os.PathLike[str], command: str = "") -> Store:
    """The store beside `out`: who has its lock alone writes the evaluation, once all samples are counted.

    `command` says which evaluation that is.
    """
    return Store(
        unfinished_folder(path_of(out)), path_of(out), "evaluates for it", ResultsError, command
    )


def checkpoint_path(
    out: str | os.PathLike[str],
    setup: EvaluationSetup,
    tokens: Collection[str],
    fingerprints: Mapping[str, str],
) -> Path:
    """The folder beside `out` in which such a run keeps its counts.

    Its name is a digest of all that affects the counts: another setup, other samples, other predictions, other labels
    and another devkit have another folder, and so never go on with these counts.

    Args:
        out: the folder that the finished evaluation goes to.
        setup: task and rules.
        tokens: the samples.
        fingerprints: of the predictions and of the labels.
    """
    name = digest_of(
        {
            "devkit": __version__,
            "setup": setup.as_dict(),
            "tokens": sorted(tokens),
            "fingerprints": dict(fingerprints),
        }
    )
    return evaluation_store(out).folder / _COUNTS / name


def remove_checkpoints(out: str | os.PathLike[str]) -> None:
    """Remove all such folders beside `out`, once what they were for is written."""
    store = evaluation_store(out)
    remove_in(store.folder, _COUNTS)
    store.remove()
