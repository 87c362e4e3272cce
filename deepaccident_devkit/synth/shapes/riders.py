"""Two-wheelers with their riders, and people on foot."""

from deepaccident_devkit.synth.shapes.parts import DARK, LAMP, SKIN, TAIL, Frame, wheel
from deepaccident_devkit.synth.solids import Block, Color

_LIMB = 0.045
"""Half the thickness of arms and legs, metres."""


def motorcycle(frame: Frame) -> list[Block]:
    """A motorcycle and its rider, who sits upright."""
    x = frame.x
    return [
        *_two_wheels(x, 0.32, 0.07),
        Block((-0.5 * x, 0.42 * x), (-0.15, 0.15), (0.34, 0.7), frame.color, inset=(0.12, 0.05, 0.03)),
        Block((-0.05 * x, 0.36 * x), (-0.16, 0.16), (0.7, 0.92), frame.color, inset=(0.1, 0.12, 0.05)),
        Block((-0.78 * x, -0.1 * x), (-0.12, 0.12), (0.7, 0.8), DARK, inset=(0.0, 0.06, 0.02)),
        _fork(0.72 * x, 0.3, 0.98),
        _handlebar(0.38 * x, frame.y, 0.98),
        Block((0.44 * x, 0.54 * x), (-0.09, 0.09), (0.8, 0.94), LAMP, main=False),
        Block((-0.82 * x, -0.76 * x), (-0.06, 0.06), (0.72, 0.8), TAIL, main=False),
        *_rider(frame, seat=-0.2 * x, low=0.8, reach=0.5 * x, helmet=DARK),
    ]


def scooter(frame: Frame) -> list[Block]:
    """A scooter with a shield before its rider's knees."""
    x = frame.x
    return [
        *_two_wheels(x, 0.26, 0.06),
        Block((-0.85 * x, -0.1 * x), (-0.17, 0.17), (0.38, 0.76), frame.color, inset=(0.1, 0.06, 0.04)),
        Block((-0.12 * x, 0.5 * x), (-0.15, 0.15), (0.26, 0.36), frame.color),
        Block((0.46 * x, 0.54 * x), (-0.22, 0.22), (0.32, 0.95), frame.color, inset=(0.1, -0.1, 0.05)),
        Block((-0.7 * x, -0.1 * x), (-0.13, 0.13), (0.76, 0.82), DARK),
        _handlebar(0.4 * x, frame.y, 0.98),
        Block((0.44 * x, 0.52 * x), (-0.08, 0.08), (0.82, 0.94), LAMP, main=False),
        Block((-0.87 * x, -0.8 * x), (-0.08, 0.08), (0.6, 0.7), TAIL, main=False),
        *_rider(frame, seat=-0.3 * x, low=0.82, reach=0.45 * x, helmet=(220, 220, 216)),
    ]


def cyclist(frame: Frame) -> list[Block]:
    """A bicycle and its rider, who leans forward."""
    x = frame.x
    return [
        *_two_wheels(x, 0.33, 0.025),
        Block((-0.1 * x, 0.42 * x), (-0.025, 0.025), (0.44, 0.5), frame.color, inset=(-0.1, -0.02, 0.0), main=False),
        Block((-0.2 * x, 0.5 * x), (-0.025, 0.025), (0.74, 0.8), frame.color, main=False),
        Block((-0.22 * x, -0.16 * x), (-0.03, 0.03), (0.36, 0.92), DARK, inset=(0.1, -0.1, 0.0), main=False),
        _fork(0.62 * x, 0.3, 1.0),
        _handlebar(0.46 * x, frame.y, 1.0),
        *_rider(frame, seat=-0.28 * x, low=0.9, reach=0.5 * x, helmet=(226, 228, 230)),
    ]


def walker(frame: Frame) -> list[Block]:
    """A person in the middle of a long step, with swinging arms."""
    return _person(frame, stride=frame.x - _LIMB)


def stroller(frame: Frame) -> list[Block]:
    """A person with a short step and a bag on the back."""
    y, top = frame.y, frame.top
    bag = Block((-frame.x, -0.4 * frame.x), (-0.6 * y, 0.6 * y), (0.56 * top, 0.78 * top), DARK, inset=(0, 0.02, 0.02))
    return [*_person(frame, stride=0.5 * frame.x), bag]


def _person(frame: Frame, stride: float) -> list[Block]:
    y, top, color = frame.y, frame.top, frame.color
    hip, neck = 0.48 * top, 0.85 * top
    reach = min(0.62 * frame.x, 0.12)
    return [
        _limb(stride, (0.015, 0.14), (0.03, hip), frame.accent),
        _limb(-stride, (-0.14, -0.015), (0.03, hip), frame.accent),
        Block((-reach, reach), (-0.72 * y, 0.72 * y), (hip, neck), color, inset=(0.02, 0.02, -0.02)),
        _limb(-0.6 * stride, (0.76 * y, y), (0.46 * top, 0.82 * top), color),
        _limb(0.6 * stride, (-y, -0.76 * y), (0.46 * top, 0.82 * top), color),
        Block((-0.05, 0.05), (-0.05, 0.05), (neck, neck + 0.04), SKIN, main=False),
        Block((-0.08, 0.1), (-0.075, 0.075), (neck + 0.03, top - 0.06), SKIN, inset=(0.01, -0.01, -0.01)),
        Block((-0.1, 0.08), (-0.085, 0.085), (top - 0.1, top), DARK, inset=(0.03, 0.03, 0.03)),
    ]


def _rider(frame: Frame, seat: float, low: float, reach: float, helmet: Color) -> list[Block]:
    """A rider at `seat`, `low` metres above the road, with hands `reach` metres ahead of the middle."""
    top, side = frame.top, min(frame.y - 0.02, 0.24)
    neck, lean = top - 0.27, min(0.22, 0.4 * (reach - seat))
    shoulder = seat + lean
    arms = ((side - 0.08, side), (-side, -side + 0.08))
    hand = 1.0 if neck > 1.1 else 0.9 * neck
    return [
        Block(
            (seat - 0.14, seat + 0.12), (-side + 0.05, side - 0.05), (low, neck), frame.accent, inset=(-lean, lean, 0.0)
        ),
        *(
            Block((seat, seat + 0.15), across, (0.36, low + 0.08), DARK, inset=(-0.06, -0.02, 0.0))
            for across in ((0.05, min(side, 0.16)), (-min(side, 0.16), -0.05))
        ),
        *(
            Block(
                (reach - 0.1, reach),
                across,
                (hand - 0.04, neck - 0.04),
                frame.accent,
                inset=(reach - shoulder - 0.1, shoulder - reach + 0.1, 0.0),
                main=False,
            )
            for across in arms
        ),
        Block((shoulder - 0.08, shoulder + 0.14), (-0.1, 0.1), (neck, top - 0.14), SKIN, main=False),
        Block((shoulder - 0.12, shoulder + 0.14), (-0.12, 0.12), (top - 0.18, top), helmet, inset=(0.05, 0.05, 0.04)),
    ]


def _limb(end: float, y: tuple[float, float], z: tuple[float, float], color: Color) -> Block:
    """An arm or a leg from the body's middle down to `end` metres ahead of it."""
    return Block((end - _LIMB, end + _LIMB), y, z, color, inset=(end, -end, 0.0))


def _two_wheels(x: float, radius: float, half_width: float) -> list[Block]:
    across = (-half_width, half_width)
    return [block for axle in (x - radius, radius - x) for block in wheel(axle, across, radius, main=True)]


def _fork(x: float, low: float, high: float) -> Block:
    return Block((x - 0.03, x + 0.03), (-0.05, 0.05), (low, high), DARK, inset=(0.16, -0.16, 0.0), main=False)


def _handlebar(x: float, y: float, height: float) -> Block:
    return Block((x - 0.03, x + 0.03), (-y, y), (height - 0.03, height + 0.03), DARK, main=False)
