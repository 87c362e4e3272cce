"""Facts measured on the real release, and assumptions of our readers, for `info --facts`.

`release_facts` defines the rows.
"""

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

`all`, `some` and `share` are shares: always, sometimes, or a certain fraction. `few` are
percentiles of few real cases. `most` and `least` are extremes. `area` is an AUC. `range` is a
median that lies in a range.
"""


@dataclass(frozen=True, slots=True)
class Fact(ShortRepr):
    """A fact about the real release, and its value in an examined release; shares are in 0..1.

    Attributes:
        key: Key in `ScenarioFacts.values`.
        name: Description.
        kind: How the fact is compared.
        confidence: `A`: several sources, or recomputed; `B`: one source; `C`: a remark; empty for
            an assumption of our readers.
        source: Part of the real release that was measured; empty for an assumption of our readers.
        real_cases: Number of real cases; 0 if unknown.
        real: Published values: one number, or at least one for `few`; empty for `all`, `some` and
            `range`.
        unit: Unit of the numbers; `share` for shares.
        limits: Lowest and highest value that agrees; unused for `share`, `mean`, `median` and
            `few`.
        here: The examined release's share, mean, median, maximum, minimum or AUC; None if it has no
            cases.
        ends: Ends of its 95 % interval, or 5th and 95th percentile for `few`; None without a value.
        cases: Number of cases in the examined release.
        scenarios: Number of scenarios with a case.
        verdict: Whether the examined release agrees.
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
        """Return the row's cells: fact, confidence, real values, value here, cases, verdict."""
        if self.kind == "all":
            published = "always"
        elif self.kind == "some":
            published = "occurs"
        elif self.kind == "range":
            published = _format_numbers(self.limits, self.unit, " to ")
        else:
            published = _format_numbers(self.real, self.unit)
        if self.source:
            cases = ""
            if self.real_cases:
                cases = f", {self.real_cases:,}"
            published += f" ({self.source}{cases})"
        value = "–"
        if self.here is not None:
            value = _format_numbers([self.here], self.unit)
        ends = self.ends or ()
        if len({self.here, *ends}) > 1:
            value += f" [{_format_numbers(ends, self.unit, ' … ')}]"
        return (self.name, self.confidence, published, value, f"{self.cases:,}", self.verdict)


def _format_numbers(values: Sequence[float], unit: str, separator: str = ", ") -> str:
    """Format numbers with their unit; shares are formatted in per cent."""
    scale = 1
    if unit == "share":
        scale = 100
        unit = "%"
    numbers = separator.join(f"{scale * value:.3g}" for value in values)
    return f"{numbers} {unit}".rstrip()


FACTS: Final[tuple[Fact, ...]] = as_record(
    json.loads(Path(__file__).with_suffix(".json").read_bytes()), tuple[Fact, ...]
)
"""All rows of the table in order, read from `real_facts.json`."""
