"""Predictions of a model for a sample, from any framework, and the frames and cells evaluated."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, cast

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import EvaluationError, GeometryError
from deepaccident_devkit.geometry import BevGrid, Boxes
from deepaccident_devkit.geometry.bev_grid import Axis, Orientation
from deepaccident_devkit.motion import (
    LABEL_PROTOCOLS,
    MotionHeads,
    MotionLabelConfig,
    MotionLabels,
    motion_labels,
)
from deepaccident_devkit.support.arrays import (
    AnyArray,
    FloatArray,
    FrozenArrays,
    as_numbers,
    checked,
    checked_number,
    checked_whole,
)
from deepaccident_devkit.taxonomy import FRAME_PERIOD

# Numbers of axes of K stacked predictions; centerness may lack that of its only channel.
_AXES: Final = {"segmentation": (5,), "centerness": (4, 5), "offset": (5,), "flow": (5,)}
# Seconds: times of a longer path are probably not in seconds.
LONGEST_PATH: Final = 10.0
LONG_PATHS: Final = (
    "suspicious: {path} longer than 10 s; times are in seconds, not in frames or milliseconds"
)
# Share of a cell: edges of a range fall on edges of cells, apart from rounding.
_CELL_TOLERANCE: Final = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MotionOutput(FrozenArrays):
    """K predictions of one sample's motion, in the present ego frame, as heads or as instances.

    The released order counts: five samples, then the mean; VPQ and IoU use the last one. A single
    prediction is fine.

    Attributes:
        grid: Cells; its orientation is that of the maps.
        heads: K maps of a model over T frames, the present first (a single one need not be in a
            tuple); None with `instances`.
        instances: (K, T, H, W) int32, ids from 1 that stay the same over the frames, 0 elsewhere;
            None with heads.
        orientation: Argument of the constructor: orientation of the maps, None for the grid's. The
            grid stores it: this field is always None.
    """

    grid: BevGrid
    heads: tuple[MotionHeads, ...] | None = None
    instances: AnyArray | None = None
    orientation: Orientation | None = None

    def __post_init__(self) -> None:
        """Check and freeze.

        Raises:
            GeometryError: heads and instances are both passed, or both missing, nothing is
                predicted, or a shape is not the grid's.
            ChoiceError: no such orientation.
        """
        grid = _checked_grid(self.grid, self.orientation)
        if (self.heads is None) == (self.instances is None):
            raise GeometryError("motion output: give heads, or instances, and not both")
        if self.instances is not None:
            maps = checked("instances", self.instances, (None, None, *grid.shape), np.int32)
            if not len(maps):
                raise GeometryError("instances: expected at least one prediction, found none")
            object.__setattr__(self, "instances", maps)
        else:
            object.__setattr__(self, "heads", _checked_heads(self.heads, grid))
        object.__setattr__(self, "grid", grid)
        object.__setattr__(self, "orientation", None)
        FrozenArrays.__post_init__(self)

    @classmethod
    def from_arrays(
        cls,
        segmentation: ArrayLike,
        centerness: ArrayLike,
        offset: ArrayLike,
        flow: ArrayLike,
        *,
        grid: BevGrid,
        orientation: Orientation | None = None,
    ) -> MotionOutput:
        """Return heads from a model's stacked arrays, of any framework, or from lists.

        `support.arrays.as_numbers` reads the arrays; float32 arrays in the processor's memory are
        not copied. A single prediction may lack the first axis, K, in all four. The arrays are of
        one sample: K is not a batch.

        Args:
            segmentation: (K, T, 2, H, W) logits: background, actor.
            centerness: (K, T, 1, H, W), also (K, T, H, W).
            offset: (K, T, 2, H, W) cells down the rows and along the columns to the instance's
                centre.
            flow: (K, T, 2, H, W) cells to the instance's position at the next frame.
            grid: Cells of the maps.
            orientation: Orientation of the maps and their vectors; None for the grid's.

        Raises:
            GeometryError: another shape, NaN, or an array that cannot be read from here (see the
                message's remedy).
            ChoiceError: no such orientation.
        """
        oriented_grid = _checked_grid(grid, orientation)
        arrays = {
            "segmentation": segmentation,
            "centerness": centerness,
            "offset": offset,
            "flow": flow,
        }
        maps = {name: as_numbers(name, array, dtype=np.float32) for name, array in arrays.items()}
        if maps["segmentation"].ndim == 4:
            maps = {name: array[None] for name, array in maps.items()}
        _check_axes(maps)
        heads = []
        for index in range(len(maps["segmentation"])):
            prediction = {name: array[index] for name, array in maps.items()}
            heads.append(MotionHeads(**prediction, orientation=oriented_grid.orientation))
        return cls(grid=oriented_grid, heads=tuple(heads))

    def __len__(self) -> int:
        """Return the number of predictions, K."""
        if self.heads is not None:
            return len(self.heads)
        return len(self.instances if self.instances is not None else ())

    def __repr__(self) -> str:
        """Return predictions, frames, cells, and which of the two forms."""
        if self.instances is not None:
            maps = self.instances[0]
            form = "instances"
        else:
            maps = (self.heads or ())[0].segmentation
            form = "heads"
        predictions = f"{len(self)} prediction{'s' * (len(self) != 1)}"
        return f"MotionOutput({predictions} of {len(maps)} frames, {self.grid.text}, {form})"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Accident(FrozenArrays):
    """A predicted accident.

    Attributes:
        positions: (2, 2) x forward, y left of the colliding pair, metres in the present ego frame.
        time: Seconds after the present, from 0.
        score: Confidence of the model, higher is surer.
        ids: Their actor ids, in the order of `positions`; None if the model has none.
    """

    positions: FloatArray
    time: float
    score: float = 1.0
    ids: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        """Check and freeze; raises GeometryError."""
        positions = checked("accident positions", self.positions, (2, 2)).copy()
        if not np.isfinite(positions).all():
            raise GeometryError(
                "accident positions: not all numbers are finite; leave out what is not predicted"
            )
        time = checked_number("accident time", self.time, "seconds after the present")
        score = checked_number("accident score", self.score)
        if not (math.isfinite(time) and math.isfinite(score)):
            raise GeometryError(f"accident: time {time} and score {score} must be finite")
        if time < 0:
            raise GeometryError(
                f"accident time: expected seconds after the present, found {time}; leave out the "
                "past"
            )
        ids = _checked_ids(self.ids)
        object.__setattr__(self, "positions", positions)
        object.__setattr__(self, "time", time)
        object.__setattr__(self, "score", score)
        object.__setattr__(self, "ids", ids)
        FrozenArrays.__post_init__(self)


Prediction = MotionOutput | Iterable[Accident]


def instances_of(values: ArrayLike, grid: BevGrid) -> MotionOutput:
    """Return predictions from instance maps; raises GeometryError.

    Args:
        values: One prediction (T, H, W), or K of them (K, T, H, W).
        grid: Cells of the maps.
    """
    maps = as_numbers("instances", values, dtype=None)
    height, width = _checked_grid(grid, None).shape
    if maps.ndim not in (3, 4) or maps.shape[-2:] != (height, width):
        raise GeometryError(
            f"instances: expected shape (T, {height}, {width}), or (K, T, {height}, {width}) for K "
            f"predictions, found {maps.shape}"
        )
    return MotionOutput(grid=grid, instances=maps[None] if maps.ndim == 3 else maps)


def _check_axes(maps: Mapping[str, AnyArray]) -> None:
    """Check the axes of stacked heads; raises GeometryError."""
    segmentation = maps["segmentation"]
    for name, array in maps.items():
        has_axes = segmentation.ndim == 5 and array.ndim in _AXES[name]
        if not has_axes or len(array) != len(segmentation):
            shapes = ", ".join(f"{key} {np.shape(values)}" for key, values in maps.items())
            raise GeometryError(
                f"{name}: expected (K, T, channels, H, W), or (T, channels, H, W), found {shapes}"
            )


def checked_prediction(prediction: object) -> MotionOutput | list[Accident]:
    """Return a prediction, explicit accidents as a list; raises EvaluationError otherwise."""
    if isinstance(prediction, MotionOutput):
        return prediction
    # empty Boxes could only be a list of alarms by mistake
    is_list = isinstance(prediction, Iterable) and not isinstance(prediction, Boxes)
    items = prediction if is_list else [prediction]
    alarms: list[Accident] = []
    for item in cast("Iterable[object]", items):
        if item is prediction or not isinstance(item, Accident):
            raise EvaluationError(
                "prediction: expected a MotionOutput or a list of Accidents, found "
                f"{type(prediction).__name__} with {type(item).__name__}; wrap a single Accident "
                "in a list, give [] for no alarm, and make an output of instance maps with "
                "instances_of"
            )
        alarms.append(item)
    return alarms


def _checked_grid(grid: object, orientation: Orientation | None) -> BevGrid:
    """Return a grid in an orientation; raises GeometryError or ChoiceError."""
    if not isinstance(grid, BevGrid):
        raise GeometryError(
            f"grid: expected a BevGrid, such as label.config.grid, found {type(grid).__name__}"
        )
    return grid if orientation is None else grid.with_orientation(orientation)


def _checked_heads(heads: object, grid: BevGrid) -> tuple[MotionHeads, ...]:
    """Return heads as a tuple; raises GeometryError if they are not, or not of the grid."""
    predictions = (heads,) if isinstance(heads, MotionHeads) else heads
    is_sequence = isinstance(predictions, Sequence)
    items = list(cast("Sequence[object]", predictions)) if is_sequence else [predictions]
    non_heads = [item for item in items if not isinstance(item, MotionHeads)]
    if non_heads or not is_sequence:
        kinds = sorted({type(item).__name__ for item in items})
        raise GeometryError(
            f"heads: expected MotionHeads, found {', '.join(kinds)}; of arrays, make the output "
            "with MotionOutput.from_arrays(segmentation, centerness, offset, flow, grid=…)"
        )
    if not items:
        raise GeometryError("heads: expected at least one prediction, found none")
    checked_heads = tuple(cast("list[MotionHeads]", items))
    for item in checked_heads:
        shape = item.segmentation.shape[-2:]
        if shape != grid.shape or item.orientation != grid.orientation:
            raise GeometryError(
                f"heads: expected maps of {grid.shape} cells in orientation {grid.orientation}, "
                f"found {shape} in {item.orientation}"
            )
    return checked_heads


def ascending_times(values: ArrayLike) -> FloatArray:
    """Return a copy of the times of a predicted path, (T,) seconds after the present.

    Raises GeometryError if they are not ascending.
    """
    times = checked("times", values, (None,)).copy()
    is_valid = len(times) and np.isfinite(times).all() and times[0] >= 0
    if not (is_valid and (np.diff(times) > 0).all()):
        raise GeometryError(
            f"times: expected ascending seconds after the present, found {times.tolist()}"
        )
    return times


def _checked_ids(ids: object) -> tuple[int, int] | None:
    """Return two actor ids, or None; raises GeometryError."""
    if ids is None:
        return None
    pair = ids.tolist() if isinstance(ids, np.ndarray) else ids
    if not isinstance(pair, Sequence) or isinstance(pair, str) or len(pair) != 2:
        raise GeometryError(
            f"accident ids: expected two actor ids, or None for unknown ones, found {ids!r}"
        )
    expected = "two whole numbers, or None for unknown ones"
    first, second = (checked_whole("accident ids", value, expected) for value in pair)
    return first, second


def compared_labels(
    dataset: Dataset, token: str, rules: Any, form: Any, horizon: float
) -> MotionLabels | None:
    """Return the sample's motion labels; None where there is nothing to compare with."""
    config = label_config(rules, form, horizon)
    return None if config is None else motion_labels(dataset, token, config)


def label_config(rules: Any, form: Any, horizon: float) -> MotionLabelConfig | None:
    """Return the configuration of the labels that predictions are compared with.

    Args:
        rules: Rules with the name of the label protocol in `labels`; without it the form has the
            name.
        form: Form in which motion is stored (`Results.form`); None for explicit accidents.
        horizon: Seconds that the labels look ahead.

    Returns:
        The configuration; None for explicit accidents by rules without labels.
    """
    labels = getattr(rules, "labels", None)
    if form is not None:
        step = round(form.step / FRAME_PERIOD)
        protocol = labels or form.labels or "clean"
        config = MotionLabelConfig(grid=form.grid, step=step, protocol=protocol)
    elif hasattr(rules, "labels"):
        config = MotionLabelConfig(protocol=labels or "released")
    else:
        return None
    return replace(config, future_frames=round(horizon / (config.step * FRAME_PERIOD)))


def labels_at_present(label: MotionLabels) -> MotionLabels:
    """Return labels with every frame in the present ego frame.

    Labels in their own frames are warped with bilinear centres.
    """
    return label if label.at_present else label.to_present(centerness="bilinear")


def frames_there(label: MotionLabels) -> int:
    """Return the number of label frames, from the present on, that are in the recording.

    Raises:
        EvaluationError: the present frame is not in the recording.
    """
    valid = label.label_valid
    count = len(valid) if valid.all() else int(np.argmin(valid))
    if not count:
        raise EvaluationError(
            "labels: the present frame is not in the recording; choose another sample"
        )
    return count


def checked_pair(prediction: object, label: object) -> tuple[MotionOutput, MotionLabels]:
    """Return a prediction of motion and its labels as they are.

    Raises:
        EvaluationError: one of them is of another kind.
    """
    if not isinstance(prediction, MotionOutput):
        raise EvaluationError(
            f"prediction: expected a MotionOutput, found {type(prediction).__name__}; make one "
            "with MotionOutput.from_arrays(…), of MotionHeads with MotionOutput(…), of instance "
            "maps with instances_of(…)"
        )
    if not isinstance(label, MotionLabels):
        raise EvaluationError(
            f"label: expected MotionLabels, found {type(label).__name__}; give what "
            "dataset.motion_labels(token) or a folder of label files has of the sample"
        )
    return prediction, label


def compared_frames(
    prediction: MotionOutput | list[Accident], label: MotionLabels, protocol: str | None
) -> int:
    """Return the number of frames of a prediction that are compared with labels.

    Explicit accidents fit all labels.

    Args:
        prediction: Prediction of a sample.
        label: Labels of the sample.
        protocol: Label protocol that the labels must be of; None for any.

    Raises:
        EvaluationError: the labels are of another label protocol or have no frame that is in the
            recording, or the prediction covers other ground or has too few frames.
    """
    if protocol is not None and label.config.rules != LABEL_PROTOCOLS[protocol]:
        raise EvaluationError(
            f"labels: expected those of the label protocol {protocol!r}, found others; make them "
            f"with MotionLabelConfig(protocol={protocol!r}), or give the metrics' protocol another "
            "value of its field labels"
        )
    frames = frames_there(label)
    grid = label.config.grid
    if not isinstance(prediction, MotionOutput):
        return frames
    if (prediction.grid.x, prediction.grid.y) != (grid.x, grid.y):
        raise EvaluationError(
            f"prediction: its cells cover x {prediction.grid.x}, y {prediction.grid.y}; expected "
            f"those of the labels, x {grid.x}, y {grid.y}: make both with the same grid"
        )
    lengths = [len(heads.segmentation) for heads in prediction.heads or ()]
    if prediction.instances is not None:
        lengths += [len(maps) for maps in prediction.instances]
    predicted = min(lengths)
    if predicted < frames:
        raise EvaluationError(
            f"prediction: expected at least {frames} frames from the present on, found {predicted}"
        )
    return frames


def first_frames(heads: MotionHeads, frames: int) -> MotionHeads:
    """Return heads without the frames from `frames` on."""
    if len(heads.segmentation) == frames:
        return heads
    return replace(heads, **{name: getattr(heads, name)[:frames] for name in _AXES})


def cells_within(grid: BevGrid, extent: float) -> tuple[slice, slice]:
    """Return rows and columns of the cells with centres in a square around the ego.

    Args:
        grid: Cells and orientation.
        extent: Side of the square, metres.
    """
    along_x = _axis_within(grid.x, extent)
    along_y = _axis_within(grid.y, extent)
    if grid.orientation == "fiery":
        return along_x, along_y
    if grid.orientation == "released":
        rows = grid.shape[0]
        along_y = slice(rows - along_y.stop, rows - along_y.start)
    return along_y, along_x


def _axis_within(axis: Axis, extent: float) -> slice:
    """Return the cells along an axis with centres within `extent` / 2 of the ego."""
    low, high, size = axis
    count = round((high - low) / size)
    ends = []
    for edge in (-extent / 2, extent / 2):
        cell = math.ceil((edge - low) / size - 0.5 - _CELL_TOLERANCE)
        ends.append(min(max(cell, 0), count))
    return slice(*ends)
