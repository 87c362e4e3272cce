"""What stands still: the ground and its roads; on it street furniture, trees, houses and the infrastructure's pole."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate

import numpy as np

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.plugins.synth.roads import (
    FIRST_BUILDING,
    POLE,
    TREE,
    Arm,
    GroundMap,
    Junction,
    RoadSpec,
    Terrain,
)
from deepaccident_devkit.plugins.synth.roads.layout import KERB_RADIUS, OUTWARD
from deepaccident_devkit.plugins.synth.solids import Block, Color, Solids, build
from deepaccident_devkit.plugins.synth.spec import View
from deepaccident_devkit.support.arrays import FloatArray, ShortRepr

# Metres that things reach into the ground.
BASEMENT = 0.2
# The colours of lamps that are on: red, amber, green.
LAMP_COLORS: tuple[Color, Color, Color] = ((230, 46, 38), (240, 186, 50), (52, 210, 96))
_DARK_LAMPS: tuple[Color, Color, Color] = ((72, 22, 20), (76, 58, 20), (18, 62, 32))
_STEEL: Color = (92, 96, 100)
_HOUSING: Color = (38, 40, 42)
# The colour of a lantern's head, which shines at night.
LANTERN_COLOR: Color = (226, 222, 200)
_PLATE: Color = (230, 226, 220)
_RIM: Color = (186, 34, 36)
# Metres from the kerb to the middle of a mast.
KERB_INSET = 0.3
# Metres from the stop line or yield line, towards the junction, to the light or sign.
_BEHIND_LINE = 0.3
# Heights of the red, amber and green lamp above the ground, metres.
_LAMP_HEIGHTS = (3.35, 3.05, 2.75)
_LANTERN_SPACING = 28.0
_LANTERN_HEIGHT = 6.0
_BARK: Color = (92, 72, 54)
_LEAVES: tuple[Color, ...] = ((70, 116, 54), (88, 132, 62), (58, 100, 58))
_TREE_SPACING = 13.0
# The share of places that have a tree.
_TREE_SHARE = 0.55
# Metres from the sidewalk to a trunk, so that crowns end at the sidewalk.
_TREE_INSET = 1.25
Span = tuple[float, float]
# Height of a storey, metres.
STOREY = 3.2
_WALLS: tuple[Color, ...] = (
    (176, 122, 96), (206, 190, 160), (170, 170, 166), (148, 100, 82), (220, 214, 200), (140, 150, 158), (190, 160, 128),
)  # fmt: skip
# Metres from the sidewalk to the fronts.
_SETBACK = (2.5, 4.6)
_LAST_HOUSE = 110.0
_KERB_HOUSE_LENGTH = 20.5
_KERB_HOUSE_STOREYS = 3
# Metres from the middle of a mast to the house on the kerb behind it.
_MAST_ROOM = 0.25
_CODES = 240
# A corner, given by its signs of x and y.
Corner = tuple[int, int]
_MAX_SLOPE = np.deg2rad(3.0)
# The least and the greatest height of the infrastructure's sensors above the ground, metres: its cameras, some of
# them above the road, are higher than any truck.
_POLE_HEIGHTS, _LOW_POLE_HEIGHTS = (4.1, 4.6), (3.35, 3.75)
# Metres from the sidewalk's outer edges to the middle of the pole: the farthest place from which it sees along the
# lanes.
_POLE_INSET = 0.15
_POLE_UNDER_SENSOR = 0.4


@dataclass(frozen=True, slots=True, kw_only=True)
class SignalHead:
    """The lamps for the traffic that comes by one arm.

    Attributes:
        arm: by which the traffic comes.
        rows: rows of the red, amber and green lamp in `World.props`.
    """

    arm: Arm
    rows: tuple[int, int, int]


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
    low_pole: bool = False,
) -> World:
    """A town around a junction; raises ConfigError if a hidden view's arms have no corner in common.

    A `hidden` view puts a house on the kerb of the corner between two arms, and the pole on the opposite corner, where
    it sees both; in the open one the pole sees these two best. Apart from house and pole both views give the same
    world.
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
    height = float(pole.uniform(*(_LOW_POLE_HEIGHTS if low_pole else _POLE_HEIGHTS)))
    x, y = (sign * (spec.sidewalk_edge - _POLE_INSET) for sign in corner)
    signs = [yield_sign(spec, arm) for arm in spec.yielding_arms]
    stands: list[Prop] = [
        *lights,
        *signs,
        mast(x, y, height - _POLE_UNDER_SENSOR),
        *buildings,
        *plants,
    ]
    stands += [each for each in lanterns(spec) if not any(overlap(each, other) for other in stands)]
    props = [settled_prop(each, terrain) for each in stands]
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


@dataclass(frozen=True, slots=True)
class Prop:
    """One thing, made as if the ground were flat.

    Attributes:
        code: its code on the map from above, as in `roads`.
        blocks: its blocks, in the ground frame.
    """

    code: int
    blocks: tuple[Block, ...]

    @property
    def footprint(self) -> tuple[float, float, float, float]:
        """The extent of all its blocks: x from, x to, y from, y to, metres."""
        spans = [(*block.x, *block.y) for block in self.blocks]
        x0, x1, y0, y1 = zip(*spans, strict=True)
        return min(x0), max(x1), min(y0), max(y1)


def overlap(first: Prop, second: Prop) -> bool:
    """Whether the footprints of two things overlap."""
    a, b = first.footprint, second.footprint
    return all(a[k] < b[k + 1] and b[k] < a[k + 1] for k in (0, 2))


def settled_prop(prop: Prop, terrain: Terrain) -> Prop:
    """The thing on sloping ground: raised to the height of its lowest corner, so that no part of it floats."""
    if terrain.is_flat:
        return prop
    lift = float(terrain.height(_corners(prop)).min())
    return replace(
        prop,
        blocks=tuple(
            replace(block, z=(block.z[0] + lift, block.z[1] + lift)) for block in prop.blocks
        ),
    )


def solids_of(props: Sequence[Prop]) -> Solids:
    """The solids of all things, in order."""
    return build([block for prop in props for block in prop.blocks])


def top_map(ground: GroundMap, props: Sequence[Prop]) -> GroundMap:
    """The map from above: lower things are painted first, so that higher things cover them."""
    flat = [
        (block.z[1], prop.code, (*block.x, *block.y)) for prop in props for block in prop.blocks
    ]
    flat.sort(key=lambda entry: entry[0])
    return ground.with_rectangles(
        np.array([extent for _, _, extent in flat]).reshape(-1, 4),
        np.array([code for _, code, _ in flat], dtype=np.uint8),
    )


def _corners(prop: Prop) -> FloatArray:
    x0, x1, y0, y1 = prop.footprint
    return np.array([[x0, y0], [x0, y1], [x1, y0], [x1, y1]])


def mast(x: float, y: float, top: float) -> Prop:
    """A mast whose top is `top` metres high."""
    return Prop(POLE, (_column(x, y, (-0.1, top)),))


def traffic_light(spec: RoadSpec, arm: Arm) -> Prop:
    """A mast, a housing and three dark lamps (the last three blocks: red, amber, green) at the right of a stop line."""
    out_x, out_y = OUTWARD[arm]
    x, y = _right_of_line(spec, arm)
    lamps = (
        _box(x + 0.12 * out_x, y + 0.12 * out_y, 0.11, (z - 0.1, z + 0.1), color)
        for z, color in zip(_LAMP_HEIGHTS, _DARK_LAMPS, strict=True)
    )
    housing = _box(x, y, 0.15, (_LAMP_HEIGHTS[2] - 0.2, _LAMP_HEIGHTS[0] + 0.2), _HOUSING)
    return Prop(POLE, (_column(x, y, (-0.1, housing.z[0])), housing, *lamps))


def yield_sign(spec: RoadSpec, arm: Arm) -> Prop:
    """A post with a white triangle in a red one, a corner downwards, at the right of a yield line."""
    out_x, out_y = OUTWARD[arm]
    x, y = _right_of_line(spec, arm)
    rim = _triangle(x, y, arm, (2.05, 2.75), _RIM)
    face = _triangle(x + 0.02 * out_x, y + 0.02 * out_y, arm, (2.2, 2.69), _PLATE)
    return Prop(POLE, (_column(x, y, (-0.1, 2.3), half=0.025), rim, face))


def lanterns(spec: RoadSpec) -> Iterator[Prop]:
    """Street lanterns along each arm, on its two sidewalks by turns."""
    for arm in spec.arms:
        out_x, out_y = OUTWARD[arm]
        for number, along in enumerate(np.arange(spec.stop_line[1] + 9.0, 115.0, _LANTERN_SPACING)):
            side = 1 if number % 2 else -1
            beside = side * (spec.road_edge + KERB_INSET)
            x, y = float(along * out_x - beside * out_y), float(along * out_y + beside * out_x)
            head = _box(x, y, 0.24, (_LANTERN_HEIGHT, _LANTERN_HEIGHT + 0.25), LANTERN_COLOR)
            yield Prop(POLE, (_column(x, y, (-0.1, _LANTERN_HEIGHT)), head))


def _right_of_line(spec: RoadSpec, arm: Arm) -> tuple[float, float]:
    """Where the light or sign for the traffic from an arm stands: x and y, metres."""
    along, beside = spec.stop_line[0] - _BEHIND_LINE, spec.road_edge + KERB_INSET
    out_x, out_y = OUTWARD[arm]
    return along * out_x - beside * out_y, along * out_y + beside * out_x


def _triangle(x: float, y: float, arm: Arm, z: tuple[float, float], color: Color) -> Block:
    """A plate across an arm, nearly a point at the bottom, and at the top as wide as it is high."""
    tip, wide, thin = 0.02, (z[1] - z[0]) * 0.5, 0.02
    if OUTWARD[arm][0]:
        return Block(
            (x - thin, x + thin), (y - tip, y + tip), z, color, inset=(0.0, 0.0, tip - wide)
        )
    return Block(
        (x - tip, x + tip), (y - thin, y + thin), z, color, inset=(tip - wide, tip - wide, 0.0)
    )


def _column(x: float, y: float, z: tuple[float, float], half: float = 0.09) -> Block:
    return _box(x, y, half, z, _STEEL)


def _box(x: float, y: float, half: float, z: tuple[float, float], color: Color) -> Block:
    return Block((x - half, x + half), (y - half, y + half), z, color)


def trees(rng: np.random.Generator, spec: RoadSpec) -> Iterator[Prop]:
    """Trees along both sides of each arm, with gaps."""
    for arm in spec.arms:
        out_x, out_y = OUTWARD[arm]
        for along in np.arange(spec.stop_line[1] + 7.0, 105.0, _TREE_SPACING):
            for side in (1, -1):
                place, present = float(along + rng.uniform(-2, 2)), rng.random() < _TREE_SHARE
                beside = side * (spec.sidewalk_edge + _TREE_INSET)
                if present:
                    yield _tree(rng, place * out_x - beside * out_y, place * out_y + beside * out_x)


def _tree(rng: np.random.Generator, x: float, y: float) -> Prop:
    leaves, top = _LEAVES[rng.integers(len(_LEAVES))], float(rng.uniform(4.0, 5.6))
    crown = ((x - 1.1, x + 1.1), (y - 1.1, y + 1.1))
    return Prop(
        TREE,
        (
            Block((x - 0.14, x + 0.14), (y - 0.14, y + 0.14), (-0.1, 2.3), _BARK),
            Block(*crown, (2.2, 3.3), leaves, inset=(-0.1, -0.1, -0.1)),
            Block(
                (x - 1.15, x + 1.15),
                (y - 1.15, y + 1.15),
                (3.3, top),
                leaves,
                inset=(0.7, 0.7, 0.7),
            ),
        ),
    )


def houses(rng: np.random.Generator, spec: RoadSpec) -> list[Prop]:
    """A corner building in each quadrant and a row of houses along each of its two sides."""
    blocks = [
        block
        for sign_x in (1, -1)
        for sign_y in (1, -1)
        for block in _quadrant(rng, spec, sign_x, sign_y)
    ]
    if spec.kind == "three-way":
        blocks += _closed_side(rng, spec)
    return [Prop(FIRST_BUILDING + number % _CODES, (block,)) for number, block in enumerate(blocks)]


def kerb_house(spec: RoadSpec, corner: tuple[int, int]) -> Prop:
    """The house on the kerb of a corner, given by its signs of x and y: it hides the traffic behind it.

    Between it and the road there is only room for a mast.
    """
    near = spec.road_edge + KERB_INSET + _MAST_ROOM
    kept = KERB_RADIUS - KERB_INSET - _MAST_ROOM
    near = max(near, spec.road_edge + KERB_RADIUS - kept / float(np.sqrt(2)))
    x, y = (_mirrored((near, near + _KERB_HOUSE_LENGTH), sign) for sign in corner)
    return Prop(
        FIRST_BUILDING,
        (Block(x, y, (-BASEMENT, STOREY * _KERB_HOUSE_STOREYS + 0.8), _WALLS[0], facade=True),),
    )


def _quadrant(
    rng: np.random.Generator, spec: RoadSpec, sign_x: int, sign_y: int
) -> Iterator[Block]:
    setback = spec.sidewalk_edge + rng.uniform(*_SETBACK, 2)
    end = setback + rng.uniform(15, 22, 2)
    yield _house(rng, (setback[0], end[0]), (setback[1], end[1]), (sign_x, sign_y), storeys=(3, 6))
    for span, front in _row(rng, spec, end[0], end[1]):
        yield _house(rng, span, front, (sign_x, sign_y))
    for span, front in _row(rng, spec, end[1], end[0]):
        yield _house(rng, front, span, (sign_x, sign_y))


def _closed_side(rng: np.random.Generator, spec: RoadSpec) -> Iterator[Block]:
    """A house on the side where a three-way junction has no arm, between the corner houses."""
    front = spec.sidewalk_edge + rng.uniform(*_SETBACK)
    half = spec.sidewalk_edge + _SETBACK[0] - 1.5
    yield _house(rng, (-half, half), (front, front + rng.uniform(9, 14)), (1, 1), storeys=(2, 4))


def _row(
    rng: np.random.Generator, spec: RoadSpec, start: float, deepest: float
) -> Iterator[tuple[Span, Span]]:
    """Houses side by side from `start`: their extents along the road and away from it."""
    position = start + rng.uniform(1.5, 6)
    while position < _LAST_HOUSE:
        length, front = rng.uniform(10, 20), spec.sidewalk_edge + rng.uniform(*_SETBACK)
        yield (position, position + length), (front, min(front + rng.uniform(9, 14), deepest))
        position += length + rng.uniform(1, 7)


def _house(
    rng: np.random.Generator,
    x: Span,
    y: Span,
    signs: tuple[int, int],
    storeys: tuple[int, int] = (2, 5),
) -> Block:
    """A house of the first quadrant, mirrored into another."""
    height = STOREY * int(rng.integers(*storeys)) + 0.8
    wall = _WALLS[rng.integers(len(_WALLS))]
    return Block(
        _mirrored(x, signs[0]), _mirrored(y, signs[1]), (-BASEMENT, height), wall, facade=True
    )


def _mirrored(span: Span, sign: int) -> Span:
    low, high = sorted((sign * float(span[0]), sign * float(span[1])))
    return low, high


def _signals(junction: Junction, lights: list[Prop]) -> list[SignalHead]:
    """Where the lamps of the arms' traffic lights are, whose blocks are the first of the world's solids."""
    ends = accumulate(
        len(light.blocks) for light in lights
    )  # the lamps are the last blocks of a light
    return [
        SignalHead(arm=arm, rows=(end - 3, end - 2, end - 1))
        for arm, end in zip(junction.arms, ends, strict=False)
    ]


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
    slope, uphill, yaw = (
        rng.uniform(0, _MAX_SLOPE),
        rng.uniform(-np.pi, np.pi),
        rng.uniform(-np.pi, np.pi),
    )
    if not terrain.is_flat:
        slope = 0.0
    across = SE3.from_quaternion((np.cos(slope / 2), 0.0, np.sin(slope / 2), 0.0))
    direction = SE3.from_yaw(uphill)
    tilt = direction @ across @ direction.inverse()
    x, y, z = rng.uniform((-400, -400, -2), (400, 400, 8))
    return SE3.from_rotation(np.eye(3), (x, y, z)) @ tilt @ SE3.from_yaw(yaw)
