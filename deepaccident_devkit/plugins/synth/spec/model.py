"""The fields of a scenario file, and the choices that it leaves open.

`spec.draw` draws one value from each range and from each list of choices in a file. A field's name
is its key in the file, except that `from_arm` is written `from`.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, TypeAlias

import numpy as np

from deepaccident_devkit.plugins.synth.roads import ARMS, Arm, RoadSpec, Turn

Side = Literal["left", "right"]
View = Literal["open", "hidden"]
Rule = Literal["signal", "priority"]
Role = Literal["ego", "ego_behind", "other", "other_behind", "background", "pedestrian", "parked"]
Category = Literal["car", "truck", "van", "cyclist", "motorcycle", "pedestrian"]
Weather = Literal["Clear", "Cloudy", "HardRain", "MidRain", "SoftRain", "Wet", "WetCloudy"]
TimeOfDay = Literal["Noon", "Sunset", "Night"]

# The meta file's names for the same arm, and for the arms that are 1, 2 and 3 quarter turns further
# counter-clockwise.
_SPAWN_SIDES = ("same", "right", "opposite", "left")


@dataclass(frozen=True, slots=True)
class Bounds:
    """The permitted range of a number, both ends included.

    Attributes:
        low: Smallest value.
        high: Largest value.
        unit: Unit, such as `m/s`; empty for a count.
    """

    low: float
    high: float
    unit: str = ""

    def __str__(self) -> str:
        """Return the bounds in words, such as `0 to 30 m/s`."""
        text = f"{self.low:g} to {self.high:g} {self.unit}"
        return text.rstrip()


@dataclass(frozen=True, slots=True, kw_only=True)
class ActorSpec:
    """A road user that the file names; background road users come in addition.

    Attributes:
        role: Role in the scenario; each of the first four at most once. `ego`, `other` and the two
            behind them are agents.
        category: Kind of road user. `ego`, `other` and their followers can be a car, truck, van or
            motorcycle; so can `parked`. `background` can also be a cyclist. Only `pedestrian` is a
            pedestrian.
        from_arm: Arm that it comes from, or where it stands or walks. Leave it out for `ego_behind`
            and `other_behind`: they take the path of the vehicle that they follow.
        turn: Turn that it takes at the junction.
        lane: Number of its lane; 0 is the rightmost lane. If not given, it follows from the turn:
            the leftmost lane to turn left, the rightmost to turn right, any lane to go straight on.
        max_speed: Speed that it reaches on a free straight road; at most 3 m/s for a pedestrian. If
            not set, it is drawn for its category.
        start_distance: Distance along its path from its start to the middle of the junction; for a
            parked vehicle, the distance at which it stands; for a pedestrian, at which it steps
            onto the road. If not set, it is drawn. It cannot be set for drivers of `meet`, whose
            start follows from their timing.
        gap: Distance at the start, from bumper to bumper, to the vehicle that it follows; only for
            followers.
        side: Side of the road, as a driver towards the junction sees it: where a parked vehicle
            stands, or from where a pedestrian steps onto the road.
        lane_change: Distance before the middle of the junction at which it begins to change into
            the other lane of its road; only with the turn `straight`, on a road with two lanes. The
            vehicle behind it stays in its lane.
        ignores: Rules that it breaks in the accident. In the normal twin it obeys them.
    """

    # identity
    role: Role
    category: Category = "car"
    # route
    from_arm: Arm | None = None
    turn: Turn = "straight"
    lane: Annotated[int, Bounds(0, 1)] = 0
    # speed and start
    max_speed: Annotated[float, Bounds(0.5, 20, "m/s")] | None = None
    start_distance: Annotated[float, Bounds(0, 120, "m")] | None = None
    gap: Annotated[float, Bounds(2, 40, "m")] | None = None
    side: Side = "right"
    # behaviour
    lane_change: Annotated[float, Bounds(10, 110, "m")] | None = None
    ignores: tuple[Rule, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class MeetSpec:
    """The two road users that are timed to collide where their paths cross.

    Attributes:
        actors: Two roles, each of which exactly one actor has; neither a follower nor `parked`.
        offset: Time by which the second actor comes to the crossing of the paths after the first
            one, if neither brakes.
    """

    actors: tuple[Role, Role] = ("ego", "other")
    offset: Annotated[float, Bounds(-3, 3, "s")] = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class BackgroundSpec:
    """Numbers of road users to add to `actors`; one that finds no room is left out.

    Attributes:
        vehicles: Number of cars, vans and trucks that drive.
        two_wheelers: Number of motorcycles and cyclists.
        parked: Number of vehicles at the road's edge.
        walking: Number of pedestrians on the sidewalks.
        crossing: Number of pedestrians on the crosswalks.
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
        name: Name of the scenario, for readers.
        design: Number of the paper's design, if it is one of the twelve.
        road: The junction.
        view: `hidden` puts a house on the kerb of the corner between ego and other.
        exchange: Whether ego and other (and their followers) change places in half of the draws. In
            a draw that is made in Python, whether they have changed places.
        actors: Named road users; `ego` and `other` are among them.
        meet: Road users that are timed to meet; if not set, there is no such pair.
        background: All other road users.
        weather: Weather of the whole recording, in the release's words.
        time_of_day: Time of day, which decides the light.
    """

    # name
    name: str = "scenario"
    design: Annotated[int, Bounds(1, 12)] | None = None
    # place
    road: RoadSpec = field(default_factory=RoadSpec)
    view: View = "open"
    # road users
    exchange: bool = False
    actors: tuple[ActorSpec, ...]
    meet: MeetSpec | None = None
    background: BackgroundSpec = field(default_factory=BackgroundSpec)
    # sky
    weather: Weather = "Clear"
    time_of_day: TimeOfDay = "Noon"

    def actor(self, role: Role) -> ActorSpec:
        """Return the first actor with a role; raise KeyError if there is none."""
        for actor in self.actors:
            if actor.role == role:
                return actor
        raise KeyError(role)

    @property
    def spawn_side(self) -> str:
        """Side from which other approaches ego, in the meta file's words.

        One of `left`, `right`, `opposite` and `same`.
        """
        ego_arm = self.actor("ego").from_arm or "west"
        other_arm = self.actor("other").from_arm or "west"
        quarters = ARMS.index(other_arm) - ARMS.index(ego_arm)
        return _SPAWN_SIDES[quarters % len(ARMS)]


@dataclass(frozen=True, slots=True)
class Fixed:
    """A choice of one value."""

    value: Any

    def draw(self, _rng: np.random.Generator) -> Any:
        """Return the value."""
        return self.value

    def alternatives(self) -> Iterator[Any]:
        """Yield the value."""
        yield self.value


@dataclass(frozen=True, slots=True)
class Range:
    """A span of numbers, each equally likely, both ends included.

    Attributes:
        low: Smallest number.
        high: Largest number.
        is_whole: Whether only whole numbers are drawn.
    """

    low: float
    high: float
    is_whole: bool

    def draw(self, rng: np.random.Generator) -> float:
        """Draw a number from the range."""
        if self.is_whole:
            return int(rng.integers(int(self.low), int(self.high) + 1))
        return float(rng.uniform(self.low, self.high))

    def alternatives(self) -> Iterator[float]:
        """Yield the smallest and the largest number."""
        yield from (self.low, self.high)


@dataclass(frozen=True, slots=True)
class OneOf:
    """A choice of one of several values, each equally likely.

    A value that is listed twice is twice as likely.
    """

    options: tuple[FieldChoice, ...]

    def draw(self, rng: np.random.Generator) -> Any:
        """Draw a value."""
        option = self.options[int(rng.integers(len(self.options)))]
        return option.draw(rng)

    def alternatives(self) -> Iterator[Any]:
        """Yield the values; a range gives both of its ends."""
        for option in self.options:
            yield from option.alternatives()


@dataclass(frozen=True, slots=True)
class AllOf:
    """A list; a draw contains every item."""

    items: tuple[FieldChoice, ...]

    def draw(self, rng: np.random.Generator) -> tuple[Any, ...]:
        """Draw each item."""
        values = [item.draw(rng) for item in self.items]
        return tuple(values)

    def alternatives(self) -> Iterator[AllOf]:
        """Yield only the list itself: the open choices are in its items."""
        yield self


@dataclass(frozen=True, slots=True)
class Part:
    """A part of a scenario.

    Attributes:
        kind: Dataclass of the part.
        where: Line of the file where the part begins, such as `mine.yaml:12`.
        path: Path of the part, such as `actors[1]`; empty for the whole file.
        fields: Fields that the file names, in the order of the dataclass; the others have their
            defaults.
        lines: Lines of the fields that the file names, such as `mine.yaml:13`, by field.
    """

    kind: type[Any]
    where: str
    path: str
    fields: Mapping[str, FieldChoice]
    lines: Mapping[str, str]

    def draw(self, rng: np.random.Generator) -> Any:
        """Draw an instance of the dataclass."""
        values = {name: choice.draw(rng) for name, choice in self.fields.items()}
        return self.kind(**values)

    def alternatives(self) -> Iterator[Part]:
        """Yield only the part itself: the open choices are in its fields."""
        yield self

    def values(self, name: str) -> tuple[Any, ...]:
        """Return the alternatives of a field; its default if the file does not name it."""
        if name in self.fields:
            return tuple(self.fields[name].alternatives())
        return (default_of(self.kind, name),)

    def instances(self) -> Iterator[Any]:
        """Yield the instances that can be drawn (of a range only its ends), one at a time."""
        options = [tuple(_list_values(choice)) for choice in self.fields.values()]
        for values in itertools.product(*options):
            values_by_name = dict(zip(self.fields, values, strict=True))
            yield self.kind(**values_by_name)

    def line(self, name: str) -> str:
        """Return the line of a field; if the file does not name the field, the line of the part."""
        return self.lines.get(name, self.where)

    def path_of(self, name: str) -> str:
        """Return the path of a field, such as `actors[1].from`."""
        key = key_of(name)
        if not self.path:
            return key
        return f"{self.path}.{key}"


FieldChoice: TypeAlias = Fixed | Range | OneOf | AllOf | Part


def _list_values(choice: FieldChoice) -> Iterator[Any]:
    """Yield the values of a choice; a part gives all its instances."""
    for value in choice.alternatives():
        if isinstance(value, Part):
            yield from value.instances()
        else:
            yield value


def key_of(name: str) -> str:
    """Return a field's key in a file.

    The field `from_arm` has the key `from`, which cannot be a name in Python.
    """
    return "from" if name == "from_arm" else name


def default_of(kind: type[Any], name: str) -> Any:
    """Return the default of a field of a dataclass."""
    fields_by_name = {field.name: field for field in dataclasses.fields(kind)}
    field = fields_by_name[name]
    if field.default_factory is dataclasses.MISSING:
        return field.default
    return field.default_factory()
