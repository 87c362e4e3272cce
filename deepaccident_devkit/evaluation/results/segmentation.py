"""Segmentation results: the form of their arrays, and the array of a prediction in that form."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf

import numpy as np

from deepaccident_devkit.errors import GeometryError, ResultsError
from deepaccident_devkit.evaluation.results.forms import ArrayLayout, MapsForm
from deepaccident_devkit.evaluation.results.records import (
    MAX_CELLS,
    ContentError,
    StoredLayers,
)
from deepaccident_devkit.evaluation.segmentation import SegmentationOutput, checked_classes
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.support.arrays import AnyArray

# What is stored → name of the array, and letters of the numpy dtype kinds that it may have.
_ARRAYS: Mapping[StoredLayers, tuple[str, str]] = {
    "masks": ("mask", "bu"),
    "scores": ("score", "fu"),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class SegmentationForm(MapsForm):
    """Layout of stored segmentation results, which all samples of a folder share.

    Attributes:
        stored: `masks` or `scores`.
        classes: Names of the classes, in the order of the layers.
        grid: BEV grid and orientation of the layers.
    """

    stored: StoredLayers
    classes: tuple[str, ...]
    grid: BevGrid

    def __post_init__(self) -> None:
        """Check the fields; raise GeometryError or ResultsError if one is invalid."""
        object.__setattr__(self, "classes", checked_classes(self.classes))
        if len(self.classes) * self.grid.cells > MAX_CELLS:
            raise ResultsError(
                f"form: {len(self.classes)} layers of {self.grid.cells} cells do not fit into "
                "memory; store fewer"
            )

    @classmethod
    def of(cls, output: SegmentationOutput) -> SegmentationForm:
        """Return the form in which an output is stored."""
        stored: StoredLayers = "masks" if output.scores is None else "scores"
        return cls(stored=stored, classes=output.classes, grid=output.grid)

    @property
    def lookahead(self) -> float:
        """Seconds that the predictions look ahead; infinite, as they fit any horizon."""
        return inf

    @property
    def text(self) -> str:
        """The form in words."""
        return (
            f"{self.stored} of {', '.join(self.classes)}, cells x {self.grid.x}, y {self.grid.y}, "
            f"orientation {self.grid.orientation}"
        )

    def array_layout(self) -> dict[str, ArrayLayout]:
        """Return the layout of a sample's array by its name."""
        name, kinds = _ARRAYS[self.stored]
        shape = (len(self.classes), *self.grid.shape)
        return {name: ArrayLayout(shape=shape, kinds=kinds, min_length=len(self.classes))}

    def output(self, arrays: Mapping[str, AnyArray]) -> SegmentationOutput:
        """Build a sample's prediction from its array; raise ContentError if it is invalid."""
        (layers,) = arrays.values()
        try:
            return SegmentationOutput(classes=self.classes, grid=self.grid, **{self.stored: layers})
        except GeometryError as error:
            raise ContentError(str(error)) from error


class SegmentationEncoder:
    """Encoder that turns segmentation outputs into arrays of the form that they share."""

    def __init__(self, grid: BevGrid | None, classes: Sequence[str] | None) -> None:
        """Prepare to encode; see `ResultsWriter` for the arguments."""
        self._grid = grid
        self._classes = tuple(classes or ())
        self.form: SegmentationForm | None = None

    def encode(self, prediction: object) -> dict[str, AnyArray]:
        """Return a prediction's array by its name; raise ResultsError if it cannot be stored."""
        if not isinstance(prediction, SegmentationOutput):
            raise ResultsError(
                f"expected a SegmentationOutput, found {type(prediction).__name__}; make one with "
                "SegmentationOutput.from_arrays(masks=…, grid=…)"
            )
        form = SegmentationForm.of(prediction)
        expected = self.form or replace(
            form, grid=self._grid or form.grid, classes=self._classes or form.classes
        )
        if form != expected:
            raise ResultsError(
                f"expected {expected.text}, found {form.text}; write predictions of different "
                "forms to different results"
            )
        self.form = form
        name, _ = _ARRAYS[form.stored]
        return {name: np.asarray(getattr(prediction, form.stored))}

    def adopt(self, form: SegmentationForm) -> None:
        """Continue with the form of results from an encoder with the same arguments."""
        self.form = form
