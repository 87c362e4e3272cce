"""Road users that a file does not name, and all parked vehicles."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from deepaccident_devkit.plugins.synth.actors import Body, random_body
from deepaccident_devkit.plugins.synth.roads import Arm, Junction, Path, Route
from deepaccident_devkit.plugins.synth.roads.layout import OUTWARD
from deepaccident_devkit.plugins.synth.spec import ActorSpec, ScenarioSpec
from deepaccident_devkit.plugins.synth.traffic.driving import (
    DRIVING_STYLES,
    RoadUser,
    lane_path,
    lane_span,
    shifted_path,
)
from deepaccident_devkit.plugins.synth.traffic.rights import RED, SignalPlan
from deepaccident_devkit.support.arrays import FloatArray

_DRIVER_CATEGORIES = ("car", "car", "car", "car", "van", "truck")
_RIDER_CATEGORIES = ("motorcycle", "cyclist")
_PARKED_CATEGORIES = ("car", "car", "car", "van")
# Background traffic starts within this distance from the junction's middle.
_MAX_START_DISTANCE_M = 75.0
_MAX_TRIES = 8
# Gap between two that start in one lane: a constant, and one for each m/s.
_START_GAP_M = 3.0
_START_GAP_S = 1.2
# Braking of road users that start before a red light or a yield line, m/s².
_QUEUE_BRAKING = 1.5
# A house that hides the view stands within this distance from the junction's middle.
_HOUSE_DISTANCE_M = 32.0
# Smallest and largest distance from a sidewalk's middle to the right, so that people pass each
# other on the left, metres.
_SIDEWALK_OFFSETS = (0.2, 0.4)
_CROSSWALK_OFFSETS = (0.3, 0.9)
# Largest distance, along its slot, from the middle of the slot to a parked vehicle.
_MAX_SLOT_SHIFT_M = 0.15
# About half the length of a parked vehicle.
_HALF_VEHICLE_LENGTH_M = 2.4
# Width along the road that stays free for a pedestrian who crosses it.
_CROSSING_WIDTH_M = 2.2
# Smallest and largest distance from the junction's middle to a parked vehicle, if the file does not
# give it, metres.
_PARKING_DISTANCES = (18.0, 60.0)


def background_users(
    rng: np.random.Generator,
    spec: ScenarioSpec,
    junction: Junction,
    named: Sequence[RoadUser],
    signals: SignalPlan | None,
    begin: float,
) -> list[RoadUser]:
    """Draw the moving background as the simulation begins; one that finds no room is left out.

    The lanes in front of the named road users stay free up to the junction.

    Args:
        rng: Generator of random numbers.
        spec: The scenario.
        junction: Its junction.
        named: Named road users.
        signals: Traffic lights; None if there are none.
        begin: Time at which the simulation begins, seconds.
    """
    lanes = _OccupiedLanes(named)
    sidewalks = [path for path in junction.sidewalk_paths() if not _built_over(spec, path)]
    background = spec.background

    def draw_driver() -> RoadUser | None:
        return _driver(rng, junction, _DRIVER_CATEGORIES, lanes, signals, begin)

    def draw_rider() -> RoadUser | None:
        return _driver(rng, junction, _RIDER_CATEGORIES, lanes, signals, begin)

    def draw_walker() -> RoadUser | None:
        return _walker(rng, sidewalks)

    def draw_crosser() -> RoadUser | None:
        return _crosser(rng, junction, named, signals, begin)

    draws: list[tuple[int, Callable[[], RoadUser | None]]] = [
        (background.vehicles, draw_driver),
        (background.two_wheelers, draw_rider),
        (background.walking if sidewalks else 0, draw_walker),
        (background.crossing, draw_crosser),
    ]
    users: list[RoadUser] = []
    for count, draw in draws:
        for _ in range(count):
            user = draw()
            if user is not None:
                users.append(user)
    return users


class _OccupiedLanes:
    """The parts of each lane where nobody else can start."""

    def __init__(self, named: Sequence[RoadUser]) -> None:
        self._spans: list[tuple[Route, float, float]] = []
        """A route, and start and end of the occupied part, metres along the route."""
        for user in named:
            if user.route is not None:
                reach = _start_reach(user, user.max_speed)
                self._spans.append((user.route, user.start - reach, user.route.exit_s + 15.0))

    def is_free(self, route: Route, position: float) -> bool:
        """Return whether a road user can start at `position`, metres along a route."""
        for other, begin, end in self._spans:
            if begin < position < end and _share_lane(route, other, position):
                return False
        return True

    def occupy(self, user: RoadUser, route: Route) -> None:
        """Mark the surroundings of a road user's start as occupied."""
        reach = _start_reach(user, user.start_speed)
        self._spans.append((route, user.start - reach - 3.0, user.start + reach + 3.0))


def _start_reach(user: RoadUser, speed: float) -> float:
    """Return the distance from a road user's centre within which nobody else can start, metres."""
    return user.body.size[0] / 2 + _START_GAP_M + _START_GAP_S * speed


def _share_lane(route: Route, other: Route, position: float) -> bool:
    """Return whether two routes are in the same lane at `position`, metres along the first."""
    if position < route.enter_s:
        return route.from_arm == other.from_arm and route.lane == other.lane
    return route.to_arm == other.to_arm and route.lane == other.lane


def _driver(
    rng: np.random.Generator,
    junction: Junction,
    categories: Sequence[str],
    lanes: _OccupiedLanes,
    signals: SignalPlan | None,
    begin: float,
) -> RoadUser | None:
    """Draw a driver or rider; None if there is no room for it."""
    category = str(rng.choice(categories))
    body = random_body(rng, category)
    max_speed = rng.uniform(*DRIVING_STYLES[category].max_speed)
    half_length = body.size[0] / 2
    for _ in range(_MAX_TRIES):
        route = _random_route(rng, junction, category)
        approaching = rng.random() < 0.75
        if approaching:
            last_start = route.enter_s - half_length - 4.0
            start = last_start - rng.uniform(0, _MAX_START_DISTANCE_M)
        else:
            start = route.exit_s + rng.uniform(8.0, 45.0)
        if lanes.is_free(route, float(start)):
            break
    else:
        return None
    speed = 0.9 * max_speed
    red = signals is not None and signals.state(route.from_arm, begin) == RED
    if approaching and (red or route.from_arm in junction.spec.yielding_arms):
        stopping_distance = max(route.stop_s - start - half_length - 0.5, 0.0)
        speed = min(speed, float(np.sqrt(2 * _QUEUE_BRAKING * stopping_distance)))
    if approaching and signals is None:
        speed *= 0.7
    user = RoadUser(
        role="background",
        body=body,
        path=lane_path(junction, route, category),
        start=float(start),
        start_speed=float(speed),
        max_speed=max_speed,
        route=route,
        span=lane_span(route),
    )
    lanes.occupy(user, route)
    return user


def _random_route(rng: np.random.Generator, junction: Junction, category: str) -> Route:
    """Draw a route over the junction; cyclists do not turn left."""
    arm = junction.arms[rng.integers(len(junction.arms))]
    turns = [turn for turn in junction.turns(arm) if category != "cyclist" or turn != "left"]
    weights = np.array([3.0 if turn == "straight" else 1.0 for turn in turns])
    turn = turns[rng.choice(len(turns), p=weights / weights.sum())]
    lane = None
    if turn == "straight" and category != "cyclist":
        lane = int(rng.integers(junction.spec.lanes))
    return junction.route(arm, turn, lane)


def _built_over(spec: ScenarioSpec, sidewalk: Path) -> bool:
    """Return whether the house of a hidden view, between ego and other, stands on a sidewalk."""
    if spec.view != "hidden":
        return False
    arms = [spec.actor(role).from_arm or "west" for role in ("ego", "other")]
    corner = np.array([OUTWARD[arm] for arm in arms], dtype=np.float64).sum(axis=0)
    near = np.abs(sidewalk.xy).max(axis=1) < _HOUSE_DISTANCE_M
    in_corner = (sidewalk.xy * corner > 0).all(axis=1)
    return bool((near & in_corner).any())


def _walker(rng: np.random.Generator, sidewalks: Sequence[Path]) -> RoadUser:
    """Draw a pedestrian on a sidewalk, in either direction."""
    path = _random_direction(rng, sidewalks[int(rng.integers(len(sidewalks)))], _SIDEWALK_OFFSETS)
    body = random_body(rng, "pedestrian")
    speed = rng.uniform(*DRIVING_STYLES["pedestrian"].max_speed)
    start = float(path.length / 2 + rng.uniform(-55, 45))
    return RoadUser(
        role="pedestrian", body=body, path=path, start=start, start_speed=speed, max_speed=speed
    )


def _random_direction(rng: np.random.Generator, path: Path, offsets: tuple[float, float]) -> Path:
    """Draw one of the directions of a path, and an offset to the right of it, metres."""
    if rng.random() >= 0.5:
        path = path.reversed()
    return shifted_path(path, float(-rng.uniform(*offsets)))


def _crosser(
    rng: np.random.Generator,
    junction: Junction,
    named: Sequence[RoadUser],
    signals: SignalPlan | None,
    begin: float,
) -> RoadUser | None:
    """Draw a pedestrian on a crosswalk that no named road user drives over.

    Returns:
        None if there is no such crosswalk, or its arm has no red while the pedestrian crosses.
    """
    used_arms: set[Arm] = set()
    for user in named:
        if user.route:
            used_arms.update((user.route.from_arm, user.route.to_arm))
    arms = [arm for arm in junction.arms if arm not in used_arms]
    if not arms:
        return None
    arm = arms[rng.integers(len(arms))]
    delay = rng.uniform(0.0, 8.0)
    body = random_body(rng, "pedestrian")
    speed = rng.uniform(*DRIVING_STYLES["pedestrian"].max_speed)
    path = _random_direction(rng, junction.crosswalk(arm), _CROSSWALK_OFFSETS)
    duration = path.length / speed
    if signals is not None:
        for share in (0.0, 0.5, 1.0):
            if signals.state(arm, begin + delay + share * duration) != RED:
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


@dataclass(frozen=True, slots=True, eq=False)
class ParkedVehicle:
    """A vehicle at the road's edge.

    Attributes:
        body: Size and shape.
        pose: x, y (metres), yaw (radians) of its box's centre.
    """

    body: Body
    pose: tuple[float, float, float]


def parked_vehicles(
    rng: np.random.Generator, spec: ScenarioSpec, junction: Junction, walking: Sequence[RoadUser]
) -> list[ParkedVehicle]:
    """Draw the parked vehicles: the named ones, each on the slot nearest to its place, then others.

    There are as many others as find room. All keep some distance from the paths of pedestrians who
    cross a road.

    Args:
        rng: Generator of random numbers.
        spec: The scenario.
        junction: Its junction.
        walking: Named pedestrians.
    """
    slots = junction.parking_places()
    free_rows = [
        row
        for row, slot in enumerate(slots)
        if not any(_in_the_way(slot, user) for user in walking)
    ]
    vehicles = []
    for actor in spec.actors:
        if actor.role == "parked" and free_rows:
            nearest = _nearest_slot(rng, actor, slots[free_rows])
            vehicles.append(_parked(rng, actor.category, slots[free_rows.pop(nearest)]))
    count = min(spec.background.parked, len(free_rows))
    chosen_rows = sorted(rng.permutation(len(free_rows))[:count].tolist())
    for row in chosen_rows:
        category = str(rng.choice(_PARKED_CATEGORIES))
        vehicles.append(_parked(rng, category, slots[free_rows[row]]))
    return vehicles


def _in_the_way(slot: FloatArray, user: RoadUser) -> bool:
    """Return whether a vehicle on a slot would stand where a pedestrian steps onto the road."""
    along, lateral = user.path.project(slot[:2])
    beside_path = -_HALF_VEHICLE_LENGTH_M < along[0] < user.path.length + _HALF_VEHICLE_LENGTH_M
    return bool(beside_path and abs(lateral[0]) < _HALF_VEHICLE_LENGTH_M + _CROSSING_WIDTH_M / 2)


def _nearest_slot(rng: np.random.Generator, actor: ActorSpec, slots: FloatArray) -> int:
    """Return the row of the slot (N, 3) nearest to the place that a file gives for a vehicle."""
    out = np.array(OUTWARD[actor.from_arm or "west"], dtype=np.float64)
    distance = actor.start_distance
    if distance is None:
        distance = rng.uniform(*_PARKING_DISTANCES)
    lateral_axis = np.array([-out[1], out[0]])
    side = 1.0 if actor.side == "right" else -1.0
    along = slots[:, :2] @ out
    beside = side * (slots[:, :2] @ lateral_axis)
    on_side = (along > 0) & (beside > 0) & (beside < along.max() / 2)
    return int((np.abs(along - distance) + 1000.0 * ~on_side).argmin())


def _parked(rng: np.random.Generator, category: str, slot: FloatArray) -> ParkedVehicle:
    """Draw a parked vehicle of a category on a slot (3,)."""
    x, y, yaw = slot.tolist()
    shift = rng.uniform(-_MAX_SLOT_SHIFT_M, _MAX_SLOT_SHIFT_M)
    pose = (x + shift * np.cos(yaw), y + shift * np.sin(yaw), yaw)
    return ParkedVehicle(random_body(rng, category), pose)
