"""A scenario whose ranges and choices are still open, and how to draw from it."""

from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from deepaccident_devkit.synth.roads import ARMS, Arm
from deepaccident_devkit.synth.spec.checks import LEADERS, meeting_roles, usual_lanes
from deepaccident_devkit.synth.spec.choices import Items, Part, has_list
from deepaccident_devkit.synth.spec.model import ActorSpec, Role, ScenarioSpec

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

    @property
    def draws_alike(self) -> bool:
        """Whether only numbers differ between draws: nobody's way, kind or lane is drawn from several."""
        if self.root.values("exchange")[0] or self._has_two_lanes:
            return False
        parts = (self.root.fields[name] for name in ("road", "view", "actors", "meet") if name in self.root.fields)
        return not any(has_list(part) for part in parts)

    @property
    def _has_two_lanes(self) -> bool:
        """Whether a draw can have a road with two lanes, of which a driver's lane may be drawn."""
        return any(isinstance(road, Part) and road.values("lanes") != (1,) for road in self.root.values("road"))


def draw(template: SpecTemplate, rng: np.random.Generator) -> ScenarioSpec:
    """Make every choice of a scenario.

    It always has all four vehicle agents: followers that the file does not name are cars. If the file asks for an
    exchange, ego and other change places in half of the draws; a four-way junction is then turned, so that ego comes
    from the same arm as before.

    Args:
        template: from `read_spec`, or one of `DESIGNS`.
        rng: random numbers; the same numbers give the same scenario.
    """
    spec = cast("ScenarioSpec", template.root.draw(rng))
    named = cast("Items", template.root.fields["actors"]).items
    actors = [_completed(actor, cast("Part", part), spec, rng) for actor, part in zip(spec.actors, named, strict=True)]
    roles = {actor.role for actor in actors}
    actors += [ActorSpec(role=role) for role in LEADERS if role not in roles]
    spec = replace(spec, actors=tuple(actors))
    exchanged = spec.exchange and bool(rng.random() < 0.5)
    return _exchanged(spec) if exchanged else replace(spec, exchange=False)


def _completed(actor: ActorSpec, part: Part, spec: ScenarioSpec, rng: np.random.Generator) -> ActorSpec:
    """An actor with the values that follow from others."""
    if actor.role == "pedestrian":
        return replace(actor, category="pedestrian")
    if "lane" in part.fields or spec.road.lanes == 1:
        return actor
    lane = int(rng.choice(usual_lanes(actor.turn, spec.road.lanes)))
    return replace(actor, lane=lane)


def _exchanged(spec: ScenarioSpec) -> ScenarioSpec:
    """The scenario with ego in the place of other, and other in the place of ego."""
    came_from = spec.actor("ego").from_arm
    actors = tuple(replace(actor, role=_EXCHANGED.get(actor.role, actor.role)) for actor in spec.actors)
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
        actor if actor.from_arm is None else replace(actor, from_arm=turned(actor.from_arm)) for actor in spec.actors
    )
    return replace(spec, road=replace(spec.road, hump=hump), actors=actors)
