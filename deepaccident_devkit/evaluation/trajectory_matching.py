"""Which predicted path is which true one, as the released evaluation pairs them (evaluation.md d, `traj_mapping`).

Paths are those of the instances of the first frame: id → (n, 2) positions, such as `motion.trajectories` gives in
metres, or `LinkedInstances.centers` times the cells' size. An instance that a frame lacks has no point for it, so that
point k of a path is not always frame k; the released code takes it so, and so do these functions.

The released code adds a row and a column of zeros to its costs (ids begin at 1) and then drops the first match,
`matches[1:]`, as the one of those two. With a stable sort it always is; an unstable one (numpy's default, which differs
with version and processor) can pair the zeros with somebody and drop a real match. Here the sort is stable, and so the
extra row and the dropped match are left out of it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from deepaccident_devkit.arrays import FloatArray
from deepaccident_devkit.errors import GeometryError

Paths = Mapping[int, FloatArray]
GATE: Final = 4.0
"""Metres, the mean over the frames, within which two paths can be the same."""


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


def padded(paths: Paths, length: int, *, accelerating: bool = True) -> dict[int, FloatArray]:
    """The paths, those shorter than `length` points continued; longer ones stay as they are.

    Args:
        paths: of at least one point each.
        length: points wanted.
        accelerating: the released slip: a path whose last step is d goes on by d, 2 d, 3 d, … a frame; else by d each
            time. A path of one point stands still.
    """
    return {name: _continued(path, length, accelerating=accelerating) for name, path in paths.items()}


def match_trajectories(prediction: Paths, truth: Paths, *, gate: float = GATE) -> TrajectoryMatches:
    """Pair paths greedily, the nearest two first; a pair that is too far apart uses up both and counts as unmatched.

    Args:
        prediction: id → (≥ T, 2) metres, of which the first T points count (see `padded`).
        truth: id → (T, 2) metres.
        gate: metres a frame that the paths of a pair may be apart at most, on average.

    Raises:
        GeometryError: true paths of several lengths, or a predicted one that is shorter.
    """
    predicted, true = list(prediction), list(truth)
    costs = _costs(prediction, truth)
    limit = gate * longest(truth)
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
    result: FloatArray = np.sqrt(apart[..., 0] * apart[..., 0] + apart[..., 1] * apart[..., 1])
    return result


def _continued(path: FloatArray, length: int, *, accelerating: bool) -> FloatArray:
    missing = length - len(path)
    if missing <= 0:
        return path
    step = path[-1] - path[-2] if len(path) > 1 else np.zeros(2)
    factor = np.arange(1.0, missing + 1) if accelerating else np.ones(missing)
    added: FloatArray = np.cumsum([path[-1], *(factor[:, None] * step)], axis=0)[1:]
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
