"""A recipe: what a study trains and compares, read from a YAML file and checked as far as it can be without torch.

`Recipe` describes the file, and docs/studies.md shows one. Every fault is a ConfigError that names the file, the key
and the remedy.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from itertools import chain, product
from pathlib import Path
from typing import Any, Final, Literal

import msgspec

from deepaccident_devkit.baselines.outlook import MotionModel
from deepaccident_devkit.baselines.predict import path_times
from deepaccident_devkit.errors import ConfigError, DeepAccidentError
from deepaccident_devkit.evaluation.breakdowns import attribute_name
from deepaccident_devkit.evaluation.runs import SampleSelection
from deepaccident_devkit.evaluation.runs.setups import SampleList, ScopeName
from deepaccident_devkit.motion import MotionLabelConfig
from deepaccident_devkit.selection.conditions import parse_where
from deepaccident_devkit.study.numbers import NUMBERS
from deepaccident_devkit.support.arrays import checked_flag
from deepaccident_devkit.support.json_text import as_record
from deepaccident_devkit.support.reading import fault_text, read_bytes
from deepaccident_devkit.support.text import choice
from deepaccident_devkit.synth import SynthConfig
from deepaccident_devkit.synth.spec.reading import Node, parse_yaml
from deepaccident_devkit.taxonomy import AGENTS
from deepaccident_devkit.v2x import AGENT_SETS, Link

SHIPPED: Final = Path(__file__).parent / "recipes"
DEFAULT_HORIZON: Final = 2.0
NUSCENES: Final = "nuscenes"
"""Of a release that is made: whether it is put into nuScenes' format."""
_EFFECTS: Final = ("latency", "pose_noise", "packet_loss", "budget")
"""Of a row, what its `Link` has."""
_ALONE: Final = "file: these weights are there; leave the other keys out"
_MIX: Final = "mix: expected a share between 0 and 1, of all moments"
_TWICE: Final = "name: is there twice; name the keys that have lists in it, such as {agents}"
_LISTS: Final = ("agents", "horizon", *_EFFECTS)
"""Of a row, what can be a list: a row each."""


class _Part(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A part of a recipe."""


class Headline(_Part, frozen=True, kw_only=True):
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
    """

    release: str
    split: str = "all"
    samples: SampleList = "evaluate"
    scope: ScopeName = "all"
    agents: tuple[str, ...] = ("ego_vehicle",)
    horizon: float | None = None
    where: tuple[str, ...] = ()
    labels: str = "released"

    def label_config(self, horizon: float | None) -> MotionLabelConfig:
        """The labels that look so many seconds ahead; raises ConfigError or ChoiceError."""
        frames = len(path_times(horizon or DEFAULT_HORIZON))
        return MotionLabelConfig(future_frames=frames, protocol=self.labels)


class Row(_Part, frozen=True, kw_only=True):
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
        chosen: dict[str, Any] = {name: getattr(self, name) for name in _EFFECTS if getattr(self, name)}
        if self.budget:
            chosen["payload"] = "bev" if self.weights else "boxes"
        return Link(**chosen) if chosen else None

    @property
    def faults(self) -> list[str]:
        """What does not go together."""
        kinds = [name for name in ("weights", "baseline", "trivial") if getattr(self, name) is not None]
        told = {
            "expected one of weights, baseline and trivial, or weights and the baseline constant_velocity, found "
            f"{' and '.join(kinds) or 'none'}": len(kinds) != 1
            and (kinds, self.baseline) != (["weights", "baseline"], "constant_velocity"),
            "control: spoils what a model sees; leave it out, or give weights": self.control and not self.weights,
            "horizon: is what the weights were trained for; leave it out here": self.horizon and self.weights,
            "control, budget: do not go together; leave one out": self.control and self.budget,
        }
        return [each for each, found in told.items() if found]


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
        weights: name → `release` to learn from, `also` another one beside it (of which the share `mix` of all moments
            is), `from` which weights above (with their model), and fields of `ModelChoice` and `TrainConfig`; or `file`
            alone, weights as `deepaccident predict` takes them.
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
    rows: tuple[Row, ...]
    seeds: tuple[int, ...] = (1,)
    weights: dict[str, dict[str, Any]] = {}
    groups: dict[str, tuple[str, ...]] = {}
    by: tuple[str, ...] = ()
    compare: tuple[tuple[str, str], ...] = ()
    headline: Headline | None = None
    name: str = ""

    @property
    def pairs(self) -> list[tuple[str, str]]:
        """The rows that are compared, those of the headline first."""
        first = [] if self.headline is None else [(self.headline.row, self.headline.less)]
        return list(dict.fromkeys([*first, *self.compare]))


class _File(msgspec.Struct):
    """What there must be before rows are made of lists."""

    rows: list[dict[str, Any]]
    smoke: dict[str, Any] = {}


def read_recipe(recipe: str, *, smoke: bool = False) -> Recipe:
    """A recipe from a file, or one that ships, by its name; `smoke` puts in place what its part `smoke` says.

    Raises:
        ConfigError: it is not there, cannot be read, or is no recipe.
    """
    path = Path(recipe)
    if path.suffix not in (".yaml", ".yml"):
        known = sorted(each.stem for each in SHIPPED.glob("*.yaml"))
        path = SHIPPED / f"{choice('RECIPE, which is no file .yaml', recipe, known, error=ConfigError)}.yaml"
    try:
        told = _plain(parse_yaml(read_bytes(path, "spec").decode().strip() or "{}", str(path)))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: {fault_text(error)}; give a file of YAML, in UTF-8") from error
    with at(path, "the recipe"):
        file = as_record(told, _File)
        if smoke and not file.smoke:
            raise ConfigError("smoke: is missing; write this part, or leave out --smoke")
        chosen = _merged(told, file.smoke if smoke else {}) | {"name": f"{path.stem}{'-smoke' * smoke}"}
        chosen["rows"] = [row for each in chosen["rows"] for row in _expanded(each)]
        read = as_record({key: each for key, each in chosen.items() if key != "smoke"}, Recipe)
    beside = {
        name: {**source, "spec": str(path.parent / source["spec"])}
        for name, source in read.releases.items()
        if source.get("spec")
    }
    return _checked(path, msgspec.structs.replace(read, releases={**read.releases, **beside}))


@contextmanager
def at(path: Path | str, place: str) -> Iterator[None]:
    """Say of errors in the block where they are: of a recipe, at a key; raises ConfigError."""
    try:
        yield
    except (DeepAccidentError, ValueError) as error:
        raise ConfigError(f"{path}: {place}: {error}; docs/studies.md shows a recipe") from error


def source_of(source: Mapping[str, Any]) -> SynthConfig | None:
    """How a release is made; None for one that is there. Raises ConfigError, ChoiceError or ValueError."""
    own = "dataroot" in source
    possible = ("dataroot", "version") if own else [NUSCENES, *(each.name for each in dataclasses.fields(SynthConfig))]
    for key in source:
        choice("key", key, possible)
    given = {**source, "spec": Path(source["spec"])} if source.get("spec") else dict(source)
    checked_flag(NUSCENES, given.pop(NUSCENES, False))
    return None if own else as_record(given, SynthConfig)


def _checked(path: Path, recipe: Recipe) -> Recipe:
    """The recipe, whose parts fit one another, and what the devkit has; raises ConfigError."""
    test, plans, names = recipe.test, recipe.weights, [row.name for row in recipe.rows]
    number, where = ("apa", None) if recipe.headline is None else (recipe.headline.number, recipe.headline.where)
    above = {name: (None, *list(plans)[:place]) for place, name in enumerate(plans)}
    trained = [name for name in plans if "file" not in plans[name]]
    checks: list[tuple[str, Callable[[], object]]] = [
        *((f"releases.{name}", partial(source_of, source)) for name, source in recipe.releases.items()),
        ("test", partial(choice, "release", test.release, recipe.releases)),
        ("test", partial(test.label_config, test.horizon)),
        ("test", partial(SampleSelection, split=test.split, samples=test.samples, agents=test.agents)),
        *(
            (f"weights.{name}", partial(_refused, _ALONE))
            for name in plans
            if "file" in plans[name] and len(plans[name]) > 1
        ),
        *(
            (f"weights.{name}", partial(choice, "release", plans[name].get("release"), recipe.releases))
            for name in trained
        ),
        *(
            (f"weights.{name}", partial(choice, "also", plans[name].get("also"), (None, *recipe.releases)))
            for name in trained
        ),
        *((f"weights.{name}", partial(_refused, _MIX)) for name in trained if not 0 < plans[name].get("mix", 0.5) < 1),
        *(
            (f"weights.{name}", partial(choice, "from, which stands above", plans[name].get("from"), above[name]))
            for name in trained
        ),
        *((f"rows: {row.name}", partial(_refused, fault)) for row in recipe.rows for fault in row.faults),
        *((f"rows: {row.name}", partial(choice, "weights", row.weights, (None, *plans))) for row in recipe.rows),
        *(
            (f"rows: {row.name}", partial(choice, "agents", agent, (*AGENT_SETS, *AGENTS)))
            for row in recipe.rows
            for agent in row.cooperating
            if row.agents not in AGENT_SETS
        ),
        *((f"rows: {row.name}", partial(getattr, row, "link")) for row in recipe.rows),
        *((f"rows: {row.name}", partial(test.label_config, row.horizon)) for row in recipe.rows),
        *((f"rows: {name}", partial(_refused, _TWICE)) for name in names if names.count(name) > 1),
        *(("test.where, groups", partial(parse_where, text)) for text in chain(test.where, *recipe.groups.values())),
        *(("by", partial(attribute_name, by)) for by in recipe.by),
        *(("compare, headline", partial(choice, "row", name, names)) for name in chain(*recipe.pairs)),
        ("headline", partial(choice, "number", number, NUMBERS)),
        ("headline", partial(choice, "where", where, (None, *recipe.groups))),
    ]
    for place, check in checks:
        with at(path, place):
            check()
    return recipe


def _refused(told: str) -> None:
    raise ConfigError(told)


def _expanded(row: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    """The rows that one with lists stands for."""
    lists = {key: row[key] for key in _LISTS if isinstance(row.get(key), list)}
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
