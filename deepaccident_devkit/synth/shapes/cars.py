"""Cars: saloon, hatchback and off-roader."""

from dataclasses import dataclass

from deepaccident_devkit.synth.shapes.parts import DARK, Frame, lamps, mirrors, plates, wheels
from deepaccident_devkit.synth.solids import FRONT, LEFT, REAR, RIGHT, Block

_ALL_AROUND = (FRONT, REAR, LEFT, RIGHT)
_BODY = 0.94
"""Of the label box's half width: mirrors take the rest."""


@dataclass(frozen=True, slots=True)
class _Line:
    """The side view of a car, in shares of its half length and of its height.

    Attributes:
        waist: height of the windows' lower edge.
        cabin: from, to: the windows' lower edge.
        roof: from, to: the roof.
        boot: from, to: the boot's lid behind the cabin; None where the cabin ends the car.
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
    """Three boxes."""
    return _car(frame, _SALOON)


def hatchback(frame: Frame) -> list[Block]:
    """Two boxes."""
    return _car(frame, _HATCHBACK)


def off_roader(frame: Frame) -> list[Block]:
    """Two boxes, steep and on large wheels, with rails on the roof."""
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
