"""The columns that statistics are computed on, which group each row counts for, and counting by group."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from deepaccident_devkit.arrays import AnyArray, BoolArray, FloatArray, IntArray
from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.statistics.results import GROUPS, PROBABILITIES, TOTAL, UNKNOWN, LeftOut, QuantileRow
from deepaccident_devkit.tables.arrow import record_batch, views
from deepaccident_devkit.tables.specs import table_spec

if TYPE_CHECKING:
    from deepaccident_devkit.tables.records import ScenarioRecord

_PARTS = GROUPS[1:]
"""The groups that the total is made of; a row's group code counts in them, −1 for rows that are not selected."""


class Selected:
    """A release's columns, and the scenarios of it that count.

    Attributes:
        dataset: the release.
        scenarios: the records that count, in the table's order.
        scenario_group: (S,) int8 group code of every scenario of the release, −1 for those that do not count.
    """

    def __init__(self, dataset: Dataset, scenarios: RowArgument | Iterable[RowArgument] | None) -> None:
        """Select scenarios by token or record, or a single one, None for all; raises TokenError or ChoiceError."""
        if isinstance(scenarios, str | Mapping):
            scenarios = [scenarios]
        if scenarios is not None and not isinstance(scenarios, Iterable):
            raise ChoiceError(f"scenarios: expected tokens or records of scenarios, found {scenarios!r}")
        self.dataset = dataset
        self.scenario_group = np.full(len(dataset.scenario), -1, dtype=np.int8)
        chosen = range(len(dataset.scenario))
        rows = chosen if scenarios is None else sorted({dataset.getind("scenario", token) for token in scenarios})
        self.rows: Sequence[int] = rows
        self.scenarios: list[ScenarioRecord] = [dataset.scenario[row] for row in rows]
        for row, scenario in zip(rows, self.scenarios, strict=True):
            self.scenario_group[row] = _PARTS.index(group_of(scenario))
        self._views: dict[str, Mapping[str, Any]] = {}

    def column(self, table: str, name: str) -> Any:
        """The view of a stored column, read-only, over the mapped memory."""
        if table not in self._views:
            spec, batches = table_spec(table), self.dataset.arrow(table).to_batches()
            empty: dict[str, list[Any]] = {column.stored: [] for column in spec.stored_columns if column.stored}
            self._views[table] = views(spec, batches[0] if batches else record_batch(spec, empty))
        return self._views[table][name]

    @cached_property
    def labelled(self) -> BoolArray:
        """(S,) whether any agent of a scenario has labels."""
        labelled = np.zeros(len(self.scenario_group), dtype=bool)
        labelled[self.column("sample", "scenario_row")[self.column("sample", "labelled")[:]]] = True
        return labelled

    @cached_property
    def annotation_group(self) -> AnyArray:
        """(N,) int8 group code of every annotation."""
        sample_group = self.scenario_group[self.column("sample", "scenario_row")]
        groups: AnyArray = sample_group[self.column("annotation", "sample_row")]
        return groups

    def group(self, table: str) -> AnyArray:
        """(N,) int8 group code of every row of a table that has a `scenario_row`."""
        groups: AnyArray = self.scenario_group[self.column(table, "scenario_row")]
        return groups

    @property
    def unlabelled(self) -> LeftOut:
        """The selected scenarios without any label."""
        groups = self.scenario_group[~self.labelled]
        return LeftOut(what="scenarios without labels", counts=group_counts(groups))


def group_of(scenario: ScenarioRecord) -> str:
    """The group, besides the total, that a scenario counts for."""
    return scenario["split"] or UNKNOWN


def group_counts(groups: AnyArray) -> dict[str, int]:
    """Group → how many rows, from the group codes of rows."""
    return _with_total(np.bincount(groups[groups >= 0], minlength=len(_PARTS)))


def cross_counts(codes: AnyArray, groups: AnyArray, values: int) -> list[dict[str, int]]:
    """For each code from 0 to `values` − 1: group → how many rows; rows with a negative code or group do not count."""
    return [_with_total(row) for row in _cross(codes, groups, values)]


def word_counts(
    scenarios: Iterable[ScenarioRecord],
    word: Callable[[ScenarioRecord], str | None],
    known: Sequence[str] = (),
    weight: Callable[[ScenarioRecord], int] = lambda _: 1,
) -> dict[str, dict[str, int]]:
    """Value → group → how many, of a word of scenarios.

    Args:
        scenarios: records.
        word: the value of a record; None counts as `unknown`, which is there only if it occurs.
        known: values that are there in any case, in this order; others follow.
        weight: what a scenario counts.
    """
    counts = {value: dict.fromkeys(GROUPS, 0) for value in known}
    for scenario in scenarios:
        row = counts.setdefault(word(scenario) or UNKNOWN, dict.fromkeys(GROUPS, 0))
        for group in (TOTAL, group_of(scenario)):
            row[group] += weight(scenario)
    others = sorted(set(counts) - {*known, UNKNOWN})
    return {value: counts[value] for value in (*known, *others, UNKNOWN) if value in counts}


def binned(
    values: FloatArray, groups: AnyArray, edges: Sequence[float]
) -> tuple[dict[str, tuple[int, ...]], dict[str, int]]:
    """Count numbers in bins, by group.

    Args:
        values: (N,) without NaN.
        groups: (N,) group codes; rows with −1 do not count.
        edges: (B + 1,) ascending; a bin holds its lower edge, the last one both.

    Returns:
        Group → B counts; group → how many outside of the edges.
    """
    bounds = np.asarray(edges, dtype=np.float64)
    bins = np.searchsorted(bounds, values, side="right").astype(np.int8)  # 0 below, B + 1 above
    bins[values == bounds[-1]] = len(bounds) - 1
    rows = cross_counts(bins, groups, len(bounds) + 1)
    inner = {group: tuple(row[group] for row in rows[1:-1]) for group in GROUPS}
    return inner, {group: rows[0][group] + rows[-1][group] for group in GROUPS}


def quantile_rows(field: str, category: str, values: FloatArray, groups: AnyArray) -> list[QuantileRow]:
    """The quantiles of numbers in every group.

    Args:
        field: what the numbers are.
        category: whose they are.
        values: (N,) without NaN.
        groups: (N,) group codes, none negative.
    """
    counts = np.bincount(groups, minlength=len(_PARTS))
    whole = _quantiles(values)
    rows = [QuantileRow(field=field, category=category, group=TOTAL, number=len(values), values=whole)]
    for code, (group, number) in enumerate(zip(_PARTS, counts.tolist(), strict=True)):
        part = whole if number == len(values) else _quantiles(values[groups == code])
        rows.append(QuantileRow(field=field, category=category, group=group, number=number, values=part))
    return rows


def _quantiles(values: FloatArray) -> tuple[float, ...] | None:
    return tuple(np.quantile(values, PROBABILITIES).tolist()) if len(values) else None


def _cross(codes: AnyArray, groups: AnyArray, values: int) -> IntArray:
    """(values, groups without the total) counts."""
    counted = (codes >= 0) & (groups >= 0)
    keys = codes[counted] * np.int16(len(_PARTS)) + groups[counted]
    counts: IntArray = np.bincount(keys, minlength=values * len(_PARTS))
    return counts.reshape(values, len(_PARTS))


def _with_total(counts: IntArray) -> dict[str, int]:
    return {TOTAL: int(counts.sum()), **dict(zip(_PARTS, counts.tolist(), strict=True))}
