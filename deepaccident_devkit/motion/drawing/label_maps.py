"""From the cells that instances cover to the maps of `MotionLabels`: centres, peaks, offsets and flow.

Centres and vectors are computed in the protocol's native orientation, in which the released code rounds. The maps are
written in the configuration's orientation.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from deepaccident_devkit.geometry.bev_grid import cells_in, vectors_in
from deepaccident_devkit.motion.config import MotionLabelConfig
from deepaccident_devkit.support.arrays import AnyArray, BoolArray, Float32Array, IntArray

_VANISHED: Final = 104.0
"""exp(−x) is 0 in float32 from here on."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CoveredCells:
    """The cells that instances cover at some frames, P in all, in one orientation.

    Attributes:
        frame: (P,) int64, number of the frame.
        row: (P,) int64.
        column: (P,) int64.
        identity: (P,) int64, ids from 1.
        frames: number of frames.
        ids: highest id of all frames.
    """

    frame: IntArray
    row: IntArray
    column: IntArray
    identity: IntArray
    frames: int
    ids: int

    @property
    def slot(self) -> IntArray:
        """(P,) frame · (1 + ids) + identity."""
        return self.frame * (1 + self.ids) + self.identity

    def centers(self) -> Float32Array:
        """(frames, 1 + ids, 2) the cell nearest to the mean of each instance's cells, half to even; NaN for none."""
        slot, slots = self.slot, self.frames * (1 + self.ids)
        count = np.bincount(slot, minlength=slots).astype(np.float32)
        # sums of whole numbers are exact in float32, except on huge grids: so the mean is torch's
        sums = [
            np.bincount(slot, weights=values, minlength=slots).astype(np.float32) for values in (self.row, self.column)
        ]
        with np.errstate(invalid="ignore"):
            means: Float32Array = np.rint(np.stack(sums, axis=-1) / count[:, None])
        return means.reshape(self.frames, 1 + self.ids, 2)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LabelMaps:
    """The maps of `MotionLabels`, T frames in the configuration's orientation."""

    segmentation: AnyArray
    instance: AnyArray
    centerness: AnyArray
    offset: AnyArray
    flow: AnyArray

    @classmethod
    def empty(cls, config: MotionLabelConfig) -> LabelMaps:
        """Maps of frames without any actor.

        They share one piece of memory. Five pieces of a megabyte each would be returned to the system after every
        sample, and to get them again takes as long as all the rasterising.
        """
        frames, (height, width) = config.label_frames, config.grid.shape
        count = frames * height * width
        memory = np.empty(count * 25, dtype=np.uint8)
        memory[: 16 * count].view(np.float32)[:] = config.ignore_index
        memory[16 * count :] = 0
        two, one = (frames, 2, height, width), (frames, height, width)
        return cls(
            offset=memory[: 8 * count].view(np.float32).reshape(two),
            flow=memory[8 * count : 16 * count].view(np.float32).reshape(two),
            centerness=memory[16 * count : 20 * count].view(np.float32).reshape(frames, 1, height, width),
            instance=memory[20 * count : 24 * count].view(np.int32).reshape(one),
            segmentation=memory[24 * count :].reshape(one),
        )


def label_maps(
    covered: CoveredCells, centers: Float32Array, following: Float32Array, missing: BoolArray, config: MotionLabelConfig
) -> LabelMaps:
    """The maps of instances and their centres.

    Args:
        covered: the rasterised cells, native.
        centers: (T, 1 + ids, 2) each instance's centre, row and column, native; NaN where there is none.
        following: (T, 1 + ids, 2) where it is at the next frame, seen from this one; NaN where that is not known.
        missing: (T,) which frames are not in the recording.
        config: of the labels.
    """
    maps, target = LabelMaps.empty(config), config.grid.orientation
    native = config.grid.with_orientation(config.rules.native)
    source, shape = native.orientation, native.shape
    row, column = cells_in(covered.row, covered.column, shape, source, target)
    cell = row * config.grid.shape[1] + column
    before = covered.frame * native.cells
    cell += before
    maps.segmentation.reshape(-1)[cell] = 1
    maps.instance.reshape(-1)[cell] = covered.identity
    slot = covered.slot
    (down, along), (next_down, next_along) = np.array([centers, following]).reshape(2, -1, 2).swapaxes(1, 2).copy()
    from_row = down.take(slot) - covered.row.astype(np.float32)
    from_column = along.take(slot) - covered.column.astype(np.float32)
    offset = vectors_in(from_row, from_column, source, target)
    flow = vectors_in(next_down - down, next_along - along, source, target)
    cell += before  # offset and flow have two channels
    for channel in range(2):
        for raster, vector in ((maps.offset, offset[channel]), (maps.flow, flow[channel])):
            values = np.where(np.isnan(vector), np.float32(config.ignore_index), vector)
            raster.reshape(-1)[cell] = values if raster is maps.offset else values.take(slot)
        cell += native.cells
    frame, identity = np.nonzero(~np.isnan(centers[..., 0]))
    peak_row, peak_column = centers[frame, identity].astype(np.int64).T
    peak_row, peak_column = cells_in(peak_row, peak_column, shape, source, target)
    _draw_peaks(maps.centerness, frame, np.stack([peak_row, peak_column], axis=1), config.sigma)
    if not config.rules.missing_frames_are_empty:
        for mark in (maps.segmentation, maps.instance, maps.centerness):
            mark[missing] = config.ignore_index
    return maps


def _draw_peaks(centerness: AnyArray, frame: IntArray, center: IntArray, sigma: float) -> None:
    """Put peaks around centres (n, 2), row and column, of frames (n,) into (T, 1, H, W); the higher value counts."""
    import cv2

    shape = centerness.shape[-2:]
    peak = _peak(sigma, max(shape))
    reach = len(peak) // 2
    first, last = np.maximum(center - reach, 0), np.minimum(center + reach + 1, shape)
    bounds = np.hstack([first, last, first - center + reach, last - center + reach]).tolist()
    for number, (top, left, bottom, right, above, before, below, behind) in zip(frame.tolist(), bounds, strict=True):
        part = centerness[number, 0, top:bottom, left:right]
        cv2.max(part, peak[above:below, before:behind], part)  # half of numpy's time: it goes from row to row faster


@functools.lru_cache(maxsize=8)
def _peak(sigma: float, farthest: int) -> Float32Array:
    """(2 r + 1, 2 r + 1) exp(−d² / σ²) around a centre in float32, until it is 0 or the grid ends."""
    radius = min(math.floor(sigma * math.sqrt(_VANISHED)), farthest)
    steps = np.arange(-radius, radius + 1, dtype=np.float32)
    squares = np.add.outer(steps**2, steps**2) / np.float32(sigma**2)
    return np.exp(-squares.astype(np.float64)).astype(np.float32)
