"""How far predicted paths are from the true ones: minADE, minFDE and miss rate over K predictions (evaluation.md d).

The released code prints nine numbers, of which three say anything: it gives all predictions the probability 1, so that
its p- and brier-variants are the plain ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from deepaccident_devkit.evaluation.trajectory_matching import Paths, TrajectoryMatches, distances, longest


@dataclass(frozen=True, slots=True, kw_only=True)
class TrajectoryRules:
    """What decides the errors; the defaults are the released ones.

    Attributes:
        ade_limit: metres; a larger mean error counts as this.
        fde_limit: metres; a larger final error counts as this.
        miss_distance: metres; a larger final error is a miss.
        first_prediction_empty_ends: the released slip: where the first prediction has no path at all, the sample
            counts for nothing, whatever the others have.
    """

    ade_limit: float = 8.0
    fde_limit: float = 10.0
    miss_distance: float = 5.0
    first_prediction_empty_ends: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class TrajectoryErrors:
    """Sums over the true paths of a sample that some prediction has a partner for.

    Attributes:
        ade: of the mean distances over the frames, metres.
        fde: of the distances at the last frame, metres.
        missed: how many are missed.
        count: how many there are.
    """

    ade: float
    fde: float
    missed: int
    count: int


def trajectory_errors(
    predictions: Sequence[Paths],
    truth: Paths,
    matches: Sequence[TrajectoryMatches],
    rules: TrajectoryRules = TrajectoryRules(),
) -> TrajectoryErrors:
    """The errors of a sample; for each true path, those of the prediction that ends nearest to it (the first of ties).

    Args:
        predictions: K times id → (≥ T, 2) metres.
        truth: id → (T, 2) metres.
        matches: of each prediction with the truth.
        rules: limits and slips.
    """
    ade, fde, missed, count = 0.0, 0.0, 0, 0
    frames = longest(truth)
    if predictions and not predictions[0] and rules.first_prediction_empty_ends:
        return TrajectoryErrors(ade=ade, fde=fde, missed=missed, count=count)
    partners = [{true: mine for mine, true in match.pairs} for match in matches]
    for name, path in truth.items():
        errors = [
            distances(paths[mine[name]][:frames], path)
            for paths, mine in zip(predictions, partners, strict=True)
            if name in mine
        ]
        if errors:
            best = min(errors, key=lambda each: each.item(-1))
            ade += min(sum(best.tolist()) / frames, rules.ade_limit)
            fde += min(best.item(-1), rules.fde_limit)
            missed += best.item(-1) > rules.miss_distance
            count += 1
    return TrajectoryErrors(ade=ade, fde=fde, missed=missed, count=count)
