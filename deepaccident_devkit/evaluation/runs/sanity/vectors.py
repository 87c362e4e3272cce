"""Whether the vectors of heads, offset and flow, look as if their channels or signs were others, or swapped."""

from __future__ import annotations

from typing import Final

import numpy as np

from deepaccident_devkit.arrays import AnyArray, FloatArray
from deepaccident_devkit.evaluation.runs.sanity.probes import (
    SYMMETRIES,
    Group,
    Suspicion,
    Symmetry,
    nearer_tally,
)
from deepaccident_devkit.motion import MotionHeads, MotionLabels

EXCHANGED: Final = "offset and flow swapped"
_CHANGE: Final = 400.0
"""Cells by which all vectors together have to change."""
_HEADS: Final[tuple[Group, ...]] = ("offset", "flow")
_MEANING: Final = {
    "offset": "channel 0 is down the rows, channel 1 along the columns, from a cell to its instance's centre",
    "flow": "channel 0 is down the rows, channel 1 along the columns, from an instance's centre to its next centre",
}
_TELLING: Final = 3.0
"""Cells by which a vector has to change for its cell to tell."""
_FAR: Final = 20.0
"""Cells: vectors that are further off are as wrong as this."""
_LEAST: Final = 0.6


def vector_suspicions() -> list[Suspicion]:
    """What is looked for in heads."""
    both = "; ".join(f"of the {head}, {meaning}" for head, meaning in _MEANING.items())
    result = [_suspicion(EXCHANGED, "exchange", "the offset is given as flow, and the flow as offset", both)]
    result += [
        _suspicion(_vector_name(head, each), head, _vector_says(head, each), _MEANING[head])
        for head in _HEADS
        for each in SYMMETRIES
    ]
    return result


def vector_tallies(heads: MotionHeads, truth: MotionLabels) -> dict[str, list[float]]:
    """What a sample says of each suspicion, in the cells that are actors' both in the heads and in the labels.

    Args:
        heads: of as many frames as are compared.
        truth: labels at the present, with these frames at least.
    """
    frames = len(heads.segmentation)
    heads = heads.in_orientation(truth.config.grid.orientation)
    there = (heads.segmentation[:, 1] > heads.segmentation[:, 0]) & (truth.segmentation[:frames] == 1)
    found, true = ({head: _vectors(getattr(each, head)[:frames], there) for head in _HEADS} for each in (heads, truth))
    known = {head: ~(true[head] == truth.config.ignore_index).all(axis=-1) for head in _HEADS}
    result = {
        _vector_name(head, each): _vector_tally(found[head][known[head]], true[head][known[head]], each)
        for head in _HEADS
        for each in SYMMETRIES
    }
    both = known["offset"] & known["flow"]
    result[EXCHANGED] = _exchanged(*(each[head][both] for each in (found, true) for head in _HEADS))
    return result


def _suspicion(name: str, group: Group, says: str, remedy: str) -> Suspicion:
    return Suspicion(
        name=name,
        group=group,
        says=says,
        remedy=remedy,
        measure="how near the vectors are to the true ones, from 0 to 1",
        least=_LEAST,
        evidence=_CHANGE,
    )


def _exchanged(offset: FloatArray, flow: FloatArray, true_offset: FloatArray, true_flow: FloatArray) -> list[float]:
    """Whether offsets are nearer to the true flows and flows to the true offsets, where these two differ."""
    half = np.linalg.norm(true_offset - true_flow, axis=-1)
    before, after = (
        sum(np.linalg.norm(found - true, axis=-1) for found, true in zip((offset, flow), sides, strict=True))
        for sides in ((true_offset, true_flow), (true_flow, true_offset))
    )
    return _nearer(np.asarray(before), np.asarray(after), 2 * half)


def _vectors(maps: AnyArray, there: AnyArray) -> FloatArray:
    """(P, 2) of the cells that are there."""
    vectors: FloatArray = np.moveaxis(maps, 1, -1)[there].astype(np.float64)
    return vectors


def _vector_tally(found: FloatArray, true: FloatArray, symmetry: Symmetry) -> list[float]:
    wrong = symmetry.apply(true)
    return _nearer(
        *(np.linalg.norm(one - other, axis=-1) for one, other in ((found, true), (found, wrong), (wrong, true)))
    )


def _nearer(before: FloatArray, after: FloatArray, change: FloatArray) -> list[float]:
    tells = change >= _TELLING
    misfit = float(np.minimum(after, _FAR).sum())
    return nearer_tally(before[tells], after[tells], change[tells], misfit)


def _vector_name(head: str, symmetry: Symmetry) -> str:
    return f"{head}: {_channels_text(symmetry)}"


def _vector_says(head: str, symmetry: Symmetry) -> str:
    """What is wrong then: a clause."""
    if head == "flow" and symmetry.matrix.tolist() == [[-1.0, 0.0], [0.0, -1.0]]:
        return "the flow leads to the instance's centre in the previous frame, or both its channels have the wrong sign"
    return f"the {head} has {_channels_text(symmetry)}"


def _channels_text(symmetry: Symmetry) -> str:
    """A symmetry of x and y, read as one of channels 0 and 1."""
    negated = [str(number) for number, sign in enumerate((symmetry.x_sign, symmetry.y_sign)) if sign < 0]
    signs = "both channels negated" if len(negated) == 2 else f"channel {negated[0]} negated" if negated else ""
    if not symmetry.swapped:
        return signs
    return f"its channels swapped, then {signs}" if signs else "its channels swapped"
