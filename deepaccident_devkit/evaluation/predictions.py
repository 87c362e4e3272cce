"""A model's predictions for a sample, from any framework, and which frames and cells to compare."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, cast

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import EvaluationError, GeometryError
from deepaccident_devkit.evaluation.drawing import Drawing, DrawnPlaces
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

# Head → possible numbers of axes of its K stacked maps; the axis of centerness' single channel may
# be missing.
_AXES = {"segmentation": (5,), "centerness": (4, 5), "offset": (5,), "flow": (5,)}
# If a path is longer than this, its times are probably not in seconds.
LONGEST_PATH: Final = 10.0
LONG_PATHS: Final = (
    "suspicious: {path} longer than 10 s; times are in seconds, not in frames or milliseconds"
)
# Because of rounding, an edge of a range may differ from an edge of a cell by this fraction of it.
_CELL_TOLERANCE = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MotionOutput(FrozenArrays):
    """K predictions of one sample's motion, in the current ego frame, as heads or instances.

    The order matters, and should be the released one: five random draws, then their mean. VPQ and
    IoU use the last prediction. A single prediction is accepted, too.

    Attributes:
        grid: Cells and orientation of the maps.
        heads: K predictions of a model over T frames, the current one first; None if
            `instances` are passed. A single prediction need not be in a tuple.
        instances: (K, T, H, W) int32, ids from 1 that stay the same over the frames, 0 elsewhere;
            None if `heads` are passed.
        orientation: Only an argument of the constructor: orientation of the maps; None for the
            grid's. It is stored in the grid, so this field is always None.
    """

    grid: BevGrid
    heads: tuple[MotionHeads, ...] | None = None
    instances: AnyArray | None = None
    orientation: Orientation | None = None

    def __post_init__(self) -> None:
        """Check and freeze.

        Raises:
            GeometryError: If heads and instances are both passed or both missing, if there is no
                prediction, or if a shape does not match the grid.
            ChoiceError: If the orientation does not exist.
        """
        grid = checked_grid(self.grid, self.orientation)
        if (self.heads is None) == (self.instances is None):
            raise GeometryError("motion output: give either heads or instances")
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
        """Create predictions from stacked arrays of a model's heads, from any framework.

        `support.arrays.as_numbers` reads the arrays or lists; float32 arrays in CPU memory are not
        copied. For a single prediction, the first axis, K, may be missing in all four arrays. The
        arrays belong to one sample: K is not a batch.

        Args:
            segmentation: Logits of background and actor, (K, T, 2, H, W).
            centerness: Centerness, (K, T, 1, H, W) or (K, T, H, W).
            offset: Vector to the instance's centre, (K, T, 2, H, W) cells, along rows, then along
                columns.
            flow: Vector to the instance's position in the next frame, (K, T, 2, H, W) cells, in the
                same order.
            grid: Cells of the maps.
            orientation: Orientation of the maps and their vectors; None for the grid's.

        Raises:
            GeometryError: If an array has the wrong shape, contains NaN, or cannot be read in this
                process (the message explains what to do).
            ChoiceError: If the orientation does not exist.
        """
        oriented_grid = checked_grid(grid, orientation)
        arrays = {
            "segmentation": segmentation,
            "centerness": centerness,
            "offset": offset,
            "flow": flow,
        }
        maps = {name: as_numbers(name, array, dtype=np.float32) for name, array in arrays.items()}
        if maps["segmentation"].ndim == 4:  # a single prediction
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
        """Return the numbers of predictions, frames and cells, and the form."""
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
        positions: Positions of the colliding pair, (2, 2) x forward, y left, metres in the current
            ego frame.
        time: Seconds after the current frame, at least 0.
        score: Confidence of the model; higher means more certain.
        ids: Actor ids of the pair, in the order of `positions`; None if the model does not predict
            them.
    """

    positions: FloatArray
    time: float
    score: float = 1.0
    ids: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        """Check and freeze the fields; raise GeometryError if one is invalid."""
        positions = checked("accident positions", self.positions, (2, 2)).copy()
        if not np.isfinite(positions).all():
            raise GeometryError(
                "accident positions: not all numbers are finite; remove accidents without "
                "a predicted position"
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

    @property
    def words(self) -> str:
        """Time and score in words, such as `in 1.5 s, score 0.9`."""
        return f"in {self.time:.1f} s, score {self.score:.2g}"

    def drawing(self) -> Drawing:
        """Describe the predicted positions for a picture."""
        places = DrawnPlaces(
            xy=self.positions,
            time=self.time,
            role="predicted",
            note=self.words,
            label="predicted collision",
        )
        return Drawing(places=(places,))


Prediction = MotionOutput | Iterable[Accident]


def instances_of(values: ArrayLike, grid: BevGrid) -> MotionOutput:
    """Create predictions from instance maps; raise GeometryError if they do not fit the grid.

    Args:
        values: Instance maps of one prediction, (T, H, W), or of K predictions, (K, T, H, W).
        grid: Cells of the maps.
    """
    maps = as_numbers("instances", values, dtype=None)
    height, width = checked_grid(grid, None).shape
    if maps.ndim not in (3, 4) or maps.shape[-2:] != (height, width):
        raise GeometryError(
            f"instances: expected shape (T, {height}, {width}), or (K, T, {height}, {width}) for K "
            f"predictions, found {maps.shape}"
        )
    return MotionOutput(grid=grid, instances=maps[None] if maps.ndim == 3 else maps)


def _check_axes(maps: Mapping[str, AnyArray]) -> None:
    """Raise GeometryError if stacked heads have wrong axes or different numbers of predictions."""
    segmentation = maps["segmentation"]
    for name, array in maps.items():
        has_axes = segmentation.ndim == 5 and array.ndim in _AXES[name]
        if not has_axes or len(array) != len(segmentation):
            shapes = ", ".join(f"{head} {values.shape}" for head, values in maps.items())
            raise GeometryError(
                f"{name}: expected (K, T, channels, H, W), or (T, channels, H, W), found {shapes}"
            )


def checked_prediction(prediction: object) -> MotionOutput | list[Accident]:
    """Return motion unchanged, and explicit accidents as a list.

    Raise EvaluationError for anything else.
    """
    if isinstance(prediction, MotionOutput):
        return prediction
    # Boxes are iterable, too, and empty ones would pass as an empty list
    is_list = isinstance(prediction, Iterable) and not isinstance(prediction, Boxes)
    items = prediction if is_list else [prediction]
    alarms = []
    for item in cast("Iterable[object]", items):
        if item is prediction or not isinstance(item, Accident):
            raise EvaluationError(
                "prediction: expected a MotionOutput or a list of Accidents, found "
                f"{type(prediction).__name__} with {type(item).__name__}; wrap a single Accident "
                "in a list, give [] for no alarm, and make an output from instance maps with "
                "instances_of"
            )
        alarms.append(item)
    return alarms


def checked_grid(grid: object, orientation: Orientation | None) -> BevGrid:
    """Return a grid with an orientation; None keeps the grid's own orientation.

    Raise GeometryError if it is not a grid, or ChoiceError if the orientation does not exist.
    """
    if not isinstance(grid, BevGrid):
        raise GeometryError(
            f"grid: expected a BevGrid, such as label.config.grid, found {type(grid).__name__}"
        )
    return grid if orientation is None else grid.with_orientation(orientation)


def _checked_heads(heads: object, grid: BevGrid) -> tuple[MotionHeads, ...]:
    """Return heads as a tuple; raise GeometryError if one has the wrong type or grid."""
    predictions = (heads,) if isinstance(heads, MotionHeads) else heads
    is_sequence = isinstance(predictions, Sequence)
    items = list(cast("Sequence[object]", predictions)) if is_sequence else [predictions]
    non_heads = [item for item in items if not isinstance(item, MotionHeads)]
    if non_heads or not is_sequence:
        kinds = sorted({type(item).__name__ for item in items})
        raise GeometryError(
            f"heads: expected MotionHeads, found {', '.join(kinds)}; to make the output from "
            "arrays, call MotionOutput.from_arrays(segmentation, centerness, offset, flow, "
            "grid=…)"
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
    """Return a copy of the times of a predicted path, (T,) seconds after the current frame.

    Raise GeometryError if they are not ascending.
    """
    times = checked("times", values, (None,)).copy()
    begins_in_future = len(times) > 0 and np.isfinite(times).all() and times[0] >= 0
    if not (begins_in_future and (np.diff(times) > 0).all()):
        raise GeometryError(
            f"times: expected ascending seconds after the present, found {times.tolist()}"
        )
    return times


def _checked_ids(ids: object) -> tuple[int, int] | None:
    """Return a pair of actor ids, or None; raise GeometryError for anything else."""
    if ids is None:
        return None
    pair = ids.tolist() if isinstance(ids, np.ndarray) else ids
    if not isinstance(pair, Sequence) or isinstance(pair, str) or len(pair) != 2:
        raise GeometryError(
            f"accident ids: expected two actor ids, or None for unknown ones, found {ids!r}"
        )
    expected = "two whole numbers, or None for unknown ones"
    first = checked_whole("accident ids", pair[0], expected)
    second = checked_whole("accident ids", pair[1], expected)
    return first, second


def compared_labels(
    dataset: Dataset, token: str, rules: Any, form: Any, horizon: float
) -> MotionLabels | None:
    """Load the motion labels that a sample's prediction is compared with; None if not needed."""
    config = label_config(rules, form, horizon)
    if config is None:
        return None
    return motion_labels(dataset, token, config)


def label_config(rules: Any, form: Any, horizon: float) -> MotionLabelConfig | None:
    """Return the configuration of the labels that predictions are compared with.

    Args:
        rules: Rules of the metrics, whose field `labels` names the label protocol; rules without
            this field take the protocol of the form.
        form: How maps are stored (`Results.form`); None for explicit accidents.
        horizon: Seconds that the labels look ahead.

    Returns:
        The configuration; None for explicit accidents if the rules do not need labels.
    """
    labels = getattr(rules, "labels", None)
    if hasattr(form, "step"):
        step = round(form.step / FRAME_PERIOD)
        protocol = labels or form.labels or "clean"
        config = MotionLabelConfig(grid=form.grid, step=step, protocol=protocol)
    elif hasattr(rules, "labels"):
        config = MotionLabelConfig(protocol=labels or "released")
    else:
        return None
    return replace(config, future_frames=round(horizon / (config.step * FRAME_PERIOD)))


def labels_at_present(label: MotionLabels) -> MotionLabels:
    """Return labels with all frames in the current ego frame.

    If each frame is in its own ego frame, the labels are warped, with bilinear interpolation of
    centerness.
    """
    if label.at_present:
        return label
    return label.to_present(centerness="bilinear")


def num_recorded_frames(label: MotionLabels) -> int:
    """Return how many consecutive label frames, from the current one, the recording contains.

    Raises:
        EvaluationError: If the current frame is not in the recording.
    """
    is_valid = label.label_valid
    count = len(is_valid) if is_valid.all() else int(np.argmin(is_valid))
    if not count:
        raise EvaluationError(
            "labels: the present frame is not in the recording; choose another sample"
        )
    return count


def checked_pair(prediction: object, label: object) -> tuple[MotionOutput, MotionLabels]:
    """Return a motion prediction and its labels after checking their types.

    Raises:
        EvaluationError: If one of the two has another type.
    """
    if not isinstance(prediction, MotionOutput):
        raise EvaluationError(
            f"prediction: expected a MotionOutput, found {type(prediction).__name__}; make one "
            "from arrays with MotionOutput.from_arrays(…), from MotionHeads with "
            "MotionOutput(…), or from instance maps with instances_of(…)"
        )
    if not isinstance(label, MotionLabels):
        raise EvaluationError(
            f"label: expected MotionLabels, found {type(label).__name__}; give "
            "dataset.motion_labels(token), or the sample's labels from a folder of label files"
        )
    return prediction, label


def compared_frames(
    prediction: MotionOutput | list[Accident], label: MotionLabels, protocol: str | None
) -> int:
    """Return how many frames of a prediction are compared with labels.

    Explicit accidents are compared with all labelled frames that the recording contains.

    Args:
        prediction: Prediction of a sample.
        label: Labels of the sample.
        protocol: Label protocol that the labels must follow; None for any protocol.

    Raises:
        EvaluationError: If the labels follow another protocol or have no frame in the recording, or
            if the prediction covers another area or has too few frames.
    """
    if protocol is not None and label.config.rules != LABEL_PROTOCOLS[protocol]:
        raise EvaluationError(
            f"labels: expected labels of the label protocol {protocol!r}, found labels of "
            f"another; make them with MotionLabelConfig(protocol={protocol!r}), or give the "
            "metrics' protocol another value of its field labels"
        )
    frames = num_recorded_frames(label)
    grid = label.config.grid
    if not isinstance(prediction, MotionOutput):
        return frames
    if (prediction.grid.x, prediction.grid.y) != (grid.x, grid.y):
        raise EvaluationError(
            f"prediction: its cells cover x {prediction.grid.x}, y {prediction.grid.y}; expected "
            f"the cells of the labels, x {grid.x}, y {grid.y}. Make both with the same grid"
        )
    frame_counts = [len(heads.segmentation) for heads in prediction.heads or ()]
    if prediction.instances is not None:
        frame_counts += [len(maps) for maps in prediction.instances]
    predicted_frames = min(frame_counts)
    if predicted_frames < frames:
        raise EvaluationError(
            f"prediction: expected at least {frames} frames from the present on, found "
            f"{predicted_frames}"
        )
    return frames


def first_frames(heads: MotionHeads, frames: int) -> MotionHeads:
    """Cut heads to their first `frames` frames."""
    if len(heads.segmentation) == frames:
        return heads
    maps = {name: getattr(heads, name)[:frames] for name in _AXES}
    return replace(heads, **maps)


def cells_within(grid: BevGrid, extent: float) -> tuple[slice, slice]:
    """Return the slices of rows and columns whose cell centres are in a square around the ego.

    Args:
        grid: Cells and orientation of the maps.
        extent: Side length of the square, metres.
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
    """Return the slice of cells along an axis whose centres are within `extent` / 2 of the ego."""
    low, high, size = axis
    cell_count = round((high - low) / size)
    bounds = []
    for edge in (-extent / 2, extent / 2):
        cell = math.ceil((edge - low) / size - 0.5 - _CELL_TOLERANCE)
        bounds.append(min(max(cell, 0), cell_count))
    return slice(*bounds)
