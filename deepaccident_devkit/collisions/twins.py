"""Twins: an accident scenario and the normal one of the same name and subtype, and those that a split tears apart."""

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
        scenarios: their tokens.
        splits: the split of each.
    """

    scenarios: tuple[str, str]
    splits: tuple[str, str]


def twin_of(dataset: Dataset, scenario: RowArgument) -> ScenarioRecord | None:
    """The scenario of the same name and subtype with the other ending; None if this release has none.

    Args:
        dataset: the release.
        scenario: token or record.

    Raises:
        TokenError: no such scenario.
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
    """The twins of which each is in another split; what is learnt from one is then known of the other.

    Args:
        split_of: scenario token → its split; scenarios without one do not count.
    """
    twins: dict[tuple[str, str], list[str]] = defaultdict(list)
    for token, split in split_of.items():
        scenario_type, _, name = token.partition("/")
        if split is not None:
            twins[scenario_type.rpartition("_")[0], name].append(token)
    return tuple(
        TornTwins(scenarios=pair, splits=(str(split_of[pair[0]]), str(split_of[pair[1]])))
        for tokens in twins.values()
        for pair in combinations(tokens, 2)
        if split_of[pair[0]] != split_of[pair[1]]
    )
