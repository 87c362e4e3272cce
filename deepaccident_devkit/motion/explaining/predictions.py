"""What a prediction put at a cell of the labels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Protocol, runtime_checkable

import numpy as np

from deepaccident_devkit.arrays import AnyArray, FloatArray, checked
from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion.cells.parts import Cell, CellPrediction, CellValues, Pair
from deepaccident_devkit.motion.explaining.quirks import actor_of, cell_values
from deepaccident_devkit.motion.labels import MotionLabels
from deepaccident_devkit.motion.orientations import vectors_in
from deepaccident_devkit.motion.postprocessing.heads import MotionHeads
from deepaccident_devkit.motion.postprocessing.predict import LinkedInstances, predict_instances

_POST_PROCESSING: Final = "motion"


@runtime_checkable
class PredictedMotion(Protocol):
    """A `MotionOutput`: K predictions on a grid, as heads or as instance maps (K, T, H, W)."""

    @property
    def grid(self) -> BevGrid:
        """The cells; its orientation is how the maps lie."""
        ...

    @property
    def heads(self) -> Sequence[MotionHeads] | None:
        """A model's maps."""
        ...

    @property
    def instances(self) -> AnyArray | None:
        """Ids."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Predicted:
    """Any kind of prediction: its grid, the last prediction's instances (T, H, W), and all heads if there are some."""

    grid: BevGrid
    instance: AnyArray
    heads: tuple[MotionHeads, ...]


def cell_prediction(
    labels: MotionLabels, t: int, values: CellValues, point: Pair, prediction: object
) -> CellPrediction:
    """What a prediction has at a point of the present ego frame, beside the values of the labels' cell there.

    Args:
        labels: all maps.
        t: label frame.
        values: the labels' at the cell.
        point: the middle of the labels' cell in the present ego frame, metres.
        prediction: as `MotionLabels.explain` takes it.

    Raises:
        GeometryError: it is no prediction, or of another shape.
    """
    predicted = _predicted(prediction, labels.config.grid)
    frames = len(predicted.instance)
    if t >= frames:
        return CellPrediction(outcome="no such frame", frames=frames)
    (index,), (inside,) = predicted.grid.index_of([point])
    if not inside:
        return CellPrediction(outcome="outside", frames=frames)
    cell: Cell = (int(index[0]), int(index[1]))
    instance = int(predicted.instance[t][cell])
    there, here = instance != 0, values.segmentation == 1
    result = CellPrediction(
        outcome=("found" if there else "missed") if here else ("false alarm" if there else "empty"),
        frames=frames,
        cell=cell,
        instance=instance,
        instance_cells=int((predicted.instance[t] == instance).sum()) if there else 0,
    )
    if predicted.heads:
        result = _with_heads(result, predicted.heads, t, cell, labels.config.grid)
    return _with_overlap(result, labels, t, predicted) if there else result


def _predicted(prediction: Any, grid: BevGrid) -> _Predicted:
    laid, heads = grid, tuple[MotionHeads, ...]()
    if isinstance(prediction, MotionHeads):
        laid, heads = grid.with_orientation(prediction.orientation), (prediction,)
    elif isinstance(prediction, LinkedInstances):
        return _of_instances(prediction.instance, grid.with_orientation(prediction.orientation))
    elif isinstance(prediction, PredictedMotion):
        if prediction.instances is not None:
            return _of_instances(prediction.instances[-1], prediction.grid)
        laid, heads = prediction.grid, tuple(prediction.heads or ())
    else:
        return _of_instances(prediction, grid)
    if not heads or heads[-1].segmentation.shape[-2:] != laid.shape:
        raise GeometryError(f"prediction: expected heads of {laid.text}, found {prediction!r}; give a MotionOutput")
    return _Predicted(grid=laid, instance=predict_instances(heads[-1], _POST_PROCESSING).instance, heads=heads)


def _of_instances(instance: Any, grid: BevGrid) -> _Predicted:
    maps = checked("prediction", instance, (None, *grid.shape), np.int32)
    return _Predicted(grid=grid, instance=maps, heads=())


def _with_heads(
    result: CellPrediction, heads: tuple[MotionHeads, ...], t: int, cell: Cell, grid: BevGrid
) -> CellPrediction:
    last = heads[-1]
    logits = np.array([each.segmentation[t][(..., *cell)] for each in heads], dtype=np.float64)
    probabilities = _sigmoids(logits[:, 1] - logits[:, 0]).tolist()
    offset, flow = (
        vectors_in(values[t, 0][cell], values[t, 1][cell], last.orientation, grid.orientation)
        for values in (last.offset, last.flow)
    )
    return replace(
        result,
        probability=probabilities[-1],
        probabilities=tuple(probabilities),
        centerness=float(last.centerness[t, 0][cell]),
        offset=(float(offset[0]), float(offset[1])),
        flow=(float(flow[0]), float(flow[1])),
    )


def _sigmoids(values: FloatArray) -> FloatArray:
    result: FloatArray = (1 + np.tanh(values / 2)) / 2  # does not overflow
    return result


def _with_overlap(result: CellPrediction, labels: MotionLabels, t: int, predicted: _Predicted) -> CellPrediction:
    """With the labels' actor that the predicted instance covers most; it needs the same cells in the same frame."""
    grid = labels.config.grid
    if predicted.grid.with_orientation(grid.orientation) != grid or not (labels.at_present or t == 0):
        return result
    instance = predicted.grid.reorient(predicted.instance[t], grid.orientation)
    shown = (instance == result.instance) & (labels.segmentation[t] == 1)
    identity, counts = np.unique(labels.instance[t][shown], return_counts=True)
    if not len(identity):
        return result
    most = int(counts.argmax())
    place = np.argwhere(shown & (labels.instance[t] == identity[most]))[0]
    return replace(result, mostly=_actor_at(labels, t, place), shared_cells=int(counts[most]))


def _actor_at(labels: MotionLabels, t: int, place: AnyArray) -> int | None:
    return actor_of(labels, cell_values(labels, t, (int(place[0]), int(place[1]))))
