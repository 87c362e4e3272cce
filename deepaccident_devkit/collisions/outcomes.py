"""Outcomes of an accident if one or both of the colliding actors brake after a warning."""

from collections.abc import Sequence
from dataclasses import dataclass
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
MAX_END_GAP_M: Final = 1.0
"""Largest gap in the last frame of a recording that shows its accident, metres.

Recordings with a larger gap are left out, and listed by name.
"""
STOPPED_SPEED: Final = 0.5
"""Speed below which a braking actor that is hit counts as stopped, m/s."""
# Smallest share by which delta-v is less in a mitigated accident, or more in a worsened one.
_MIN_DELTA_V_CHANGE = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class Braking:
    """Reaction time and deceleration of a warned driver; ConfigError if one is out of range.

    Attributes:
        reaction: Time from the warning to the braking, seconds, 0 or more.
        deceleration: Deceleration, m/s², above 0.
    """

    reaction: float
    deceleration: float

    def __post_init__(self) -> None:
        """Raise ConfigError unless both numbers are finite and in range."""
        is_valid = 0 <= self.reaction < np.inf and 0 < self.deceleration < np.inf
        if not is_valid:
            raise ConfigError(
                "Braking: expected a reaction time of 0 s or more and a deceleration above 0 "
                f"m/s², found {self.reaction} s and {self.deceleration} m/s²"
            )


BRAKINGS: Final = tuple(
    Braking(reaction=reaction, deceleration=deceleration)
    for reaction in (0.5, 1.0, 1.5)
    for deceleration in (4.0, 6.0, 8.0)
)
"""The nine braking settings that are always shown together.

They combine three reaction times with three decelerations.
"""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ReplayCheck(FrozenArrays):
    """Result of the replay in which neither actor brakes; it must collide within the recording.

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
        """Whether the recording shows its collision, with a margin of at most `MAX_END_GAP_M`."""
        return self.collides and self.margin <= MAX_END_GAP_M


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Outcomes(FrozenArrays):
    """Outcomes of an accident for W warnings and K ways to brake; arrays are read-only.

    Delta-v decides the outcome. The delta-v of either actor gives the same outcome: as the masses
    are constant, both change by the same fraction.

    Attributes:
        outcome: Positions in `OUTCOMES`, shape (W, K), int64.
        extrapolated: Whether the actors touch only after the end of the recording, when they go
            straight on, shape (W, K). If the replay ended with the recording, the accident would
            count as avoided.
        time: Times from the first frame to the contact, shape (W, K), seconds; inf if avoided.
        speeds: Speeds of the two actors at the contact, shape (W, K, 2), m/s; NaN if avoided.
        delta_v: Changes of their speeds by the impact, shape (W, K, 2), m/s, with assumed masses; 0
            if avoided.
        reduction: Fraction by which delta-v is smaller than without braking, shape (W, K): 1 if
            avoided, negative if delta-v is larger.
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
    delta_v: FloatArray = np.asarray(relative_speeds)[..., None] * shares
    return delta_v


def delta_v_ranges(masses: ArrayLike, relative_speeds: ArrayLike) -> FloatArray:
    """Return the minimum and maximum of `delta_v_of`, shape (…, 2, 2).

    Both masses may be wrong by up to `MASS_UNCERTAINTY`.
    """
    mass_pair = checked("masses", masses, (2,))
    factors = np.array([1 + MASS_UNCERTAINTY, 1 - MASS_UNCERTAINTY])
    first_heavier = delta_v_of(mass_pair * factors, relative_speeds)
    second_heavier = delta_v_of(mass_pair * factors[::-1], relative_speeds)
    # A heavier actor changes its speed less.
    first_range = np.stack([first_heavier[..., 0], second_heavier[..., 0]], axis=-1)
    second_range = np.stack([second_heavier[..., 1], first_heavier[..., 1]], axis=-1)
    return np.stack([first_range, second_range], axis=-2)


def undisturbed(accident: Accident) -> ReplayCheck:
    """Return whether and how a recorded accident collides in a replay without braking."""
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
    """Return the outcomes of an accident if the colliding actors are warned at certain times.

    - Avoided: the two actors do not touch until 3 s after the recording.
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
        GeometryError: The warning times have a wrong shape.
    """
    pair = pair_of(accident.paths, accident.sizes)
    arrival_times = checked("warning_times", warning_times, (None,)) + latency
    starts, decelerations = _find_braking_starts(pair, arrival_times, brakings)
    distinct, rows = _find_distinct_brakings(starts, decelerations)
    actor_starts = np.where(brakers, distinct[:, :1], np.inf)
    distinct_decelerations = distinct[:, 1]
    times = contact_times(pair, actor_starts, distinct_decelerations)
    impact = impacts(pair, actor_starts, distinct_decelerations, times)
    delta_v = np.nan_to_num(delta_v_of(accident.masses, impact.relative_speeds))
    reduction = reductions_of(delta_v[:, 0])
    outcome = _classify_outcomes(impact.speeds[:, brakers], times, reduction)
    extrapolated = np.isfinite(times) & (times > pair.duration)
    return Outcomes(
        outcome=outcome[rows],
        extrapolated=extrapolated[rows],
        time=times[rows],
        speeds=impact.speeds[rows],
        delta_v=delta_v[rows],
        reduction=reduction[rows],
    )


def _find_braking_starts(
    pair: Pair, warning_times: FloatArray, brakings: Sequence[Braking]
) -> tuple[FloatArray, FloatArray]:
    """Return the start and the deceleration of the braking after each warning.

    Returns:
        Start times of the braking, shape (W, K), seconds; inf if it does not begin before
        the recording ends; and decelerations, shape (W, K), m/s².
    """
    reactions = np.array([braking.reaction for braking in brakings])
    starts = np.round(warning_times[:, None] + reactions, 9)  # equal sums of tenths are one replay
    is_in_recording = starts < pair.duration
    starts = np.where(is_in_recording, np.maximum(starts, 0.0), np.inf)
    decelerations = [braking.deceleration for braking in brakings]
    return starts, np.broadcast_to(decelerations, starts.shape)


def _find_distinct_brakings(
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
    braking_rows = rows.ravel()[:-1]
    return distinct, braking_rows.reshape(starts.shape)


def reductions_of(delta_v: FloatArray) -> FloatArray:
    """Return the fractions by which delta-v is smaller than without braking, shape (N,).

    Args:
        delta_v: Changes of speed, shape (N,), m/s; the last one without braking. If that one is 0,
            the reduction of any larger one is −inf.
    """
    unbraked = delta_v[-1]
    if unbraked > 0:
        reductions: FloatArray = 1 - delta_v / unbraked
        return reductions
    return np.where(delta_v > 0, -np.inf, 0.0)


def _classify_outcomes(speeds: FloatArray, times: FloatArray, reduction: FloatArray) -> IntArray:
    """Return the codes of outcomes, shape (N,); the last row is without braking.

    Args:
        speeds: Speeds of the B braking actors at the contact, shape (N, B), m/s.
        times: Times of the contact, shape (N,), seconds; inf without contact.
        reduction: Fractions by which delta-v is smaller than without braking, shape (N,).
    """
    moves_unbraked = (speeds[-1] >= STOPPED_SPEED).any()
    stopped = (speeds < STOPPED_SPEED).all(axis=1) & moves_unbraked
    avoided = np.isinf(times)
    worsened = reduction <= -_MIN_DELTA_V_CHANGE
    mitigated = reduction >= _MIN_DELTA_V_CHANGE
    codes = [OUTCOMES.index(name) for name in ("avoided", "worsened", "stopped", "mitigated")]
    unchanged_code = OUTCOMES.index("unchanged")
    return np.select([avoided, worsened, stopped, mitigated], codes, unchanged_code)
