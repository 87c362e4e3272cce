"""Predicted instances against true ones: overlap of their cells (IoU, VPQ), and their paths.

VPQ: instances found in the right cells and under the same id in all frames. In each frame a true
    and a predicted instance match if the intersection of their cells is more than half of the
    union, so each has at most one partner. A true instance with another predicted id in its
    previous match is not a true positive, but counts as missed and as a false alarm. The opposite,
    a predicted id that jumps to another true instance, is not punished. The measure is FIERY's,
    which the released code copied; counts are sums over frames (docs/released_code.md, IoU and
    VPQ).

Paths (docs/released_code.md, Paths) belong to the instances of the first frame: id → (n, 2)
positions, such as `motion.trajectories` returns in metres, or `LinkedInstances.centers` times the
cells' size. An instance that a frame lacks has no point for it, so point k of a path is not always
of frame k. The released code ignores this, and so do these functions.

Paths are paired as in the released code (`traj_mapping`). It adds a row and a column of zeros to
its costs (ids begin at 1) and then drops the first match, `matches[1:]`, as the pair of these two.
With a stable sort it always is; an unstable one (numpy's default, which differs with version and
processor) can pair the zeros with an instance and drop a real match. Here the sort is stable, so
the extra row and the dropped match are left out.

The released code prints nine errors, but only three are informative: it gives all predictions the
probability 1, so its p- and brier-variants are the plain ones.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.geometry.bev_grid import cells_in
from deepaccident_devkit.support.arrays import (
    AnyArray,
    BoolArray,
    FloatArray,
    FrozenArrays,
    IntArray,
    as_numbers,
)

CLASSES: Final = ("background", "instances")
"""Classes that are counted: cells without any instance, as if they were one, and the instances."""
# Largest number of entries of a histogram of pairs of ids; larger ids are renumbered.
_MAX_PAIRS: Final = 4_000_000
Paths = Mapping[int, FloatArray]
# Metres, mean over the frames, within which two paths can be the same.
_MATCH_DISTANCE_M: Final = 4.0
# Metres: a larger mean error, or final error, counts as this.
_ADE_LIMIT, _FDE_LIMIT = 8.0, 10.0
# Metres; a larger final error is a miss.
_MISS_DISTANCE: Final = 5.0


@dataclass(frozen=True, slots=True, kw_only=True)
class SegmentationCounts:
    """Cells of one class.

    Attributes:
        true_positive: Cells of the class in prediction and truth.
        false_positive: Cells of the class only in the prediction.
        false_negative: Cells of the class only in the truth.
    """

    true_positive: int
    false_positive: int
    false_negative: int


def mask_counts(predicted: BoolArray, true: BoolArray) -> SegmentationCounts:
    """Compare two masks of one class, of the same shape.

    >>> import numpy as np
    >>> predicted, true = np.array([[True, True]]), np.array([[True, False]])
    >>> mask_counts(predicted, true)
    SegmentationCounts(true_positive=1, false_positive=1, false_negative=0)
    """
    common = int(np.count_nonzero(predicted & true))
    return SegmentationCounts(
        true_positive=common,
        false_positive=int(np.count_nonzero(predicted)) - common,
        false_negative=int(np.count_nonzero(true)) - common,
    )


def iou(counts: Iterable[SegmentationCounts], *, absent: float = 0.0) -> float:
    """Return the intersection over union (IoU) of one class over all samples, in [0, 1].

    As `IntersectionOverUnion` of FIERY, which the released code copied.

    >>> iou([SegmentationCounts(true_positive=2, false_positive=1, false_negative=1)])
    0.5

    Args:
        counts: Counts of the samples, from `mask_counts`.
        absent: Value where neither side has the class.
    """
    samples = list(counts)
    intersection = sum(sample.true_positive for sample in samples)
    differences = sum(sample.false_positive + sample.false_negative for sample in samples)
    union = intersection + differences
    return intersection / union if union else absent


def prediction_accuracy(
    true_positives: float, false_positives: float, false_negatives: float
) -> float:
    """Return TP / (TP + FP / 2 + FN / 2), the paper's accuracy of predicted accidents or paths.

    Its mean over the allowed distances is the APA of the DeepAccident paper.

    >>> prediction_accuracy(3, 1, 1)
    0.75

    Args:
        true_positives: Number of true positives.
        false_positives: Number of false positives.
        false_negatives: Number of missed ones.

    Returns:
        A share in [0, 1]; NaN where nothing is counted.
    """
    total = true_positives + false_positives / 2 + false_negatives / 2
    return true_positives / total if total else math.nan


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class VpqCounts(FrozenArrays):
    """Counts of T frames, (T, 2) each: by `CLASSES`; arrays are read-only.

    Attributes:
        iou: float64 sum of the intersections over unions of the true positives.
        true_positive: int64.
        false_positive: int64; none for the background.
        false_negative: int64; none for the background.
    """

    iou: FloatArray
    true_positive: IntArray
    false_positive: IntArray
    false_negative: IntArray


@dataclass(frozen=True, slots=True, kw_only=True)
class PanopticQuality:
    """Factors of panoptic quality, shares in [0, 1].

    Attributes:
        pq: Segmentation quality times recognition quality.
        sq: Mean intersection over union of the true positives.
        rq: True positives over `denominator`.
        denominator: True positives plus half of the false positives and negatives; at least 1.
    """

    pq: float
    sq: float
    rq: float
    denominator: float


def vpq_counts(
    prediction: AnyArray, label: AnyArray, *, temporally_consistent: bool = True
) -> VpqCounts:
    """Compare the instances of one sample.

    Args:
        prediction: (T, H, W) integers: ids from 1; lower values are background.
        label: The same shape.
        temporally_consistent: Whether a true instance must keep the predicted id of its last match;
            False for panoptic quality frame by frame.

    Raises:
        GeometryError: other shapes.
    """
    predicted, true = _checked_maps(prediction, label)
    shared = _shared_cells(predicted, true)
    true_size = shared.sum(axis=2)
    predicted_size = shared.sum(axis=1)
    frame, true_id, predicted_id = _matches(
        shared, true_size, predicted_size, consistent=temporally_consistent
    )
    common = shared[frame, true_id, predicted_id]
    union = true_size[frame, true_id] + predicted_size[frame, predicted_id] - common
    overlap = common / union
    matches = np.bincount(frame, minlength=len(true))
    alarms = np.count_nonzero(predicted_size[:, 1:], axis=1) - matches
    missed = np.count_nonzero(true_size[:, 1:], axis=1) - matches
    overlap_sums = []
    for index in range(len(true)):
        overlap_sums.append(math.fsum(overlap[frame == index].tolist()))
    # cells of the background in both, which count where they are more than half of the union
    background = shared[:, 0, 0]
    background_union = np.maximum(true_size[:, 0] + predicted_size[:, 0] - background, 1)
    is_match = 2 * background > background_union
    background_overlap = np.where(is_match, background / background_union, 0.0)
    return VpqCounts(
        iou=np.stack([background_overlap, np.array(overlap_sums)], axis=1),
        true_positive=np.stack([background_overlap > 0, matches], axis=1),
        false_positive=np.stack([alarms * 0, alarms], axis=1),
        false_negative=np.stack([missed * 0, missed], axis=1),
    )


def vpq_matches(prediction: AnyArray, label: AnyArray) -> IntArray:
    """Return the matched instances: the true positives of `vpq_counts`.

    Arguments and errors are as in `vpq_counts`.

    Returns:
        (N, 3) int64: frame from 0, predicted id, true id; by frame.
    """
    predicted, true = _checked_maps(prediction, label)
    ids = []
    ranks = []
    for maps in (predicted, true):
        # the background is always among the ids, with rank 0
        map_ids, rank = np.unique(np.append(np.maximum(maps, 0), 0), return_inverse=True)
        ids.append(map_ids.astype(np.int64))
        ranks.append(rank.reshape(-1)[:-1].reshape(maps.shape))
    shared = _shared_cells(ranks[0], ranks[1])
    frame, true_id, predicted_id = _matches(
        shared, shared.sum(axis=2), shared.sum(axis=1), consistent=True
    )
    return np.stack([frame, ids[0][predicted_id], ids[1][true_id]], axis=1)


def panoptic_quality(
    iou: float, true_positive: float, false_positive: float, false_negative: float
) -> PanopticQuality:
    """Return panoptic quality (PQ, for sums of `vpq_counts` VPQ) from sums over frames.

    As `PanopticMetric` of FIERY; 0 where there is nothing to count.

    >>> panoptic_quality(1.5, 2, 1, 1)
    PanopticQuality(pq=0.5, sq=0.75, rq=0.6666666666666666, denominator=3.0)

    Args:
        iou: Sum of the intersections over unions of the true positives.
        true_positive: Number of true positives.
        false_positive: Number of false positives.
        false_negative: Number of missed instances.
    """
    denominator = max(true_positive + false_positive / 2 + false_negative / 2, 1)
    return PanopticQuality(
        pq=iou / denominator,
        sq=iou / max(true_positive, 1),
        rq=true_positive / denominator,
        denominator=denominator,
    )


def _checked_maps(prediction: AnyArray, label: AnyArray) -> tuple[AnyArray, AnyArray]:
    """Return two sets of instance maps (T, H, W); raises GeometryError."""
    predicted = as_numbers("prediction", prediction, dtype=None)
    true = as_numbers("label", label, dtype=None)
    if predicted.shape != true.shape or true.ndim != 3:
        raise GeometryError(
            f"prediction: expected (T, H, W) as the label's {true.shape}, found {predicted.shape}"
        )
    return predicted, true


def _shared_cells(predicted: AnyArray, true: AnyArray) -> IntArray:
    """Return numbers of cells by true and predicted id, shape (T, G + 1, P + 1).

    Id 0 is the background; ids are renumbered if they are large.
    """
    frames = len(true)
    cells = true[0].size if len(true) else 0
    occupied = np.flatnonzero((predicted > 0) | (true > 0))
    true_id = np.maximum(true.reshape(-1)[occupied], 0).astype(np.int64)
    predicted_id = np.maximum(predicted.reshape(-1)[occupied], 0).astype(np.int64)
    if math.prod(_pairs_shape(frames, true_id, predicted_id)) > _MAX_PAIRS:
        true_id = _renumbered(true_id)
        predicted_id = _renumbered(predicted_id)
    shape = _pairs_shape(frames, true_id, predicted_id)
    frame = occupied // max(cells, 1)
    pairs = (frame * shape[1] + true_id) * shape[2] + predicted_id
    shared: IntArray = np.bincount(pairs, minlength=math.prod(shape)).reshape(shape)
    shared[:, 0, 0] = cells - np.bincount(frame, minlength=frames)
    return shared


def _pairs_shape(frames: int, true_id: IntArray, predicted_id: IntArray) -> tuple[int, int, int]:
    """Return the shape of a histogram of frames and pairs of ids."""
    true_ids = int(true_id.max(initial=0)) + 1
    predicted_ids = int(predicted_id.max(initial=0)) + 1
    return frames, true_ids, predicted_ids


def _renumbered(ids: IntArray) -> IntArray:
    """Return the ranks of ids; the background 0 always has rank 0."""
    _, ranks = np.unique(np.append(ids, 0), return_inverse=True)
    return np.asarray(ranks[:-1], dtype=np.int64)


def _matches(
    shared: IntArray, true_size: IntArray, predicted_size: IntArray, *, consistent: bool
) -> tuple[IntArray, IntArray, IntArray]:
    """Return frame, true id and predicted id of the pairs that match, by frame.

    With `consistent` only pairs under the same id as before match.
    """
    frame, true_id, predicted_id = np.nonzero(shared[:, 1:, 1:])
    true_id = true_id + 1
    predicted_id = predicted_id + 1
    common = shared[frame, true_id, predicted_id]
    sizes = true_size[frame, true_id] + predicted_size[frame, predicted_id]
    match = np.flatnonzero(3 * common > sizes)
    if consistent:
        # the matches of each true id, in time
        order = np.argsort(true_id[match], kind="stable")
        same_truth = np.diff(true_id[match][order]) == 0
        has_jumped = same_truth & (np.diff(predicted_id[match][order]) != 0)
        match = np.delete(match, order[1:][has_jumped])
    return frame[match], true_id[match], predicted_id[match]


@dataclass(frozen=True, slots=True, kw_only=True)
class TrajectoryMatches:
    """Pairs of predicted and true paths.

    Attributes:
        pairs: (predicted id, true id), by rising cost.
        costs: Cost of each pair, the sum of the distances over the frames, metres.
        unmatched_prediction: Predicted ids without a partner: the left-over ones, ascending,
            then the ones too far from their best partner, by rising cost.
        unmatched_truth: The same for true ids.
    """

    pairs: tuple[tuple[int, int], ...]
    costs: tuple[float, ...]
    unmatched_prediction: tuple[int, ...]
    unmatched_truth: tuple[int, ...]


def longest(paths: Paths) -> int:
    """Return the number of points of the longest path; 0 without paths.

    The released code pads both sides to the truth's.
    """
    return max((len(path) for path in paths.values()), default=0)


def padded(paths: Paths, length: int) -> dict[int, FloatArray]:
    """Return the paths, continued to a number of points; longer ones stay as they are.

    The released quirk: a path with a last step d goes on by d, 2 d, 3 d, … per frame. A path of
    one point stands still.

    Args:
        paths: Paths of at least one point each.
        length: Number of points.
    """
    return {name: _continued(path, length) for name, path in paths.items()}


def match_trajectories(prediction: Paths, truth: Paths) -> TrajectoryMatches:
    """Pair paths greedily, the nearest two first.

    A pair that is too far apart uses up both paths and counts as unmatched.

    Args:
        prediction: Id → (≥ T, 2) metres; only the first T points count (see `padded`).
        truth: Id → (T, 2) metres.

    Raises:
        GeometryError: true paths of several lengths, or a predicted one that is shorter.
    """
    predicted = list(prediction)
    true = list(truth)
    costs = _costs(prediction, truth)
    limit = _MATCH_DISTANCE_M * longest(truth)
    free_predicted = dict.fromkeys(sorted(predicted))
    free_true = dict.fromkeys(sorted(true))
    pairs: list[tuple[int, int]] = []
    pair_costs: list[float] = []
    far_pairs: list[tuple[int, int]] = []
    for flat in np.argsort(costs, axis=None, kind="stable").tolist():
        row, column = divmod(flat, len(true))
        predicted_id = predicted[row]
        true_id = true[column]
        if predicted_id not in free_predicted or true_id not in free_true:
            continue
        del free_predicted[predicted_id], free_true[true_id]
        cost = costs.item(flat)
        if cost <= limit:
            pairs.append((predicted_id, true_id))
            pair_costs.append(cost)
        else:
            far_pairs.append((predicted_id, true_id))
        if not (free_predicted and free_true):
            break
    return TrajectoryMatches(
        pairs=tuple(pairs),
        costs=tuple(pair_costs),
        unmatched_prediction=(*free_predicted, *(predicted_id for predicted_id, _ in far_pairs)),
        unmatched_truth=(*free_true, *(true_id for _, true_id in far_pairs)),
    )


def distances(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the distances between points (…, 2).

    np.hypot is not used, since its last bit differs between machines.
    """
    difference = first - second
    x = difference[..., 0]
    y = difference[..., 1]
    return np.asarray(np.sqrt(x * x + y * y))


def _continued(path: FloatArray, length: int) -> FloatArray:
    """Return a path of at least `length` points, continued with growing steps."""
    missing = length - len(path)
    if missing <= 0:
        return path
    step = path[-1] - path[-2] if len(path) > 1 else np.zeros(2)
    steps = np.arange(1.0, missing + 1)[:, None] * step
    added: FloatArray = np.cumsum([path[-1], *steps], axis=0)[1:]
    return np.concatenate([path, added])


def _costs(prediction: Paths, truth: Paths) -> FloatArray:
    """Return the sums of the distances over the frames, from the first frame on, shape (P, G)."""
    length = longest(truth)
    has_other_truth = any(len(path) != length for path in truth.values())
    if has_other_truth or any(len(path) < length for path in prediction.values()):
        raise GeometryError(f"trajectories: expected {length} points each; see `padded`")
    result = np.zeros((len(prediction), len(truth)))
    if result.size:
        predicted = np.stack([path[:length] for path in prediction.values()], axis=1)
        true = np.stack([path[:length] for path in truth.values()], axis=1)
        for predicted_points, true_points in zip(predicted, true, strict=True):
            result += distances(predicted_points[:, None], true_points[None])
    return result


def instance_paths(instance: AnyArray, grid: BevGrid) -> dict[int, FloatArray]:
    """Return the paths of the first frame's instances, like `LinkedInstances.centers` of heads.

    Args:
        instance: (T, H, W) ids from 1 that stay the same over the frames, 0 elsewhere.
        grid: Cells and orientation of the maps.

    Returns:
        Id, ascending → (n, 2) x forward, y left, metres: the mean of its cells' centres in each
        frame that has it; a frame without it has no point.
    """
    shape = instance.shape[1:]
    ids = np.unique(instance[0][instance[0] > 0])
    flat = np.flatnonzero(instance > 0)
    identity = instance.reshape(-1)[flat]
    rank = np.minimum(np.searchsorted(ids, identity), max(len(ids) - 1, 0))
    is_first = ids[rank] == identity if len(ids) else np.zeros(len(flat), dtype=bool)
    frame, row, column = np.unravel_index(flat[is_first], instance.shape)
    key = rank[is_first] * len(instance) + frame
    length = len(ids) * len(instance)
    y, x = cells_in(row, column, shape, grid.orientation, "devkit")
    count = np.bincount(key, minlength=length)
    metres = []
    for cells, (low, _, size) in ((x, grid.x), (y, grid.y)):
        mean = np.bincount(key, cells, length) / np.maximum(count, 1)
        metres.append(low + (mean + 0.5) * size)
    positions = np.stack(metres, axis=-1).reshape(len(ids), len(instance), 2)
    is_present = count.reshape(len(ids), len(instance)) > 0
    paths = {}
    for index, name in enumerate(ids.tolist()):
        paths[name] = positions[index][is_present[index]]
    return paths


@dataclass(frozen=True, slots=True, kw_only=True)
class TrajectoryErrors:
    """Sums over the true paths of a sample that have a partner in some prediction.

    Attributes:
        ade: Sum of the mean distances over the frames, metres.
        fde: Sum of the distances at the last frame, metres.
        missed: Number of missed paths.
        count: Number of paths.
    """

    ade: float
    fde: float
    missed: int
    count: int


def trajectory_errors(
    predictions: Sequence[Paths], truth: Paths, matches: Sequence[TrajectoryMatches]
) -> TrajectoryErrors:
    """Return the errors of a sample, for each true path from the prediction that ends nearest.

    The first of equally near predictions counts. The released quirk: where the first prediction has
    no path at all, the sample does not count, even if other predictions have paths.

    Args:
        predictions: K predictions, id → (≥ T, 2) metres.
        truth: Id → (T, 2) metres.
        matches: Matches of each prediction with the truth.
    """
    ade = 0.0
    fde = 0.0
    missed = 0
    count = 0
    frames = longest(truth)
    if predictions and not predictions[0]:
        return TrajectoryErrors(ade=ade, fde=fde, missed=missed, count=count)
    partners = [{true: predicted for predicted, true in match.pairs} for match in matches]
    for name, path in truth.items():
        errors = []
        for paths, partner in zip(predictions, partners, strict=True):
            if name in partner:
                errors.append(distances(paths[partner[name]][:frames], path))
        if not errors:
            continue
        best = min(errors, key=lambda error: error.item(-1))
        final_error = best.item(-1)
        ade += min(sum(best.tolist()) / frames, _ADE_LIMIT)
        fde += min(final_error, _FDE_LIMIT)
        missed += final_error > _MISS_DISTANCE
        count += 1
    return TrajectoryErrors(ade=ade, fde=fde, missed=missed, count=count)
