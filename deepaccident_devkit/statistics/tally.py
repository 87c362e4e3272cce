"""`Tally`: what is counted in some scenarios, in a form that adds up; the tallies of parts give that of the whole."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final, TypeAlias

import numpy as np

from deepaccident_devkit.arrays import AnyArray, FloatArray, IntArray, ShortRepr
from deepaccident_devkit.statistics.results import GROUPS, PROBABILITIES, TOTAL, UNKNOWN, CollisionPair, QuantileRow

PARTS: Final = GROUPS[1:]
"""The groups that the total is made of; a row's group code counts in them, −1 for rows that are not selected."""
LEFT_OUT: Final = "left out"
"""In place of a table's word: what the table does not count."""
Occurrences: TypeAlias = tuple[FloatArray, IntArray]
"""Values (V,), and how often each occurs (V,)."""


@dataclass(slots=True, kw_only=True)
class Tally(ShortRepr):
    """What is counted in some scenarios, by group without the total.

    Attributes:
        counts: table; word, or number of a bin; group → how many.
        values: table, field, category, group → values, of one or more parts.
        pairs: row of a scenario → its colliding pair.
    """

    counts: Counter[tuple[str, str, str]] = field(default_factory=Counter)
    values: defaultdict[tuple[str, str, str, str], list[Occurrences]] = field(default_factory=lambda: defaultdict(list))
    pairs: dict[int, CollisionPair] = field(default_factory=dict)

    def count(self, table: str, groups: AnyArray, word: str = "") -> None:
        """Count rows (N,) by their group codes; those with −1 do not count."""
        self.count_words(table, (word,), np.zeros(len(groups), dtype=np.int8), groups)

    def count_words(self, table: str, words: Sequence[str], codes: AnyArray, groups: AnyArray) -> None:
        """Count rows (N,) by word, of which they have the codes, and group code; negative ones do not count."""
        counted = (codes >= 0) & (groups >= 0)
        keys = codes[counted] * np.int16(len(PARTS)) + groups[counted]
        numbers = np.bincount(keys, minlength=len(words) * len(PARTS)).reshape(len(words), len(PARTS))
        for word, row in zip(words, numbers.tolist(), strict=True):
            self.counts.update({(table, word, group): number for group, number in zip(PARTS, row, strict=True)})

    def count_bins(self, table: str, values: FloatArray, groups: AnyArray, edges: Sequence[float]) -> None:
        """Count numbers in bins.

        Args:
            table: name of the histogram.
            values: (N,) without NaN.
            groups: (N,) group codes; rows with −1 do not count.
            edges: (B + 1,) ascending; a bin holds its lower edge, the last one both.
        """
        bounds = np.asarray(edges, dtype=np.float64)
        bins = np.searchsorted(bounds, values, side="right").astype(np.int8)  # 0 below, B + 1 above
        bins[values == bounds[-1]] = len(bounds) - 1
        self.count_words(table, _bins(edges), bins, groups)

    def add_values(self, table: str, name: str, category: str, values: FloatArray, groups: AnyArray) -> None:
        """Keep the values (N,) of a field and category, without NaN, of which quantiles are wanted; groups as above."""
        for code, group in enumerate(PARTS):
            chosen = values[groups == code]
            if len(chosen):
                self.values[table, name, category, group].append(np.unique(chosen, return_counts=True))

    def add(self, other: Tally) -> None:
        """Add the tally of other scenarios."""
        self.counts.update(other.counts)
        for key, parts in other.values.items():
            self.values[key] += parts
        self.pairs |= other.pairs

    def by_group(self, table: str, word: str = "") -> dict[str, int]:
        """Group → how many of a word."""
        counts = {group: self.counts[table, word, group] for group in PARTS}
        return {TOTAL: sum(counts.values()), **counts}

    def by_word(self, table: str, known: Sequence[str] = ()) -> dict[str, dict[str, int]]:
        """Word → group → how many.

        Args:
            table: name of the table.
            known: words that are there in any case, in this order; others follow, and `unknown` is last.
        """
        found = {word for name, word, _ in self.counts if name == table and word != LEFT_OUT}
        others = sorted(found - {*known, UNKNOWN})
        return {word: self.by_group(table, word) for word in (*known, *others, *({UNKNOWN} & found))}

    def by_bin(self, table: str, edges: Sequence[float]) -> tuple[dict[str, tuple[int, ...]], dict[str, int]]:
        """Group → counts of the B bins between edges; group → how many outside of them."""
        below, *rows, above = [self.by_group(table, name) for name in _bins(edges)]
        inner = {group: tuple(row[group] for row in rows) for group in GROUPS}
        return inner, {group: below[group] + above[group] for group in GROUPS}

    def quantiles(self, table: str, name: str, category: str) -> list[QuantileRow]:
        """The quantiles of a field and category in every group."""
        parts = [_repeated(self.values.get((table, name, category, group), [])) for group in PARTS]
        everything = np.concatenate(parts)
        whole = _quantiles(everything)
        rows = [QuantileRow(field=name, category=category, group=TOTAL, number=len(everything), values=whole)]
        for group, values in zip(PARTS, parts, strict=True):
            part = whole if len(values) == len(everything) else _quantiles(values)
            rows.append(QuantileRow(field=name, category=category, group=group, number=len(values), values=part))
        return rows


def _bins(edges: Sequence[float]) -> tuple[str, ...]:
    """The numbers of what lies below the edges, of the bins between, and of what lies above."""
    return tuple(map(str, range(len(edges) + 1)))


def _repeated(parts: Sequence[Occurrences]) -> FloatArray:
    """(N,) all values, each as often as it occurs."""
    return np.concatenate([np.zeros(0), *(np.repeat(values, times) for values, times in parts)])


def _quantiles(values: FloatArray) -> tuple[float, ...] | None:
    return tuple(np.quantile(values, PROBABILITIES).tolist()) if len(values) else None
