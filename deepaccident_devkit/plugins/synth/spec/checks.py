"""Checks that a scenario file is a possible scenario with all values that can be drawn."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from typing import Final, TypeAlias, cast

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.plugins.synth.roads import ARMS, Arm, Junction, RoadSpec, Turn
from deepaccident_devkit.plugins.synth.spec.model import AllOf, Part, Role

# Arm, turn and lane.
_Way: TypeAlias = tuple[Arm, Turn, int]
# Role of a follower → role of its leader.
LEADERS: Final[Mapping[Role, Role]] = {"ego_behind": "ego", "other_behind": "other"}
_LEADING: Final = tuple(LEADERS.values())
_AGENTS: Final = (*_LEADING, *LEADERS)
_AGENT_CATEGORIES: Final = ("car", "truck", "van", "motorcycle")
_WALKING: Final = "pedestrian"
_MOST_ACTORS: Final = 100
# m/s: from kerb to kerb no pedestrian becomes faster.
_FASTEST_WALK: Final = 3.0
# Role → fields that it cannot have.
_FORBIDDEN: Final[Mapping[str, tuple[str, ...]]] = {
    **dict.fromkeys(LEADERS, ("from_arm", "turn", "lane", "start_distance", "side", "lane_change")),
    **dict.fromkeys((*_LEADING, "background"), ("gap", "side")),
    _WALKING: ("turn", "lane", "gap", "ignores", "lane_change"),
    "parked": ("turn", "lane", "gap", "ignores", "max_speed", "lane_change"),
}


def check_scenario_spec(root: Part) -> None:
    """Check what the fields' types alone cannot show; raises ConfigError, with line and field, if a draw cannot be."""
    actors = _actors(root)
    _check_roles(root, actors)
    _check_roads(root)
    junctions = _junctions(root)
    for actor in actors:
        _check_fields(actor)
        _check_category(actor)
        _check_way(actor, junctions)
        _check_lane(actor, junctions)
        _check_speed(actor)
    _check_view(root, actors)
    _check_meeting(root, actors, junctions)


def _actors(root: Part) -> Sequence[Part]:
    actors = root.fields["actors"]
    return actors.items if isinstance(actors, AllOf) else ()  # type: ignore[return-value]


def _role(actor: Part) -> Role:
    return cast("Role", actor.values("role")[0])


def _check_roles(root: Part, actors: Sequence[Part]) -> None:
    if len(actors) > _MOST_ACTORS:
        raise _fault(
            root,
            "actors",
            f"there are {len(actors)}; no road has room for so many",
            f"keep {_MOST_ACTORS}",
        )
    counts = Counter(_role(actor) for actor in actors)
    for role in _LEADING:
        if not counts[role]:
            raise _fault(root, "actors", f"there is no actor with role {role}", "add one")
    seen: set[Role] = set()
    for actor in actors:
        role = _role(actor)
        if role in _AGENTS and role in seen:
            raise _fault(
                actor, "role", f"there are {counts[role]} actors with role {role}", "keep one"
            )
        seen.add(role)


def _junctions(root: Part) -> tuple[Junction, ...]:
    """One junction of each kind and number of lanes that can be drawn."""
    pairs = {
        pair
        for road in root.values("road")
        for pair in (
            product(road.values("kind"), road.values("lanes")) if isinstance(road, Part) else ()
        )
    }
    return tuple(Junction(RoadSpec(kind=kind, lanes=lanes)) for kind, lanes in sorted(pairs)) or (
        Junction(),
    )


def _check_fields(actor: Part) -> None:
    role = _role(actor)
    for name in actor.fields:
        if name in _FORBIDDEN[role]:
            raise _fault(actor, name, f"is not possible for the role {role}", "leave it out")
    if role not in LEADERS and "from_arm" not in actor.fields:
        raise _fault(
            actor,
            "from_arm",
            f"is missing; the role {role} needs it",
            f"add one of {', '.join(ARMS)}",
        )


def _check_category(actor: Part) -> None:
    role = _role(actor)
    possible = _possible_categories(role)
    for category in actor.values("category") if "category" in actor.fields else ():
        if category not in possible:
            remedy = f"choose {', '.join(possible)}; a cyclist has the role background, a pedestrian the role pedestrian"
            raise _fault(actor, "category", f"the role {role} cannot be a {category}", remedy)


def _possible_categories(role: Role) -> tuple[str, ...]:
    if role == _WALKING:
        return (_WALKING,)
    return (*_AGENT_CATEGORIES, "cyclist") if role == "background" else _AGENT_CATEGORIES


def _check_way(actor: Part, junctions: Sequence[Junction]) -> None:
    if _role(actor) in LEADERS:
        return
    for junction, arm, turn in product(junctions, actor.values("from_arm"), actor.values("turn")):
        kind = junction.spec.kind
        if arm not in junction.arms:
            remedy = f"choose {' or '.join(junction.arms)}"
            raise _fault(actor, "from_arm", f"a {kind} junction has no {arm} arm", remedy)
        if _drives(actor) and turn not in junction.turns(arm):
            remedy = f"choose {' or '.join(junction.turns(arm))}"
            raise _fault(
                actor,
                "turn",
                f"nobody can go {turn} from the {arm} arm of a {kind} junction",
                remedy,
            )


def _drives(actor: Part) -> bool:
    return _role(actor) not in (_WALKING, "parked")


def _check_lane(actor: Part, junctions: Sequence[Junction]) -> None:
    fewest = min(junction.spec.lanes for junction in junctions)
    if max(actor.values("lane")) >= fewest:
        sentence = f"there is no lane {max(actor.values('lane'))} where the road has one lane in each direction"
        raise _fault(actor, "lane", sentence, "choose 0, or give the road two lanes")
    if any(value is not None for value in actor.values("lane_change")):
        if fewest < 2:
            sentence = "there is no other lane where the road has one lane in each direction"
            raise _fault(actor, "lane_change", sentence, "leave it out, or give the road two lanes")
        if set(actor.values("turn")) != {"straight"}:
            sentence = "is possible only with the turn straight"
            raise _fault(actor, "lane_change", sentence, "leave it out, or go straight on")


def _check_speed(actor: Part) -> None:
    """A pedestrian walks or runs over the road, and stops at the other kerb."""
    fastest = max((speed for speed in actor.values("max_speed") if speed is not None), default=0.0)
    if _role(actor) == _WALKING and fastest > _FASTEST_WALK:
        sentence = f"expected 0.5 to {_FASTEST_WALK:g} m/s for a pedestrian, found {fastest:g}"
        raise _fault(actor, "max_speed", sentence, "walking is 1 to 2 m/s, running 3")


def _check_roads(root: Part) -> None:
    """Make every road that can be drawn; a road checks itself."""
    for road in root.values("road"):
        if isinstance(road, Part):
            for hump in road.values("hump"):
                if isinstance(hump, Part):
                    _try(hump)
            _try(road)


def _try(part: Part) -> None:
    try:
        for _ in part.instances():
            pass
    except ConfigError as error:
        place, _, sentence = str(error).partition(": ")
        name = place.rpartition(".")[2]
        line, path = (
            (part.line(name), part.path_of(name))
            if name in part.fields
            else (part.where, part.path)
        )
        raise ConfigError(f"{line}: {path}: {sentence}") from error


def _check_view(root: Part, actors: Sequence[Part]) -> None:
    if "hidden" not in root.values("view"):
        return
    ego, other = (next(actor for actor in actors if _role(actor) == role) for role in _LEADING)
    for one, another in product(ego.values("from_arm"), other.values("from_arm")):
        if abs(ARMS.index(one) - ARMS.index(another)) % 2 == 0:
            sentence = f"no house can stand between ego from the {one} and other from the {another}"
            raise _fault(root, "view", sentence, "choose open, or neighbouring arms")


def _check_meeting(root: Part, actors: Sequence[Part], junctions: Sequence[Junction]) -> None:
    by_role = {_role(actor): actor for actor in actors}
    counts = Counter(_role(actor) for actor in actors)
    for meeting in root.values("meet"):
        if not isinstance(meeting, Part):
            continue
        first, second = meeting_roles(meeting)
        for role in (first, second):
            if role in LEADERS or role == "parked":
                raise _fault(
                    meeting,
                    "actors",
                    f"{role} cannot be timed",
                    "choose two roles such as ego and other",
                )
            if counts[role] != 1:
                sentence = f"there are {counts[role]} actors with role {role}"
                raise _fault(meeting, "actors", sentence, "choose roles that one actor has")
        if first == second:
            raise _fault(meeting, "actors", f"{first} cannot meet itself", "name two roles")
        for role in (first, second) if None not in root.values("meet") else ():
            _check_timed(meeting, by_role[role])
        if all(
            _drives(by_role[role]) and by_role[role].values("lane_change") == (None,)
            for role in (first, second)
        ):
            _check_crossing(meeting, by_role[first], by_role[second], junctions)


def _check_timed(meeting: Part, actor: Part) -> None:
    """The start of those who are timed follows from the meeting; that of a pedestrian is its place."""
    role = _role(actor)
    if role != _WALKING and actor.values("start_distance") != (None,):
        sentence = f"follows from meet ({meeting.where}) for {role}, who is timed"
        raise _fault(
            actor, "start_distance", sentence, "leave it out; meet.offset says who comes later"
        )


def meeting_roles(meeting: Part) -> tuple[Role, Role]:
    """Who is timed to meet."""
    (pair,) = meeting.values("actors")
    roles = (
        tuple(next(item.alternatives()) for item in pair.items) if isinstance(pair, AllOf) else pair
    )
    return cast("tuple[Role, Role]", roles)


def _check_crossing(
    meeting: Part, first: Part, second: Part, junctions: Sequence[Junction]
) -> None:
    for junction in junctions:
        for ways in product(_ways(first, junction), _ways(second, junction)):
            if junction.conflicts(*(junction.route(*way) for way in ways)) is None:
                texts = [
                    f"{_role(actor)} ({' '.join(map(str, way))})"
                    for actor, way in zip((first, second), ways, strict=True)
                ]
                raise _fault(
                    meeting,
                    "actors",
                    f"the ways of {' and '.join(texts)} do not meet",
                    _way_to_meet(*ways),
                )


def _way_to_meet(one: _Way, other: _Way) -> str:
    """What to do about two ways that do not meet."""
    if (one[0], one[2]) == (other[0], other[2]):
        return "in one lane they follow each other; let one of them come by the other lane, with a lane_change"
    return "change an arm, a turn or a lane"


def _ways(actor: Part, junction: Junction) -> Iterator[_Way]:
    """Every arm, turn and lane of a driver that can be drawn."""
    for arm, turn in product(actor.values("from_arm"), actor.values("turn")):
        lanes = (
            actor.values("lane")
            if "lane" in actor.fields
            else usual_lanes(turn, junction.spec.lanes)
        )
        yield from ((arm, turn, lane) for lane in lanes)


def usual_lanes(turn: Turn, lanes: int) -> range:
    """The lanes of a road from which a turn is usually made."""
    return {"left": range(lanes - 1, lanes), "right": range(1), "straight": range(lanes)}[turn]


def _fault(part: Part, name: str, sentence: str, remedy: str) -> ConfigError:
    return ConfigError(f"{part.line(name)}: {part.path_of(name)}: {sentence}; {remedy}")
