"""A recipe: what a study trains and compares, read from a YAML file and checked as far as it can be without torch.

`Recipe` describes the file, and docs/studies.md shows one. Every fault is a ConfigError that names the file, the key
and the remedy.
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
# Of a release that is made: whether it is put into nuScenes' format.
NUSCENES: Final = "nuscenes"
# Of a row, what its `Link` has.
_EFFECTS: Final = ("latency", "pose_noise", "packet_loss", "budget")
# Of a row, what can be a list: a row each.
_LISTS: Final = ("agents", "horizon", *_EFFECTS)
# Rows of a recipe, when each list has become a row for each of its values.
MOST_ROWS: Final = 1000
# Up to 100 numbers that fit into torch's generator.
StudySeeds = Annotated[
    tuple[Annotated[int, msgspec.Meta(ge=0, lt=1 << 62)], ...], msgspec.Meta(max_length=100)
]


class _Part(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A part of a recipe."""


class StudyHeadline(_Part, frozen=True, kw_only=True):
    """The comparison that is fixed before the study is run.

    Attributes:
        row: that should have more.
        less: than this one.
        number: of `NUMBERS`.
        where: in which of the recipe's groups; None for all samples.
    """

    row: str
    less: str
    number: str = "apa"
    where: str | None = None


class TestedOn(_Part, frozen=True, kw_only=True):
    """On what all rows are tested.

    Attributes:
        release: one of the recipe's.
        split: `all`, or a split's name.
        samples: of `SampleSelection`, and so are `scope` and `agents`.
        scope: accidents alone, or their normal twins, too.
        agents: whose samples.
        horizon: seconds before the end from which samples are taken; None for the longest that a row looks ahead.
        where: filters as `--where` takes them: pairs of scenarios stay of which one matches all.
        labels: the protocol of motion labels. Models of the presets `tiny` have `clean`.
        includes_training: whether models may have learned from scenarios of the test, from their twins, or from other
            recordings of them; if not, such a recipe is refused.
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
        """The labels that look so many seconds ahead; raises ConfigError or ChoiceError."""
        frames = len(path_times(horizon or DEFAULT_HORIZON))
        return MotionLabelConfig(future_frames=frames, protocol=self.labels)


class StudyRow(_Part, frozen=True, kw_only=True):
    """A line of the tables: what predicts, and with whose data.

    Attributes:
        name: of the line. In the file it may name keys that have lists, such as `late {latency} s`.
        weights: of a model, one of the recipe's.
        baseline: how actors go on that agents see by the labels; with `weights`, that the model detects, for alarms in
            place of those that follow from its maps.
        trivial: in place of both, `nothing`, an empty map without alarms and boxes; `everything`, a map that is all one
            actor; or `labels`, whom the agents see at the present, as the labels show these, the future too: more a
            model cannot say of them.
        agents: who cooperates: a configuration, or agents' names with commas.
        control: what is spoilt in a model's inputs: `blank`, all sensors of all agents; `strangers`, partners' data are
            those of another pair of scenarios.
        latency: of `Link`, and so are `pose_noise`, `packet_loss` and `budget`.
        pose_noise: metres.
        packet_loss: probability.
        budget: bytes a frame; a partner sends a model's features, or boxes.
        horizon: seconds that it looks ahead, None for 2; of a model its weights say it.
        over: of one of several rows that differ in a number: its key, the number, and what they are called.
    """

    name: str
    weights: str | None = None
    baseline: MotionModel | None = None
    trivial: Literal["nothing", "everything", "labels"] | None = None
    agents: str = "all"
    control: Literal["blank", "strangers"] | None = None
    latency: float = 0.0
    pose_noise: float = 0.0
    packet_loss: float = 0.0
    budget: int | None = None
    horizon: float | None = None
    over: tuple[str, float, str] | None = None

    @property
    def cooperating(self) -> str | list[str]:
        """As `v2x.cooperating_agents` takes it."""
        return self.agents if self.agents in AGENT_SETS else self.agents.split(",")

    @property
    def link(self) -> Link | None:
        """What happens to partners' data; None for nothing. Raises ConfigError."""
        chosen: dict[str, Any] = {
            name: getattr(self, name) for name in _EFFECTS if getattr(self, name)
        }
        if self.budget:
            chosen["payload"] = "bev" if self.weights else "boxes"
        return Link(**chosen) if chosen else None

    @property
    def faults(self) -> list[str]:
        """What does not go together."""
        kinds = [
            name for name in ("weights", "baseline", "trivial") if getattr(self, name) is not None
        ]
        told = {
            "expected one of weights, baseline and trivial, or weights and the baseline constant_velocity, found "
            f"{' and '.join(kinds) or 'none'}": len(kinds) != 1
            and (kinds, self.baseline) != (["weights", "baseline"], "constant_velocity"),
            "control: spoils what a model sees; leave it out, or give weights": self.control
            and not self.weights,
            "horizon: is what the weights were trained for; leave it out here": self.horizon
            and self.weights,
            "control, budget: do not go together; leave one out": self.control and self.budget,
        }
        return [each for each, found in told.items() if found]


class TrainingPlan(msgspec.Struct, frozen=True, kw_only=True):
    """What a recipe itself says of some weights; the other keys are fields of `ModelChoice` and `TrainConfig`.

    Attributes:
        release: to learn from, one of the recipe's; empty for weights that are there.
        split: of it.
        validation: the split of it whose score chooses the best weights; None for none.
        also: another release to learn from; None for none.
        also_split: of that one.
        mix: share of all moments that are from it.
        start: which weights above to begin from; `from` in the file.
        file: weights that are there, as `deepaccident predict` takes them.
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
        title: of the page.
        question: that the study answers.
        releases: name → fields of `SynthConfig`, or `dataroot` and `version` of one that is there. With `nuscenes:
            true` what the ego vehicle recorded is put into nuScenes' format, and opened by its devkit.
        test: on what all rows are tested.
        rows: the lines of the tables.
        seeds: of the trainings; each row of a model is one of every seed.
        weights: name → keys of `TrainingPlan`, and fields of `ModelChoice` and `TrainConfig`; or only `file`. Weights
            that begin `from` others have their model.
        groups: name → filters as `--where` takes them: numbers are also given of the pairs of scenarios of which one
            matches all.
        by: numbers are also given by these attributes, as `--by` takes them.
        compare: pairs of rows, of which the differences are given, the first less the second.
        headline: fixed beforehand; None for none.
        name: of the folder of its results: the file's, and `-smoke`.
    """

    title: str
    question: str
    releases: dict[str, dict[str, Any]]
    test: TestedOn
    rows: tuple[StudyRow, ...]
    seeds: StudySeeds = (1,)
    weights: dict[str, dict[str, Any]] = {}
    groups: dict[str, tuple[str, ...]] = {}
    by: tuple[str, ...] = ()
    compare: tuple[tuple[str, str], ...] = ()
    headline: StudyHeadline | None = None
    name: str = ""

    @property
    def pairs(self) -> list[tuple[str, str]]:
        """The rows that are compared, those of the headline first."""
        first = [] if self.headline is None else [(self.headline.row, self.headline.less)]
        return list(dict.fromkeys([*first, *self.compare]))

    def plan(self, weights: str) -> TrainingPlan:
        """What it says of weights; raises ValueError."""
        return as_record(self.weights[weights], TrainingPlan)


class _Source(msgspec.Struct):
    """The keys of a release that name files."""

    dataroot: str = ""
    version: str = ""
    spec: str = ""


class _File(msgspec.Struct):
    """What there must be before rows are made of lists, and files are looked for."""

    rows: list[dict[str, Any]]
    smoke: dict[str, Any] = {}
    releases: dict[str, _Source] = {}


def read_recipe(recipe: str, *, smoke: bool = False) -> Recipe:
    """A recipe from a file, or one that ships, by its name; `smoke` puts in place what its part `smoke` says.

    Raises:
        ConfigError: it is not there, cannot be read, or is no recipe.
    """
    path = Path(recipe)
    if path.suffix not in (".yaml", ".yml"):
        known = sorted(each.stem for each in SHIPPED_RECIPES.glob("*.yaml"))
        path = (
            SHIPPED_RECIPES
            / f"{choice('RECIPE, which is no file .yaml', recipe, known, error=ConfigError)}.yaml"
        )
    try:
        text = read_bytes(path, "spec").decode().strip()
        if (
            len(text) > 100_000
        ):  # those that ship have up to 3,000; PyYAML would read more for many seconds
            raise ConfigError(f"{path}: has more than 100,000 characters; split the study")
        told = _plain(parse_yaml(text or "{}", str(path)))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: {fault_text(error)}; give a file of YAML, in UTF-8") from error
    with recipe_place(path, "the recipe"):
        file = as_record(told, _File)
        if smoke and not file.smoke:
            raise ConfigError("smoke: is missing; write this part, or leave out --smoke")
        chosen = _merged(told, file.smoke if smoke else {}) | {
            "name": f"{path.stem}{'-smoke' * smoke}"
        }
        chosen.pop("smoke", None)
        file = as_record(chosen, _File)
        count = sum(math.prod(map(len, _lists(row).values())) for row in file.rows)
        if not 0 < count <= MOST_ROWS:
            raise ConfigError(
                f"rows: expected 1 to {MOST_ROWS:,}, found {count:,}: a list makes a row of each of its values, and "
                "several lists a row of each combination; change the lists"
            )
        chosen["rows"] = [each for row in file.rows for each in _expanded(row)]
        for name, source in file.releases.items():
            if source.spec:
                chosen["releases"][name]["spec"] = str(path.parent / source.spec)
        read = as_record(chosen, Recipe)
    return _checked(path, read)


@contextmanager
def recipe_place(path: Path | str, place: str) -> Iterator[None]:
    """Say of errors in the block where they are: of a recipe, at a key; raises ConfigError."""
    try:
        yield
    except (DeepAccidentError, ValueError) as error:
        raise ConfigError(f"{path}: {place}: {error}; docs/studies.md shows a recipe") from error


def synth_config_of(source: Mapping[str, Any]) -> SynthConfig | None:
    """How a release is made; None for one that is there. Raises ConfigError, ChoiceError or ValueError."""
    own = "dataroot" in source
    possible = (
        ("dataroot", "version")
        if own
        else [NUSCENES, *(each.name for each in dataclasses.fields(SynthConfig))]
    )
    for key in source:
        choice("key", key, possible)
    given = {**source, "spec": Path(source["spec"])} if source.get("spec") else dict(source)
    checked_flag(NUSCENES, given.pop(NUSCENES, False))
    return None if own else as_record(given, SynthConfig)


def _checked(path: Path, recipe: Recipe) -> Recipe:
    """The recipe, whose parts fit one another, and what the devkit has; raises ConfigError."""
    test, names = recipe.test, Counter(row.name for row in recipe.rows)
    for name, source in recipe.releases.items():
        with recipe_place(path, f"releases.{name}"):
            synth_config_of(source)
    with recipe_place(path, "test"):
        _check_name("release", test.release, recipe.releases)
        test.label_config(test.horizon)
        SampleSelection(split=test.split, samples=test.samples, agents=test.agents)
    above: list[Any] = [None]
    for name in recipe.weights:
        with recipe_place(path, f"weights.{name}"):
            _check_plan(recipe, name, above)
        above.append(name)
    for row in recipe.rows:
        with recipe_place(path, f"rows: {row.name}"):
            _check_row(row, recipe)
            if names[row.name] > 1:
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
            _check_name("row", name, names)
        if recipe.headline is not None:
            _check_name("number", recipe.headline.number, NUMBERS)
            _check_name("where", recipe.headline.where, (None, *recipe.groups))
    return recipe


def _check_plan(recipe: Recipe, name: str, above: Collection[Any]) -> None:
    """Check what the recipe says of some weights, `above` are those before; raises ConfigError or ChoiceError."""
    plan = recipe.plan(name)
    if plan.file is not None:
        if len(recipe.weights[name]) > 1:
            raise ConfigError("file: these weights are there; leave the other keys out")
        return
    _check_name("release", plan.release, recipe.releases)
    _check_name("also", plan.also, (None, *recipe.releases))
    _check_name("from, which stands above", plan.start, above)
    if not 0 < plan.mix < 1:
        raise ConfigError(
            f"mix: expected a share between 0 and 1 of all moments, found {plan.mix!r}"
        )


def _check_name(kind: str, name: str | None, names: Collection[str | None]) -> None:
    """Raise ChoiceError if a name is none of these, and ConfigError if it is spelled in another way."""
    if choice(kind, name, names) != name:
        raise ConfigError(
            f"{kind}: found {name!r}; write it with the same capital letters everywhere"
        )


def _check_row(row: StudyRow, recipe: Recipe) -> None:
    """Check a row by itself and with the others' names; raises ConfigError or ChoiceError."""
    if row.faults:
        raise ConfigError(row.faults[0])
    _check_name("weights", row.weights, (None, *recipe.weights))
    if row.agents not in AGENT_SETS:
        for agent in row.cooperating:
            _check_name("agents", agent, (*AGENT_SETS, *AGENTS))
    recipe.test.label_config(row.horizon)
    _ = row.link  # its effects are checked as it is made


def _lists(row: Mapping[str, Any]) -> dict[str, list[Any]]:
    """The lists of a row that stand for rows."""
    return {key: row[key] for key in _LISTS if isinstance(row.get(key), list)}


def _expanded(row: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    """The rows that one with lists stands for."""
    lists = _lists(row)
    key = next((key for key in lists if key != "agents"), None)
    for values in product(*lists.values()):
        one = dict(zip(lists, values, strict=True))
        over = key and [key, one[key], _filled(row.get("name"), {**one, key: "…"})]
        yield {**row, **one, "name": _filled(row.get("name"), one), "over": over} if one else row


def _filled(name: object, values: Mapping[Any, Any]) -> str:
    """A name with the values of the keys that stand in it; `str.format` would also read attributes."""
    return re.sub(r"\{(\w+)\}", lambda found: str(values.get(found[1], found[0])), str(name))


def _merged(value: Any, changes: Any) -> Any:
    """A value with another in its place; of two mappings, key by key."""
    if not (isinstance(value, dict) and isinstance(changes, dict)):
        return changes
    return {**value, **{key: _merged(value.get(key), each) for key, each in changes.items()}}


def _plain(node: Node) -> Any:
    """A value as JSON holds it."""
    if isinstance(node.value, Mapping):
        return {key: _plain(entry) for key, entry in node.value.items()}
    return [_plain(each) for each in node.value] if isinstance(node.value, tuple) else node.value
