"""Whether predicted maps look mirrored, turned, scaled, inverted, or as if their frames were others.

Of heads also what `vectors` looks for.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from deepaccident_devkit.arrays import BoolArray, IntArray
from deepaccident_devkit.evaluation.metrics.frames import first_frames, frames_there, labels_at_present
from deepaccident_devkit.evaluation.metrics.predictions import MotionOutput
from deepaccident_devkit.evaluation.runs.sanity.moments import moment_suspicions, moment_tallies
from deepaccident_devkit.evaluation.runs.sanity.probes import (
    SCALES,
    SYMMETRIES,
    Group,
    Suspicion,
    Symmetry,
    orientation_mistaken,
    overlap,
    scale_says,
    tally,
)
from deepaccident_devkit.evaluation.runs.sanity.vectors import vector_suspicions, vector_tallies
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.geometry.bev_grid import Axis, Orientation
from deepaccident_devkit.motion import OWN_BOX_ID, MotionLabels

INVERTED: Final = "actors and background swapped"
_LEAST: Final = 0.12
"""IoU that predictions reach when they are set right; noisy ones with much missing reach little more."""
_MARGIN: Final = 2.5
_CELLS: Final = 100


def motion_suspicions(stated: Orientation, *, heads: bool) -> list[Suspicion]:
    """What is looked for in maps that are said to lie in an orientation."""
    channels = (
        "channel 0 is the background, channel 1 the actors" if heads else "0 is the background, ids are 1 and more"
    )
    unscaled = "state the cell size that the maps have: metres and cells may be mixed up, or the number of cells halved"
    result = [_place(INVERTED, "channels", "actors are given as background, and background as actors", channels)]
    result += [
        _place(each.name, "place", f"{each.says} in the maps", _orientation_remedy(each, stated)) for each in SYMMETRIES
    ]
    result += [_place(name, "place", scale_says(scale), unscaled) for name, scale in SCALES.items()]
    return result + moment_suspicions() + (vector_suspicions() if heads else [])


def motion_tallies(prediction: MotionOutput, label: MotionLabels) -> dict[str, list[float]]:
    """What a sample says of each suspicion, by its last prediction; the own box in the middle tells nothing."""
    frames = frames_there(label)
    truth, grid = labels_at_present(label), label.config.grid
    own = truth.id_map.get(OWN_BOX_ID)
    drawn, instance = (grid.reorient(maps[:frames], "devkit") for maps in (truth.segmentation == 1, truth.instance))
    told = np.ones_like(drawn) if own is None else instance != own
    predicted = prediction.grid.reorient(actor_cells(prediction, frames), "devkit")
    inverted = prediction.grid.reorient(_inverted(prediction, frames), "devkit")
    given = overlap(predicted, drawn, told)
    result = {
        INVERTED: tally(*overlap(inverted, drawn, told), *given),
        **{
            each.name: tally(*overlap(each.undo_raster(predicted), drawn, told), *given)
            for each in SYMMETRIES
            if not each.swapped or drawn.shape[1] == drawn.shape[2]
        },
    }
    for name, scale in SCALES.items():
        unscaled, known = _unscaled(predicted, grid, scale)
        result[name] = tally(*overlap(unscaled, drawn, told & known), *given)
    unwarped = None if label.at_present else grid.reorient(label.segmentation[:frames] == 1, "devkit")
    result |= moment_tallies(predicted, drawn, unwarped, _length(prediction))
    if prediction.heads is not None:
        result |= vector_tallies(first_frames(prediction.heads[-1], frames), truth)
    return result


def actor_cells(prediction: MotionOutput, frames: int) -> BoolArray:
    """(T, H, W) which cells are actors in the last prediction, as it lies."""
    if prediction.instances is not None:
        return np.asarray(prediction.instances[-1, :frames] > 0)
    segmentation = first_frames((prediction.heads or ())[-1], frames).segmentation
    return np.asarray(segmentation[:, 1] > segmentation[:, 0])


def _length(prediction: MotionOutput) -> int:
    """How many frames the last prediction has."""
    return len(prediction.instances[-1] if prediction.instances is not None else (prediction.heads or ())[-1].flow)


def _inverted(prediction: MotionOutput, frames: int) -> BoolArray:
    """(T, H, W) which cells are actors if the channels are swapped, or if the id that most cells have is nobody's."""
    if prediction.instances is None:
        return ~actor_cells(prediction, frames)
    maps = prediction.instances[-1, :frames]
    names, counts = np.unique(maps, return_counts=True)
    return np.asarray(maps != names[np.argmax(counts)])


def _place(name: str, group: Group, says: str, remedy: str) -> Suspicion:
    return Suspicion(
        name=name,
        group=group,
        says=says,
        remedy=remedy,
        measure="IoU of the actors' cells",
        least=_LEAST,
        evidence=_CELLS,
        margin=_MARGIN,
    )


def _unscaled(predicted: BoolArray, grid: BevGrid, scale: float) -> tuple[BoolArray, BoolArray]:
    """Maps (T, rows, columns) in the devkit's orientation as if all were `scale` times too far; and what is known.

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


def _orientation_remedy(symmetry: Symmetry, stated: Orientation) -> str:
    mistaken = orientation_mistaken(symmetry, stated)
    if mistaken is None:
        return "no orientation of the devkit explains this: mirror or turn the maps back before writing them"
    return (
        f"maps in the orientation {mistaken!r} look so where {stated!r} is stated: state orientation {mistaken!r}, or "
        "mirror or turn the maps back before writing them"
    )
