"""`accident_context`: what a release knows of a sample beside its motion labels."""

from __future__ import annotations

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.evaluation.accident.impact import box_truth, labelled_sample
from deepaccident_devkit.evaluation.accident.protocol import AccidentContext


def accident_context(dataset: Dataset, sample: RowArgument, horizon: float | None = None) -> AccidentContext:
    """What a release knows of a sample beside its motion labels, for the accident metrics.

    Args:
        dataset: the release.
        sample: token or record.
        horizon: seconds that the protocol `boxes` looks ahead; None leaves out what it alone needs.

    Raises:
        TokenError: no such sample.
        NotAvailableError: the sample has no label; with a horizon also as of `box_truth`.
    """
    there = labelled_sample(dataset, sample)
    scenario = dataset.get("scenario", there["scenario_token"])
    collision = scenario["collision"]
    return AccidentContext(
        pair=None if collision is None else (collision["ids"][0], collision["ids"][1]),
        known=scenario["weather"] is not None,
        own_actor_id=dataset.get("agent", there["agent_token"])["actor_id"],
        truth=None if horizon is None else box_truth(dataset, there, horizon),
    )
