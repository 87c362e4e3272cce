"""Vehicles that stand at the road's edge."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from deepaccident_devkit.arrays import FloatArray
from deepaccident_devkit.synth.bodies import Body, random_body
from deepaccident_devkit.synth.roads import Junction
from deepaccident_devkit.synth.roads.terrain import OUTWARD
from deepaccident_devkit.synth.spec import ActorSpec, ScenarioSpec
from deepaccident_devkit.synth.traffic.users import RoadUser

_CATEGORIES = ("car", "car", "car", "van")
_SHIFT = 0.15
"""Metres by which one stands off the middle of its slot, along it."""
_HALF_LENGTH = 2.4
"""Metres, about half the length of one that parks."""
_FREE_PATH = 2.2
"""Metres along the road that are left free for someone who walks over it."""
_DISTANCES = (18.0, 60.0)
"""Metres from the junction's middle where one stands whose place is not given."""


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
    """Those that the file names, each on the slot nearest to its place, then as many of the others as find room.

    Args:
        rng: random numbers.
        spec: what the file says.
        junction: its roads.
        walking: those who walk over a road, between whose ways and a parked vehicle there is some room.
    """
    places = junction.parking_places()
    free = [row for row, place in enumerate(places) if not any(_in_the_way(place, user) for user in walking)]
    vehicles = []
    for actor in spec.actors:
        if actor.role == "parked" and free:
            row = _nearest(rng, actor, places[free])
            vehicles.append(_parked(rng, actor.category, places[free.pop(row)]))
    count = min(spec.background.parked, len(free))
    others = sorted(rng.permutation(len(free))[:count].tolist())
    return vehicles + [_parked(rng, str(rng.choice(_CATEGORIES)), places[free[row]]) for row in others]


def _in_the_way(place: FloatArray, user: RoadUser) -> bool:
    """Whether a vehicle on a slot would stand where someone steps onto the road."""
    along, left = user.path.project(place[:2])
    return bool(
        -_HALF_LENGTH < along[0] < user.path.length + _HALF_LENGTH and abs(left[0]) < _HALF_LENGTH + _FREE_PATH / 2
    )


def _nearest(rng: np.random.Generator, actor: ActorSpec, places: FloatArray) -> int:
    """The row of the slot (N, 3) nearest to where a file wants a vehicle."""
    out = np.array(OUTWARD[actor.from_arm or "west"], dtype=np.float64)
    distance = actor.start_distance if actor.start_distance is not None else float(rng.uniform(*_DISTANCES))
    left = np.array([-out[1], out[0]])
    side = 1.0 if actor.side == "right" else -1.0
    along, beside = places[:, :2] @ out, side * (places[:, :2] @ left)
    on_side = (along > 0) & (beside > 0) & (beside < along.max() / 2)
    return int((np.abs(along - distance) + 1000.0 * ~on_side).argmin())


def _parked(rng: np.random.Generator, category: str, place: FloatArray) -> ParkedVehicle:
    x, y, yaw = place.tolist()
    shift = float(rng.uniform(-_SHIFT, _SHIFT))
    return ParkedVehicle(random_body(rng, category), (x + shift * np.cos(yaw), y + shift * np.sin(yaw), yaw))
