"""The static world: the ground with its roads, street furniture, trees, houses and the pole."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

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
from deepaccident_devkit.plugins.synth.roads.layout import KERB_RADIUS, OUTWARD, point_on_arm
from deepaccident_devkit.plugins.synth.solids import (
    Block,
    Color,
    Solids,
    Span,
    build,
    center_span,
    span_around,
)
from deepaccident_devkit.plugins.synth.spec import View
from deepaccident_devkit.support.arrays import ShortRepr

BASEMENT = 0.2
"""Depth to which objects extend into the ground, metres."""
LAMP_COLORS: tuple[Color, Color, Color] = ((230, 46, 38), (240, 186, 50), (52, 210, 96))
"""The colours of lit lamps: red, amber, green."""
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
# Fraction of the tree positions that have a tree.
_TREE_SHARE = 0.55
# Distance from the sidewalk to the middle of a trunk, so that crowns end at the sidewalk.
_TREE_INSET_M = 1.25
STOREY = 3.2
"""Height of a storey, metres."""
_WALL_COLORS: tuple[Color, ...] = (
    (176, 122, 96), (206, 190, 160), (170, 170, 166), (148, 100, 82), (220, 214, 200),
    (140, 150, 158), (190, 160, 128),
)  # fmt: skip
# Smallest and largest distance from the sidewalk to the fronts of houses, metres.
_SETBACKS = (2.5, 4.6)
# Distance from the junction's middle at which rows of houses end.
_ROW_END_M = 110.0
_KERB_HOUSE_LENGTH_M = 20.5
_KERB_HOUSE_STOREYS = 3
_PARAPET_HEIGHT_M = 0.8
# Distance from the middle of a mast to the house on the kerb behind it.
_MAST_CLEARANCE_M = 0.25
_NUM_BUILDING_CODES = 240
Corner = tuple[int, int]
"""A corner of the junction, given by its signs of x and y."""
_MAX_SLOPE = np.deg2rad(3.0)
# Smallest and largest height of the infrastructure's sensors above the ground, metres. Its cameras,
# some of which are above the road, are higher than any truck.
_POLE_HEIGHTS = (4.1, 4.6)
_LOW_POLE_HEIGHTS = (3.35, 3.75)
# Distance from the sidewalk's outer edges to the middle of the pole, which is the farthest place
# from which it sees along the lanes.
_POLE_INSET_M = 0.15
# Distance from the top of the pole to the sensor.
_SENSOR_OFFSET_M = 0.4


@dataclass(frozen=True, slots=True, kw_only=True)
class SignalHead:
    """The lamps for the traffic from one arm.

    Attributes:
        arm: Arm from which the traffic comes.
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
    opposite corner, from which both arms are visible; in the open view, the pole stands where it
    sees these two arms best. Apart from the house and the pole, both views give the same world.

    Args:
        rng: Generator of random numbers.
        junction: The junction.
        view: `open` or `hidden`.
        between: The two arms.
        low_pole: Whether the pole is low, as in the real release.

    Raises:
        ConfigError: The two arms of a hidden view do not share a corner.
    """
    place_rng, house_rng, tree_rng, pole_rng = rng.spawn(4)
    spec = junction.spec
    terrain = junction.terrain
    buildings = draw_houses(house_rng, spec)
    plants = list(draw_trees(tree_rng, spec))
    lights = []
    if spec.signalized:
        lights = [traffic_light(spec, arm) for arm in junction.arms]
    pole_corner = _draw_pole_corner(pole_rng, junction, between)
    if view == "hidden":
        corner_x, corner_y = _find_common_corner(junction, between)
        house = make_kerb_house(spec, (corner_x, corner_y))
        buildings = [house, *(prop for prop in buildings if not overlaps(prop, house))]
        plants = [prop for prop in plants if not overlaps(prop, house)]
        pole_corner = (-corner_x, -corner_y)
    pole_heights = _LOW_POLE_HEIGHTS if low_pole else _POLE_HEIGHTS
    height = float(pole_rng.uniform(*pole_heights))
    pole_distance = spec.sidewalk_edge - _POLE_INSET_M
    x, y = (sign * pole_distance for sign in pole_corner)
    pole = make_mast(x, y, height - _SENSOR_OFFSET_M)
    signs = [yield_sign(spec, arm) for arm in spec.yielding_arms]
    flat_props = [*lights, *signs, pole, *buildings, *plants]
    free_lanterns = []
    for lantern in make_lanterns(spec):
        if not any(overlaps(lantern, prop) for prop in flat_props):
            free_lanterns.append(lantern)
    props = [settle_prop(prop, terrain) for prop in flat_props + free_lanterns]
    ground = junction.ground_map()
    return World(
        world_from_ground=_draw_pose(place_rng, terrain),
        ground=ground,
        top=paint_top_map(ground, props),
        props=build_solids(props),
        terrain=terrain,
        lidar_pole=SE3.from_yaw(float(np.arctan2(-y, -x)), (x, y, height)),
        signals=_find_signal_heads(junction, props[: len(lights)]),
    )


@dataclass(frozen=True, slots=True)
class Prop:
    """One static object, built as if the ground were flat.

    Attributes:
        code: Code on the map from above, as in `roads`.
        blocks: Blocks, in the ground frame.
    """

    code: int
    blocks: tuple[Block, ...]

    @property
    def footprint(self) -> tuple[float, float, float, float]:
        """The extent of all its blocks: x from, x to, y from, y to, metres."""
        x_from = min(block.x[0] for block in self.blocks)
        x_to = max(block.x[1] for block in self.blocks)
        y_from = min(block.y[0] for block in self.blocks)
        y_to = max(block.y[1] for block in self.blocks)
        return x_from, x_to, y_from, y_to


def overlaps(prop: Prop, other: Prop) -> bool:
    """Return whether the footprints of two objects overlap."""
    x0, x1, y0, y1 = prop.footprint
    other_x0, other_x1, other_y0, other_y1 = other.footprint
    overlap_in_x = x0 < other_x1 and other_x0 < x1
    overlap_in_y = y0 < other_y1 and other_y0 < y1
    return overlap_in_x and overlap_in_y


def settle_prop(prop: Prop, terrain: Terrain) -> Prop:
    """Place an object on sloping ground.

    The object is raised to the height of its lowest corner, so that no part of it floats.
    """
    if terrain.is_flat:
        return prop
    x0, x1, y0, y1 = prop.footprint
    corners = np.array([[x0, y0], [x0, y1], [x1, y0], [x1, y1]])
    lift = float(terrain.height(corners).min())
    blocks = []
    for block in prop.blocks:
        low, high = block.z
        blocks.append(replace(block, z=(low + lift, high + lift)))
    return replace(prop, blocks=tuple(blocks))


def build_solids(props: Sequence[Prop]) -> Solids:
    """Build the solids of all objects, in order."""
    blocks: list[Block] = []
    for prop in props:
        blocks += prop.blocks
    return build(blocks)


def paint_top_map(ground: GroundMap, props: Sequence[Prop]) -> GroundMap:
    """Paint the map seen from above: lower objects first, so that higher ones cover them."""
    entries = []
    for prop in props:
        for block in prop.blocks:
            entries.append((block.z[1], prop.code, (*block.x, *block.y)))
    entries.sort(key=lambda entry: entry[0])
    rectangles = np.array([extent for _, _, extent in entries]).reshape(-1, 4)
    codes = np.array([code for _, code, _ in entries], dtype=np.uint8)
    return ground.with_rectangles(rectangles, codes)


def make_mast(x: float, y: float, top: float) -> Prop:
    """Make a mast that is `top` metres high, at x and y, metres."""
    column = _make_column(x, y, (-0.1, top))
    return Prop(POLE, (column,))


def traffic_light(spec: RoadSpec, arm: Arm) -> Prop:
    """Make a mast, a housing and three unlit lamps to the right of a stop line.

    The lamps are the last three blocks: red, amber, green.
    """
    out_x, out_y = OUTWARD[arm]
    x, y = _locate_right_of_line(spec, arm)
    lamps = []
    for height, color in zip(_LAMP_HEIGHTS, _DARK_LAMP_COLORS, strict=True):
        lamp_z = span_around(height, 0.1)
        lamps.append(_make_box(x + 0.12 * out_x, y + 0.12 * out_y, 0.11, lamp_z, color))
    red_height, _, green_height = _LAMP_HEIGHTS
    housing_bottom = green_height - 0.2
    housing = _make_box(x, y, 0.15, (housing_bottom, red_height + 0.2), _HOUSING_COLOR)
    return Prop(POLE, (_make_column(x, y, (-0.1, housing_bottom)), housing, *lamps))


def yield_sign(spec: RoadSpec, arm: Arm) -> Prop:
    """Make a post with a white triangle inside a red one, to the right of a yield line.

    The triangles point down.
    """
    out_x, out_y = OUTWARD[arm]
    x, y = _locate_right_of_line(spec, arm)
    post = _make_column(x, y, (-0.1, 2.3), half=0.025)
    rim = _make_triangle(x, y, arm, (2.05, 2.75), _RIM_COLOR)
    face = _make_triangle(x + 0.02 * out_x, y + 0.02 * out_y, arm, (2.2, 2.69), _PLATE_COLOR)
    return Prop(POLE, (post, rim, face))


def make_lanterns(spec: RoadSpec) -> Iterator[Prop]:
    """Yield street lanterns along each arm, on alternate sidewalks."""
    head_z = (_LANTERN_HEIGHT_M, _LANTERN_HEIGHT_M + 0.25)
    distances = np.arange(spec.stop_line[1] + 9.0, 115.0, _LANTERN_SPACING_M)
    from_middle = spec.road_edge + KERB_INSET
    for arm in spec.arms:
        for number, along in enumerate(distances.tolist()):
            side = 1 if number % 2 else -1
            x, y = point_on_arm(arm, along, side * from_middle)
            head = _make_box(x, y, 0.24, head_z, LANTERN_COLOR)
            yield Prop(POLE, (_make_column(x, y, (-0.1, _LANTERN_HEIGHT_M)), head))


def _locate_right_of_line(spec: RoadSpec, arm: Arm) -> tuple[float, float]:
    """Return x and y of the light or sign for the traffic from an arm, metres."""
    along = spec.stop_line[0] - _LINE_DISTANCE_M
    return point_on_arm(arm, along, spec.road_edge + KERB_INSET)


def _make_triangle(x: float, y: float, arm: Arm, z: Span, color: Color) -> Block:
    """Make a triangular plate across an arm that narrows almost to a point at the bottom.

    The plate's top is as wide as the plate is high.

    Args:
        x: Position x of its middle, metres.
        y: Position y of its middle, metres.
        arm: The arm.
        z: Extent from and to, metres.
        color: Colour of the plate.
    """
    half_tip = 0.02
    half_thickness = 0.02
    bottom, top = z
    half_width = (top - bottom) * 0.5
    growth = half_tip - half_width
    if arm in ("west", "east"):
        x_span = span_around(x, half_thickness)
        y_span = span_around(y, half_tip)
        return Block(x_span, y_span, z, color, inset=(0.0, 0.0, growth))
    x_span = span_around(x, half_tip)
    y_span = span_around(y, half_thickness)
    return Block(x_span, y_span, z, color, inset=(growth, growth, 0.0))


def _make_column(x: float, y: float, z: Span, half: float = 0.09) -> Block:
    """Make a column of steel; `half` is half its width, metres."""
    return _make_box(x, y, half, z, _STEEL_COLOR)


def _make_box(x: float, y: float, half: float, z: Span, color: Color) -> Block:
    """Make an upright block of square cross-section; `half` is half its width, metres."""
    x_span = span_around(x, half)
    y_span = span_around(y, half)
    return Block(x_span, y_span, z, color)


def draw_trees(rng: np.random.Generator, spec: RoadSpec) -> Iterator[Prop]:
    """Draw trees along both sides of each arm, with gaps."""
    from_middle = spec.sidewalk_edge + _TREE_INSET_M
    for arm in spec.arms:
        for distance in np.arange(spec.stop_line[1] + 7.0, 105.0, _TREE_SPACING_M).tolist():
            for side in (1, -1):
                along = distance + rng.uniform(-2, 2)
                has_tree = rng.random() < _TREE_SHARE
                if has_tree:
                    x, y = point_on_arm(arm, along, side * from_middle)
                    yield _draw_tree(rng, x, y)


def _draw_tree(rng: np.random.Generator, x: float, y: float) -> Prop:
    """Draw a tree at x and y, metres."""
    leaf_color = _LEAF_COLORS[rng.integers(len(_LEAF_COLORS))]
    top = float(rng.uniform(4.0, 5.6))
    trunk = _make_box(x, y, 0.14, (-0.1, 2.3), _BARK_COLOR)
    lower_crown = Block(
        span_around(x, 1.1), span_around(y, 1.1), (2.2, 3.3), leaf_color, inset=(-0.1, -0.1, -0.1)
    )
    upper_crown = Block(
        span_around(x, 1.15), span_around(y, 1.15), (3.3, top), leaf_color, inset=(0.7, 0.7, 0.7)
    )
    return Prop(TREE, (trunk, lower_crown, upper_crown))


def draw_houses(rng: np.random.Generator, spec: RoadSpec) -> list[Prop]:
    """Draw a corner building in each quadrant and a row of houses along each of its two sides."""
    blocks: list[Block] = []
    for signs in product((1, -1), (1, -1)):
        blocks += _draw_quadrant(rng, spec, signs)
    if spec.kind == "three-way":
        blocks.append(_draw_closed_side(rng, spec))
    props = []
    for number, block in enumerate(blocks):
        props.append(Prop(FIRST_BUILDING + number % _NUM_BUILDING_CODES, (block,)))
    return props


def make_kerb_house(spec: RoadSpec, corner: Corner) -> Prop:
    """Make the house on the kerb of a corner, which hides the traffic behind it.

    The gap between the house and the road is just wide enough for a mast.

    Args:
        spec: The road.
        corner: Signs (±1, ±1) of x and y of the quadrant.
    """
    # Keep the house's corner outside the kerb's arc, on the diagonal.
    corner_radius = KERB_RADIUS - KERB_INSET - _MAST_CLEARANCE_M
    corner_front = spec.road_edge + KERB_RADIUS - corner_radius / float(np.sqrt(2))
    front = max(spec.road_edge + KERB_INSET + _MAST_CLEARANCE_M, corner_front)
    span = (front, front + _KERB_HOUSE_LENGTH_M)
    x, y = (_mirror_span(span, sign) for sign in corner)
    z = (-BASEMENT, STOREY * _KERB_HOUSE_STOREYS + _PARAPET_HEIGHT_M)
    house = Block(x, y, z, _WALL_COLORS[0], facade=True)
    return Prop(FIRST_BUILDING, (house,))


def _draw_quadrant(rng: np.random.Generator, spec: RoadSpec, signs: Corner) -> Iterator[Block]:
    """Draw random houses in the quadrant where x and y have the given signs."""
    start_x, start_y = spec.sidewalk_edge + rng.uniform(*_SETBACKS, 2)
    length_x, length_y = rng.uniform(15, 22, 2)
    end_x = start_x + length_x
    end_y = start_y + length_y
    yield _draw_house(rng, (start_x, end_x), (start_y, end_y), signs, storeys=(3, 6))
    for span, depth in _draw_row(rng, spec, end_x, end_y):
        yield _draw_house(rng, span, depth, signs)
    for span, depth in _draw_row(rng, spec, end_y, end_x):
        yield _draw_house(rng, depth, span, signs)


def _draw_closed_side(rng: np.random.Generator, spec: RoadSpec) -> Block:
    """Draw a house where a three-way junction has no arm, between the corner houses."""
    front = spec.sidewalk_edge + rng.uniform(*_SETBACKS)
    back = front + rng.uniform(9, 14)
    half_length = spec.sidewalk_edge + _SETBACKS[0] - 1.5
    return _draw_house(rng, center_span(half_length), (front, back), (1, 1), storeys=(2, 4))


def _draw_row(
    rng: np.random.Generator, spec: RoadSpec, start: float, max_depth: float
) -> Iterator[tuple[Span, Span]]:
    """Draw houses side by side.

    Args:
        rng: Generator of random numbers.
        spec: The road.
        start: Distance from the junction's middle at which the row starts, metres.
        max_depth: Largest distance from the road's middle line to the back of a house, metres.

    Yields:
        Extent of each house along the road, and away from the road, metres.
    """
    position = start + rng.uniform(1.5, 6)
    while position < _ROW_END_M:
        length = rng.uniform(10, 20)
        front = spec.sidewalk_edge + rng.uniform(*_SETBACKS)
        back = min(front + rng.uniform(9, 14), max_depth)
        yield (position, position + length), (front, back)
        position += length + rng.uniform(1, 7)


def _draw_house(
    rng: np.random.Generator,
    x: Span,
    y: Span,
    signs: Corner,
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
    height = STOREY * int(rng.integers(*storeys)) + _PARAPET_HEIGHT_M
    wall_color = _WALL_COLORS[rng.integers(len(_WALL_COLORS))]
    x = _mirror_span(x, signs[0])
    y = _mirror_span(y, signs[1])
    return Block(x, y, (-BASEMENT, height), wall_color, facade=True)


def _mirror_span(span: Span, sign: int) -> Span:
    """Return a span, mirrored if the sign is negative."""
    start = sign * float(span[0])
    end = sign * float(span[1])
    return min(start, end), max(start, end)


def _find_signal_heads(junction: Junction, lights: list[Prop]) -> tuple[SignalHead, ...]:
    """Return the lamps of the arms' traffic lights, the first solids of the world."""
    heads = []
    end = 0
    for arm, light in zip(junction.arms, lights, strict=False):
        end += len(light.blocks)
        # The lamps are the last blocks of a light.
        heads.append(SignalHead(arm=arm, rows=(end - 3, end - 2, end - 1)))
    return tuple(heads)


def _draw_pole_corner(
    rng: np.random.Generator, junction: Junction, between: tuple[Arm, Arm]
) -> Corner:
    """Draw one of the corners nearest to two arms.

    A three-way junction has corners only in the south.
    """
    y_signs = (1, -1) if "north" in junction.arms else (-1,)
    toward_arms = np.sum([OUTWARD[arm] for arm in between], axis=0)
    nearness_by_corner = {}
    for corner in product((1, -1), y_signs):
        nearness_by_corner[corner] = int(toward_arms @ corner)
    max_nearness = max(nearness_by_corner.values())
    nearest = [corner for corner, value in nearness_by_corner.items() if value == max_nearness]
    return nearest[int(rng.random() * len(nearest))]


def _find_common_corner(junction: Junction, arms: tuple[Arm, Arm]) -> Corner:
    """Return the corner between two arms; raise ConfigError if they do not share one."""
    (x_a, y_a), (x_b, y_b) = (OUTWARD[arm] for arm in arms)
    corner = (x_a + x_b, y_a + y_b)
    if 0 in corner or not set(arms) <= set(junction.arms):
        raise ConfigError(
            f"between: the arms {arms[0]} and {arms[1]} of a {junction.spec.kind} junction have no "
            f"corner in common; choose two neighbours of {', '.join(junction.arms)}"
        )
    return corner


def _draw_pose(rng: np.random.Generator, terrain: Terrain) -> SE3:
    """Draw a pose of the ground, up to several hundred metres from the town's origin.

    The pose has any direction, and lies on a gentle slope if the ground has no hump.
    """
    slope = rng.uniform(0, _MAX_SLOPE)
    uphill = rng.uniform(-np.pi, np.pi)
    yaw = rng.uniform(-np.pi, np.pi)
    if not terrain.is_flat:
        slope = 0.0
    half_slope = slope / 2
    pitch = SE3.from_quaternion((np.cos(half_slope), 0.0, np.sin(half_slope), 0.0))
    direction = SE3.from_yaw(uphill)
    tilt = direction @ pitch @ direction.inverse()
    position = rng.uniform((-400, -400, -2), (400, 400, 8))
    return SE3.from_rotation(np.eye(3), position) @ tilt @ SE3.from_yaw(yaw)
