"""Lists of entries by sample, which accident and detection results consist of, as columns over all entries.

A check of many entries says whether all are good; of one entry it says what is wrong. `read_entries` finds that one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from deepaccident_devkit.arrays import AnyArray, FloatArray, IntArray
from deepaccident_devkit.evaluation.results.faults import ContentError, at, shown
from deepaccident_devkit.evaluation.results.header import check_fields, check_token

Entry = Mapping[str, Any]
Columns = Mapping[str, AnyArray]
ReadColumns = Callable[[Sequence[Entry], Sequence[str]], Columns]
"""Makes columns of N entries, from these and their samples' tokens; its ContentError says what is wrong with a single
one.
"""
_NUMBERS: Final = {int, float}
"""Python's types of JSON numbers; `bool` is another."""
LARGEST: Final = 1e6
"""Metres, seconds, metres a second: larger numbers are mistakes, and squares of the largest floats overflow."""
FROM_ZERO: Final = (0.0, LARGEST)
ANY_NUMBER: Final = (-np.inf, np.inf)


@dataclass(frozen=True, slots=True, eq=False)
class Entries:
    """All entries of a results file.

    Attributes:
        number: token → number of the sample, in the file's order; S of them.
        first: (S + 1,) row of each sample's first entry, and the number of entries, N.
        columns: field → (N, …).
    """

    number: Mapping[str, int]
    first: IntArray
    columns: Columns

    def of(self, token: str) -> dict[str, AnyArray]:
        """The columns of a sample's entries; KeyError for a sample that is not here."""
        number = self.number[token]
        rows = slice(self.first[number], self.first[number + 1])
        return {name: column[rows] for name, column in self.columns.items()}


def read_entries(results: object, read: ReadColumns) -> Entries:
    """The entries under `results`.

    Raises:
        ContentError: names the token, the number of the entry (from 0), and the field.
    """
    if not isinstance(results, dict):
        raise ContentError(f"results: expected an object, sample token to list of entries, found {shown(results)}")
    if not results:
        raise ContentError("results: holds no sample; a sample without anything predicted has []")
    for token, given in results.items():
        with at("results"):
            check_token(token)
        if not isinstance(given, list):
            raise ContentError(f"results: {token}: expected a list of entries, [] for none, found {shown(given)}")
    lengths = [len(given) for given in results.values()]
    entries = list(chain.from_iterable(results.values()))
    owners = list(chain.from_iterable([token] * length for token, length in zip(results, lengths, strict=True)))
    try:
        columns = read(entries, owners)
    except ContentError:
        _tell_first_wrong(entries, owners, read)
        raise
    return Entries(
        MappingProxyType({token: number for number, token in enumerate(results)}),
        np.concatenate([[0], np.cumsum(lengths)]),
        MappingProxyType(dict(columns)),
    )


def check_entries(entries: Sequence[object], required: Sequence[str], optional: Sequence[str]) -> None:
    """Whether all entries are objects that have the required fields, and others only if they are optional.

    Raises:
        ContentError: says what is wrong with the first entry.
    """
    if set(map(type, entries)) - {dict}:
        raise ContentError(f"expected an object, found {shown(entries[0])}")
    layouts: set[tuple[str, ...]] = set(map(tuple, entries))  # type: ignore[arg-type]  # these are objects
    for names in layouts:
        check_fields(dict.fromkeys(names), required, optional)


def numbers(
    entries: Sequence[Entry],
    name: str,
    shape: tuple[int, ...],
    expected: str,
    limits: tuple[float, float] = (-LARGEST, LARGEST),
) -> FloatArray:
    """(N, *shape) float64 of lists in lists of numbers.

    Args:
        entries: N of them, which have the field.
        name: of the field.
        shape: lengths of the lists, outermost first; () for a number.
        expected: what the field should be, for the error.
        limits: the least and the most that a number may be.

    Raises:
        ContentError: says what the first entry has and what was expected.
    """
    flat = _flat([entry[name] for entry in entries], shape)
    if flat is not None and not set(map(type, flat)) - _NUMBERS:
        try:
            array = np.array(flat, dtype=np.float64).reshape(len(entries), *shape)
        except OverflowError:
            array = np.array([np.inf])
        if np.isfinite(array).all() and ((array >= limits[0]) & (array <= limits[1])).all():
            return array
    raise _unexpected(entries, name, expected)


def whole_numbers(entries: Sequence[Entry], name: str, shape: tuple[int, ...], expected: str) -> IntArray:
    """(N, *shape) int64, likewise; raises ContentError."""
    flat = _flat([entry[name] for entry in entries], shape)
    if flat is not None and not set(map(type, flat)) - {int}:
        try:
            return np.array(flat, dtype=np.int64).reshape(len(entries), *shape)
        except OverflowError:
            pass
    raise _unexpected(entries, name, expected)


def choices(entries: Sequence[Entry], name: str, possible: Sequence[str]) -> AnyArray:
    """(N,) int8, which of the possible texts each entry has; raises ContentError."""
    values = [entry[name] for entry in entries]
    if set(map(type, values)) - {str} or set(values) - set(possible):
        raise _unexpected(entries, name, f"one of {', '.join(possible)}")
    code = {text: number for number, text in enumerate(possible)}
    return np.array([code[value] for value in values], dtype=np.int8)


def with_value(entries: Sequence[Entry], name: str) -> tuple[IntArray, list[Entry]]:
    """The entries that have an optional field that is not null: their rows, and themselves."""
    rows = [row for row, entry in enumerate(entries) if entry.get(name) is not None]
    return np.array(rows, dtype=np.int64), [entries[row] for row in rows]


def _tell_first_wrong(entries: Sequence[Any], owners: Sequence[str], read: ReadColumns) -> None:
    """Find the first wrong entry by bisection; raises ContentError that names it."""
    low, high = 0, len(entries)
    while high - low > 1:
        middle = (low + high) // 2
        try:
            read(entries[low:middle], owners[low:middle])
            low = middle
        except ContentError:
            high = middle
    with at(f"results: {owners[low]}: entry {low - owners.index(owners[low])}"):
        read(entries[low:high], owners[low:high])


def _flat(values: list[Any], shape: tuple[int, ...]) -> list[Any] | None:
    """The contents of the innermost lists, in order; None if something is no list of that length."""
    for length in shape:
        if set(map(type, values)) - {list} or set(map(len, values)) - {length}:
            return None
        values = list(chain.from_iterable(values))
    return values


def _unexpected(entries: Sequence[Entry], name: str, expected: str) -> ContentError:
    return ContentError(f"{name}: expected {expected}, found {shown(entries[0][name])}")
