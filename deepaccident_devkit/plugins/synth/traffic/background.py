"""Road users that a file does not name, and all parked vehicles."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from deepaccident_devkit.plugins.synth.actors import Body, random_body
from deepaccident_devkit.plugins.synth.roads import Arm, Junction, Path, Route
from deepaccident_devkit.plugins.synth.roads.layout import OUTWARD
from deepaccident_devkit.plugins.synth.roads.paths import shift_path
from deepaccident_devkit.plugins.synth.spec import ActorSpec, ScenarioSpec
from deepaccident_devkit.plugins.synth.traffic.driving import (
    DRIVING_STYLES,
    RoadUser,
    lane_path,
    lane_span,
)
from deepaccident_devkit.plugins.synth.traffic.rights import RED, SignalPlan
from deepaccident_devkit.support.arrays import FloatArray

_DRIVER_CATEGORIES = ("car", "car", "car", "car", "van", "truck")
_RIDER_CATEGORIES = ("motorcycle", "cyclist")
_PARKED_CATEGORIES = ("car", "car", "car", "van")
# Largest distance from the junction at which a vehicle of the background starts.
_MAX_START_DISTANCE_M = 75.0
_MAX_TRIES = 8
# Gap between two road users that start in one lane: a constant part, and a part for each m/s.
_START_GAP_M = 3.0
_START_GAP_S = 1.2
# Braking of road users that start before a red light or a yield line, m/s².
_QUEUE_BRAKING = 1.5
# Largest distance from the junction's middle to a house that hides the view.
_HOUSE_DISTANCE_M = 32.0
# Smallest and largest distance from a sidewalk's middle to the right, so that people pass each
# other on the left, metres.
_SIDEWALK_OFFSETS = (0.2, 0.4)
_CROSSWALK_OFFSETS = (0.3, 0.9)
# Largest distance, along its slot, from the middle of the slot to a parked vehicle.
_MAX_SLOT_SHIFT_M = 0.15
# About half the length of a parked vehicle.
_HALF_VEHICLE_LENGTH_M = 2.4
# Width of the road's edge that stays free for a pedestrian who crosses the road.
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
    """Draw the moving background road users at the start of the simulation.

    A road user that finds no room is left out. The lanes in front of the named road users stay free
    up to the junction.

    Args:
        rng: Generator of random numbers.
        spec: The scenario.
        junction: Junction of the scenario.
        named: Named road users.
        signals: Traffic lights; None if there are none.
        begin: Start time of the simulation, seconds.
    """
    lanes = _OccupiedLanes(named)
    sidewalks = [path for path in junction.sidewalk_paths() if not _is_built_over(spec, path)]
    background = spec.background

    def draw_driver() -> RoadUser | None:
        return _draw_driver(rng, junction, _DRIVER_CATEGORIES, lanes, signals, begin)

    def draw_rider() -> RoadUser | None:
        return _draw_driver(rng, junction, _RIDER_CATEGORIES, lanes, signals, begin)

    def draw_walker() -> RoadUser | None:
        return _draw_walker(rng, sidewalks)

    def draw_crosser() -> RoadUser | None:
        return _draw_crosser(rng, junction, named, signals, begin)

    draws: list[tuple[int, Callable[[], RoadUser | None]]] = [
        (background.vehicles, draw_driver),
        (background.two_wheelers, draw_rider),
        (background.walking if sidewalks else 0, draw_walker),
        (background.crossing, draw_crosser),
    ]
    users = []
    for count, draw in draws:
        for _ in range(count):
            user = draw()
            if user is not None:
                users.append(user)
    return users


class _OccupiedLanes:
    """The parts of each lane where no further road user can start."""

    def __init__(self, named: Sequence[RoadUser]) -> None:
        self._spans: list[tuple[Route, float, float]] = []
        """Routes, with start and end of the occupied part, metres along the route."""
        for user in named:
            if user.route is not None:
                reach = _compute_start_reach(user, user.max_speed)
                self._spans.append((user.route, user.start - reach, user.route.exit_s + 15.0))

    def is_free(self, route: Route, position: float) -> bool:
        """Return whether a road user can start at a position along a route, metres."""
        for other_route, begin, end in self._spans:
            if begin < position < end and _share_lane(route, other_route, position):
                return False
        return True

    def occupy(self, user: RoadUser, route: Route) -> None:
        """Mark the surroundings of a road user's start as occupied."""
        reach = _compute_start_reach(user, user.start_speed)
        begin = user.start - reach - 3.0
        end = user.start + reach + 3.0
        self._spans.append((route, begin, end))


def _compute_start_reach(user: RoadUser, speed: float) -> float:
    """Return the distance from a road user within which no other can start, metres."""
    gap = _START_GAP_S * speed
    half_length = user.body.size[0] / 2
    return half_length + _START_GAP_M + gap


def _share_lane(route: Route, other: Route, position: float) -> bool:
    """Return whether two routes are in the same lane at a position along the first one, metres."""
    if route.lane != other.lane:
        return False
    if position < route.enter_s:
        return route.from_arm == other.from_arm
    return route.to_arm == other.to_arm


def _draw_driver(
    rng: np.random.Generator,
    junction: Junction,
    categories: Sequence[str],
    lanes: _OccupiedLanes,
    signals: SignalPlan | None,
    begin: float,
) -> RoadUser | None:
    """Draw a driver or rider of the background.

    Args:
        rng: Generator of random numbers.
        junction: The junction.
        categories: Categories to choose from.
        lanes: Occupied parts of the lanes; the start of the road user is added.
        signals: Traffic lights; None if there are none.
        begin: Start time of the simulation, seconds.

    Returns:
        None if there is no room for it.
    """
    category = str(rng.choice(categories))
    body = random_body(rng, category)
    max_speed = rng.uniform(*DRIVING_STYLES[category].max_speed)
    half_length = body.size[0] / 2
    for _ in range(_MAX_TRIES):
        route = _draw_route(rng, junction, category)
        approaches = rng.random() < 0.75
        if approaches:
            last_start = route.enter_s - half_length - 4.0
            start = last_start - rng.uniform(0, _MAX_START_DISTANCE_M)
        else:
            start = route.exit_s + rng.uniform(8.0, 45.0)
        if lanes.is_free(route, start):
            break
    else:
        return None
    speed = 0.9 * max_speed
    faces_red = signals is not None and signals.state(route.from_arm, begin) == RED
    has_to_yield = route.from_arm in junction.spec.yielding_arms
    if approaches and (faces_red or has_to_yield):
        stopping_distance = max(route.stop_s - start - half_length - 0.5, 0.0)
        queue_speed = float(np.sqrt(2 * _QUEUE_BRAKING * stopping_distance))
        speed = min(speed, queue_speed)
    if approaches and signals is None:
        speed *= 0.7
    user = RoadUser(
        role="background",
        body=body,
        path=lane_path(junction, route, category),
        start=start,
        start_speed=speed,
        max_speed=max_speed,
        route=route,
        span=lane_span(route),
    )
    lanes.occupy(user, route)
    return user


def _draw_route(rng: np.random.Generator, junction: Junction, category: str) -> Route:
    """Draw a route over the junction; cyclists do not turn left."""
    arm = junction.arms[rng.integers(len(junction.arms))]
    cycles = category == "cyclist"
    turns = [turn for turn in junction.turns(arm) if not (cycles and turn == "left")]
    weights = np.array([3.0 if turn == "straight" else 1.0 for turn in turns])
    probabilities = weights / weights.sum()
    turn = turns[rng.choice(len(turns), p=probabilities)]
    lane = None
    if turn == "straight" and not cycles:
        lane = int(rng.integers(junction.spec.lanes))
    return junction.route(arm, turn, lane)


def _is_built_over(spec: ScenarioSpec, sidewalk: Path) -> bool:
    """Return whether the house of a hidden view, between ego and other, stands on a sidewalk."""
    if spec.view != "hidden":
        return False
    arms = [spec.actor(role).from_arm or "west" for role in ("ego", "other")]
    directions = np.array([OUTWARD[arm] for arm in arms], dtype=np.float64)
    corner = directions.sum(axis=0)
    is_near_middle = np.abs(sidewalk.xy).max(axis=1) < _HOUSE_DISTANCE_M
    is_in_corner = (sidewalk.xy * corner > 0).all(axis=1)
    return bool((is_near_middle & is_in_corner).any())


def _draw_walker(rng: np.random.Generator, sidewalks: Sequence[Path]) -> RoadUser:
    """Draw a pedestrian on a sidewalk, in either direction."""
    sidewalk = sidewalks[int(rng.integers(len(sidewalks)))]
    path = _draw_direction(rng, sidewalk, _SIDEWALK_OFFSETS)
    body = random_body(rng, "pedestrian")
    speed = rng.uniform(*DRIVING_STYLES["pedestrian"].max_speed)
    start = path.length / 2 + rng.uniform(-55, 45)
    return RoadUser(
        role="pedestrian", body=body, path=path, start=start, start_speed=speed, max_speed=speed
    )


def _draw_direction(rng: np.random.Generator, path: Path, offsets: tuple[float, float]) -> Path:
    """Draw one of the two directions of a path, and an offset to the right of the path, metres."""
    if rng.random() >= 0.5:
        path = path.reversed()
    offset = rng.uniform(*offsets)
    return shift_path(path, -offset)


def _draw_crosser(
    rng: np.random.Generator,
    junction: Junction,
    named: Sequence[RoadUser],
    signals: SignalPlan | None,
    begin: float,
) -> RoadUser | None:
    """Draw a pedestrian on a crosswalk that no named road user drives over.

    Args:
        rng: Generator of random numbers.
        junction: The junction.
        named: Named road users.
        signals: Traffic lights; None if there are none.
        begin: Start time of the simulation, seconds.

    Returns:
        None if there is no such crosswalk, or its arm has no red while the pedestrian crosses.
    """
    used_arms: set[Arm] = set()
    for user in named:
        if user.route:
            used_arms.update((user.route.from_arm, user.route.to_arm))
    free_arms = [arm for arm in junction.arms if arm not in used_arms]
    if not free_arms:
        return None
    arm = free_arms[rng.integers(len(free_arms))]
    delay = rng.uniform(0.0, 8.0)
    body = random_body(rng, "pedestrian")
    speed = rng.uniform(*DRIVING_STYLES["pedestrian"].max_speed)
    path = _draw_direction(rng, junction.crosswalk(arm), _CROSSWALK_OFFSETS)
    duration = path.length / speed
    if signals is not None:
        for share in (0.0, 0.5, 1.0):
            time = begin + delay + share * duration
            if signals.state(arm, time) != RED:
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

    There are fewer others if they find no room. All keep some distance from the paths of
    pedestrians who cross a road.

    Args:
        rng: Generator of random numbers.
        spec: The scenario.
        junction: Junction of the scenario.
        walking: Named pedestrians.
    """
    free_slots = []
    for slot in junction.parking_places():
        if not any(_blocks_walker(slot, user) for user in walking):
            free_slots.append(slot)
    vehicles = []
    for actor in spec.actors:
        if actor.role == "parked" and free_slots:
            nearest_slot = _find_slot(rng, actor, np.array(free_slots))
            vehicles.append(_draw_parked(rng, actor.category, free_slots.pop(nearest_slot)))
    count = min(spec.background.parked, len(free_slots))
    chosen_rows = rng.permutation(len(free_slots))[:count]
    for row in sorted(chosen_rows.tolist()):
        category = str(rng.choice(_PARKED_CATEGORIES))
        vehicles.append(_draw_parked(rng, category, free_slots[row]))
    return vehicles


def _blocks_walker(slot: FloatArray, user: RoadUser) -> bool:
    """Return whether a vehicle on a slot would stand where a pedestrian steps onto the road."""
    (along,), (lateral,) = user.path.project(slot[:2])
    if not -_HALF_VEHICLE_LENGTH_M < along < user.path.length + _HALF_VEHICLE_LENGTH_M:
        return False
    min_distance = _HALF_VEHICLE_LENGTH_M + _CROSSING_WIDTH_M / 2
    return bool(abs(lateral) < min_distance)


def _find_slot(rng: np.random.Generator, actor: ActorSpec, slots: FloatArray) -> int:
    """Return the row of the slot nearest to the place that a file gives for a vehicle.

    Args:
        rng: Generator of random numbers, for a vehicle without a distance.
        actor: The vehicle.
        slots: Poses of the slots, shape (N, 3), as from `Junction.parking_places`.
    """
    outward = np.array(OUTWARD[actor.from_arm or "west"], dtype=np.float64)
    distance = actor.start_distance
    if distance is None:
        distance = rng.uniform(*_PARKING_DISTANCES)
    leftward = np.array([-outward[1], outward[0]])
    sign = 1.0 if actor.side == "right" else -1.0
    along = slots[:, :2] @ outward
    to_side = sign * (slots[:, :2] @ leftward)
    is_on_side = (along > 0) & (to_side > 0) & (to_side < along.max() / 2)
    penalty = 1000.0 * ~is_on_side
    return int((np.abs(along - distance) + penalty).argmin())


def _draw_parked(rng: np.random.Generator, category: str, slot: FloatArray) -> ParkedVehicle:
    """Draw a parked vehicle of a category on a slot (3,)."""
    x, y, yaw = slot.tolist()
    shift = rng.uniform(-_MAX_SLOT_SHIFT_M, _MAX_SLOT_SHIFT_M)
    shifted_x = x + shift * np.cos(yaw)
    shifted_y = y + shift * np.sin(yaw)
    return ParkedVehicle(random_body(rng, category), (shifted_x, shifted_y, yaw))
