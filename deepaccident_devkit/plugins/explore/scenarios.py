"""Columns of the scenarios: fast ones from tables, and slow ones as soon as they are computed."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.collisions.recorded import map_scenarios, select_results
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
# The job that computes each slow column.
_JOB_BY_COLUMN = {
    **dict.fromkeys(("min_ttc", "min_pet", "min_gap", "max_drac"), INTERACTIONS),
    **dict.fromkeys(("closing_speed", "accident_visibility", "lead", "lead_all"), ACCIDENTS),
}
_TITLES = {
    INTERACTIONS: "how near pairs come",
    ACCIDENTS: "lead times, visibility and closing speeds",
}
# Rank of each visibility of an approaching accident.
VISIBILITY_RANKS: Final[Mapping[str, float]] = {"visible": 0.0, "partial": 1.0, "invisible": 2.0}
# Facets that are shown above the others.
_TOP_FACETS = (
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
    """A field with few values that readers can choose from.

    Attributes:
        name: Name of the field, as filters name it.
        values: Texts of the values, with `unknown` at the end.
        codes: Index of the value of each scenario, shape (N,).
    """

    name: str
    values: tuple[str, ...]
    codes: IntArray


class Scenarios:
    """The scenarios of a release, in the order of its table, and their columns.

    It is safe to read from several threads.
    """

    def __init__(self, dataset: Dataset, jobs: Jobs, *, workers: int | None = None) -> None:
        """Read the fast columns of a release; `begin` computes the slow ones."""
        self.dataset = dataset
        self.records: Sequence[ScenarioRecord] = dataset.scenario[:]
        self.tokens = [record["token"] for record in self.records]
        self.row_of = {token: row for row, token in enumerate(self.tokens)}
        self._jobs = jobs
        self._workers = workers
        self._values: dict[str, list[Any]] = {}
        self._facets: dict[str, Facet] = {}
        texts = [group_texts(dataset, record) for record in self.records]
        grouping_fields = [name for name, field in FIELDS.items() if field.groups]
        for name in [*_TOP_FACETS, *grouping_fields]:
            if name not in self._facets and not FIELDS[name].costly:
                self._facets[name] = _make_facet(name, [row[name] for row in texts])

    def __len__(self) -> int:
        """Return the number of scenarios."""
        return len(self.records)

    def begin(self) -> None:
        """Start to compute the slow columns."""
        for name in (ACCIDENTS, INTERACTIONS):
            self.job(name)

    def job(self, name: str) -> Job:
        """Return the job that computes some slow columns; it is started if necessary."""
        work = self._measure_accidents
        if name == INTERACTIONS:
            work = self._measure_interactions
        return self._jobs.ask(name, _TITLES[name], work)

    def find_job(self, column: str) -> Job | None:
        """Return the job that computes a column; None for a fast column."""
        if column in _JOB_BY_COLUMN:
            return self.job(_JOB_BY_COLUMN[column])
        return None

    def late(self, column: str) -> Job | None:
        """Return the unfinished job that computes a column; None if the column is ready."""
        job = self.find_job(column)
        if job is not None and job.result is None:
            return job
        return None

    def values(self, column: str) -> Sequence[Any] | None:
        """Return the values of a column, one per scenario, or None until the column is ready.

        An unknown value is None; several values of one scenario are a tuple.
        """
        job = self.find_job(column)
        if job is not None:
            return None if job.result is None else job.result[column]
        if column not in self._values:
            self._values[column] = list(FIELDS[column].values(self.dataset, self.records))
        return self._values[column]

    def numbers(self, column: str) -> FloatArray | None:
        """Return the values of a column as numbers to sort by, shape (N,), NaN if unknown.

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
        ordered_facets = []
        for name in dict.fromkeys([*_TOP_FACETS, *facets]):
            if name in facets and len(facets[name].values) > 1:
                ordered_facets.append(facets[name])
        return ordered_facets

    @cached_property
    def _visibility(self) -> Facet:
        texts = self.values("accident_visibility") or []
        return _make_facet("accident_visibility", texts)

    def _measure_interactions(self) -> dict[str, list[Any]]:
        results = interactions_of(self.dataset, workers=self._workers)
        measures = list(map(measures_of_moving_pairs, results))
        return _make_columns(INTERACTIONS, measures)

    def _measure_accidents(self) -> dict[str, list[Any]]:
        results = map_scenarios(
            read_accident_fields, self.dataset, label="Reading accidents", workers=self._workers
        )
        return _make_columns(ACCIDENTS, select_results(dict, results))


def _make_columns(job_name: str, rows: Sequence[Mapping[str, Any]]) -> dict[str, list[Any]]:
    """Return the columns of a job, from its results for each scenario."""
    columns = {}
    for column, job in _JOB_BY_COLUMN.items():
        if job == job_name:
            columns[column] = [row[column] for row in rows]
    return columns


def read_accident_fields(dataset: Dataset, record: ScenarioRecord) -> dict[str, Any]:
    """Return the slow columns about an accident; None for unknown values, or without one."""
    lead = None
    lead_all = None
    with suppress(NotAvailableError):
        leads = lead_times(dataset, record)
        if leads is not None:
            lead = _finite_or_none(leads.alone)
            lead_all = _finite_or_none(leads.together)
    return {
        "closing_speed": FIELDS["closing_speed"].read(dataset, record),
        "accident_visibility": FIELDS["accident_visibility"].read(dataset, record),
        "lead": lead,
        "lead_all": lead_all,
    }


def _finite_or_none(value: float) -> float | None:
    if math.isnan(value):
        return None
    return float(value)


def _make_facet(name: str, texts: Sequence[str | None]) -> Facet:
    values = sorted({text for text in texts if text is not None}, key=natural_order)
    if None in texts:
        values.append(UNKNOWN_VALUE)
    code_by_value = {value: code for code, value in enumerate(values)}
    codes = [code_by_value[UNKNOWN_VALUE if text is None else text] for text in texts]
    return Facet(name=name, values=tuple(values), codes=np.array(codes, dtype=np.int64))
