"""Instances from the maps of a model's heads: cells grouped around centres, and linked over time.

The rules follow the released code (docs/released_code.md, Post-processing), which are FIERY's
except for the distance at which frames are linked: everything is computed in float32, cells are in
row-major order, and the first one wins a tie. Arrays are in the orientation of
`PostProcessing.scan`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
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
"""Logit of the true class when the released evaluation treats labels as a prediction.

The other class has the logit 0.
"""
# Maximum length of offsets and flows; the squares of much longer ones overflow in float32.
_MAX_VECTOR_CELLS = 1e15


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MotionHeads(ShortRepr):
    """Maps of one prediction, T frames from the present on, H × W cells; arrays are read-only.

    Attributes:
        segmentation: Logits of background and actor, shape (T, 2, H, W), float32.
        centerness: Confidence that a cell is an instance's centre, shape (T, 1, H, W), float32; (T,
            H, W) is accepted, too.
        offset: Rows and columns from a cell to its instance's centre, shape (T, 2, H, W), float32,
            cells.
        flow: Rows and columns from an instance's centre to its position at the next frame, shape
            (T, 2, H, W), float32, cells.
        orientation: Orientation of the cells; the vectors' channels follow its rows and columns.
        ignore_index: Value of offset and flow where they are undefined, as in labels; a change of
            orientation leaves it unchanged. None if all values are defined.
    """

    segmentation: AnyArray
    centerness: AnyArray
    offset: AnyArray
    flow: AnyArray
    orientation: Orientation = "devkit"
    ignore_index: int | None = None

    def __post_init__(self) -> None:
        """Check and freeze the maps.

        Raise GeometryError for a wrong shape or value, and ChoiceError for an unknown orientation.
        """
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
        offset = checked("offset", self.offset, shape, np.float32)
        flow = checked("flow", self.flow, shape, np.float32)
        limited_maps = (
            ("segmentation", segmentation, np.inf),
            ("centerness", centerness, np.inf),
            ("offset", offset, _MAX_VECTOR_CELLS),
            ("flow", flow, _MAX_VECTOR_CELLS),
        )
        for name, values, limit in limited_maps:
            _check_values(name, values, limit)
            object.__setattr__(self, name, readonly(values))

    def __repr__(self) -> str:
        """Return the number of frames and cells, and the orientation."""
        frames, _, height, width = self.segmentation.shape
        cells = f"{height} × {width} cells"
        return f"MotionHeads({frames} frames of {cells}, {self.orientation})"

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
        """Build heads from lists or arrays of any framework, in the order of models' outputs.

        `support.arrays.as_numbers` reads the arrays. Float32 arrays in CPU memory are not copied.

        Raises:
            GeometryError: An array has a wrong shape, contains NaN, or cannot be read on the CPU
                (the message explains what to do).
            ChoiceError: There is no such orientation.
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
        """Treat labels as the prediction of a perfect model, as the released evaluation does.

        The segmentation's logits are 10 for the true class and 0 for the other; centerness, offset
        and flow are unchanged.
        """
        is_actor = np.asarray(labels.segmentation) == 1
        is_class = np.stack([~is_actor, is_actor], axis=1)
        return cls(
            segmentation=is_class * np.float32(LABEL_LOGIT),
            centerness=labels.centerness,
            offset=labels.offset,
            flow=labels.flow,
            orientation=labels.config.grid.orientation,
            ignore_index=labels.config.ignore_index,
        )

    def in_orientation(self, orientation: Orientation) -> MotionHeads:
        """Return the same prediction with its cells and vectors in another orientation.

        Raise ChoiceError if there is no such orientation.
        """
        if orientation == self.orientation:
            return self

        turn = partial(
            to_orientation,
            source=self.orientation,
            target=orientation,
            ignore=self.ignore_index,
        )
        return MotionHeads(
            segmentation=turn(self.segmentation, vectors=False),
            centerness=turn(self.centerness, vectors=False),
            offset=turn(self.offset, vectors=True),
            flow=turn(self.flow, vectors=True),
            orientation=orientation,
            ignore_index=self.ignore_index,
        )


def _check_channels(shape: tuple[int, ...]) -> None:
    """Raise GeometryError if the segmentation does not have two channels."""
    if len(shape) != 4 or shape[1] == 2:
        return
    remedy = ""
    if shape[1] == 1:
        remedy = "; if the model has a single logit x for actors, stack -x and x"
    elif shape[-1] == 2:
        remedy = "; move the channels to the second axis"
    raise GeometryError(
        "segmentation: expected (T, 2, H, W), the logits of background and actor, "
        f"found {shape}{remedy}"
    )


def _check_values(name: str, values: AnyArray, limit: float) -> None:
    """Raise GeometryError if a value is NaN or its magnitude exceeds a limit."""
    if not (values.min() >= -limit and values.max() <= limit):  # NaN fails both comparisons
        wrong_indices = np.argwhere(~(np.abs(values) <= limit))
        index = tuple(wrong_indices[0].tolist())
        raise GeometryError(
            f"{name}: {values[index]} at {index} is NaN or too large; did the model diverge, "
            "or does its output contain a mask?"
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameGroups:
    """Instances of one frame; ids run from 1 to I without gaps, and positions are in cells.

    Attributes:
        ids: Instance of each foreground cell, shape (P,), int64; 0 for cells that are treated as
            background nevertheless.
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
    """Group a frame's foreground cells by the peak nearest to where each cell's offset leads.

    Args:
        peaks: Rows and columns of the peaks, shape (K, 2).
        position: Rows and columns of the foreground's cells, shape (2, P), float32.
        offset: Rows and columns from each cell to its instance's centre, shape (2, P), float32.
        flow: Rows and columns from each cell to its position at the next frame, shape (2, P),
            float32.
        all_cells: Whether all cells of the frame are foreground. The instance with the lowest id
            then becomes the background, because ids are replaced by their ranks, counted from 0.
    """
    nearest = nearest_peaks(position + offset, peaks.astype(np.float32)) + 1
    occurs = np.bincount(nearest, minlength=len(peaks) + 1) > 0
    occurs[0] = not all_cells
    new_ids = np.cumsum(occurs) - 1
    ids = new_ids[nearest]
    num_ids = max(int(occurs.sum()), 1)
    position_sum = [sum_by_id(ids, component, num_ids) for component in position]
    moved_sum = [sum_by_id(ids, component, num_ids) for component in position + flow]
    return FrameGroups(
        ids=ids,
        count=np.bincount(ids, minlength=num_ids).astype(np.float64),
        position_sum=np.stack(position_sum),
        moved_sum=np.stack(moved_sum),
    )


def sum_by_id(ids: IntArray, values: AnyArray, length: int) -> FloatArray:
    """Return the sums of `values` by `ids`, shape (length,), float64.

    Ids from `length` on are left out.
    """
    sums = np.bincount(ids, values, length)[:length]
    return sums.astype(np.float64, copy=False)


def means(sums: FloatArray, counts: FloatArray) -> AnyArray:
    """Return sums (2, N) divided by counts (N,), shape (N, 2), float32.

    The results equal torch's means of float32 values.
    """
    means_by_axis = sums / counts
    return means_by_axis.T.astype(np.float32)


def link_frames(groups: Sequence[FrameGroups], distance: float) -> list[IntArray]:
    """Assign ids to the instances of consecutive frames that stay the same from frame to frame.

    The result has one array of shape (I + 1,) per frame, which maps the frame's ids to the linked
    ones, and 0 to 0. Instances are paired one to one with the instances of the previous frame,
    moved by the flow, so that the sum of the distances is smallest. Pairs closer than `distance`
    (cells) share an id. The others get new ids, counted on from the first frame's highest id. A
    frame without instances, and the frame after it, keep their own ids; these do not count as used,
    so later instances may get the same ids.
    """
    linked_ids = [np.arange(groups[0].instances + 1)]
    newest_id = groups[0].instances
    for previous, current in pairwise(groups):
        if previous.instances == 0 or current.instances == 0:
            linked_ids.append(np.arange(current.instances + 1))
            continue
        previous_ids, expected = _move_instances(previous, linked_ids[-1])
        positions = means(current.position_sum[:, 1:], current.count[1:])
        distances = _compute_distances(expected, positions)
        frame_ids, newest_id = _link_instances(previous_ids, distances, distance, newest_id)
        linked_ids.append(frame_ids)
    return linked_ids


def _move_instances(previous: FrameGroups, linked_ids: IntArray) -> tuple[IntArray, AnyArray]:
    """Return the ids of a frame (N,), and the positions (N, 2) to which the flow moves them.

    Instances that share an id are merged into one.
    """
    ids, instance = np.unique(linked_ids[1:], return_inverse=True)
    moved_sum = []
    for component in previous.moved_sum[:, 1:]:
        moved_sum.append(sum_by_id(instance, component, len(ids)))
    counts = sum_by_id(instance, previous.count[1:], len(ids))
    return ids, means(np.stack(moved_sum), counts)


def _compute_distances(first: AnyArray, second: AnyArray) -> AnyArray:
    """Return the distances between points (N, 2) and (M, 2), shape (N, M), float32."""
    offset = second - first[:, None]
    down = offset[..., 0]
    across = offset[..., 1]
    squared_distances = down * down + across * across
    return np.asarray(np.sqrt(squared_distances))


def _link_instances(
    previous_ids: IntArray, distances: AnyArray, limit: float, newest_id: int
) -> tuple[IntArray, int]:
    """Return the linked ids of the next frame (M + 1,), and the highest id used so far."""
    from scipy.optimize import linear_sum_assignment

    previous, current = linear_sum_assignment(distances)
    is_close = distances[previous, current] < np.float32(limit)
    matched = (current[is_close] + 1).tolist()
    linked_ids = np.zeros(distances.shape[1] + 1, dtype=np.int64)
    linked_ids[matched] = previous_ids[previous[is_close]]
    # New ids follow the order of a Python set, as in the released code; that order need not
    # ascend.
    unmatched = set(range(len(linked_ids))).difference(set(matched))
    unmatched.remove(0)
    new_instances = list(unmatched)
    first_new_id = newest_id + 1
    newest_id += len(new_instances)
    linked_ids[new_instances] = np.arange(first_new_id, newest_id + 1)
    return linked_ids, newest_id
