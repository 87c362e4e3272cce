"""`Forecast`: predicted paths of an actor; and how far such paths are from the recorded one.

The errors by mode, and the joint errors of all actors (`world_errors`), are defined as in the
package av2, which picks no mode. The mode that counts is chosen as in `eval_forecasting.py` of
`argoverse-api`: the one with the least error at the end.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.evaluation.instances import distances
from deepaccident_devkit.evaluation.predictions import ascending_times
from deepaccident_devkit.support.arrays import (
    BoolArray,
    FloatArray,
    FrozenArrays,
    checked,
    checked_whole,
)

# Metres; a larger error at the end is a miss.
MISS_DISTANCE: Final = 2.0
# Metres; centres that come nearer to each other collide.
COLLISION_DISTANCE: Final = 1.0
# Seconds by which a moment may miss its step, as sums of float32 do.
SAME_TIME: Final = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Forecast(FrozenArrays):
    """Predicted paths of an actor: K modes; arrays are read-only.

    Attributes:
        actor_id: CARLA id of the actor.
        times: (T,) seconds after the present, ascending.
        paths: (K, T, 2) centres of its box, x forward, y left, metres in the present ego frame.
        probabilities: (K,) probabilities of the modes; they are not normalised.
    """

    actor_id: int
    times: FloatArray
    paths: FloatArray
    probabilities: FloatArray

    def __post_init__(self) -> None:
        """Check and freeze; raises GeometryError."""
        times = ascending_times(self.times)
        probabilities = checked("probabilities", self.probabilities, (None,)).copy()
        paths = checked("paths", self.paths, (len(probabilities), len(times), 2)).copy()
        if not len(paths) or not np.isfinite(paths).all():
            raise GeometryError(
                "paths: expected one mode or more of finite numbers; leave out what is not "
                "predicted"
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

    def at(self, steps: FloatArray, present: FloatArray) -> FloatArray:
        """Return the positions at S seconds after the present, linear between the modes' times.

        Until its first time the actor goes straight on from its present position.

        Args:
            steps: Seconds after the present, shape (S,).
            present: Position at the present, shape (2,).

        Returns:
            Positions, shape (K, S, 2); NaN after the last time.
        """
        times = self.times
        paths = self.paths
        if times[0] > 0:
            start = np.broadcast_to(present, (len(paths), 1, 2))
            times = np.append(0.0, times)
            paths = np.concatenate([start, paths], axis=1)
        if len(times) == 1:
            return np.full((len(paths), len(steps), 2), np.nan)
        after = times.searchsorted(steps - SAME_TIME).clip(1, len(times) - 1)
        before = after - 1
        share = ((steps - times[before]) / (times[after] - times[before]))[:, None]
        positions = paths[:, before] * (1 - share) + paths[:, after] * share
        is_covered = (steps <= times[-1] + SAME_TIME)[:, None]
        return np.where(is_covered, positions, np.nan)


def displacement_errors(
    paths: FloatArray, truth: FloatArray, valid: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Return the average and the final displacement error (ADE, FDE) of each mode, metres.

    They are defined like `compute_ade` and `compute_fde` of av2 (`argoverse/av2-api`), with
    the mean of the ADE over the valid steps only.

    >>> import numpy as np
    >>> truth = np.array([[[1.0, 0.0], [2.0, 0.0]]])
    >>> paths = truth[:, None] + [0.0, 3.0]
    >>> displacement_errors(paths, truth, valid=np.array([[True, True]]))
    (array([[3.]]), array([[3.]]))

    Args:
        paths: Predicted positions of N actors in K modes, (N, K, T, 2) metres; NaN where there is
            none.
        truth: Recorded positions at the same times, (N, T, 2) metres.
        valid: Whether the truth is recorded, (N, T); it is not read elsewhere.

    Returns:
        ADE, the mean distance over the valid steps, (N, K); and FDE, the distance at the last step,
        (N, K). NaN where there is no such step, or the path ends before the last one.
    """
    errors = distances(paths, truth[:, None])
    errors = np.where(valid[:, None], errors, 0.0)
    steps = valid.sum(axis=1)[:, None]
    reaches_end = np.isfinite(paths[..., -1, :]).all(axis=-1)
    means = errors.sum(axis=-1) / np.maximum(steps, 1)
    ade = np.where((steps > 0) & reaches_end, means, np.nan)
    fde = np.where(valid[:, -1:], errors[..., -1], np.nan)
    return ade, fde


def misses(final_errors: FloatArray, miss_distance: float = MISS_DISTANCE) -> FloatArray:
    """Return 1 where a final error is a miss, 0 where it is not, NaN where it is NaN.

    Args:
        final_errors: Displacement errors at the last step, metres, of any shape.
        miss_distance: Metres; a larger error is a miss.
    """
    is_missed = final_errors > miss_distance
    return np.where(np.isnan(final_errors), np.nan, is_missed)


def miss_rate(final_errors: FloatArray, miss_distance: float = MISS_DISTANCE) -> float:
    """Return the share of final errors that are misses, as `compute_is_missed_prediction` of av2.

    >>> import numpy as np
    >>> miss_rate(np.array([0.5, 1.0, 2.5, np.nan]), miss_distance=2.0) == 1 / 3
    True

    Args:
        final_errors: (N,) displacement errors at the last step, metres; NaN does not count.
        miss_distance: Metres; a larger error is a miss.

    Returns:
        A share in [0, 1]; NaN if there is nothing to count.
    """
    is_missed = misses(final_errors, miss_distance)
    is_missed = is_missed[~np.isnan(is_missed)]
    return float(is_missed.mean()) if len(is_missed) else np.nan


def brier(errors: FloatArray, probabilities: FloatArray) -> FloatArray:
    """Return errors in metres plus (1 − probability)², as in av2."""
    return errors + (1 - probabilities) ** 2


def actor_errors(
    paths: FloatArray,
    truth: FloatArray,
    valid: BoolArray,
    probabilities: FloatArray,
    mode_count: int,
    miss_distance: float = MISS_DISTANCE,
) -> dict[str, FloatArray]:
    """Return the errors of each actor's best mode.

    The best mode has the least FDE among the `mode_count` most probable ones; the first of equal
    modes counts.

    Args:
        paths: Paths as in `displacement_errors`; so are `truth` and `valid`.
        truth: Recorded paths.
        valid: Where the paths are recorded.
        probabilities: (N, K) probabilities of the modes, not normalised; NaN for missing modes.
        mode_count: Number of modes that count.
        miss_distance: Metres; a larger FDE is a miss.

    Returns:
        Arrays (N,), NaN for none: `min_fde`, `miss` (1 or 0) and `brier_min_fde` need the last
        step, `min_ade` (of the best mode) and `min_ade_any` (the least of any mode) the complete
        future, `cut_ade` (the least of any mode) any step. All need a path up to the last step.
    """
    ade, fde = displacement_errors(paths, truth, valid)
    most_probable = np.argsort(-probabilities, axis=1, kind="stable")[:, :mode_count]
    ade = np.take_along_axis(ade, most_probable, 1)
    fde = np.take_along_axis(fde, most_probable, 1)
    probabilities = np.take_along_axis(probabilities, most_probable, 1)
    best = np.argmin(np.where(np.isnan(fde), np.inf, fde), axis=1)[:, None]
    min_ade = np.take_along_axis(ade, best, 1)[:, 0]
    min_fde = np.take_along_axis(fde, best, 1)[:, 0]
    probability = np.take_along_axis(probabilities, best, 1)[:, 0]
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
    """Return the joint errors of N actors; the modes of one number are one world.

    Args:
        paths: (N, K, T, 2) metres, at least one actor.
        truth: (N, T, 2) metres, all recorded.

    Returns:
        Means over the actors of ADE and of FDE, (K,) metres each, and the FDE of each actor, (N,
        K).
    """
    valid = np.ones(truth.shape[:2], dtype=bool)
    ade, fde = displacement_errors(paths, truth, valid)
    return ade.mean(axis=0), fde.mean(axis=0), fde


def collisions(paths: FloatArray, distance: float = COLLISION_DISTANCE) -> BoolArray:
    """Return whether each actor comes too near to another one in each mode, shape (N, K).

    Args:
        paths: (N, K, T, 2) metres.
        distance: Metres; two centres that are nearer at one step collide.
    """
    apart = distances(paths[:, None], paths)
    actors = np.arange(len(paths))
    apart[actors, actors] = np.inf
    return np.asarray((apart < distance).any(axis=(1, 3)))
