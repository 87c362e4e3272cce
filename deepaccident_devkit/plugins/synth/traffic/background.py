"""All road users that a file does not name: vehicles, two-wheelers, pedestrians; and all parked vehicles."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from deepaccident_devkit.plugins.synth.actors import Body, random_body
from deepaccident_devkit.plugins.synth.roads import Junction, Path, Route
from deepaccident_devkit.plugins.synth.roads.layout import OUTWARD
from deepaccident_devkit.plugins.synth.spec import ActorSpec, ScenarioSpec
from deepaccident_devkit.plugins.synth.traffic.driving import (
    MANNERS,
    RoadUser,
    lane_span,
    lane_way,
    shifted_path,
)
from deepaccident_devkit.plugins.synth.traffic.rights import RED, SignalPlan
from deepaccident_devkit.support.arrays import FloatArray

_DRIVERS = ("car", "car", "car", "car", "van", "truck")
_RIDERS = ("motorcycle", "cyclist")
# Metres from the junction's middle within which background traffic starts.
_REACH = 75.0
_TRIES = 8
# The gap between two who start in one lane: metres, and seconds of driving that are added to them.
_START_GAP = (3.0, 1.2)
# m/s² with which those who start before a red light or a yield line already brake.
_QUEUE_BRAKING = 1.5
# Metres from the junction's middle within which a house that hides the view stands.
_HOUSE_REACH = 32.0
# Least and most metres from a sidewalk's middle to the right, so that people pass each other on the left.
_SIDEWALK_OFFSETS = (0.2, 0.4)
_CROSSWALK_OFFSETS = (0.3, 0.9)


def background_users(
    rng: np.random.Generator,
    spec: ScenarioSpec,
    junction: Junction,
    named: Sequence[RoadUser],
    signals: SignalPlan | None,
    begin: float,
) -> list[RoadUser]:
    """The moving background as the simulation begins (seconds); those for whom there is no room are left out.

    The lanes in front of the named road users stay free up to the junction.
    """
    placed = _Lanes(named)
    users: list[RoadUser] = []
    sidewalks = [path for path in junction.sidewalk_paths() if not _built_over(spec, path)]
    kinds: list[tuple[int, Callable[[], RoadUser | None]]] = [
        (
            spec.background.vehicles,
            lambda: _driver(rng, junction, _DRIVERS, placed, signals, begin),
        ),
        (
            spec.background.two_wheelers,
            lambda: _driver(rng, junction, _RIDERS, placed, signals, begin),
        ),
        (spec.background.walking if sidewalks else 0, lambda: _walker(rng, sidewalks)),
        (spec.background.crossing, lambda: _crosser(rng, junction, named, signals, begin)),
    ]
    for count, make in kinds:
        users += [user for user in (make() for _ in range(count)) if user is not None]
    return users


class _Lanes:
    """The parts of each lane where nobody else can start."""

    def __init__(self, named: Sequence[RoadUser]) -> None:
        self._taken: list[tuple[Route, float, float]] = []
        """A route, and the metres along it where the part that is not free begins and ends."""
        for user in named:
            if user.route is not None:
                reach = user.body.size[0] / 2 + _START_GAP[0] + _START_GAP[1] * user.max_speed
                self._taken.append((user.route, user.start - reach, user.route.exit_s + 15.0))

    def is_free(self, route: Route, place: float) -> bool:
        """Whether one can start at `place` metres along a route."""
        return not any(
            low < place < high and _share_lane(route, other, place)
            for other, low, high in self._taken
        )

    def take(self, user: RoadUser, route: Route) -> None:
        """Mark the place around a road user's start as not free."""
        reach = user.body.size[0] / 2 + _START_GAP[0] + _START_GAP[1] * user.start_speed
        self._taken.append((route, user.start - reach - 3.0, user.start + reach + 3.0))


def _share_lane(route: Route, other: Route, place: float) -> bool:
    """Whether two routes are in the same lane at `place` metres along the first."""
    if place < route.enter_s:
        return route.from_arm == other.from_arm and route.lane == other.lane
    return route.to_arm == other.to_arm and route.lane == other.lane


def _driver(
    rng: np.random.Generator,
    junction: Junction,
    categories: Sequence[str],
    placed: _Lanes,
    signals: SignalPlan | None,
    begin: float,
) -> RoadUser | None:
    category = str(rng.choice(categories))
    body, manner = random_body(rng, category), MANNERS[category]
    max_speed = rng.uniform(*manner.max_speed)
    for _ in range(_TRIES):
        route = _random_route(rng, junction, category)
        coming = rng.random() < 0.75
        reach = route.enter_s - body.size[0] / 2 - 4.0
        place = reach - rng.uniform(0, _REACH) if coming else route.exit_s + rng.uniform(8.0, 45.0)
        if placed.is_free(route, float(place)):
            break
    else:
        return None
    speed = 0.9 * max_speed
    red = signals is not None and signals.state(route.from_arm, begin) == RED
    if coming and (red or route.from_arm in junction.spec.yielding_arms):
        room = max(route.stop_s - place - body.size[0] / 2 - 0.5, 0.0)
        speed = min(speed, float(np.sqrt(2 * _QUEUE_BRAKING * room)))
    if coming and signals is None:
        speed *= 0.7
    user = RoadUser(
        role="background",
        body=body,
        path=lane_way(junction, route, category),
        start=float(place),
        start_speed=float(speed),
        max_speed=max_speed,
        route=route,
        span=lane_span(route),
    )
    placed.take(user, route)
    return user


def _random_route(rng: np.random.Generator, junction: Junction, category: str) -> Route:
    arm = junction.arms[rng.integers(len(junction.arms))]
    turns = [turn for turn in junction.turns(arm) if category != "cyclist" or turn != "left"]
    weights = np.array([3.0 if turn == "straight" else 1.0 for turn in turns])
    turn = turns[rng.choice(len(turns), p=weights / weights.sum())]
    lane = (
        int(rng.integers(junction.spec.lanes))
        if turn == "straight" and category != "cyclist"
        else None
    )
    return junction.route(arm, turn, lane)


def _built_over(spec: ScenarioSpec, sidewalk: Path) -> bool:
    """Whether the house of a hidden view, between ego and other, stands on a sidewalk."""
    if spec.view != "hidden":
        return False
    out = np.array(
        [OUTWARD[spec.actor(role).from_arm or "west"] for role in ("ego", "other")],
        dtype=np.float64,
    )
    corner = out.sum(axis=0)
    near = np.abs(sidewalk.xy).max(axis=1) < _HOUSE_REACH
    return bool((near & (sidewalk.xy * corner > 0).all(axis=1)).any())


def _walker(rng: np.random.Generator, sidewalks: Sequence[Path]) -> RoadUser:
    """A pedestrian on a sidewalk, in either direction."""
    path = sidewalks[int(rng.integers(len(sidewalks)))]
    path = shifted_path(
        path if rng.random() < 0.5 else path.reversed(), float(-rng.uniform(*_SIDEWALK_OFFSETS))
    )
    body, manner = random_body(rng, "pedestrian"), MANNERS["pedestrian"]
    speed = rng.uniform(*manner.max_speed)
    start = float(path.length / 2 + rng.uniform(-55, 45))
    return RoadUser(
        role="pedestrian", body=body, path=path, start=start, start_speed=speed, max_speed=speed
    )


def _crosser(
    rng: np.random.Generator,
    junction: Junction,
    named: Sequence[RoadUser],
    signals: SignalPlan | None,
    begin: float,
) -> RoadUser | None:
    """A pedestrian on a crosswalk that no named road user drives over, while its arm has red."""
    used = {arm for user in named if user.route for arm in (user.route.from_arm, user.route.to_arm)}
    arms = [arm for arm in junction.arms if arm not in used]
    if not arms:
        return None
    arm = arms[rng.integers(len(arms))]
    delay = rng.uniform(0.0, 8.0)
    body, manner = random_body(rng, "pedestrian"), MANNERS["pedestrian"]
    speed = rng.uniform(*manner.max_speed)
    path = junction.crosswalk(arm)
    path = shifted_path(
        path if rng.random() < 0.5 else path.reversed(), float(-rng.uniform(*_CROSSWALK_OFFSETS))
    )
    needed = path.length / speed
    if signals is not None and any(
        signals.state(arm, begin + delay + share * needed) != RED for share in (0.0, 0.5, 1.0)
    ):
        return None
    return RoadUser(
        role="pedestrian",
        body=body,
        path=path,
        start=0.0,
        start_speed=0.0,
        max_speed=speed,
        delay=delay,
        span=(0.0, path.length),
    )


_CATEGORIES = ("car", "car", "car", "van")
# The most metres, along its slot, from the middle of the slot to a parked vehicle.
_SHIFT = 0.15
# About half the length of a parked vehicle, metres.
_HALF_LENGTH = 2.4
# Metres along the road that stay free for a pedestrian who crosses it.
_FREE_PATH = 2.2
# Least and most metres from the junction's middle to a parked vehicle whose place is not given.
_DISTANCES = (18.0, 60.0)


@dataclass(frozen=True, slots=True, eq=False)
class ParkedVehicle:
    """A vehicle at the road's edge.

    Attributes:
        body: its size and shape.
        pose: x, y (metres), yaw (radians) of its box's centre.
    """

    body: Body
    pose: tuple[float, float, float]


def parked_vehicles(
    rng: np.random.Generator, spec: ScenarioSpec, junction: Junction, walking: Sequence[RoadUser]
) -> list[ParkedVehicle]:
    """The named parked vehicles, each on the slot nearest to its place, then as many others as there is room for.

    They keep some distance from the paths of pedestrians who cross a road.
    """
    places = junction.parking_places()
    free = [
        row
        for row, place in enumerate(places)
        if not any(_in_the_way(place, user) for user in walking)
    ]
    vehicles = []
    for actor in spec.actors:
        if actor.role == "parked" and free:
            row = _nearest(rng, actor, places[free])
            vehicles.append(_parked(rng, actor.category, places[free.pop(row)]))
    count = min(spec.background.parked, len(free))
    others = sorted(rng.permutation(len(free))[:count].tolist())
    return vehicles + [
        _parked(rng, str(rng.choice(_CATEGORIES)), places[free[row]]) for row in others
    ]


def _in_the_way(place: FloatArray, user: RoadUser) -> bool:
    """Whether a vehicle on a slot would stand where someone steps onto the road."""
    along, left = user.path.project(place[:2])
    return bool(
        -_HALF_LENGTH < along[0] < user.path.length + _HALF_LENGTH
        and abs(left[0]) < _HALF_LENGTH + _FREE_PATH / 2
    )


def _nearest(rng: np.random.Generator, actor: ActorSpec, places: FloatArray) -> int:
    """The row of the slot (N, 3) that is nearest to the place that a file gives for a vehicle."""
    out = np.array(OUTWARD[actor.from_arm or "west"], dtype=np.float64)
    distance = (
        actor.start_distance if actor.start_distance is not None else rng.uniform(*_DISTANCES)
    )
    left = np.array([-out[1], out[0]])
    side = 1.0 if actor.side == "right" else -1.0
    along, beside = places[:, :2] @ out, side * (places[:, :2] @ left)
    on_side = (along > 0) & (beside > 0) & (beside < along.max() / 2)
    return int((np.abs(along - distance) + 1000.0 * ~on_side).argmin())


def _parked(rng: np.random.Generator, category: str, place: FloatArray) -> ParkedVehicle:
    x, y, yaw = place.tolist()
    shift = rng.uniform(-_SHIFT, _SHIFT)
    return ParkedVehicle(
        random_body(rng, category), (x + shift * np.cos(yaw), y + shift * np.sin(yaw), yaw)
    )
