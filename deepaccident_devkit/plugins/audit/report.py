"""`AuditReport`: the findings of an audit, with remedies and the tables behind them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from deepaccident_devkit.support.arrays import ShortRepr
from deepaccident_devkit.support.reports import CheckReport, Report, Row


@dataclass(frozen=True, slots=True, kw_only=True)
class AuditFinding(ShortRepr):
    """A fault in splits, scores or a reader.

    Attributes:
        kind: A keyword for programs, such as `twins` or `misread`.
        what: A sentence that describes the fault, and why it is one.
        remedy: A sentence that explains what to do.
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
    """The findings of an audit, and what was compared.

    Attributes:
        findings: The faults; empty if everything that was compared is right.
        tables: Name → rows on which the findings are based; the first is the heading.
        notes: Sentences on how the numbers were computed, and on what was left out.
    """

    findings: tuple[AuditFinding, ...]
    tables: Mapping[str, Sequence[Row]]
    notes: tuple[str, ...] = ()

    @property
    def is_good(self) -> bool:
        """Whether there are no findings."""
        return not self.findings

    def named_tables(self) -> Mapping[str, Sequence[Row]]:
        """Return the tables on which the findings are based."""
        return self.tables

    def to_text(self) -> str:
        """Return the report as text: findings, what was compared, tables and notes."""
        paragraphs = []
        for finding in self.findings:
            examples = [f"such as {example}" for example in finding.examples]
            lines = [f"FOUND {finding.kind}: {finding.what}", *examples, finding.remedy]
            paragraphs.append("\n  ".join(lines))
        if self.exit_status == 0:
            paragraphs.append("No problems found.")
        return "\n\n".join([*paragraphs, self.basis_text(), Report.to_text(self), *self.notes])
