"""Checks that every draw from a scenario file is a possible scenario."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from typing import Any, Final, TypeAlias, cast

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.plugins.synth.roads import ARMS, Arm, Junction, RoadSpec, Turn
from deepaccident_devkit.plugins.synth.spec.model import AllOf, Part, Role

# Arm, turn and lane of a driver.
_Movement: TypeAlias = tuple[Arm, Turn, int]
LEADERS: Final[Mapping[Role, Role]] = {"ego_behind": "ego", "other_behind": "other"}
"""Follower's role → leader's role."""
_LEADING_ROLES = tuple(LEADERS.values())
_AGENT_ROLES = (*_LEADING_ROLES, *LEADERS)
_AGENT_CATEGORIES = ("car", "truck", "van", "motorcycle")
_WALKER_ROLE = "pedestrian"
_MAX_ACTORS = 100
# No pedestrian becomes faster between the kerbs.
_MAX_WALKING_SPEED = 3.0  # m/s
_FORBIDDEN_FIELDS: Mapping[str, tuple[str, ...]] = {
    **dict.fromkeys(LEADERS, ("from_arm", "turn", "lane", "start_distance", "side", "lane_change")),
    **dict.fromkeys((*_LEADING_ROLES, "background"), ("gap", "side")),
    _WALKER_ROLE: ("turn", "lane", "gap", "ignores", "lane_change"),
    "parked": ("turn", "lane", "gap", "ignores", "max_speed", "lane_change"),
}


def check_scenario_spec(root: Part) -> None:
    """Check the rules that the types of the fields cannot express.

    Raises:
        ConfigError: A draw would give an impossible scenario; the message names line and field.
    """
    actors = _list_actors(root)
    _check_roles(root, actors)
    _check_roads(root)
    junctions = _list_junctions(root)
    for actor in actors:
        _check_fields(actor)
        _check_category(actor)
        _check_route(actor, junctions)
        _check_lane(actor, junctions)
        _check_speed(actor)
    _check_view(root, actors)
    _check_meeting(root, actors, junctions)


def _list_actors(root: Part) -> Sequence[Part]:
    """Return the actors that a file names."""
    actors = root.fields["actors"]
    if not isinstance(actors, AllOf):
        return ()
    return actors.items  # type: ignore[return-value]


def _get_role(actor: Part) -> Role:
    """Return the role of an actor."""
    return cast("Role", actor.values("role")[0])


def _check_roles(root: Part, actors: Sequence[Part]) -> None:
    """Check that ego and other exist, and that no agent is repeated."""
    if len(actors) > _MAX_ACTORS:
        sentence = f"there are {len(actors)}, but a road has room for only {_MAX_ACTORS}"
        raise _make_fault(root, "actors", sentence, f"keep {_MAX_ACTORS}")
    counts = Counter(_get_role(actor) for actor in actors)
    for role in _LEADING_ROLES:
        if not counts[role]:
            sentence = f"there is no actor with role {role}"
            raise _make_fault(root, "actors", sentence, "add one")
    previous_roles: set[Role] = set()
    for actor in actors:
        role = _get_role(actor)
        if role in _AGENT_ROLES and role in previous_roles:
            sentence = f"there are {counts[role]} actors with role {role}"
            raise _make_fault(actor, "role", sentence, "keep one")
        previous_roles.add(role)


def _list_junctions(root: Part) -> tuple[Junction, ...]:
    """Return one junction of each kind and number of lanes that can be drawn."""
    pairs: set[tuple[Any, Any]] = set()
    for road in root.values("road"):
        if isinstance(road, Part):
            pairs.update(product(road.values("kind"), road.values("lanes")))
    if not pairs:
        return (Junction(),)
    specs = [RoadSpec(kind=kind, lanes=lanes) for kind, lanes in sorted(pairs)]
    return tuple(Junction(spec) for spec in specs)


def _check_fields(actor: Part) -> None:
    """Check that an actor has only fields of its role, and that it has an arm."""
    role = _get_role(actor)
    for name in actor.fields:
        if name in _FORBIDDEN_FIELDS[role]:
            raise _make_fault(actor, name, f"is not possible for the role {role}", "remove it")
    if role not in LEADERS and "from_arm" not in actor.fields:
        sentence = f"is missing; the role {role} needs it"
        remedy = f"add one of {', '.join(ARMS)}"
        raise _make_fault(actor, "from_arm", sentence, remedy)


def _check_category(actor: Part) -> None:
    """Check that the category of an actor fits its role."""
    if "category" not in actor.fields:
        return
    role = _get_role(actor)
    possible = _list_categories(role)
    for category in actor.values("category"):
        if category not in possible:
            remedy = (
                f"choose {', '.join(possible)}; a cyclist has the role background, "
                "a pedestrian the role pedestrian"
            )
            raise _make_fault(actor, "category", f"the role {role} cannot be a {category}", remedy)


def _list_categories(role: Role) -> tuple[str, ...]:
    """Return the categories that an actor of a role can have."""
    if role == _WALKER_ROLE:
        return (_WALKER_ROLE,)
    if role == "background":
        return (*_AGENT_CATEGORIES, "cyclist")
    return _AGENT_CATEGORIES


def _check_route(actor: Part, junctions: Sequence[Junction]) -> None:
    """Check that every junction has the arm of an actor, and allows its turn."""
    if _get_role(actor) in LEADERS:
        return
    for junction, arm, turn in product(junctions, actor.values("from_arm"), actor.values("turn")):
        kind = junction.spec.kind
        if arm not in junction.arms:
            remedy = f"choose {' or '.join(junction.arms)}"
            raise _make_fault(actor, "from_arm", f"a {kind} junction has no {arm} arm", remedy)
        if _is_driver(actor) and turn not in junction.turns(arm):
            sentence = f"the turn {turn} is impossible from the {arm} arm of a {kind} junction"
            remedy = f"choose {' or '.join(junction.turns(arm))}"
            raise _make_fault(actor, "turn", sentence, remedy)


def _is_driver(actor: Part) -> bool:
    """Return whether an actor is a vehicle that moves."""
    return _get_role(actor) not in (_WALKER_ROLE, "parked")


def _check_lane(actor: Part, junctions: Sequence[Junction]) -> None:
    """Check that the lanes of an actor exist, and that it can change its lane if it has to."""
    num_lanes = min(junction.spec.lanes for junction in junctions)
    lane = max(actor.values("lane"))
    if lane >= num_lanes:
        sentence = f"there is no lane {lane} where the road has one lane in each direction"
        raise _make_fault(actor, "lane", sentence, "choose 0, or give the road two lanes")
    if all(value is None for value in actor.values("lane_change")):
        return
    if num_lanes < 2:
        sentence = "there is no other lane where the road has one lane in each direction"
        raise _make_fault(actor, "lane_change", sentence, "remove it, or give the road two lanes")
    if set(actor.values("turn")) != {"straight"}:
        sentence = "is possible only with the turn straight"
        raise _make_fault(actor, "lane_change", sentence, "remove it, or use the turn straight")


def _check_speed(actor: Part) -> None:
    """Check the speed of a pedestrian, who walks or runs over the road and stops at its end."""
    speeds = [speed for speed in actor.values("max_speed") if speed is not None]
    max_speed = max(speeds, default=0.0)
    if _get_role(actor) == _WALKER_ROLE and max_speed > _MAX_WALKING_SPEED:
        sentence = (
            f"expected 0.5 to {_MAX_WALKING_SPEED:g} m/s for a pedestrian, found {max_speed:g}"
        )
        raise _make_fault(actor, "max_speed", sentence, "walking is 1 to 2 m/s, running is 3 m/s")


def _check_roads(root: Part) -> None:
    """Make every road that can be drawn; a road checks itself."""
    for road in root.values("road"):
        if isinstance(road, Part):
            for hump in road.values("hump"):
                if isinstance(hump, Part):
                    _check_instances(hump)
            _check_instances(road)


def _check_instances(part: Part) -> None:
    """Make every instance of a part, and raise the errors with line and field of the file."""
    try:
        for _ in part.instances():
            pass
    except ConfigError as error:
        location, _, sentence = str(error).partition(": ")
        name = location.rpartition(".")[2]
        line = part.where
        path = part.path
        if name in part.fields:
            line = part.line(name)
            path = part.path_of(name)
        raise ConfigError(f"{line}: {path}: {sentence}") from error


def _check_view(root: Part, actors: Sequence[Part]) -> None:
    """Check that a house can hide ego and other from each other, if the view may be hidden."""
    if "hidden" not in root.values("view"):
        return
    ego, other = (
        next(actor for actor in actors if _get_role(actor) == role) for role in _LEADING_ROLES
    )
    for ego_arm, other_arm in product(ego.values("from_arm"), other.values("from_arm")):
        if abs(ARMS.index(ego_arm) - ARMS.index(other_arm)) % 2 == 0:
            sentence = (
                f"no house can stand between ego from the {ego_arm} and other from the {other_arm}"
            )
            raise _make_fault(root, "view", sentence, "choose open, or neighbouring arms")


def _check_meeting(root: Part, actors: Sequence[Part], junctions: Sequence[Junction]) -> None:
    """Check that the roles that are timed to meet exist and can meet."""
    actors_by_role = {_get_role(actor): actor for actor in actors}
    counts = Counter(_get_role(actor) for actor in actors)
    meetings = root.values("meet")
    for meeting in meetings:
        if not isinstance(meeting, Part):
            continue
        roles = meeting_roles(meeting)
        for role in roles:
            if role in LEADERS or role == "parked":
                remedy = "choose two roles, such as ego and other"
                raise _make_fault(meeting, "actors", f"{role} cannot be timed", remedy)
            if counts[role] != 1:
                sentence = f"there are {counts[role]} actors with role {role}"
                raise _make_fault(meeting, "actors", sentence, "choose roles that one actor has")
        if roles[0] == roles[1]:
            raise _make_fault(meeting, "actors", f"{roles[0]} cannot meet itself", "name two roles")
        pair = (actors_by_role[roles[0]], actors_by_role[roles[1]])
        if None not in meetings:
            for actor in pair:
                _check_start(meeting, actor)
        if all(_is_driver(actor) and actor.values("lane_change") == (None,) for actor in pair):
            _check_crossing(meeting, pair, junctions)


def _check_start(meeting: Part, actor: Part) -> None:
    """Check that the file does not set the start of a timed driver, which follows from its timing.

    A pedestrian's start distance only sets its place, so it is permitted.
    """
    role = _get_role(actor)
    if role != _WALKER_ROLE and actor.values("start_distance") != (None,):
        sentence = f"is computed from meet ({meeting.where}) for the timed role {role}"
        remedy = "remove it; meet.offset sets which of the two comes later"
        raise _make_fault(actor, "start_distance", sentence, remedy)


def meeting_roles(meeting: Part) -> tuple[Role, Role]:
    """Return the two roles that are timed to meet."""
    (pair,) = meeting.values("actors")
    if isinstance(pair, AllOf):
        pair = tuple(next(item.alternatives()) for item in pair.items)
    return cast("tuple[Role, Role]", pair)


def _check_crossing(meeting: Part, pair: tuple[Part, Part], junctions: Sequence[Junction]) -> None:
    """Check that the paths of two drivers cross, whatever is drawn."""
    for junction in junctions:
        possible_movements = [_list_movements(actor, junction) for actor in pair]
        for movements in product(*possible_movements):
            routes = [junction.route(*movement) for movement in movements]
            if junction.conflicts(*routes) is not None:
                continue
            drivers = []
            for actor, movement in zip(pair, movements, strict=True):
                words = " ".join(map(str, movement))
                drivers.append(f"{_get_role(actor)} ({words})")
            sentence = f"the paths of {' and '.join(drivers)} do not cross"
            raise _make_fault(meeting, "actors", sentence, _suggest_remedy(*movements))


def _suggest_remedy(movement: _Movement, other_movement: _Movement) -> str:
    """Suggest how to change two routes that do not intersect."""
    arm, _, lane = movement
    other_arm, _, other_lane = other_movement
    if arm == other_arm and lane == other_lane:
        return (
            "in one lane they follow each other; let one of them start in the other lane, "
            "with a lane_change"
        )
    return "change an arm, a turn or a lane"


def _list_movements(actor: Part, junction: Junction) -> Iterator[_Movement]:
    """Yield every arm, turn and lane of a driver that can be drawn."""
    for arm, turn in product(actor.values("from_arm"), actor.values("turn")):
        lanes: Sequence[int] = usual_lanes(turn, junction.spec.lanes)
        if "lane" in actor.fields:
            lanes = actor.values("lane")
        for lane in lanes:
            yield arm, turn, lane


def usual_lanes(turn: Turn, lanes: int) -> range:
    """Return the lanes of a road from which a turn is usually made."""
    if turn == "left":
        return range(lanes - 1, lanes)
    if turn == "right":
        return range(1)
    return range(lanes)


def _make_fault(part: Part, name: str, sentence: str, remedy: str) -> ConfigError:
    """Return the error for a field of a part."""
    line = part.line(name)
    path = part.path_of(name)
    return ConfigError(f"{line}: {path}: {sentence}; {remedy}")
