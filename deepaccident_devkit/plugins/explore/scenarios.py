"""Columns of the scenarios: from tables at once, and computed ones as soon as they are ready."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.collisions.recorded import each_scenario, those_of
from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.interactions import interactions_of
from deepaccident_devkit.interactions.scenario import measures_of_moving_pairs
from deepaccident_devkit.plugins.explore.background import Job, Jobs
from deepaccident_devkit.plugins.safety import lead_times
from deepaccident_devkit.selection.fields import FIELDS, group_texts
from deepaccident_devkit.support.arrays import FloatArray, IntArray
from deepaccident_devkit.support.text import natural_order

if TYPE_CHECKING:
    from deepaccident_devkit.tables.records import ScenarioRecord

UNKNOWN_VALUE: Final = "unknown"
INTERACTIONS: Final = "interactions"
ACCIDENTS: Final = "accidents"
# Slow column → the job that computes it.
_JOB_BY_COLUMN: Final = {
    **dict.fromkeys(("min_ttc", "min_pet", "min_gap", "max_drac"), INTERACTIONS),
    **dict.fromkeys(("closing_speed", "accident_visibility", "lead", "lead_all"), ACCIDENTS),
}
_TITLES: Final = {
    INTERACTIONS: "how near pairs come",
    ACCIDENTS: "lead times, visibility and closing speeds",
}
# Visibility of an approaching accident → its rank.
VISIBILITY_RANKS: Final[Mapping[str, float]] = {"visible": 0.0, "partial": 1.0, "invisible": 2.0}
# Facets that stand above the others.
_TOP_FACETS: Final = (
    "collision",
    "accident_visibility",
    "split",
    "town",
    "weather_group",
    "time_of_day_group",
    "collision_status",
    "scenario_type",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Facet:
    """A field with few values, for readers to choose from.

    Attributes:
        name: Name of the field, as filters name it.
        values: Texts of the values, `unknown` last.
        codes: Index of each scenario's value, shape (N,).
    """

    name: str
    values: tuple[str, ...]
    codes: IntArray


class Scenarios:
    """The scenarios of a release, in the order of its table, and their columns.

    Safe to read from several threads.
    """

    def __init__(self, dataset: Dataset, jobs: Jobs, *, workers: int | None = None) -> None:
        """Read the fast columns of a release; `begin` begins the slow ones."""
        self.dataset = dataset
        self.records: Sequence[ScenarioRecord] = dataset.scenario[:]
        self.tokens = [record["token"] for record in self.records]
        self.row_of = {token: row for row, token in enumerate(self.tokens)}
        self._jobs, self._workers = jobs, workers
        self._values: dict[str, list[Any]] = {}
        self._facets: dict[str, Facet] = {}
        texts = [group_texts(dataset, record) for record in self.records]
        grouping_fields = [name for name, field in FIELDS.items() if field.groups]
        for name in [*_TOP_FACETS, *grouping_fields]:
            if name not in self._facets and not FIELDS[name].costly:
                self._facets[name] = _facet(name, [row[name] for row in texts])

    def __len__(self) -> int:
        """Return the number of scenarios."""
        return len(self.records)

    def begin(self) -> None:
        """Begin to compute the slow columns."""
        for name in (ACCIDENTS, INTERACTIONS):
            self.job(name)

    def job(self, name: str) -> Job:
        """Return the job that computes one or several slow columns, begun if necessary."""
        work = {INTERACTIONS: self._interactions, ACCIDENTS: self._accidents}[name]
        return self._jobs.ask(name, _TITLES[name], work)

    def job_of(self, column: str) -> Job | None:
        """Return the job that computes a column; None for a column that is ready at once."""
        if column in _JOB_BY_COLUMN:
            return self.job(_JOB_BY_COLUMN[column])
        return None

    def late(self, column: str) -> Job | None:
        """Return the job that a column waits for; None for a column that is ready."""
        job = self.job_of(column)
        if job is not None and job.result is None:
            return job
        return None

    def values(self, column: str) -> Sequence[Any] | None:
        """Return a column's values, None for unknown ones, or several in a tuple.

        Return None until the column is ready.
        """
        job = self.job_of(column)
        if job is not None:
            return None if job.result is None else job.result[column]
        if column not in self._values:
            self._values[column] = list(FIELDS[column].values(self.dataset, self.records))
        return self._values[column]

    def numbers(self, column: str) -> FloatArray | None:
        """Return a column's values as numbers to sort by, shape (N,), NaN for unknown ones.

        Return None until the column is ready.
        """
        values = self.values(column)
        if values is None:
            return None
        ranks = VISIBILITY_RANKS if column == "accident_visibility" else {}
        numbers = [math.nan if value is None else ranks.get(value, value) for value in values]
        return np.array(numbers, dtype=np.float64)

    def facets(self) -> list[Facet]:
        """Return the facets that are ready and have several values, the most important first."""
        facets = dict(self._facets)
        if self.values("accident_visibility") is not None:
            facets["accident_visibility"] = self._visibility
        order = [*_TOP_FACETS, *(name for name in facets if name not in _TOP_FACETS)]
        return [facets[name] for name in order if name in facets and len(facets[name].values) > 1]

    @cached_property
    def _visibility(self) -> Facet:
        return _facet("accident_visibility", self.values("accident_visibility") or [])

    def _interactions(self) -> dict[str, list[Any]]:
        results = interactions_of(self.dataset, workers=self._workers)
        return _columns(INTERACTIONS, [measures_of_moving_pairs(pairs) for pairs in results])

    def _accidents(self) -> dict[str, list[Any]]:
        results = each_scenario(
            accident_fields, self.dataset, label="accidents", workers=self._workers
        )
        return _columns(ACCIDENTS, those_of(dict, results))


def _columns(job_name: str, rows: Sequence[Mapping[str, Any]]) -> dict[str, list[Any]]:
    """Return the columns that a job computes, from its results for each scenario."""
    names = [column for column, job in _JOB_BY_COLUMN.items() if job == job_name]
    return {name: [row[name] for row in rows] for name in names}


def accident_fields(dataset: Dataset, record: ScenarioRecord) -> dict[str, Any]:
    """Return the slow columns about an accident; None where unknown, and without a collision."""
    try:
        leads = lead_times(dataset, record)
    except NotAvailableError:
        leads = None
    fields: dict[str, Any] = {}
    for name in ("closing_speed", "accident_visibility"):
        fields[name] = FIELDS[name].read(dataset, record)
    fields["lead"] = None if leads is None else _finite_or_none(leads.alone)
    fields["lead_all"] = None if leads is None else _finite_or_none(leads.together)
    return fields


def _finite_or_none(value: float) -> float | None:
    if math.isnan(value):
        return None
    return float(value)


def _facet(name: str, texts: Sequence[str | None]) -> Facet:
    values = sorted({text for text in texts if text is not None}, key=natural_order)
    if None in texts:
        values.append(UNKNOWN_VALUE)
    code_by_value = {value: code for code, value in enumerate(values)}
    codes = [code_by_value[UNKNOWN_VALUE if text is None else text] for text in texts]
    return Facet(name=name, values=tuple(values), codes=np.array(codes, dtype=np.int64))
