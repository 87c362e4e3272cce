"""Instances from the maps of a model's heads: cells grouped around centres, and linked over time.

The rules are the released ones (docs/released_code.md, Post-processing), FIERY's: everything in
float32, cells in row-major order, and the first one of equals counts; frames are linked with
another distance than FIERY's. Arrays are in the orientation of `PostProcessing.scan`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.geometry.bev_grid import ORIENTATIONS, Orientation, to_orientation
from deepaccident_devkit.motion.labels import MotionLabels
from deepaccident_devkit.motion.reference_arithmetic.peaks import nearest_peaks
from deepaccident_devkit.support.arrays import (
    AnyArray,
    FloatArray,
    IntArray,
    ShortRepr,
    as_numbers,
    checked,
    readonly,
)
from deepaccident_devkit.support.text import settle_choices

LABEL_LOGIT: Final = 10.0
"""Logit of the right class when the released evaluation treats labels as a prediction.

The other class has 0.
"""
# Offsets and flows may not be longer, since the squares of much longer ones overflow in float32.
_MAX_VECTOR_CELLS: Final = 1e15


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MotionHeads(ShortRepr):
    """Maps of one prediction, T frames from the present on, H × W cells; arrays are read-only.

    Attributes:
        segmentation: Logits of background and actor, shape (T, 2, H, W), float32.
        centerness: Confidence that a cell is an instance's centre, shape (T, 1, H, W), float32; (T,
            H, W) is accepted, too.
        offset: Rows and columns to the instance's centre, shape (T, 2, H, W), float32, cells.
        flow: Rows and columns to the instance's position at the next frame, shape (T, 2, H, W),
            float32, cells.
        orientation: Orientation of the cells; the vectors' channels follow its rows and columns.
        ignore_index: Value of offset and flow where they are undefined, as in labels; it stays the
            same in all orientations. None if all values are vectors.
    """

    segmentation: AnyArray
    centerness: AnyArray
    offset: AnyArray
    flow: AnyArray
    orientation: Orientation = "devkit"
    ignore_index: int | None = None

    def __post_init__(self) -> None:
        """Check and freeze the maps; raises GeometryError, or ChoiceError for the orientation."""
        settle_choices(self, {"orientation": ORIENTATIONS})
        _check_channels(np.shape(self.segmentation))
        segmentation = checked("segmentation", self.segmentation, (None, 2, None, None), np.float32)
        frames, _, height, width = segmentation.shape
        if segmentation.size == 0:
            raise GeometryError(
                f"segmentation: expected at least one frame of one cell, found {segmentation.shape}"
            )
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
            limit = np.inf if name in {"segmentation", "centerness"} else _MAX_VECTOR_CELLS
            _check_values(name, values, limit)
            object.__setattr__(self, name, readonly(values))

    def __repr__(self) -> str:
        """Return the number of frames and cells, and the orientation."""
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
        """Return heads from arrays of any framework or lists, in the order of models' outputs.

        `support.arrays.as_numbers` reads the arrays. Float32 arrays in the processor's memory are
        not copied.

        Raises:
            GeometryError: Another shape, NaN, or an array that cannot be read from here (see the
                message's remedy).
            ChoiceError: No such orientation.
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
        """Return labels as the prediction of a perfect model, as the released evaluation uses them.

        Segmentation is 10 for the right class and 0 for the other; centerness, offset and flow do
        not change.
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
        """Return the same prediction with its cells, and its vectors, in another orientation.

        Raises ChoiceError.
        """
        if orientation == self.orientation:
            return self

        def turned(values: AnyArray, *, vectors: bool) -> AnyArray:
            return to_orientation(
                values,
                vectors=vectors,
                source=self.orientation,
                target=orientation,
                ignore=self.ignore_index,
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
    """Raise GeometryError if the segmentation does not have two channels."""
    if len(shape) != 4 or shape[1] == 2:
        return
    remedy = "; move the channels to the second axis" if shape[-1] == 2 else ""
    if shape[1] == 1:
        remedy = "; of a single logit x for actors, stack -x and x"
    raise GeometryError(
        "segmentation: expected (T, 2, H, W), the logits of background and actor, "
        f"found {shape}{remedy}"
    )


def _check_values(name: str, values: AnyArray, limit: float) -> None:
    """Raise GeometryError if a value is NaN or its magnitude exceeds a limit."""
    if not (values.min() >= -limit and values.max() <= limit):  # NaN is neither
        index = tuple(np.argwhere(~(np.abs(values) <= limit))[0].tolist())
        raise GeometryError(
            f"{name}: {values[index]} at {index} cannot be used; did the model diverge, "
            "or is there a mask in its output?"
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameGroups:
    """Instances of one frame; ids run from 1 to I without gaps, (row, column) are cells.

    Attributes:
        ids: Instance of each cell of the foreground, shape (P,), int64; 0 for cells that still
            count as background.
        count: Number of cells of each id, shape (I + 1,).
        position_sum: Sums of the cells' rows and columns, shape (2, I + 1), float64.
        moved_sum: Sums of the cells' rows and columns after the flow, shape (2, I + 1), float64.
    """

    ids: IntArray
    count: FloatArray
    position_sum: FloatArray
    moved_sum: FloatArray

    @property
    def instances(self) -> int:
        """Number of instances: the highest id."""
        return len(self.count) - 1


def group_cells(
    peaks: IntArray, position: AnyArray, offset: AnyArray, flow: AnyArray, *, all_cells: bool
) -> FrameGroups:
    """Return the instances of one frame: its foreground, grouped by the peak nearest to each cell.

    Args:
        peaks: Rows and columns of the peaks, shape (K, 2).
        position: Rows and columns of the foreground's cells, shape (2, P), float32.
        offset: Rows and columns to the instances' centres, shape (2, P), float32.
        flow: Rows and columns to the positions at the next frame, shape (2, P), float32.
        all_cells: Whether all cells of the frame are foreground. The lowest instance then becomes
            the background: ids are the ranks of all ids that occur, from 0.
    """
    nearest = nearest_peaks(position + offset, peaks.astype(np.float32)) + 1
    occurs = np.bincount(nearest, minlength=len(peaks) + 1) > 0
    occurs[0] = not all_cells
    ids = (np.cumsum(occurs) - 1)[nearest]
    num_ids = max(int(occurs.sum()), 1)
    moved = position + flow
    return FrameGroups(
        ids=ids,
        count=np.bincount(ids, minlength=num_ids).astype(np.float64),
        position_sum=np.stack([sums_by(ids, component, num_ids) for component in position]),
        moved_sum=np.stack([sums_by(ids, component, num_ids) for component in moved]),
    )


def sums_by(ids: IntArray, values: AnyArray, length: int) -> FloatArray:
    """Return the sums of `values` by `ids`, shape (length,), float64.

    Ids from `length` on are left out.
    """
    return np.bincount(ids, values, length)[:length].astype(np.float64, copy=False)


def means(sums: FloatArray, counts: FloatArray) -> AnyArray:
    """Return means of sums (2, N) over counts (N,), shape (N, 2), float32.

    They are equal to torch's means of float32 values.
    """
    return (sums / counts).T.astype(np.float32)


def link_frames(groups: Sequence[FrameGroups], distance: float) -> list[IntArray]:
    """Return consistent ids of the instances of consecutive frames.

    Each frame has an array of shape (I + 1,), with 0 for 0.     Instances are paired one to one
    with the instances of the frame before, moved by the flow, so that the sum of the distances is
    smallest. Pairs closer than `distance`, cells, share an id. The others get new ids, counted from
    the first frame's highest id. A frame without instances, and the frame after it, keep their own
    ids, which do not count as used: later instances may get the same ids.
    """
    linked_ids = [np.arange(groups[0].instances + 1)]
    newest_id = groups[0].instances
    for previous, current in pairwise(groups):
        if previous.instances == 0 or current.instances == 0:
            linked_ids.append(np.arange(current.instances + 1))
            continue
        previous_ids, expected = _expected_positions(previous, linked_ids[-1])
        positions = means(current.position_sum[:, 1:], current.count[1:])
        distances = _distances(expected, positions)
        frame_ids, newest_id = _linked(previous_ids, distances, distance, newest_id)
        linked_ids.append(frame_ids)
    return linked_ids


def _expected_positions(previous: FrameGroups, linked_ids: IntArray) -> tuple[IntArray, AnyArray]:
    """Return the ids of a frame (N,), and the positions (N, 2) to which the flow moves them.

    Instances that share an id are one.
    """
    ids, instance = np.unique(linked_ids[1:], return_inverse=True)
    moved_sum = [sums_by(instance, component[1:], len(ids)) for component in previous.moved_sum]
    counts = sums_by(instance, previous.count[1:], len(ids))
    return ids, means(np.stack(moved_sum), counts)


def _distances(first: AnyArray, second: AnyArray) -> AnyArray:
    """Return the distances between points (N, 2) and (M, 2), shape (N, M), float32."""
    offset = second - first[:, None]
    down = offset[..., 0]
    across = offset[..., 1]
    return np.asarray(np.sqrt(down * down + across * across))


def _linked(
    previous_ids: IntArray, distances: AnyArray, limit: float, newest_id: int
) -> tuple[IntArray, int]:
    """Return the ids of the next frame (M + 1,), and the highest id used so far."""
    from scipy.optimize import linear_sum_assignment

    previous, current = linear_sum_assignment(distances)
    is_close = distances[previous, current] < np.float32(limit)
    matched = (current[is_close] + 1).tolist()
    linked_ids = np.zeros(distances.shape[1] + 1, dtype=np.int64)
    linked_ids[matched] = previous_ids[previous[is_close]]
    # New ids follow the order of a Python set, as in the released code: it does not always ascend.
    unmatched = set(range(len(linked_ids))).difference(set(matched))
    unmatched.remove(0)
    new = list(unmatched)
    linked_ids[new] = np.arange(newest_id + 1, newest_id + 1 + len(new))
    return linked_ids, newest_id + len(new)
