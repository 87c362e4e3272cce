"""Twins (an accident and the normal scenario of the same name and subtype), and torn twins."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import TokenError

if TYPE_CHECKING:
    from deepaccident_devkit.tables.records import ScenarioRecord

_OTHER_ENDING = {"normal": "accident", "accident": "normal"}


@dataclass(frozen=True, slots=True, kw_only=True)
class TornTwins:
    """Two scenarios of one name and subtype that belong to different splits.

    Attributes:
        scenarios: Tokens of the two scenarios.
        splits: Splits of the two scenarios.
    """

    scenarios: tuple[str, str]
    splits: tuple[str, str]


def twin_of(dataset: Dataset, scenario: RowArgument) -> ScenarioRecord | None:
    """Return the scenario that has the same name and subtype but the other ending, or None.

    Args:
        dataset: The release.
        scenario: Token or record.

    Raises:
        TokenError: There is no such scenario.
    """
    record = dataset.get("scenario", scenario)
    family, _, ending = record["scenario_type"].rpartition("_")
    if ending not in _OTHER_ENDING:
        return None
    twin_type = f"{family}_{_OTHER_ENDING[ending]}"
    try:
        return dataset.scenario.get(f"{twin_type}/{record['name']}")
    except TokenError:
        return None


def torn_twins(split_of: Mapping[str, str | None]) -> tuple[TornTwins, ...]:
    """Return the twins whose two scenarios belong to different splits.

    A model that learns from one of the two scenarios has then learnt about the other.

    Args:
        split_of: Scenario token → its split; scenarios without a split (None) are ignored.
    """
    twins: dict[tuple[str, str], list[str]] = defaultdict(list)
    for token, split in split_of.items():
        scenario_type, _, name = token.partition("/")
        if split is not None:
            twins[scenario_type.rpartition("_")[0], name].append(token)
    torn = []
    for tokens in twins.values():
        for first, second in combinations(tokens, 2):
            splits = (str(split_of[first]), str(split_of[second]))
            if splits[0] != splits[1]:
                torn.append(TornTwins(scenarios=(first, second), splits=splits))
    return tuple(torn)
