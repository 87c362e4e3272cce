"""`Finding`: one thing that is wrong, odd or missing in a release; used by indexing and by `validate`."""

from dataclasses import dataclass
from typing import Literal

from deepaccident_devkit.errors import ReleaseError
from deepaccident_devkit.support.arrays import ShortRepr

Severity = Literal["error", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")
"""Worst first: `error` cannot be indexed or cannot be true, `warning` is probably wrong, `note` is worth knowing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding(ShortRepr):
    """One thing that is wrong, odd or missing.

    Attributes:
        code: its kind, such as `label-unreadable`; docs/validation.md lists them.
        severity: how bad it is.
        scenario: token of the scenario; None where the release as a whole is meant.
        where: the file (with the line), the folder, or the agents and actors.
        what: what is wrong there.
        remedy: what to do.
        known: whether the real release has it too; then it is no fault of this copy.
    """

    code: str
    severity: Severity
    scenario: str | None
    where: str
    what: str
    remedy: str
    known: bool = False

    def __str__(self) -> str:
        """One sentence: where, what, and the remedy."""
        return f"{self.where}: {self.what}; {self.remedy}"


def finding_of(error: ReleaseError, code: str, scenario: str | None) -> Finding:
    """The finding that a reader's error tells of; its text is the error's."""
    where, _, rest = str(error).partition(": ")
    what, _, remedy = rest.rpartition("; ")
    return Finding(code=code, severity="error", scenario=scenario, where=where, what=what, remedy=remedy)
