"""Twins: an accident scenario and the normal one of its name and subtype; splits that part them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING, Final

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import TokenError

if TYPE_CHECKING:
    from deepaccident_devkit.tables.records import ScenarioRecord

_OTHER_ENDING: Final[Mapping[str, str]] = {"normal": "accident", "accident": "normal"}


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
    """Return the scenario of the same name and subtype with the other ending, or None.

    Args:
        dataset: The release.
        scenario: Token or record.

    Raises:
        TokenError: No such scenario.
    """
    record = dataset.get("scenario", scenario)
    family, _, ending = record["scenario_type"].rpartition("_")
    if ending not in _OTHER_ENDING:
        return None
    try:
        return dataset.scenario.get(f"{family}_{_OTHER_ENDING[ending]}/{record['name']}")
    except TokenError:
        return None


def torn_twins(split_of: Mapping[str, str | None]) -> tuple[TornTwins, ...]:
    """Return the twins with their two scenarios in different splits.

    A model that learns from one of the two scenarios has then learnt about the other.

    Args:
        split_of: Scenario token → its split; scenarios without a split do not count.
    """
    twins: dict[tuple[str, str], list[str]] = defaultdict(list)
    for token, split in split_of.items():
        scenario_type, _, name = token.partition("/")
        if split is not None:
            twins[scenario_type.rpartition("_")[0], name].append(token)
    torn = []
    for tokens in twins.values():
        for pair in combinations(tokens, 2):
            splits = (split_of[pair[0]], split_of[pair[1]])
            if splits[0] != splits[1]:
                torn.append(TornTwins(scenarios=pair, splits=(str(splits[0]), str(splits[1]))))
    return tuple(torn)
