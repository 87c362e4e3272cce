"""`accident_context`: what a release knows of a sample beside its motion labels."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Final

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import TokenError
from deepaccident_devkit.evaluation.accident.impact import box_truth, labelled_sample
from deepaccident_devkit.evaluation.accident.protocol import AccidentContext

_OTHER_ENDING: Final[Mapping[str, str]] = MappingProxyType({"normal": "accident", "accident": "normal"})


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
        time_to_impact=there["time_to_impact"],
        time_to_end=there["time_to_end"],
        twin=_is_twin_of_an_accident(dataset, scenario),
    )


def _is_twin_of_an_accident(dataset: Dataset, scenario: Mapping[str, Any]) -> bool | None:
    """Whether nobody collides in a scenario, but somebody in that of the same family and name with the other ending."""
    if scenario["collision"] is not None:
        return False
    family, _, ending = scenario["scenario_type"].rpartition("_")
    try:
        twin = dataset.scenario.get(f"{family}_{_OTHER_ENDING.get(ending, ending)}/{scenario['name']}")
    except TokenError:
        return None
    if scenario["weather"] is None or twin["weather"] is None:  # no meta file, so nobody knows
        return None
    return twin["collision"] is not None
