"""`MeansEvaluator`: tasks whose numbers are means, in tables: what each sample adds to their sums is all that is kept."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, ClassVar, Final, Generic, Literal, NamedTuple, TypeVar

from deepaccident_devkit.evaluation.evaluator import Counts, Evaluator, ratio
from deepaccident_devkit.evaluation.task import HEADLINE_UNITS, Row, TaskResult, Unit, protocol_of
from deepaccident_devkit.support.text import natural_order

Numbers = Mapping[str, Mapping[str, Mapping[str, float]]]
Whole = Mapping[str, Mapping[str, Mapping[str, int]]]
SAMPLES: Final = "samples"
SUMS: Final = "sums"
NOTES: Final = "notes"


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
    """What one sample adds: values by table, row and column."""

    def __init__(self) -> None:
        """Start with nothing."""
        self._sums: dict[str, list[float]] = {}
        self._notes: dict[str, int] = {}

    def add(self, table: str, row: str, column: str, values: float | Iterable[float]) -> None:
        """Add one value, or several; NaN are not counted."""
        given = [values] if isinstance(values, int | float) else values
        there = [float(value) for value in given if not math.isnan(value)]
        place = self._sums.setdefault(f"{table}/{row}/{column}", [0.0, 0])
        place[0] += math.fsum(there)
        place[1] += len(there)

    def note(self, text: str, count: int = 1) -> None:
        """Say that something was left out, so many times; the text has {} for how many of all samples."""
        self._notes[text] = self._notes.get(text, 0) + count

    def counts(self) -> Counts:
        """As an evaluator keeps them."""
        return {SUMS: self._sums, NOTES: self._notes}


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
        return asdict(self.protocol)

    def pooled(self, counts: Collection[Counts]) -> Sequence[Counts]:
        """One set of counts: their sums."""
        return [_pooled(counts)]

    def result_of(self, counts: Collection[Counts]) -> Result:
        """The means over some samples, in any order."""
        pooled = _pooled(counts)
        means: dict[str, dict[str, dict[str, float]]] = {}
        numbers: dict[str, dict[str, dict[str, int]]] = {}
        for path in sorted(pooled[SUMS], key=self._place):
            table, row, column = path.split("/")
            value, count = pooled[SUMS][path]
            means.setdefault(table, {}).setdefault(row, {})[column] = ratio(value, count)
            numbers.setdefault(table, {}).setdefault(row, {})[column] = count
        notes = tuple(text.format(f"{count:,}") for text, count in sorted(pooled[NOTES].items()))
        return self.result_class(samples=pooled[SAMPLES], means=means, counted=numbers, notes=notes)

    def _place(self, path: str) -> tuple[Any, ...]:
        """Where a number comes: by the given order, and columns by that of the result's."""
        *names, column = path.split("/")
        known = [self.order.index(name) if name in self.order else len(self.order) for name in names]
        columns = list(self.result_class.columns)
        return *((at, natural_order(name)) for at, name in zip(known, names, strict=True)), columns.index(column)


def _pooled(counts: Collection[Counts]) -> dict[str, Any]:
    sums: dict[str, tuple[list[float], list[int]]] = {}
    notes: dict[str, int] = {}
    for each in counts:
        for path, (value, count) in each[SUMS].items():
            values, numbers = sums.setdefault(path, ([], []))
            values.append(value)
            numbers.append(count)
        for text, count in each[NOTES].items():
            notes[text] = notes.get(text, 0) + count
    return {
        SAMPLES: sum(each.get(SAMPLES, 1) for each in counts),
        SUMS: {path: [math.fsum(values), sum(numbers)] for path, (values, numbers) in sums.items()},
        NOTES: notes,
    }
