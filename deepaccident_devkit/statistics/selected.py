"""`Selected`: the columns of some neighbouring scenarios, and which group each row counts for."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from deepaccident_devkit.arrays import AnyArray, BoolArray
from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.statistics.results import UNKNOWN
from deepaccident_devkit.statistics.tally import PARTS
from deepaccident_devkit.tables.columns import Key
from deepaccident_devkit.tables.specs import table_spec

if TYPE_CHECKING:
    from deepaccident_devkit.tables.records import AgentRecord, ScenarioRecord

_OWNERS = {"annotation": "sample"}
"""Table → the one by whose rows its own are sorted; the others are by scenario."""


class Selected:
    """A run of scenarios of a release, from the first to the last that counts: rows are counted from its own first.

    Attributes:
        first: the row of its first scenario in the release.
        scenarios: the records that count, by row in the release.
        scenario_group: (S,) int8 group code of every scenario of the run, −1 for those that do not count.
        agents: records of the agents of all of them.
    """

    def __init__(self, dataset: Dataset, rows: Sequence[int]) -> None:
        """Select the scenarios of some rows, in ascending order."""
        self.first = rows[0]
        self._dataset = dataset
        self._slices = {"scenario": slice(self.first, rows[-1] + 1)}
        self.scenarios: dict[int, ScenarioRecord] = {row: dataset.scenario[row] for row in rows}
        self.scenario_group = np.full(rows[-1] + 1 - self.first, -1, dtype=np.int8)
        for row, scenario in self.scenarios.items():
            self.scenario_group[row - self.first] = PARTS.index(group_of(scenario))
        self.agents: list[AgentRecord] = dataset.agent[self._slice("agent")]

    def column(self, table: str, name: str) -> Any:
        """The rows of a stored column, read-only; its keys count from the run's first of the other table."""
        values = self._dataset.columns(table)[name][self._slice(table)]
        (kind,) = (column.kind for column in table_spec(table).stored_columns if column.stored == name)
        return values - self._slice(kind.table).start if isinstance(kind, Key) else values

    @cached_property
    def labelled(self) -> BoolArray:
        """(S,) whether any agent of a scenario has labels."""
        labelled = np.zeros(len(self.scenario_group), dtype=bool)
        labelled[self.column("sample", "scenario_row")[self.column("sample", "labelled")]] = True
        return labelled

    @cached_property
    def annotation_group(self) -> AnyArray:
        """(N,) int8 group code of every annotation."""
        groups: AnyArray = self.group("sample")[self.column("annotation", "sample_row")]
        return groups

    def group(self, table: str) -> AnyArray:
        """(N,) int8 group code of every row of a table that has a `scenario_row`."""
        groups: AnyArray = self.scenario_group[self.column(table, "scenario_row")]
        return groups

    def _slice(self, table: str) -> slice:
        """The rows of a table that belong to the run."""
        if table not in self._slices:
            owner = _OWNERS.get(table, "scenario")
            keys, rows = self._dataset.columns(table)[f"{owner}_row"], self._slice(owner)
            ends = np.array([rows.start, rows.stop], dtype=keys.dtype)  # of another type, all keys would be copied
            self._slices[table] = slice(*np.searchsorted(keys, ends).tolist())
        return self._slices[table]


def group_of(scenario: ScenarioRecord) -> str:
    """The group, besides the total, that a scenario counts for."""
    return scenario["split"] or UNKNOWN
