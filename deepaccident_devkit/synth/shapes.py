"""What each category looks like: solids inside its label box, x forward, origin on the road below the box's centre."""

from collections.abc import Callable

from deepaccident_devkit.synth import solids
from deepaccident_devkit.synth.solids import FRONT, LEFT, REAR, RIGHT, Block, Color, Solids

BOX_CLEARANCE = 0.02
"""Metres from the road to the bottom of every label box: no point of the ground lies in a box."""
INSET = 0.01
"""Metres between a label box and what it holds, so that rounding moves no point out of its box."""

_TIRE: Color = (38, 38, 40)
_LAMP: Color = (250, 246, 215)
_TAIL: Color = (190, 24, 24)
_SKIN: Color = (214, 168, 138)
_DARK: Color = (58, 60, 66)


def shape_of(category: str, size: tuple[float, float, float], color: Color, accent: Color) -> Solids:
    """The solids of an actor with a label box of length, width, height `size`, metres."""
    length, width, height = size
    return solids.build(_BLOCKS[category](length / 2 - INSET, width / 2 - INSET, _top(height), color, accent))


def _top(height: float) -> float:
    return BOX_CLEARANCE + height - INSET


def _car(x: float, y: float, top: float, color: Color, _accent: Color) -> list[Block]:
    waist, side = 0.57 * top, y - 0.03
    return [
        Block((-x + 0.02, x - 0.02), (-side, side), (0.2, waist), color, inset=(0.1, 0.05, 0.04)),
        Block(
            (-0.86 * x, 0.42 * x),
            (-side + 0.06, side - 0.06),
            (waist, top - 0.04),
            color,
            glass=(FRONT, REAR, LEFT, RIGHT),
            inset=(0.62, 0.4, 0.14),
        ),
        Block((-0.86 * x + 0.36, 0.42 * x - 0.58), (-side + 0.18, side - 0.18), (top - 0.05, top), color, main=False),
        *_wheels((0.62 * x, -0.62 * x), y, 0.32),
        *_lamps(x, side, 0.42 * top),
    ]


def _van(x: float, y: float, top: float, color: Color, _accent: Color) -> list[Block]:
    waist, side = 0.5 * top, y - 0.03
    panes = ((side - 0.15, side - 0.05), (0.05 - side, 0.15 - side))
    return [
        Block((-x + 0.02, x - 0.02), (-side, side), (0.22, waist), color, inset=(0.1, 0.0, 0.02)),
        Block(
            (-x + 0.03, 0.72 * x),
            (-side + 0.02, side - 0.02),
            (waist, top),
            color,
            glass=(FRONT,),
            inset=(0.75, 0.08, 0.1),
        ),
        *(
            Block(
                (0.05 * x, 0.36 * x),
                pane,
                (waist + 0.08, top - 0.3),
                solids.GLASS,
                inset=(0.25, 0.0, 0.0),
                main=False,
            )
            for pane in panes
        ),
        *_wheels((0.62 * x, -0.62 * x), y, 0.35),
        *_lamps(x, side, 0.38 * top),
    ]


def _truck(x: float, y: float, top: float, color: Color, accent: Color) -> list[Block]:
    cab_top, side = 0.76 * top, y - 0.02
    return [
        Block((-x + 0.05, 0.9 * x), (-0.8 * y, 0.8 * y), (0.55, 0.95), _DARK, main=False),
        Block((-x, 0.5 * x), (-side, side), (0.95, top), accent),
        Block((0.56 * x, x - 0.02), (-side + 0.05, side - 0.05), (0.45, 0.5 * cab_top + 0.3), color),
        Block(
            (0.56 * x, x - 0.02),
            (-side + 0.05, side - 0.05),
            (0.5 * cab_top + 0.3, cab_top),
            color,
            glass=(FRONT, LEFT, RIGHT),
            inset=(0.25, 0.0, 0.06),
        ),
        *_wheels((0.76 * x, -0.45 * x, -0.75 * x), y, 0.48),
        *_lamps(x, side - 0.1, 0.8),
    ]


def _motorcycle(x: float, y: float, top: float, color: Color, accent: Color) -> list[Block]:
    return [
        *_two_wheels(x, 0.33, 0.07),
        Block((-0.62 * x, 0.62 * x), (-0.14, 0.14), (0.32, 0.86), color, inset=(0.2, 0.05, 0.02)),
        Block((0.36 * x, 0.46 * x), (-y, y), (0.92, 0.98), _DARK, main=False),
        *_rider(-0.15 * x, 0.84, top, min(y - 0.1, 0.26), accent),
    ]


def _cyclist(x: float, y: float, top: float, color: Color, accent: Color) -> list[Block]:
    return [
        *_two_wheels(x, 0.34, 0.03),
        Block((-0.55 * x, 0.5 * x), (-0.04, 0.04), (0.5, 0.62), color, main=False),
        Block((0.5 * x, 0.58 * x), (-y, y), (0.98, 1.02), _DARK, main=False),
        Block((-0.18 * x, 0.12 * x), (-0.12, 0.12), (0.5, 0.92), _DARK, main=False),
        *_rider(-0.12 * x, 0.9, top, y, accent),
    ]


def _pedestrian(x: float, y: float, top: float, color: Color, accent: Color) -> list[Block]:
    hip, neck, leg = 0.47 * top, 0.84 * top, 0.07
    return [
        Block((-0.02, 0.14), (0.02, 0.02 + 2 * leg), (0.03, hip), accent),
        Block((-0.14, 0.02), (-0.02 - 2 * leg, -0.02), (0.03, hip), accent),
        Block((-0.62 * x, 0.62 * x), (-y, y), (hip, neck), color, inset=(0.02, 0.02, 0.03)),
        Block((-0.1, 0.1), (-0.09, 0.09), (neck + 0.02, top), _SKIN),
    ]


def _rider(x: float, seat: float, top: float, half_width: float, color: Color) -> list[Block]:
    neck = top - 0.28
    return [
        Block((x - 0.15, x + 0.15), (-half_width, half_width), (seat, neck), color, inset=(-0.1, 0.1, 0.03)),
        Block((x - 0.02, x + 0.24), (-0.11, 0.11), (neck + 0.02, top), _DARK),
    ]


def _two_wheels(x: float, radius: float, half_width: float) -> list[Block]:
    across = (-half_width, half_width)
    return [block for axle in (x - radius, radius - x) for block in _wheel(axle, across, radius, main=True)]


def _wheels(axles: tuple[float, ...], y: float, radius: float) -> list[Block]:
    sides = ((y - 0.22, y), (-y, -y + 0.22))
    return [block for axle in axles for side in sides for block in _wheel(axle, side, radius, main=False)]


def _wheel(axle: float, across: tuple[float, float], radius: float, *, main: bool) -> tuple[Block, Block]:
    """Two blocks that give a wheel six corners from the side."""
    middle, cut = 0.03 + radius, 0.5 * radius
    upper = Block(
        (axle - radius, axle + radius), across, (middle, middle + radius), _TIRE, inset=(cut, cut, 0.0), main=main
    )
    lower = Block(
        (axle - cut, axle + cut), across, (middle - radius, middle), _TIRE, inset=(-cut, -cut, 0.0), main=main
    )
    return upper, lower


def _lamps(x: float, side: float, height: float) -> list[Block]:
    z = (height, height + 0.13)
    across = ((side - 0.45, side - 0.08), (-side + 0.08, -side + 0.45))
    front = [Block((x - 0.3, x), y, z, _LAMP, main=False) for y in across]
    rear = [Block((-x, -x + 0.3), y, z, _TAIL, main=False) for y in across]
    return front + rear


_BLOCKS: dict[str, Callable[[float, float, float, Color, Color], list[Block]]] = {
    "car": _car,
    "van": _van,
    "truck": _truck,
    "motorcycle": _motorcycle,
    "cyclist": _cyclist,
    "pedestrian": _pedestrian,
}
