"""What stands still: the ground with its roads, buildings that hide what comes, trees, lights and the pole."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.synth import roads, solids
from deepaccident_devkit.synth.roads import GroundMap
from deepaccident_devkit.synth.solids import Block, Color, Solids

_MAX_SLOPE = np.deg2rad(3.0)
_WALLS: tuple[Color, ...] = (
    (176, 122, 96), (206, 190, 160), (170, 170, 166), (148, 100, 82), (220, 214, 200), (140, 150, 158), (190, 160, 128),
)  # fmt: skip
_BARK: Color = (92, 72, 54)
_LEAVES: tuple[Color, ...] = ((70, 116, 54), (88, 132, 62), (58, 100, 58))
_STEEL: Color = (92, 96, 100)
_LAMPS: tuple[Color, ...] = ((210, 40, 36), (226, 180, 48), (48, 190, 84))
_POLE_PLACE = roads.ROAD_EDGE + 0.3
_LAMP_PLACE = 11.5
_KERB_HOUSE = (_POLE_PLACE + 0.25, 27.0)
"""From, to: metres from the junction's middle, along each arm, of a house that hides what comes round its corner;
there is just room for a mast between it and the road."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class World:
    """Everything that stays as it is over a scenario, in the ground frame.

    Attributes:
        world_from_ground: where the junction lies in the town, and how it slopes.
        ground: the roads; what images and points on the ground see.
        top: the ground with all that stands on it: what the BEV camera sees.
        props: buildings, trees, poles.
        lidar_pole: the pole's sensor frame: `ground_from_lidar` of the infrastructure agent.
    """

    world_from_ground: SE3
    ground: GroundMap
    top: GroundMap
    props: Solids
    lidar_pole: SE3


@dataclass(frozen=True, slots=True)
class HidingPlace:
    """Which corner house stands on the kerb, so that it hides what comes round it; corners by their signs of x and y.

    Attributes:
        house: the corner of the house.
        pole: the corner of the infrastructure's pole, which looks past it.
    """

    house: tuple[int, int]
    pole: tuple[int, int]

    @property
    def block(self) -> Block:
        """The house."""
        x, y = (sorted((sign * _KERB_HOUSE[0], sign * _KERB_HOUSE[1])) for sign in self.house)
        return Block((x[0], x[1]), (y[0], y[1]), (-0.2, 3.2 * 3 + 0.8), _WALLS[0], facade=True)


@dataclass(frozen=True, slots=True)
class _Prop:
    """Blocks with the code they have on the map from above."""

    code: int
    blocks: tuple[Block, ...]


def random_world(rng: np.random.Generator, *, signalized: bool, hiding: HidingPlace | None = None) -> World:
    """A crossing in a town.

    Args:
        rng: random numbers; what does not concern a hiding place is the same with it and without.
        signalized: with traffic lights.
        hiding: a house on the kerb; None for a wide view.
    """
    world_from_ground = _random_place(rng)
    buildings, trees = list(_buildings(rng)), list(_trees(rng))
    corner = rng.choice([-1, 1], 2)
    if hiding is not None:
        buildings, trees = _with_house(hiding.block, buildings, trees)
        corner = np.array(hiding.pole)
    props = [
        *(_Prop(roads.TREE, blocks) for blocks in trees),
        *(_Prop(roads.FIRST_BUILDING + k, (block,)) for k, block in enumerate(buildings)),
    ]
    height = float(rng.uniform(3.0, 5.0))
    x, y = (corner * _POLE_PLACE).tolist()
    props.append(_Prop(roads.POLE, (_mast(x, y, height - 0.4),)))
    if signalized:
        props += [_Prop(roads.POLE, blocks) for blocks in _traffic_lights()]
    ground = roads.crossing()
    return World(
        world_from_ground=world_from_ground,
        ground=ground,
        top=_top_map(ground, props),
        props=solids.build([block for prop in props for block in prop.blocks]),
        lidar_pole=SE3.from_yaw(float(np.arctan2(-y, -x)), (x, y, height)),
    )


def _with_house(
    house: Block, buildings: Sequence[Block], trees: Sequence[tuple[Block, ...]]
) -> tuple[list[Block], list[tuple[Block, ...]]]:
    """Buildings and trees, with a house in the place of those that stand where it does."""
    others = [block for block in buildings if not _overlap(block, house)]
    return [house, *others], [tree for tree in trees if not any(_overlap(block, house) for block in tree)]


def _overlap(first: Block, second: Block) -> bool:
    return all(a[0] < b[1] and b[0] < a[1] for a, b in ((first.x, second.x), (first.y, second.y)))


def _random_place(rng: np.random.Generator) -> SE3:
    """Some hundred metres off the town's origin, turned any way, on a gentle slope."""
    slope, uphill, yaw = rng.uniform(0, _MAX_SLOPE), rng.uniform(-np.pi, np.pi), rng.uniform(-np.pi, np.pi)
    across = SE3.from_quaternion((np.cos(slope / 2), 0.0, np.sin(slope / 2), 0.0))
    direction = SE3.from_yaw(uphill)
    tilt = direction @ across @ direction.inverse()
    x, y, z = rng.uniform((-400, -400, -2), (400, 400, 8))
    return SE3.from_rotation(np.eye(3), (x, y, z)) @ tilt @ SE3.from_yaw(yaw)


def _buildings(rng: np.random.Generator) -> Iterator[Block]:
    """A corner building in each quadrant and a row of houses along each of its two arms."""
    for sign_x in (1, -1):
        for sign_y in (1, -1):
            setback = rng.uniform(11.4, 13.5, 2)
            corner = rng.uniform(15, 22, 2)
            end = setback + corner
            yield _house(rng, (setback[0], end[0]), (setback[1], end[1]), sign_x, sign_y, storeys=(3, 6))
            for span, front in _row(rng, end[0], end[1]):
                yield _house(rng, span, front, sign_x, sign_y)
            for span, front in _row(rng, end[1], end[0]):
                yield _house(rng, front, span, sign_x, sign_y)


def _row(
    rng: np.random.Generator, start: float, deepest: float
) -> Iterator[tuple[tuple[float, float], tuple[float, float]]]:
    """Houses side by side from `start` on: extents along the road and away from it."""
    position = start + rng.uniform(1.5, 6)
    while position < 110:
        length, front = rng.uniform(10, 20), rng.uniform(11.4, 14)
        yield (position, position + length), (front, min(front + rng.uniform(9, 14), deepest))
        position += length + rng.uniform(1, 7)


def _house(
    rng: np.random.Generator,
    x: tuple[float, float],
    y: tuple[float, float],
    sign_x: int,
    sign_y: int,
    storeys: tuple[int, int] = (2, 5),
) -> Block:
    """A house of the first quadrant, mirrored into another."""
    x0, x1 = sorted((float(sign_x * x[0]), float(sign_x * x[1])))
    y0, y1 = sorted((float(sign_y * y[0]), float(sign_y * y[1])))
    height = 3.2 * int(rng.integers(*storeys)) + 0.8
    wall = _WALLS[rng.integers(len(_WALLS))]
    return Block((x0, x1), (y0, y1), (-0.2, height), wall, facade=True)


def _trees(rng: np.random.Generator) -> Iterator[tuple[Block, ...]]:
    """Trees between sidewalk and houses, in the gaps of a regular row."""
    for along in np.arange(18.0, 100.0, 13.0):
        for sign_a in (1, -1):
            for sign_b in (1, -1):
                if rng.random() < 0.55:
                    spot = np.array([sign_a * (along + rng.uniform(-2, 2)), sign_b * 10.1])
                    yield _tree(rng, *(spot if rng.random() < 0.5 else spot[::-1]).tolist())


def _tree(rng: np.random.Generator, x: float, y: float) -> tuple[Block, ...]:
    leaves, top = _LEAVES[rng.integers(len(_LEAVES))], float(rng.uniform(4.0, 5.6))
    crown = ((x - 1.1, x + 1.1), (y - 1.1, y + 1.1))
    return (
        Block((x - 0.14, x + 0.14), (y - 0.14, y + 0.14), (-0.1, 2.3), _BARK),
        Block(*crown, (2.2, 3.3), leaves, inset=(-0.1, -0.1, -0.1)),
        Block((x - 1.15, x + 1.15), (y - 1.15, y + 1.15), (3.3, top), leaves, inset=(0.7, 0.7, 0.7)),
    )


def _traffic_lights() -> Iterator[tuple[Block, ...]]:
    """A mast with three lamps at the right of each stop line, facing who waits there."""
    place = np.array([-_LAMP_PLACE, -_POLE_PLACE])
    for quarter in range(4):
        turn = np.array([[0, -1], [1, 0]])
        facing = np.linalg.matrix_power(turn, quarter) @ (-1, 0)
        x, y = (np.linalg.matrix_power(turn, quarter) @ place).tolist()
        lamps = (
            _lamp(x + 0.1 * facing[0], y + 0.1 * facing[1], 3.35 - 0.3 * row, color) for row, color in enumerate(_LAMPS)
        )
        yield (_mast(x, y, 2.4), replace(_lamp(x, y, 3.05, _STEEL), z=(2.4, 3.6)), *lamps)


def _mast(x: float, y: float, top: float) -> Block:
    return Block((x - 0.09, x + 0.09), (y - 0.09, y + 0.09), (-0.1, top), _STEEL)


def _lamp(x: float, y: float, z: float, color: Color) -> Block:
    return Block((x - 0.14, x + 0.14), (y - 0.14, y + 0.14), (z - 0.1, z + 0.1), color)


def _top_map(ground: GroundMap, props: Sequence[_Prop]) -> GroundMap:
    """The map from above: lower things first, so that higher ones cover them."""
    flat = [(block.z[1], prop.code, (*block.x, *block.y)) for prop in props for block in prop.blocks]
    flat.sort(key=lambda entry: entry[0])
    return ground.with_rectangles(
        np.array([extent for _, _, extent in flat]), np.array([code for _, code, _ in flat], dtype=np.uint8)
    )
