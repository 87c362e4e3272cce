"""From the maps of a model's heads to instances: cells grouped around centres, and instances linked over time.

The rules are the released ones (docs/released_code.md, Post-processing), FIERY's: everything in float32, cells in
row-major order, and of equals the first one counts; frames are linked with another distance than FIERY's. Arrays here
are in the orientation of `PostProcessing.scan`.
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
"""The right class's logit when the released evaluation treats labels as a prediction; the other class has 0."""
# In cells: no offset or flow may be longer; the squares of much longer ones overflow in float32.
_LARGEST: Final = 1e15


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
            _check_values(
                name, values, np.inf if name in {"segmentation", "centerness"} else _LARGEST
            )
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
        """Heads from arrays of any framework (`support.arrays.as_numbers`) or lists, in the order of models' outputs.

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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameGroups:
    """The instances of one frame; ids run from 1 to I without gaps, (row, column) are cells.

    Attributes:
        ids: (P,) int64 the instance of each cell of the foreground; 0 for cells that count as background all the same.
        count: (I + 1,) cells of each id.
        position_sum: (2, I + 1) float64 sums of their rows and columns.
        moved_sum: (2, I + 1) float64 sums of where the flow takes them.
    """

    ids: IntArray
    count: FloatArray
    position_sum: FloatArray
    moved_sum: FloatArray

    @property
    def instances(self) -> int:
        """How many instances there are: the highest id."""
        return len(self.count) - 1


def group_cells(
    peaks: IntArray, position: AnyArray, offset: AnyArray, flow: AnyArray, *, all_cells: bool
) -> FrameGroups:
    """Instances of one frame: the foreground's cells by the peak (K, 2) nearest to where their offset points.

    `position`, `offset` and `flow` are (2, P) float32 rows and columns. If `all_cells` of the frame are foreground, the
    lowest instance becomes the background: ids are the ranks of all ids that occur, from 0.
    """
    nearest = nearest_peaks(position + offset, peaks.astype(np.float32)) + 1
    occurs = np.bincount(nearest, minlength=len(peaks) + 1) > 0
    occurs[0] = not all_cells
    ids = (np.cumsum(occurs) - 1)[nearest]
    length = max(int(occurs.sum()), 1)
    return FrameGroups(
        ids=ids,
        count=np.bincount(ids, minlength=length).astype(np.float64),
        position_sum=np.stack([sums_by(ids, along, length) for along in position]),
        moved_sum=np.stack([sums_by(ids, along, length) for along in position + flow]),
    )


def sums_by(ids: IntArray, values: AnyArray, length: int) -> FloatArray:
    """(length,) float64 sums of `values` by `ids`; ids from `length` on are left out."""
    return np.bincount(ids, values, length)[:length].astype(np.float64, copy=False)


def means(sums: FloatArray, counts: FloatArray) -> AnyArray:
    """(2, N) sums over (N,) counts → (N, 2) float32 means, equal to torch's of float32 values."""
    return (sums / counts).T.astype(np.float32)


def link_frames(groups: Sequence[FrameGroups], distance: float) -> list[IntArray]:
    """Consistent ids (I + 1,) of the instances of consecutive frames, 0 for 0.

    Instances are paired one to one with those of the frame before, which the flow has moved, so that the sum of the
    distances is smallest. Pairs nearer than `distance`, cells, share an id. The others get new ids, counted from the
    first frame's highest id. A frame without instances, and the frame after it, keep their own ids, which do not count
    as given: later instances may get the same ids.
    """
    names = [np.arange(groups[0].instances + 1)]
    newest = groups[0].instances
    for before, after in pairwise(groups):
        if before.instances == 0 or after.instances == 0:
            names.append(np.arange(after.instances + 1))
            continue
        known, expected = _expected(before, names[-1])
        distances = _distances(expected, means(after.position_sum[:, 1:], after.count[1:]))
        linked, newest = _linked(known, distances, distance, newest)
        names.append(linked)
    return names


def _expected(before: FrameGroups, names: IntArray) -> tuple[IntArray, AnyArray]:
    """The ids (N,) of a frame and where the flow takes them (N, 2); instances that share an id are one."""
    known, which = np.unique(names[1:], return_inverse=True)
    sums = np.stack([sums_by(which, along[1:], len(known)) for along in before.moved_sum])
    return known, means(sums, sums_by(which, before.count[1:], len(known)))


def _distances(first: AnyArray, second: AnyArray) -> AnyArray:
    """(N, M) float32 distances between points (N, 2) and (M, 2)."""
    apart = second - first[:, None]
    return np.asarray(np.sqrt(apart[..., 0] * apart[..., 0] + apart[..., 1] * apart[..., 1]))


def _linked(
    known: IntArray, distances: AnyArray, limit: float, newest: int
) -> tuple[IntArray, int]:
    """The next frame's ids (M + 1,), and the highest id given so far."""
    from scipy.optimize import linear_sum_assignment

    before, after = linear_sum_assignment(distances)
    near = distances[before, after] < np.float32(limit)
    matched = (after[near] + 1).tolist()
    names = np.zeros(distances.shape[1] + 1, dtype=np.int64)
    names[matched] = known[before[near]]
    # new ids are given in the order of a Python set, as the released code makes it: not always the ascending one
    rest = set(range(len(names))).difference(set(matched))
    rest.remove(0)
    new = list(rest)
    names[new] = np.arange(newest + 1, newest + 1 + len(new))
    return names, newest + len(new)
