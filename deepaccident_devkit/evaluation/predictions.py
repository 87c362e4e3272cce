"""The predictions of a model for a sample, from any framework, and the frames and cells of them that are evaluated."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import EvaluationError, GeometryError
from deepaccident_devkit.geometry import BevGrid, Boxes
from deepaccident_devkit.geometry.bev_grid import Orientation
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

# Of K stacked predictions; centerness may lack that of its only channel.
_AXES: Final = {"segmentation": (5,), "centerness": (4, 5), "offset": (5,), "flow": (5,)}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MotionOutput(FrozenArrays):
    """K predictions of one sample's motion, in the present ego frame; give either heads or instances.

    The released order counts: five samples, then the mean; VPQ and IoU take the last one. A single prediction is fine.

    Attributes:
        grid: the cells; its orientation is how the maps lie.
        heads: K times a model's maps of T frames, the present first (a single one may stand alone); None if
            `instances` are given.
        instances: (K, T, H, W) int32, ids from 1 that stay the same over the frames, 0 elsewhere; None with heads.
        orientation: an argument of the constructor: how the maps lie, None for the grid's. The grid keeps it: this
            field is always None.
    """

    grid: BevGrid
    heads: tuple[MotionHeads, ...] | None = None
    instances: AnyArray | None = None
    orientation: Orientation | None = None

    def __post_init__(self) -> None:
        """Check and freeze.

        Raises:
            GeometryError: both or none are given, nothing is predicted, or a shape is not the grid's.
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
        """Heads as a model gives them: stacked arrays of any framework (`support.arrays.as_numbers`), and lists.

        float32 arrays in the processor's memory are not copied. A single prediction may lack the first axis, K, in all
        four. The arrays are of one sample: K is no batch.

        Args:
            segmentation: (K, T, 2, H, W) logits: background, actor.
            centerness: (K, T, 1, H, W), also (K, T, H, W).
            offset: (K, T, 2, H, W) cells down the rows and along the columns to the instance's centre.
            flow: (K, T, 2, H, W) cells to where the instance is at the next frame.
            grid: the cells.
            orientation: how the maps lie, their vectors with them; None for as the grid says.

        Raises:
            GeometryError: another shape, NaN, or an array that cannot be read from here (see the message's remedy).
            ChoiceError: no such orientation.
        """
        laid = _checked_grid(grid, orientation)
        given = {
            "segmentation": segmentation,
            "centerness": centerness,
            "offset": offset,
            "flow": flow,
        }
        maps = {name: as_numbers(name, values, dtype=np.float32) for name, values in given.items()}
        if maps["segmentation"].ndim == 4:
            maps = {name: values[None] for name, values in maps.items()}
        count = len(maps["segmentation"]) if maps["segmentation"].ndim == 5 else None
        for name, values in maps.items():
            if count is None or values.ndim not in _AXES[name] or len(values) != count:
                shapes = ", ".join(f"{each} {np.shape(array)}" for each, array in maps.items())
                raise GeometryError(
                    f"{name}: expected (K, T, channels, H, W), or (T, channels, H, W), found {shapes}"
                )
        heads = (
            MotionHeads(
                **{name: values[index] for name, values in maps.items()},
                orientation=laid.orientation,
            )
            for index in range(count or 0)
        )
        return cls(grid=laid, heads=tuple(heads))

    def __len__(self) -> int:
        """Number of predictions, K."""
        return (
            len(self.heads)
            if self.heads is not None
            else len(self.instances if self.instances is not None else ())
        )

    def __repr__(self) -> str:
        """Predictions, frames, cells, and which of the two forms."""
        maps = (
            self.instances[0] if self.instances is not None else (self.heads or ())[0].segmentation
        )
        form = "heads" if self.instances is None else "instances"
        plural = "s" * (len(self) != 1)
        return f"MotionOutput({len(self)} prediction{plural} of {len(maps)} frames, {self.grid.text}, {form})"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Accident(FrozenArrays):
    """A predicted accident.

    Attributes:
        positions: (2, 2) x forward, y left of the two that collide, metres in the present ego frame.
        time: seconds after the present, from 0.
        score: how sure the model is, the more the higher.
        ids: their actor ids, in the order of `positions`; None if the model has none.
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
                f"accident time: expected seconds after the present, found {time}; leave out the past"
            )
        for name, value in {
            "positions": positions,
            "time": time,
            "score": score,
            "ids": _checked_ids(self.ids),
        }.items():
            object.__setattr__(self, name, value)
        FrozenArrays.__post_init__(self)


Prediction = MotionOutput | Iterable[Accident]


def instances_of(values: ArrayLike, grid: BevGrid) -> MotionOutput:
    """One prediction (T, H, W), or K of them (K, T, H, W), given as instance maps; raises GeometryError."""
    maps = as_numbers("instances", values, dtype=None)
    height, width = _checked_grid(grid, None).shape
    if maps.ndim not in (3, 4) or maps.shape[-2:] != (height, width):
        raise GeometryError(
            f"instances: expected shape (T, {height}, {width}), or (K, T, {height}, {width}) for K predictions, found "
            f"{maps.shape}"
        )
    return MotionOutput(grid=grid, instances=maps[None] if maps.ndim == 3 else maps)


def checked_prediction(prediction: object) -> MotionOutput | list[Accident]:
    """A prediction, explicit accidents as a list; raises EvaluationError if it is neither motion nor accidents."""
    if isinstance(prediction, MotionOutput):
        return prediction
    alarms: list[Accident] = []
    # empty Boxes are no alarm only by mistake
    for each in (
        prediction
        if isinstance(prediction, Iterable) and not isinstance(prediction, Boxes)
        else [prediction]
    ):
        if each is prediction or not isinstance(each, Accident):
            raise EvaluationError(
                f"prediction: expected a MotionOutput or a list of Accidents, found {type(prediction).__name__} with "
                f"{type(each).__name__}; wrap a single Accident in a list, give [] for no alarm, and make an output of "
                "instance maps with instances_of"
            )
        alarms.append(each)
    return alarms


def _checked_grid(grid: object, orientation: Orientation | None) -> BevGrid:
    if not isinstance(grid, BevGrid):
        raise GeometryError(
            f"grid: expected a BevGrid, such as label.config.grid, found {type(grid).__name__}"
        )
    return grid if orientation is None else grid.with_orientation(orientation)


def _checked_heads(heads: object, grid: BevGrid) -> tuple[MotionHeads, ...]:
    given = (heads,) if isinstance(heads, MotionHeads) else heads
    if not isinstance(given, Sequence) or not all(isinstance(each, MotionHeads) for each in given):
        kinds = (
            sorted({type(each).__name__ for each in given})
            if isinstance(given, Sequence)
            else [type(given).__name__]
        )
        raise GeometryError(
            f"heads: expected MotionHeads, found {', '.join(kinds)}; of arrays, make the output with "
            "MotionOutput.from_arrays(segmentation, centerness, offset, flow, grid=…)"
        )
    if not given:
        raise GeometryError("heads: expected at least one prediction, found none")
    for each in given:
        if each.segmentation.shape[-2:] != grid.shape or each.orientation != grid.orientation:
            raise GeometryError(
                f"heads: expected maps of {grid.shape} cells in orientation {grid.orientation}, found "
                f"{each.segmentation.shape[-2:]} in {each.orientation}"
            )
    return tuple(given)


def ascending_times(values: ArrayLike) -> FloatArray:
    """(T,) seconds after the present of a predicted path, a copy; raises GeometryError if they are not ascending."""
    times = checked("times", values, (None,)).copy()
    if not (
        len(times) and np.isfinite(times).all() and times[0] >= 0 and (np.diff(times) > 0).all()
    ):
        raise GeometryError(
            f"times: expected ascending seconds after the present, found {times.tolist()}"
        )
    return times


# Seconds: the times of a path that is longer are probably no seconds.
LONGEST_PATH: Final = 10.0
LONG_PATHS: Final = (
    "suspicious: {path} longer than 10 s; times are in seconds, not in frames or milliseconds"
)


def _checked_ids(ids: object) -> tuple[int, int] | None:
    if ids is None:
        return None
    pair = ids.tolist() if isinstance(ids, np.ndarray) else ids
    if not isinstance(pair, Sequence) or isinstance(pair, str) or len(pair) != 2:
        raise GeometryError(
            f"accident ids: expected two actor ids, or None for unknown ones, found {ids!r}"
        )
    first, second = (
        checked_whole("accident ids", each, "two whole numbers, or None for unknown ones")
        for each in pair
    )
    return first, second


# Cells: edges of a range fall on edges of cells, apart from rounding.
_TINY: Final = 1e-6


def compared_labels(
    dataset: Dataset, token: str, rules: Any, form: Any, horizon: float
) -> MotionLabels | None:
    """The sample's motion labels as `label_config` says; None where there is none to compare with."""
    config = label_config(rules, form, horizon)
    return None if config is None else motion_labels(dataset, token, config)


def label_config(rules: Any, form: Any, horizon: float) -> MotionLabelConfig | None:
    """What the labels show that predictions are compared with; None for explicit accidents by rules without labels.

    Args:
        rules: whose `labels` name the label protocol, where they have it; else the form does.
        form: `Results.form`, how motion is stored; None for explicit accidents.
        horizon: seconds that the labels look ahead.
    """
    labels = getattr(rules, "labels", None)
    if form is not None:
        step, protocol = round(form.step / FRAME_PERIOD), labels or form.labels or "clean"
        config = MotionLabelConfig(grid=form.grid, step=step, protocol=protocol)
    elif hasattr(rules, "labels"):
        config = MotionLabelConfig(protocol=labels or "released")
    else:
        return None
    return replace(config, future_frames=round(horizon / (config.step * FRAME_PERIOD)))


def labels_at_present(label: MotionLabels) -> MotionLabels:
    """Labels with every frame in the present ego frame, warped with bilinear centres where they are not yet."""
    return label if label.at_present else label.to_present(centerness="bilinear")


def frames_there(label: MotionLabels) -> int:
    """How many label frames, from the present on, are in the recording; raises EvaluationError if none is."""
    valid = label.label_valid
    count = len(valid) if valid.all() else int(np.argmin(valid))
    if not count:
        raise EvaluationError(
            "labels: the present frame is not in the recording; choose another sample"
        )
    return count


def checked_pair(prediction: object, label: object) -> tuple[MotionOutput, MotionLabels]:
    """A prediction of motion and the labels it is compared with, as they are; raises EvaluationError for others."""
    if not isinstance(prediction, MotionOutput):
        raise EvaluationError(
            f"prediction: expected a MotionOutput, found {type(prediction).__name__}; make one with "
            "MotionOutput.from_arrays(…), of MotionHeads with MotionOutput(…), of instance maps with instances_of(…)"
        )
    if not isinstance(label, MotionLabels):
        raise EvaluationError(
            f"label: expected MotionLabels, found {type(label).__name__}; give what dataset.motion_labels(token) or a "
            "folder of label files has of the sample"
        )
    return prediction, label


def compared_frames(
    prediction: MotionOutput | list[Accident], label: MotionLabels, protocol: str | None
) -> int:
    """How many frames of a prediction are compared with labels; explicit accidents fit all labels.

    Raises:
        EvaluationError: the labels are of another label protocol (None for any) or have no frame that is in the
            recording, or the prediction covers other ground or has too few frames.
    """
    if protocol is not None and label.config.rules != LABEL_PROTOCOLS[protocol]:
        raise EvaluationError(
            f"labels: expected those of the label protocol {protocol!r}, found others; make them with "
            f"MotionLabelConfig(protocol={protocol!r}), or give the metrics' protocol another value of its field labels"
        )
    frames, grid = frames_there(label), label.config.grid
    if not isinstance(prediction, MotionOutput):
        return frames
    if (prediction.grid.x, prediction.grid.y) != (grid.x, grid.y):
        raise EvaluationError(
            f"prediction: its cells cover x {prediction.grid.x}, y {prediction.grid.y}; expected those of the labels, "
            f"x {grid.x}, y {grid.y}: make both with the same grid"
        )
    maps = () if prediction.instances is None else prediction.instances
    predicted = min([*(len(each.segmentation) for each in prediction.heads or ()), *map(len, maps)])
    if predicted < frames:
        raise EvaluationError(
            f"prediction: expected at least {frames} frames from the present on, found {predicted}"
        )
    return frames


def first_frames(heads: MotionHeads, frames: int) -> MotionHeads:
    """Heads without the frames from `frames` on."""
    if len(heads.segmentation) == frames:
        return heads
    return replace(heads, **{name: getattr(heads, name)[:frames] for name in _AXES})


def cells_within(grid: BevGrid, extent: float) -> tuple[slice, slice]:
    """Rows and columns of the cells whose centres are in a square of `extent` metres around the ego."""
    spans = [
        [
            min(max(math.ceil((edge - low) / size - 0.5 - _TINY), 0), round((high - low) / size))
            for edge in edges
        ]
        for (low, high, size), edges in (
            (axis, (-extent / 2, extent / 2)) for axis in (grid.x, grid.y)
        )
    ]
    along_x, along_y = (slice(first, stop) for first, stop in spans)
    if grid.orientation == "fiery":
        return along_x, along_y
    if grid.orientation == "released":
        rows = grid.shape[0]
        along_y = slice(rows - along_y.stop, rows - along_y.start)
    return along_y, along_x
