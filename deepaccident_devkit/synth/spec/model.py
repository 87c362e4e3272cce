"""What a scenario file can say: the parts of a scenario to simulate, with every choice made.

A file's ranges and lists of choices are drawn by `spec.draw`; what it gives has one value everywhere. A field's name is
its key in the file, but that `from_arm` is written `from`.
"""

from dataclasses import dataclass, field
from typing import Annotated, Literal

from deepaccident_devkit.synth.roads import ARMS, Arm, RoadSpec, Turn


@dataclass(frozen=True, slots=True)
class Bounds:
    """The span of a number, both ends included.

    Attributes:
        low: the least.
        high: the most.
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
Rule = Literal["signal", "priority", "crosswalk"]
Role = Literal["ego", "ego_behind", "other", "other_behind", "background", "pedestrian", "parked"]
Category = Literal["car", "truck", "van", "cyclist", "motorcycle", "pedestrian"]
Weather = Literal["Clear", "Cloudy", "HardRain", "MidRain", "SoftRain", "Wet", "WetCloudy"]
TimeOfDay = Literal["Noon", "Sunset", "Night"]

_SIDES = ("same", "right", "opposite", "left")
"""How meta names the arm that lies so many arms further, counter-clockwise."""
_MEETING_ROLES: tuple[Role, Role] = ("ego", "other")


@dataclass(frozen=True, slots=True, kw_only=True)
class ActorSpec:
    """One road user that the file names; the background's are drawn besides.

    Attributes:
        role: who it is; each of the first four once at most. `ego` and `other` record, and so do those behind them.
        category: of its body.
        from_arm: the arm that it comes from, or stands or walks at. `ego_behind` and `other_behind` take the way of
            those whom they follow, and have none of their own.
        turn: what it does at the junction.
        lane: 0 is the rightmost one. If a file does not say it, it follows from the turn: the leftmost to turn left,
            the rightmost to turn right, any to go straight on.
        max_speed: that it reaches on a free straight road; drawn by its category if not given.
        start_distance: from its start to the middle of the junction, along its path; of a parked or walking one,
            from there to the middle of the junction. If not given it follows from `meet`, or is drawn.
        gap: from bumper to bumper to the one whom it follows, at the start; only for those behind.
        delay: before it sets off.
        side: of the road, seen by those who drive towards the junction: where a parked one stands, and from where a
            pedestrian steps onto the road.
        lane_change: from where it begins to change into the other lane of its road, to the middle of the junction;
            only for one that goes straight on, on a road with two lanes. Who is behind it stays in the lane.
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
    delay: Annotated[float, Bounds(0, 10, "s")] = 0.0
    side: Side = "right"
    lane_change: Annotated[float, Bounds(10, 110, "m")] | None = None
    ignores: tuple[Rule, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class MeetSpec:
    """Who is timed to meet where their paths cross.

    Attributes:
        actors: two roles, of which there is one actor each; not those behind, nor `parked`.
        offset: how much later the second comes to the crossing of the paths than the first, if nobody brakes.
    """

    actors: tuple[Role, Role] = ("ego", "other")
    offset: Annotated[float, Bounds(-3, 3, "s")] = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class BackgroundSpec:
    """How many road users are tried besides those of `actors`; one that finds no room is left out.

    Attributes:
        vehicles: cars, vans and trucks that drive.
        two_wheelers: motorcycles and cyclists.
        parked: at the road's edge.
        walking: pedestrians on the sidewalks.
        crossing: pedestrians over the crosswalks.
    """

    vehicles: Annotated[int, Bounds(0, 40)] = 10
    two_wheelers: Annotated[int, Bounds(0, 20)] = 4
    parked: Annotated[int, Bounds(0, 40)] = 12
    walking: Annotated[int, Bounds(0, 40)] = 10
    crossing: Annotated[int, Bounds(0, 20)] = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class EndSpec:
    """When the recording ends; a collision always ends it.

    Attributes:
        time: at the latest.
        arrival: it also ends when ego is this far past the middle of the junction, along its path.
    """

    time: Annotated[float, Bounds(1, 20, "s")] = 10.0
    arrival: Annotated[float, Bounds(10, 90, "m")] = 25.0


@dataclass(frozen=True, slots=True, kw_only=True)
class ScenarioSpec:
    """A scenario to simulate, with every choice made.

    Attributes:
        name: of the file, for people.
        design: which of the paper's twelve it is, if it is one.
        road: the junction.
        view: `hidden` puts a house on the kerb of the corner between ego and other.
        exchange: whether ego and other change places in half of the draws, and those behind them; of a draw, whether
            they did.
        actors: the road users that matter; `ego` and `other` are among them.
        meet: who is timed to meet; nobody if not given.
        background: everyone else.
        weather: of the whole recording, in the release's words.
        time_of_day: which decides the light.
        end: when the recording ends.
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
    end: EndSpec = field(default_factory=EndSpec)

    def actor(self, role: Role) -> ActorSpec:
        """The first actor of a role; there is one, or KeyError."""
        for actor in self.actors:
            if actor.role == role:
                return actor
        raise KeyError(role)

    @property
    def spawn_side(self) -> str:
        """Where other comes from, seen from ego, as meta names it: `left`, `right`, `opposite` or `same`."""
        ego, other = (ARMS.index(self.actor(role).from_arm or "west") for role in _MEETING_ROLES)
        return _SIDES[(other - ego) % len(ARMS)]
