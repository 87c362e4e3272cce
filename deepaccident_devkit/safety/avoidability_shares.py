"""What warnings change over many accidents: shares of outcomes by the seconds of warning."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from deepaccident_devkit.arrays import FloatArray, FrozenArrays, IntArray, as_floats
from deepaccident_devkit.safety.avoidability import BRAKERS, Avoidability
from deepaccident_devkit.safety.outcomes import OUTCOMES, Braking, Outcomes, delta_v_ranges
from deepaccident_devkit.taxonomy import FRAME_PERIOD

GROUPS: Final = ("vehicles", "head-on", "pedestrians")
"""Kinds of accidents that are counted apart: with a pedestrian, who does not brake as a vehicle does; of vehicles that
meet head-on, where it matters most how the other goes on if one of them brakes; and all others."""
WARNED: Final = (*BRAKERS, "ego")
"""Who is warned and brakes; `ego` alone counts only the accidents of the ego."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OutcomeShares(FrozenArrays):
    """Shares of outcomes over a group of accidents, for L leads of the warning and K ways to brake.

    Accidents whose recording is shorter than a lead do not count at it. Arrays are read-only; NaN where none counts.

    Attributes:
        group: one of `GROUPS`.
        warned: one of `WARNED`.
        brakings: the K ways to brake.
        leads: (L,) seconds from the warning to the end of the recording: 0, 0.1, …
        accidents: (L,) how many count.
        shares: (L, K, 5) of `OUTCOMES`.
        extrapolated: (L, K) share in which they touch only after the end of the recording.
        relative_speed: (L, K) mean over all of these of the speed between the two at the contact, m/s; 0 if avoided.
        delta_v: (L, K, 3) the same of the larger delta-v of the two: with the assumed masses; the least and the most
            with masses that are wrong by up to `MASS_UNCERTAINTY`.
    """

    group: str
    warned: str
    brakings: tuple[Braking, ...]
    leads: FloatArray
    accidents: IntArray
    shares: FloatArray
    extrapolated: FloatArray
    relative_speed: FloatArray
    delta_v: FloatArray


def group_of(accident: Avoidability) -> str:
    """The one of `GROUPS` that an accident is counted in."""
    if accident.pedestrian:
        return "pedestrians"
    return "head-on" if accident.head_on else "vehicles"


def outcomes_if_warned(accident: Avoidability, warned: str) -> Outcomes | None:
    """What warnings of the one of `WARNED` change; None if the ego is to be warned and is not of the pair."""
    if warned != "ego":
        return accident.outcomes[BRAKERS.index(warned)]
    agents = accident.accident.agents
    return accident.outcomes[agents.index("ego_vehicle")] if "ego_vehicle" in agents else None


def outcome_shares(accidents: Sequence[Avoidability]) -> list[OutcomeShares]:
    """The shares of outcomes of each group of accidents and for each who is warned; groups without any are left out.

    Args:
        accidents: computed for the same ways to brake.
    """
    result = []
    for group in GROUPS:
        members = [each for each in accidents if group_of(each) == group]
        for warned in WARNED:
            told = [(each, found) for each in members if (found := outcomes_if_warned(each, warned)) is not None]
            if told:
                result.append(_shares(group, warned, told))
    return result


def _shares(group: str, warned: str, told: Sequence[tuple[Avoidability, Outcomes]]) -> OutcomeShares:
    brakings = told[0][0].brakings
    longest = max(len(outcomes.outcome) for _, outcomes in told)
    sums = np.zeros((longest, len(brakings), len(OUTCOMES) + 5))
    accidents = np.zeros(longest, dtype=np.int64)
    for accident, outcomes in told:
        rows = slice(0, len(outcomes.outcome))
        accidents[rows] += 1
        sums[rows] += _figures(accident, outcomes)
    means = sums / accidents[:, None, None]
    shares, extrapolated, relative, delta_v = np.split(means, np.cumsum([len(OUTCOMES), 1, 1]), axis=2)
    return OutcomeShares(
        group=group,
        warned=warned,
        brakings=brakings,
        leads=as_floats(np.arange(longest) * FRAME_PERIOD),
        accidents=accidents,
        shares=shares,
        extrapolated=extrapolated[..., 0],
        relative_speed=relative[..., 0],
        delta_v=delta_v,
    )


def _figures(accident: Avoidability, outcomes: Outcomes) -> FloatArray:
    """(L, K, 10) of one accident: each outcome 0 or 1, extrapolated 0 or 1, relative speed, delta-v, least, most."""
    relative = outcomes.delta_v.sum(axis=-1)  # the shares of the two add up to 1
    ranges = delta_v_ranges(accident.accident.masses, relative).max(axis=-2)
    classes = outcomes.outcome[..., None] == np.arange(len(OUTCOMES))
    return np.dstack([classes, outcomes.extrapolated, relative, outcomes.delta_v.max(axis=-1), ranges])
