"""The shapes of each category: solids that fit into its label box.

Their x axis points forward, their origin is on the road below the box's centre.
"""

from collections.abc import Callable
from dataclasses import dataclass

from deepaccident_devkit.plugins.synth import solids
from deepaccident_devkit.plugins.synth.solids import (
    FRONT,
    LEFT,
    REAR,
    RIGHT,
    Block,
    Color,
    Solids,
    both_sides,
    center_span,
    span_around,
)

BOX_CLEARANCE = 0.02
"""Distance from the road to the bottom of every label box, so that no point of the ground lies in
a box, metres."""
INSET = 0.01
"""Distance between a label box and its solids, so that rounding moves no point out of its box,
metres."""
TIRE: Color = (34, 34, 36)
RIM: Color = (150, 152, 156)
LAMP: Color = (250, 246, 215)
"""The colour of headlamps."""
TAIL: Color = (190, 24, 24)
"""The colour of tail lamps."""
SKIN: Color = (214, 168, 138)
DARK: Color = (48, 50, 56)
PLATE: Color = (232, 232, 224)
# Half the thickness of an arm or a leg.
_HALF_LIMB_M = 0.045
_UPRIGHT_FACES = (FRONT, REAR, LEFT, RIGHT)
# Half the width of the body of a car as a share of its label box's; mirrors take up the rest.
_CAR_BODY_SHARE = 0.94
# Half the width of the body of a van or truck as a share of its label box's.
_VAN_BODY_SHARE = 0.95


@dataclass(frozen=True, slots=True)
class _ShapeFrame:
    """The space that a shape may fill, and its two colours.

    Attributes:
        x: Half the length, metres.
        y: Half the width, metres.
        top: Height above the road, metres.
        color: Colour of paint or clothes.
        accent: Second colour.
    """

    x: float
    y: float
    top: float
    color: Color
    accent: Color


def make_wheels(
    axles: tuple[float, ...], y: float, radius: float, width: float = 0.22
) -> list[Block]:
    """Make wheels on both sides, with outer faces `y` metres from the middle.

    Args:
        axles: Positions of the axles along x, metres.
        y: Distance of the outer faces from the middle, metres.
        radius: Radius of the wheels, metres.
        width: Width of the wheels, metres.
    """
    blocks: list[Block] = []
    for axle in axles:
        for across in both_sides(y - width, y):
            blocks += make_wheel(axle, across, radius, main=False)
    return blocks


def make_wheel(
    axle: float, across: tuple[float, float], radius: float, *, main: bool
) -> tuple[Block, Block, Block]:
    """Make a wheel of three blocks: two for the tyre, and a rim.

    Seen from the side, the tyre has six corners.
    """
    middle = 0.03 + radius
    cut = 0.5 * radius
    rim = 0.52 * radius
    upper = Block(
        span_around(axle, radius),
        across,
        (middle, middle + radius),
        TIRE,
        inset=(cut, cut, 0.0),
        main=main,
    )
    lower = Block(
        span_around(axle, cut),
        across,
        (middle - radius, middle),
        TIRE,
        inset=(-cut, -cut, 0.0),
        main=main,
    )
    rim_across = (across[0] - 0.008, across[1] + 0.008)
    hub = Block(span_around(axle, rim), rim_across, span_around(middle, rim), RIM, main=False)
    return upper, lower, hub


def make_lamps(x: float, side: float, height: float, depth: float = 0.3) -> list[Block]:
    """Make two headlamps and two tail lamps.

    Args:
        x: Distance of their outer faces ahead of and behind the middle, metres.
        side: Half the width of the body, metres.
        height: Height of their lower faces, metres.
        depth: Length of the blocks, metres.
    """
    z = (height, height + 0.13)
    sides = both_sides(side - 0.45, side - 0.08)
    front = [Block((x - depth, x), y, z, LAMP, main=False) for y in sides]
    rear = [Block((-x, -x + depth), y, z, TAIL, main=False) for y in sides]
    return front + rear


def make_plates(x: float, height: float) -> list[Block]:
    """Make a number plate in front and one behind, `x` metres from the middle."""
    y = center_span(0.26)
    z = (height, height + 0.11)
    front = Block((x - 0.1, x), y, z, PLATE, main=False)
    rear = Block((-x, -x + 0.1), y, z, PLATE, main=False)
    return [front, rear]


def make_mirrors(x: float, body: float, y: float, height: float, color: Color) -> list[Block]:
    """Make two mirrors.

    Args:
        x: Position along x, metres.
        body: Half the width of the body, metres.
        y: Distance of their outer faces from the middle, metres.
        height: Height of their lower faces, metres.
        color: Colour of their housings.
    """
    along = (x - 0.06, x + 0.1)
    z = (height, height + 0.14)
    return [
        Block(along, across, z, color, inset=(0.04, 0.0, 0.0), main=False)
        for across in both_sides(body - 0.02, y)
    ]


def motorcycle(frame: _ShapeFrame) -> list[Block]:
    """Make a motorcycle and its rider, who sits upright."""
    x = frame.x
    return [
        *_make_two_wheels(x, 0.32, 0.07),
        Block(
            (-0.5 * x, 0.42 * x),
            center_span(0.15),
            (0.34, 0.7),
            frame.color,
            inset=(0.12, 0.05, 0.03),
        ),
        Block(
            (-0.05 * x, 0.36 * x),
            center_span(0.16),
            (0.7, 0.92),
            frame.color,
            inset=(0.1, 0.12, 0.05),
        ),
        Block((-0.78 * x, -0.1 * x), center_span(0.12), (0.7, 0.8), DARK, inset=(0.0, 0.06, 0.02)),
        _make_fork(0.72 * x, 0.3, 0.98),
        _make_handlebar(0.38 * x, frame.y, 0.98),
        Block((0.44 * x, 0.54 * x), center_span(0.09), (0.8, 0.94), LAMP, main=False),
        Block((-0.82 * x, -0.76 * x), center_span(0.06), (0.72, 0.8), TAIL, main=False),
        *_make_rider(frame, seat=-0.2 * x, low=0.8, reach=0.5 * x, helmet=DARK),
    ]


def scooter(frame: _ShapeFrame) -> list[Block]:
    """Make a scooter with a shield before its rider's knees."""
    x = frame.x
    return [
        *_make_two_wheels(x, 0.26, 0.06),
        Block(
            (-0.85 * x, -0.1 * x),
            center_span(0.17),
            (0.38, 0.76),
            frame.color,
            inset=(0.1, 0.06, 0.04),
        ),
        Block((-0.12 * x, 0.5 * x), center_span(0.15), (0.26, 0.36), frame.color),
        Block(
            (0.46 * x, 0.54 * x),
            center_span(0.22),
            (0.32, 0.95),
            frame.color,
            inset=(0.1, -0.1, 0.05),
        ),
        Block((-0.7 * x, -0.1 * x), center_span(0.13), (0.76, 0.82), DARK),
        _make_handlebar(0.4 * x, frame.y, 0.98),
        Block((0.44 * x, 0.52 * x), center_span(0.08), (0.82, 0.94), LAMP, main=False),
        Block((-0.87 * x, -0.8 * x), center_span(0.08), (0.6, 0.7), TAIL, main=False),
        *_make_rider(frame, seat=-0.3 * x, low=0.82, reach=0.45 * x, helmet=(220, 220, 216)),
    ]


def cyclist(frame: _ShapeFrame) -> list[Block]:
    """Make a bicycle and its rider, who leans forward."""
    x = frame.x
    return [
        *_make_two_wheels(x, 0.33, 0.025),
        Block(
            (-0.1 * x, 0.42 * x),
            center_span(0.025),
            (0.44, 0.5),
            frame.color,
            inset=(-0.1, -0.02, 0.0),
            main=False,
        ),
        Block((-0.2 * x, 0.5 * x), center_span(0.025), (0.74, 0.8), frame.color, main=False),
        Block(
            (-0.22 * x, -0.16 * x),
            center_span(0.03),
            (0.36, 0.92),
            DARK,
            inset=(0.1, -0.1, 0.0),
            main=False,
        ),
        _make_fork(0.62 * x, 0.3, 1.0),
        _make_handlebar(0.46 * x, frame.y, 1.0),
        *_make_rider(frame, seat=-0.28 * x, low=0.9, reach=0.5 * x, helmet=(226, 228, 230)),
    ]


def walker(frame: _ShapeFrame) -> list[Block]:
    """Make a person in the middle of a long step, with swinging arms."""
    return _make_person(frame, stride=frame.x - _HALF_LIMB_M)


def stroller(frame: _ShapeFrame) -> list[Block]:
    """Make a person with a short step and a bag on the back."""
    y = frame.y
    top = frame.top
    bag = Block(
        (-frame.x, -0.4 * frame.x),
        center_span(0.6 * y),
        (0.56 * top, 0.78 * top),
        DARK,
        inset=(0, 0.02, 0.02),
    )
    return [*_make_person(frame, stride=0.5 * frame.x), bag]


def _make_person(frame: _ShapeFrame, stride: float) -> list[Block]:
    """Make a person with one foot `stride` metres ahead of the middle and one as far behind."""
    y = frame.y
    top = frame.top
    color = frame.color
    hip = 0.48 * top
    neck = 0.85 * top
    reach = min(0.62 * frame.x, 0.12)
    return [
        _make_limb(stride, (0.015, 0.14), (0.03, hip), frame.accent),
        _make_limb(-stride, (-0.14, -0.015), (0.03, hip), frame.accent),
        Block(
            center_span(reach), center_span(0.72 * y), (hip, neck), color, inset=(0.02, 0.02, -0.02)
        ),
        _make_limb(-0.6 * stride, (0.76 * y, y), (0.46 * top, 0.82 * top), color),
        _make_limb(0.6 * stride, (-y, -0.76 * y), (0.46 * top, 0.82 * top), color),
        Block(center_span(0.05), center_span(0.05), (neck, neck + 0.04), SKIN, main=False),
        Block(
            (-0.08, 0.1),
            center_span(0.075),
            (neck + 0.03, top - 0.06),
            SKIN,
            inset=(0.01, -0.01, -0.01),
        ),
        Block((-0.1, 0.08), center_span(0.085), (top - 0.1, top), DARK, inset=(0.03, 0.03, 0.03)),
    ]


def _make_rider(
    frame: _ShapeFrame, seat: float, low: float, reach: float, helmet: Color
) -> list[Block]:
    """Make a rider.

    Args:
        frame: Space and colours.
        seat: Position of the seat along x, metres.
        low: Height of the seat above the road, metres.
        reach: Position of the hands along x, metres.
        helmet: Colour of the helmet.
    """
    top = frame.top
    side = min(frame.y - 0.02, 0.24)
    neck = top - 0.27
    lean = min(0.22, 0.4 * (reach - seat))
    shoulder = seat + lean
    arms = both_sides(side - 0.08, side)
    legs = both_sides(0.05, min(side, 0.16))
    hand = 1.0 if neck > 1.1 else 0.9 * neck
    return [
        Block(
            (seat - 0.14, seat + 0.12),
            center_span(side - 0.05),
            (low, neck),
            frame.accent,
            inset=(-lean, lean, 0.0),
        ),
        *(
            Block((seat, seat + 0.15), across, (0.36, low + 0.08), DARK, inset=(-0.06, -0.02, 0.0))
            for across in legs
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
        Block(
            (shoulder - 0.08, shoulder + 0.14),
            center_span(0.1),
            (neck, top - 0.14),
            SKIN,
            main=False,
        ),
        Block(
            (shoulder - 0.12, shoulder + 0.14),
            center_span(0.12),
            (top - 0.18, top),
            helmet,
            inset=(0.05, 0.05, 0.04),
        ),
    ]


def _make_limb(end: float, y: tuple[float, float], z: tuple[float, float], color: Color) -> Block:
    """Make an arm or a leg from the body's middle down to `end` metres ahead of it."""
    x = span_around(end, _HALF_LIMB_M)
    return Block(x, y, z, color, inset=(end, -end, 0.0))


def _make_two_wheels(x: float, radius: float, half_width: float) -> list[Block]:
    """Make the front and the rear wheel of a two-wheeler of half length `x`, metres."""
    across = center_span(half_width)
    front = make_wheel(x - radius, across, radius, main=True)
    rear = make_wheel(radius - x, across, radius, main=True)
    return [*front, *rear]


def _make_fork(x: float, low: float, high: float) -> Block:
    """Make a fork between two heights, metres."""
    return Block(
        span_around(x, 0.03),
        center_span(0.05),
        (low, high),
        DARK,
        inset=(0.16, -0.16, 0.0),
        main=False,
    )


def _make_handlebar(x: float, y: float, height: float) -> Block:
    """Make a handlebar of half width `y`, metres."""
    along = span_around(x, 0.03)
    z = span_around(height, 0.03)
    return Block(along, center_span(y), z, DARK, main=False)


@dataclass(frozen=True, slots=True)
class _CarProfile:
    """The side view of a car, in shares of its half length and of its height.

    Attributes:
        waist: Height of the windows' lower edge.
        cabin: Start and end of the windows' lower edge.
        roof: Start and end of the roof.
        boot: Start and end of the boot's lid behind the cabin; None if the cabin is the rear end of
            the car.
        wheel: Radius of the wheels, metres.
        sill: Height of the body's lower edge, metres.
    """

    waist: float
    cabin: tuple[float, float]
    roof: tuple[float, float]
    boot: tuple[float, float] | None
    wheel: float
    sill: float


_SALOON = _CarProfile(0.6, (-0.84, 0.45), (-0.6, 0.16), (-0.98, -0.76), 0.32, 0.2)
_HATCHBACK = _CarProfile(0.6, (-0.94, 0.5), (-0.74, 0.1), None, 0.31, 0.2)
_OFF_ROADER = _CarProfile(0.58, (-0.96, 0.44), (-0.86, 0.16), None, 0.36, 0.27)


def saloon(frame: _ShapeFrame) -> list[Block]:
    """Make a car of three boxes: bonnet, cabin, boot."""
    return _make_car(frame, _SALOON)


def hatchback(frame: _ShapeFrame) -> list[Block]:
    """Make a car of two boxes: bonnet, cabin."""
    return _make_car(frame, _HATCHBACK)


def off_roader(frame: _ShapeFrame) -> list[Block]:
    """Make a steep car of two boxes on large wheels, with rails on the roof."""
    along = (-0.7 * frame.x, 0.05 * frame.x)
    z = (frame.top - 0.05, frame.top)
    rails = [Block(along, across, z, DARK, main=False) for across in both_sides(0.5, 0.56)]
    return [*_make_car(frame, _OFF_ROADER), *rails]


def _make_car(frame: _ShapeFrame, profile: _CarProfile) -> list[Block]:
    """Make a car with a side view."""
    x = frame.x
    body = _CAR_BODY_SHARE * frame.y
    top = frame.top
    color = frame.color
    waist = profile.waist * top
    roof = top - 0.05
    middle = waist + 0.6 * (roof - waist)
    rear, front = (share * x for share in profile.cabin)
    roof_rear, roof_front = (share * x for share in profile.roof)
    upper = 0.6
    blocks = [
        Block(
            center_span(x - 0.06),
            center_span(body - 0.05),
            (profile.sill, 0.42),
            color,
            inset=(-0.05, -0.05, -0.05),
        ),
        Block(
            center_span(x - 0.01), center_span(body), (0.42, waist), color, inset=(0.16, 0.07, 0.05)
        ),
        Block(
            (rear, front),
            center_span(body - 0.08),
            (waist, middle),
            color,
            glass=_UPRIGHT_FACES,
            inset=(upper * (front - roof_front), upper * (roof_rear - rear), 0.09),
        ),
        Block(
            (rear + upper * (roof_rear - rear), front - upper * (front - roof_front)),
            center_span(body - 0.17),
            (middle, roof),
            color,
            glass=_UPRIGHT_FACES,
            inset=((1 - upper) * (front - roof_front), (1 - upper) * (roof_rear - rear), 0.1),
        ),
        Block(
            (roof_rear, roof_front),
            center_span(body - 0.26),
            (roof, top),
            color,
            inset=(0.12, 0.12, 0.1),
        ),
        Block(
            (0.9 * front, x - 0.2),
            center_span(body - 0.12),
            (waist, waist + 0.05),
            color,
            inset=(0.25, 0, 0.1),
        ),
        Block((x - 0.1, x - 0.01), center_span(0.5 * body), (0.27, 0.39), DARK, main=False),
        *_make_pillars(0.5 * (roof_rear + roof_front), body - 0.09, waist, roof, color),
        *make_mirrors(0.72 * front, body - 0.06, frame.y, waist + 0.02, color),
        *make_wheels((0.62 * x, -0.6 * x), body, profile.wheel),
        *make_lamps(x - 0.02, body, 0.72 * waist),
        *make_plates(x, 0.45),
    ]
    if profile.boot:
        lid = (profile.boot[0] * x, profile.boot[1] * x)
        blocks.append(
            Block(lid, center_span(body - 0.1), (waist, waist + 0.06), color, inset=(0, 0.08, 0.08))
        )
    return blocks


def _make_pillars(x: float, side: float, waist: float, roof: float, color: Color) -> list[Block]:
    """Make an upright post between the side windows, left and right.

    Args:
        x: Position along x, metres.
        side: Distance of the windows from the middle, metres.
        waist: Height of the lower ends, metres.
        roof: Height of the upper ends, metres.
        color: Colour of the posts.
    """
    along = span_around(x, 0.05)
    return [
        Block(along, across, (waist, roof), color, main=False)
        for across in both_sides(side - 0.04, side + 0.005)
    ]


def delivery_van(frame: _ShapeFrame) -> list[Block]:
    """Make a van with windows only in front."""
    return _make_van(frame, panes=((0.14, 0.4),))


def minibus(frame: _ShapeFrame) -> list[Block]:
    """Make a van with windows along its full length."""
    panes = ((0.14, 0.4), (-0.4, 0.06), (-0.88, -0.48))
    return _make_van(frame, panes=panes)


def box_truck(frame: _ShapeFrame) -> list[Block]:
    """Make a cab and a large box."""
    x = frame.x
    y = _VAN_BODY_SHARE * frame.y
    top = frame.top
    box = Block((-x, 0.52 * x), center_span(y), (0.95, top), frame.accent, inset=(0.02, 0.02, 0.02))
    return [*_make_chassis(frame, 0.76 * top), box]


def tank_truck(frame: _ShapeFrame) -> list[Block]:
    """Make a cab and a tank with eight sides."""
    x = frame.x
    y = _VAN_BODY_SHARE * frame.y
    top = 0.82 * frame.top
    low = 0.95 + 0.28 * (top - 0.95)
    high = top - 0.28 * (top - 0.95)
    along = (-x, 0.5 * x)
    narrow = 0.4 * y
    return [
        *_make_chassis(frame, 0.74 * frame.top),
        Block(along, center_span(y - narrow), (0.95, low), frame.accent, inset=(0.0, 0.0, -narrow)),
        Block(along, center_span(y), (low, high), frame.accent),
        Block(along, center_span(y), (high, top), frame.accent, inset=(0.0, 0.0, narrow)),
        Block((-0.3 * x, 0.0), center_span(0.3), (top, frame.top), DARK),
    ]


def _make_van(frame: _ShapeFrame, panes: tuple[tuple[float, float], ...]) -> list[Block]:
    """Make a van; `panes` are start and end of its side windows, in shares of its half length."""
    x = frame.x
    y = _VAN_BODY_SHARE * frame.y
    top = frame.top
    color = frame.color
    waist = 0.52 * top
    sides = both_sides(y - 0.12, y - 0.045)
    return [
        Block(
            (-x + 0.04, x - 0.06),
            center_span(y - 0.05),
            (0.22, 0.44),
            color,
            inset=(-0.04, -0.02, -0.05),
        ),
        Block(center_span(x - 0.01), center_span(y), (0.44, waist), color, inset=(0.2, 0.0, 0.03)),
        Block(
            (-x + 0.02, 0.8 * x),
            center_span(y - 0.03),
            (waist, top - 0.08),
            color,
            glass=(FRONT,),
            inset=(0.62, 0.05, 0.05),
        ),
        Block(
            (-x + 0.09, 0.78 * x - 0.62),
            center_span(y - 0.1),
            (top - 0.08, top),
            color,
            inset=(0.12, 0.1, 0.12),
        ),
        Block(
            (-x + 0.01, -x + 0.1),
            center_span(0.7 * y),
            (waist + 0.1, top - 0.35),
            solids.GLASS,
            main=False,
        ),
        *(
            Block(
                (span[0] * x, span[1] * x),
                side,
                (waist + 0.06, top - 0.34),
                solids.GLASS,
                main=False,
            )
            for span in panes
            for side in sides
        ),
        *make_mirrors(0.5 * x, y - 0.03, frame.y, waist + 0.06, DARK),
        *make_wheels((0.64 * x, -0.62 * x), y, 0.35),
        *make_lamps(x - 0.02, y, 0.72 * waist),
        *make_plates(x, 0.46),
    ]


def _make_chassis(frame: _ShapeFrame, cab_top: float) -> list[Block]:
    """Make frame, wheels and cab of a truck."""
    x = frame.x
    y = _VAN_BODY_SHARE * frame.y
    middle = 0.45 * cab_top + 0.35
    cab = (0.56 * x, x - 0.02)
    return [
        Block((-x + 0.05, 0.9 * x), center_span(0.8 * y), (0.55, 0.95), DARK, main=False),
        Block(cab, center_span(y - 0.04), (0.45, middle), frame.color, inset=(0.04, 0.0, 0.0)),
        Block(
            (cab[0], cab[1] - 0.04),
            center_span(y - 0.04),
            (middle, cab_top - 0.15),
            frame.color,
            glass=(FRONT, LEFT, RIGHT),
            inset=(0.16, 0.0, 0.05),
        ),
        Block(
            (cab[0], cab[1] - 0.2),
            center_span(y - 0.09),
            (cab_top - 0.15, cab_top),
            frame.color,
            inset=(0.2, 0, 0.1),
        ),
        Block((x - 0.1, x), center_span(0.6 * y), (0.6, 0.95), DARK, glass=(REAR,), main=False),
        *make_mirrors(cab[1] - 0.3, y - 0.06, frame.y, middle + 0.15, DARK),
        *make_wheels((0.76 * x, -0.45 * x, -0.75 * x), y, 0.48, 0.3),
        *make_lamps(x, y - 0.1, 0.66),
    ]


MODELS: dict[str, tuple[Callable[[_ShapeFrame], list[Block]], ...]] = {
    "car": (saloon, hatchback, off_roader),
    "van": (delivery_van, minibus),
    "truck": (box_truck, tank_truck),
    "motorcycle": (motorcycle, scooter),
    "cyclist": (cyclist,),
    "pedestrian": (walker, stroller),
}
"""Functions that build the models of each category."""


def make_shape(
    category: str, size: tuple[float, float, float], color: Color, accent: Color, model: int = 0
) -> Solids:
    """Build the solids of a road user.

    Args:
        category: One of `taxonomy.CATEGORIES`.
        size: Length, width and height of the label box, metres.
        color: Colour of paint or clothes.
        accent: Second colour.
        model: Index into the category's `MODELS`; after the last one, the first follows.
    """
    length, width, height = size
    frame = _ShapeFrame(
        x=length / 2 - INSET,
        y=width / 2 - INSET,
        top=BOX_CLEARANCE + height - INSET,
        color=color,
        accent=accent,
    )
    models = MODELS[category]
    make_blocks = models[model % len(models)]
    return solids.build(make_blocks(frame))
