"""`Comparison`: the numbers of two evaluations side by side, as text, JSON and CSV."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, Literal

from deepaccident_devkit.arrays import ShortRepr
from deepaccident_devkit.evaluation.metrics.frozen_mappings import plain
from deepaccident_devkit.evaluation.metrics.intervals import Resampling
from deepaccident_devkit.reports import write_csv
from deepaccident_devkit.text import columns_text

Family = Literal["main", "headlines", "other"]
"""What a number is tested with: by itself, with all other headlines, or not at all."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparedNumber(ShortRepr):
    """A number of both results.

    Attributes:
        number: its path in the result: `ranges/30x30/iou`.
        headline: its short name, if it is one of the task's headlines; else None.
        unit: of a headline; else None.
        a: of the first; None where it has nothing to count.
        b: of the second; likewise.
        difference: b − a; None if one of them is.
        low: where the interval of the true difference begins; None for no interval.
        high: where it ends.
        family: `main` for the task's first headline, which is tested by itself; `headlines` for the others, which are
            tested together; `other` for numbers that are for exploration and are not tested.
        p: of the paired permutation test of this number for itself; None without difference or resamples.
        adjusted_p: the same by Holm's rule over the headlines; of others like p.
        real: whether the adjusted p is at most 1 − confidence; False for numbers that are not tested.
        better: `a` or `b`, if a difference is real and it is known whether more is better; else None.
        decision: for people: `b is better`, or why nothing is decided, and how many scenarios would.
    """

    number: str
    headline: str | None
    unit: str | None
    a: float | None
    b: float | None
    difference: float | None
    low: float | None
    high: float | None
    family: Family
    p: float | None
    adjusted_p: float | None
    real: bool
    better: str | None
    decision: str


_COLUMNS: Final = tuple(ComparedNumber.__dataclass_fields__)


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison(ShortRepr):
    """Two evaluations by the same rules.

    Attributes:
        a: folder of the first.
        b: folder of the second.
        task: of both.
        protocol: of both.
        samples: compared.
        scenarios: that they are of.
        clusters: that these are, where an accident and its twin are one.
        left_out: samples that only one of them has.
        partial: marks of those that are partial themselves.
        resampling: how differences were tested.
        swaps: how many swaps of the two runs' counts, cluster by cluster, p is of.
        all_swaps: whether these are all there are (apart from the sign); else they are random.
        numbers: headlines first.
    """

    a: Path
    b: Path
    task: str
    protocol: str
    samples: int
    scenarios: int
    clusters: int
    left_out: int
    partial: tuple[str, ...]
    resampling: Resampling
    swaps: int
    all_swaps: bool
    numbers: tuple[ComparedNumber, ...]

    def to_text(self) -> str:
        """A table of the headlines, how many other numbers differ, and what to make of that."""
        marks = [f"a, b: only the samples that both have; {self.left_out} left out"] if self.left_out else []
        head = [
            f"{self.task}, protocol {self.protocol}: {self.samples} samples of {self.scenarios} scenarios",
            f"clusters: {self.clusters} (an accident and its twin are one)",
            f"a: {self.a}",
            f"b: {self.b}",
            *self.partial,
            *marks,
        ]
        shown = [each for each in self.numbers if each.headline]
        percent = f"{self.resampling.confidence:.0%}"
        rows: list[Sequence[str]] = [("number", "a", "b", "b − a", f"{percent} interval", "p", "decision")]
        rows += [_text_row(each) for each in shown]
        return "\n".join([*head, "", columns_text(rows), "", *self.notes()])

    def notes(self) -> list[str]:
        """Notes for readers of the table."""
        if not self.resampling.resamples:
            return ["no intervals and no tests: no resamples were asked for"]
        level = 1 - self.resampling.confidence
        main = next((each.headline for each in self.numbers if each.family == "main"), None)
        others = [each for each in self.numbers if each.family == "other" and each.p is not None]
        low = sum(each.p is not None and each.p <= level for each in others)
        drawn = f"all {self.swaps:,}" if self.all_swaps else f"{self.swaps:,} random"
        by_chance = f"between equally good runs about {level * len(others):.1f} would, by chance"
        explored = f"for exploration: {low} of {len(others)} other numbers have a p of at most {level:.0%}; {by_chance}"
        return [
            f"p: share of {drawn} swaps of clusters between a and b after which they differ at least as much",
            f"tested at {level:.0%}: {main}; and the other headlines together, whose p is adjusted by Holm's rule",
            "scenarios that would decide: with a chance of 80 %, if the true difference is the observed one",
            *([explored] if others else []),
        ]

    def as_dict(self) -> dict[str, Any]:
        """All of it, as JSON holds it."""
        made: dict[str, Any] = plain(asdict(self) | {"a": os.fspath(self.a), "b": os.fspath(self.b)})
        return made | {"notes": self.notes()}

    def to_csv(self, path: str | os.PathLike[str]) -> Path:
        """Write a line a number; returns the file's path."""
        return write_csv(path, [_COLUMNS, *([getattr(each, name) for name in _COLUMNS] for each in self.numbers)])


def _text_row(each: ComparedNumber) -> tuple[str, ...]:
    unit = f" ({each.unit})" if each.unit and each.unit != "share" else ""
    interval = "–" if each.low is None or each.high is None else f"[{each.low:+.3f}, {each.high:+.3f}]"
    return (
        f"{each.headline}{unit}",
        *("–" if value is None else f"{value:.3f}" for value in (each.a, each.b)),
        "–" if each.difference is None else f"{each.difference:+.3f}",
        interval,
        "–" if each.adjusted_p is None else f"{each.adjusted_p:.3f}",
        each.decision,
    )
