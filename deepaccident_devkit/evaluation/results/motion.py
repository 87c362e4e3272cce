"""Motion results: the form of their arrays, and the arrays of a prediction in that form."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final, get_args

import numpy as np

from deepaccident_devkit.errors import GeometryError, ResultsError
from deepaccident_devkit.evaluation.predictions import MotionOutput
from deepaccident_devkit.evaluation.results.forms import ArrayLayout, MapsForm
from deepaccident_devkit.evaluation.results.records import (
    MAX_CELLS,
    ContentError,
    Stored,
)
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion import LABEL_PROTOCOLS, predict_instances
from deepaccident_devkit.support.arrays import AnyArray, checked_number
from deepaccident_devkit.support.text import settle_choices
from deepaccident_devkit.taxonomy import FRAME_PERIOD

# Name of a head → its number of channels.
HEADS: Final[Mapping[str, int]] = {"segmentation": 2, "centerness": 1, "offset": 2, "flow": 2}
_MAX_ID = 2**31 - 1
# A step may differ from a whole number of frames by this fraction of a frame.
_FRAME_TOLERANCE = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionForm(MapsForm):
    """Layout of stored motion results, which all samples of a file share.

    Attributes:
        stored: `instances` for maps of ids, `heads` for the outputs of the model.
        grid: BEV grid and orientation of the maps.
        predictions: Largest number K of predictions per sample; if there are several, the last one
            is the mean.
        frames: Number T of frames; the current frame is the first.
        step: Seconds between frames, a whole number of recorded frames (0.1 s).
        labels: Name of the label protocol (`motion.LABEL_PROTOCOLS`) that the model was trained on;
            None if unknown.
    """

    stored: Stored
    grid: BevGrid
    predictions: int
    frames: int
    step: float = 0.5
    labels: str | None = None

    def __post_init__(self) -> None:
        """Check the fields; raise a ResultsError that names the first invalid one."""
        if not isinstance(self.grid, BevGrid):
            raise ResultsError(f"grid: expected a BevGrid, found {type(self.grid).__name__}")
        allowed = {"stored": get_args(Stored), "labels": (*LABEL_PROTOCOLS, None)}
        settle_choices(self, allowed, error=ResultsError)
        for name in ("predictions", "frames"):
            value = getattr(self, name)
            if type(value) is not int or value < 1:
                raise ResultsError(f"{name}: expected a whole number from 1, found {value!r}")
        object.__setattr__(self, "step", checked_number("step", self.step, error=ResultsError))
        self._check_step()
        if self.predictions * self.frames * self.grid.cells > MAX_CELLS:
            raise ResultsError(
                f"form: {self.predictions} predictions of {self.frames} frames of "
                f"{self.grid.cells} cells do not fit into memory; store fewer"
            )

    def _check_step(self) -> None:
        """Raise ResultsError unless the step is a whole number of recorded frames."""
        frames = self.step / FRAME_PERIOD
        is_positive = math.isfinite(frames) and frames > 0.5
        if not (is_positive and abs(frames - round(frames)) < _FRAME_TOLERANCE):
            raise ResultsError(
                "step: expected seconds that are a multiple of 0.1 s (one frame), found "
                f"{self.step!r}"
            )

    @property
    def lookahead(self) -> float:
        """Seconds that the predictions look ahead."""
        return (self.frames - 1) * self.step

    @property
    def text(self) -> str:
        """The form in words."""
        return (
            f"{self.stored}, up to {self.predictions} predictions of {self.frames} frames, "
            f"{self.step:g} s apart, cells x {self.grid.x}, y {self.grid.y}, orientation "
            f"{self.grid.orientation}, labels {self.labels}"
        )

    def array_layout(self) -> dict[str, ArrayLayout]:
        """Return the layouts of a sample's arrays by name; the first axis may be shorter."""
        map_counts = (self.predictions, self.frames)
        if self.stored == "instances":
            shape: tuple[int, ...] = (*map_counts, *self.grid.shape)
            return {"instance": ArrayLayout(shape=shape, kinds="ui", min_length=1)}
        layout = {}
        for name, channels in HEADS.items():
            shape = (*map_counts, channels, *self.grid.shape)
            layout[name] = ArrayLayout(shape=shape, kinds="f", min_length=1)
        return layout

    def output(self, arrays: Mapping[str, AnyArray]) -> MotionOutput:
        """Build a sample's prediction from its arrays; raise ContentError if one is invalid."""
        if self.stored == "instances":
            maps = arrays["instance"]
            if maps.min() < 0 or maps.max() > _MAX_ID:
                raise ContentError(
                    f"instance: expected ids from 0 to {_MAX_ID}, found {maps.min()} to "
                    f"{maps.max()}"
                )
            return MotionOutput(grid=self.grid, instances=maps.astype(np.int32))
        try:
            return MotionOutput.from_arrays(*arrays.values(), grid=self.grid)
        except GeometryError as error:
            raise ContentError(str(error)) from error


class MotionEncoder:
    """Encoder that turns motion outputs into arrays, and determines the form that they share."""

    def __init__(
        self, grid: BevGrid | None, step: float, labels: str | None, store: Stored
    ) -> None:
        """Prepare to encode; see `ResultsWriter` for the arguments and errors."""
        self._grid = grid
        self._first_form = MotionForm(
            stored=store, grid=grid or BevGrid(), predictions=1, frames=1, step=step, labels=labels
        )
        self.form: MotionForm | None = None

    def encode(self, prediction: object) -> dict[str, AnyArray]:
        """Return a prediction's arrays by name; raise ResultsError if they cannot be stored."""
        output = self._check_output(prediction)
        arrays = self._make_arrays(output)
        first_array = next(iter(arrays.values()))
        predictions, frames = first_array.shape[:2]
        if self.form is not None and self.form.frames != frames:
            raise ResultsError(
                f"expected {self.form.frames} frames, as in earlier samples, found {frames}"
            )
        form = replace(self._first_form, grid=output.grid, predictions=predictions, frames=frames)
        self.adopt(form)
        return arrays

    def adopt(self, form: MotionForm) -> None:
        """Continue with the form of results from an encoder with the same arguments."""
        if self.form is not None:
            form = replace(form, predictions=max(form.predictions, self.form.predictions))
        self._grid = form.grid
        self.form = form

    def _check_output(self, prediction: object) -> MotionOutput:
        """Return the prediction; raise ResultsError if it has the wrong type or grid."""
        if not isinstance(prediction, MotionOutput):
            raise ResultsError(
                f"expected a MotionOutput, found {type(prediction).__name__}; make one with "
                "MotionOutput.from_arrays(…), or from instance maps with instances_of(…)"
            )
        if self._grid not in (None, prediction.grid):
            raise ResultsError(
                f"expected a prediction on {self._grid}, found one on {prediction.grid}; write "
                "predictions on different grids to different results"
            )
        return prediction

    def _make_arrays(self, output: MotionOutput) -> dict[str, AnyArray]:
        """Return the arrays to store by name; raise ResultsError if they cannot be stored."""
        if output.instances is not None and output.instances.min() < 0:
            raise ResultsError(
                f"instances: expected ids from 1, and 0 elsewhere, found {output.instances.min()}"
            )
        if self._first_form.stored == "instances":
            return instance_arrays(output)
        if output.heads is None:
            raise ResultsError(
                "expected heads, found instance maps; write instance maps with store='instances'"
            )
        if any(heads.ignore_index is not None for heads in output.heads):
            raise ResultsError(
                "expected the heads of a model, found heads made from labels, which contain "
                "values to ignore; write the instance maps of the labels with store='instances'"
            )
        return head_arrays(output)


def head_arrays(output: MotionOutput) -> dict[str, AnyArray]:
    """Return the heads of K predictions by name: float32 arrays (K, T, channels, H, W)."""
    arrays = {}
    for name in HEADS:
        maps = [getattr(heads, name) for heads in output.heads or ()]
        arrays[name] = np.stack(maps)
    return arrays


def instance_arrays(output: MotionOutput) -> dict[str, AnyArray]:
    """Return the instance maps of K predictions, extracted from the heads if necessary."""
    maps = output.instances
    if maps is None:
        predicted = [predict_instances(heads, "motion").instance for heads in output.heads or ()]
        maps = np.stack(predicted)
    max_id = int(maps.max(initial=0))
    id_type: type[np.integer[Any]] = np.int32
    if max_id < 2**8:
        id_type = np.uint8
    elif max_id < 2**16:
        id_type = np.uint16
    return {"instance": maps.astype(id_type)}
