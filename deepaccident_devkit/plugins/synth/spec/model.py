"""What a scenario file can say: the parts of a scenario to simulate, and their open choices.

`spec.draw` draws one value from each range and from each list of choices in a file. A field's name is its key in the
file, except that `from_arm` is written `from`.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, TypeAlias

import numpy as np

from deepaccident_devkit.plugins.synth.roads import ARMS, Arm, RoadSpec, Turn


@dataclass(frozen=True, slots=True)
class Bounds:
    """The span of a number, both ends included.

    Attributes:
        low: the smallest.
        high: the largest.
        unit: such as `m/s`; empty for a count.
    """

    low: float
    high: float
    unit: str = ""

    def __str__(self) -> str:
        """Such as `0 to 30 m/s`."""
        return f"{self.low:g} to {self.high:g} {self.unit}".rstrip()


Side = Literal["left", "right"]
View = Literal["open", "hidden"]
Rule = Literal["signal", "priority"]
Role = Literal["ego", "ego_behind", "other", "other_behind", "background", "pedestrian", "parked"]
Category = Literal["car", "truck", "van", "cyclist", "motorcycle", "pedestrian"]
Weather = Literal["Clear", "Cloudy", "HardRain", "MidRain", "SoftRain", "Wet", "WetCloudy"]
TimeOfDay = Literal["Noon", "Sunset", "Night"]

# The meta file's names for the arm itself and for those 1, 2 and 3 arms further, counter-clockwise.
_SIDES = ("same", "right", "opposite", "left")
_MEETING_ROLES: tuple[Role, Role] = ("ego", "other")


@dataclass(frozen=True, slots=True, kw_only=True)
class ActorSpec:
    """One road user that the file names; the road users of the background are drawn in addition.

    Attributes:
        role: who it is; each of the first four at most once. `ego`, `other` and the two behind them are agents.
        category: its kind of road user. `ego`, `other` and those behind them can be a car, truck, van or motorcycle; so
            can `parked`. `background` can also be a cyclist. Only `pedestrian` is a pedestrian.
        from_arm: the arm that it comes from, or where it stands or walks. Leave it out for `ego_behind` and
            `other_behind`: they take the path of the vehicle that they follow.
        turn: what it does at the junction.
        lane: 0 is the rightmost lane. If not given, it follows from the turn: the leftmost lane to turn left, the
            rightmost to turn right, any lane to go straight on.
        max_speed: the speed that it reaches on a free straight road, for a pedestrian 3 m/s at most; if not given,
            drawn by its category.
        start_distance: how far from the middle of the junction it starts, along its path; a parked vehicle: how far
            from there it stands; a pedestrian: how far from there it steps onto the road. If not given, it is drawn.
            Drivers of `meet` cannot have it: their start follows from their timing.
        gap: distance at the start, from bumper to bumper, to the vehicle that it follows; only for those behind.
        side: side of the road, as a driver towards the junction sees it: where a parked vehicle stands, or from where
            a pedestrian steps onto the road.
        lane_change: how far before the middle of the junction it begins to change into the other lane of its road;
            only with the turn `straight`, on a road with two lanes. The vehicle behind it stays in its lane.
        ignores: the rules that it breaks. In the normal twin it keeps them.
    """

    role: Role
    category: Category = "car"
    from_arm: Arm | None = None
    turn: Turn = "straight"
    lane: Annotated[int, Bounds(0, 1)] = 0
    max_speed: Annotated[float, Bounds(0.5, 20, "m/s")] | None = None
    start_distance: Annotated[float, Bounds(0, 120, "m")] | None = None
    gap: Annotated[float, Bounds(2, 40, "m")] | None = None
    side: Side = "right"
    lane_change: Annotated[float, Bounds(10, 110, "m")] | None = None
    ignores: tuple[Rule, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class MeetSpec:
    """Who is timed to meet where their paths cross.

    Attributes:
        actors: two roles that one actor each has; neither those behind nor `parked`.
        offset: how much later than the first the second comes to the crossing of the paths, if nobody brakes.
    """

    actors: tuple[Role, Role] = ("ego", "other")
    offset: Annotated[float, Bounds(-3, 3, "s")] = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class BackgroundSpec:
    """How many more road users than those of `actors` to add; one for which there is no room is left out.

    Attributes:
        vehicles: cars, vans and trucks that drive.
        two_wheelers: motorcycles and cyclists.
        parked: vehicles at the road's edge.
        walking: pedestrians on the sidewalks.
        crossing: pedestrians on the crosswalks.
    """

    vehicles: Annotated[int, Bounds(0, 40)] = 10
    two_wheelers: Annotated[int, Bounds(0, 20)] = 4
    parked: Annotated[int, Bounds(0, 40)] = 12
    walking: Annotated[int, Bounds(0, 40)] = 10
    crossing: Annotated[int, Bounds(0, 20)] = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class ScenarioSpec:
    """A scenario to simulate, with every choice made.

    Attributes:
        name: name of the scenario, for readers.
        design: number of the paper's design, if it is one of the twelve.
        road: the junction.
        view: `hidden` puts a house on the kerb of the corner between ego and other.
        exchange: whether ego and other (and those behind them) change places in half of the draws. In a draw that is
            made in Python it says whether they have changed places.
        actors: the road users that matter; `ego` and `other` are among them.
        meet: who is timed to meet; nobody if not given.
        background: all other road users.
        weather: weather of the whole recording, in the release's words.
        time_of_day: it decides the light.
    """

    name: str = "scenario"
    design: Annotated[int, Bounds(1, 12)] | None = None
    road: RoadSpec = field(default_factory=RoadSpec)
    view: View = "open"
    exchange: bool = False
    actors: tuple[ActorSpec, ...]
    meet: MeetSpec | None = None
    background: BackgroundSpec = field(default_factory=BackgroundSpec)
    weather: Weather = "Clear"
    time_of_day: TimeOfDay = "Noon"

    def actor(self, role: Role) -> ActorSpec:
        """The first actor of a role; KeyError if there is none."""
        for actor in self.actors:
            if actor.role == role:
                return actor
        raise KeyError(role)

    @property
    def spawn_side(self) -> str:
        """Where other comes from, seen from ego, as the meta file names it: `left`, `right`, `opposite` or `same`."""
        ego, other = (ARMS.index(self.actor(role).from_arm or "west") for role in _MEETING_ROLES)
        return _SIDES[(other - ego) % len(ARMS)]


@dataclass(frozen=True, slots=True)
class Fixed:
    """One value."""

    value: Any

    def draw(self, _rng: np.random.Generator) -> Any:
        """The value."""
        return self.value

    def alternatives(self) -> Iterator[Any]:
        """The value."""
        yield self.value


@dataclass(frozen=True, slots=True)
class Range:
    """A span of numbers, each equally likely, both ends included.

    Attributes:
        low: the smallest.
        high: the largest.
        whole: whether only whole numbers are drawn.
    """

    low: float
    high: float
    whole: bool

    def draw(self, rng: np.random.Generator) -> float:
        """A number of the span."""
        if self.whole:
            return int(rng.integers(int(self.low), int(self.high) + 1))
        return float(rng.uniform(self.low, self.high))

    def alternatives(self) -> Iterator[float]:
        """The smallest and the largest."""
        yield from (self.low, self.high)


@dataclass(frozen=True, slots=True)
class OneOf:
    """One of several values, each equally likely; a value that is listed twice is twice as likely."""

    options: tuple[FieldChoice, ...]

    def draw(self, rng: np.random.Generator) -> Any:
        """A value."""
        return self.options[int(rng.integers(len(self.options)))].draw(rng)

    def alternatives(self) -> Iterator[Any]:
        """The values; of a range both ends."""
        return itertools.chain.from_iterable(option.alternatives() for option in self.options)


@dataclass(frozen=True, slots=True)
class AllOf:
    """A list whose items are all kept."""

    items: tuple[FieldChoice, ...]

    def draw(self, rng: np.random.Generator) -> tuple[Any, ...]:
        """All items, each drawn."""
        return tuple(item.draw(rng) for item in self.items)

    def alternatives(self) -> Iterator[AllOf]:
        """Only itself: the open choices are in its items."""
        yield self


@dataclass(frozen=True, slots=True)
class Part:
    """A part of a scenario.

    Attributes:
        kind: its dataclass.
        where: its line of the file, such as `mine.yaml:12`.
        path: such as `actors[1]`; empty for the whole file.
        fields: those that the file names, in the order of the dataclass; the others have their defaults.
        lines: field that the file names → its line, such as `mine.yaml:13`.
    """

    kind: type[Any]
    where: str
    path: str
    fields: Mapping[str, FieldChoice]
    lines: Mapping[str, str]

    def draw(self, rng: np.random.Generator) -> Any:
        """An instance of the dataclass."""
        return self.kind(**{name: choice.draw(rng) for name, choice in self.fields.items()})

    def alternatives(self) -> Iterator[Part]:
        """Only itself: the open choices are in its fields."""
        yield self

    def values(self, name: str) -> tuple[Any, ...]:
        """The alternatives of a field; its default if the file does not name it."""
        return (
            tuple(self.fields[name].alternatives())
            if name in self.fields
            else (default_of(self.kind, name),)
        )

    def instances(self) -> Iterator[Any]:
        """Each instance that can be drawn (of a range only its ends), made one at a time."""
        options = [tuple(_instances(choice)) for choice in self.fields.values()]
        return (
            self.kind(**dict(zip(self.fields, values, strict=True)))
            for values in itertools.product(*options)
        )

    def line(self, name: str) -> str:
        """The line of a field; if the file does not name the field, the line of the part."""
        return self.lines.get(name, self.where)

    def path_of(self, name: str) -> str:
        """The path of a field, such as `actors[1].from`."""
        key = key_of(name)
        return f"{self.path}.{key}" if self.path else key


FieldChoice: TypeAlias = Fixed | Range | OneOf | AllOf | Part


def _instances(choice: FieldChoice) -> Iterator[Any]:
    for value in choice.alternatives():
        yield from value.instances() if isinstance(value, Part) else (value,)


def key_of(name: str) -> str:
    """A field's key in a file: the field `from_arm` has the key `from`, which cannot be a name in Python."""
    return "from" if name == "from_arm" else name


def default_of(kind: type[Any], name: str) -> Any:
    """The default of a field."""
    field = next(field for field in dataclasses.fields(kind) if field.name == name)
    return (
        field.default if field.default_factory is dataclasses.MISSING else field.default_factory()
    )
