"""`Forecast`: predicted paths of an actor; and functions that compare them with the recorded path.

The errors of a mode, and the joint errors of all actors (`world_errors`), are defined as in the
package av2, which does not select a mode. The mode that counts is selected as in
`eval_forecasting.py` of `argoverse-api`: it is the one with the lowest final error.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.evaluation.drawing import Drawing, DrawnPath
from deepaccident_devkit.evaluation.instances import distances
from deepaccident_devkit.evaluation.predictions import ascending_times
from deepaccident_devkit.support.arrays import (
    BoolArray,
    FloatArray,
    FrozenArrays,
    checked,
    checked_whole,
)

# Largest final error that is not a miss, metres.
MISS_DISTANCE: Final = 2.0
# Two actors collide if their centres are nearer to each other than this, metres.
COLLISION_DISTANCE: Final = 1.0
# Seconds by which a time may differ from its step, as sums of float32 do.
SAME_TIME: Final = 1e-3
# Pictures of modes divide by at least this probability.
_MIN_PROBABILITY = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Forecast(FrozenArrays):
    """Predicted paths of an actor in K modes; arrays are read-only.

    Attributes:
        actor_id: CARLA id of the actor.
        times: (T,) seconds after the current frame, ascending.
        paths: (K, T, 2) centres of the actor's box, x forward, y left, metres in the current ego
            frame.
        probabilities: (K,) probabilities of the modes; their sum may differ from 1.
    """

    actor_id: int
    times: FloatArray
    paths: FloatArray
    probabilities: FloatArray

    def __post_init__(self) -> None:
        """Check and freeze the arrays.

        Raises:
            GeometryError: If a shape or a value is invalid.
        """
        times = ascending_times(self.times)
        probabilities = checked("probabilities", self.probabilities, (None,)).copy()
        paths = checked("paths", self.paths, (len(probabilities), len(times), 2)).copy()
        if not len(paths) or not np.isfinite(paths).all():
            raise GeometryError(
                "paths: expected at least one mode of finite numbers; leave out actors and "
                "times without a prediction"
            )
        if not ((probabilities >= 0) & (probabilities <= 1)).all():
            raise GeometryError(
                f"probabilities: expected numbers from 0 to 1, found {probabilities.tolist()}"
            )
        actor_id = checked_whole("actor id", self.actor_id)
        object.__setattr__(self, "actor_id", actor_id)
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "paths", paths)
        object.__setattr__(self, "probabilities", probabilities)
        FrozenArrays.__post_init__(self)

    def drawing(self) -> Drawing:
        """Describe the modes for a picture; the most probable one is the darkest."""
        highest = max(float(self.probabilities.max()), _MIN_PROBABILITY)
        modes = []
        for path, probability in zip(self.paths, self.probabilities.tolist(), strict=True):
            mode = DrawnPath(
                xy=path,
                times=self.times,
                role="predicted",
                probability=probability / highest,
                label="predicted",
            )
            modes.append(mode)
        return Drawing(paths=tuple(modes))

    def at(self, steps: FloatArray, present: FloatArray) -> FloatArray:
        """Interpolate the positions linearly at S times.

        Before the forecast's first time, the actor moves in a straight line from its current
        position.

        Args:
            steps: (S,) seconds after the current frame.
            present: (2,) current position, metres.

        Returns:
            Positions, shape (K, S, 2), metres; NaN after the forecast's last time.
        """
        times = self.times
        paths = self.paths
        if times[0] > 0:
            start = np.broadcast_to(present, (len(paths), 1, 2))
            times = np.append(0.0, times)
            paths = np.concatenate([start, paths], axis=1)
        if len(times) == 1:
            return np.full((len(paths), len(steps), 2), np.nan)
        later = times.searchsorted(steps - SAME_TIME).clip(1, len(times) - 1)
        earlier = later - 1
        period = times[later] - times[earlier]
        share = ((steps - times[earlier]) / period)[:, None]
        positions: FloatArray = paths[:, earlier] * (1 - share) + paths[:, later] * share
        is_after_end = steps > times[-1] + SAME_TIME
        positions[:, is_after_end] = np.nan
        return positions


def displacement_errors(
    paths: FloatArray, truth: FloatArray, valid: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Return the average and the final displacement error (ADE, FDE) of each mode, metres.

    They are defined like `compute_ade` and `compute_fde` of av2 (`argoverse/av2-api`), except that
    the ADE is averaged over valid steps only.

    >>> import numpy as np
    >>> truth = np.array([[[1.0, 0.0], [2.0, 0.0]]])
    >>> paths = truth[:, None] + [0.0, 3.0]
    >>> displacement_errors(paths, truth, valid=np.array([[True, True]]))
    (array([[3.]]), array([[3.]]))

    Args:
        paths: (N, K, T, 2) predicted positions of N actors in K modes, metres; NaN if missing.
        truth: (N, T, 2) recorded positions at the same times, metres.
        valid: (N, T) bool, True for steps that are recorded; `truth` is ignored at other steps.

    Returns:
        The ADE, (N, K): the mean distance over the valid steps; and the FDE, (N, K): the distance
        at the last step. The ADE is NaN without a valid step, the FDE if the last step is not
        valid; both are NaN if the path ends before the last step.
    """
    errors = distances(paths, truth[:, None])
    errors = np.where(valid[:, None], errors, 0.0)
    step_count = valid.sum(axis=1)[:, None]
    mean_errors = errors.sum(axis=-1) / np.maximum(step_count, 1)
    reaches_end = np.isfinite(paths[..., -1, :]).all(axis=-1)
    ade = np.where((step_count > 0) & reaches_end, mean_errors, np.nan)
    fde = np.where(valid[:, -1:], errors[..., -1], np.nan)
    return ade, fde


def misses(final_errors: FloatArray, miss_distance: float = MISS_DISTANCE) -> FloatArray:
    """Return 1 for final errors that are misses and 0 for others; NaN stays NaN.

    Args:
        final_errors: Displacement errors at the last step, metres, of any shape.
        miss_distance: Largest error that is not a miss, metres.
    """
    is_missed = final_errors > miss_distance
    return np.where(np.isnan(final_errors), np.nan, is_missed)


def miss_rate(final_errors: FloatArray, miss_distance: float = MISS_DISTANCE) -> float:
    """Return the share of final errors that are misses, like av2's `compute_is_missed_prediction`.

    >>> import numpy as np
    >>> miss_rate(np.array([0.5, 1.0, 2.5, np.nan]), miss_distance=2.0) == 1 / 3
    True

    Args:
        final_errors: (N,) displacement errors at the last step, metres; NaN is ignored.
        miss_distance: Largest error that is not a miss, metres.

    Returns:
        The miss rate in [0, 1]; NaN if there is nothing to count.
    """
    known_errors = final_errors[~np.isnan(final_errors)]
    if not len(known_errors):
        return np.nan
    return float((known_errors > miss_distance).mean())


def brier(errors: FloatArray, probabilities: FloatArray) -> FloatArray:
    """Add the Brier penalty (1 − probability)² to errors in metres, as av2 does."""
    return errors + (1 - probabilities) ** 2


def actor_errors(
    paths: FloatArray,
    truth: FloatArray,
    valid: BoolArray,
    probabilities: FloatArray,
    mode_count: int,
    miss_distance: float = MISS_DISTANCE,
) -> dict[str, FloatArray]:
    """Compute the errors of each actor's best mode.

    The best mode has the lowest FDE among the `mode_count` most probable modes (ties: the first).

    Args:
        paths: (N, K, T, 2) predicted positions, metres; NaN if missing.
        truth: (N, T, 2) recorded positions, metres.
        valid: (N, T) bool, True for steps that are recorded.
        probabilities: (N, K) probabilities of the modes, not normalised; NaN for missing modes.
        mode_count: Number of modes that count.
        miss_distance: Largest FDE that is not a miss, metres.

    Returns:
        Arrays (N,). `min_fde`, `miss` (1 or 0) and `brier_min_fde` describe the best mode, as does
        `min_ade`; `min_ade_any` and `cut_ade` are the lowest ADE of any mode. Errors are NaN unless
        the path reaches the last step, and unless the truth is recorded: at the last step for
        `min_fde`, `miss` and `brier_min_fde`, at all steps for `min_ade` and `min_ade_any`, at any
        step for `cut_ade`.
    """
    ade, fde = displacement_errors(paths, truth, valid)
    actor = np.arange(len(paths))
    most_probable = np.argsort(-probabilities, axis=1, kind="stable")[:, :mode_count]
    ade = ade[actor[:, None], most_probable]
    fde = fde[actor[:, None], most_probable]
    known_fde = np.where(np.isnan(fde), np.inf, fde)
    best_modes = np.argmin(known_fde, axis=1)
    min_ade = ade[actor, best_modes]
    min_fde = fde[actor, best_modes]
    probability = probabilities[actor, most_probable[actor, best_modes]]
    min_ade_any = np.fmin.reduce(ade, axis=1)
    is_complete = valid.all(axis=1)
    return {
        "min_ade": np.where(is_complete, min_ade, np.nan),
        "min_fde": min_fde,
        "miss": misses(min_fde, miss_distance),
        "brier_min_fde": brier(min_fde, probability),
        "min_ade_any": np.where(is_complete, min_ade_any, np.nan),
        "cut_ade": min_ade_any,
    }


def world_errors(paths: FloatArray, truth: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Compute the joint errors of N actors; the k-th modes of all actors form the k-th world.

    Args:
        paths: (N, K, T, 2) predicted positions of at least one actor, metres.
        truth: (N, T, 2) recorded positions, metres, without missing ones.

    Returns:
        ADE and FDE averaged over the actors, (K,) metres each, and the FDE of each actor, (N, K)
        metres.
    """
    valid = np.ones(truth.shape[:2], dtype=bool)
    ade, fde = displacement_errors(paths, truth, valid)
    return ade.mean(axis=0), fde.mean(axis=0), fde


def collisions(paths: FloatArray, distance: float = COLLISION_DISTANCE) -> BoolArray:
    """Find out which actors come too near to another one in each mode, shape (N, K) bool.

    Args:
        paths: (N, K, T, 2) predicted centres, metres.
        distance: Actors collide if their centres are nearer to each other at any step, metres.
    """
    center_distances = distances(paths[:, None], paths)
    actor = np.arange(len(paths))
    center_distances[actor, actor] = np.inf
    is_near: BoolArray = center_distances < distance
    return np.asarray(is_near.any(axis=(1, 3)))
