"""The same id for the same instance in all frames: the flow moves instances to the next frame, where they are matched.

The rules are the released ones (docs/released_code.md, Post-processing), FIERY's with another distance.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from deepaccident_devkit.arrays import AnyArray, IntArray
from deepaccident_devkit.motion.postprocessing.grouping import FrameGroups, means, sums_by


def link_frames(groups: Sequence[FrameGroups], distance: float) -> list[IntArray]:
    """Consistent ids of the instances of consecutive frames.

    Instances are paired one to one with those of the frame before, which the flow has moved, so that the sum of the
    distances is smallest. Pairs nearer than `distance` share an id. The others get new ids, counted from the first
    frame's highest id. A frame without instances, and the frame after it, keep their own ids, which do not count as
    given: later instances may get the same ids.

    Args:
        groups: the frames' instances.
        distance: cells; a pair must be nearer.

    Returns:
        Per frame (I + 1,) int64: the consistent id of each of its instances; 0 for 0.
    """
    names = [np.arange(groups[0].instances + 1)]
    newest = groups[0].instances
    for before, after in pairwise(groups):
        if before.instances == 0 or after.instances == 0:
            names.append(np.arange(after.instances + 1))
            continue
        known, expected = _expected(before, names[-1])
        distances = _distances(expected, means(after.position_sum[:, 1:], after.count[1:]))
        linked, newest = _linked(known, distances, distance, newest)
        names.append(linked)
    return names


def _expected(before: FrameGroups, names: IntArray) -> tuple[IntArray, AnyArray]:
    """The ids (N,) of a frame and where the flow takes them (N, 2); instances that share an id are one."""
    known, which = np.unique(names[1:], return_inverse=True)
    sums = np.stack([sums_by(which, along[1:], len(known)) for along in before.moved_sum])
    return known, means(sums, sums_by(which, before.count[1:], len(known)))


def _distances(first: AnyArray, second: AnyArray) -> AnyArray:
    """(N, M) float32 distances between points (N, 2) and (M, 2)."""
    apart = second - first[:, None]
    distances: AnyArray = np.sqrt(apart[..., 0] * apart[..., 0] + apart[..., 1] * apart[..., 1])
    return distances


def _linked(known: IntArray, distances: AnyArray, limit: float, newest: int) -> tuple[IntArray, int]:
    """The next frame's ids (M + 1,), and the highest id given so far."""
    from scipy.optimize import linear_sum_assignment

    before, after = linear_sum_assignment(distances)
    near = distances[before, after] < np.float32(limit)
    matched = (after[near] + 1).tolist()
    names = np.zeros(distances.shape[1] + 1, dtype=np.int64)
    names[matched] = known[before[near]]
    # new ids are given in the order of a Python set, as the released code makes it: not always the ascending one
    rest = set(range(len(names))).difference(set(matched))
    rest.remove(0)
    new = list(rest)
    names[new] = np.arange(newest + 1, newest + 1 + len(new))
    return names, newest + len(new)
