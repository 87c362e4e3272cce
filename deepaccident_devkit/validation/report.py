"""What `validate` found: findings, and which files are here and missing."""

import sys
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from deepaccident_devkit.reports import Report
from deepaccident_devkit.tables import SEVERITIES, Finding
from deepaccident_devkit.tables.velocities import VelocityFit
from deepaccident_devkit.taxonomy import VELOCITY_FRAMES
from deepaccident_devkit.text import counted
from deepaccident_devkit.validation.completeness_report import Completeness

_LINES_A_SCENARIO = 8
_ALL_LISTED = "(--all lists all)"


@dataclass(frozen=True, slots=True, kw_only=True)
class ValidationReport(Report):
    """What was found in a release.

    Attributes:
        dataroot: its folder.
        version: `v1` or `v1-mini`.
        deep: whether sensor files were decoded.
        scenarios: how many were looked at.
        samples: agents times frames of those.
        findings: worst scenario first, within it worst first.
        files: which are here, and which are missing.
        velocity: in which frame the labels' velocities fit the displacements.
        velocity_frames: scenario → what its labels' velocities are in; None where it cannot be told.
    """

    dataroot: str
    version: str
    deep: bool
    scenarios: int
    samples: int
    findings: Sequence[Finding]
    files: Completeness
    velocity: VelocityFit
    velocity_frames: Mapping[str, str | None]

    @property
    def counts(self) -> dict[str, int]:
        """Severity → findings."""
        counts = Counter(finding.severity for finding in self.findings)
        return {severity: counts[severity] for severity in SEVERITIES}

    @property
    def is_good(self) -> bool:
        """Whether all findings are notes, or known of the real release."""
        return all(finding.severity == "note" or finding.known for finding in self.findings)

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        content = Report.to_dict(self)  # no `super()`: a dataclass with slots is another class
        content["counts"] = self.counts
        content["velocity"]["best"] = self.velocity.best
        return content

    def to_text(self, *, notes: bool = False, whole: bool = False) -> str:
        """A table for a terminal, worst scenario first.

        Args:
            notes: whether to list what is only worth knowing, too.
            whole: whether to list all that was found of a scenario.
        """
        most = sys.maxsize if whole else _LINES_A_SCENARIO
        blocks = [self._head(), *self._scenario_blocks(most, notes=notes), *self._closing(notes=notes)]
        return "\n\n".join(blocks)

    def _head(self) -> str:
        depth = "every file decoded" if self.deep else "labels, calib, meta and file names (--deep decodes the rest)"
        return (
            f"DeepAccident {self.version} at {self.dataroot}\n"
            f"{self.scenarios} scenarios, {self.samples:,} samples: {depth}"
        )

    def _scenario_blocks(self, most: int, *, notes: bool) -> Iterator[str]:
        by_scenario: dict[str | None, list[Finding]] = {}
        for finding in self.findings:
            if notes or finding.severity != "note":
                by_scenario.setdefault(finding.scenario, []).append(finding)
        for scenario, findings in by_scenario.items():
            counts = Counter(finding.severity for finding in findings)
            head = ", ".join(counted(counts[severity], severity) for severity in SEVERITIES if counts[severity])
            lines = [f"{scenario or 'the release'}  ({head})"]
            lines += [_line(finding) for finding in findings[:most]]
            if len(findings) > most:
                lines.append(f"  … and {len(findings) - most} more {_ALL_LISTED}")
            yield "\n".join(lines)

    def _closing(self, *, notes: bool) -> Iterator[str]:
        by_code = Counter((finding.severity, finding.code, finding.known) for finding in self.findings)
        if by_code:
            rank = {severity: place for place, severity in enumerate(SEVERITIES)}
            rows = sorted(by_code.items(), key=lambda item: (rank[item[0][0]], -item[1], item[0][1]))
            lines = [f"{'kind':<24} {'how bad':<8} {'findings':>8}"]
            for (severity, code, known), count in rows:
                lines.append(f"{code:<24} {severity:<8} {count:>8}{'  known of the release' if known else ''}")
            yield "\n".join(lines)
        if self.velocity.boxes:
            shares = ", ".join(
                f"{name} {count / self.velocity.boxes:.0%}" for name, count in self.velocity.fits.items()
            )
            best = VELOCITY_FRAMES[self.velocity.best] if self.velocity.best else "in none of the known frames"
            found = Counter(self.velocity_frames.values())
            scenarios = ", ".join(f"{name or 'unknown'} in {count}" for name, count in found.most_common())
            yield (
                f"label velocities: {best}\n"
                f"  scenarios: {scenarios}; of {self.velocity.boxes:,} moving boxes fit: {shares}"
            )
        yield f"files: {self.files.section()}"
        hidden = self.counts["note"] and not notes
        verdict = ", ".join(counted(self.counts[severity], severity) for severity in SEVERITIES)
        yield verdict + (" (--all lists the notes)" if hidden else "")


def worst_first(findings: Sequence[Finding]) -> list[Finding]:
    """Findings grouped by scenario: the one with the most errors first, then warnings; worst first within."""
    rank = {severity: place for place, severity in enumerate(SEVERITIES)}
    counts: dict[str | None, Counter[str]] = {}
    for finding in findings:
        counts.setdefault(finding.scenario, Counter())[finding.severity] += 1

    def place(finding: Finding) -> tuple[object, ...]:
        of_scenario = counts[finding.scenario]
        badness = [-of_scenario[severity] for severity in SEVERITIES]
        return (finding.scenario is not None, *badness, finding.scenario or "", rank[finding.severity])

    return sorted(findings, key=place)


def _line(finding: Finding) -> str:
    known = " (known of the release)" if finding.known else ""
    return f"  {finding.severity:<7} {finding.code}: {finding}{known}"
