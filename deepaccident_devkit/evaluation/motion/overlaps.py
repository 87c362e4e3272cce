"""How far predicted and true maps overlap: IoU of cells, video panoptic quality (VPQ) of instances.

VPQ: instances found, in the right cells and under the same id in all frames. In each frame a true and a predicted
instance match if the intersection of their cells is more than half of the union, so that each has at most one partner.
A true instance that was matched with another predicted id when it last had a match is no true positive but both missed
and a false alarm. The other way round, a predicted id that jumps to another true instance, is not punished.
FIERY's measure, of which the released code has a copy; counts are sums over frames (docs/released_code.md, IoU and
VPQ).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.support.arrays import AnyArray, BoolArray, FloatArray, FrozenArrays, IntArray, as_numbers


@dataclass(frozen=True, slots=True, kw_only=True)
class SegmentationCounts:
    """Cells of one class.

    Attributes:
        true_positive: of the class in both.
        false_positive: predicted alone.
        false_negative: true alone.
    """

    true_positive: int
    false_positive: int
    false_negative: int


def mask_counts(predicted: BoolArray, true: BoolArray) -> SegmentationCounts:
    """Compare two masks of one class, of the same shape."""
    both = int(np.count_nonzero(predicted & true))
    return SegmentationCounts(
        true_positive=both,
        false_positive=int(np.count_nonzero(predicted)) - both,
        false_negative=int(np.count_nonzero(true)) - both,
    )


def iou(counts: Iterable[SegmentationCounts], *, absent: float = 0.0) -> float:
    """Intersection over union of one class, in [0, 1], over all samples; `absent` where neither side has the class."""
    every = list(counts)
    both = sum(each.true_positive for each in every)
    union = both + sum(each.false_positive + each.false_negative for each in every)
    return both / union if union else absent


CLASSES: Final = ("background", "instances")
"""What is counted: cells without any instance, as if they were one, and the instances."""
_MOST_PAIRS: Final = 4_000_000
"""Entries of a histogram of pairs of ids; ids that would need more are renumbered."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class VpqCounts(FrozenArrays):
    """Counts of T frames, (T, 2) each: of `CLASSES`; arrays are read-only.

    Attributes:
        iou: float64, sum of the intersections over unions of the true positives.
        true_positive: int64.
        false_positive: int64; none of the background.
        false_negative: int64; none of the background.
    """

    iou: FloatArray
    true_positive: IntArray
    false_positive: IntArray
    false_negative: IntArray


@dataclass(frozen=True, slots=True, kw_only=True)
class PanopticQuality:
    """Shares in [0, 1].

    Attributes:
        pq: segmentation quality times recognition quality.
        sq: mean intersection over union of the true positives.
        rq: true positives over `denominator`.
        denominator: true positives, and half of the false positives and negatives; at least 1.
    """

    pq: float
    sq: float
    rq: float
    denominator: float


def vpq_counts(prediction: AnyArray, label: AnyArray, *, temporally_consistent: bool = True) -> VpqCounts:
    """Compare the instances of one sample.

    Args:
        prediction: (T, H, W) integers: ids from 1; what is less is background.
        label: the same shape.
        temporally_consistent: a true instance must keep the predicted id of its last match; False for panoptic quality
            frame by frame.

    Raises:
        GeometryError: other shapes.
    """
    predicted, true = _checked_maps(prediction, label)
    shared = _shared_cells(predicted, true)
    true_size, predicted_size = shared.sum(axis=2), shared.sum(axis=1)
    frame, true_id, predicted_id = _matches(shared, true_size, predicted_size, consistent=temporally_consistent)
    inside = shared[frame, true_id, predicted_id]
    overlap = inside / (true_size[frame, true_id] + predicted_size[frame, predicted_id] - inside)
    found = np.bincount(frame, minlength=len(true))
    alarms = np.count_nonzero(predicted_size[:, 1:], axis=1) - found
    missed = np.count_nonzero(true_size[:, 1:], axis=1) - found
    covered = np.array([math.fsum(overlap[frame == index].tolist()) for index in range(len(true))])
    beside = _background_overlap(shared[:, 0, 0], true_size[:, 0], predicted_size[:, 0])
    return VpqCounts(
        iou=np.stack([beside, covered], axis=1),
        true_positive=np.stack([beside > 0, found], axis=1),
        false_positive=np.stack([alarms * 0, alarms], axis=1),
        false_negative=np.stack([missed * 0, missed], axis=1),
    )


def vpq_matches(prediction: AnyArray, label: AnyArray) -> IntArray:
    """The matched instances: the true positives of `vpq_counts`; arguments and errors as there.

    Returns:
        (N, 3) int64: frame from 0, predicted id, true id; by frame.
    """
    predicted, true = _checked_maps(prediction, label)
    names, ranks = [], []
    for maps in (predicted, true):
        ids, rank = np.unique(np.append(np.maximum(maps, 0), 0), return_inverse=True)
        names.append(ids.astype(np.int64))
        ranks.append(rank.reshape(-1)[:-1].reshape(maps.shape))
    shared = _shared_cells(ranks[0], ranks[1])
    frame, true_id, predicted_id = _matches(shared, shared.sum(axis=2), shared.sum(axis=1), consistent=True)
    return np.stack([frame, names[0][predicted_id], names[1][true_id]], axis=1)


def panoptic_quality(iou: float, true_positive: float, false_positive: float, false_negative: float) -> PanopticQuality:
    """The quality of sums over frames; 0 where there is nothing to count."""
    denominator = max(true_positive + false_positive / 2 + false_negative / 2, 1)
    return PanopticQuality(
        pq=iou / denominator,
        sq=iou / max(true_positive, 1),
        rq=true_positive / denominator,
        denominator=denominator,
    )


def _checked_maps(prediction: AnyArray, label: AnyArray) -> tuple[AnyArray, AnyArray]:
    """Two sets of instance maps (T, H, W); raises GeometryError."""
    predicted, true = as_numbers("prediction", prediction, dtype=None), as_numbers("label", label, dtype=None)
    if predicted.shape != true.shape or true.ndim != 3:
        raise GeometryError(f"prediction: expected (T, H, W) as the label's {true.shape}, found {predicted.shape}")
    return predicted, true


def _shared_cells(predicted: AnyArray, true: AnyArray) -> IntArray:
    """(T, G + 1, P + 1) cells by true and predicted id, 0 the background; ids are renumbered if they are large."""
    frames, cells = len(true), true[0].size if len(true) else 0
    here = np.flatnonzero((predicted > 0) | (true > 0))
    true_id, predicted_id = (np.maximum(maps.reshape(-1)[here], 0).astype(np.int64) for maps in (true, predicted))
    if math.prod(_pairs_shape(frames, true_id, predicted_id)) > _MOST_PAIRS:
        true_id, predicted_id = (_renumbered(ids) for ids in (true_id, predicted_id))
    shape = _pairs_shape(frames, true_id, predicted_id)
    frame = here // max(cells, 1)
    pairs = (frame * shape[1] + true_id) * shape[2] + predicted_id
    shared: IntArray = np.bincount(pairs, minlength=math.prod(shape)).reshape(shape)
    shared[:, 0, 0] = cells - np.bincount(frame, minlength=frames)
    return shared


def _pairs_shape(frames: int, true_id: IntArray, predicted_id: IntArray) -> tuple[int, int, int]:
    return frames, int(true_id.max(initial=0)) + 1, int(predicted_id.max(initial=0)) + 1


def _renumbered(ids: IntArray) -> IntArray:
    """The ranks of ids; of the background 0, whether it is among them or not."""
    _, ranks = np.unique(np.append(ids, 0), return_inverse=True)
    return np.asarray(ranks[:-1], dtype=np.int64)


def _matches(
    shared: IntArray, true_size: IntArray, predicted_size: IntArray, *, consistent: bool
) -> tuple[IntArray, IntArray, IntArray]:
    """Frame, true id and predicted id of the pairs that match, by frame; or only those under the same id as before."""
    frame, true_id, predicted_id = np.nonzero(shared[:, 1:, 1:])
    true_id, predicted_id = true_id + 1, predicted_id + 1
    inside = shared[frame, true_id, predicted_id]
    match = np.flatnonzero(3 * inside > true_size[frame, true_id] + predicted_size[frame, predicted_id])
    if consistent:
        match = match[_same_partner(true_id[match], predicted_id[match])]
    return frame[match], true_id[match], predicted_id[match]


def _same_partner(true_id: IntArray, predicted_id: IntArray) -> BoolArray:
    """Which matches, in the order of time, are with the same predicted id as the match before of that true id."""
    order = np.argsort(true_id, kind="stable")
    other = (np.diff(true_id[order]) == 0) & (np.diff(predicted_id[order]) != 0)
    same = np.ones(len(order), dtype=bool)
    same[order[1:]] = ~other
    return same


def _background_overlap(inside: IntArray, true_size: IntArray, predicted_size: IntArray) -> FloatArray:
    """(T,) intersection over union of the background where it is more than a half, else 0."""
    union = np.maximum(true_size + predicted_size - inside, 1)
    return np.where(2 * inside > union, inside / union, 0.0)
