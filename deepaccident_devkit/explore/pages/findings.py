"""What `validate` finds in the release, with filters."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final
from urllib.parse import urlencode

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from deepaccident_devkit.explore.explorer import Explorer
from deepaccident_devkit.explore.pages.answers import explorer_of
from deepaccident_devkit.explore.pages.release_tabs import pages_of, part_of, release_page
from deepaccident_devkit.tables import SEVERITIES
from deepaccident_devkit.validation import CODES, Finding, ValidationReport, validate_release

ANY: Final = "any"
"""The severity that stands for all, notes too."""


def routes() -> list[Route]:
    """The addresses."""
    return [Route("/release/findings", _findings)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Kind:
    """Findings of one kind.

    Attributes:
        code: such as `label-unreadable`.
        severity: how bad they are.
        known: how many of them the real release has too.
        count: all of them.
        meaning: of the code, a sentence; empty for a code of another version.
    """

    code: str
    severity: str
    known: int
    count: int
    meaning: str


def _findings(request: Request) -> Response:
    """The files are read only for readers who open this page, since it takes minutes for a whole release."""
    explorer = explorer_of(request)

    def work() -> ValidationReport:
        return validate_release(explorer.dataset.dataroot, explorer.dataset.version, workers=explorer.workers)

    job = explorer.jobs.ask("findings", "what is wrong or missing in the files", work)
    return release_page(request, "findings", job, lambda report: _context(request, explorer, report))


def _context(request: Request, explorer: Explorer, report: ValidationReport) -> dict[str, Any]:
    severity, code = (request.query_params.get(name, "") for name in ("severity", "code"))
    shown = chosen_findings(report.findings, severity=severity, code=code)
    return {
        "report": report,
        "counts": {name: (count, _address(severity=name, code="")) for name, count in report.counts.items()},
        "kinds": [(kind, _address(severity="", code=kind.code)) for kind in kinds_of(report.findings)],
        "severity": severity,
        "code": code,
        "hidden": 0 if severity or code else report.counts["note"],
        "with_notes": _address(severity=ANY, code=""),
        "without_severity": _address(severity="", code=code),
        "without_code": _address(severity=severity, code=""),
        "part": part_of(request, shown),
        "known": pages_of(explorer),
    }


def chosen_findings(findings: Sequence[Finding], *, severity: str, code: str) -> list[Finding]:
    """Findings of a severity (or `any`) and a code; empty for those that are not chosen by it. Notes must be asked for.

    Args:
        findings: in the order to show.
        severity: of `SEVERITIES`, or `any`; empty for all but notes, and with a code for all.
        code: such as `label-unreadable`.
    """
    wanted: Sequence[str] = (severity,)
    if severity == ANY or (code and not severity):
        wanted = SEVERITIES
    elif not severity:
        wanted = [each for each in SEVERITIES if each != "note"]
    return [each for each in findings if each.severity in wanted and code in ("", each.code)]


def kinds_of(findings: Sequence[Finding]) -> list[Kind]:
    """How many there are of each kind; the worst first, within them the most frequent."""
    counts = Counter((each.severity, each.code) for each in findings)
    known = Counter((each.severity, each.code) for each in findings if each.known)
    rank: Mapping[str, int] = {severity: place for place, severity in enumerate(SEVERITIES)}
    ordered = sorted(counts.items(), key=lambda item: (rank[item[0][0]], -item[1], item[0][1]))
    return [
        Kind(
            code=code,
            severity=severity,
            known=known[severity, code],
            count=count,
            meaning=CODES[code].meaning if code in CODES else "",
        )
        for (severity, code), count in ordered
    ]


def _address(**chosen: str) -> str:
    """The parameters of the address with these choices."""
    return f"?{urlencode({name: value for name, value in chosen.items() if value})}"
