"""What `validate` found: findings, counts against a whole release, and what is still to download."""

import sys
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from deepaccident_devkit.arrays import ShortRepr
from deepaccident_devkit.reports import Report
from deepaccident_devkit.tables import SEVERITIES, Finding
from deepaccident_devkit.tables.velocities import VelocityFit
from deepaccident_devkit.taxonomy import AGENTS, BEV_CAMERA, CHANNELS, VELOCITY_FRAMES
from deepaccident_devkit.text import counted

KINDS = ("calib", "label", *CHANNELS)
"""The kinds of files that an agent has."""
NOT_IN_TEST = ("label", BEV_CAMERA)
"""Kinds that the test split ships without."""
UNKNOWN_SPLIT = "unknown"
_LINES_A_SCENARIO = 8
_ALL_LISTED = "(--all lists all)"


@dataclass(frozen=True, slots=True, kw_only=True)
class Coverage(ShortRepr):
    """Which part of a whole release is here.

    Attributes:
        scenarios: split → scenarios here; `unknown` for those of no known split.
        expected: split → scenarios of the whole release.
        recordings: split → agent → kind of file → scenarios that have any of it.
    """

    scenarios: Mapping[str, int]
    expected: Mapping[str, int]
    recordings: Mapping[str, Mapping[str, Mapping[str, int]]]

    def to_download(self) -> Iterator[str]:
        """What is missing for a whole release, a sentence each."""
        here, whole = sum(self.scenarios.values()), sum(self.expected.values())
        if set(self.scenarios) <= set(self.expected):
            for split, total in self.expected.items():
                if self.scenarios.get(split, 0) < total:
                    yield f"{split}: {total - self.scenarios.get(split, 0)} of {total} scenarios"
        elif here < whole:
            yield f"{whole - here} of {whole} scenarios (the splits of those here are not all known)"
        for split, agents in self.recordings.items():
            yield from self._missing_kinds(split, agents)

    def _missing_kinds(self, split: str, agents: Mapping[str, Mapping[str, int]]) -> Iterator[str]:
        """What the scenarios of a split that are here lack; kinds that lack the same share a sentence."""
        scenarios = self.scenarios[split]
        kinds_of: dict[tuple[tuple[str, int], ...], list[str]] = {}
        for kind in KINDS:
            if split == "test" and kind in NOT_IN_TEST:
                continue
            lacking = tuple((agent, scenarios - counts[kind]) for agent, counts in agents.items())
            kinds_of.setdefault(tuple(pair for pair in lacking if pair[1]), []).append(kind)
        for lacking, kinds in kinds_of.items():
            if not lacking:
                continue
            everywhere = len(lacking) == len(agents) and all(count == scenarios for _, count in lacking)
            places = ", ".join(f"{agent} in {count} of {scenarios} scenarios" for agent, count in lacking)
            name = f"split {split}" if split == UNKNOWN_SPLIT else split
            yield f"{name}: {', '.join(kinds)} of {'all agents' if everywhere else places}"


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
        coverage: what is here of a whole release.
        velocity: in which frame the labels' velocities fit the displacements.
        velocity_frames: scenario → what its labels' velocities are in; None where it cannot be told.
    """

    dataroot: str
    version: str
    deep: bool
    scenarios: int
    samples: int
    findings: Sequence[Finding]
    coverage: Coverage
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
        content = super().to_dict()
        content["counts"] = self.counts
        content["velocity"]["best"] = self.velocity.best
        content["to_download"] = list(self.coverage.to_download())
        return content

    def to_text(self, *, notes: bool = False, whole: bool = False) -> str:
        """A table for a terminal, worst scenario first.

        Args:
            notes: whether to list what is only worth knowing, too.
            whole: whether to list all that was found of a scenario, and all that is to download.
        """
        most = sys.maxsize if whole else _LINES_A_SCENARIO
        blocks = [self._head(), *self._scenario_blocks(most, notes=notes), *self._closing(most, notes=notes)]
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

    def _closing(self, most: int, *, notes: bool) -> Iterator[str]:
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
        missing = list(self.coverage.to_download())
        if missing:
            shown = missing[:most]
            more = [f"  … and {len(missing) - len(shown)} more {_ALL_LISTED}"] if len(missing) > len(shown) else []
            yield "still to download, for a whole release:\n" + "\n".join([*(f"  {line}" for line in shown), *more])
        hidden = self.counts["note"] and not notes
        verdict = ", ".join(counted(self.counts[severity], severity) for severity in SEVERITIES)
        yield verdict + (" (--notes lists the notes)" if hidden else "")


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


def empty_recordings() -> dict[str, dict[str, int]]:
    """Agent → kind of file → 0."""
    return {agent: dict.fromkeys(KINDS, 0) for agent in AGENTS}


def _line(finding: Finding) -> str:
    known = " (known of the release)" if finding.known else ""
    return f"  {finding.severity:<7} {finding.code}: {finding}{known}"
