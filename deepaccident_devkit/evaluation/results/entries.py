"""The lists of entries by sample that accident and detection results consist of, as columns over all entries."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from types import MappingProxyType
from typing import Any

import numpy as np

from deepaccident_devkit.arrays import AnyArray, IntArray
from deepaccident_devkit.evaluation.results.columns import Entry
from deepaccident_devkit.evaluation.results.faults import ContentError, at, shown
from deepaccident_devkit.evaluation.results.header import check_token

Columns = Mapping[str, AnyArray]
ReadColumns = Callable[[Sequence[Entry], Sequence[str]], Columns]
"""Columns of N entries, of these and their samples' tokens; raises ContentError, of a single entry what is wrong."""


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


def _tell_first_wrong(entries: Sequence[Any], owners: Sequence[str], read: ReadColumns) -> None:
    """Find the first entry that is not as it should be, by halves; raises ContentError that names it."""
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
