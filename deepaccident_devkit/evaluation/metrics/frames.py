"""The frames and cells that are evaluated: at the present, in the recording, within a range.

See docs/released_code.md, Conventions and samples.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np

from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.metrics.predictions import MotionOutput
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion import LABEL_PROTOCOLS, MotionHeads, MotionLabels

_TINY: Final = 1e-6
"""Cells: edges of a range fall on edges of cells, apart from rounding."""


def labels_at_present(label: MotionLabels) -> MotionLabels:
    """Labels with every frame in the present ego frame, warped with bilinear centres where they are not yet."""
    return label if label.at_present else label.to_present(centerness="bilinear")


def frames_there(label: MotionLabels) -> int:
    """How many label frames, from the present on, are in the recording; raises EvaluationError if none is."""
    valid = label.label_valid
    count = len(valid) if valid.all() else int(np.argmin(valid))
    if not count:
        raise EvaluationError("labels: the present frame is not in the recording; choose another sample")
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


def check_protocol(label: MotionLabels, protocol: str | None) -> None:
    """Whether labels are of a protocol, None for any; raises EvaluationError."""
    if protocol is not None and label.config.rules != LABEL_PROTOCOLS[protocol]:
        raise EvaluationError(
            f"labels: expected those of the label protocol {protocol!r}, found others; make them with "
            f"MotionLabelConfig(protocol={protocol!r}), or give the metrics' protocol another value of its field labels"
        )


def check_output(output: MotionOutput, label: MotionLabels, frames: int) -> None:
    """Whether a prediction covers a label's ground and its first frames; raises EvaluationError."""
    grid = label.config.grid
    if (output.grid.x, output.grid.y) != (grid.x, grid.y):
        raise EvaluationError(
            f"prediction: its cells cover x {output.grid.x}, y {output.grid.y}; expected those of the labels, "
            f"x {grid.x}, y {grid.y}: make both with the same grid"
        )
    heads, maps = output.heads or (), () if output.instances is None else output.instances
    predicted = min([*(len(each.segmentation) for each in heads), *map(len, maps)])
    if predicted < frames:
        raise EvaluationError(f"prediction: expected at least {frames} frames from the present on, found {predicted}")


def first_frames(heads: MotionHeads, frames: int) -> MotionHeads:
    """Heads without the frames from `frames` on."""
    if len(heads.segmentation) == frames:
        return heads
    return replace(
        heads,
        segmentation=heads.segmentation[:frames],
        centerness=heads.centerness[:frames],
        offset=heads.offset[:frames],
        flow=heads.flow[:frames],
    )


def cells_within(grid: BevGrid, extent: float) -> tuple[slice, slice]:
    """Rows and columns of the cells whose centres are in a square of `extent` metres around the ego."""
    spans = [
        [min(max(math.ceil((edge - low) / size - 0.5 - _TINY), 0), round((high - low) / size)) for edge in edges]
        for (low, high, size), edges in ((axis, (-extent / 2, extent / 2)) for axis in (grid.x, grid.y))
    ]
    along_x, along_y = (slice(first, stop) for first, stop in spans)
    if grid.orientation == "fiery":
        return along_x, along_y
    if grid.orientation == "released":
        rows = grid.shape[0]
        along_y = slice(rows - along_y.stop, rows - along_y.start)
    return along_y, along_x
