"""What all shapes have in common: colours, clearances, wheels and lamps."""

from dataclasses import dataclass

from deepaccident_devkit.synth.solids import Block, Color

BOX_CLEARANCE = 0.02
"""Metres from the road to the bottom of every label box, so that no point of the ground lies in a box."""
INSET = 0.01
"""Metres between a label box and what it holds, so that rounding moves no point out of its box."""

TIRE: Color = (34, 34, 36)
RIM: Color = (150, 152, 156)
LAMP: Color = (250, 246, 215)
"""The colour of headlamps."""
TAIL: Color = (190, 24, 24)
"""The colour of tail lamps."""
SKIN: Color = (214, 168, 138)
DARK: Color = (48, 50, 56)
PLATE: Color = (232, 232, 224)


@dataclass(frozen=True, slots=True)
class Frame:
    """The space that a shape may fill, and its two colours.

    Attributes:
        x: half the length, metres.
        y: half the width, metres.
        top: the height above the road, metres.
        color: the colour of paint or clothes.
        accent: the second colour.
    """

    x: float
    y: float
    top: float
    color: Color
    accent: Color


def wheels(axles: tuple[float, ...], y: float, radius: float, width: float = 0.22) -> list[Block]:
    """Wheels on both sides, whose outer faces are `y` metres from the middle."""
    sides = ((y - width, y), (-y, -y + width))
    return [block for axle in axles for side in sides for block in wheel(axle, side, radius, main=False)]


def wheel(axle: float, across: tuple[float, float], radius: float, *, main: bool) -> tuple[Block, Block, Block]:
    """A wheel of three blocks: two that give the tyre six corners, seen from the side, and a rim."""
    middle, cut, rim = 0.03 + radius, 0.5 * radius, 0.52 * radius
    upper = Block(
        (axle - radius, axle + radius), across, (middle, middle + radius), TIRE, inset=(cut, cut, 0.0), main=main
    )
    lower = Block((axle - cut, axle + cut), across, (middle - radius, middle), TIRE, inset=(-cut, -cut, 0.0), main=main)
    beyond = (across[0] - 0.008, across[1] + 0.008)
    hub = Block((axle - rim, axle + rim), beyond, (middle - rim, middle + rim), RIM, main=False)
    return upper, lower, hub


def lamps(x: float, side: float, height: float, depth: float = 0.3) -> list[Block]:
    """Two headlamps and two tail lamps, whose faces are `x` metres ahead of and behind the middle."""
    z = (height, height + 0.13)
    across = ((side - 0.45, side - 0.08), (-side + 0.08, -side + 0.45))
    front = [Block((x - depth, x), y, z, LAMP, main=False) for y in across]
    rear = [Block((-x, -x + depth), y, z, TAIL, main=False) for y in across]
    return front + rear


def plates(x: float, height: float) -> list[Block]:
    """A number plate in front and one behind."""
    z = (height, height + 0.11)
    return [
        Block((x - 0.1, x), (-0.26, 0.26), z, PLATE, main=False),
        Block((-x, -x + 0.1), (-0.26, 0.26), z, PLATE, main=False),
    ]


def mirrors(x: float, body: float, y: float, height: float, color: Color) -> list[Block]:
    """Mirrors between the body's side and `y` metres from the middle."""
    z = (height, height + 0.14)
    sides = ((body - 0.02, y), (-y, -body + 0.02))
    return [Block((x - 0.06, x + 0.1), side, z, color, inset=(0.04, 0.0, 0.0), main=False) for side in sides]
