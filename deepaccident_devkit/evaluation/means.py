"""`MeansEvaluator`: tasks with means as numbers, in tables; only the terms of sums are stored."""

from __future__ import annotations

import re
import sys
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, ClassVar, Final, Generic, TypeVar

import numpy as np

from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.evaluator import Counts, Evaluator, ratio
from deepaccident_devkit.evaluation.task import Row, TaskResult
from deepaccident_devkit.support.arrays import BoolArray, FloatArray, IntArray
from deepaccident_devkit.support.text import counted, natural_order

MEAN_OF_SCENARIOS: Final = "mean of scenarios"
"""The row with the mean of the scenarios' own means of the main row, for evaluators that ask for
it."""
# Number of steps from 0 to 1 to which values are rounded, so that sums are exact.
_STEPS_PER_UNIT: Final = 2.0**30
# Beginning of the path of a column's row.
_ANY_CELL: Final = "means/*/*/"


def table_rows(
    columns: Sequence[Row], main_tables: Sequence[str], main_row: str
) -> tuple[Row, ...]:
    """Return the rows of a result's tables: the headlines by column, then one row for each column.

    Args:
        columns: One row for each column of the tables, with the column's name as its path.
        main_tables: Tables with headlines in `main_row`, except for columns that are not
            headlines.
        main_row: Row of the tables.
    """
    numbers = [
        replace(column, path=_ANY_CELL + column.path, is_headline=False) for column in columns
    ]
    headline_columns = [column for column in columns if column.is_headline]
    headline_rows = [
        replace(
            column, path=f"means/{table}/{main_row}/{column.path}", name=f"{column.path} {table}"
        )
        for column in headline_columns
        for table in main_tables
    ]
    return (*headline_rows, *numbers)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class MeansResult(TaskResult):
    """Means of a number of samples; `table_rows` makes the `rows` of a subclass.

    Attributes:
        samples: Number of samples that were counted.
        means: Table → row → column → mean; NaN where there is nothing to count.
        counted: Table → row → column → number of values in the mean.
        notes: Sentences on what was left out.
    """

    samples: int
    means: Mapping[str, Mapping[str, Mapping[str, float]]]
    counted: Mapping[str, Mapping[str, Mapping[str, int]]]
    notes: tuple[str, ...]


_Result = TypeVar("_Result", bound=MeansResult)


class Sums:
    """What one sample adds: values by table, row and column.

    Values are rounded to multiples of 2⁻³⁰ (1e-9), so that sums below 8 million are exact, in any
    order.
    """

    def __init__(self) -> None:
        """Start with nothing."""
        self._numbers: dict[str, FloatArray] = {}
        self._notes: Counter[str] = Counter()

    def add(self, table: str, row: str, column: str, value: float) -> None:
        """Add one value; NaN is not counted."""
        mask = np.ones(1, dtype=bool)
        values = np.array([value])
        self.add_rows(table, {row: mask}, {column: values})

    def add_rows(
        self, table: str, rows: Mapping[str, BoolArray], columns: Mapping[str, FloatArray]
    ) -> None:
        """Add values of columns to rows; NaN is not counted.

        Args:
            table: Name of the table.
            rows: Name of a row → mask (N,) of the values that it has.
            columns: Name of a column → values (N,).
        """
        values = np.stack([*columns.values()], axis=1)
        masks = np.stack([*rows.values()]).astype(np.float64)
        is_known = np.isfinite(values)
        sums = masks @ np.where(is_known, _rounded(values), 0.0)
        numbers = np.stack([sums, masks @ is_known], axis=-1).reshape(-1, 2)
        for (row, column), number in zip(product(rows, columns), numbers, strict=True):
            path = f"{table}/{row}/{column}"
            self._numbers[path] = self._numbers.get(path, 0.0) + number

    def note(self, text: str, count: float = 1) -> None:
        """Note a sentence on a number of things, if there are any.

        Args:
            text: Sentence in which `{plan}` becomes `2 plans`, the number over all samples.
            count: Number of things in this sample.
        """
        if count:
            self._notes[text] += int(count)

    def counts(self, scenario: str | None = None) -> Counts:
        """Return the counts for an evaluator.

        Args:
            scenario: Token; with it the row `MEAN_OF_SCENARIOS` has means of the scenario's means.
        """
        counts = _counts(self._numbers, self._notes)
        if scenario is not None:
            counts["scenario"] = scenario
        return counts


class MeansEvaluator(Evaluator[_Result], Generic[_Result]):
    """Base of evaluators with means as numbers; see the subclasses for what is counted."""

    order: ClassVar[Sequence[str]] = ()
    """Names of tables and rows that come before the others, in their order."""
    main_row: ClassVar[str] = ""
    """Row that `MEAN_OF_SCENARIOS` is made from."""

    def add(self, token: str, counts: Counts) -> None:
        """Take a sample's counts (`Evaluator.add`).

        Samples with the same names of numbers share one string of them.
        """
        names = counts.get("names")
        if not (isinstance(names, str) and names.replace("\n", "").isprintable()):
            raise EvaluationError(
                f"{token}: expected counts with the names of their numbers; evaluate again"
            )
        super().add(token, {**counts, "names": sys.intern(names)})

    def pooled(self, counts: Collection[Counts]) -> Sequence[Counts]:
        """Return one set of counts: their sums."""
        by_scenario: dict[str | None, list[Counts]] = {}
        for sample in counts:
            by_scenario.setdefault(sample.get("scenario"), []).append(sample)
        parts = []
        for scenario, samples in by_scenario.items():
            if scenario is None:
                parts.append(_pooled(samples))
            else:
                parts.append(self._of_scenario(samples))
        return [_pooled(parts)]

    def _of_scenario(self, counts: Collection[Counts]) -> Counts:
        """Return the sums of one scenario with its means."""
        pooled = _pooled(counts)
        main = f"/{self.main_row}/"
        numbers = _by_path(pooled)
        means = {}
        for path, (value, count) in numbers.items():
            if main in path:
                mean = _rounded(value / max(count, 1.0))
                mean_path = path.replace(main, f"/{MEAN_OF_SCENARIOS}/")
                means[mean_path] = np.array([mean, min(count, 1.0)])
        return {**pooled, **_counts(numbers | means, pooled["notes"])}

    def drawn_numbers(
        self, parts: Sequence[Sequence[Counts]], times: IntArray, names: Sequence[str]
    ) -> FloatArray:
        """Return the numbers of each draw (`Evaluator.drawn_numbers`).

        All sums are drawn at once.
        """
        paths = [name.removeprefix("means/") for name in names]
        rows = []
        for part in parts:
            numbers = _by_path(self.pooled(part)[0])
            rows.append([numbers.get(path, np.zeros(2)) for path in paths])
        values = np.array(rows).reshape(len(parts), len(names), 2)
        sums = times @ values[..., 0]
        counts = times @ values[..., 1]
        return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)

    def result_of(self, counts: Collection[Counts]) -> _Result:
        """Return the means over some samples, in any order."""
        (pooled,) = self.pooled(counts)
        means: dict[str, dict[str, dict[str, float]]] = {}
        counted: dict[str, dict[str, dict[str, int]]] = {}
        columns = []
        for row_description in self.result_class.rows:
            if row_description.path.startswith(_ANY_CELL):
                columns.append(row_description.path.removeprefix(_ANY_CELL))
        numbers = _by_path(pooled)
        for path in sorted(numbers, key=lambda path: self._sort_key(path, columns)):
            value, count = numbers[path]
            table, row, column = path.split("/")
            mean = ratio(float(value), float(count))
            means.setdefault(table, {}).setdefault(row, {})[column] = mean
            counted.setdefault(table, {}).setdefault(row, {})[column] = int(count)
        notes = tuple(_note_text(text, count) for text, count in sorted(pooled["notes"].items()))
        result: _Result = self.result_class(
            samples=pooled["samples"], means=means, counted=counted, notes=notes
        )
        return result

    def _sort_key(self, path: str, columns: Sequence[str]) -> tuple[Any, ...]:
        """Return the sort key of a number: `order` for tables and rows, `columns` for columns.

        Raises ValueError for an unknown column.
        """
        *names, column = path.split("/")
        keys = []
        for name in names:
            rank = self.order.index(name) if name in self.order else len(self.order)
            keys.append((rank, natural_order(name)))
        return *keys, columns.index(column)


def _note_text(text: str, count: int) -> str:
    """Put a number and its noun into a note, where the noun stands in braces."""
    return re.sub(r"\{([^{}]+)\}", lambda noun: counted(count, noun[1]), text)


def _rounded(values: FloatArray | float) -> FloatArray:
    """Return values rounded to multiples of 1 / `_STEPS_PER_UNIT`."""
    steps = np.rint(np.multiply(values, _STEPS_PER_UNIT))
    return np.asarray(steps / _STEPS_PER_UNIT)


def _counts(numbers: Mapping[str, FloatArray], notes: Mapping[str, int]) -> dict[str, Any]:
    """Return sums by path `table/row/column`, as JSON holds them.

    Args:
        numbers: Path → sum and number of values, shape (2,).
        notes: Sentence → number of things.
    """
    return {
        "names": "\n".join(numbers),
        "numbers": [number.tolist() for number in numbers.values()],
        "notes": dict(notes),
    }


def _by_path(counts: Counts) -> dict[str, FloatArray]:
    """Return the sums of counts by path; the inverse of `_counts`."""
    paths = filter(None, counts["names"].split("\n"))
    return dict(zip(paths, np.array(counts["numbers"]), strict=True))


def _pooled(counts: Collection[Counts]) -> Counts:
    """Return the sums of counts."""
    by_names: dict[str, list[Counts]] = {}
    numbers: dict[str, FloatArray] = {}
    notes: Counter[str] = Counter()
    for sample in counts:
        by_names.setdefault(sample["names"], []).append(sample)
        notes.update(sample["notes"])
    # many samples have few different names
    for samples in by_names.values():
        total = np.sum([sample["numbers"] for sample in samples], axis=0)
        for path, number in _by_path({**samples[0], "numbers": total}).items():
            numbers[path] = numbers.get(path, 0.0) + number
    sample_count = sum(sample.get("samples", 1) for sample in counts)
    return {"samples": sample_count, **_counts(numbers, notes)}
