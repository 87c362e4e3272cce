"""`AuditReport`: the findings of an audit, with remedies and the tables that they rest on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from deepaccident_devkit.support.arrays import ShortRepr
from deepaccident_devkit.support.reports import CheckReport, Report, Row


@dataclass(frozen=True, slots=True, kw_only=True)
class AuditFinding(ShortRepr):
    """A fault of splits, scores or a reader.

    Attributes:
        kind: A word for programs, such as `twins` or `misread`.
        what: A sentence that describes the fault and why it is wrong.
        remedy: A remedy, as a sentence.
        number: Number of cases.
        examples: A few of the cases.
    """

    kind: str
    what: str
    remedy: str
    number: int
    examples: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class AuditReport(CheckReport):
    """The findings of an audit, and the numbers of things that it compared.

    Attributes:
        findings: The faults; empty if nothing that was compared is wrong.
        tables: Name → rows, the heading first, which the findings rest on.
        notes: Sentences on how the numbers were computed, and on what was left out.
    """

    findings: tuple[AuditFinding, ...]
    tables: Mapping[str, Sequence[Row]]
    notes: tuple[str, ...] = ()

    @property
    def is_good(self) -> bool:
        """Whether there is no finding."""
        return not self.findings

    def named_tables(self) -> Mapping[str, Sequence[Row]]:
        """Return the tables that the findings rest on."""
        return self.tables

    def to_text(self) -> str:
        """Return a paragraph for each finding, what was compared, the tables and the notes."""
        paragraphs = []
        for finding in self.findings:
            examples = [f"such as {example}" for example in finding.examples]
            lines = [f"FOUND {finding.kind}: {finding.what}", *examples, finding.remedy]
            paragraphs.append("\n  ".join(lines))
        if self.exit_status == 0:
            paragraphs.append("Nothing was found.")
        return "\n\n".join([*paragraphs, self.basis_text(), Report.to_text(self), *self.notes])
