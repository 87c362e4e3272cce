"""The static world: the ground and its roads, street furniture, trees, houses and the pole."""

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

BASEMENT = 0.2
"""Depth to which things reach into the ground, metres."""
LAMP_COLORS: tuple[Color, Color, Color] = ((230, 46, 38), (240, 186, 50), (52, 210, 96))
"""The colours of lamps that are on: red, amber, green."""
_DARK_LAMP_COLORS: tuple[Color, Color, Color] = ((72, 22, 20), (76, 58, 20), (18, 62, 32))
_STEEL_COLOR: Color = (92, 96, 100)
_HOUSING_COLOR: Color = (38, 40, 42)
LANTERN_COLOR: Color = (226, 222, 200)
"""The colour of a lantern's head, which shines at night."""
_PLATE_COLOR: Color = (230, 226, 220)
_RIM_COLOR: Color = (186, 34, 36)
KERB_INSET = 0.3
"""Distance from the kerb to the middle of a mast, metres."""
# Distance from the stop line or yield line, towards the junction, to the light or sign.
_LINE_DISTANCE_M = 0.3
# Heights of the red, amber and green lamp above the ground, metres.
_LAMP_HEIGHTS = (3.35, 3.05, 2.75)
_LANTERN_SPACING_M = 28.0
_LANTERN_HEIGHT_M = 6.0
_BARK_COLOR: Color = (92, 72, 54)
_LEAF_COLORS: tuple[Color, ...] = ((70, 116, 54), (88, 132, 62), (58, 100, 58))
_TREE_SPACING_M = 13.0
# The share of places that have a tree.
_TREE_SHARE = 0.55
# Distance from the sidewalk to a trunk, so that crowns end at the sidewalk.
_TREE_INSET_M = 1.25
Span = tuple[float, float]
STOREY = 3.2
"""Height of a storey, metres."""
_WALL_COLORS: tuple[Color, ...] = (
    (176, 122, 96), (206, 190, 160), (170, 170, 166), (148, 100, 82), (220, 214, 200),
    (140, 150, 158), (190, 160, 128),
)  # fmt: skip
# Smallest and largest distance from the sidewalk to the fronts of houses, metres.
_SETBACKS = (2.5, 4.6)
# Rows of houses end at this distance from the middle.
_ROW_END_M = 110.0
_KERB_HOUSE_LENGTH_M = 20.5
_KERB_HOUSE_STOREYS = 3
# Distance from the middle of a mast to the house on the kerb behind it.
_MAST_CLEARANCE_M = 0.25
_NUM_BUILDING_CODES = 240
Corner = tuple[int, int]
"""A corner of the junction, given by its signs of x and y."""
_MAX_SLOPE = np.deg2rad(3.0)
# Smallest and largest height of the infrastructure's sensors above the ground, metres: its cameras,
# some of them above the road, are higher than any truck.
_POLE_HEIGHTS = (4.1, 4.6)
_LOW_POLE_HEIGHTS = (3.35, 3.75)
# Distance from the sidewalk's outer edges to the middle of the pole: the farthest place from which
# it sees along the lanes.
_POLE_INSET_M = 0.15
# Distance from the top of the pole to the sensor.
_SENSOR_OFFSET_M = 0.4


@dataclass(frozen=True, slots=True, kw_only=True)
class SignalHead:
    """The lamps for the traffic that comes by one arm.

    Attributes:
        arm: Arm by which the traffic comes.
        rows: Rows of the red, amber and green lamp in `World.props`.
    """

    arm: Arm
    rows: tuple[int, int, int]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class World(ShortRepr):
    """Everything that does not change during a scenario, in the ground frame.

    Attributes:
        world_from_ground: Pose of the junction in the town, with its slope.
        ground: Map of the roads, as cameras and LiDAR see them.
        top: Map of the ground with everything on it, as the BEV camera sees it.
        props: Buildings, trees, poles; the first solids are the lamps of `signals`.
        terrain: Height of the ground.
        lidar_pole: `ground_from_lidar` of the infrastructure agent.
        signals: Traffic lights, one for each arm; none at an unsignalised junction.
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
    """Draw a town around a junction.

    A `hidden` view puts a house on the kerb of the corner between two arms, and the pole on the
    opposite corner, where it sees both; in the open view the pole sees these two best. Apart from
    house and pole both views give the same world.

    Args:
        rng: Generator of random numbers.
        junction: The junction.
        view: `open` or `hidden`.
        between: The two arms.
        low_pole: Whether the pole is low, as in the real release.

    Raises:
        ConfigError: The arms of a hidden view have no corner in common.
    """
    place_rng, house_rng, tree_rng, pole_rng = rng.spawn(4)
    spec = junction.spec
    terrain = junction.terrain
    buildings = houses(house_rng, spec)
    plants = list(trees(tree_rng, spec))
    lights = [traffic_light(spec, arm) for arm in junction.arms] if spec.signalized else []
    corner = _pole_corner(pole_rng, junction, between)
    if view == "hidden":
        house_corner = _corner_between(junction, between)
        house = kerb_house(spec, house_corner)
        buildings = [house, *(prop for prop in buildings if not overlap(prop, house))]
        plants = [prop for prop in plants if not overlap(prop, house)]
        corner = (-house_corner[0], -house_corner[1])
    pole_heights = _LOW_POLE_HEIGHTS if low_pole else _POLE_HEIGHTS
    height = float(pole_rng.uniform(*pole_heights))
    x, y = (sign * (spec.sidewalk_edge - _POLE_INSET_M) for sign in corner)
    pole = mast(x, y, height - _SENSOR_OFFSET_M)
    signs = [yield_sign(spec, arm) for arm in spec.yielding_arms]
    flat_props: list[Prop] = [*lights, *signs, pole, *buildings, *plants]
    flat_props += [
        lantern
        for lantern in lanterns(spec)
        if not any(overlap(lantern, prop) for prop in flat_props)
    ]
    props = [settled_prop(prop, terrain) for prop in flat_props]
    ground = junction.ground_map()
    return World(
        world_from_ground=_random_pose(place_rng, terrain),
        ground=ground,
        top=top_map(ground, props),
        props=solids_of(props),
        terrain=terrain,
        lidar_pole=SE3.from_yaw(float(np.arctan2(-y, -x)), (x, y, height)),
        signals=tuple(_signal_heads(junction, props[: len(lights)])),
    )


@dataclass(frozen=True, slots=True)
class Prop:
    """One thing, made as if the ground were flat.

    Attributes:
        code: Code on the map from above, as in `roads`.
        blocks: Blocks, in the ground frame.
    """

    code: int
    blocks: tuple[Block, ...]

    @property
    def footprint(self) -> tuple[float, float, float, float]:
        """The extent of all its blocks: x from, x to, y from, y to, metres."""
        spans = [(*block.x, *block.y) for block in self.blocks]
        x0, x1, y0, y1 = zip(*spans, strict=True)
        return min(x0), max(x1), min(y0), max(y1)


def overlap(prop: Prop, other: Prop) -> bool:
    """Return whether the footprints of two things overlap."""
    a = prop.footprint
    b = other.footprint
    return all(a[k] < b[k + 1] and b[k] < a[k + 1] for k in (0, 2))


def settled_prop(prop: Prop, terrain: Terrain) -> Prop:
    """Return a thing on sloping ground.

    It is raised to the height of its lowest corner, so that no part of it floats.
    """
    if terrain.is_flat:
        return prop
    lift = float(terrain.height(_corners(prop)).min())
    blocks = []
    for block in prop.blocks:
        blocks.append(replace(block, z=(block.z[0] + lift, block.z[1] + lift)))
    return replace(prop, blocks=tuple(blocks))


def solids_of(props: Sequence[Prop]) -> Solids:
    """Build the solids of all things, in order."""
    return build([block for prop in props for block in prop.blocks])


def top_map(ground: GroundMap, props: Sequence[Prop]) -> GroundMap:
    """Paint the map from above: lower things first, so that higher things cover them."""
    entries = []
    for prop in props:
        for block in prop.blocks:
            entries.append((block.z[1], prop.code, (*block.x, *block.y)))
    entries.sort(key=lambda entry: entry[0])
    rectangles = np.array([extent for _, _, extent in entries]).reshape(-1, 4)
    codes = np.array([code for _, code, _ in entries], dtype=np.uint8)
    return ground.with_rectangles(rectangles, codes)


def _corners(prop: Prop) -> FloatArray:
    """Return the corners (4, 2) of a thing's footprint, metres."""
    x0, x1, y0, y1 = prop.footprint
    return np.array([[x0, y0], [x0, y1], [x1, y0], [x1, y1]])


def mast(x: float, y: float, top: float) -> Prop:
    """Make a mast that is `top` metres high."""
    column = _column(x, y, (-0.1, top))
    return Prop(POLE, (column,))


def traffic_light(spec: RoadSpec, arm: Arm) -> Prop:
    """Make a mast, a housing and three dark lamps at the right of a stop line.

    The lamps are the last three blocks: red, amber, green.
    """
    out_x, out_y = OUTWARD[arm]
    x, y = _right_of_line(spec, arm)
    lamps = []
    for z, color in zip(_LAMP_HEIGHTS, _DARK_LAMP_COLORS, strict=True):
        lamps.append(_box(x + 0.12 * out_x, y + 0.12 * out_y, 0.11, (z - 0.1, z + 0.1), color))
    housing_z = (_LAMP_HEIGHTS[2] - 0.2, _LAMP_HEIGHTS[0] + 0.2)
    housing = _box(x, y, 0.15, housing_z, _HOUSING_COLOR)
    return Prop(POLE, (_column(x, y, (-0.1, housing.z[0])), housing, *lamps))


def yield_sign(spec: RoadSpec, arm: Arm) -> Prop:
    """Make a post with a white triangle in a red one, at the right of a yield line.

    The triangles have a corner at the bottom.
    """
    out_x, out_y = OUTWARD[arm]
    x, y = _right_of_line(spec, arm)
    post = _column(x, y, (-0.1, 2.3), half=0.025)
    rim = _triangle(x, y, arm, (2.05, 2.75), _RIM_COLOR)
    face = _triangle(x + 0.02 * out_x, y + 0.02 * out_y, arm, (2.2, 2.69), _PLATE_COLOR)
    return Prop(POLE, (post, rim, face))


def lanterns(spec: RoadSpec) -> Iterator[Prop]:
    """Yield street lanterns along each arm, on its two sidewalks by turns."""
    head_z = (_LANTERN_HEIGHT_M, _LANTERN_HEIGHT_M + 0.25)
    positions = np.arange(spec.stop_line[1] + 9.0, 115.0, _LANTERN_SPACING_M)
    for arm in spec.arms:
        out_x, out_y = OUTWARD[arm]
        for number, along in enumerate(positions):
            side = 1 if number % 2 else -1
            beside = side * (spec.road_edge + KERB_INSET)
            x = float(along * out_x - beside * out_y)
            y = float(along * out_y + beside * out_x)
            head = _box(x, y, 0.24, head_z, LANTERN_COLOR)
            yield Prop(POLE, (_column(x, y, (-0.1, _LANTERN_HEIGHT_M)), head))


def _right_of_line(spec: RoadSpec, arm: Arm) -> tuple[float, float]:
    """Return x and y of the light or sign for the traffic from an arm, metres."""
    along = spec.stop_line[0] - _LINE_DISTANCE_M
    beside = spec.road_edge + KERB_INSET
    out_x, out_y = OUTWARD[arm]
    return along * out_x - beside * out_y, along * out_y + beside * out_x


def _triangle(x: float, y: float, arm: Arm, z: tuple[float, float], color: Color) -> Block:
    """Make a plate across an arm, nearly a point at the bottom.

    At the top it is as wide as it is high.
    """
    half_tip = 0.02
    half_thickness = 0.02
    half_top = (z[1] - z[0]) * 0.5
    growth = half_tip - half_top
    if OUTWARD[arm][0]:
        x_span = (x - half_thickness, x + half_thickness)
        y_span = (y - half_tip, y + half_tip)
        return Block(x_span, y_span, z, color, inset=(0.0, 0.0, growth))
    x_span = (x - half_tip, x + half_tip)
    y_span = (y - half_thickness, y + half_thickness)
    return Block(x_span, y_span, z, color, inset=(growth, growth, 0.0))


def _column(x: float, y: float, z: tuple[float, float], half: float = 0.09) -> Block:
    """Make a column of steel; `half` is half its width, metres."""
    return _box(x, y, half, z, _STEEL_COLOR)


def _box(x: float, y: float, half: float, z: tuple[float, float], color: Color) -> Block:
    """Make an upright block of square cross-section; `half` is half its width, metres."""
    x_span = (x - half, x + half)
    y_span = (y - half, y + half)
    return Block(x_span, y_span, z, color)


def trees(rng: np.random.Generator, spec: RoadSpec) -> Iterator[Prop]:
    """Yield trees along both sides of each arm, with gaps."""
    for arm in spec.arms:
        out_x, out_y = OUTWARD[arm]
        for along in np.arange(spec.stop_line[1] + 7.0, 105.0, _TREE_SPACING_M):
            for side in (1, -1):
                position = float(along + rng.uniform(-2, 2))
                has_tree = rng.random() < _TREE_SHARE
                beside = side * (spec.sidewalk_edge + _TREE_INSET_M)
                if has_tree:
                    x = position * out_x - beside * out_y
                    y = position * out_y + beside * out_x
                    yield _tree(rng, x, y)


def _tree(rng: np.random.Generator, x: float, y: float) -> Prop:
    """Draw a tree at x and y, metres."""
    leaf_color = _LEAF_COLORS[rng.integers(len(_LEAF_COLORS))]
    top = float(rng.uniform(4.0, 5.6))
    trunk = _box(x, y, 0.14, (-0.1, 2.3), _BARK_COLOR)
    lower_crown = Block(
        (x - 1.1, x + 1.1), (y - 1.1, y + 1.1), (2.2, 3.3), leaf_color, inset=(-0.1, -0.1, -0.1)
    )
    upper_crown = Block(
        (x - 1.15, x + 1.15), (y - 1.15, y + 1.15), (3.3, top), leaf_color, inset=(0.7, 0.7, 0.7)
    )
    return Prop(TREE, (trunk, lower_crown, upper_crown))


def houses(rng: np.random.Generator, spec: RoadSpec) -> list[Prop]:
    """Draw a corner building in each quadrant and a row of houses along each of its two sides."""
    blocks: list[Block] = []
    for sign_x in (1, -1):
        for sign_y in (1, -1):
            blocks += _quadrant(rng, spec, sign_x, sign_y)
    if spec.kind == "three-way":
        blocks += _closed_side(rng, spec)
    props = []
    for number, block in enumerate(blocks):
        props.append(Prop(FIRST_BUILDING + number % _NUM_BUILDING_CODES, (block,)))
    return props


def kerb_house(spec: RoadSpec, corner: tuple[int, int]) -> Prop:
    """Make the house on the kerb of a corner, which hides the traffic behind it.

    Between it and the road there is only room for a mast.

    Args:
        spec: The road.
        corner: Signs of x and y.
    """
    front = spec.road_edge + KERB_INSET + _MAST_CLEARANCE_M
    corner_radius = KERB_RADIUS - KERB_INSET - _MAST_CLEARANCE_M
    corner_front = spec.road_edge + KERB_RADIUS - corner_radius / float(np.sqrt(2))
    front = max(front, corner_front)
    x, y = (_mirrored((front, front + _KERB_HOUSE_LENGTH_M), sign) for sign in corner)
    z = (-BASEMENT, STOREY * _KERB_HOUSE_STOREYS + 0.8)
    house = Block(x, y, z, _WALL_COLORS[0], facade=True)
    return Prop(FIRST_BUILDING, (house,))


def _quadrant(
    rng: np.random.Generator, spec: RoadSpec, sign_x: int, sign_y: int
) -> Iterator[Block]:
    """Yield the houses of a quadrant, given by its signs of x and y."""
    setback = spec.sidewalk_edge + rng.uniform(*_SETBACKS, 2)
    end = setback + rng.uniform(15, 22, 2)
    signs = (sign_x, sign_y)
    yield _house(rng, (setback[0], end[0]), (setback[1], end[1]), signs, storeys=(3, 6))
    for span, front in _row(rng, spec, end[0], end[1]):
        yield _house(rng, span, front, signs)
    for span, front in _row(rng, spec, end[1], end[0]):
        yield _house(rng, front, span, signs)


def _closed_side(rng: np.random.Generator, spec: RoadSpec) -> Iterator[Block]:
    """Yield a house where a three-way junction has no arm, between the corner houses."""
    front = spec.sidewalk_edge + rng.uniform(*_SETBACKS)
    half = spec.sidewalk_edge + _SETBACKS[0] - 1.5
    back = front + rng.uniform(9, 14)
    yield _house(rng, (-half, half), (front, back), (1, 1), storeys=(2, 4))


def _row(
    rng: np.random.Generator, spec: RoadSpec, start: float, max_depth: float
) -> Iterator[tuple[Span, Span]]:
    """Yield houses side by side from `start`: their extents along the road and away from it."""
    position = start + rng.uniform(1.5, 6)
    while position < _ROW_END_M:
        length = rng.uniform(10, 20)
        front = spec.sidewalk_edge + rng.uniform(*_SETBACKS)
        back = min(front + rng.uniform(9, 14), max_depth)
        yield (position, position + length), (front, back)
        position += length + rng.uniform(1, 7)


def _house(
    rng: np.random.Generator,
    x: Span,
    y: Span,
    signs: tuple[int, int],
    storeys: tuple[int, int] = (2, 5),
) -> Block:
    """Draw a house of the first quadrant, mirrored into another.

    Args:
        rng: Generator of random numbers.
        x: Extent in x in the first quadrant, metres.
        y: Extent in y, metres.
        signs: Signs of x and y of the quadrant.
        storeys: Smallest number of storeys, and one more than the largest.
    """
    height = STOREY * int(rng.integers(*storeys)) + 0.8
    wall_color = _WALL_COLORS[rng.integers(len(_WALL_COLORS))]
    x = _mirrored(x, signs[0])
    y = _mirrored(y, signs[1])
    return Block(x, y, (-BASEMENT, height), wall_color, facade=True)


def _mirrored(span: Span, sign: int) -> Span:
    """Return a span, mirrored if the sign is negative."""
    low, high = sorted((sign * float(span[0]), sign * float(span[1])))
    return low, high


def _signal_heads(junction: Junction, lights: list[Prop]) -> list[SignalHead]:
    """Return the lamps of the arms' traffic lights, the first solids of the world."""
    ends = accumulate(len(light.blocks) for light in lights)
    heads = []
    for arm, end in zip(junction.arms, ends, strict=False):
        # The lamps are the last blocks of a light.
        heads.append(SignalHead(arm=arm, rows=(end - 3, end - 2, end - 1)))
    return heads


def _pole_corner(rng: np.random.Generator, junction: Junction, between: tuple[Arm, Arm]) -> Corner:
    """Draw one of the corners nearest to two arms.

    A three-way junction has corners only in the south.
    """
    y_signs = (1, -1) if "north" in junction.arms else (-1,)
    toward_arms = np.sum([OUTWARD[arm] for arm in between], axis=0)
    nearness = {(x, y): int(toward_arms @ (x, y)) for x in (1, -1) for y in y_signs}
    max_nearness = max(nearness.values())
    nearest = [corner for corner, value in nearness.items() if value == max_nearness]
    return nearest[int(rng.random() * len(nearest))]


def _corner_between(junction: Junction, arms: tuple[Arm, Arm]) -> Corner:
    """Return the corner between two arms; raises ConfigError if they have none in common."""
    (x_a, y_a), (x_b, y_b) = (OUTWARD[arm] for arm in arms)
    corner = (x_a + x_b, y_a + y_b)
    if 0 in corner or not set(arms) <= set(junction.arms):
        raise ConfigError(
            f"between: the arms {arms[0]} and {arms[1]} of a {junction.spec.kind} junction have no "
            f"corner in common; choose two neighbours of {', '.join(junction.arms)}"
        )
    return corner


def _random_pose(rng: np.random.Generator, terrain: Terrain) -> SE3:
    """Draw a pose of the ground some hundred metres from the town's origin, in any direction.

    It is on a gentle slope if the ground has no hump.
    """
    slope = rng.uniform(0, _MAX_SLOPE)
    uphill = rng.uniform(-np.pi, np.pi)
    yaw = rng.uniform(-np.pi, np.pi)
    if not terrain.is_flat:
        slope = 0.0
    across = SE3.from_quaternion((np.cos(slope / 2), 0.0, np.sin(slope / 2), 0.0))
    direction = SE3.from_yaw(uphill)
    tilt = direction @ across @ direction.inverse()
    x, y, z = rng.uniform((-400, -400, -2), (400, 400, 8))
    return SE3.from_rotation(np.eye(3), (x, y, z)) @ tilt @ SE3.from_yaw(yaw)
