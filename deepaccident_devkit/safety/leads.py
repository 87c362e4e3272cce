"""Lead times of sets of agents and Shapley values of their partners, over arrays.

An ego and n partners observe two colliders. A coalition is the ego with some of the partners: of coalition number k,
partner i is one if bit i of k is set, so that number 0 is the ego alone and the last one is all of them.
"""

from __future__ import annotations

from math import factorial

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.arrays import BoolArray, FloatArray, IntArray, as_numbers
from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.taxonomy import FRAME_PERIOD

_PAIR = 2


def coalition_members(partners: int) -> BoolArray:
    """Which partners are in each coalition: (2^n, n)."""
    members: BoolArray = (np.arange(1 << partners)[:, None] >> np.arange(partners) & 1).astype(bool)
    return members


def first_together(observed: ArrayLike) -> IntArray:
    """The first frame at which the union over a coalition observes both colliders.

    Args:
        observed: (…, 1 + n, 2, F) bool: whether the ego (first) and each partner observe each collider at each frame.
            Recordings of several lengths can be one array if they end together, with False before their beginnings.

    Returns:
        (…, 2^n) position of the frame, from 0; −1 for a coalition that never does.

    Raises:
        GeometryError: `observed` has another shape.
    """
    seen = as_numbers("observed", observed, "truth values (…, agents, 2, frames)", np.bool_)
    if seen.ndim < 3 or seen.shape[-2] != _PAIR or not seen.shape[-3]:
        raise GeometryError(f"observed: expected shape (…, agents, 2, frames), found {seen.shape}")
    coalitions = coalition_members(seen.shape[-3] - 1)
    both = np.zeros((*seen.shape[:-3], len(coalitions), seen.shape[-1]), dtype=bool)
    for number, members in enumerate(coalitions):
        union = np.asarray(seen[..., np.concatenate([[True], members]), :, :].any(axis=-3))
        both[..., number, :] = union[..., 0, :] & union[..., 1, :]
    first: IntArray = np.where(both.any(axis=-1), both.argmax(axis=-1) if both.shape[-1] else 0, -1)
    return first


def coalition_leads(observed: ArrayLike) -> FloatArray:
    """Seconds from the first frame at which a coalition observes both colliders to the last frame, the impact.

    Args:
        observed: (…, 1 + n, 2, F) bool, as of `first_together`.

    Returns:
        (…, 2^n) seconds; 0 for a coalition that never does.

    Raises:
        GeometryError: `observed` has another shape.
    """
    return leads_from(first_together(observed), np.shape(observed)[-1])


def leads_from(first: IntArray, frames: int) -> FloatArray:
    """Seconds from the frames that `first_together` gives (…) to the last one of so many; 0 where it gives −1."""
    leads: FloatArray = np.where(first < 0, 0, frames - 1 - first) * FRAME_PERIOD
    return leads


def shapley_values(leads: ArrayLike) -> FloatArray:
    """Each partner's exact Shapley value of the gain in lead time over the ego alone.

    That is how much a partner adds to those who joined before it, as a mean over all orders of joining. The values
    add up to the gain of all partners together.

    Args:
        leads: (…, 2^n) of each coalition, as `coalition_leads` gives them.

    Returns:
        (…, n) in the unit of `leads`.

    Raises:
        GeometryError: the number of coalitions is no power of two.
    """
    values = as_numbers("leads", leads)
    count = values.shape[-1] if values.ndim else 0
    partners = count.bit_length() - 1
    if count != 1 << max(partners, 0):
        raise GeometryError(f"leads: expected one for each of 2^n coalitions, found shape {values.shape}")
    members = coalition_members(partners)
    sizes = members.sum(axis=1)
    weights = np.array(
        [factorial(size) * factorial(partners - size - 1) / factorial(partners) for size in range(partners)]
    )
    result = np.zeros((*values.shape[:-1], partners))
    for partner in range(partners):
        without = np.flatnonzero(~members[:, partner])
        gains = values[..., without + (1 << partner)] - values[..., without]
        result[..., partner] = gains @ weights[sizes[without]]
    return result
