"""A recipe: what a study trains and compares, read from a YAML file.

Everything that does not need torch is checked here. `Recipe` describes the file; docs/studies.md
shows an example. Every fault raises a ConfigError that names the file, the key and the remedy.
"""

import dataclasses
import math
import re
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from itertools import chain, product
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from deepaccident_devkit.errors import ConfigError, DeepAccidentError
from deepaccident_devkit.evaluation.breakdowns import attribute_name
from deepaccident_devkit.evaluation.runs import SampleSelection
from deepaccident_devkit.evaluation.runs.setups import SampleList, ScopeName
from deepaccident_devkit.motion import MotionLabelConfig
from deepaccident_devkit.plugins.baselines.outlook import MotionModel
from deepaccident_devkit.plugins.baselines.predict import path_times
from deepaccident_devkit.plugins.study.numbers import NUMBERS
from deepaccident_devkit.plugins.synth import SynthConfig
from deepaccident_devkit.plugins.synth.spec.reading import Node, parse_yaml
from deepaccident_devkit.selection.conditions import parse_where
from deepaccident_devkit.support.arrays import checked_flag
from deepaccident_devkit.support.json_text import as_record
from deepaccident_devkit.support.reading import fault_text, read_bytes
from deepaccident_devkit.support.text import choice
from deepaccident_devkit.support.values import NamedValues
from deepaccident_devkit.taxonomy import AGENTS
from deepaccident_devkit.v2x import AGENT_SETS, Link

SHIPPED_RECIPES = Path(__file__).parent / "recipes"
# Seconds that a row looks ahead by default.
DEFAULT_HORIZON = 2.0
# The key that converts a synthetic release to nuScenes' format.
NUSCENES = "nuscenes"
# The keys of a row that are fields of its `Link`.
_LINK_EFFECTS = ("latency", "pose_noise", "packet_loss", "budget")
# The keys of a row that may contain a list; each value of the list becomes a row.
_LIST_KEYS = ("agents", "horizon", *_LINK_EFFECTS)
# Largest number of rows after all lists have been expanded.
MAX_ROWS = 1000
# Largest size of a recipe file. Shipped recipes have up to 3,000 characters; PyYAML would take many
# seconds to read a larger file.
_MAX_CHARACTERS = 100_000
# Key → value of a part of a recipe.
Settings = Mapping[str, Any]
# Up to 100 numbers that torch's generator accepts as seeds.
StudySeeds = Annotated[
    tuple[Annotated[int, msgspec.Meta(ge=0, lt=1 << 62)], ...], msgspec.Meta(max_length=100)
]


class _Part(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A part of a recipe."""


class StudyHeadline(_Part, frozen=True, kw_only=True):
    """The main comparison of a study, which is fixed before the study is run.

    Attributes:
        row: Name of the row that is expected to have the higher number.
        less: Name of the row that is expected to have the lower number.
        number: Name of the compared number in `NUMBERS`.
        where: Name of one of the recipe's groups; None for all samples.
    """

    row: str
    less: str
    number: str = "apa"
    where: str | None = None


class TestedOn(_Part, frozen=True, kw_only=True):
    """The samples on which all rows are tested.

    Attributes:
        release: Name of one of the recipe's releases.
        split: `all`, or the name of a split.
        samples: The list of samples; see `SampleSelection`.
        scope: Whether only accidents are tested, or also their normal twins; see `SampleSelection`.
        agents: The agents whose samples are tested; see `SampleSelection`.
        horizon: Seconds before the end from which samples are taken; None for the longest horizon
            of any row.
        where: Filters in the syntax of `--where`; an accident and its normal twin are both tested
            if either one satisfies every filter.
        labels: The protocol of motion labels. The `tiny` presets require `clean`.
        includes_training: Allow models trained on test scenarios, their twins or other recordings
            of them; if False, such a recipe raises an error.
    """

    release: str
    split: str = "all"
    samples: SampleList = "evaluate"
    scope: ScopeName = "all"
    agents: tuple[str, ...] = ("ego_vehicle",)
    horizon: float | None = None
    where: tuple[str, ...] = ()
    labels: str = "released"
    includes_training: bool = False

    def label_config(self, horizon: float | None) -> MotionLabelConfig:
        """Return the config of motion labels up to `horizon` seconds ahead.

        If None, the default horizon is used. Raise ConfigError or ChoiceError if it is not allowed.
        """
        times = path_times(horizon or DEFAULT_HORIZON)
        return MotionLabelConfig(future_frames=len(times), protocol=self.labels)


class StudyRow(_Part, frozen=True, kw_only=True):
    """A row of the tables: what makes the predictions, and from which agents' data.

    Attributes:
        name: Name of the row. In the file, it may refer to keys that contain lists, such as `late
            {latency} s`.
        weights: Which of the recipe's weights a model uses; None without a model.
        baseline: Motion model of a baseline, which extrapolates the actors that agents see
            according to the labels. With `weights`, it extrapolates the model's detections instead,
            and its alarms replace the ones that follow from the model's maps.
        trivial: Used instead of both: `nothing` is an empty map without alarms and boxes;
            `everything` is a map covered by one actor; `labels` are the labels, including the
            future, of the actors that the agents see at t = 0: an upper bound for a model.
        agents: The cooperating agents: a configuration, or names of agents separated by commas.
        control: How a model's inputs are degraded: `blank` blanks all sensors of all agents;
            `strangers` takes partners' data from another pair of scenarios.
        latency: Age of partners' data in seconds; see `Link`.
        pose_noise: Error of partners' positions in metres; see `Link`.
        packet_loss: Probability that a partner's data are lost; see `Link`.
        budget: Bytes per frame; see `Link`. A partner sends either a model's features or boxes.
        horizon: Seconds that the row looks ahead; None for 2, or for what a model's weights define.
        over: Key, number and name of a series of rows that differ in this number; None for other
            rows.
    """

    name: str
    # Prediction.
    weights: str | None = None
    baseline: MotionModel | None = None
    trivial: Literal["nothing", "everything", "labels"] | None = None
    # Inputs.
    agents: str = "all"
    control: Literal["blank", "strangers"] | None = None
    # Communication.
    latency: float = 0.0
    pose_noise: float = 0.0
    packet_loss: float = 0.0
    budget: int | None = None
    # Horizon and series.
    horizon: float | None = None
    over: tuple[str, float, str] | None = None

    @property
    def cooperating(self) -> str | list[str]:
        """The cooperating agents, as accepted by `v2x.cooperating_agents`."""
        if self.agents in AGENT_SETS:
            return self.agents
        return self.agents.split(",")

    @property
    def link(self) -> Link | None:
        """The link's effects on partners' data, None without any; raise ConfigError if invalid."""
        effects: NamedValues = {}
        for name in _LINK_EFFECTS:
            value = getattr(self, name)
            if value:
                effects[name] = value
        if not effects:
            return None
        if self.budget:
            effects["payload"] = "bev" if self.weights else "boxes"
        return Link(**effects)

    @property
    def faults(self) -> list[str]:
        """Messages about keys that cannot be combined."""
        kinds = []
        for name in ("weights", "baseline", "trivial"):
            if getattr(self, name) is not None:
                kinds.append(name)
        has_model_and_baseline = kinds == ["weights", "baseline"]
        extrapolates_model = has_model_and_baseline and self.baseline == "constant_velocity"
        faults = []
        if len(kinds) != 1 and not extrapolates_model:
            faults.append(
                "expected one of weights, baseline and trivial, or weights and the baseline "
                f"constant_velocity, found {' and '.join(kinds) or 'none'}"
            )
        if self.control and not self.weights:
            faults.append("control: changes what a model sees; remove it, or add weights")
        if self.horizon and self.weights:
            faults.append("horizon: is set by the weights; remove it here")
        if self.control and self.budget:
            faults.append("control, budget: cannot be combined; remove one of them")
        return faults


class TrainingPlan(msgspec.Struct, frozen=True, kw_only=True):
    """The settings for training some weights that only recipes have.

    The remaining keys are fields of `ModelChoice` and `TrainConfig`.

    Attributes:
        release: Which of the recipe's releases to learn from; empty for existing weights.
        split: Split of that release to learn from.
        validation: Split of that release on which the best weights are selected; None for none.
        also: Another release to learn from; None for none.
        also_split: Split of the other release.
        mix: Share of the training frames that come from the other release.
        start: Earlier weights of the recipe to start from; called `from` in the file.
        file: Existing weights, as accepted by `deepaccident predict`.
    """

    release: str = ""
    split: str = "all"
    validation: str | None = None
    also: str | None = None
    also_split: str = "all"
    mix: float = 0.5
    start: str | None = msgspec.field(default=None, name="from")
    file: str | None = None


class Recipe(_Part, frozen=True, kw_only=True):
    """A study.

    Attributes:
        title: Title of the page.
        question: The question that the study answers.
        releases: Name → fields of `SynthConfig`, or `dataroot` and `version` of an existing
            release. With `nuscenes: true` the ego vehicle's recordings are converted to nuScenes'
            format and opened by its devkit.
        test: The samples on which all rows are tested.
        rows: The rows of the tables.
        seeds: Seeds of the trainings; a row of a model is run once for each seed.
        weights: Name → keys of `TrainingPlan`, and fields of `ModelChoice` and `TrainConfig`; or
            only `file`. Weights that begin `from` others inherit their model.
        groups: Name → filters as `--where` takes them: numbers are also given for the pairs of
            scenarios in which either scenario matches all filters.
        by: Attributes; numbers are also given for each of their values, as `--by` takes them.
        compare: Pairs of rows that are compared: the first row minus the second.
        headline: Comparison that is fixed beforehand; None for none.
        name: Name of the folder of results: the file's stem, with `-smoke` if it is a smoke run.
    """

    # Description.
    title: str
    question: str
    # Data and models.
    releases: dict[str, dict[str, Any]]
    test: TestedOn
    rows: tuple[StudyRow, ...]
    seeds: StudySeeds = (1,)
    weights: dict[str, dict[str, Any]] = {}
    # Numbers.
    groups: dict[str, tuple[str, ...]] = {}
    by: tuple[str, ...] = ()
    compare: tuple[tuple[str, str], ...] = ()
    headline: StudyHeadline | None = None
    # Output.
    name: str = ""

    @property
    def pairs(self) -> list[tuple[str, str]]:
        """The pairs of rows that are compared, without repetition, the headline first."""
        pairs = list(self.compare)
        if self.headline is not None:
            pairs.insert(0, (self.headline.row, self.headline.less))
        return list(dict.fromkeys(pairs))

    def plan(self, weights: str) -> TrainingPlan:
        """Return the training plan of some weights; raise ValueError if its keys are wrong."""
        return as_record(self.weights[weights], TrainingPlan)


class _Source(msgspec.Struct):
    """The keys of a release that are file names."""

    dataroot: str = ""
    version: str = ""
    spec: str = ""


class _File(msgspec.Struct):
    """The parts of the file that are checked before lists are expanded and paths resolved."""

    rows: list[NamedValues]
    smoke: NamedValues = {}
    releases: dict[str, _Source] = {}


def read_recipe(recipe: str, *, smoke: bool = False) -> Recipe:
    """Read a recipe from a file, or a shipped recipe by name.

    Args:
        recipe: Path of the file, or name of a shipped recipe.
        smoke: Whether to apply the changes in the recipe's part `smoke`.

    Raises:
        ConfigError: If the file does not exist, cannot be read, or is not a recipe.
    """
    path = _find_recipe(recipe)
    content = _read_content(path)
    with recipe_place(path, "the recipe"):
        file = as_record(content, _File)
        name = path.stem
        if smoke:
            if not file.smoke:
                raise ConfigError("smoke: is missing; add this part, or remove --smoke")
            content = _merge_changes(content, file.smoke)
            name = f"{name}-smoke"
        settings = {**content, "name": name}
        settings.pop("smoke", None)
        file = as_record(settings, _File)
        settings["rows"] = _expand_rows(file)
        for release, source in file.releases.items():
            if source.spec:
                settings["releases"][release]["spec"] = str(path.parent / source.spec)
        result = as_record(settings, Recipe)
    _check_recipe(path, result)
    return result


def _find_recipe(recipe: str) -> Path:
    """Return the path of a recipe, which is a file or the name of a shipped recipe."""
    path = Path(recipe)
    if path.suffix in (".yaml", ".yml"):
        return path
    shipped_names = sorted(file.stem for file in SHIPPED_RECIPES.glob("*.yaml"))
    name = choice("RECIPE", recipe, shipped_names, error=ConfigError, also=", or a .yaml file")
    return SHIPPED_RECIPES / f"{name}.yaml"


def _read_content(path: Path) -> Any:
    """Read a YAML file as plain values; raise ConfigError if it is unreadable."""
    try:
        text = read_bytes(path, "spec").decode().strip()
        if len(text) > _MAX_CHARACTERS:
            raise ConfigError(f"{path}: has more than 100,000 characters; split the study")
        return _plain_value(parse_yaml(text or "{}", str(path)))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: {fault_text(error)}; give a YAML file in UTF-8") from error


def _expand_rows(file: _File) -> list[Settings]:
    """Expand the lists in the rows; raise ConfigError if there are no rows or too many."""
    count = 0
    for row in file.rows:
        count += math.prod(map(len, _lists_of_row(row).values()))
    if not 0 < count <= MAX_ROWS:
        raise ConfigError(
            f"rows: expected 1 to {MAX_ROWS:,}, found {count:,}; each value of a list, and each "
            "combination of several lists, makes a row: change the lists"
        )
    expanded_rows: list[Settings] = []
    for row in file.rows:
        expanded_rows += _expand_row(row)
    return expanded_rows


@contextmanager
def recipe_place(path: Path | str, place: str) -> Iterator[None]:
    """Add the recipe and a place in it to the errors of the block; they become ConfigErrors."""
    try:
        yield
    except (DeepAccidentError, ValueError) as error:
        raise ConfigError(f"{path}: {place}: {error}; docs/studies.md shows a recipe") from error


def synth_config_of(source: Settings) -> SynthConfig | None:
    """Return the config of a synthetic release; None for an existing release.

    Raise ConfigError, ChoiceError or ValueError if a field is wrong.
    """
    is_existing = "dataroot" in source
    if is_existing:
        valid_keys = ["dataroot", "version"]
    else:
        valid_keys = [NUSCENES, *(field.name for field in dataclasses.fields(SynthConfig))]
    for key in source:
        choice("key", key, valid_keys)
    settings = dict(source)
    if source.get("spec"):
        settings["spec"] = Path(source["spec"])
    checked_flag(NUSCENES, settings.pop(NUSCENES, False))
    if is_existing:
        return None
    return as_record(settings, SynthConfig)


def _check_recipe(path: Path, recipe: Recipe) -> None:
    """Raise a ConfigError if parts of a recipe contradict each other or the devkit."""
    test = recipe.test
    name_counts = Counter(row.name for row in recipe.rows)
    for name, source in recipe.releases.items():
        with recipe_place(path, f"releases.{name}"):
            synth_config_of(source)
    with recipe_place(path, "test"):
        _check_name("release", test.release, recipe.releases)
        test.label_config(test.horizon)
        SampleSelection(split=test.split, samples=test.samples, agents=test.agents)
    earlier_weights: list[Any] = [None]
    for name in recipe.weights:
        with recipe_place(path, f"weights.{name}"):
            _check_plan(recipe, name, earlier_weights)
        earlier_weights.append(name)
    for row in recipe.rows:
        with recipe_place(path, f"rows: {row.name}"):
            _check_row(row, recipe)
            if name_counts[row.name] > 1:
                raise ConfigError(
                    "name: appears twice; put the keys with lists into the name, such as {agents}"
                )
    with recipe_place(path, "test.where, groups"):
        for text in chain(test.where, *recipe.groups.values()):
            parse_where(text)
    with recipe_place(path, "by"):
        for attribute in recipe.by:
            attribute_name(attribute)
    with recipe_place(path, "compare, headline"):
        for name in chain(*recipe.pairs):
            _check_name("row", name, name_counts)
        if recipe.headline is not None:
            _check_name("number", recipe.headline.number, NUMBERS)
            _check_name("where", recipe.headline.where, (None, *recipe.groups))


def _check_plan(recipe: Recipe, name: str, earlier_weights: Collection[Any]) -> None:
    """Check the plan of some weights, which may start from `earlier_weights`.

    Raise ConfigError or ChoiceError if it is wrong.
    """
    plan = recipe.plan(name)
    if plan.file is not None:
        if len(recipe.weights[name]) > 1:
            raise ConfigError("file: these weights already exist; remove the other keys")
        return
    _check_name("release", plan.release, recipe.releases)
    _check_name("also", plan.also, (None, *recipe.releases))
    _check_name("from (weights listed above)", plan.start, earlier_weights)
    if not 0 < plan.mix < 1:
        raise ConfigError(
            f"mix: expected a share between 0 and 1 of all moments, found {plan.mix!r}"
        )


def _check_name(kind: str, name: str | None, names: Collection[str | None]) -> None:
    """Raise a ChoiceError if `names` lacks `name`; a ConfigError if only its case differs."""
    if choice(kind, name, names) != name:
        raise ConfigError(f"{kind}: found {name!r}; use the same capital letters everywhere")


def _check_row(row: StudyRow, recipe: Recipe) -> None:
    """Raise a ConfigError or ChoiceError if a row, or a name in it, is wrong."""
    faults = row.faults
    if faults:
        raise ConfigError(faults[0])
    _check_name("weights", row.weights, (None, *recipe.weights))
    if row.agents not in AGENT_SETS:
        for agent in row.cooperating:
            _check_name("agents", agent, (*AGENT_SETS, *AGENTS))
    recipe.test.label_config(row.horizon)
    _ = row.link  # creating the link checks its fields


def _lists_of_row(row: Settings) -> dict[str, list[Any]]:
    """Return the lists in a row that are expanded to rows, by key."""
    lists = {}
    for key in _LIST_KEYS:
        if isinstance(row.get(key), list):
            lists[key] = row[key]
    return lists


def _expand_row(row: Settings) -> Iterator[Settings]:
    """Yield one row per combination of the values in a row's lists."""
    lists = _lists_of_row(row)
    if not lists:
        yield row
        return
    number_keys = [key for key in lists if key != "agents"]
    for combination in product(*lists.values()):
        values = dict(zip(lists, combination, strict=True))
        series = None
        if number_keys:
            key = number_keys[0]
            series_name = _fill_name(row.get("name"), {**values, key: "…"})
            series = [key, values[key], series_name]
        name = _fill_name(row.get("name"), values)
        yield {**row, **values, "name": name, "over": series}


def _fill_name(name: object, values: Mapping[Any, Any]) -> str:
    """Replace `{key}` in a name by values.

    `str.format` is not used because it would also read attributes.
    """

    def fill(match: re.Match[str]) -> str:
        value = values.get(match[1], match[0])
        return str(value)

    return re.sub(r"\{(\w+)\}", fill, str(name))


def _merge_changes(value: Any, changes: Any) -> Any:
    """Apply changes to a value; mappings are merged key by key."""
    if not (isinstance(value, dict) and isinstance(changes, dict)):
        return changes
    merged = dict(value)
    for key, change in changes.items():
        merged[key] = _merge_changes(value.get(key), change)
    return merged


def _plain_value(node: Node) -> Any:
    """Convert a YAML node to JSON values."""
    if isinstance(node.value, Mapping):
        return {key: _plain_value(entry) for key, entry in node.value.items()}
    if isinstance(node.value, tuple):
        return [_plain_value(entry) for entry in node.value]
    return node.value
