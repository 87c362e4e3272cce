"""Trees between the sidewalks and the houses."""

from collections.abc import Iterator

import numpy as np

from deepaccident_devkit.synth.roads import TREE, RoadSpec
from deepaccident_devkit.synth.roads.terrain import OUTWARD
from deepaccident_devkit.synth.solids import Block, Color
from deepaccident_devkit.synth.stage.props import Prop

_BARK: Color = (92, 72, 54)
_LEAVES: tuple[Color, ...] = ((70, 116, 54), (88, 132, 62), (58, 100, 58))
_SPACING = 13.0
_SHARE = 0.55
"""Of the places that have a tree."""
_INSET = 1.25
"""Metres from the sidewalk to a trunk: crowns end at the sidewalk."""


def trees(rng: np.random.Generator, spec: RoadSpec) -> Iterator[Prop]:
    """Trees along both sides of each arm, with gaps."""
    for arm in spec.arms:
        out_x, out_y = OUTWARD[arm]
        for along in np.arange(spec.stop_line[1] + 7.0, 105.0, _SPACING):
            for side in (1, -1):
                place, present = float(along + rng.uniform(-2, 2)), rng.random() < _SHARE
                beside = side * (spec.sidewalk_edge + _INSET)
                if present:
                    yield _tree(rng, place * out_x - beside * out_y, place * out_y + beside * out_x)


def _tree(rng: np.random.Generator, x: float, y: float) -> Prop:
    leaves, top = _LEAVES[rng.integers(len(_LEAVES))], float(rng.uniform(4.0, 5.6))
    crown = ((x - 1.1, x + 1.1), (y - 1.1, y + 1.1))
    return Prop(
        TREE,
        (
            Block((x - 0.14, x + 0.14), (y - 0.14, y + 0.14), (-0.1, 2.3), _BARK),
            Block(*crown, (2.2, 3.3), leaves, inset=(-0.1, -0.1, -0.1)),
            Block((x - 1.15, x + 1.15), (y - 1.15, y + 1.15), (3.3, top), leaves, inset=(0.7, 0.7, 0.7)),
        ),
    )
