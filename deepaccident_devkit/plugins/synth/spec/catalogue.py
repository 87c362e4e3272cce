"""Scenario files from text to template, how to draw from it, and the paper's twelve designs."""

import os
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
from typing import Final, cast

import numpy as np

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.plugins.synth.roads import ARMS, Arm
from deepaccident_devkit.plugins.synth.spec.checks import (
    LEADERS,
    check_scenario_spec,
    meeting_roles,
    usual_lanes,
)
from deepaccident_devkit.plugins.synth.spec.model import ActorSpec, AllOf, Part, Role, ScenarioSpec
from deepaccident_devkit.plugins.synth.spec.reading import parse_yaml, read_part
from deepaccident_devkit.support.reading import fault_text, read_bytes
from deepaccident_devkit.support.text import path_of

_EXCHANGED: dict[Role, Role] = {
    "ego": "other", "other": "ego", "ego_behind": "other_behind", "other_behind": "ego_behind",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class SpecTemplate:
    """A scenario as a file describes it.

    Attributes:
        root: the contents of the file, checked.
    """

    root: Part

    @property
    def name(self) -> str:
        """The scenario's name, for readers."""
        return str(self.root.values("name")[0])

    @property
    def design(self) -> int | None:
        """Number of the paper's design, if it is one of the twelve."""
        return cast("int | None", self.root.values("design")[0])

    @property
    def meeting_roles(self) -> frozenset[Role]:
        """The roles that are timed to meet; empty if there are none."""
        meetings = [meeting for meeting in self.root.values("meet") if isinstance(meeting, Part)]
        return frozenset(role for meeting in meetings for role in meeting_roles(meeting))

    @property
    def meets(self) -> bool:
        """Whether two are timed to meet, so that there is an accident."""
        return bool(self.meeting_roles)

    def place(self, field: str) -> str:
        """Where the file names a field, for messages, such as `mine.yaml:6: meet`."""
        return f"{self.root.line(field)}: {self.root.path_of(field)}"


def draw(template: SpecTemplate, rng: np.random.Generator) -> ScenarioSpec:
    """Make every choice of a scenario.

    It always has all four vehicle agents: followers that the file does not name are cars. If the file asks for an
    exchange, ego and other change places in half of the draws; a four-way junction is then turned, so that ego comes
    from the same arm as before.

    Args:
        template: from `read_spec` or `read_design`.
        rng: random numbers; the same numbers give the same scenario.
    """
    spec = cast("ScenarioSpec", template.root.draw(rng))
    named = cast("AllOf", template.root.fields["actors"]).items
    actors = [
        _completed(actor, cast("Part", part), spec, rng)
        for actor, part in zip(spec.actors, named, strict=True)
    ]
    roles = {actor.role for actor in actors}
    actors += [ActorSpec(role=role) for role in LEADERS if role not in roles]
    spec = replace(spec, actors=tuple(actors))
    exchanged = spec.exchange and bool(rng.random() < 0.5)
    return _exchanged(spec) if exchanged else replace(spec, exchange=False)


def _completed(
    actor: ActorSpec, part: Part, spec: ScenarioSpec, rng: np.random.Generator
) -> ActorSpec:
    """An actor with the values that follow from others."""
    if actor.role == "pedestrian":
        return replace(actor, category="pedestrian")
    if "lane" in part.fields or spec.road.lanes == 1:
        return actor
    return replace(actor, lane=int(rng.choice(usual_lanes(actor.turn, spec.road.lanes))))


def _exchanged(spec: ScenarioSpec) -> ScenarioSpec:
    """The scenario with ego in the place of other, and other in the place of ego."""
    came_from = spec.actor("ego").from_arm
    actors = tuple(
        replace(actor, role=_EXCHANGED.get(actor.role, actor.role)) for actor in spec.actors
    )
    meet = spec.meet
    if meet is not None:
        first, second = (_EXCHANGED.get(role, role) for role in meet.actors)
        meet = replace(meet, actors=(first, second))
    spec = replace(spec, actors=actors, meet=meet, exchange=True)
    comes_from = spec.actor("ego").from_arm
    if spec.road.kind == "three-way" or came_from is None or comes_from is None:
        return spec
    return _turned(spec, ARMS.index(came_from) - ARMS.index(comes_from))


def _turned(spec: ScenarioSpec, quarters: int) -> ScenarioSpec:
    """The scenario with all arms turned by so many quarter turns, counter-clockwise."""

    def turned(arm: Arm) -> Arm:
        return ARMS[(ARMS.index(arm) + quarters) % len(ARMS)]

    hump = spec.road.hump
    if hump is not None:
        hump = replace(hump, arm=turned(hump.arm))
    actors = tuple(
        actor if actor.from_arm is None else replace(actor, from_arm=turned(actor.from_arm))
        for actor in spec.actors
    )
    return replace(spec, road=replace(spec.road, hump=hump), actors=actors)


# PyYAML reads so many in a few seconds.
_MOST_CHARACTERS = 200_000


def read_spec(path: str | os.PathLike[str]) -> SpecTemplate:
    """The scenario of a YAML file (docs/synth.md has all fields).

    Raises:
        ConfigError: there is no such file, or it is no possible scenario; the message names line, field and remedy.
    """
    try:
        text = read_bytes(path_of(path), "spec").decode()
    except FileNotFoundError as error:
        raise ConfigError(
            f"{path}: no such file; give the path of a scenario file (docs/synth.md)"
        ) from error
    except (OSError, ValueError) as error:
        told = fault_text(error) if isinstance(error, OSError) else f"cannot be read ({error})"
        raise ConfigError(f"{path}: {told}; give a YAML file in UTF-8") from error
    if len(text) > _MOST_CHARACTERS:
        raise ConfigError(
            f"{path}: has more than {_MOST_CHARACTERS} characters; give a scenario file, it has a few dozen lines"
        )
    return parse_spec(text, str(path))


def parse_spec(text: str, source: str = "scenario") -> SpecTemplate:
    """The scenario of a YAML text.

    Args:
        text: the contents of a scenario file.
        source: its name in error messages.

    Raises:
        ConfigError: it is no possible scenario; the message names line, field and remedy.
    """
    root = read_part(parse_yaml(text, source), ScenarioSpec)
    check_scenario_spec(root)
    return SpecTemplate(root)


DESIGN_NUMBERS: Final = tuple(range(1, 13))
"""1 to 6 at signalised junctions, 7 to 12 at unsignalised ones."""


def design_text(number: int) -> str:
    """The text of a design's scenario file.

    Raises:
        ConfigError: there is no such design.
    """
    for entry in files("deepaccident_devkit.plugins.synth.spec").joinpath("designs").iterdir():
        if entry.name.startswith(f"{number:02d}_") and entry.name.endswith(".yaml"):
            return entry.read_text(encoding="utf-8")
    raise ConfigError(
        f"design: {number} is not one of 1 to {len(DESIGN_NUMBERS)}; choose one of these"
    )


@cache
def read_design(number: int) -> SpecTemplate:
    """The scenario of a design; raises ConfigError if there is no such design."""
    return parse_spec(design_text(number), f"design {number}")
