"""Where instances go, which predicted path is which true one, and how far off it is (docs/released_code.md, Paths).

Paths are those of the instances of the first frame: id → (n, 2) positions, such as `motion.trajectories` gives in
metres, or `LinkedInstances.centers` times the cells' size. An instance that a frame lacks has no point for it, so that
point k of a path is not always of frame k. The released code ignores this, and so do these functions.

They are paired as the released code does (`traj_mapping`). It adds a row and a column of zeros to its costs (ids begin
at 1) and then drops the first match, `matches[1:]`, as the one of those two. With a stable sort it always is; an
unstable one (numpy's default, which differs with version and processor) can pair the zeros with somebody and drop a
real match. Here the sort is stable, and so the extra row and the dropped match are left out of it.

Of the errors the released code prints nine numbers, of which three say anything: it gives all predictions the
probability 1, so that its p- and brier-variants are the plain ones.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.geometry.bev_grid import cells_in
from deepaccident_devkit.support.arrays import AnyArray, FloatArray

Paths = Mapping[int, FloatArray]
_GATE: Final = 4.0
"""Metres, the mean over the frames, within which two paths can be the same."""
_ADE_LIMIT, _FDE_LIMIT = 8.0, 10.0
"""Metres: a larger mean error, or final error, counts as this."""
_MISS_DISTANCE: Final = 5.0
"""Metres; a larger final error is a miss."""


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
    added: FloatArray = np.cumsum([path[-1], *(np.arange(1.0, missing + 1)[:, None] * step)], axis=0)[1:]
    return np.concatenate([path, added])


def _costs(prediction: Paths, truth: Paths) -> FloatArray:
    """(P, G) the sums of the distances over the frames, from the first frame on."""
    length = longest(truth)
    if any(len(path) != length for path in truth.values()) or any(len(path) < length for path in prediction.values()):
        raise GeometryError(f"trajectories: expected {length} points each; see `padded`")
    result = np.zeros((len(prediction), len(truth)))
    if result.size:
        predicted, true = (
            np.stack([path[:length] for path in paths.values()], axis=1) for paths in (prediction, truth)
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
    metres = [low + (along + 0.5) * size for along, (low, _, size) in zip(mean, (grid.x, grid.y), strict=True)]
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
