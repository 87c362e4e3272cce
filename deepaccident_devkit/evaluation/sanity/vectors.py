"""Whether the vectors of heads, offset and flow, point as though their channels were others."""

from __future__ import annotations

from typing import Final

import numpy as np

from deepaccident_devkit.arrays import AnyArray, FloatArray
from deepaccident_devkit.evaluation.sanity.probes import Group, Suspicion, tally
from deepaccident_devkit.evaluation.sanity.symmetries import SYMMETRIES, Symmetry
from deepaccident_devkit.motion import MotionHeads, MotionLabels

_HEADS: Final[tuple[Group, ...]] = ("offset", "flow")
_MEANING: Final = {
    "offset": "channel 0 is down the rows, channel 1 along the columns, from a cell to its instance's centre",
    "flow": "channel 0 is down the rows, channel 1 along the columns, from an instance's centre to its next one",
}
_TELLING: Final = 3.0
"""Cells by which a vector has to change for its cell to tell."""
_FAR: Final = 20.0
"""Cells: vectors that are further off are as wrong as this."""
_LEAST: Final = 0.5
_CELLS: Final = 100


def vector_suspicions() -> list[Suspicion]:
    """What is looked for in heads."""
    return [
        Suspicion(
            name=_name(head, each),
            group=head,
            says=f"the {head} has {_channels_text(each)}",
            remedy=_MEANING[head],
            measure="share of the cells whose vector is right",
            least=_LEAST,
            evidence=_CELLS,
        )
        for head in _HEADS
        for each in SYMMETRIES
    ]


def vector_tallies(heads: MotionHeads, truth: MotionLabels) -> dict[str, list[float]]:
    """What a sample says of each suspicion, in the cells that are actors' both in the heads and in the labels.

    Args:
        heads: of as many frames as are compared.
        truth: labels at the present, with these frames at least.
    """
    frames = len(heads.segmentation)
    heads = heads.in_orientation(truth.config.grid.orientation)
    there = (heads.segmentation[:, 1] > heads.segmentation[:, 0]) & (truth.segmentation[:frames] == 1)
    result = {}
    for head in _HEADS:
        found, true = (_vectors(getattr(each, head)[:frames], there) for each in (heads, truth))
        known = ~(true == truth.config.ignore_index).all(axis=-1)
        for each in SYMMETRIES:
            result[_name(head, each)] = _tally(found[known], true[known], each)
    return result


def _vectors(maps: AnyArray, there: AnyArray) -> FloatArray:
    """(P, 2) of the cells that are there."""
    vectors: FloatArray = np.moveaxis(maps, 1, -1)[there].astype(np.float64)
    return vectors


def _tally(found: FloatArray, true: FloatArray, symmetry: Symmetry) -> list[float]:
    change = np.linalg.norm(symmetry.apply(true) - true, axis=-1)
    tells = change >= _TELLING
    after, before = (np.linalg.norm(each - true, axis=-1) for each in (symmetry.undo(found), found))
    fits, given = (int(np.count_nonzero(tells & (each < change / 2))) for each in (after, before))
    return tally(fits, int(np.count_nonzero(tells)), given, misfit=float(np.minimum(after, _FAR).sum()))


def _name(head: str, symmetry: Symmetry) -> str:
    return f"{head}: {_channels_text(symmetry)}"


def _channels_text(symmetry: Symmetry) -> str:
    """A symmetry of x and y, read as one of channels 0 and 1."""
    negated = [str(number) for number, sign in enumerate((symmetry.x_sign, symmetry.y_sign)) if sign < 0]
    signs = "both channels negated" if len(negated) == 2 else f"channel {negated[0]} negated" if negated else ""
    if not symmetry.swapped:
        return signs
    return f"its channels swapped, then {signs}" if signs else "its channels swapped"
