"""`AuditReport`: what an audit found, each finding in words with its remedy, and the tables it rests on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from deepaccident_devkit.support.arrays import ShortRepr
from deepaccident_devkit.support.reports import CheckReport, Report, Row


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
class AuditReport(CheckReport):
    """What an audit found, and what it compared.

    Attributes:
        findings: what is wrong; none if nothing of what was compared is.
        tables: name → rows, the heading first: what the findings rest on.
        notes: sentences on how the numbers were made, and on what was left out.
    """

    findings: tuple[AuditFinding, ...]
    tables: Mapping[str, Sequence[Row]]
    notes: tuple[str, ...] = ()

    @property
    def is_good(self) -> bool:
        """Whether there is no finding."""
        return not self.findings

    def named_tables(self) -> Mapping[str, Sequence[Row]]:
        """What the findings rest on."""
        return self.tables

    def to_text(self) -> str:
        """A paragraph for each finding, what was compared, the tables and the notes."""
        paragraphs = [
            "\n  ".join(
                [
                    f"FOUND {each.kind}: {each.what}",
                    *map("such as {}".format, each.examples),
                    each.remedy,
                ]
            )
            for each in self.findings
        ]
        if self.exit_status == 0:
            paragraphs.append("Nothing was found.")
        return "\n\n".join([*paragraphs, self.basis_text(), Report.to_text(self), *self.notes])
