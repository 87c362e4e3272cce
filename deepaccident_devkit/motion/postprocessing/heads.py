"""`MotionHeads`: the outputs of a motion model for one sample, as plain arrays of any framework."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.arrays import AnyArray, ShortRepr, as_numbers, checked, readonly
from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.geometry.bev_grid import ORIENTATIONS, Orientation
from deepaccident_devkit.motion.labels import MotionLabels
from deepaccident_devkit.motion.orientations import to_orientation
from deepaccident_devkit.text import settle_choices

LABEL_LOGIT: Final = 10.0
"""The right class's logit when the released evaluation treats labels as a prediction; the other class has 0."""
_LARGEST: Final = 1e15
"""In cells: no offset or flow may be longer; the squares of much longer ones overflow in float32."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MotionHeads(ShortRepr):
    """The maps of one prediction, T frames from the present on, H × W cells; arrays are read-only.

    Attributes:
        segmentation: (T, 2, H, W) float32 logits: background, actor.
        centerness: (T, 1, H, W) float32: how surely a cell is an instance's centre; (T, H, W) is accepted, too.
        offset: (T, 2, H, W) float32 cells (down the rows, along the columns) to the instance's centre.
        flow: (T, 2, H, W) float32 cells (rows, columns) to where the instance is at the next frame.
        orientation: how the cells lie; the vectors' channels follow the rows and columns of that orientation.
        ignore_index: the value of offset and flow where they are undefined, as in labels; it stays the same in all
            orientations. None if all values are vectors.
    """

    segmentation: AnyArray
    centerness: AnyArray
    offset: AnyArray
    flow: AnyArray
    orientation: Orientation = "devkit"
    ignore_index: int | None = None

    def __post_init__(self) -> None:
        """Check and freeze; raises GeometryError, or ChoiceError for an unknown orientation."""
        settle_choices(self, {"orientation": ORIENTATIONS})
        _check_channels(np.shape(self.segmentation))
        segmentation = checked("segmentation", self.segmentation, (None, 2, None, None), np.float32)
        frames, _, height, width = segmentation.shape
        if segmentation.size == 0:
            raise GeometryError(f"segmentation: expected at least one frame of one cell, found {segmentation.shape}")
        centerness = as_numbers("centerness", self.centerness, dtype=np.float32)
        if centerness.ndim == 3:
            centerness = centerness[:, None]
        centerness = checked("centerness", centerness, (frames, 1, height, width), np.float32)
        shape = frames, 2, height, width
        maps = {
            "segmentation": segmentation,
            "centerness": centerness,
            "offset": checked("offset", self.offset, shape, np.float32),
            "flow": checked("flow", self.flow, shape, np.float32),
        }
        for name, values in maps.items():
            _check_values(name, values, np.inf if name in {"segmentation", "centerness"} else _LARGEST)
            object.__setattr__(self, name, readonly(values))

    def __repr__(self) -> str:
        """Frames, cells and orientation."""
        frames, _, height, width = self.segmentation.shape
        return f"MotionHeads({frames} frames of {height} × {width} cells, {self.orientation})"

    @classmethod
    def from_arrays(
        cls,
        segmentation: ArrayLike,
        centerness: ArrayLike,
        offset: ArrayLike,
        flow: ArrayLike,
        orientation: Orientation = "devkit",
        *,
        ignore_index: int | None = None,
    ) -> MotionHeads:
        """Heads from arrays of any framework (`arrays.as_numbers`) or lists, in the order in which models give them.

        float32 arrays in the processor's memory are not copied.

        Raises:
            GeometryError: another shape, NaN, or an array that cannot be read from here (see the message's remedy).
            ChoiceError: no such orientation.
        """
        return cls(
            segmentation=as_numbers("segmentation", segmentation, dtype=np.float32),
            centerness=as_numbers("centerness", centerness, dtype=np.float32),
            offset=as_numbers("offset", offset, dtype=np.float32),
            flow=as_numbers("flow", flow, dtype=np.float32),
            orientation=orientation,
            ignore_index=ignore_index,
        )

    @classmethod
    def from_labels(cls, labels: MotionLabels) -> MotionHeads:
        """Labels as the prediction of a perfect model, with which the released evaluation compares.

        Segmentation is 10 for the right class and 0 for the other; centerness, offset and flow are as they are.
        """
        actor = np.asarray(labels.segmentation) == 1
        return cls(
            segmentation=np.stack([~actor, actor], axis=1) * np.float32(LABEL_LOGIT),
            centerness=labels.centerness,
            offset=labels.offset,
            flow=labels.flow,
            orientation=labels.config.grid.orientation,
            ignore_index=labels.config.ignore_index,
        )

    def in_orientation(self, orientation: Orientation) -> MotionHeads:
        """The same prediction with its cells, and its vectors, in another orientation. Raises ChoiceError."""
        if orientation == self.orientation:
            return self

        def turned(values: AnyArray, *, vectors: bool) -> AnyArray:
            return to_orientation(
                values, vectors=vectors, source=self.orientation, target=orientation, ignore=self.ignore_index
            )

        return MotionHeads(
            segmentation=turned(self.segmentation, vectors=False),
            centerness=turned(self.centerness, vectors=False),
            offset=turned(self.offset, vectors=True),
            flow=turned(self.flow, vectors=True),
            orientation=orientation,
            ignore_index=self.ignore_index,
        )


def _check_channels(shape: tuple[int, ...]) -> None:
    if len(shape) != 4 or shape[1] == 2:
        return
    remedy = "; move the channels to the second axis" if shape[-1] == 2 else ""
    if shape[1] == 1:
        remedy = "; of a single logit x for actors, stack -x and x"
    raise GeometryError(
        f"segmentation: expected (T, 2, H, W), the logits of background and actor, found {shape}{remedy}"
    )


def _check_values(name: str, values: AnyArray, most: float) -> None:
    lowest, highest = values.min(), values.max()
    if not (lowest >= -most and highest <= most):  # NaN is neither
        at = tuple(np.argwhere(~(np.abs(values) <= most))[0].tolist())
        raise GeometryError(
            f"{name}: {values[at]} at {at} cannot be used; did the model diverge, or is there a mask in its output?"
        )
