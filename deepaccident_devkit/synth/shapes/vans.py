"""Vans and trucks."""

from deepaccident_devkit.synth import solids
from deepaccident_devkit.synth.shapes.parts import DARK, Frame, lamps, mirrors, plates, wheels
from deepaccident_devkit.synth.solids import FRONT, LEFT, REAR, RIGHT, Block

_BODY = 0.95
"""Of the label box's half width: mirrors take the rest."""


def delivery_van(frame: Frame) -> list[Block]:
    """A van with panes in front alone."""
    return _van(frame, panes=((0.14, 0.4),))


def minibus(frame: Frame) -> list[Block]:
    """A van with panes all along."""
    return _van(frame, panes=((0.14, 0.4), (-0.4, 0.06), (-0.88, -0.48)))


def box_truck(frame: Frame) -> list[Block]:
    """A cab and a large box."""
    x, y, top = frame.x, _BODY * frame.y, frame.top
    box = Block((-x, 0.52 * x), (-y, y), (0.95, top), frame.accent, inset=(0.02, 0.02, 0.02))
    return [*_chassis(frame, 0.76 * top), box]


def tank_truck(frame: Frame) -> list[Block]:
    """A cab and a tank with eight sides."""
    x, y, top = frame.x, _BODY * frame.y, 0.82 * frame.top
    low, high = 0.95 + 0.28 * (top - 0.95), top - 0.28 * (top - 0.95)
    along, narrow = (-x, 0.5 * x), 0.4 * y
    return [
        *_chassis(frame, 0.74 * frame.top),
        Block(along, (-y + narrow, y - narrow), (0.95, low), frame.accent, inset=(0.0, 0.0, -narrow)),
        Block(along, (-y, y), (low, high), frame.accent),
        Block(along, (-y, y), (high, top), frame.accent, inset=(0.0, 0.0, narrow)),
        Block((-0.3 * x, 0.0), (-0.3, 0.3), (top, frame.top), DARK),
    ]


def _van(frame: Frame, panes: tuple[tuple[float, float], ...]) -> list[Block]:
    x, y, top, color = frame.x, _BODY * frame.y, frame.top, frame.color
    waist = 0.52 * top
    sides = ((y - 0.12, y - 0.045), (0.045 - y, 0.12 - y))
    return [
        Block((-x + 0.04, x - 0.06), (-y + 0.05, y - 0.05), (0.22, 0.44), color, inset=(-0.04, -0.02, -0.05)),
        Block((-x + 0.01, x - 0.01), (-y, y), (0.44, waist), color, inset=(0.2, 0.0, 0.03)),
        Block(
            (-x + 0.02, 0.8 * x),
            (-y + 0.03, y - 0.03),
            (waist, top - 0.08),
            color,
            glass=(FRONT,),
            inset=(0.62, 0.05, 0.05),
        ),
        Block((-x + 0.09, 0.78 * x - 0.62), (-y + 0.1, y - 0.1), (top - 0.08, top), color, inset=(0.12, 0.1, 0.12)),
        Block((-x + 0.01, -x + 0.1), (-0.7 * y, 0.7 * y), (waist + 0.1, top - 0.35), solids.GLASS, main=False),
        *(
            Block((span[0] * x, span[1] * x), side, (waist + 0.06, top - 0.34), solids.GLASS, main=False)
            for span in panes
            for side in sides
        ),
        *mirrors(0.5 * x, y - 0.03, frame.y, waist + 0.06, DARK),
        *wheels((0.64 * x, -0.62 * x), y, 0.35),
        *lamps(x - 0.02, y, 0.72 * waist),
        *plates(x, 0.46),
    ]


def _chassis(frame: Frame, cab_top: float) -> list[Block]:
    """Frame, wheels and cab of a truck."""
    x, y = frame.x, _BODY * frame.y
    middle = 0.45 * cab_top + 0.35
    cab = (0.56 * x, x - 0.02)
    return [
        Block((-x + 0.05, 0.9 * x), (-0.8 * y, 0.8 * y), (0.55, 0.95), DARK, main=False),
        Block(cab, (-y + 0.04, y - 0.04), (0.45, middle), frame.color, inset=(0.04, 0.0, 0.0)),
        Block(
            (cab[0], cab[1] - 0.04),
            (-y + 0.04, y - 0.04),
            (middle, cab_top - 0.15),
            frame.color,
            glass=(FRONT, LEFT, RIGHT),
            inset=(0.16, 0.0, 0.05),
        ),
        Block(
            (cab[0], cab[1] - 0.2), (-y + 0.09, y - 0.09), (cab_top - 0.15, cab_top), frame.color, inset=(0.2, 0, 0.1)
        ),
        Block((x - 0.1, x), (-0.6 * y, 0.6 * y), (0.6, 0.95), DARK, glass=(REAR,), main=False),
        *mirrors(cab[1] - 0.3, y - 0.06, frame.y, middle + 0.15, DARK),
        *wheels((0.76 * x, -0.45 * x, -0.75 * x), y, 0.48, 0.3),
        *lamps(x, y - 0.1, 0.66),
    ]
