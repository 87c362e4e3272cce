"""A recipe: what a study trains and compares, read from a YAML file.

Everything that does not need torch is checked here. `Recipe` describes the file, and
docs/studies.md shows one. Every fault is a ConfigError that names the file, the key and the remedy.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from itertools import chain, product
from pathlib import Path
from typing import Annotated, Any, Final, Literal

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
from deepaccident_devkit.taxonomy import AGENTS
from deepaccident_devkit.v2x import AGENT_SETS, Link

SHIPPED_RECIPES: Final = Path(__file__).parent / "recipes"
DEFAULT_HORIZON: Final = 2.0
# The key that converts a synthetic release into nuScenes' format.
NUSCENES: Final = "nuscenes"
# The keys of a row that become its `Link`.
_LINK_EFFECTS: Final = ("latency", "pose_noise", "packet_loss", "budget")
# The keys of a row that may hold a list; each value of the list becomes a row.
_LIST_KEYS: Final = ("agents", "horizon", *_LINK_EFFECTS)
# Rows of a recipe, after each list has become one row for each of its values.
MAX_ROWS: Final = 1000
# Characters of a recipe file. Shipped recipes have up to 3,000; PyYAML needs many seconds for more.
_MAX_CHARACTERS: Final = 100_000
# Up to 100 numbers that fit into torch's generator.
StudySeeds = Annotated[
    tuple[Annotated[int, msgspec.Meta(ge=0, lt=1 << 62)], ...], msgspec.Meta(max_length=100)
]


class _Part(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A part of a recipe."""


class StudyHeadline(_Part, frozen=True, kw_only=True):
    """The comparison that is fixed before the study is run.

    Attributes:
        row: Name of the row that is expected to have more.
        less: Name of the row that is expected to have less.
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
        split: `all`, or a split's name.
        samples: The list of samples, as in `SampleSelection`.
        scope: Whether only accidents are tested or their normal twins too, as in `SampleSelection`.
        agents: The agents that the samples belong to, as in `SampleSelection`.
        horizon: Seconds before the end from which samples are taken; None for the longest horizon
            of a row.
        where: Filters as `--where` takes them; a pair of scenarios is tested if either matches all.
        labels: The protocol of motion labels. Models of the presets `tiny` have `clean`.
        includes_training: Whether models may have learned from scenarios of the test, from their
            twins, or from other recordings of them; otherwise such a recipe is refused.
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

        None stands for the default horizon. Raises ConfigError or ChoiceError.
        """
        frame_count = len(path_times(horizon or DEFAULT_HORIZON))
        return MotionLabelConfig(future_frames=frame_count, protocol=self.labels)


class StudyRow(_Part, frozen=True, kw_only=True):
    """A row of the tables: what predicts, and from which agents' data.

    Attributes:
        name: Name of the row. In the file it may contain keys that have lists, such as `late
            {latency} s`.
        weights: Name of the recipe's weights of a model.
        baseline: Motion model of a baseline, which extrapolates the actors that agents see
            according to the labels. With `weights` it extrapolates the model's detections, and its
            alarms replace the alarms that follow from the model's maps.
        trivial: Used instead of both: `nothing` is an empty map without alarms and boxes;
            `everything` is a map covered by one actor; `labels` are the labels of the actors that
            the agents see at the present, including their future: an upper bound for a model.
        agents: The cooperating agents: a configuration, or names of agents separated by commas.
        control: How a model's inputs are spoilt: `blank` blanks all sensors of all agents;
            `strangers` takes partners' data from another pair of scenarios.
        latency: Seconds, as in `Link`.
        pose_noise: Metres, as in `Link`.
        packet_loss: Probability, as in `Link`.
        budget: Bytes a frame, as in `Link`; a partner sends a model's features, or boxes.
        horizon: Seconds that the row looks ahead, None for 2; the weights of a model define theirs.
        over: For a row of a series that differs in a number: key, number, and name of the series.
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
        """The cooperating agents, as `v2x.cooperating_agents` takes them."""
        return self.agents if self.agents in AGENT_SETS else self.agents.split(",")

    @property
    def link(self) -> Link | None:
        """The degradation of partners' data; None for none. Raises ConfigError."""
        effects: dict[str, Any] = {}
        for name in _LINK_EFFECTS:
            value = getattr(self, name)
            if value:
                effects[name] = value
        if self.budget:
            effects["payload"] = "bev" if self.weights else "boxes"
        return Link(**effects) if effects else None

    @property
    def faults(self) -> list[str]:
        """Messages on keys that do not go together."""
        kinds = [
            name for name in ("weights", "baseline", "trivial") if getattr(self, name) is not None
        ]
        extrapolates_model = (kinds, self.baseline) == (
            ["weights", "baseline"],
            "constant_velocity",
        )
        faults = []
        if len(kinds) != 1 and not extrapolates_model:
            faults.append(
                "expected one of weights, baseline and trivial, or weights and the baseline "
                f"constant_velocity, found {' and '.join(kinds) or 'none'}"
            )
        if self.control and not self.weights:
            faults.append("control: spoils what a model sees; leave it out, or give weights")
        if self.horizon and self.weights:
            faults.append("horizon: is what the weights were trained for; leave it out here")
        if self.control and self.budget:
            faults.append("control, budget: do not go together; leave one out")
        return faults


class TrainingPlan(msgspec.Struct, frozen=True, kw_only=True):
    """A recipe's own settings of some weights.

    The other keys are fields of `ModelChoice` and `TrainConfig`.

    Attributes:
        release: Name of the recipe's release to learn from; empty for existing weights.
        split: Split of that release.
        validation: Split of that release that selects the best weights; None for none.
        also: Name of another release to learn from; None for none.
        also_split: Split of the other release.
        mix: Share of all moments that come from the other release.
        start: Name of earlier weights of the recipe to begin from; `from` in the file.
        file: Existing weights, as `deepaccident predict` takes them.
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
        """The pairs of rows that are compared, without repetition; the headline comes first."""
        pairs = list(self.compare)
        if self.headline is not None:
            pairs.insert(0, (self.headline.row, self.headline.less))
        return list(dict.fromkeys(pairs))

    def plan(self, weights: str) -> TrainingPlan:
        """Return the training plan of some weights; raises ValueError."""
        return as_record(self.weights[weights], TrainingPlan)


class _Source(msgspec.Struct):
    """The keys of a release that name files."""

    dataroot: str = ""
    version: str = ""
    spec: str = ""


class _File(msgspec.Struct):
    """The parts of the file that are checked before lists are expanded and paths resolved."""

    rows: list[dict[str, Any]]
    smoke: dict[str, Any] = {}
    releases: dict[str, _Source] = {}


def read_recipe(recipe: str, *, smoke: bool = False) -> Recipe:
    """Read a recipe from a file, or a shipped one by its name; `smoke` applies its part `smoke`.

    Raises:
        ConfigError: The file does not exist, cannot be read, or is no recipe.
    """
    path = _recipe_path(recipe)
    content = _read_content(path)
    with recipe_place(path, "the recipe"):
        file = as_record(content, _File)
        if smoke and not file.smoke:
            raise ConfigError("smoke: is missing; write this part, or leave out --smoke")
        merged = _merged(content, file.smoke if smoke else {})
        merged |= {"name": f"{path.stem}{'-smoke' * smoke}"}
        merged.pop("smoke", None)
        file = as_record(merged, _File)
        merged["rows"] = _all_rows(file)
        for name, source in file.releases.items():
            if source.spec:
                merged["releases"][name]["spec"] = str(path.parent / source.spec)
        result = as_record(merged, Recipe)
    _check_recipe(path, result)
    return result


def _recipe_path(recipe: str) -> Path:
    """Return the path of a recipe, given as a file or by the name of a shipped one."""
    path = Path(recipe)
    if path.suffix in (".yaml", ".yml"):
        return path
    shipped_names = sorted(file.stem for file in SHIPPED_RECIPES.glob("*.yaml"))
    name = choice("RECIPE, which is no file .yaml", recipe, shipped_names, error=ConfigError)
    return SHIPPED_RECIPES / f"{name}.yaml"


def _read_content(path: Path) -> Any:
    """Read a YAML file as plain values; raises ConfigError."""
    try:
        text = read_bytes(path, "spec").decode().strip()
        if len(text) > _MAX_CHARACTERS:
            raise ConfigError(f"{path}: has more than 100,000 characters; split the study")
        return _plain(parse_yaml(text or "{}", str(path)))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: {fault_text(error)}; give a file of YAML, in UTF-8") from error


def _all_rows(file: _File) -> list[Mapping[str, Any]]:
    """Return the rows with each list expanded; raises ConfigError if there are too many or none."""
    count = 0
    for row in file.rows:
        count += math.prod(map(len, _lists(row).values()))
    if not 0 < count <= MAX_ROWS:
        raise ConfigError(
            f"rows: expected 1 to {MAX_ROWS:,}, found {count:,}: a list makes a row of each of its "
            "values, and several lists a row of each combination; change the lists"
        )
    return [expanded for row in file.rows for expanded in _expanded_rows(row)]


@contextmanager
def recipe_place(path: Path | str, place: str) -> Iterator[None]:
    """Prefix errors of the block with the recipe and the key; raises ConfigError."""
    try:
        yield
    except (DeepAccidentError, ValueError) as error:
        raise ConfigError(f"{path}: {place}: {error}; docs/studies.md shows a recipe") from error


def synth_config_of(source: Mapping[str, Any]) -> SynthConfig | None:
    """Return the config of a synthetic release; None for an existing release.

    Raises ConfigError, ChoiceError or ValueError.
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
    return None if is_existing else as_record(settings, SynthConfig)


def _check_recipe(path: Path, recipe: Recipe) -> None:
    """Check that the parts of a recipe fit one another and the devkit; raises ConfigError."""
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
                    "name: is there twice; name the keys that have lists in it, such as {agents}"
                )
    with recipe_place(path, "test.where, groups"):
        for text in chain(test.where, *recipe.groups.values()):
            parse_where(text)
    with recipe_place(path, "by"):
        for by in recipe.by:
            attribute_name(by)
    with recipe_place(path, "compare, headline"):
        for name in chain(*recipe.pairs):
            _check_name("row", name, name_counts)
        if recipe.headline is not None:
            _check_name("number", recipe.headline.number, NUMBERS)
            _check_name("where", recipe.headline.where, (None, *recipe.groups))


def _check_plan(recipe: Recipe, name: str, earlier_weights: Collection[Any]) -> None:
    """Check the plan of some weights, which may begin from `earlier_weights`.

    Raises ConfigError or ChoiceError.
    """
    plan = recipe.plan(name)
    if plan.file is not None:
        if len(recipe.weights[name]) > 1:
            raise ConfigError("file: these weights are there; leave the other keys out")
        return
    _check_name("release", plan.release, recipe.releases)
    _check_name("also", plan.also, (None, *recipe.releases))
    _check_name("from, which stands above", plan.start, earlier_weights)
    if not 0 < plan.mix < 1:
        raise ConfigError(
            f"mix: expected a share between 0 and 1 of all moments, found {plan.mix!r}"
        )


def _check_name(kind: str, name: str | None, names: Collection[str | None]) -> None:
    """Raise ChoiceError if `names` lacks the name, ConfigError if only its case differs."""
    if choice(kind, name, names) != name:
        raise ConfigError(
            f"{kind}: found {name!r}; write it with the same capital letters everywhere"
        )


def _check_row(row: StudyRow, recipe: Recipe) -> None:
    """Check a row by itself and the names that it uses; raises ConfigError or ChoiceError."""
    faults = row.faults
    if faults:
        raise ConfigError(faults[0])
    _check_name("weights", row.weights, (None, *recipe.weights))
    if row.agents not in AGENT_SETS:
        for agent in row.cooperating:
            _check_name("agents", agent, (*AGENT_SETS, *AGENTS))
    recipe.test.label_config(row.horizon)
    _ = row.link  # building the link checks its effects


def _lists(row: Mapping[str, Any]) -> dict[str, list[Any]]:
    """Return the lists of a row that are expanded to rows, by key."""
    return {key: row[key] for key in _LIST_KEYS if isinstance(row.get(key), list)}


def _expanded_rows(row: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    """Yield a row for each combination of the values of its lists."""
    lists = _lists(row)
    series_key = next((key for key in lists if key != "agents"), None)
    for combination in product(*lists.values()):
        values = dict(zip(lists, combination, strict=True))
        if not values:
            yield row
            continue
        series = None
        if series_key is not None:
            series_name = _filled_name(row.get("name"), {**values, series_key: "…"})
            series = [series_key, values[series_key], series_name]
        name = _filled_name(row.get("name"), values)
        yield {**row, **values, "name": name, "over": series}


def _filled_name(name: object, values: Mapping[Any, Any]) -> str:
    """Return a name with its `{key}` parts replaced by values.

    `str.format` would also read attributes.
    """
    return re.sub(r"\{(\w+)\}", lambda match: str(values.get(match[1], match[0])), str(name))


def _merged(value: Any, changes: Any) -> Any:
    """Return a value replaced by its changes; two mappings are merged key by key."""
    if not (isinstance(value, dict) and isinstance(changes, dict)):
        return changes
    changed = {key: _merged(value.get(key), change) for key, change in changes.items()}
    return {**value, **changed}


def _plain(node: Node) -> Any:
    """Return the value of a YAML node as JSON holds it."""
    if isinstance(node.value, Mapping):
        return {key: _plain(entry) for key, entry in node.value.items()}
    if isinstance(node.value, tuple):
        return [_plain(entry) for entry in node.value]
    return node.value
