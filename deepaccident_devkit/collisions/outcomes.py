"""What becomes of an accident if a collider, or both, brake after a warning."""

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
"""What can become of an accident; their positions are the codes of `Outcomes.outcome`."""
MOST_MARGIN: Final = 1.0
"""Metres; a recording with a larger gap at its last frame does not show its accident, and is left out by name."""
STOPPED_SPEED: Final = 0.5
"""m/s below which a braking actor that is hit counts as stopped."""
# Share by which delta-v is less or more in a mitigated or worsened accident.
_CHANGE: Final = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class Braking:
    """How a warned driver brakes; raises ConfigError.

    Attributes:
        reaction: seconds from the warning to the braking, 0 or more.
        deceleration: m/s², above 0.
    """

    reaction: float
    deceleration: float

    def __post_init__(self) -> None:
        """Check the numbers."""
        if not (0 <= self.reaction < np.inf and 0 < self.deceleration < np.inf):
            raise ConfigError(
                "Braking: expected a reaction of 0 s or more and a deceleration above 0 m/s², "
                f"found {self.reaction} s and {self.deceleration} m/s²"
            )


BRAKINGS: Final = tuple(
    Braking(reaction=reaction, deceleration=deceleration)
    for reaction, deceleration in product((0.5, 1.0, 1.5), (4.0, 6.0, 8.0))
)
"""The nine that are always shown together: three reactions, and for each three decelerations."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ReplayCheck(FrozenArrays):
    """The replay in which nobody brakes: it must collide by the end of the recording.

    Attributes:
        margin: metres between the outlines that count as contact: the gap at the last frame, and 1e-9 m more.
        collides: whether they touch by the end of the recording.
        time: seconds from the first frame to the contact; inf for none.
        speeds: (2,) m/s at the contact; NaN without one. Read-only.
        delta_v: (2,) changes of speed by the impact, m/s, with assumed masses; NaN without a contact. Read-only.
    """

    margin: float
    collides: bool
    time: float
    speeds: FloatArray
    delta_v: FloatArray

    @property
    def usable(self) -> bool:
        """Whether the recording shows its accident: they collide, with a margin of at most `MOST_MARGIN`."""
        return self.collides and self.margin <= MOST_MARGIN


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Outcomes(FrozenArrays):
    """What W warnings make of an accident with K ways to brake; arrays are read-only.

    The class is decided by delta-v. It makes no difference whose: as the masses stay the same, the delta-v of both
    change by the same share.

    Attributes:
        outcome: (W, K) int64 positions in `OUTCOMES`.
        extrapolated: (W, K) whether they touch only after the end of the recording, where they go straight on: if the
            replay ended there, the accident would count as avoided.
        time: (W, K) seconds from the first frame to the contact; inf if avoided.
        speeds: (W, K, 2) of the two at the contact, m/s; NaN if avoided.
        delta_v: (W, K, 2) changes of their speeds by the impact, m/s, with assumed masses; 0 if avoided.
        reduction: (W, K) share by which delta-v is less than if nobody brakes: 1 if avoided, negative if it is more.
    """

    outcome: IntArray
    extrapolated: BoolArray
    time: FloatArray
    speeds: FloatArray
    delta_v: FloatArray
    reduction: FloatArray


def delta_v_of(masses: ArrayLike, relative_speeds: ArrayLike) -> FloatArray:
    """(…, 2) changes of both speeds by a plastic, central impact, by masses (2,) kg and relative speeds (…), m/s."""
    both = checked("masses", masses, (2,))
    return np.asarray(np.asarray(relative_speeds)[..., None] * (both[::-1] / both.sum()))


def delta_v_ranges(masses: ArrayLike, relative_speeds: ArrayLike) -> FloatArray:
    """(…, 2, 2) the least and the most of `delta_v_of` for masses that are wrong by up to `MASS_UNCERTAINTY` each."""
    both = checked("masses", masses, (2,))
    ends = []
    for sign in (1, -1):  # a heavier actor changes its speed less
        first = delta_v_of(
            both * [1 + sign * MASS_UNCERTAINTY, 1 - sign * MASS_UNCERTAINTY], relative_speeds
        )
        second = delta_v_of(
            both * [1 - sign * MASS_UNCERTAINTY, 1 + sign * MASS_UNCERTAINTY], relative_speeds
        )
        ends.append(np.stack([first[..., 0], second[..., 1]], axis=-1))
    return np.stack(ends, axis=-1)


def undisturbed(accident: Accident) -> ReplayCheck:
    """The check of a recording: the replay in which nobody brakes."""
    pair = pair_of(accident.paths, accident.sizes)
    starts, hard = np.full((1, 2), np.inf), np.ones(1)
    time = contact_times(pair, starts, hard)
    impact = impacts(pair, starts, hard, time)
    return ReplayCheck(
        margin=pair.margin,
        collides=bool(time[0] <= pair.duration),
        time=float(time[0]),
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
    """What becomes of an accident if colliders are warned at some times.

    Avoided: they do not touch until 3 s after the recording. Worsened: they do, and delta-v is more by a tenth at
    least, as for a leader who stops in front of a striker. Stopped: it is not, and the speed of those who brake is
    below 0.5 m/s at the contact, and was not in the recording's. Mitigated: delta-v is less by a tenth at least.
    Unchanged: the rest, and always if no braking begins before the recording ends.

    Args:
        accident: the recorded motion.
        brakers: which of the two brake.
        warning_times: (W,) seconds from the first frame; NaN for no warning. A braking that would begin before the
            first frame begins there.
        brakings: the K ways to brake.
        latency: seconds that a warning takes to reach them.

    Raises:
        GeometryError: the warning times have another shape.
    """
    pair = pair_of(accident.paths, accident.sizes)
    starts, hard = _brakings_begun(
        pair, checked("warning_times", warning_times, (None,)) + latency, brakings
    )
    distinct, places = _distinct(starts, hard)
    begun = np.where(brakers, distinct[:, :1], np.inf)
    times = contact_times(pair, begun, distinct[:, 1])
    impact = impacts(pair, begun, distinct[:, 1], times)
    delta_v = np.nan_to_num(delta_v_of(accident.masses, impact.relative_speeds))
    reduction = reductions_of(delta_v[:, 0])
    outcome = _classes(impact.speeds[:, brakers], times, reduction)
    return Outcomes(
        outcome=outcome[places],
        extrapolated=(np.isfinite(times) & (times > pair.duration))[places],
        time=times[places],
        speeds=impact.speeds[places],
        delta_v=delta_v[places],
        reduction=reduction[places],
    )


def _brakings_begun(
    pair: Pair, warning_times: FloatArray, brakings: Sequence[Braking]
) -> tuple[FloatArray, FloatArray]:
    """(W, K) seconds at which the braking begins, inf for none before the recording ends; (W, K) decelerations."""
    reactions = np.array([each.reaction for each in brakings])
    starts = np.round(warning_times[:, None] + reactions, 9)  # equal sums of tenths are one replay
    starts = np.where(starts < pair.duration, np.maximum(starts, 0.0), np.inf)
    return starts, np.broadcast_to([each.deceleration for each in brakings], starts.shape)


def _distinct(starts: FloatArray, decelerations: FloatArray) -> tuple[FloatArray, IntArray]:
    """(N, 2) different starts and decelerations, the last one without braking; where those of W × K are among them."""
    hard = np.where(np.isinf(starts), 1.0, decelerations)
    asked = np.stack([starts.ravel(), hard.ravel()], axis=1)
    distinct, places = np.unique(
        np.concatenate([asked, [[np.inf, 1.0]]]), axis=0, return_inverse=True
    )
    return distinct, places.ravel()[:-1].reshape(starts.shape)


def reductions_of(delta_v: FloatArray) -> FloatArray:
    """(N,) shares that are saved of the last one, which is without braking; −inf if that is 0 and another is not."""
    if delta_v[-1] > 0:
        return np.asarray(1 - delta_v / delta_v[-1])
    return np.where(delta_v > 0, -np.inf, 0.0)


def _classes(speeds: FloatArray, times: FloatArray, reduction: FloatArray) -> IntArray:
    """(N,) codes of outcomes; `speeds` (N, B) are of those who brake. The last one is without braking."""
    stopped = (speeds < STOPPED_SPEED).all(axis=1) & (speeds[-1] >= STOPPED_SPEED).any()
    chosen = [np.isinf(times), reduction <= -_CHANGE, stopped, reduction >= _CHANGE]
    codes = [OUTCOMES.index(name) for name in ("avoided", "worsened", "stopped", "mitigated")]
    return np.select(chosen, codes, OUTCOMES.index("unchanged"))
