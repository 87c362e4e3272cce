"""Buildings around a junction: corner houses, rows along the arms, and one on the kerb that hides traffic."""

from collections.abc import Iterator

import numpy as np

from deepaccident_devkit.synth.roads import FIRST_BUILDING, RoadSpec
from deepaccident_devkit.synth.solids import Block, Color
from deepaccident_devkit.synth.stage.furniture import KERB_INSET
from deepaccident_devkit.synth.stage.props import BASEMENT, Prop

Span = tuple[float, float]

STOREY = 3.2
"""Height of a storey, metres."""
_WALLS: tuple[Color, ...] = (
    (176, 122, 96), (206, 190, 160), (170, 170, 166), (148, 100, 82), (220, 214, 200), (140, 150, 158), (190, 160, 128),
)  # fmt: skip
_SETBACK = (2.5, 4.6)
"""Metres from the sidewalk to the fronts."""
_LAST = 110.0
_KERB_HOUSE_LENGTH = 20.5
_KERB_HOUSE_STOREYS = 3
_MAST_ROOM = 0.25
"""Metres from the middle of a mast to the house on the kerb behind it."""
_CODES = 240


def houses(rng: np.random.Generator, spec: RoadSpec) -> list[Prop]:
    """A corner building in each quadrant and a row of houses along each of its two sides."""
    blocks = [block for sign_x in (1, -1) for sign_y in (1, -1) for block in _quadrant(rng, spec, sign_x, sign_y)]
    if spec.kind == "three-way":
        blocks += _closed_side(rng, spec)
    return [_building(number, block) for number, block in enumerate(blocks)]


def kerb_house(spec: RoadSpec, corner: tuple[int, int]) -> Prop:
    """The house on the kerb of a corner, given by its signs of x and y: it hides the traffic behind it.

    Between it and the road there is only room for a mast.
    """
    near = spec.road_edge + KERB_INSET + _MAST_ROOM
    kept = spec.kerb_radius - KERB_INSET - _MAST_ROOM
    near = max(near, spec.road_edge + spec.kerb_radius - kept / float(np.sqrt(2)))
    x, y = (_mirrored((near, near + _KERB_HOUSE_LENGTH), sign) for sign in corner)
    wall = _WALLS[0]
    return Prop(FIRST_BUILDING, (Block(x, y, (-BASEMENT, STOREY * _KERB_HOUSE_STOREYS + 0.8), wall, facade=True),))


def _quadrant(rng: np.random.Generator, spec: RoadSpec, sign_x: int, sign_y: int) -> Iterator[Block]:
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


def _row(rng: np.random.Generator, spec: RoadSpec, start: float, deepest: float) -> Iterator[tuple[Span, Span]]:
    """Houses side by side from `start`: their extents along the road and away from it."""
    position = start + rng.uniform(1.5, 6)
    while position < _LAST:
        length, front = rng.uniform(10, 20), spec.sidewalk_edge + rng.uniform(*_SETBACK)
        yield (position, position + length), (front, min(front + rng.uniform(9, 14), deepest))
        position += length + rng.uniform(1, 7)


def _house(
    rng: np.random.Generator, x: Span, y: Span, signs: tuple[int, int], storeys: tuple[int, int] = (2, 5)
) -> Block:
    """A house of the first quadrant, mirrored into another."""
    height = STOREY * int(rng.integers(*storeys)) + 0.8
    wall = _WALLS[rng.integers(len(_WALLS))]
    return Block(_mirrored(x, signs[0]), _mirrored(y, signs[1]), (-BASEMENT, height), wall, facade=True)


def _mirrored(span: Span, sign: int) -> Span:
    low, high = sorted((sign * float(span[0]), sign * float(span[1])))
    return low, high


def _building(number: int, block: Block) -> Prop:
    return Prop(FIRST_BUILDING + number % _CODES, (block,))
