"""`AuditReport`: what an audit found, each finding in words with its remedy, and the tables it rests on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from deepaccident_devkit.reports import Report, Row
from deepaccident_devkit.support.arrays import ShortRepr


@dataclass(frozen=True, slots=True, kw_only=True)
class AuditFinding(ShortRepr):
    """One thing that is wrong with splits, scores or a reader.

    Attributes:
        kind: a word for programs, such as `twins` or `misread`.
        what: a sentence that says what was found, and why it is wrong.
        remedy: what to do.
        number: how many cases there are.
        examples: the first of them.
    """

    kind: str
    what: str
    remedy: str
    number: int
    examples: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class AuditReport(Report):
    """What an audit found.

    Attributes:
        findings: what is wrong; none if all is well.
        tables: name → rows, the heading first: what the findings rest on.
        notes: sentences on how the numbers were made, and on what was left out.
    """

    findings: tuple[AuditFinding, ...]
    tables: Mapping[str, Sequence[Row]]
    notes: tuple[str, ...] = ()

    def named_tables(self) -> Mapping[str, Sequence[Row]]:
        """What the findings rest on."""
        return self.tables

    def to_text(self) -> str:
        """A paragraph for each finding, then the tables and the notes."""
        told = [
            "\n  ".join([f"FOUND {each.kind}: {each.what}", *map("such as {}".format, each.examples), each.remedy])
            for each in self.findings
        ]
        return "\n\n".join([*(told or ["Nothing was found."]), Report.to_text(self), *self.notes])
