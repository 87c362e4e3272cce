"""Whether predicted maps look mirrored, turned, scaled, or a step off in time, and whether ids stay.

Of heads also whether their vectors, offset and flow, point as though their channels were others.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Final

import numpy as np

from deepaccident_devkit.arrays import AnyArray, BoolArray, FloatArray, IntArray
from deepaccident_devkit.evaluation.metrics.frames import first_frames, frames_there, labels_at_present
from deepaccident_devkit.evaluation.metrics.predictions import MotionOutput
from deepaccident_devkit.evaluation.runs.sanity.probes import (
    SCALES,
    SYMMETRIES,
    Group,
    Suspicion,
    Symmetry,
    orientation_mistaken,
    scale_says,
    tally,
)
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.geometry.bev_grid import Axis, Orientation
from deepaccident_devkit.motion import OWN_BOX_ID, MotionHeads, MotionLabels

LAGS: Final = {"one step late": -1, "one step early": 1}
"""Which of the true frames is found in the place of a frame."""
_LEAST: Final = 0.25
_CELLS: Final = 100


def motion_suspicions(stated: Orientation, *, heads: bool) -> list[Suspicion]:
    """What is looked for in maps that are said to lie in an orientation."""
    result = [
        Suspicion(
            name=each.name,
            group="place",
            says=f"{each.says} in the maps",
            remedy=_orientation_remedy(each, stated),
            measure="IoU of the actors' cells",
            least=_LEAST,
            evidence=_CELLS,
        )
        for each in SYMMETRIES
    ]
    result += [
        Suspicion(
            name=name,
            group="place",
            says=scale_says(scale),
            remedy="state the cell size that the maps have: metres and cells may be mixed up, or their number halved",
            measure="IoU of the actors' cells",
            least=_LEAST,
            evidence=_CELLS,
        )
        for name, scale in SCALES.items()
    ]
    result += [
        Suspicion(
            name=name,
            group="time",
            says=f"each frame shows what is {'before' if lag < 0 else 'after'} it by one step",
            remedy="the first frame of a prediction is the present, the next one a step later",
            measure="IoU in the cells that change from step to step",
            least=_LEAST,
            evidence=_CELLS,
            also=(f"{name}: not two", f"{name}: everywhere"),
        )
        for name, lag in LAGS.items()
    ]
    return result + (vector_suspicions() if heads else [])


def motion_tallies(prediction: MotionOutput, label: MotionLabels) -> dict[str, list[float]]:
    """What a sample says of each suspicion, by its last prediction; the own box in the middle tells nothing."""
    frames = frames_there(label)
    truth, grid = labels_at_present(label), label.config.grid
    own = truth.id_map.get(OWN_BOX_ID)
    drawn, instance = (grid.reorient(maps[:frames], "devkit") for maps in (truth.segmentation == 1, truth.instance))
    told = np.ones_like(drawn) if own is None else instance != own
    predicted = prediction.grid.reorient(_actors(prediction, frames), "devkit")
    given = _overlap(predicted, drawn, told)
    result = {
        each.name: tally(*_overlap(each.undo_raster(predicted), drawn, told), *given)
        for each in SYMMETRIES
        if not each.swapped or drawn.shape[1] == drawn.shape[2]
    }
    for name, scale in SCALES.items():
        unscaled, known = _unscaled(predicted, grid, scale)
        result[name] = tally(*_overlap(unscaled, drawn, told & known), *given)
    for name, lag in LAGS.items():
        result |= _lag_tallies(name, lag, predicted, drawn)
    if prediction.heads is not None:
        result |= vector_tallies(first_frames(prediction.heads[-1], frames), truth)
    return result


def ids_kept(prediction: MotionOutput, label: MotionLabels) -> list[int]:
    """How often a true instance that is found in two frames on end keeps its id, and how often there is one.

    Found is an instance most of whose cells have one predicted id. Of heads, whose ids the devkit links itself: none.
    """
    if prediction.instances is None:
        return [0, 0]
    frames = frames_there(label)
    grid, truth = label.config.grid, labels_at_present(label)
    predicted = prediction.grid.reorient(prediction.instances[-1, :frames], grid.orientation)
    names = [_names(found, true) for found, true in zip(predicted, truth.instance[:frames], strict=True)]
    pairs = [before[one] == after[one] for before, after in pairwise(names) for one in before.keys() & after.keys()]
    return [sum(pairs), len(pairs)]


def is_empty(prediction: MotionOutput, frames: int) -> bool:
    """Whether nobody is in the last prediction."""
    return not _actors(prediction, frames).any()


def _actors(prediction: MotionOutput, frames: int) -> BoolArray:
    """(T, H, W) which cells are actors in the last prediction, as it lies."""
    if prediction.instances is not None:
        return np.asarray(prediction.instances[-1, :frames] > 0)
    segmentation = first_frames((prediction.heads or ())[-1], frames).segmentation
    return np.asarray(segmentation[:, 1] > segmentation[:, 0])


def _overlap(predicted: BoolArray, true: BoolArray, where: BoolArray) -> tuple[int, int]:
    """Cells of the intersection and of the union."""
    both = int(np.count_nonzero(predicted & true & where))
    return both, int(np.count_nonzero((predicted | true) & where))


def _unscaled(predicted: BoolArray, grid: BevGrid, scale: float) -> tuple[BoolArray, BoolArray]:
    """Maps (T, rows, columns) in the devkit's orientation as though all were `scale` times too far; and what is known.

    The ego, at x = y = 0, stays.
    """
    (row, row_there), (column, column_there) = (_scaled_cells(axis, scale) for axis in (grid.y, grid.x))
    known = row_there[:, None] & column_there
    return predicted[:, row[:, None], column] & known, known


def _scaled_cells(axis: Axis, scale: float) -> tuple[IntArray, BoolArray]:
    low, high, size = axis
    center = low + (np.arange(round((high - low) / size)) + 0.5) * size
    cell = np.floor((center * scale - low) / size).astype(np.int64)
    there = (cell >= 0) & (cell < len(center))
    return np.where(there, cell, 0), there


def _lag_tallies(name: str, lag: int, predicted: BoolArray, true: BoolArray) -> dict[str, list[float]]:
    """Whether frames show the true ones a step off.

    Most cells are those of parked cars, so that only those count that differ between the two true frames compared. Who
    predicts that nobody moves, or slowly, is later from frame to frame, and who overestimates speeds earlier: so a
    prediction that is off by one step as a whole is not off by two, least of all in the last frame, and not right in
    the first one.
    """
    late = lag < 0
    known = range(-lag, len(true)) if late else range(len(true) - lag)
    twice = range(-2 * lag, len(true)) if late else range(len(true) - 2 * lag)
    extreme = _decided(predicted, true, twice[-1:], lag, 2 * lag) if late else _decided(predicted, true, known[:1], lag)
    return {
        name: _decided(predicted, true, known, lag),
        f"{name}: not two": _decided(predicted, true, twice, lag, 2 * lag),
        f"{name}: everywhere": extreme,
    }


def _decided(predicted: BoolArray, true: BoolArray, frames: range, lag: int, other: int = 0) -> list[float]:
    """The overlap with the true frames that are `lag` off against that with those that are `other` off."""
    here = np.array([*frames], dtype=np.int64)
    one, two, found = true[here + lag], true[here + other], predicted[here]
    where = one != two
    return tally(*_overlap(found, one, where), *_overlap(found, two, where))


def _names(found: AnyArray, true: AnyArray) -> dict[int, int]:
    """True id → the predicted id that most of its cells have."""
    both = true > 0
    keys, counts = np.unique(np.stack([true[both], found[both]]), axis=1, return_counts=True)
    cells = dict(zip(*np.unique(true[both], return_counts=True), strict=True))
    return {
        int(one): int(other)
        for one, other, count in zip(*keys, counts, strict=True)
        if other > 0 and 2 * count > cells[one]
    }


def _orientation_remedy(symmetry: Symmetry, stated: Orientation) -> str:
    mistaken = orientation_mistaken(symmetry, stated)
    if mistaken is None:
        return "no orientation of the devkit's explains that: mirror or turn the maps back before writing them"
    return (
        f"maps in the orientation {mistaken!r} look so where {stated!r} is stated: state orientation {mistaken!r}, or "
        "mirror or turn the maps back before writing them"
    )


_HEADS: Final[tuple[Group, ...]] = ("offset", "flow")
_MEANING: Final = {
    "offset": "channel 0 is down the rows, channel 1 along the columns, from a cell to its instance's centre",
    "flow": "channel 0 is down the rows, channel 1 along the columns, from an instance's centre to its next one",
}
_TELLING: Final = 3.0
"""Cells by which a vector has to change for its cell to tell."""
_FAR: Final = 20.0
"""Cells: vectors that are further off are as wrong as this."""
_LEAST_RIGHT: Final = 0.5


def vector_suspicions() -> list[Suspicion]:
    """What is looked for in heads."""
    return [
        Suspicion(
            name=_vector_name(head, each),
            group=head,
            says=f"the {head} has {_channels_text(each)}",
            remedy=_MEANING[head],
            measure="share of the cells whose vector is right",
            least=_LEAST_RIGHT,
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
            result[_vector_name(head, each)] = _vector_tally(found[known], true[known], each)
    return result


def _vectors(maps: AnyArray, there: AnyArray) -> FloatArray:
    """(P, 2) of the cells that are there."""
    vectors: FloatArray = np.moveaxis(maps, 1, -1)[there].astype(np.float64)
    return vectors


def _vector_tally(found: FloatArray, true: FloatArray, symmetry: Symmetry) -> list[float]:
    change = np.linalg.norm(symmetry.apply(true) - true, axis=-1)
    tells = change >= _TELLING
    after, before = (np.linalg.norm(each - true, axis=-1) for each in (symmetry.undo(found), found))
    fits, given = (int(np.count_nonzero(tells & (each < change / 2))) for each in (after, before))
    return tally(fits, int(np.count_nonzero(tells)), given, misfit=float(np.minimum(after, _FAR).sum()))


def _vector_name(head: str, symmetry: Symmetry) -> str:
    return f"{head}: {_channels_text(symmetry)}"


def _channels_text(symmetry: Symmetry) -> str:
    """A symmetry of x and y, read as one of channels 0 and 1."""
    negated = [str(number) for number, sign in enumerate((symmetry.x_sign, symmetry.y_sign)) if sign < 0]
    signs = "both channels negated" if len(negated) == 2 else f"channel {negated[0]} negated" if negated else ""
    if not symmetry.swapped:
        return signs
    return f"its channels swapped, then {signs}" if signs else "its channels swapped"
