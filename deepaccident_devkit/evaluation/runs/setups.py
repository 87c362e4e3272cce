"""The rules of an evaluation (`EvaluationSetup`), and its samples (`SampleSelection`)."""

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
from deepaccident_devkit.evaluation.results import MotionForm, Results
from deepaccident_devkit.evaluation.segmentation import SegmentationEvaluator
from deepaccident_devkit.evaluation.task import FrozenDict, switched
from deepaccident_devkit.evaluation.tracking import TrackingEvaluator
from deepaccident_devkit.evaluation.warning import WarningEvaluator
from deepaccident_devkit.motion import LABEL_PROTOCOLS, MotionLabels
from deepaccident_devkit.release.fingerprints import INDEX_REMEDY, digest_of
from deepaccident_devkit.selection.samples import no_samples_text, samples
from deepaccident_devkit.support.arrays import ShortRepr
from deepaccident_devkit.support.files import remove_in
from deepaccident_devkit.support.parallel import Places, Store, unfinished_folder
from deepaccident_devkit.support.plugins import offers
from deepaccident_devkit.support.text import (
    PathType,
    choice,
    choices,
    counted,
    match_spelling,
    meant_text,
    path_of,
    settle_choices,
)
from deepaccident_devkit.support.values import NamedValues
from deepaccident_devkit.support.version import __version__
from deepaccident_devkit.taxonomy import AGENTS, FRAME_PERIOD, SPLIT_CHOICES, SPLITS, VEHICLE_AGENTS

__all__ = ["TASKS", "EvaluationSetup", "SampleLoader", "evaluator_class", "is_task"]

SampleList = Literal["evaluate", "all"]
ScopeName = Literal["accident", "all"]
# A message names at most this many samples.
_MAX_NAMED_SAMPLES = 3
# Seconds between successive samples of a list.
LIST_STEP: Final = 0.5
# A horizon may differ from a whole number of steps by this fraction of a step.
_STEP_TOLERANCE = 1e-6
# Largest horizon; all recordings are shorter.
_MAX_HORIZON_S = 100
# Name of the folder with the counts of an unfinished evaluation.
_COUNTS_FOLDER = "counts"


@dataclass(frozen=True, slots=True, kw_only=True)
class SampleSelection:
    """A list of samples, as made by `motion.samples`.

    Attributes:
        split: `train`, `val`, … or the path of a split file.
        samples: `evaluate` for samples within the horizon before the end, `all` for two samples a
            second over the full scenarios.
        scope: `accident` for scenarios designed to end in an accident, `all` for normal ones, too.
        agents: Agents of the samples, in the order of `taxonomy.AGENTS`; None for all agents.
        horizon: Seconds before the end, only used by `evaluate`.
    """

    split: str
    samples: SampleList = "evaluate"
    scope: ScopeName = "accident"
    agents: tuple[str, ...] | None = None
    horizon: float = 2.0

    def __post_init__(self) -> None:
        """Check the choices and sort the agents; raise ChoiceError if a choice does not exist."""
        object.__setattr__(self, "split", match_spelling(os.fspath(self.split), SPLIT_CHOICES))
        settle_choices(self, {"samples": get_args(SampleList), "scope": get_args(ScopeName)})
        if self.agents is not None:
            object.__setattr__(self, "agents", _order_agents(self.agents))

    def tokens(self, dataset: Dataset) -> list[str]:
        """Return the samples' tokens, ordered by scenario, agent and time.

        Raises:
            ChoiceError: If the split does not exist.
            ConfigError: If `samples` is `evaluate` and the horizon is not a multiple of 0.5 s.
            NotAvailableError: If the release has no labelled samples of this selection.
        """
        horizon = self.horizon if self.samples == "evaluate" else LIST_STEP
        steps = horizon / LIST_STEP
        if abs(steps - round(steps)) > _STEP_TOLERANCE:
            raise ConfigError(
                f"horizon: expected a multiple of {LIST_STEP} s, the time between the evaluated "
                f"samples, found {horizon:g} s; choose a multiple, or samples='all'"
            )
        tokens = samples(
            dataset, self.split, self.samples, "paper", horizon=horizon, scope=self.scope
        )
        if self.samples == "all" and self.scope == "accident":
            tokens = [token for token in tokens if token.partition("/")[0].endswith("_accident")]
        if self.agents is not None:
            tokens = [token for token in tokens if agent_of(token) in self.agents]
        if not tokens:
            agents = ""
            if self.agents is not None:
                agents = f" of {', '.join(self.agents)}"
            raise NotAvailableError(
                f"{self.split}: this split has no labelled samples{agents} in this release "
                f"({self.text()}); {no_samples_text(dataset, self.split, self.scope)}"
            )
        return tokens

    def as_dict(self) -> dict[str, Any]:
        """Convert all fields to JSON-compatible values."""
        values = asdict(self)
        if self.agents is not None:
            values["agents"] = list(self.agents)
        return values

    def text(self) -> str:
        """Describe the selection in words.

        An example is `split val, samples evaluate (the last 2 s), scope accident, all agents`.
        """
        period = ""
        if self.samples == "evaluate":
            period = f" (the last {self.horizon:g} s)"
        agents = "all agents"
        if self.agents is not None:
            agents = f"agents {', '.join(self.agents)}"
        return f"split {self.split}, samples {self.samples}{period}, scope {self.scope}, {agents}"


def label_rules(task: str) -> dict[str, str]:
    """Return hints, by name, for users who pass a label protocol as the protocol of a task."""
    hints = {}
    for name in LABEL_PROTOCOLS:
        remedy = ""
        if task == "motion":
            remedy = f"; choose the labels with the switch labels={name!r} (--switch labels={name})"
        hints[name] = f"; {name!r} is a label protocol{remedy}"
    return hints


def scenario_of(token: str) -> str:
    """Extract the scenario's token from a sample's token."""
    return token.rsplit("/", 2)[0]


def agent_of(token: str) -> str:
    """Extract the agent's name from a sample's token; empty if it is not a sample token."""
    if token.count("/") > 1:
        return token.rsplit("/", 2)[1]
    return ""


def _order_agents(requested: Sequence[str]) -> tuple[str, ...]:
    """Sort agents as in `taxonomy.AGENTS`; raise ChoiceError if one is unknown."""
    names = choices("agents", requested, AGENTS)
    return tuple(name for name in AGENTS if name in names)


@dataclass(frozen=True, slots=True, kw_only=True)
class Coverage(ShortRepr):
    """How the predicted samples differ from the list of samples to evaluate.

    Attributes:
        expected: Number of samples in the list.
        missing: Sorted tokens of samples in the list without a prediction.
        extra: Sorted tokens of predicted samples of this release that are not in the list.
        unknown: Sorted tokens of predictions that do not name a sample of this release.
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
        """Whether the results contain all samples of the list, and no others."""
        return not (self.missing or self.extra or self.unknown)

    def to_text(self) -> str:
        """Say which options are missing, or how many samples differ, with some examples."""
        if self.is_complete:
            return f"all {counted(self.expected, 'sample')} have a prediction, and no others do"
        sentences = self._list_differences()
        if self.options:
            remedy = "evaluate with the same options, or predict again without them"
            sentences = [f"the predictions were made with {self.options}: {remedy}"]
        elif self.agents:
            splits = ", ".join(self.splits)
            agents = ",".join(self.agents)
            sentences.append(f"the predictions cover --split {splits} --agents {agents}")
        if self.extra and not (self.missing or self.unknown):
            sentences.append(
                "ignore them with --allow-partial (allow_partial=True), or evaluate full scenarios "
                "with --samples all; every evaluated sample has a prediction, so the numbers are "
                "not partial"
            )
        return "; ".join(filter(None, sentences))

    def _list_differences(self) -> list[str]:
        """Return texts about missing, extra and unknown samples, which are empty for none."""
        expected = counted(self.expected, "sample")
        extra = counted(len(self.extra), "prediction")
        unknown = counted(len(self.unknown), "prediction")
        return [
            _name_samples(self.missing, f"without a prediction: {len(self.missing)} of {expected}"),
            _name_samples(self.extra, f"{extra} for samples that are not evaluated"),
            _name_samples(self.unknown, f"{unknown} for samples that are not in this release"),
        ]


def coverage(
    dataset: Dataset, results: Collection[str], selection: SampleSelection, *, explain: bool = True
) -> Coverage:
    """Compare the tokens of results with the samples of a selection.

    Args:
        dataset: Release with the samples.
        results: Tokens of the predictions.
        selection: Selection of the samples to evaluate.
        explain: Whether to search for `Coverage.options`, which takes longer; this is always done
            if no sample has a prediction.

    Raises:
        ChoiceError: If the split does not exist.
        ConfigError: If the selection's horizon is invalid; see `SampleSelection.tokens`.
        NotAvailableError: If the release has no labelled samples of this selection.
    """
    expected = selection.tokens(dataset)
    predicted = set(results)
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
    """Return the options that must be changed to select exactly these samples; empty if unknown."""
    horizon = max(dataset.get("sample", token)["time_to_end"] for token in tokens)
    values_by_option: dict[str, tuple[Any, ...]] = {
        "split": (requested.split, *splits),
        "samples": get_args(SampleList),
        "scope": get_args(ScopeName),
        "agents": (requested.agents, agents),
        "horizon": (requested.horizon, horizon),
    }
    distinct_values = map(dict.fromkeys, values_by_option.values())
    for values in product(*distinct_values):
        options = dict(zip(values_by_option, values, strict=True))
        selection = replace(requested, **options)
        with suppress(ConfigError, NotAvailableError):
            if set(selection.tokens(dataset)) == tokens:
                changed = asdict(selection).items() - asdict(requested).items()
                return _options_text(changed)
    return ""


def _options_text(options: Iterable[tuple[str, Any]]) -> str:
    """Format options as on a command line, sorted by name."""
    texts = []
    for name, value in sorted(options):
        text = value
        if name == "agents":
            text = ",".join(value)
        texts.append(f"--{name} {text}")
    return " ".join(texts)


def release_note(dataset: Dataset, scenarios: Iterable[str]) -> NamedValues:
    """Build the note about the release that results store in their `meta` under `release`.

    Args:
        dataset: Release that was predicted.
        scenarios: Tokens of the scenarios that have a prediction.
    """
    return {
        "version": dataset.version,
        "index": dataset.tables_folder.name,
        "recordings": dataset.recordings(scenarios),
    }


def check_recordings(results: Results, dataset: Dataset) -> None:
    """Raise ResultsError if results were predicted on other recordings with the same names.

    Results without a note about their recordings are not checked, nor are scenarios that are
    missing in the note or in the release.
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
            f"{results.path}: were predicted on recordings that differ from the recordings "
            f"in {dataset.dataroot} ({dataset.version}; results of {note.get('version')}). "
            f"{len(changed)} of {counted(len(hashes), 'scenario')} have the same name but "
            f"different content, such as {changed[0]}. Evaluate with the release that was "
            "predicted, or predict this one. If files of the release were restored or edited, "
            f"the index may be outdated: {INDEX_REMEDY}"
        )


def _is_sample(dataset: Dataset, token: str) -> bool:
    """Return whether the release has a sample with this token."""
    try:
        dataset.getind("sample", token)
    except TokenError:
        return False
    return True


def _name_samples(tokens: Sequence[str], text: str) -> str:
    """Append the first tokens, in brackets, to a text about them; empty if there are no tokens."""
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
        TrackingEvaluator,
        WarningEvaluator,
        PlanningEvaluator,
        ForecastingEvaluator,
        SegmentationEvaluator,
    )
}
"""The devkit's own tasks by name. `evaluator_class` also finds the tasks of plug-ins."""


def is_task(name: str) -> bool:
    """Return whether the devkit or a plug-in has a task."""
    if name in TASKS:
        return True
    offered = offers(lambda plugin: plugin.tasks, TASKS)
    return name in offered.by_name


def evaluator_class(task: str) -> type[Evaluator[Any]]:
    """Return the evaluator class of a task of the devkit or of a plug-in.

    Raises:
        ChoiceError: If the task is unknown; if it belongs to a plug-in that is not installed or was
            left out, the message names the plug-in.
    """
    name = match_spelling(task, TASKS)
    if name in TASKS:
        return TASKS[name]
    offered = offers(lambda plugin: plugin.tasks, TASKS)
    names = (*TASKS, *offered.by_name)
    remedy = f"; if a plug-in adds this task, install it. {offered.refusals_text()}".rstrip()
    hint = meant_text(str(task), names) or remedy
    plugin_task = choice("task", task, names, elsewhere={str(task).lower(): hint})
    evaluator = offered.by_name[plugin_task].load()
    if not evaluator.protocols:
        raise ConfigError(
            f"{evaluator.__name__}: has no protocols; give the class a protocol, such as an "
            "empty frozen dataclass"
        )
    return evaluator


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluationSetup:
    """Task and rules of an evaluation; numbers with the same setup are comparable.

    Attributes:
        task: Name of a task of the devkit or of a plug-in.
        protocol: Name of one of the task's `protocols`.
        switches: Name of a changed field of the protocol (`task.switch_names`) → its new value.
        horizon: Seconds that the predictions look ahead; detection and tracking do not use it.
    """

    task: str
    protocol: str = "released"
    switches: Mapping[str, Any] = field(default_factory=dict)
    horizon: float = 2.0

    def __post_init__(self) -> None:
        """Check all fields; raise ChoiceError or ConfigError if one is invalid."""
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
        switched(protocols[protocol], self.switches)  # raises if a choice is invalid

    @property
    def rules(self) -> Any:
        """The protocol with the switches applied."""
        protocols = evaluator_class(self.task).protocols
        return switched(protocols[self.protocol], self.switches)

    def evaluator(self) -> Evaluator[Any]:
        """Create an evaluator with these rules."""
        evaluator_type = evaluator_class(self.task)
        return evaluator_type(self.rules)

    def as_dict(self) -> dict[str, Any]:
        """Convert all fields, and the evaluator's `settings`, to JSON-compatible values."""
        return asdict(self) | {
            "switches": dict(self.switches),
            "settings": self.evaluator().settings,
        }


def default_selection(
    setup: EvaluationSetup,
    split: PathType = "val",
    *,
    samples: SampleList | None = None,
    scope: ScopeName | None = None,
    agents: Sequence[str] | None = None,
) -> SampleSelection:
    """Build the default selection of samples for a setup; arguments override the defaults.

    Args:
        setup: Setup with the task and the horizon.
        split: `train`, `val`, … or the path of a split file.
        samples: List of samples; None takes `all` if the task follows whole recordings, and
            `evaluate` otherwise.
        scope: Scope of the scenarios; None takes `all` if all samples are evaluated, and `accident`
            otherwise.
        agents: Agents of the samples; None for all agents that the task evaluates.

    Raises:
        ChoiceError: If the list, the scope or an agent does not exist.
    """
    task = evaluator_class(setup.task)
    if agents is None and task.vehicles_only:
        agents = VEHICLE_AGENTS
    if not samples:
        samples = "all" if task.needs_whole_recordings else "evaluate"
    if not scope:
        scope = "all" if samples == "all" else "accident"
    return SampleSelection(
        split=os.fspath(split),
        samples=samples,
        scope=scope,
        agents=None if agents is None else _order_agents(agents),
        horizon=setup.horizon,
    )


@dataclass(frozen=True, slots=True)
class SampleLoader:
    """Callable that loads a sample's prediction and truth for an evaluator; cheap to pickle.

    Attributes:
        dataset: Dataset with the ground truth.
        results: Results with the predictions, of a kind that the task can be evaluated from.
        setup: Task and rules of the evaluation.
    """

    dataset: Dataset
    results: Results
    setup: EvaluationSetup

    def __post_init__(self) -> None:
        """Raise EvaluationError if the task needs other results or longer predictions."""
        kinds = evaluator_class(self.setup.task).result_kinds
        if self.results.task not in kinds:
            raise EvaluationError(
                f"{self.results.path}: contains {self.results.task} results; {self.setup.task} is "
                f"evaluated from {' or '.join(kinds)} results"
            )
        if self.results.task == "accident" and getattr(self.setup.rules, "maps_alone", False):
            raise EvaluationError(
                f"{self.results.path}: contains explicit accidents, but the protocol "
                f"{self.setup.protocol!r} evaluates motion; give motion results, or choose "
                "protocol 'paper' or 'boxes'"
            )
        form = self.results.form
        min_seconds = self.setup.horizon - FRAME_PERIOD / 2
        if isinstance(form, MotionForm) and form.lookahead < min_seconds:
            raise EvaluationError(
                f"{self.results.path}: the predictions look {form.lookahead:g} s ahead "
                f"({counted(form.frames, 'frame')}, {form.step:g} s apart, from the present on), "
                f"less than the horizon of {self.setup.horizon:g} s; add the present frame if it "
                "is missing, or evaluate with a shorter horizon"
            )

    @property
    def places(self) -> Places:
        """Paths that workers must be able to read."""
        paths = (*self.dataset.places, self.results.path)
        return Places(reads=paths)

    def __call__(self, token: str) -> tuple[Any, ...]:
        """Load a sample's prediction and truth: the arguments of the evaluator's `update`."""
        evaluator = self.setup.evaluator()
        truth = evaluator.truth(self.dataset, token, self.results.form, self.setup.horizon)
        return self.prediction(token), *truth

    def prediction(self, token: str) -> Any:
        """Load the prediction for a sample; boxes are in the protocol's frame."""
        evaluator = self.setup.evaluator()
        return evaluator.read(self.results, self.dataset, token)

    def label(self, token: str) -> MotionLabels | None:
        """Load the motion labels that a sample is compared with; None if none are needed."""
        return compared_labels(
            self.dataset, token, self.setup.rules, self.results.form, self.setup.horizon
        )


def evaluation_store(out: PathType, command: str = "") -> Store:
    """Return the store, next to the folder of an evaluation, for the counts of an unfinished run.

    Once all samples are counted, only the process that has the store's lock writes the evaluation.

    Args:
        out: Folder of the evaluation.
        command: Digest that identifies the evaluation.
    """
    target = path_of(out)
    return Store(unfinished_folder(target), target, "is evaluating", ResultsError, command)


def checkpoint_path(
    out: PathType,
    setup: EvaluationSetup,
    tokens: Collection[str],
    fingerprints: Mapping[str, str],
) -> Path:
    """Return the folder, next to that of the evaluation, in which a run stores its counts.

    The name of this folder is a digest of everything that affects the counts: the setup, the
    samples, the predictions, the labels and the devkit. So runs that differ in any of these never
    use each other's counts.

    Args:
        out: Folder of the finished evaluation.
        setup: Task and rules.
        tokens: Tokens of the samples.
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


def remove_checkpoints(out: PathType) -> None:
    """Remove the stored counts next to the folder of an evaluation, once it is written."""
    store = evaluation_store(out)
    remove_in(store.folder, _COUNTS_FOLDER)
    store.remove()
