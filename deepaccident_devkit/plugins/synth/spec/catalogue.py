"""Scenario files from text to template, draws from a template, and the paper's twelve designs."""

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
from deepaccident_devkit.support.text import PathType, path_of

_EXCHANGED_ROLES: dict[Role, Role] = {
    "ego": "other", "other": "ego", "ego_behind": "other_behind", "other_behind": "ego_behind",
}  # fmt: skip
# PyYAML reads a text of this length in a few seconds.
_MAX_CHARACTERS = 200_000
DESIGN_NUMBERS: Final = tuple(range(1, 13))
"""Numbers of the designs: 1 to 6 at signalised junctions, 7 to 12 at unsignalised ones."""


@dataclass(frozen=True, slots=True)
class SpecTemplate:
    """A scenario as a file describes it.

    Attributes:
        root: The checked contents of the file.
    """

    root: Part

    @property
    def name(self) -> str:
        """Name of the scenario, for readers."""
        return str(self.root.values("name")[0])

    @property
    def design(self) -> int | None:
        """Number of the paper's design, if it is one of the twelve."""
        return cast("int | None", self.root.values("design")[0])

    @property
    def meeting_roles(self) -> frozenset[Role]:
        """The roles that are timed to meet; empty if there are none."""
        roles: set[Role] = set()
        for meeting in self.root.values("meet"):
            if isinstance(meeting, Part):
                roles.update(meeting_roles(meeting))
        return frozenset(roles)

    @property
    def meets(self) -> bool:
        """Whether two road users are timed to meet, so that there is an accident."""
        return bool(self.meeting_roles)

    def place(self, field: str) -> str:
        """Return the location of a field in the file, for messages, such as `mine.yaml:6: meet`."""
        line = self.root.line(field)
        return f"{line}: {self.root.path_of(field)}"


def draw(template: SpecTemplate, rng: np.random.Generator) -> ScenarioSpec:
    """Draw every open choice of a scenario.

    The result always has all four vehicle agents: followers that the file does not name are cars.
    If the file asks for an exchange, ego and other change places in half of the draws; a four-way
    junction is then turned, so that ego comes from the same arm as before.

    Args:
        template: Template from `read_spec` or `read_design`.
        rng: Generator of random numbers; the same numbers give the same scenario.
    """
    spec = cast("ScenarioSpec", template.root.draw(rng))
    actor_parts = cast("AllOf", template.root.fields["actors"]).items
    actors = [
        _complete_actor(actor, cast("Part", part), spec, rng)
        for actor, part in zip(spec.actors, actor_parts, strict=True)
    ]
    roles = {actor.role for actor in actors}
    actors += [ActorSpec(role=role) for role in LEADERS if role not in roles]
    spec = replace(spec, actors=tuple(actors))
    if spec.exchange and bool(rng.random() < 0.5):
        return _exchange_roles(spec)
    return replace(spec, exchange=False)


def _complete_actor(
    actor: ActorSpec, part: Part, spec: ScenarioSpec, rng: np.random.Generator
) -> ActorSpec:
    """Fill in an actor's values that follow from other fields.

    Args:
        actor: A draw of the actor.
        part: The actor in the file.
        spec: A draw of the scenario.
        rng: Generator of random numbers.
    """
    if actor.role == "pedestrian":
        return replace(actor, category="pedestrian")
    if "lane" in part.fields or spec.road.lanes == 1:
        return actor
    lanes = usual_lanes(actor.turn, spec.road.lanes)
    lane = int(rng.choice(lanes))
    return replace(actor, lane=lane)


def _exchange_roles(spec: ScenarioSpec) -> ScenarioSpec:
    """Return a scenario in which ego and other have changed places."""
    previous_arm = spec.actor("ego").from_arm
    actors = []
    for actor in spec.actors:
        role = _EXCHANGED_ROLES.get(actor.role, actor.role)
        actors.append(replace(actor, role=role))
    meet = spec.meet
    if meet is not None:
        role, other_role = (_EXCHANGED_ROLES.get(role, role) for role in meet.actors)
        meet = replace(meet, actors=(role, other_role))
    spec = replace(spec, actors=tuple(actors), meet=meet, exchange=True)
    new_arm = spec.actor("ego").from_arm
    if spec.road.kind == "three-way" or previous_arm is None or new_arm is None:
        return spec
    return _turn_arms(spec, ARMS.index(previous_arm) - ARMS.index(new_arm))


def _turn_arms(spec: ScenarioSpec, quarters: int) -> ScenarioSpec:
    """Return a scenario with all arms turned by a number of quarter turns, counter-clockwise."""

    def turn_arm(arm: Arm) -> Arm:
        index = ARMS.index(arm) + quarters
        return ARMS[index % len(ARMS)]

    road = spec.road
    if road.hump is not None:
        turned_hump = replace(road.hump, arm=turn_arm(road.hump.arm))
        road = replace(road, hump=turned_hump)
    actors = []
    for actor in spec.actors:
        arm = actor.from_arm
        actors.append(actor if arm is None else replace(actor, from_arm=turn_arm(arm)))
    return replace(spec, road=road, actors=tuple(actors))


def read_spec(path: PathType) -> SpecTemplate:
    """Read the scenario of a YAML file (docs/synth.md has all fields).

    Raises:
        ConfigError: There is no such file, or it does not describe a possible scenario; the message
            names line, field and remedy.
    """
    try:
        text = read_bytes(path_of(path), "spec").decode()
    except FileNotFoundError as error:
        raise ConfigError(
            f"{path}: no such file; give the path of a scenario file (docs/synth.md)"
        ) from error
    except (OSError, ValueError) as error:
        fault = fault_text(error) if isinstance(error, OSError) else f"cannot be read ({error})"
        raise ConfigError(f"{path}: {fault}; give a YAML file in UTF-8") from error
    if len(text) > _MAX_CHARACTERS:
        raise ConfigError(
            f"{path}: has more than {_MAX_CHARACTERS} characters; give a scenario file, "
            "which has a few dozen lines"
        )
    return parse_spec(text, str(path))


def parse_spec(text: str, source: str = "scenario") -> SpecTemplate:
    """Parse the scenario of a YAML text.

    Args:
        text: Contents of a scenario file.
        source: Name of the file in error messages.

    Raises:
        ConfigError: The text does not describe a possible scenario; the message names line, field
            and remedy.
    """
    root = read_part(parse_yaml(text, source), ScenarioSpec)
    check_scenario_spec(root)
    return SpecTemplate(root)


def design_text(number: int) -> str:
    """Return the text of a design's scenario file.

    Raises:
        ConfigError: There is no such design.
    """
    folder = files("deepaccident_devkit.plugins.synth.spec").joinpath("designs")
    for entry in folder.iterdir():
        if entry.name.startswith(f"{number:02d}_") and entry.name.endswith(".yaml"):
            return entry.read_text(encoding="utf-8")
    raise ConfigError(
        f"design: {number} is not one of 1 to {len(DESIGN_NUMBERS)}; choose one of these"
    )


@cache
def read_design(number: int) -> SpecTemplate:
    """Read the scenario of a design; raise ConfigError if there is no such design."""
    text = design_text(number)
    return parse_spec(text, f"design {number}")
