"""Predicted instances against true ones: how far their cells overlap (IoU, VPQ), and where they go (paths).

VPQ: instances found, in the right cells and under the same id in all frames. In each frame a true and a predicted
instance match if the intersection of their cells is more than half of the union, so that each has at most one partner.
A true instance that was matched with another predicted id when it last had a match is no true positive but both missed
and a false alarm. The other way round, a predicted id that jumps to another true instance, is not punished.
FIERY's measure, of which the released code has a copy; counts are sums over frames (docs/released_code.md, IoU and
VPQ).

Paths (docs/released_code.md, Paths) are those of the instances of the first frame: id → (n, 2) positions, such as
`motion.trajectories` gives in metres, or `LinkedInstances.centers` times the cells' size. An instance that a frame
lacks has no point for it, so that point k of a path is not always of frame k. The released code ignores this, and so
do these functions.

Paths are paired as the released code does (`traj_mapping`). It adds a row and a column of zeros to its costs (ids begin
at 1) and then drops the first match, `matches[1:]`, as the one of those two. With a stable sort it always is; an
unstable one (numpy's default, which differs with version and processor) can pair the zeros with somebody and drop a
real match. Here the sort is stable, and so the extra row and the dropped match are left out of it.

Of the errors the released code prints nine numbers, of which three say anything: it gives all predictions the
probability 1, so that its p- and brier-variants are the plain ones.
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
# Entries of a histogram of pairs of ids; ids that would need more are renumbered.
_MOST_PAIRS: Final = 4_000_000


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


def vpq_counts(
    prediction: AnyArray, label: AnyArray, *, temporally_consistent: bool = True
) -> VpqCounts:
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
    frame, true_id, predicted_id = _matches(
        shared, true_size, predicted_size, consistent=temporally_consistent
    )
    inside = shared[frame, true_id, predicted_id]
    overlap = inside / (true_size[frame, true_id] + predicted_size[frame, predicted_id] - inside)
    found = np.bincount(frame, minlength=len(true))
    alarms = np.count_nonzero(predicted_size[:, 1:], axis=1) - found
    missed = np.count_nonzero(true_size[:, 1:], axis=1) - found
    covered = np.array([math.fsum(overlap[frame == index].tolist()) for index in range(len(true))])
    same = shared[
        :, 0, 0
    ]  # cells of the background in both, which counts where they are more than half of the union
    union = np.maximum(true_size[:, 0] + predicted_size[:, 0] - same, 1)
    beside = np.where(2 * same > union, same / union, 0.0)
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
    frame, true_id, predicted_id = _matches(
        shared, shared.sum(axis=2), shared.sum(axis=1), consistent=True
    )
    return np.stack([frame, names[0][predicted_id], names[1][true_id]], axis=1)


def panoptic_quality(
    iou: float, true_positive: float, false_positive: float, false_negative: float
) -> PanopticQuality:
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
    predicted, true = (
        as_numbers("prediction", prediction, dtype=None),
        as_numbers("label", label, dtype=None),
    )
    if predicted.shape != true.shape or true.ndim != 3:
        raise GeometryError(
            f"prediction: expected (T, H, W) as the label's {true.shape}, found {predicted.shape}"
        )
    return predicted, true


def _shared_cells(predicted: AnyArray, true: AnyArray) -> IntArray:
    """(T, G + 1, P + 1) cells by true and predicted id, 0 the background; ids are renumbered if they are large."""
    frames, cells = len(true), true[0].size if len(true) else 0
    here = np.flatnonzero((predicted > 0) | (true > 0))
    true_id, predicted_id = (
        np.maximum(maps.reshape(-1)[here], 0).astype(np.int64) for maps in (true, predicted)
    )
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
    match = np.flatnonzero(
        3 * inside > true_size[frame, true_id] + predicted_size[frame, predicted_id]
    )
    if consistent:
        order = np.argsort(true_id[match], kind="stable")  # of each true id by time
        other = (np.diff(true_id[match][order]) == 0) & (np.diff(predicted_id[match][order]) != 0)
        match = np.delete(match, order[1:][other])
    return frame[match], true_id[match], predicted_id[match]


Paths = Mapping[int, FloatArray]
# Metres, the mean over the frames, within which two paths can be the same.
_GATE: Final = 4.0
# Metres: a larger mean error, or final error, counts as this.
_ADE_LIMIT, _FDE_LIMIT = 8.0, 10.0
# Metres; a larger final error is a miss.
_MISS_DISTANCE: Final = 5.0


@dataclass(frozen=True, slots=True, kw_only=True)
class TrajectoryMatches:
    """Pairs of predicted and true paths.

    Attributes:
        pairs: (predicted id, true id), by rising cost.
        costs: of each pair, the sum of the distances over the frames, metres.
        unmatched_prediction: predicted ids without a partner: those left over, ascending, then those whose best
            partner was too far, by rising cost.
        unmatched_truth: likewise of the true ids.
    """

    pairs: tuple[tuple[int, int], ...]
    costs: tuple[float, ...]
    unmatched_prediction: tuple[int, ...]
    unmatched_truth: tuple[int, ...]


def longest(paths: Paths) -> int:
    """How many points the longest path has; 0 without paths. The released code pads both sides to the truth's."""
    return max((len(path) for path in paths.values()), default=0)


def padded(paths: Paths, length: int) -> dict[int, FloatArray]:
    """The paths, those shorter than `length` points continued; longer ones stay as they are.

    The released quirk: a path whose last step is d goes on by d, 2 d, 3 d, … a frame. A path of one point stands still.

    Args:
        paths: of at least one point each.
        length: points wanted.
    """
    return {name: _continued(path, length) for name, path in paths.items()}


def match_trajectories(prediction: Paths, truth: Paths) -> TrajectoryMatches:
    """Pair paths greedily, the nearest two first; a pair that is too far apart uses up both and counts as unmatched.

    Args:
        prediction: id → (≥ T, 2) metres, of which the first T points count (see `padded`).
        truth: id → (T, 2) metres.

    Raises:
        GeometryError: true paths of several lengths, or a predicted one that is shorter.
    """
    predicted, true = list(prediction), list(truth)
    costs = _costs(prediction, truth)
    limit = _GATE * longest(truth)
    free_predicted, free_true = dict.fromkeys(sorted(predicted)), dict.fromkeys(sorted(true))
    near: list[tuple[tuple[int, int], float]] = []
    far: list[tuple[tuple[int, int], float]] = []
    for flat in np.argsort(costs, axis=None, kind="stable").tolist():
        row, column = divmod(flat, len(true))
        pair = predicted[row], true[column]
        if pair[0] in free_predicted and pair[1] in free_true:
            del free_predicted[pair[0]], free_true[pair[1]]
            cost = costs.item(flat)
            (near if cost <= limit else far).append((pair, cost))
            if not (free_predicted and free_true):
                break
    return TrajectoryMatches(
        pairs=tuple(pair for pair, _ in near),
        costs=tuple(cost for _, cost in near),
        unmatched_prediction=(*free_predicted, *(pair[0] for pair, _ in far)),
        unmatched_truth=(*free_true, *(pair[1] for pair, _ in far)),
    )


def distances(first: FloatArray, second: FloatArray) -> FloatArray:
    """Between points (…, 2); without np.hypot, whose last bit is not everywhere the same."""
    apart = first - second
    return np.asarray(np.sqrt(apart[..., 0] * apart[..., 0] + apart[..., 1] * apart[..., 1]))


def _continued(path: FloatArray, length: int) -> FloatArray:
    missing = length - len(path)
    if missing <= 0:
        return path
    step = path[-1] - path[-2] if len(path) > 1 else np.zeros(2)
    added: FloatArray = np.cumsum(
        [path[-1], *(np.arange(1.0, missing + 1)[:, None] * step)], axis=0
    )[1:]
    return np.concatenate([path, added])


def _costs(prediction: Paths, truth: Paths) -> FloatArray:
    """(P, G) the sums of the distances over the frames, from the first frame on."""
    length = longest(truth)
    if any(len(path) != length for path in truth.values()) or any(
        len(path) < length for path in prediction.values()
    ):
        raise GeometryError(f"trajectories: expected {length} points each; see `padded`")
    result = np.zeros((len(prediction), len(truth)))
    if result.size:
        predicted, true = (
            np.stack([path[:length] for path in paths.values()], axis=1)
            for paths in (prediction, truth)
        )
        for here, there in zip(predicted, true, strict=True):
            result += distances(here[:, None], there[None])
    return result


def instance_paths(instance: AnyArray, grid: BevGrid) -> dict[int, FloatArray]:
    """Where the instances of the first frame go, as `LinkedInstances.centers` has it for those read off heads.

    Args:
        instance: (T, H, W) ids from 1 that stay the same over the frames, 0 elsewhere.
        grid: its cells and orientation.

    Returns:
        Id, ascending → (n, 2) x forward, y left, metres: the mean of its cells' centres in each frame that it is in;
        a frame without it has no point.
    """
    shape = instance.shape[1:]
    ids = np.unique(instance[0][instance[0] > 0])
    place = np.flatnonzero(instance > 0)
    identity = instance.reshape(-1)[place]
    which = np.minimum(np.searchsorted(ids, identity), max(len(ids) - 1, 0))
    known = ids[which] == identity if len(ids) else np.zeros(len(place), dtype=bool)
    frame, *cell = np.unravel_index(place[known], instance.shape)
    key, length = which[known] * len(instance) + frame, len(ids) * len(instance)
    y, x = cells_in(cell[0], cell[1], shape, grid.orientation, "devkit")
    count = np.bincount(key, minlength=length)
    mean = [np.bincount(key, along, length) / np.maximum(count, 1) for along in (x, y)]
    metres = [
        low + (along + 0.5) * size
        for along, (low, _, size) in zip(mean, (grid.x, grid.y), strict=True)
    ]
    paths = np.stack(metres, axis=-1).reshape(len(ids), len(instance), 2)
    there = count.reshape(len(ids), len(instance)) > 0
    return {name: path[here] for name, path, here in zip(ids.tolist(), paths, there, strict=True)}


@dataclass(frozen=True, slots=True, kw_only=True)
class TrajectoryErrors:
    """Sums over the true paths of a sample that have a partner in some prediction.

    Attributes:
        ade: of the mean distances over the frames, metres.
        fde: of the distances at the last frame, metres.
        missed: how many are missed.
        count: how many there are.
    """

    ade: float
    fde: float
    missed: int
    count: int


def trajectory_errors(
    predictions: Sequence[Paths], truth: Paths, matches: Sequence[TrajectoryMatches]
) -> TrajectoryErrors:
    """The errors of a sample; for each true path, those of the prediction that ends nearest to it (the first of ties).

    The released quirk: where the first prediction has no path at all, the sample does not count, even if other
    predictions have paths.

    Args:
        predictions: K times id → (≥ T, 2) metres.
        truth: id → (T, 2) metres.
        matches: of each prediction with the truth.
    """
    ade, fde, missed, count = 0.0, 0.0, 0, 0
    frames = longest(truth)
    if predictions and not predictions[0]:
        return TrajectoryErrors(ade=ade, fde=fde, missed=missed, count=count)
    partners = [{true: mine for mine, true in match.pairs} for match in matches]
    for name, path in truth.items():
        errors = [
            distances(paths[mine[name]][:frames], path)
            for paths, mine in zip(predictions, partners, strict=True)
            if name in mine
        ]
        if errors:
            best = min(errors, key=lambda each: each.item(-1))
            ade += min(sum(best.tolist()) / frames, _ADE_LIMIT)
            fde += min(best.item(-1), _FDE_LIMIT)
            missed += best.item(-1) > _MISS_DISTANCE
            count += 1
    return TrajectoryErrors(ade=ade, fde=fde, missed=missed, count=count)
