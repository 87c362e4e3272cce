"""`MeansEvaluator`: tasks whose numbers are means, in tables; only what each sample adds to their sums is kept."""

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
"""The row with the mean of the scenarios' own means of the main row, for evaluators that ask for it."""
# Of 1: sums have no finer numbers.
_PARTS: Final = 2.0**30


# Beginning of the path of a column's row.
_ANY_CELL: Final = "means/*/*/"


def table_rows(
    columns: Sequence[Row], main_tables: Sequence[str], main_row: str
) -> tuple[Row, ...]:
    """Return the rows of a result's tables: first the headlines by column, then one row for each column.

    Args:
        columns: One row for each column of the tables, with the column's name as its path.
        main_tables: Tables whose numbers in `main_row` are headlines, unless their column says otherwise.
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
        samples: that were counted.
        means: table → row → column → mean; NaN where there is nothing to count.
        counted: table → row → column → of how many.
        notes: sentences on what was left out.
    """

    samples: int
    means: Mapping[str, Mapping[str, Mapping[str, float]]]
    counted: Mapping[str, Mapping[str, Mapping[str, int]]]
    notes: tuple[str, ...]


_Result = TypeVar("_Result", bound=MeansResult)


class Sums:
    """What one sample adds: values by table, row and column.

    Values are rounded to multiples of 2⁻³⁰ (1e-9), so that sums below 8 million are exact, in any order.
    """

    def __init__(self) -> None:
        """Start with nothing."""
        self._numbers: dict[str, FloatArray] = {}
        self._notes: Counter[str] = Counter()

    def add(self, table: str, row: str, column: str, value: float) -> None:
        """Add one value; NaN is not counted."""
        self.add_rows(table, {row: np.ones(1, dtype=bool)}, {column: np.array([value])})

    def add_rows(
        self, table: str, rows: Mapping[str, BoolArray], columns: Mapping[str, FloatArray]
    ) -> None:
        """Add values (N,) of columns to each row, of which its mask (N,) has them; NaN are not counted."""
        values, masks = (
            np.stack([*columns.values()], axis=1),
            np.stack([*rows.values()]).astype(np.float64),
        )
        there = np.isfinite(values)
        numbers = np.stack(
            [masks @ np.where(there, _rounded(values), 0.0), masks @ there], axis=-1
        ).reshape(-1, 2)
        for name, number in zip(product(rows, columns), numbers, strict=True):
            path = "/".join((table, *name))
            self._numbers[path] = self._numbers.get(path, 0.0) + number

    def note(self, text: str, count: float = 1) -> None:
        """Say something of a number of things, if there are any: `{plan}` becomes `2 plans`, those of all samples."""
        if count:
            self._notes[text] += int(count)

    def counts(self, scenario: str | None = None) -> Counts:
        """As an evaluator keeps them; with a scenario's token, the row `MEAN_OF_SCENARIOS` has means of its means."""
        return _counts(self._numbers, self._notes) | (
            {} if scenario is None else {"scenario": scenario}
        )


class MeansEvaluator(Evaluator[_Result], Generic[_Result]):
    """Base of evaluators whose numbers are means; see the subclasses for what is counted."""

    order: ClassVar[Sequence[str]] = ()
    """Names of tables and rows that come before the others, in their order."""
    main_row: ClassVar[str] = ""
    """Row that `MEAN_OF_SCENARIOS` is made from."""

    def add(self, token: str, counts: Counts) -> None:
        """Take a sample's counts (`Evaluator.add`); of samples with the same names these are kept once."""
        names = counts.get("names")
        if not (isinstance(names, str) and names.replace("\n", "").isprintable()):
            raise EvaluationError(
                f"{token}: expected counts with the names of their numbers; evaluate again"
            )
        super().add(token, {**counts, "names": sys.intern(names)})

    def pooled(self, counts: Collection[Counts]) -> Sequence[Counts]:
        """One set of counts: their sums."""
        by_scenario: dict[str | None, list[Counts]] = {}
        for each in counts:
            by_scenario.setdefault(each.get("scenario"), []).append(each)
        parts = [
            _pooled(those) if name is None else self._of_scenario(those)
            for name, those in by_scenario.items()
        ]
        return [_pooled(parts)]

    def _of_scenario(self, counts: Collection[Counts]) -> Counts:
        """The sums of one scenario with its means."""
        whole, main = _pooled(counts), f"/{self.main_row}/"
        numbers = _by_path(whole)
        means = {
            path.replace(main, f"/{MEAN_OF_SCENARIOS}/"): np.array(
                [_rounded(value / max(count, 1.0)), min(count, 1.0)]
            )
            for path, (value, count) in numbers.items()
            if main in path
        }
        return {**whole, **_counts(numbers | means, whole["notes"])}

    def drawn_numbers(
        self, parts: Sequence[Sequence[Counts]], times: IntArray, names: Sequence[str]
    ) -> FloatArray:
        """The numbers of each draw (`Evaluator.drawn_numbers`): all sums are drawn at once."""
        pooled = [_by_path(self.pooled(part)[0]) for part in parts]
        given = np.array(
            [
                [each.get(name.removeprefix("means/"), np.zeros(2)) for name in names]
                for each in pooled
            ]
        )
        sums, counts = (
            times @ each for each in np.moveaxis(given.reshape(len(parts), len(names), 2), -1, 0)
        )
        return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)

    def result_of(self, counts: Collection[Counts]) -> _Result:
        """The means over some samples, in any order."""
        (pooled,) = self.pooled(counts)
        means: dict[str, dict[str, dict[str, float]]] = {}
        counted: dict[str, dict[str, dict[str, int]]] = {}
        columns = [
            row.path.removeprefix(_ANY_CELL)
            for row in self.result_class.rows
            if row.path.startswith(_ANY_CELL)
        ]
        for path, (value, count) in sorted(
            _by_path(pooled).items(), key=lambda item: self._place(item[0], columns)
        ):
            table, row, column = path.split("/")
            means.setdefault(table, {}).setdefault(row, {})[column] = ratio(
                float(value), float(count)
            )
            counted.setdefault(table, {}).setdefault(row, {})[column] = int(count)
        notes = tuple(_note_text(text, count) for text, count in sorted(pooled["notes"].items()))
        result: _Result = self.result_class(
            samples=pooled["samples"], means=means, counted=counted, notes=notes
        )
        return result

    def _place(self, path: str, columns: Sequence[str]) -> tuple[Any, ...]:
        """Return the sort key of a number: `order` for tables and rows, `columns` for columns; raises ValueError."""
        *names, column = path.split("/")
        places = [
            self.order.index(name) if name in self.order else len(self.order) for name in names
        ]
        keys = [(place, natural_order(name)) for place, name in zip(places, names, strict=True)]
        return *keys, columns.index(column)


def _note_text(text: str, count: int) -> str:
    """Put a number and its noun into a note, where the noun stands in braces."""
    return re.sub(r"\{([^{}]+)\}", lambda noun: counted(count, noun[1]), text)


def _rounded(values: FloatArray | float) -> FloatArray:
    return np.asarray(np.rint(np.multiply(values, _PARTS)) / _PARTS)


def _counts(numbers: Mapping[str, FloatArray], notes: Mapping[str, int]) -> dict[str, Any]:
    """Paths `table/row/column` with the sum and of how many (2,), as JSON holds them."""
    return {
        "names": "\n".join(numbers),
        "numbers": [each.tolist() for each in numbers.values()],
        "notes": dict(notes),
    }


def _by_path(counts: Counts) -> dict[str, FloatArray]:
    return dict(
        zip(filter(None, counts["names"].split("\n")), np.array(counts["numbers"]), strict=True)
    )


def _pooled(counts: Collection[Counts]) -> Counts:
    alike: dict[str, list[Counts]] = {}
    numbers: dict[str, FloatArray] = {}
    notes: Counter[str] = Counter()
    for each in counts:
        alike.setdefault(each["names"], []).append(each)
        notes.update(each["notes"])
    for those in alike.values():  # few, of many samples
        total = np.sum([each["numbers"] for each in those], axis=0)
        for path, number in _by_path({**those[0], "numbers": total}).items():
            numbers[path] = numbers.get(path, 0.0) + number
    return {"samples": sum(each.get("samples", 1) for each in counts), **_counts(numbers, notes)}
