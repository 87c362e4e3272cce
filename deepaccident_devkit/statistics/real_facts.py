"""Facts measured on the real release, and assumptions of our readers, behind `info --facts`.

docs/validation.md, Facts of the real release, defines the rows.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

from deepaccident_devkit.support.arrays import ShortRepr
from deepaccident_devkit.support.json_text import as_record

FactVerdict = Literal["agree", "differ", "cannot say"]
FactKind = Literal[
    "all", "some", "share", "mean", "median", "few", "most", "least", "area", "range"
]
"""How a fact is compared.

`all`, `some` and `share` are shares: always, sometimes, or a number. `few` are percentiles where
there are few real cases, `most` and `least` extremes, `area` an AUC, and `range` a median that
lies in a range.
"""


@dataclass(frozen=True, slots=True)
class Fact(ShortRepr):
    """One fact and, once a release was examined, the release's value of it. Shares are from 0 to 1.

    Attributes:
        key: Key in `ScenarioFacts.values`.
        name: Description.
        kind: How it is compared.
        confidence: `A`: several sources, or recomputed; `B`: one source; `C`: a remark; empty for
            an assumption of our readers.
        source: Part of the real release that was measured; empty for an assumption of our readers.
        real_cases: Number of real cases; 0 where unknown.
        real: Published values: one number, of `few` at least one, none of `all`, `some` and
            `range`.
        unit: Unit of the numbers; `share` for shares.
        limits: Lowest and highest value that agrees, of all kinds but `share`, `mean`, `median` and
            `few`.
        here: The release's share, mean, median, most, least or AUC; None where it has none.
        ends: Ends of its 95 % interval, or 5th and 95th percentile of `few`; None without a value.
        cases: Number of cases in the release.
        scenarios: Number of scenarios with a case.
        verdict: Whether the release agrees.
    """

    key: str
    name: str
    kind: FactKind
    confidence: Literal["A", "B", "C", ""] = ""
    source: str = ""
    real_cases: int = 0
    real: tuple[float, ...] = ()
    unit: str = "share"
    limits: tuple[float, float] = (1.0, 1.0)
    here: float | None = None
    ends: tuple[float, float] | None = None
    cases: int = 0
    scenarios: int = 0
    verdict: FactVerdict = "cannot say"

    def texts(self) -> tuple[str, ...]:
        """Return a table's cells: fact, confidence, others, here, cases, verdict."""
        words = {"all": "always", "some": "occurs", "range": _text(self.limits, self.unit, " to ")}
        published = words.get(self.kind) or _text(self.real, self.unit)
        if self.source:
            cases = f", {self.real_cases:,}" if self.real_cases else ""
            published += f" ({self.source}{cases})"
        value = "–" if self.here is None else _text([self.here], self.unit)
        if len({self.here, *(self.ends or ())}) > 1:
            value += f" [{_text(self.ends or (), self.unit, ' … ')}]"
        return (self.name, self.confidence, published, value, f"{self.cases:,}", self.verdict)


def _text(values: Sequence[float], unit: str, separator: str = ", ") -> str:
    scale, sign = (100, "%") if unit == "share" else (1, unit)
    numbers = separator.join(f"{scale * value:.3g}" for value in values)
    return f"{numbers} {sign}".rstrip()


FACTS: Final[tuple[Fact, ...]] = as_record(
    json.loads(Path(__file__).with_suffix(".json").read_bytes()), tuple[Fact, ...]
)
"""All rows of the table, in its order, from `real_facts.json`."""
