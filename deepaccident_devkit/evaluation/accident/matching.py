"""Which instance of one set of maps is which of another."""

from __future__ import annotations

import numpy as np

from deepaccident_devkit.evaluation.accident.reading import TIE, InstanceTracks, even


def match_tracks(predicted: InstanceTracks, truth: InstanceTracks, gate: float) -> dict[int, int]:
    """Instances that go the same way, one to one: predicted id → true id.

    The distance of two is the mean of that of their centres over the moments at which both are there. Of all ways to
    match, as many pairs as possible within `gate`, and of those with as many the least sum of distances. (So a distant
    pair cannot use up an instance that another one needs, as it does in the released code.)

    Args:
        predicted: over T moments.
        truth: over the same.
        gate: metres; pairs farther apart, and those that are never there together, are no match.
    """
    from scipy.optimize import linear_sum_assignment

    apart = np.linalg.norm(predicted.center[:, :, None] - truth.center[:, None], axis=-1)
    common = np.isfinite(apart)
    sums = np.where(common, apart, 0).sum(axis=0)
    distance = np.where(common.any(axis=0), even(sums / np.maximum(common.sum(axis=0), 1)), np.inf)
    allowed = distance <= gate + TIE
    # a pair more within the gate outweighs all that distances can add up to
    refused = (gate + 1) * (min(distance.shape) + 1)
    rows, columns = linear_sum_assignment(np.where(allowed, distance, refused))
    return {
        int(predicted.identity[row]): int(truth.identity[column])
        for row, column in zip(rows.tolist(), columns.tolist(), strict=True)
        if allowed[row, column]
    }
