"""Things that stand on the ground: blocks, with a code for the map from above."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from deepaccident_devkit.arrays import FloatArray
from deepaccident_devkit.synth.roads import GroundMap, Terrain
from deepaccident_devkit.synth.solids import Block, Solids, build

BASEMENT = 0.2
"""Metres that things reach into the ground."""


@dataclass(frozen=True, slots=True)
class Prop:
    """One thing, made as if the ground were flat.

    Attributes:
        code: its code on the map from above, as in `roads`.
        blocks: its blocks, in the ground frame.
    """

    code: int
    blocks: tuple[Block, ...]

    @property
    def footprint(self) -> tuple[float, float, float, float]:
        """The extent of all its blocks: x from, x to, y from, y to, metres."""
        spans = [(*block.x, *block.y) for block in self.blocks]
        x0, x1, y0, y1 = zip(*spans, strict=True)
        return min(x0), max(x1), min(y0), max(y1)


def overlap(first: Prop, second: Prop) -> bool:
    """Whether the footprints of two things overlap."""
    a, b = first.footprint, second.footprint
    return all(a[k] < b[k + 1] and b[k] < a[k + 1] for k in (0, 2))


def settled(prop: Prop, terrain: Terrain) -> Prop:
    """The thing on sloping ground: raised to the height of its lowest corner, so that no part of it floats."""
    if terrain.is_flat:
        return prop
    lift = float(terrain.height(_corners(prop)).min())
    return replace(
        prop, blocks=tuple(replace(block, z=(block.z[0] + lift, block.z[1] + lift)) for block in prop.blocks)
    )


def solids_of(props: Sequence[Prop]) -> Solids:
    """The solids of all things, in order."""
    return build([block for prop in props for block in prop.blocks])


def top_map(ground: GroundMap, props: Sequence[Prop]) -> GroundMap:
    """The map from above: lower things are painted first, so that higher things cover them."""
    flat = [(block.z[1], prop.code, (*block.x, *block.y)) for prop in props for block in prop.blocks]
    flat.sort(key=lambda entry: entry[0])
    return ground.with_rectangles(
        np.array([extent for _, _, extent in flat]).reshape(-1, 4),
        np.array([code for _, code, _ in flat], dtype=np.uint8),
    )


def _corners(prop: Prop) -> FloatArray:
    x0, x1, y0, y1 = prop.footprint
    return np.array([[x0, y0], [x0, y1], [x1, y0], [x1, y1]])
