"""Comparison of predicted and true instances: overlap of cells (IoU, VPQ), and paths.

VPQ measures whether instances are found in the correct cells, with the same id in all frames. In
each frame, a true and a predicted instance match if the intersection of their cells is more than
half of the union, so each has at most one match. If the previous match of a true instance had
another predicted id, the instance is not a true positive, but counts as missed and as a false
alarm. The opposite, a predicted id that jumps to another true instance, is not punished. The
measure is FIERY's, which the released code copied; counts are summed over frames (section "IoU and
VPQ" of docs/released_code.md).

Paths (section "Paths" of docs/released_code.md) belong to the instances of the first frame: id →
(n, 2) positions, as returned by `motion.trajectories` in metres, or as `LinkedInstances.centers`
times the size of a cell. If an instance is missing in a frame, its path gets no point for this
frame. So point k of a path does not always belong to frame k. The released code ignores this, and
so do these functions.

Paths are paired as in the released code (`traj_mapping`). The released code adds a row and a column
of zeros to its costs (since ids begin at 1), and then drops the first match, `matches[1:]`, which
should be the pair of this row and column. With a stable sort it always is. With an unstable one
(numpy's default, which differs between versions and processors), the zeros can be paired with an
instance, and then a real match is dropped. The sort is stable here, so the extra row and column are
not needed.

The released code prints nine errors, but only three are informative: it gives all predictions the
probability 1, so its p- and brier-variants equal the plain errors.
"""

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
"""Classes that are counted: the background, as if it were a single instance, and instances."""
# Largest number of entries in a histogram of pairs of ids; if it is larger, ids are renumbered.
_MAX_PAIRS = 4_000_000
Paths = Mapping[int, FloatArray]
# Largest distance between two matching paths, averaged over frames.
_MATCH_DISTANCE_M = 4.0
# Larger mean errors of paths are clipped to this one.
_MAX_ADE_M = 8.0
# Larger final errors of paths are clipped to this one.
_MAX_FDE_M = 10.0
# A path with a larger final error is a miss.
_MISS_DISTANCE_M = 5.0


@dataclass(frozen=True, slots=True, kw_only=True)
class SegmentationCounts:
    """Numbers of correct and wrong cells of one class.

    Attributes:
        true_positive: Number of cells of the class in both prediction and truth.
        false_positive: Number of cells of the class only in the prediction.
        false_negative: Number of cells of the class only in the truth.
    """

    true_positive: int
    false_positive: int
    false_negative: int


def mask_counts(predicted: BoolArray, true: BoolArray) -> SegmentationCounts:
    """Count the cells in which two masks of one class, with the same shape, agree and differ.

    >>> import numpy as np
    >>> predicted, true = np.array([[True, True]]), np.array([[True, False]])
    >>> mask_counts(predicted, true)
    SegmentationCounts(true_positive=1, false_positive=1, false_negative=0)
    """
    num_common_cells = int(np.count_nonzero(predicted & true))
    return SegmentationCounts(
        true_positive=num_common_cells,
        false_positive=int(np.count_nonzero(predicted)) - num_common_cells,
        false_negative=int(np.count_nonzero(true)) - num_common_cells,
    )


def iou(counts: Iterable[SegmentationCounts], *, absent: float = 0.0) -> float:
    """Return the intersection over union (IoU) of one class over all samples, in [0, 1].

    It is computed like `IntersectionOverUnion` of FIERY, which the released code copied.

    >>> iou([SegmentationCounts(true_positive=2, false_positive=1, false_negative=1)])
    0.5

    Args:
        counts: Counts of the samples, from `mask_counts`.
        absent: Returned if neither the predictions nor the truth contain the class.
    """
    samples = list(counts)
    intersection = sum(sample.true_positive for sample in samples)
    differences = sum(sample.false_positive + sample.false_negative for sample in samples)
    union = intersection + differences
    if not union:
        return absent
    return intersection / union


def prediction_accuracy(
    true_positives: float, false_positives: float, false_negatives: float
) -> float:
    """Return TP / (TP + FP / 2 + FN / 2), the paper's accuracy of predicted accidents or paths.

    Averaged over the allowed distances, it is the APA of the DeepAccident paper.

    >>> prediction_accuracy(3, 1, 1)
    0.75

    Args:
        true_positives: Number of true positives.
        false_positives: Number of false positives.
        false_negatives: Number of false negatives.

    Returns:
        The accuracy in [0, 1]; NaN if all three numbers are 0.
    """
    total = true_positives + false_positives / 2 + false_negatives / 2
    if not total:
        return math.nan
    return true_positives / total


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class VpqCounts(FrozenArrays):
    """Counts of T frames for each of `CLASSES`; arrays have shape (T, 2) and are read-only.

    Attributes:
        iou: Summed intersections over unions of the true positives, float64.
        true_positive: Number of true positives, int64.
        false_positive: Number of false positives, int64; 0 for the background.
        false_negative: Number of false negatives, int64; 0 for the background.
    """

    iou: FloatArray
    true_positive: IntArray
    false_positive: IntArray
    false_negative: IntArray


@dataclass(frozen=True, slots=True, kw_only=True)
class PanopticQuality:
    """Panoptic quality and its factors, in [0, 1].

    Attributes:
        pq: Segmentation quality times recognition quality.
        sq: Mean intersection over union of the true positives.
        rq: Number of true positives divided by `denominator`.
        denominator: Number of true positives plus half of the false positives and false negatives;
            at least 1.
    """

    pq: float
    sq: float
    rq: float
    denominator: float


def vpq_counts(
    prediction: AnyArray, label: AnyArray, *, temporally_consistent: bool = True
) -> VpqCounts:
    """Count the matched, missed and falsely predicted instances of one sample in each frame.

    Args:
        prediction: Instance maps, (T, H, W) integers: ids from 1; lower values are background.
        label: True instance maps of the same shape.
        temporally_consistent: Whether a true instance must keep the predicted id of its previous
            match; False for the panoptic quality of single frames.

    Raises:
        GeometryError: If the two shapes differ, or are not (T, H, W).
    """
    predicted, true = _checked_maps(prediction, label)
    shared = _shared_cells(predicted, true)
    true_size = shared.sum(axis=2)
    predicted_size = shared.sum(axis=1)
    frame, true_id, predicted_id = _match_instances(
        shared, true_size, predicted_size, consistent=temporally_consistent
    )
    intersection = shared[frame, true_id, predicted_id]
    union = true_size[frame, true_id] + predicted_size[frame, predicted_id] - intersection
    overlap = intersection / union
    matches = np.bincount(frame, minlength=len(true))
    false_alarms = np.count_nonzero(predicted_size[:, 1:], axis=1) - matches
    missed = np.count_nonzero(true_size[:, 1:], axis=1) - matches
    overlap_sums = []
    for index in range(len(true)):
        overlaps_of_frame = overlap[frame == index].tolist()
        overlap_sums.append(math.fsum(overlaps_of_frame))
    # the background matches in frames in which more than half of the union's cells are shared
    background = shared[:, 0, 0]
    background_union = np.maximum(true_size[:, 0] + predicted_size[:, 0] - background, 1)
    is_match = 2 * background > background_union
    background_overlap = np.where(is_match, background / background_union, 0.0)
    no_errors = np.zeros_like(matches)
    return VpqCounts(
        iou=np.stack([background_overlap, overlap_sums], axis=1),
        true_positive=np.stack([background_overlap > 0, matches], axis=1),
        false_positive=np.stack([no_errors, false_alarms], axis=1),
        false_negative=np.stack([no_errors, missed], axis=1),
    )


def vpq_matches(prediction: AnyArray, label: AnyArray) -> IntArray:
    """Return the matched instances: the true positives of `vpq_counts`.

    Arguments and errors are as in `vpq_counts`.

    Returns:
        (N, 3) int64: index of the frame, predicted id, true id; ordered by frame.
    """
    predicted, true = _checked_maps(prediction, label)
    predicted_ids, predicted_ranks = _rank_ids(predicted)
    true_ids, true_ranks = _rank_ids(true)
    shared = _shared_cells(predicted_ranks, true_ranks)
    frame, true_rank, predicted_rank = _match_instances(
        shared, shared.sum(axis=2), shared.sum(axis=1), consistent=True
    )
    return np.stack([frame, predicted_ids[predicted_rank], true_ids[true_rank]], axis=1)


def _rank_ids(maps: AnyArray) -> tuple[IntArray, IntArray]:
    """Return the unique ids in an array, including the background 0, and the rank of each entry."""
    with_background = np.append(np.maximum(maps, 0), 0)
    ids, ranks = np.unique(with_background, return_inverse=True)
    map_ranks = ranks.reshape(-1)[:-1].reshape(maps.shape)
    return ids.astype(np.int64), map_ranks


def panoptic_quality(
    iou: float, true_positive: float, false_positive: float, false_negative: float
) -> PanopticQuality:
    """Compute panoptic quality (PQ) from sums over frames; with sums of `vpq_counts` it is VPQ.

    It is computed like `PanopticMetric` of FIERY, and is 0 if all sums are 0.

    >>> panoptic_quality(1.5, 2, 1, 1)
    PanopticQuality(pq=0.5, sq=0.75, rq=0.6666666666666666, denominator=3.0)

    Args:
        iou: Summed intersections over unions of the true positives.
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
    """Return instance maps (T, H, W) as arrays; raise GeometryError if they do not fit."""
    predicted = as_numbers("prediction", prediction, dtype=None)
    true = as_numbers("label", label, dtype=None)
    if predicted.shape != true.shape or true.ndim != 3:
        raise GeometryError(
            f"prediction: expected (T, H, W) as the label's {true.shape}, found {predicted.shape}"
        )
    return predicted, true


def _shared_cells(predicted: AnyArray, true: AnyArray) -> IntArray:
    """Count the cells of each frame, true id and predicted id, shape (T, G + 1, P + 1).

    Id 0 is the background. Large ids are replaced by their ranks.
    """
    frames = len(true)
    cells = true[0].size if len(true) else 0
    occupied = np.flatnonzero((predicted > 0) | (true > 0))
    true_id = np.maximum(true.reshape(-1)[occupied], 0).astype(np.int64)
    predicted_id = np.maximum(predicted.reshape(-1)[occupied], 0).astype(np.int64)
    if math.prod(_pairs_shape(frames, true_id, predicted_id)) > _MAX_PAIRS:
        _, true_id = _rank_ids(true_id)
        _, predicted_id = _rank_ids(predicted_id)
    shape = _pairs_shape(frames, true_id, predicted_id)
    _, true_ids, predicted_ids = shape
    frame = occupied // max(cells, 1)
    pairs = (frame * true_ids + true_id) * predicted_ids + predicted_id
    pair_counts = np.bincount(pairs, minlength=math.prod(shape))
    shared: IntArray = pair_counts.reshape(shape)
    shared[:, 0, 0] = cells - np.bincount(frame, minlength=frames)
    return shared


def _pairs_shape(frames: int, true_id: IntArray, predicted_id: IntArray) -> tuple[int, int, int]:
    """Return the shape of a histogram over frames, true ids and predicted ids."""
    true_ids = int(true_id.max(initial=0)) + 1
    predicted_ids = int(predicted_id.max(initial=0)) + 1
    return frames, true_ids, predicted_ids


def _match_instances(
    shared: IntArray, true_size: IntArray, predicted_size: IntArray, *, consistent: bool
) -> tuple[IntArray, IntArray, IntArray]:
    """Return the frame, true id and predicted id of each matched pair, ordered by frame.

    With `consistent`, a true instance only matches the predicted id of its previous match.
    """
    frame, true_id, predicted_id = np.nonzero(shared[:, 1:, 1:])
    true_id = true_id + 1
    predicted_id = predicted_id + 1
    intersection = shared[frame, true_id, predicted_id]
    sizes = true_size[frame, true_id] + predicted_size[frame, predicted_id]
    matches = np.flatnonzero(3 * intersection > sizes)  # more than half of the union
    if consistent:
        # the matches of each true id, by frame
        order = np.argsort(true_id[matches], kind="stable")
        is_same_truth = np.diff(true_id[matches][order]) == 0
        has_jumped = is_same_truth & (np.diff(predicted_id[matches][order]) != 0)
        matches = np.delete(matches, order[1:][has_jumped])
    return frame[matches], true_id[matches], predicted_id[matches]


@dataclass(frozen=True, slots=True, kw_only=True)
class TrajectoryMatches:
    """Matched pairs of predicted and true paths.

    Attributes:
        pairs: (predicted id, true id) of each pair, in ascending order of cost.
        costs: Cost of each pair: the distance summed over frames, metres.
        unmatched_prediction: Predicted ids without a match: first the ones that are left over, in
            ascending order, then the ones that are too far from the path they were paired with, in
            ascending order of cost.
        unmatched_truth: True ids without a match, in the same order.
    """

    pairs: tuple[tuple[int, int], ...]
    costs: tuple[float, ...]
    unmatched_prediction: tuple[int, ...]
    unmatched_truth: tuple[int, ...]


def longest(paths: Paths) -> int:
    """Return the number of points of the longest path; 0 if there are no paths.

    The released code pads predicted and true paths to the length of the longest true path.
    """
    return max(map(len, paths.values()), default=0)


def padded(paths: Paths, length: int) -> dict[int, FloatArray]:
    """Extend each path to a number of points; longer paths do not change.

    A quirk of the released code is reproduced: a path whose last step is d continues by d, 2 d,
    3 d, … per frame. A path with a single point stands still.

    Args:
        paths: Paths with at least one point each.
        length: Number of points to which paths are extended.
    """
    extended = {}
    for identity, path in paths.items():
        extended[identity] = _extend_path(path, length)
    return extended


def match_trajectories(prediction: Paths, truth: Paths) -> TrajectoryMatches:
    """Match predicted and true paths greedily, the nearest pair first.

    If the paths of a pair are too far apart, both count as unmatched and are not paired again.

    Args:
        prediction: Id → predicted path, (≥ T, 2) metres; only the first T points count (see
            `padded`).
        truth: Id → true path, (T, 2) metres.

    Raises:
        GeometryError: If the true paths differ in length, or a predicted path is shorter.
    """
    predicted = list(prediction)
    true = list(truth)
    costs = _path_costs(prediction, truth)
    max_cost = _MATCH_DISTANCE_M * longest(truth)
    free_predicted = dict.fromkeys(sorted(predicted))
    free_true = dict.fromkeys(sorted(true))
    pairs = []
    pair_costs = []
    far_pairs = []
    for flat in np.argsort(costs, axis=None, kind="stable").tolist():
        row, column = divmod(flat, len(true))
        predicted_id = predicted[row]
        true_id = true[column]
        if predicted_id not in free_predicted or true_id not in free_true:
            continue
        del free_predicted[predicted_id]
        del free_true[true_id]
        cost = costs.item(flat)
        if cost <= max_cost:
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
    """Compute the distances between points (…, 2) and other points (…, 2).

    `np.hypot` is not used, since its last bit differs between machines.
    """
    difference = first - second
    x = difference[..., 0]
    y = difference[..., 1]
    return np.asarray(np.sqrt(x * x + y * y))


def _extend_path(path: FloatArray, length: int) -> FloatArray:
    """Extend a path by growing steps to at least `length` points."""
    num_missing = length - len(path)
    if num_missing <= 0:
        return path
    last_step = path[-1] - path[-2] if len(path) > 1 else np.zeros(2)
    steps = np.arange(1.0, num_missing + 1)[:, None] * last_step
    added: FloatArray = np.cumsum([path[-1], *steps], axis=0)[1:]
    return np.concatenate([path, added])


def _path_costs(prediction: Paths, truth: Paths) -> FloatArray:
    """Sum the distances of each pair of paths over frames, in order of time, shape (P, G)."""
    length = longest(truth)
    has_short_truth = any(len(path) != length for path in truth.values())
    if has_short_truth or any(len(path) < length for path in prediction.values()):
        raise GeometryError(f"trajectories: expected {length} points each; see `padded`")
    costs = np.zeros((len(prediction), len(truth)))
    if costs.size:
        predicted = np.stack([path[:length] for path in prediction.values()], axis=1)
        true = np.stack([path[:length] for path in truth.values()], axis=1)
        for predicted_points, true_points in zip(predicted, true, strict=True):
            costs += distances(predicted_points[:, None], true_points[None])
    return costs


def instance_paths(instance: AnyArray, grid: BevGrid) -> dict[int, FloatArray]:
    """Return the paths of the first frame's instances, like `LinkedInstances.centers` for heads.

    Args:
        instance: (T, H, W) ids from 1 that stay the same over the frames, 0 elsewhere.
        grid: Cells and orientation of the maps.

    Returns:
        Id, ascending → path, (n, 2) x forward, y left, metres: the mean of the instance's cell
        centres in each frame that contains the instance.
    """
    shape = instance.shape[1:]
    ids = np.unique(instance[0][instance[0] > 0])
    flat = np.flatnonzero(instance > 0)
    identity = instance.reshape(-1)[flat]
    rank = np.minimum(np.searchsorted(ids, identity), max(len(ids) - 1, 0))
    is_in_first_frame = np.zeros(len(flat), dtype=bool)
    if len(ids):
        is_in_first_frame = ids[rank] == identity
    frame, row, column = np.unravel_index(flat[is_in_first_frame], instance.shape)
    key = rank[is_in_first_frame] * len(instance) + frame
    length = len(ids) * len(instance)
    y, x = cells_in(row, column, shape, grid.orientation, "devkit")
    cell_count = np.bincount(key, minlength=length)
    coordinates = []
    for cells, (low, _, size) in ((x, grid.x), (y, grid.y)):
        mean_cell = np.bincount(key, cells, length) / np.maximum(cell_count, 1)
        coordinates.append(low + (mean_cell + 0.5) * size)
    positions = np.stack(coordinates, axis=-1).reshape(len(ids), len(instance), 2)
    is_present = cell_count.reshape(len(ids), len(instance)) > 0
    paths = {}
    for index, instance_id in enumerate(ids.tolist()):
        paths[instance_id] = positions[index][is_present[index]]
    return paths


@dataclass(frozen=True, slots=True, kw_only=True)
class TrajectoryErrors:
    """Sums over the true paths of a sample that are matched in at least one prediction.

    Attributes:
        ade: Summed errors of the paths, each averaged over its frames, metres.
        fde: Summed errors of the paths in the last frame, metres.
        missed: Number of paths whose final error is too large.
        count: Number of paths.
    """

    ade: float
    fde: float
    missed: int
    count: int


def trajectory_errors(
    predictions: Sequence[Paths], truth: Paths, matches: Sequence[TrajectoryMatches]
) -> TrajectoryErrors:
    """Sum the errors of a sample; for each true path, the prediction that ends nearest counts.

    If predictions are equally near, the first counts. A quirk of the released code is reproduced:
    if the first prediction has no path at all, the sample does not count, even if other predictions
    have paths.

    Args:
        predictions: K predictions, each with id → path, (≥ T, 2) metres.
        truth: Id → true path, (T, 2) metres.
        matches: Matches of each prediction with the truth.
    """
    ade = 0.0
    fde = 0.0
    missed = 0
    count = 0
    frames = longest(truth)
    if predictions and not predictions[0]:
        return TrajectoryErrors(ade=ade, fde=fde, missed=missed, count=count)
    partners = []
    for match in matches:
        partners.append({true_id: predicted_id for predicted_id, true_id in match.pairs})
    for true_id, path in truth.items():
        errors = []
        for paths, partner_ids in zip(predictions, partners, strict=True):
            if true_id in partner_ids:
                partner = paths[partner_ids[true_id]][:frames]
                errors.append(distances(partner, path))
        if not errors:
            continue
        best_errors = min(errors, key=lambda error: error.item(-1))
        final_error = best_errors.item(-1)
        ade += min(sum(best_errors.tolist()) / frames, _MAX_ADE_M)
        fde += min(final_error, _MAX_FDE_M)
        missed += final_error > _MISS_DISTANCE_M  # True counts as 1
        count += 1
    return TrajectoryErrors(ade=ade, fde=fde, missed=missed, count=count)
