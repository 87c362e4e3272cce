"""Outcomes of an accident if one collider or both brake after a warning."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.collisions.contact import Pair, contact_times, impacts, pair_of
from deepaccident_devkit.collisions.recorded import MASS_UNCERTAINTY, Accident
from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.support.arrays import (
    BoolArray,
    FloatArray,
    FrozenArrays,
    IntArray,
    checked,
)

OUTCOMES: Final = ("avoided", "stopped", "mitigated", "unchanged", "worsened")
"""Possible outcomes of an accident; their positions are the codes of `Outcomes.outcome`."""
MOST_MARGIN: Final = 1.0
"""Largest gap at the last frame with which a recording shows its accident, metres.

Recordings with a larger gap are left out, and listed by name.
"""
STOPPED_SPEED: Final = 0.5
"""Speed below which a braking actor that is hit counts as stopped, m/s."""
# Delta-v is less or more by at least this share in a mitigated or worsened accident.
_MIN_DELTA_V_CHANGE: Final = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class Braking:
    """Reaction and deceleration of a warned driver; raises ConfigError.

    Attributes:
        reaction: Time from the warning to the braking, seconds, 0 or more.
        deceleration: Deceleration, m/s², above 0.
    """

    reaction: float
    deceleration: float

    def __post_init__(self) -> None:
        """Raise ConfigError unless both numbers are finite and in range."""
        if not (0 <= self.reaction < np.inf and 0 < self.deceleration < np.inf):
            raise ConfigError(
                "Braking: expected a reaction of 0 s or more and a deceleration above 0 m/s², "
                f"found {self.reaction} s and {self.deceleration} m/s²"
            )


BRAKINGS: Final = tuple(
    Braking(reaction=reaction, deceleration=deceleration)
    for reaction, deceleration in product((0.5, 1.0, 1.5), (4.0, 6.0, 8.0))
)
"""The nine ways to brake that are always shown together: three reactions, each with three
decelerations.
"""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ReplayCheck(FrozenArrays):
    """The replay in which nobody brakes: it must collide by the end of the recording.

    Attributes:
        margin: Gap between the outlines that counts as contact, metres: the gap at the last frame,
            and 1e-9 m more.
        collides: Whether the two actors touch by the end of the recording.
        time: Time from the first frame to the contact, seconds; inf without contact.
        speeds: Speeds at the contact, shape (2,), m/s; NaN without contact. Read-only.
        delta_v: Changes of speed by the impact, shape (2,), m/s, with assumed masses; NaN without
            contact. Read-only.
    """

    margin: float
    collides: bool
    time: float
    speeds: FloatArray
    delta_v: FloatArray

    @property
    def usable(self) -> bool:
        """Whether the recording shows its collision, with a margin of at most `MOST_MARGIN`."""
        return self.collides and self.margin <= MOST_MARGIN


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Outcomes(FrozenArrays):
    """Outcomes of an accident for W warnings and K ways to brake; arrays are read-only.

    The class is decided by delta-v. The delta-v of either actor gives the same class: as the masses
    stay the same, both change by the same share.

    Attributes:
        outcome: Positions in `OUTCOMES`, shape (W, K), int64.
        extrapolated: Whether the actors touch only after the end of the recording, where they go
            straight on, shape (W, K). If the replay ended there, the accident would count as
            avoided.
        time: Times from the first frame to the contact, shape (W, K), seconds; inf if avoided.
        speeds: Speeds of the two actors at the contact, shape (W, K, 2), m/s; NaN if avoided.
        delta_v: Changes of their speeds by the impact, shape (W, K, 2), m/s, with assumed masses; 0
            if avoided.
        reduction: Share by which delta-v is less than without braking, shape (W, K): 1 if avoided,
            negative if it is more.
    """

    outcome: IntArray
    extrapolated: BoolArray
    time: FloatArray
    speeds: FloatArray
    delta_v: FloatArray
    reduction: FloatArray


def delta_v_of(masses: ArrayLike, relative_speeds: ArrayLike) -> FloatArray:
    """Return the changes of both speeds by a plastic, central impact, shape (…, 2), m/s.

    Args:
        masses: Masses of the two actors, shape (2,), kilograms.
        relative_speeds: Relative speeds at the impact, shape (…), m/s.
    """
    mass_pair = checked("masses", masses, (2,))
    shares = mass_pair[::-1] / mass_pair.sum()
    return np.asarray(np.asarray(relative_speeds)[..., None] * shares)


def delta_v_ranges(masses: ArrayLike, relative_speeds: ArrayLike) -> FloatArray:
    """Return the minimum and maximum of `delta_v_of`, shape (…, 2, 2).

    Both masses may be wrong by up to `MASS_UNCERTAINTY`.
    """
    mass_pair = checked("masses", masses, (2,))
    bounds = []
    for sign in (1, -1):  # a heavier actor changes its speed less
        factors = [1 + sign * MASS_UNCERTAINTY, 1 - sign * MASS_UNCERTAINTY]
        first_delta_v = delta_v_of(mass_pair * factors, relative_speeds)[..., 0]
        second_delta_v = delta_v_of(mass_pair * factors[::-1], relative_speeds)[..., 1]
        bounds.append(np.stack([first_delta_v, second_delta_v], axis=-1))
    return np.stack(bounds, axis=-1)


def undisturbed(accident: Accident) -> ReplayCheck:
    """Return the check of a recording: the replay in which nobody brakes."""
    pair = pair_of(accident.paths, accident.sizes)
    starts = np.full((1, 2), np.inf)
    decelerations = np.ones(1)
    times = contact_times(pair, starts, decelerations)
    impact = impacts(pair, starts, decelerations, times)
    return ReplayCheck(
        margin=pair.margin,
        collides=bool(times[0] <= pair.duration),
        time=float(times[0]),
        speeds=impact.speeds[0],
        delta_v=delta_v_of(accident.masses, impact.relative_speeds[0]),
    )


def outcomes_of(
    accident: Accident,
    brakers: tuple[bool, bool],
    warning_times: ArrayLike,
    *,
    brakings: Sequence[Braking] = BRAKINGS,
    latency: float = 0.0,
) -> Outcomes:
    """Return the outcomes of an accident if colliders are warned at given times.

    - Avoided: the two do not touch until 3 s after the recording.
    - Worsened: they touch, and delta-v is larger by at least a tenth, as for a leader that stops in
      front of a striker.
    - Stopped: not worsened, and the braking actors are slower than 0.5 m/s at the contact, but were
      not in the recording.
    - Mitigated: delta-v is smaller by at least a tenth.
    - Unchanged: all other outcomes, and always if no braking begins before the recording ends.

    Args:
        accident: Recorded motion of the two actors.
        brakers: Whether each of the two actors brakes.
        warning_times: Times of W warnings from the first frame, shape (W,), seconds; NaN for no
            warning. A braking that would begin before the first frame begins there.
        brakings: The K ways to brake.
        latency: Time that a warning takes to reach the drivers, seconds.

    Raises:
        GeometryError: The warning times have another shape.
    """
    pair = pair_of(accident.paths, accident.sizes)
    arrival_times = checked("warning_times", warning_times, (None,)) + latency
    starts, decelerations = _braking_starts(pair, arrival_times, brakings)
    distinct, rows = _distinct_brakings(starts, decelerations)
    actor_starts = np.where(brakers, distinct[:, :1], np.inf)
    times = contact_times(pair, actor_starts, distinct[:, 1])
    impact = impacts(pair, actor_starts, distinct[:, 1], times)
    delta_v = np.nan_to_num(delta_v_of(accident.masses, impact.relative_speeds))
    reduction = reductions_of(delta_v[:, 0])
    outcome = _outcome_codes(impact.speeds[:, brakers], times, reduction)
    extrapolated = np.isfinite(times) & (times > pair.duration)
    return Outcomes(
        outcome=outcome[rows],
        extrapolated=extrapolated[rows],
        time=times[rows],
        speeds=impact.speeds[rows],
        delta_v=delta_v[rows],
        reduction=reduction[rows],
    )


def _braking_starts(
    pair: Pair, warning_times: FloatArray, brakings: Sequence[Braking]
) -> tuple[FloatArray, FloatArray]:
    """Return when the braking begins and how hard it is.

    Returns:
        Times at which the braking begins, shape (W, K), seconds, inf if it does not begin before
        the recording ends; and decelerations, shape (W, K), m/s².
    """
    reactions = np.array([braking.reaction for braking in brakings])
    starts = np.round(warning_times[:, None] + reactions, 9)  # equal sums of tenths are one replay
    starts = np.where(starts < pair.duration, np.maximum(starts, 0.0), np.inf)
    decelerations = [braking.deceleration for braking in brakings]
    return starts, np.broadcast_to(decelerations, starts.shape)


def _distinct_brakings(
    starts: FloatArray, decelerations: FloatArray
) -> tuple[FloatArray, IntArray]:
    """Return the distinct ways of braking.

    Returns:
        Distinct pairs of start and deceleration, shape (N, 2), without braking in the last row; and
        the row of each braking among them, shape (W, K).
    """
    decelerations = np.where(np.isinf(starts), 1.0, decelerations)
    brakings = np.stack([starts.ravel(), decelerations.ravel()], axis=1)
    with_unbraked = np.concatenate([brakings, [[np.inf, 1.0]]])
    distinct, rows = np.unique(with_unbraked, axis=0, return_inverse=True)
    return distinct, rows.ravel()[:-1].reshape(starts.shape)


def reductions_of(delta_v: FloatArray) -> FloatArray:
    """Return the shares of delta-v that are saved, shape (N,).

    Args:
        delta_v: Changes of speed, shape (N,), m/s; the last one without braking. If that is 0, the
            reduction of any larger one is −inf.
    """
    unbraked = delta_v[-1]
    if unbraked > 0:
        return np.asarray(1 - delta_v / unbraked)
    return np.where(delta_v > 0, -np.inf, 0.0)


def _outcome_codes(speeds: FloatArray, times: FloatArray, reduction: FloatArray) -> IntArray:
    """Return the codes of outcomes, shape (N,); the last row is without braking.

    Args:
        speeds: Speeds of the B braking actors at the contact, shape (N, B), m/s.
        times: Times of the contact, shape (N,), seconds; inf without contact.
        reduction: Shares of delta-v that are saved, shape (N,).
    """
    moving_unbraked = (speeds[-1] >= STOPPED_SPEED).any()
    stopped = (speeds < STOPPED_SPEED).all(axis=1) & moving_unbraked
    avoided = np.isinf(times)
    worsened = reduction <= -_MIN_DELTA_V_CHANGE
    mitigated = reduction >= _MIN_DELTA_V_CHANGE
    codes = [OUTCOMES.index(name) for name in ("avoided", "worsened", "stopped", "mitigated")]
    return np.select([avoided, worsened, stopped, mitigated], codes, OUTCOMES.index("unchanged"))
