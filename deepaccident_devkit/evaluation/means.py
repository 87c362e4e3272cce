"""`MeansEvaluator`: tasks whose numbers are means, in tables; only what each sample adds to their sums is kept."""

from __future__ import annotations

import sys
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any, ClassVar, Final, Generic, Literal, NamedTuple, TypeVar

import numpy as np

from deepaccident_devkit.evaluation.evaluator import Counts, Evaluator, ratio
from deepaccident_devkit.evaluation.task import HEADLINE_UNITS, Row, TaskResult, Unit, plain, protocol_of
from deepaccident_devkit.support.arrays import BoolArray, FloatArray, IntArray
from deepaccident_devkit.support.text import natural_order

Numbers = Mapping[str, Mapping[str, Mapping[str, float]]]
Whole = Mapping[str, Mapping[str, Mapping[str, int]]]
SAMPLES: Final = "samples"
SCENARIO: Final = "scenario"
NAMES: Final = "names"
SUMS: Final = "sums"
COUNTS: Final = "counts"
NOTES: Final = "notes"
MEAN_OF_SCENARIOS: Final = "mean of scenarios"
"""The row with the mean of the scenarios' own means of the main row, for evaluators that ask for it."""
_PARTS: Final = 2.0**30
"""Of 1: sums have no finer numbers."""


class Column(NamedTuple):
    """A column of the tables.

    Attributes:
        unit: of its numbers.
        better: which numbers are better.
        is_headline: whether its numbers in the main row of the main tables are headlines.
    """

    unit: Unit
    better: Literal["higher", "lower", "neither"] = "lower"
    is_headline: bool = True


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class MeansResult(TaskResult):
    """Means of a number of samples.

    Attributes:
        samples: that were counted.
        means: table → row → column → mean; NaN where there is nothing to count.
        counted: table → row → column → of how many.
        notes: sentences on what was left out.
    """

    columns: ClassVar[Mapping[str, Column]] = {}
    main_tables: ClassVar[Sequence[str]] = ()
    main_row: ClassVar[str] = ""

    samples: int
    means: Numbers
    counted: Whole
    notes: tuple[str, ...]

    def __init_subclass__(cls) -> None:
        """Make headlines of the columns, and the units of all numbers known."""
        cls.rows = tuple(
            Row(f"means/{table}/{cls.main_row}/{name}", f"{name} {table}", each.unit, each.better)
            for name, each in cls.columns.items()
            for table in cls.main_tables
            if each.is_headline
        )
        super(MeansResult, cls).__init_subclass__()
        HEADLINE_UNITS.update({f"means/*/{name}": each.unit for name, each in cls.columns.items()})


Result = TypeVar("Result", bound=MeansResult)


class Sums:
    """What one sample adds: values by table, row and column.

    Values are rounded to multiples of 2⁻³⁰ (1e-9), so that sums below 8 million are exact, in any order.
    """

    def __init__(self) -> None:
        """Start with nothing."""
        self._sums: dict[str, list[float]] = {}
        self._notes: dict[str, int] = {}

    def add(self, table: str, row: str, column: str, values: float | Iterable[float]) -> None:
        """Add one value, or several; NaN are not counted."""
        given = np.array([values] if isinstance(values, int | float) else list(values), dtype=np.float64)
        self.add_rows(table, {row: np.ones(len(given), dtype=bool)}, {column: given})

    def add_rows(self, table: str, rows: Mapping[str, BoolArray], columns: Mapping[str, FloatArray]) -> None:
        """Add values (N,) of columns to each row, of which its mask (N,) has them; NaN are not counted."""
        values = np.stack([*columns.values()], axis=1)
        there = np.isfinite(values)
        masks = np.stack([*rows.values()]).astype(np.float64)
        sums, counts = masks @ np.where(there, _rounded(values), 0.0), masks @ there
        for row, *numbers in zip(rows, sums.tolist(), counts.tolist(), strict=True):
            for column, value, count in zip(columns, *numbers, strict=True):
                place = self._sums.setdefault(f"{table}/{row}/{column}", [0.0, 0])
                place[0] += value
                place[1] += int(count)

    def note(self, text: str, count: int = 1) -> None:
        """Say that something was left out, so many times; the text has {} for how many of all samples."""
        self._notes[text] = self._notes.get(text, 0) + count

    def counts(self, scenario: str | None = None) -> Counts:
        """As an evaluator keeps them; with a scenario's token, the row `MEAN_OF_SCENARIOS` has means of its means."""
        return _counts(self._sums, self._notes) | ({} if scenario is None else {SCENARIO: scenario})


class MeansEvaluator(Evaluator[Result], Generic[Result]):
    """Base of evaluators whose numbers are means; see the subclasses for what is counted."""

    result_class: type[Result]
    protocols: ClassVar[Mapping[str, Any]]
    order: ClassVar[Sequence[str]] = ()
    """Names of tables and rows that come before the others, in their order."""

    def __init__(self, protocol: Any = "") -> None:
        """Start without samples.

        Args:
            protocol: of `protocols` by name, the first if none is given, or your own.

        Raises:
            ChoiceError: no protocol has that name, or it is of another type.
        """
        super().__init__()
        kinds: Any = tuple({type(each) for each in self.protocols.values()})
        self.protocol = protocol_of(protocol or next(iter(self.protocols)), kinds, self.protocols)

    @property
    def settings(self) -> dict[str, Any]:
        """The protocol's choices."""
        choices: dict[str, Any] = plain(self.protocol)
        return choices

    def add(self, token: str, counts: Counts) -> None:
        """Take a sample's counts (`Evaluator.add`); of samples with the same names these are kept once."""
        super().add(token, {**counts, NAMES: sys.intern(counts[NAMES])})

    def pooled(self, counts: Collection[Counts]) -> Sequence[Counts]:
        """One set of counts: their sums."""
        by_scenario: dict[str | None, list[Counts]] = {}
        for each in counts:
            by_scenario.setdefault(each.get(SCENARIO), []).append(each)
        return [_pooled([self._of_scenario(name, _pooled(those)) for name, those in by_scenario.items()])]

    def _of_scenario(self, name: str | None, counts: Counts) -> Counts:
        """The sums of one scenario with its means."""
        if name is None:  # sums of several, which have the means
            return counts
        sums, end = _by_path(counts), f"/{self.result_class.main_row}/"
        means = {
            path.replace(end, f"/{MEAN_OF_SCENARIOS}/"): [
                float(_rounded(value / count)) if count else 0.0,
                min(count, 1),
            ]
            for path, (value, count) in sums.items()
            if end in path
        }
        return {**counts, **_counts(sums | means, counts[NOTES])}

    def drawn_numbers(self, parts: Sequence[Sequence[Counts]], times: IntArray, names: Sequence[str]) -> FloatArray:
        """The numbers of each draw (`Evaluator.drawn_numbers`): all sums are drawn at once."""
        pooled = [_by_path(self.pooled(part)[0]) for part in parts]
        paths = [name.removeprefix("means/") for name in names]
        given = np.array([[each.get(path, _NOTHING) for path in paths] for each in pooled])
        sums, counts = np.moveaxis(given.reshape(len(parts), len(paths), 2), -1, 0)
        drawn = times @ counts
        return np.where(drawn > 0, times @ sums / np.maximum(drawn, 1), np.nan)

    def result_of(self, counts: Collection[Counts]) -> Result:
        """The means over some samples, in any order."""
        (pooled,) = self.pooled(counts)
        sums = _by_path(pooled)
        means: dict[str, dict[str, dict[str, float]]] = {}
        numbers: dict[str, dict[str, dict[str, int]]] = {}
        for path in sorted(sums, key=self._place):
            table, row, column = path.split("/")
            value, count = sums[path]
            means.setdefault(table, {}).setdefault(row, {})[column] = ratio(value, count)
            numbers.setdefault(table, {}).setdefault(row, {})[column] = int(count)
        notes = tuple(text.format(f"{count:,}") for text, count in sorted(pooled[NOTES].items()))
        return self.result_class(samples=pooled[SAMPLES], means=means, counted=numbers, notes=notes)

    def _place(self, path: str) -> tuple[Any, ...]:
        """Where a number comes: by the given order, and columns by that of the result's."""
        *names, column = path.split("/")
        known = [self.order.index(name) if name in self.order else len(self.order) for name in names]
        columns = list(self.result_class.columns)
        return *((at, natural_order(name)) for at, name in zip(known, names, strict=True)), columns.index(column)


_NOTHING: Final = (0.0, 0)
_Paths = Mapping[str, Sequence[float]]
"""`table/row/column` → sum, and of how many."""


def _rounded(values: FloatArray | float) -> FloatArray:
    return np.asarray(np.rint(np.multiply(values, _PARTS)) / _PARTS)


def _counts(sums: _Paths, notes: Mapping[str, int]) -> dict[str, Any]:
    values, numbers = zip(*sums.values(), strict=True) if sums else ((), ())
    rows = [
        f"{row}/{','.join(path.rpartition('/')[2] for path in paths)}"
        for row, paths in groupby(sums, key=lambda path: path.rpartition("/")[0])
    ]
    return {NAMES: "\n".join(rows), SUMS: [*values], COUNTS: [*numbers], NOTES: dict(notes)}


def _by_path(counts: Counts) -> dict[str, Sequence[float]]:
    rows = (line.rpartition("/") for line in counts[NAMES].splitlines())
    names = [f"{row}/{column}" for row, _, columns in rows for column in columns.split(",")]
    return dict(zip(names, zip(counts[SUMS], counts[COUNTS], strict=True), strict=True))


def _pooled(counts: Collection[Counts]) -> Counts:
    alike: dict[str, list[Counts]] = {}
    sums: dict[str, list[float]] = {}
    notes: dict[str, int] = {}
    for each in counts:
        alike.setdefault(each[NAMES], []).append(each)
        for text, count in each[NOTES].items():
            notes[text] = notes.get(text, 0) + count
    for those in alike.values():  # few, of many samples
        totals = [np.sum([each[part] for each in those], axis=0).tolist() for part in (SUMS, COUNTS)]
        for path, value, count in zip(_by_path(those[0]), *totals, strict=True):
            place = sums.setdefault(path, [0.0, 0])
            place[0] += value
            place[1] += count
    return {SAMPLES: sum(each.get(SAMPLES, 1) for each in counts), **_counts(sums, notes)}
