"""Vehicles with four wheels or more: saloon, hatchback and off-roader, vans and trucks."""

from dataclasses import dataclass

from deepaccident_devkit.synth import solids
from deepaccident_devkit.synth.shapes.parts import DARK, Frame, lamps, mirrors, plates, wheels
from deepaccident_devkit.synth.solids import FRONT, LEFT, REAR, RIGHT, Block

_ALL_AROUND = (FRONT, REAR, LEFT, RIGHT)
_BODY = 0.94
"""The share of the label box's half width that the body has; mirrors have the rest."""


@dataclass(frozen=True, slots=True)
class _Line:
    """The side view of a car, in shares of its half length and of its height.

    Attributes:
        waist: height of the windows' lower edge.
        cabin: where the windows' lower edge begins and ends.
        roof: where the roof begins and ends.
        boot: where the boot's lid behind the cabin begins and ends; None if the cabin is the rear end of the car.
        wheel: radius of the wheels, metres.
        sill: height of the body's lower edge, metres.
    """

    waist: float
    cabin: tuple[float, float]
    roof: tuple[float, float]
    boot: tuple[float, float] | None
    wheel: float
    sill: float


_SALOON = _Line(0.6, (-0.84, 0.45), (-0.6, 0.16), (-0.98, -0.76), 0.32, 0.2)
_HATCHBACK = _Line(0.6, (-0.94, 0.5), (-0.74, 0.1), None, 0.31, 0.2)
_OFF_ROADER = _Line(0.58, (-0.96, 0.44), (-0.86, 0.16), None, 0.36, 0.27)


def saloon(frame: Frame) -> list[Block]:
    """A car of three boxes: bonnet, cabin, boot."""
    return _car(frame, _SALOON)


def hatchback(frame: Frame) -> list[Block]:
    """A car of two boxes: bonnet, cabin."""
    return _car(frame, _HATCHBACK)


def off_roader(frame: Frame) -> list[Block]:
    """A steep car of two boxes on large wheels, with rails on the roof."""
    x, top = frame.x, frame.top
    rails = [Block((-0.7 * x, 0.05 * x), y, (top - 0.05, top), DARK, main=False) for y in ((0.5, 0.56), (-0.56, -0.5))]
    return [*_car(frame, _OFF_ROADER), *rails]


def _car(frame: Frame, line: _Line) -> list[Block]:
    x, body, top, color = frame.x, _BODY * frame.y, frame.top, frame.color
    waist, roof = line.waist * top, top - 0.05
    between = waist + 0.6 * (roof - waist)
    (rear, front), (roof_rear, roof_front) = ((share * x for share in span) for span in (line.cabin, line.roof))
    upper = 0.6
    blocks = [
        Block(
            (-x + 0.06, x - 0.06), (-body + 0.05, body - 0.05), (line.sill, 0.42), color, inset=(-0.05, -0.05, -0.05)
        ),
        Block((-x + 0.01, x - 0.01), (-body, body), (0.42, waist), color, inset=(0.16, 0.07, 0.05)),
        Block(
            (rear, front),
            (-body + 0.08, body - 0.08),
            (waist, between),
            color,
            glass=_ALL_AROUND,
            inset=(upper * (front - roof_front), upper * (roof_rear - rear), 0.09),
        ),
        Block(
            (rear + upper * (roof_rear - rear), front - upper * (front - roof_front)),
            (-body + 0.17, body - 0.17),
            (between, roof),
            color,
            glass=_ALL_AROUND,
            inset=((1 - upper) * (front - roof_front), (1 - upper) * (roof_rear - rear), 0.1),
        ),
        Block((roof_rear, roof_front), (-body + 0.26, body - 0.26), (roof, top), color, inset=(0.12, 0.12, 0.1)),
        Block((0.9 * front, x - 0.2), (-body + 0.12, body - 0.12), (waist, waist + 0.05), color, inset=(0.25, 0, 0.1)),
        Block((x - 0.1, x - 0.01), (-0.5 * body, 0.5 * body), (0.27, 0.39), DARK, main=False),
        *_pillars(0.5 * (roof_rear + roof_front), body - 0.09, waist, roof, frame),
        *mirrors(0.72 * front, body - 0.06, frame.y, waist + 0.02, color),
        *wheels((0.62 * x, -0.6 * x), body, line.wheel),
        *lamps(x - 0.02, body, 0.72 * waist),
        *plates(x, 0.45),
    ]
    if line.boot:
        lid = (line.boot[0] * x, line.boot[1] * x)
        blocks.append(Block(lid, (-body + 0.1, body - 0.1), (waist, waist + 0.06), color, inset=(0, 0.08, 0.08)))
    return blocks


def _pillars(x: float, side: float, waist: float, roof: float, frame: Frame) -> list[Block]:
    """An upright post between the side windows, left and right."""
    outer = ((side - 0.04, side + 0.005), (-side - 0.005, -side + 0.04))
    return [Block((x - 0.05, x + 0.05), across, (waist, roof), frame.color, main=False) for across in outer]


_VAN_BODY = 0.95
"""The same share for vans and trucks."""


def delivery_van(frame: Frame) -> list[Block]:
    """A van with windows only in front."""
    return _van(frame, panes=((0.14, 0.4),))


def minibus(frame: Frame) -> list[Block]:
    """A van with windows along its whole length."""
    return _van(frame, panes=((0.14, 0.4), (-0.4, 0.06), (-0.88, -0.48)))


def box_truck(frame: Frame) -> list[Block]:
    """A cab and a large box."""
    x, y, top = frame.x, _VAN_BODY * frame.y, frame.top
    box = Block((-x, 0.52 * x), (-y, y), (0.95, top), frame.accent, inset=(0.02, 0.02, 0.02))
    return [*_chassis(frame, 0.76 * top), box]


def tank_truck(frame: Frame) -> list[Block]:
    """A cab and a tank with eight sides."""
    x, y, top = frame.x, _VAN_BODY * frame.y, 0.82 * frame.top
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
    x, y, top, color = frame.x, _VAN_BODY * frame.y, frame.top, frame.color
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
    x, y = frame.x, _VAN_BODY * frame.y
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
