"""What others measured of the real release, and what our readers take for granted: the table behind `info --facts`.

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
"""What is compared: a share (that must be all, or some, or is a number), a mean, a median, percentiles where there are
few real cases, the most, the least, an AUC, or a median that lies in a range."""


@dataclass(frozen=True, slots=True)
class Fact(ShortRepr):
    """One fact; and, once a release was looked at, what it has of it. Shares are from 0 to 1.

    Attributes:
        key: of `ScenarioFacts.values`.
        name: what it is.
        kind: how it is compared.
        confidence: `A`: several sources, or recomputed; `B`: one source; `C`: a remark; empty for what our readers take
            for granted.
        source: the part of the real release that was measured; empty for our readers'.
        real_cases: how many real cases there were; 0 where that is not known.
        real: what others measured: one number, of `few` one or more, none of `all`, `some` and `range`.
        unit: of the numbers; `share` for shares.
        limits: between which numbers it agrees, of all kinds but `share`, `mean`, `median` and `few`.
        here: the release's share, mean, median, most, least or AUC; None where it has none.
        ends: of its 95 % interval, or the 5th and 95th percentile for few real cases; None where there is none.
        cases: how many cases there are here.
        scenarios: how many scenarios they are of.
        verdict: whether the two agree.
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
        """A table's cells: fact, confidence, others, here, cases, verdict."""
        words = {"all": "always", "some": "occurs", "range": _text(self.limits, self.unit, " to ")}
        of = (
            f" ({self.source}{f', {self.real_cases:,}' if self.real_cases else ''})"
            if self.source
            else ""
        )
        others = words.get(self.kind) or _text(self.real, self.unit)
        here = "–" if self.here is None else _text([self.here], self.unit)
        within = (
            f" [{_text(self.ends or (), self.unit, ' … ')}]"
            if len({self.here, *(self.ends or ())}) > 1
            else ""
        )
        return (
            self.name,
            self.confidence,
            others + of,
            here + within,
            f"{self.cases:,}",
            self.verdict,
        )


def _text(values: Sequence[float], unit: str, between: str = ", ") -> str:
    scale, sign = (100, "%") if unit == "share" else (1, unit)
    return f"{between.join(f'{scale * each:.3g}' for each in values)} {sign}".rstrip()


FACTS: Final[tuple[Fact, ...]] = as_record(
    json.loads(Path(__file__).with_suffix(".json").read_bytes()), tuple[Fact, ...]
)
"""Every row of the table, in its order, as `real_facts.json` has them."""
