"""`explain_cell_from_boxes`: how one cell of motion labels came to its values, from the boxes of its frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import get_args

import numpy as np

from deepaccident_devkit.arrays import checked_whole
from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.motion.cells.explanation import CellExplanation
from deepaccident_devkit.motion.cells.parts import Cell, CellBox, CellPeak, CellSource, CellValues
from deepaccident_devkit.motion.drawing.box_polygons import FrameBoxes
from deepaccident_devkit.motion.explaining.boxes import FrameCandidates
from deepaccident_devkit.motion.explaining.predictions import cell_prediction
from deepaccident_devkit.motion.explaining.quirks import Remaker, actor_of, cell_values
from deepaccident_devkit.motion.explaining.sources import cell_source, poses_at_present
from deepaccident_devkit.motion.labels import MotionLabels
from deepaccident_devkit.motion.warps.warping import WarpMode
from deepaccident_devkit.taxonomy import FRAME_PERIOD, UNTRACKED_ID

_MAPS = ("segmentation", "instance", "centerness", "offset", "flow")


def explain_cell_from_boxes(
    labels: MotionLabels,
    frames: Sequence[FrameBoxes | None],
    t: int,
    row: int,
    col: int,
    *,
    is_vehicle: bool = True,
    prediction: object = None,
) -> CellExplanation:
    """How a cell came to its values, from the boxes that the labels were made from; see `MotionLabels.explain`.

    Args:
        labels: of `motion_labels_from_boxes`, or the same at the present.
        frames: its argument: the boxes of each label frame.
        t: label frame, as in the arrays; 0 is the present.
        row: of the cell, in the labels' orientation.
        col: its column.
        is_vehicle: whether the agent is a vehicle, with a box of its own.
        prediction: what a model put there, in any of the forms that `MotionLabels.explain` takes.

    Returns:
        The explanation without tokens.

    Raises:
        GeometryError: there is no such cell, another number of frames, or the prediction has another shape.
    """
    t, *cell = _checked_place(labels, (t, row, col))
    return _explained(Remaker(labels=labels, frames=frames, is_vehicle=is_vehicle), t, (cell[0], cell[1]), prediction)


def _explained(remaker: Remaker, t: int, cell: Cell, prediction: object) -> CellExplanation:
    labels, own_frames = remaker.labels, remaker.own_frames()
    config, values = labels.config, cell_values(labels, t, cell)
    mode = _sampled(remaker, own_frames, t)
    source = cell_source(labels, t, cell, mode)
    remade = remaker.like_given(own_frames, mode or "nearest")
    pose = poses_at_present(labels)[t]
    candidates = (
        FrameCandidates.of(remaker.frames, t, config, pose, is_vehicle=remaker.is_vehicle)
        if labels.label_valid[t] or config.rules.missing_frames_are_empty
        else None
    )
    painter, covered, left_out, nearest = _boxes_at(candidates, source, labels)
    x, y = config.grid.centers()[cell].tolist()
    seen = (pose @ (x, y, 0, 1))[:2].tolist() if t and not labels.at_present else (x, y)
    return CellExplanation(
        t=t,
        cell=cell,
        seconds=t * config.step * FRAME_PERIOD,
        at_present=labels.at_present,
        recorded=bool(labels.label_valid[t]),
        center=(x, y),
        values=values,
        source=source,
        painter=painter,
        covered=covered,
        left_out=left_out,
        nearest=nearest,
        peak=_peak(own_frames, t, source),
        quirks=remaker.quirks(remade, t, cell, mode or "nearest"),
        disagrees=_disagreements(labels, values, cell_values(remade, t, cell), painter),
        protocol=config.protocol if isinstance(config.protocol, str) else "own",
        prediction=None if prediction is None else cell_prediction(labels, t, values, (seen[0], seen[1]), prediction),
    )


def _checked_place(labels: MotionLabels, place: tuple[int, int, int]) -> list[int]:
    result = []
    for name, value, count in zip(("t", "row", "col"), place, labels.segmentation.shape, strict=True):
        whole = checked_whole(name, value)
        if not 0 <= whole < count:
            what = " (0 is the present)" if name == "t" else ""
            raise GeometryError(f"{name}: expected 0 to {count - 1}{what}, found {whole}")
        result.append(whole)
    return result


def _sampled(remaker: Remaker, own_frames: MotionLabels, t: int) -> WarpMode | None:
    """How the labels' centerness was sampled; None if neither mode gives what they have in frame t."""
    given = remaker.labels.centerness[t]
    for mode in get_args(WarpMode):
        if np.array_equal(remaker.like_given(own_frames, mode).centerness[t], given):
            found: WarpMode = mode
            return found
    return None


def _boxes_at(
    candidates: FrameCandidates | None, source: CellSource, labels: MotionLabels
) -> tuple[CellBox | None, tuple[CellBox, ...], tuple[CellBox, ...], CellBox | None]:
    """The painter, the boxes under it, those left out, and of an empty cell the nearest that is rasterised."""
    if candidates is None or source.cell is None or source.center is None:
        return None, (), (), None
    middle = source.center

    def box(number: int) -> CellBox:
        found = candidates.box(number, middle)
        return replace(found, label_id=labels.id_map.get(found.actor_id))

    numbers = candidates.covering(source.cell)
    drawn = [number for number in numbers if candidates.drawn[number]]
    left_out = tuple(box(number) for number in numbers if not candidates.drawn[number])
    if drawn:
        *under, top = drawn
        return box(top), tuple(box(number) for number in reversed(under)), left_out, None
    shown = np.flatnonzero(candidates.drawn)
    nearest = box(int(shown[candidates.distances(middle)[shown].argmin()])) if len(shown) else None
    return None, (), left_out, nearest


def _peak(own_frames: MotionLabels, t: int, source: CellSource) -> CellPeak | None:
    """The centre in frame t's own raster that is nearest to the source cell."""
    if source.cell is None:
        return None
    places = np.argwhere(own_frames.segmentation[t] == 1)
    _, first = np.unique(own_frames.instance[t][tuple(places.T)], return_index=True)
    if not len(first):
        return None
    ones = places[first]
    centers = ones + own_frames.offset[t][:, ones[:, 0], ones[:, 1]].T
    distances = np.hypot(*(centers - source.cell).T)
    nearest = int(distances.argmin())
    one: Cell = (int(ones[nearest, 0]), int(ones[nearest, 1]))
    actor = actor_of(own_frames, cell_values(own_frames, t, one))
    center = (round(float(centers[nearest, 0])), round(float(centers[nearest, 1])))
    return None if actor is None else CellPeak(actor_id=actor, center=center, distance=float(distances[nearest]))


def _disagreements(
    labels: MotionLabels, values: CellValues, remade: CellValues, painter: CellBox | None
) -> tuple[str, ...]:
    """The maps whose values the boxes do not give, and `painter` if the labels show another actor here."""
    maps = [name for name in _MAPS if getattr(values, name) != getattr(remade, name)]
    untracked = painter is not None and painter.actor_id == UNTRACKED_ID
    if untracked and "instance" in maps and not labels.config.rules.untracked_share_an_id:
        maps.remove("instance")  # each has a number of its own, which no actor's id tells
    if labels.id_map:
        shown = actor_of(labels, values)
        same = shown == (None if painter is None else painter.actor_id)
    else:  # labels of another code's loader do not know their actors
        same = (values.segmentation == 1) == (painter is not None)
    return (*maps, *(() if same else ("painter",)))
