"""Random road users of each category: their size, colours and shape, before they get an id and a motion."""

from dataclasses import dataclass

import numpy as np

from deepaccident_devkit.synth.shapes import MODELS, shape_of
from deepaccident_devkit.synth.solids import Color, Solids

Size = tuple[float, float, float]

MEDIAN_SIZES: dict[str, Size] = {
    "car": (4.60, 1.93, 1.52),
    "truck": (8.47, 2.89, 3.83),
    "van": (4.48, 1.99, 2.04),
    "motorcycle": (2.21, 0.86, 1.53),
    "cyclist": (1.64, 0.37, 1.77),
    "pedestrian": (0.38, 0.38, 1.86),
}
"""Median length, width and height in the real release, metres (docs/format.md, Label)."""
_SPREAD = (0.05, 0.05, 0.04)
"""By which share of the median length, width and height a body may differ from it."""
_FARTHEST_ORIGIN = 0.3
_PAINTS: tuple[Color, ...] = (
    (196, 30, 36), (28, 74, 160), (226, 228, 230), (150, 155, 160), (46, 50, 56), (236, 196, 56), (40, 120, 72),
    (120, 40, 44), (88, 142, 196), (214, 120, 44),
)  # fmt: skip
_CLOTHES: tuple[Color, ...] = (
    (168, 44, 52), (52, 84, 150), (70, 110, 70), (200, 176, 120), (90, 70, 110), (64, 66, 74), (214, 212, 206),
)  # fmt: skip
_TRUCK_BOXES: tuple[Color, ...] = ((226, 226, 222), (180, 190, 200), (200, 170, 120), (90, 120, 150))


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """What an actor is made of.

    Attributes:
        category: one of `taxonomy.CATEGORIES`.
        size: length, width, height of the label box, metres.
        shape: its solids, x forward, origin on the road below the box's centre.
        origin: (x, y) of its reference point seen from the box's centre, metres.
    """

    category: str
    size: Size
    shape: Solids
    origin: tuple[float, float]


def random_body(rng: np.random.Generator, category: str) -> Body:
    """A road user of this category, near the median size of the real release."""
    factors = 1 + np.array(_SPREAD) * rng.uniform(-1, 1, 3)
    size: Size = tuple((np.array(MEDIAN_SIZES[category]) * factors).astype(np.float32).tolist())
    color, accent = _colors(rng, category)
    shape = shape_of(category, size, color, accent, model=int(rng.integers(len(MODELS[category]))))
    return Body(category, size, shape, _random_origin(rng))


def _colors(rng: np.random.Generator, category: str) -> tuple[Color, Color]:
    paints = _CLOTHES if category == "pedestrian" else _PAINTS
    accents = _TRUCK_BOXES if category == "truck" else _CLOTHES
    return paints[rng.integers(len(paints))], accents[rng.integers(len(accents))]


def _random_origin(rng: np.random.Generator) -> tuple[float, float]:
    """Where an ego origin lies: ahead of the box's centre, mostly by some centimetres, seldom by up to 0.3 m."""
    return round(float(_FARTHEST_ORIGIN * rng.random() ** 3), 4), 0.0
