"""What stands still: the ground with its roads, buildings, trees, lights and the infrastructure's pole."""

from dataclasses import dataclass

import numpy as np

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.support.arrays import ShortRepr
from deepaccident_devkit.synth.roads import Arm, GroundMap, Junction, Terrain
from deepaccident_devkit.synth.roads.layout import OUTWARD
from deepaccident_devkit.synth.solids import Solids
from deepaccident_devkit.synth.spec import View
from deepaccident_devkit.synth.stage.props import (
    Prop,
    SignalHead,
    houses,
    kerb_house,
    lanterns,
    mast,
    overlap,
    settled,
    signal_head,
    solids_of,
    top_map,
    traffic_light,
    trees,
    yield_sign,
)

Corner = tuple[int, int]
"""A corner, given by its signs of x and y."""

_MAX_SLOPE = np.deg2rad(3.0)
_POLE_HEIGHTS = (4.1, 4.6)
"""The least and the greatest height of the infrastructure's sensors above the ground, metres: its cameras, some of
them above the road, are higher than any truck."""
_POLE_INSET = 0.15
"""Metres from the sidewalk's outer edges to the middle of the pole: the farthest place from which it sees along the
lanes."""
_POLE_UNDER_SENSOR = 0.4


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class World(ShortRepr):
    """Everything that does not change during a scenario, in the ground frame.

    Attributes:
        world_from_ground: where the junction lies in the town, and how it slopes.
        ground: the map of the roads, as cameras and LiDAR see them.
        top: the map of the ground with all that stands on it, as the BEV camera sees it.
        props: buildings, trees, poles; the first solids are the lamps of `signals`.
        terrain: how high the ground lies.
        lidar_pole: `ground_from_lidar` of the infrastructure agent.
        signals: the traffic lights, one for each arm; none at an unsignalised junction.
    """

    world_from_ground: SE3
    ground: GroundMap
    top: GroundMap
    props: Solids
    terrain: Terrain
    lidar_pole: SE3
    signals: tuple[SignalHead, ...]


def random_world(
    rng: np.random.Generator,
    junction: Junction,
    view: View = "open",
    *,
    between: tuple[Arm, Arm] = ("west", "north"),
) -> World:
    """A town around a junction.

    Args:
        rng: random numbers; except for the house and the pole, both views give the same world.
        junction: its roads.
        view: `hidden` puts a house on the kerb of a corner, and the pole on the opposite corner, where it sees both
            arms.
        between: the two arms that the pole sees best; in a hidden view, the two arms beside the house.

    Raises:
        ConfigError: `view` is hidden, and the arms have no corner in common.
    """
    place, built, green, pole = rng.spawn(4)
    spec, terrain = junction.spec, junction.terrain
    buildings, plants = houses(built, spec), list(trees(green, spec))
    lights = [traffic_light(spec, arm) for arm in junction.arms] if spec.signalized else []
    corner = _pole_corner(pole, junction, between)
    if view == "hidden":
        hiding_corner = _corner_between(junction, between)
        hiding = kerb_house(spec, hiding_corner)
        buildings = [hiding, *(each for each in buildings if not overlap(each, hiding))]
        plants = [each for each in plants if not overlap(each, hiding)]
        corner = (-hiding_corner[0], -hiding_corner[1])
    height = float(pole.uniform(*_POLE_HEIGHTS))
    x, y = (sign * (spec.sidewalk_edge - _POLE_INSET) for sign in corner)
    signs = [yield_sign(spec, arm) for arm in spec.yielding_arms]
    stands: list[Prop] = [*lights, *signs, mast(x, y, height - _POLE_UNDER_SENSOR), *buildings, *plants]
    stands += [each for each in lanterns(spec) if not any(overlap(each, other) for other in stands)]
    props = [settled(each, terrain) for each in stands]
    ground = junction.ground_map()
    return World(
        world_from_ground=_random_place(place, terrain),
        ground=ground,
        top=top_map(ground, props),
        props=solids_of(props),
        terrain=terrain,
        lidar_pole=SE3.from_yaw(float(np.arctan2(-y, -x)), (x, y, height)),
        signals=tuple(_signals(junction, props[: len(lights)])),
    )


def _signals(junction: Junction, lights: list[Prop]) -> list[SignalHead]:
    heads, row = [], 0
    for arm, light in zip(junction.arms, lights, strict=False):
        heads.append(signal_head(arm, light, row))
        row += len(light.blocks)
    return heads


def _pole_corner(rng: np.random.Generator, junction: Junction, between: tuple[Arm, Arm]) -> Corner:
    """One of the corners nearest to two arms; a three-way junction has corners only in the south."""
    north = (1, -1) if "north" in junction.arms else (-1,)
    toward = np.sum([OUTWARD[arm] for arm in between], axis=0)
    nearness = {(x, y): int(toward @ (x, y)) for x in (1, -1) for y in north}
    nearest = [corner for corner, near in nearness.items() if near == max(nearness.values())]
    return nearest[int(rng.random() * len(nearest))]


def _corner_between(junction: Junction, arms: tuple[Arm, Arm]) -> Corner:
    (x_a, y_a), (x_b, y_b) = (OUTWARD[arm] for arm in arms)
    corner = (x_a + x_b, y_a + y_b)
    if 0 in corner or not set(arms) <= set(junction.arms):
        raise ConfigError(
            f"between: the arms {arms[0]} and {arms[1]} of a {junction.spec.kind} junction have no corner in common; "
            f"choose two neighbours of {', '.join(junction.arms)}"
        )
    return corner


def _random_place(rng: np.random.Generator, terrain: Terrain) -> SE3:
    """Some hundred metres from the town's origin, in any direction; on a gentle slope if the ground has no hump."""
    slope, uphill, yaw = rng.uniform(0, _MAX_SLOPE), rng.uniform(-np.pi, np.pi), rng.uniform(-np.pi, np.pi)
    if not terrain.is_flat:
        slope = 0.0
    across = SE3.from_quaternion((np.cos(slope / 2), 0.0, np.sin(slope / 2), 0.0))
    direction = SE3.from_yaw(uphill)
    tilt = direction @ across @ direction.inverse()
    x, y, z = rng.uniform((-400, -400, -2), (400, 400, 8))
    return SE3.from_rotation(np.eye(3), (x, y, z)) @ tilt @ SE3.from_yaw(yaw)
