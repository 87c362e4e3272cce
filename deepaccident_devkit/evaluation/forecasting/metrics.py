"""`Forecast`: how an actor may go on; and how far such paths are from the recorded one.

The errors by mode, and those of all actors together (`world_errors`), are the package av2's, which picks no mode. Which
one counts is as `eval_forecasting.py` of `argoverse-api` says: that with the least error at the end.
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
# Seconds by which a moment may miss the step that it is meant for, as sums of float32 do.
SAME_TIME: Final = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Forecast(FrozenArrays):
    """How an actor may go on: K modes; arrays are read-only.

    Attributes:
        actor_id: its CARLA id.
        times: (T,) seconds after the present, ascending.
        paths: (K, T, 2) where its box's centre is, x forward, y left, metres in the present ego frame.
        probabilities: (K,) of the modes; they are not normalised.
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
                "paths: expected one mode or more of finite numbers; leave out what is not predicted"
            )
        if not ((probabilities >= 0) & (probabilities <= 1)).all():
            raise GeometryError(
                f"probabilities: expected numbers from 0 to 1, found {probabilities.tolist()}"
            )
        actor_id = checked_whole("actor id", self.actor_id)
        values = {
            "actor_id": actor_id,
            "times": times,
            "paths": paths,
            "probabilities": probabilities,
        }
        for name, value in values.items():
            object.__setattr__(self, name, value)
        FrozenArrays.__post_init__(self)

    def at(self, steps: FloatArray, present: FloatArray) -> FloatArray:
        """(K, S, 2) where it is at S seconds after the present, linear between its times; NaN after the last of them.

        Before the first of its times it goes straight on from where the actor is at the present, (2,).
        """
        times, paths = self.times, self.paths
        if times[0] > 0:
            start = np.broadcast_to(present, (len(paths), 1, 2))
            times, paths = np.append(0.0, times), np.concatenate([start, paths], axis=1)
        if len(times) == 1:
            return np.full((len(paths), len(steps), 2), np.nan)
        after = times.searchsorted(steps - SAME_TIME).clip(1, len(times) - 1)
        share = ((steps - times[after - 1]) / (times[after] - times[after - 1]))[:, None]
        found = paths[:, after - 1] * (1 - share) + paths[:, after] * share
        return np.where((steps <= times[-1] + SAME_TIME)[:, None], found, np.nan)


def mode_errors(
    paths: FloatArray, truth: FloatArray, valid: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """How far each mode is from the recorded path.

    Args:
        paths: (N, K, T, 2) of N actors, metres; NaN where there is none.
        truth: (N, T, 2) of the same moments.
        valid: (N, T) whether the truth is recorded; it is not read elsewhere.

    Returns:
        (N, K) the mean distance over the valid steps (ADE), and (N, K) the distance at the last step (FDE); NaN where
        there is no such step, or the path ends before the last one.
    """
    apart = np.where(valid[:, None], distances(paths, truth[:, None]), 0.0)
    steps = valid.sum(axis=1)[:, None]
    counts = (steps > 0) & np.isfinite(paths[..., -1, :]).all(axis=-1)
    ade = np.where(counts, apart.sum(axis=-1) / np.maximum(steps, 1), np.nan)
    return ade, np.where(valid[:, -1:], apart[..., -1], np.nan)


def brier(errors: FloatArray, probabilities: FloatArray) -> FloatArray:
    """Errors in metres, to which (1 − probability)² is added."""
    return errors + (1 - probabilities) ** 2


def actor_errors(
    paths: FloatArray,
    truth: FloatArray,
    valid: BoolArray,
    probabilities: FloatArray,
    most: int,
    miss_distance: float = MISS_DISTANCE,
) -> dict[str, FloatArray]:
    """The errors of the best of each actor's modes: of the first `most` by probability that with the least FDE.

    Of equal modes the first counts.

    Args:
        paths: as of `mode_errors`; so are `truth` and `valid`.
        truth: the recorded paths.
        valid: where they are recorded.
        probabilities: (N, K) of the modes, not normalised; NaN of modes that are not there.
        most: how many modes count.
        miss_distance: metres.

    Returns:
        (N,) each, NaN for none: `min_fde`, `miss` (1 or 0) and `brier_min_fde` need the last step, `min_ade` (of the
        best mode) and `min_ade_any` (the least of any mode) the whole future, `cut_ade` (the same) any step. All need
        a path up to the last step.
    """
    first = np.argsort(-probabilities, axis=1, kind="stable")[:, :most]
    ade, fde, chance = (
        np.take_along_axis(each, first, 1)
        for each in (*mode_errors(paths, truth, valid), probabilities)
    )
    best = np.argmin(np.where(np.isnan(fde), np.inf, fde), axis=1)[:, None]
    min_ade, min_fde, probability = (
        np.take_along_axis(each, best, 1)[:, 0] for each in (ade, fde, chance)
    )
    least = np.fmin.reduce(ade, axis=1)
    whole = valid.all(axis=1)
    return {
        "min_ade": np.where(whole, min_ade, np.nan),
        "min_fde": min_fde,
        "miss": np.where(np.isnan(min_fde), np.nan, min_fde > miss_distance),
        "brier_min_fde": brier(min_fde, probability),
        "min_ade_any": np.where(whole, least, np.nan),
        "cut_ade": least,
    }


def world_errors(
    paths: FloatArray, truth: FloatArray, miss_distance: float = MISS_DISTANCE
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """The errors of N actors together, whose modes of one number are one world.

    Args:
        paths: (N, K, T, 2) metres, at least one actor.
        truth: (N, T, 2), all recorded.
        miss_distance: metres.

    Returns:
        (K,) means over the actors of ADE and of FDE, metres, and (N, K) which actors are missed.
    """
    ade, fde = mode_errors(paths, truth, np.ones(truth.shape[:2], dtype=bool))
    return ade.mean(axis=0), fde.mean(axis=0), fde > miss_distance


def collisions(paths: FloatArray, distance: float = COLLISION_DISTANCE) -> BoolArray:
    """(N, K) whether an actor's centre is nearer than a distance (metres) to another's of that mode at one step."""
    apart = distances(paths[:, None], paths)
    apart[np.arange(len(paths)), np.arange(len(paths))] = np.inf
    return np.asarray((apart < distance).any(axis=(1, 3)))
