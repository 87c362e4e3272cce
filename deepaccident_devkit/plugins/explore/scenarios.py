"""What is known of each scenario, a column at a time: at once what stands in tables, later what is computed."""

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
# Slow column → the work that gives it.
_JOB_OF: Final = {
    **dict.fromkeys(("min_ttc", "min_pet", "min_gap", "max_drac"), INTERACTIONS),
    **dict.fromkeys(("closing_speed", "accident_visibility", "lead", "lead_all"), ACCIDENTS),
}
_TITLES: Final = {
    INTERACTIONS: "how near pairs come",
    ACCIDENTS: "lead times, visibility and closing speeds",
}
# How an accident is seen to come → its place in an order.
VISIBILITY_RANKS: Final[Mapping[str, float]] = {"visible": 0.0, "partial": 1.0, "invisible": 2.0}
# Facets that stand above the others.
_FIRST: Final = (
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
    """A field with few values, each of which a reader can choose.

    Attributes:
        name: of the field, as filters name it.
        values: as texts, `unknown` last.
        codes: (N,) position of each scenario's value.
    """

    name: str
    values: tuple[str, ...]
    codes: IntArray


class Scenarios:
    """The scenarios of a release, in the order of its table, and their columns; safe to read from several threads."""

    def __init__(self, dataset: Dataset, jobs: Jobs, *, workers: int | None = None) -> None:
        """Take a release; `begin` begins what is slow."""
        self.dataset = dataset
        self.records: Sequence[ScenarioRecord] = dataset.scenario[:]
        self.tokens = [record["token"] for record in self.records]
        self.row_of = {token: row for row, token in enumerate(self.tokens)}
        self._jobs, self._workers = jobs, workers
        self._values: dict[str, list[Any]] = {}
        self._facets: dict[str, Facet] = {}
        texts = [group_texts(dataset, record) for record in self.records]
        for name in [*_FIRST, *(name for name, field in FIELDS.items() if field.groups)]:
            if name not in self._facets and not FIELDS[name].costly:
                self._facets[name] = _facet(name, [each[name] for each in texts])

    def __len__(self) -> int:
        """How many there are."""
        return len(self.records)

    def begin(self) -> None:
        """Begin to compute the slow columns."""
        for name in (ACCIDENTS, INTERACTIONS):
            self.job(name)

    def job(self, name: str) -> Job:
        """The work that gives one or several slow columns, begun if it is not."""
        work = {INTERACTIONS: self._interactions, ACCIDENTS: self._accidents}[name]
        return self._jobs.ask(name, _TITLES[name], work)

    def job_of(self, column: str) -> Job | None:
        """The work that gives a column; None for one that is there at once."""
        return self.job(_JOB_OF[column]) if column in _JOB_OF else None

    def late(self, column: str) -> Job | None:
        """The work that a column waits for; None for one that is there."""
        job = self.job_of(column)
        return job if job is not None and job.result is None else None

    def values(self, column: str) -> Sequence[Any] | None:
        """A column's values, None where unknown, or several in a tuple; None in its place until it is ready."""
        job = self.job_of(column)
        if job is not None:
            return None if job.result is None else job.result[column]
        if column not in self._values:
            self._values[column] = list(FIELDS[column].values(self.dataset, self.records))
        return self._values[column]

    def numbers(self, column: str) -> FloatArray | None:
        """(N,) a column's values as numbers by which to sort, NaN where unknown; None until it is ready."""
        values = self.values(column)
        if values is None:
            return None
        ranks = VISIBILITY_RANKS if column == "accident_visibility" else {}
        return np.array(
            [math.nan if each is None else ranks.get(each, each) for each in values],
            dtype=np.float64,
        )

    def facets(self) -> list[Facet]:
        """The facets, the most asked for first; without those of one value, and of those that are not ready."""
        found = dict(self._facets)
        if self.values("accident_visibility") is not None:
            found["accident_visibility"] = self._visibility
        order = [*_FIRST, *(name for name in found if name not in _FIRST)]
        return [found[name] for name in order if name in found and len(found[name].values) > 1]

    @cached_property
    def _visibility(self) -> Facet:
        return _facet("accident_visibility", self.values("accident_visibility") or [])

    def _interactions(self) -> dict[str, list[Any]]:
        found = interactions_of(self.dataset, workers=self._workers)
        return _columns(INTERACTIONS, [measures_of_moving_pairs(each) for each in found])

    def _accidents(self) -> dict[str, list[Any]]:
        found = each_scenario(
            accident_fields, self.dataset, label="accidents", workers=self._workers
        )
        return _columns(ACCIDENTS, those_of(dict, found))


def _columns(job: str, rows: Sequence[Mapping[str, Any]]) -> dict[str, list[Any]]:
    """The columns that a work gives, from what it found of each scenario."""
    return {name: [row[name] for row in rows] for name, work in _JOB_OF.items() if work == job}


def accident_fields(dataset: Dataset, record: ScenarioRecord) -> dict[str, Any]:
    """The columns of `_JOB_OF` that tell of an accident; None where unknown, and where nobody collides."""
    try:
        leads = lead_times(dataset, record)
    except NotAvailableError:
        leads = None
    told = {
        name: FIELDS[name].read(dataset, record)
        for name in ("closing_speed", "accident_visibility")
    }
    known = {"lead": leads.alone, "lead_all": leads.together} if leads is not None else {}
    return {**told, **{name: _known(known.get(name)) for name in ("lead", "lead_all")}}


def _known(value: float | None) -> float | None:
    return None if value is None or math.isnan(value) else float(value)


def _facet(name: str, texts: Sequence[str | None]) -> Facet:
    values = sorted({text for text in texts if text is not None}, key=natural_order)
    values += [UNKNOWN_VALUE] * (None in texts)
    place = {value: number for number, value in enumerate(values)}
    codes = np.array(
        [place[UNKNOWN_VALUE if text is None else text] for text in texts], dtype=np.int64
    )
    return Facet(name=name, values=tuple(values), codes=codes)
