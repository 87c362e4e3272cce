"""`validate`: all checks of a release, and the report of their findings."""

from __future__ import annotations

import hashlib
import json
import os
import sys
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ConfigError, IndexStoreError, ReleaseError
from deepaccident_devkit.release import ReleaseLayout, ScenarioFolder
from deepaccident_devkit.release.layout import left_aside, names_without_calib
from deepaccident_devkit.release.store import (
    Dataroot,
    StorePath,
    checksums_compared,
    places_of,
)
from deepaccident_devkit.support.files import writable_folder
from deepaccident_devkit.support.json_text import as_record
from deepaccident_devkit.support.parallel import Places, Store, run_batch
from deepaccident_devkit.support.reading import LIMITS_VARIABLE
from deepaccident_devkit.support.reports import CheckReport, Report
from deepaccident_devkit.support.text import counted
from deepaccident_devkit.support.version import __version__
from deepaccident_devkit.tables import SEVERITIES, Finding, Tables, current_index
from deepaccident_devkit.tables.boxes import VelocityFit, fit_velocities, total_fit
from deepaccident_devkit.tables.scan import (
    SMALL_FILE_ENDINGS,
    finding_of,
    read_scenario,
    scan_scenario,
    times_digest,
)
from deepaccident_devkit.tables.tables import token_of
from deepaccident_devkit.taxonomy import CHANNELS, VELOCITY_FRAMES
from deepaccident_devkit.validation.agreement import check_agreement, check_story
from deepaccident_devkit.validation.completeness import (
    Completeness,
    FileCount,
    chosen_scenarios,
    completeness,
    files_of,
    readable_release,
)
from deepaccident_devkit.validation.inventory import absences, check_split_files, take_inventory
from deepaccident_devkit.validation.labels import check_labels
from deepaccident_devkit.validation.poses import check_poses, check_untracked, check_velocities
from deepaccident_devkit.validation.sensors import check_sensors
from deepaccident_devkit.validation.subject import make_finding, subject_of

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.support.parallel import Engine

NO_FIT = total_fit([])
_MAX_SCENARIO_LINES = 8
_ALL_LISTED_HINT = "(--all lists all)"
# Names during a download: with `.part`, `.partial`, `.download` or `.crdownload` at their end.
_UNFINISHED_PATTERN = "*.zip.[cdp]*[dlt]"
# Kinds of files that are always read.
_SMALL_KINDS = ("calib", "label", "meta")


@dataclass(frozen=True, slots=True, kw_only=True)
class ScenarioCheck:
    """Findings of one scenario.

    Attributes:
        token: Token of the scenario.
        findings: Findings in the order of the checks.
        samples: Number of agents times frames.
        files: Present and missing files.
        velocity: Fit of the labels' velocities.
        hashes: Hashes of the files (`tables.scan.content_hashes`); empty if they cannot be read.
    """

    token: str
    findings: tuple[Finding, ...]
    samples: int
    files: tuple[FileCount, ...]
    velocity: VelocityFit = NO_FIT
    hashes: str = ""

    def to_json(self) -> str:
        """Return one JSON object that `of_json` turns into an equal check."""
        return json.dumps(asdict(self))

    @classmethod
    def of_json(cls, text: bytes) -> ScenarioCheck:
        """Return the check that `to_json` wrote."""
        # `json.loads` keeps lone surrogates, which names of files may have.
        return as_record(json.loads(text), cls)


def check_key(scenario: ScenarioFolder, *, deep: bool) -> str:
    """Return a digest of all that decides a scenario's check.

    These are the devkit, its settings, and names, sizes and times of the scenario's files.
    """
    settings = (
        __version__,
        deep,
        str(scenario.root),
        scenario.folder,
        os.environ.get(LIMITS_VARIABLE),
    )
    times = times_digest(scenario, (*SMALL_FILE_ENDINGS, *CHANNELS), ctime=False)
    return hashlib.blake2b(f"{settings} {times}".encode(), digest_size=8).hexdigest()


@dataclass(frozen=True, slots=True, kw_only=True)
class ValidationReport(CheckReport):
    """Findings of a release.

    Attributes:
        dataroot: Folder of the release.
        version: `v1` or `v1-mini`.
        deep: Whether sensor files were decoded.
        scenarios: Number of scenarios examined.
        samples: Number of their samples, agents times frames.
        findings: Findings, worst scenario first, and worst first within it.
        files: Present and missing files.
        velocity: Frame in which the labels' velocities fit the displacements.
        velocity_frames: Scenario → frame of its labels' velocities; None where it is unknown.
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
        """Number of findings by severity."""
        counts = Counter(finding.severity for finding in self.findings)
        return {severity: counts[severity] for severity in SEVERITIES}

    @property
    def is_good(self) -> bool:
        """Whether all findings are notes, or known of the real release."""
        for finding in self.findings:
            if finding.severity != "note" and not finding.known:
                return False
        return True

    def to_dict(self) -> dict[str, Any]:
        """Return a dictionary for JSON."""
        # `super()` fails: a dataclass with slots is another class than its body refers to.
        content = Report.to_dict(self)
        content["counts"] = self.counts
        content["velocity"]["best"] = self.velocity.best
        return content

    def to_text(self, *, notes: bool = False, whole: bool = False) -> str:
        """Return a table for a terminal, worst scenario first.

        Args:
            notes: Whether to list findings of severity `note`, too.
            whole: Whether to list all findings of a scenario.
        """
        max_lines = sys.maxsize if whole else _MAX_SCENARIO_LINES
        blocks = [self._head(), *self._scenario_blocks(max_lines, notes=notes)]
        return "\n\n".join([*blocks, *self._closing(notes=notes)])

    def _head(self) -> str:
        depth = "labels, calib, meta and file names (--deep decodes the rest)"
        if self.deep:
            depth = "every file decoded"
        return (
            f"DeepAccident {self.version} at {self.dataroot}\n"
            f"{counted(self.scenarios, 'scenario')}, {counted(self.samples, 'sample')}: {depth}"
        )

    def _scenario_blocks(self, max_lines: int, *, notes: bool) -> Iterator[str]:
        by_scenario: dict[str | None, list[Finding]] = {}
        for finding in self.findings:
            if notes or finding.severity != "note":
                by_scenario.setdefault(finding.scenario, []).append(finding)
        for scenario, findings in by_scenario.items():
            counts = Counter(finding.severity for finding in findings)
            present = [severity for severity in SEVERITIES if counts[severity]]
            summary = ", ".join(counted(counts[severity], severity) for severity in present)
            lines = [f"{scenario or 'the release'}  ({summary})"]
            lines += map(_finding_line, findings[:max_lines])
            if len(findings) > max_lines:
                lines.append(f"  … and {len(findings) - max_lines} more {_ALL_LISTED_HINT}")
            yield "\n".join(lines)

    def _closing(self, *, notes: bool) -> Iterator[str]:
        if self.findings:
            yield self._kinds_text()
        if self.velocity.boxes:
            yield self._velocity_text()
        yield f"files: {self.files.section()}"
        yield self.basis_text()
        verdict = ", ".join(counted(self.counts[severity], severity) for severity in SEVERITIES)
        if self.counts["note"] and not notes:
            verdict += " (--all lists the notes)"
        yield verdict

    def _kinds_text(self) -> str:
        """Return a line a kind of finding: by severity, then the most frequent first."""
        kinds = [(finding.severity, finding.code, finding.known) for finding in self.findings]
        counts = sorted(Counter(kinds).items(), key=lambda item: (-item[1], item[0][1]))
        lines = [f"{'kind':<24} {'how bad':<8} {'findings':>8}"]
        for listed_severity in SEVERITIES:
            for (severity, code, known), count in counts:
                if severity == listed_severity:
                    note = "  known of the release" if known else ""
                    lines.append(f"{code:<24} {severity:<8} {count:>8}{note}")
        return "\n".join(lines)

    def _velocity_text(self) -> str:
        """Return the frame of the labels' velocities, and how many scenarios and boxes fit."""
        fit = self.velocity
        best = VELOCITY_FRAMES[fit.best] if fit.best else "in none of the known frames"
        counts = Counter(self.velocity_frames.values()).most_common()
        scenarios = ", ".join(f"{name or 'unknown'} in {count}" for name, count in counts)
        shares = ", ".join(f"{name} {count / fit.boxes:.0%}" for name, count in fit.fits.items())
        return (
            f"label velocities: {best}\n"
            f"  scenarios: {scenarios}; of {fit.boxes:,} moving boxes fit: {shares}"
        )


def worst_first(findings: Sequence[Finding]) -> list[Finding]:
    """Return findings by scenario, most errors first, then most warnings; worst first within."""
    counts = Counter((finding.scenario, finding.severity) for finding in findings)

    def sort_key(finding: Finding) -> tuple[object, ...]:
        badness = [-counts[finding.scenario, severity] for severity in SEVERITIES]
        rank = SEVERITIES.index(finding.severity)
        return (finding.scenario is not None, badness, finding.scenario or "", rank)

    return sorted(findings, key=sort_key)


def _finding_line(finding: Finding) -> str:
    known = " (known of the release)" if finding.known else ""
    return f"  {finding.severity:<7} {finding.code}: {finding}{known}"


def validate_release(
    root: Dataroot,
    version: str = "v1",
    *,
    deep: bool = False,
    scenarios: Collection[str] | None = None,
    parts: Path | None = None,
    **engine: Unpack[Engine],
) -> ValidationReport:
    """Find everything that is wrong, odd or missing in a release.

    No index is needed; one that is out of date is reported.

    Args:
        root: Dataroot of the release, as for `DeepAccident`: a folder, archives, or a URL.
        version: `v1` or `v1-mini`.
        deep: Whether to decode every image, point cloud and BEV array, too, and compare it with the
            labels.
        scenarios: Tokens of the scenarios to examine; None for all.
        parts: Folder that keeps the findings of each scenario. The same call then only does the
            remaining work, and several processes with the same folder share the scenarios; one with
            changed files is examined again. None writes nothing.
        **engine: `workers`, `executor` and `progress` (`parallel.Engine`).

    Raises:
        DatarootError: The folder is missing, holds no release, or a part of it cannot be listed.
        VersionError: The version is unknown or not under this folder.
        TokenError: A token of `scenarios` is not in the release.
        ConfigError: `parts` cannot be written to.
    """
    layout = readable_release(root, version)
    folder = None if parts is None else writable_folder(parts)
    store = None if folder is None else Store(folder, folder, "validates scenarios", ConfigError)
    checks = _Work(deep=deep, store=store).run(chosen_scenarios(layout, scenarios), **engine)
    return _report(layout, checks, scenarios, root=root, deep=deep)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Work:
    """Work on scenarios, cheap to pickle.

    Attributes:
        deep: Whether sensor files are decoded.
        store: Findings of earlier calls, and of this one.
    """

    deep: bool
    store: Store | None

    def __call__(self, scenario: ScenarioFolder) -> ScenarioCheck:
        """Check one scenario, unless its check is stored."""
        if self.store is None:
            return check_scenario(scenario, deep=self.deep)
        # The key is made before any file is read, so that a later edit changes it.
        key = check_key(scenario, deep=self.deep)
        stored = self.store.kept(_name(scenario), key)
        if stored is not None:
            return ScenarioCheck.of_json(stored)
        check = check_scenario(scenario, deep=self.deep)
        self.store.keep(_name(scenario), key, check.to_json().encode())
        return check

    def run(
        self, scenarios: Sequence[ScenarioFolder], **engine: Unpack[Engine]
    ) -> list[ScenarioCheck]:
        """Check all scenarios."""
        reads = tuple({path for scenario in scenarios for path in places_of(scenario.root)})
        label = "validating scenarios"
        if self.store is None:
            return run_batch(self, scenarios, label=label, places=Places(reads=reads), **engine)
        with self.store.shared():
            places = Places(reads=reads, writes=(self.store.folder,))
            items = {_name(scenario): scenario for scenario in scenarios}
            checks = self.store.run(self, items, label=label, places=places, **engine)
            return list(checks.values())


def _name(scenario: ScenarioFolder) -> str:
    return Path(scenario.folder, scenario.token).as_posix()


def _report(
    layout: ReleaseLayout,
    checks: Sequence[ScenarioCheck],
    scenarios: Collection[str] | None,
    *,
    root: Dataroot,
    deep: bool,
) -> ValidationReport:
    """Return the report of the scenarios' checks, and of findings in the release itself."""
    readable, split_findings = check_split_files(layout)
    tokens = {None, *(check.token for check in checks)}
    all_findings = [finding for finding in split_findings if finding.scenario in tokens]
    if scenarios is None:
        all_findings += _find_strays(layout)
    all_findings += _find_outdated(layout, checks)
    counts = ((check.token, check.files) for check in checks)
    files = completeness(readable, counts, str(root), selected=scenarios is not None)
    for sentence in files.unreadable_archives:
        error = ReleaseError(sentence)
        all_findings.append(finding_of(error, "archive-unreadable", None))
    compared = Counter[str]()
    for check in checks:
        all_findings += check.findings
        for count in check.files:
            if deep or count.channel in _SMALL_KINDS:
                compared[f"{count.channel} files"] += count.expected - count.missing
    return ValidationReport(
        compared=dict(compared),
        dataroot=str(root),
        version=layout.version,
        deep=deep,
        scenarios=len(checks),
        samples=sum(check.samples for check in checks),
        findings=worst_first(all_findings),
        files=files,
        velocity=total_fit([check.velocity for check in checks]),
        velocity_frames={check.token: check.velocity.best for check in checks},
    )


def findings(dataset: Dataset, scenario: RowArgument, *, deep: bool = False) -> list[Finding]:
    """Return what is wrong, odd or missing in one scenario's present files, worst first.

    Args:
        dataset: Release with the scenario.
        scenario: Token or record, also of a scenario that was left out as broken.
        deep: Whether to decode its sensor files, too; see `validate_release`.

    Raises:
        TokenError: The release has no such scenario.
    """
    token = token_of(scenario)
    report = validate_release(
        dataset.dataroot, dataset.version, deep=deep, workers=1, scenarios=[token]
    )
    return [finding for finding in report.findings if finding.scenario == token]


@checksums_compared()
def check_scenario(scenario: ScenarioFolder, *, deep: bool = False) -> ScenarioCheck:
    """Return all findings in one scenario's files.

    The functions that index a scenario find what keeps it from being indexed. The content of its
    files is only checked if they find nothing.
    """
    scan = scan_scenario(scenario)
    inventory, sensor_findings = take_inventory(scenario, scan)
    scenario_findings = [*scan.problems, *absences(scenario, scan), *sensor_findings]
    files = None
    if scan.agents and not scan.problems:
        files, faults = read_scenario(scenario, scan)
        scenario_findings += faults
    velocity = NO_FIT
    if files is not None:
        # Absurd numbers are what the checks look for.
        with np.errstate(all="ignore"):
            subject = subject_of(files)
            velocity = fit_velocities(subject.boxes, subject.velocity)
            scenario_findings += check_poses(subject)
            scenario_findings += check_labels(subject)
            scenario_findings += check_agreement(subject)
            scenario_findings += check_untracked(subject)
            scenario_findings += check_velocities(subject, velocity)
            scenario_findings += check_story(subject)
            if deep:
                scenario_findings += check_sensors(subject, inventory)
    return ScenarioCheck(
        token=scenario.token,
        findings=tuple(scenario_findings),
        samples=len(scan.agents) * scan.num_frames,
        files=files_of(scenario),
        velocity=velocity,
        hashes="" if files is None else files.hashes,
    )


def _find_outdated(layout: ReleaseLayout, checks: Sequence[ScenarioCheck]) -> Iterator[Finding]:
    """Yield scenarios with other files than the index was made from."""
    index = current_index(layout)
    if index is None or not index.tables:
        return
    # Opening the release reports a damaged index.
    with suppress(IndexStoreError):
        indexed = Tables(index.tables_folder).hashes
        for check in checks:
            before = indexed.get(check.token)
            if check.hashes and before and before.as_dict() != json.loads(check.hashes):
                message = "its label, calib or meta files have changed since the index was made"
                yield make_finding("index-outdated", check.token, check.token, message)


def _find_strays(layout: ReleaseLayout) -> Iterator[Finding]:
    """Yield files and folders that are not read, though they look like parts of a release."""
    for folder, name in names_without_calib(layout):
        location = str(folder / "*" / "calib" / name)
        message = "has labels, meta or sensor files, but no calib files of any agent"
        yield make_finding("calib-missing", None, location, f"{message}, and is left out")
    for path, likeness in left_aside(layout.root):
        if likeness is None:
            message = "its end is not there, or is a folder above it"
            yield make_finding("link-leads-nowhere", None, str(path), message)
        else:
            message = f"is not read; it looks like {likeness}"
            yield make_finding("folder-left-aside", None, str(path), message)
    if isinstance(layout.root, StorePath):
        message = "is not read; it looks like half a download"
        for archive in Path(layout.root.store.place).rglob(_UNFINISHED_PATTERN):
            yield make_finding("archive-unfinished", None, str(archive), message)
