"""`MeansEvaluator`, the base of tasks that report tables of means; only sums are stored."""

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
from deepaccident_devkit.support.values import NamedValues

MEAN_OF_SCENARIOS: Final = "mean of scenarios"
"""Name of the row that averages each scenario's mean in the main row over scenarios."""
# Values are rounded to multiples of one over this number, so that sums are exact.
_STEPS_PER_UNIT = 2.0**30
# Beginning of the path of a column's row.
_ANY_CELL = "means/*/*/"


def table_rows(
    columns: Sequence[Row], main_tables: Sequence[str], main_row: str
) -> tuple[Row, ...]:
    """Build the descriptions of a result's numbers: first headlines, then one per column.

    Args:
        columns: One description per column of the tables, whose path is the name of the column.
        main_tables: Names of the tables that contain the headlines.
        main_row: Name of the row of these tables that contains the headlines.
    """
    headline_rows = []
    column_rows = []
    for column in columns:
        column_path = _ANY_CELL + column.path
        column_rows.append(replace(column, path=column_path, is_headline=False))
        if not column.is_headline:
            continue
        for table in main_tables:
            path = f"means/{table}/{main_row}/{column.path}"
            headline_rows.append(replace(column, path=path, name=f"{column.path} {table}"))
    return (*headline_rows, *column_rows)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class MeansResult(TaskResult):
    """Tables of means over samples; `table_rows` builds the `rows` of a subclass.

    Attributes:
        samples: Number of counted samples.
        means: Table → row → column → mean; NaN if there is nothing to count.
        counted: Table → row → column → number of averaged values.
        notes: Sentences that say what was left out.
    """

    samples: int
    means: Mapping[str, Mapping[str, Mapping[str, float]]]
    counted: Mapping[str, Mapping[str, Mapping[str, int]]]
    notes: tuple[str, ...]


_Result = TypeVar("_Result", bound=MeansResult)


class Sums:
    """Sums of the values of one sample, by table, row and column.

    Values are rounded to multiples of 2⁻³⁰ (1e-9), so that sums below 8 million are exact in any
    order.
    """

    def __init__(self) -> None:
        """Create sums without values."""
        self._numbers: dict[str, FloatArray] = {}
        self._notes: Counter[str] = Counter()

    def add(self, table: str, row: str, column: str, value: float) -> None:
        """Add one value; NaN is ignored."""
        mask = np.ones(1, dtype=bool)
        values = np.array([value])
        self.add_rows(table, {row: mask}, {column: values})

    def add_rows(
        self, table: str, rows: Mapping[str, BoolArray], columns: Mapping[str, FloatArray]
    ) -> None:
        """Add values of columns to rows; NaN is ignored.

        Args:
            table: Name of the table.
            rows: Name of a row → mask (N,) of the values that belong to the row.
            columns: Name of a column → values (N,).
        """
        values = np.stack([*columns.values()], axis=1)
        masks = np.stack([*rows.values()]).astype(np.float64)
        is_known = np.isfinite(values)
        known_values = np.where(is_known, _round_values(values), 0.0)
        sums = masks @ known_values
        counts = masks @ is_known
        terms = np.stack([sums, counts], axis=-1).reshape(-1, 2)
        for (row, column), term in zip(product(rows, columns), terms, strict=True):
            path = f"{table}/{row}/{column}"
            self._numbers[path] = self._numbers.get(path, 0.0) + term

    def note(self, text: str, count: float = 1) -> None:
        """Add a note that states a number of things, unless the number is 0.

        Args:
            text: Sentence in which `{plan}` becomes `2 plans` for a total of 2 over all samples.
            count: Number of things in this sample.
        """
        if count:
            self._notes[text] += int(count)

    def counts(self, scenario: str | None = None) -> Counts:
        """Convert the sums to counts for an evaluator.

        Args:
            scenario: Token of the scenario, for evaluators whose tables contain the row
                `MEAN_OF_SCENARIOS`; None for other evaluators.
        """
        counts = _make_counts(self._numbers, self._notes)
        if scenario is not None:
            counts["scenario"] = scenario
        return counts


class MeansEvaluator(Evaluator[_Result], Generic[_Result]):
    """Base of evaluators that report means; subclasses define what is counted."""

    order: ClassVar[Sequence[str]] = ()
    """Names of the tables and rows that come first, in this order."""
    main_row: ClassVar[str] = ""
    """Name of the row from which `MEAN_OF_SCENARIOS` is computed."""

    def add(self, token: str, counts: Counts) -> None:
        """Add a sample's counts (`Evaluator.add`).

        Samples whose numbers have the same names share the strings, which saves memory.
        """
        names = counts.get("names")
        if not (isinstance(names, str) and names.replace("\n", "").isprintable()):
            raise EvaluationError(
                f"{token}: expected counts with the names of their numbers; evaluate again"
            )
        super().add(token, {**counts, "names": sys.intern(names)})

    def pooled(self, counts: Collection[Counts]) -> Sequence[Counts]:
        """Sum all counts; the list has a single entry."""
        samples_by_scenario: dict[str | None, list[Counts]] = {}
        for sample in counts:
            samples_by_scenario.setdefault(sample.get("scenario"), []).append(sample)
        scenario_sums = []
        for scenario, samples in samples_by_scenario.items():
            sums = _sum_counts(samples)
            if scenario is not None:
                sums = self._add_scenario_means(sums)
            scenario_sums.append(sums)
        return [_sum_counts(scenario_sums)]

    def _add_scenario_means(self, sums: Counts) -> Counts:
        """Add a scenario's means, as further terms, to the scenario's sums."""
        main = f"/{self.main_row}/"
        terms = _terms_by_path(sums)
        means = {}
        for path, (total, count) in terms.items():
            if main in path:
                mean = _round_values(total / max(count, 1.0))
                mean_path = path.replace(main, f"/{MEAN_OF_SCENARIOS}/")
                means[mean_path] = np.array([mean, min(count, 1.0)])
        return {**sums, **_make_counts(terms | means, sums["notes"])}

    def drawn_numbers(
        self, parts: Sequence[Sequence[Counts]], times: IntArray, names: Sequence[str]
    ) -> FloatArray:
        """Compute the numbers of each draw (`Evaluator.drawn_numbers`).

        The sums of all draws are computed at once.
        """
        paths = [name.removeprefix("means/") for name in names]
        rows = []
        for part in parts:
            (pooled,) = self.pooled(part)
            terms = _terms_by_path(pooled)
            rows.append([terms.get(path, np.zeros(2)) for path in paths])
        part_terms = np.array(rows).reshape(len(parts), len(names), 2)
        sums = times @ part_terms[..., 0]
        counts = times @ part_terms[..., 1]
        return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)

    def result_of(self, counts: Collection[Counts]) -> _Result:
        """Compute the means from the counts of samples, in any order."""
        (pooled,) = self.pooled(counts)
        means: dict[str, dict[str, dict[str, float]]] = {}
        counted: dict[str, dict[str, dict[str, int]]] = {}
        columns = []
        for row_description in self.result_class.rows:
            if row_description.path.startswith(_ANY_CELL):
                columns.append(row_description.path.removeprefix(_ANY_CELL))
        terms = _terms_by_path(pooled)
        for path in sorted(terms, key=lambda path: self._sort_key(path, columns)):
            total, count = terms[path].tolist()
            table, row, column = path.split("/")
            mean_by_column = means.setdefault(table, {}).setdefault(row, {})
            mean_by_column[column] = ratio(total, count)
            count_by_column = counted.setdefault(table, {}).setdefault(row, {})
            count_by_column[column] = int(count)
        notes = [_fill_note(text, count) for text, count in sorted(pooled["notes"].items())]
        result: _Result = self.result_class(
            samples=pooled["samples"], means=means, counted=counted, notes=tuple(notes)
        )
        return result

    def _sort_key(self, path: str, columns: Sequence[str]) -> tuple[Any, ...]:
        """Return the sort key of a number: tables and rows follow `order`, columns `columns`.

        Raise ValueError if the column is unknown.
        """
        *names, column = path.split("/")
        keys = []
        for name in names:
            rank = self.order.index(name) if name in self.order else len(self.order)
            keys.append((rank, natural_order(name)))
        return *keys, columns.index(column)


def _fill_note(text: str, count: int) -> str:
    """Replace the nouns in braces in a note by a number and the noun."""

    def count_noun(match: re.Match[str]) -> str:
        return counted(count, match[1])

    return re.sub(r"\{([^{}]+)\}", count_noun, text)


def _round_values(values: FloatArray | float) -> FloatArray:
    """Round values to multiples of 1 / `_STEPS_PER_UNIT`."""
    steps = np.rint(np.multiply(values, _STEPS_PER_UNIT))
    return np.asarray(steps / _STEPS_PER_UNIT)


def _make_counts(terms: Mapping[str, FloatArray], notes: Mapping[str, int]) -> NamedValues:
    """Build counts as JSON-compatible values.

    Args:
        terms: Path `table/row/column` → sum and number of values, shape (2,).
        notes: Sentence → number of things.
    """
    return {
        "names": "\n".join(terms),
        "numbers": [term.tolist() for term in terms.values()],
        "notes": dict(notes),
    }


def _terms_by_path(counts: Counts) -> dict[str, FloatArray]:
    """Return sum and number of values for each path; the inverse of `_make_counts`."""
    paths = filter(None, counts["names"].split("\n"))
    return dict(zip(paths, np.array(counts["numbers"]), strict=True))


def _sum_counts(counts: Collection[Counts]) -> Counts:
    """Add up counts: terms, notes and numbers of samples."""
    samples_by_names: dict[str, list[Counts]] = {}
    terms: dict[str, FloatArray] = {}
    notes: Counter[str] = Counter()
    for sample in counts:
        samples_by_names.setdefault(sample["names"], []).append(sample)
        notes.update(sample["notes"])
    # fast, since most samples have the same names
    for samples in samples_by_names.values():
        numbers = np.sum([sample["numbers"] for sample in samples], axis=0)
        group_sums = {**samples[0], "numbers": numbers}
        for path, term in _terms_by_path(group_sums).items():
            terms[path] = terms.get(path, 0.0) + term
    sample_count = sum(sample.get("samples", 1) for sample in counts)
    return {"samples": sample_count, **_make_counts(terms, notes)}
