"""`validate`: runs all checks on a release, and reports their findings."""

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
from deepaccident_devkit.release.layout import find_ignored_paths, names_without_calib
from deepaccident_devkit.release.part import PartManifest, read_part_manifest
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
from deepaccident_devkit.validation.sensors import check_first_images, check_sensors
from deepaccident_devkit.validation.subject import Findings, make_finding, subject_of

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.support.parallel import Engine

NO_FIT = total_fit([])
"""The velocity fit of a release without velocities."""
# Largest number of findings per scenario that the text lists.
_MAX_SCENARIO_LINES = 8
_ALL_LISTED_HINT = "(--all lists all)"
# Names of unfinished downloads: they end with `.part`, `.partial`, `.download` or `.crdownload`.
_UNFINISHED_PATTERN = "*.zip.[cdp]*[dlt]"
# Kinds of files that are always read.
_SMALL_KINDS = ("calib", "label", "meta")


@dataclass(frozen=True, slots=True, kw_only=True)
class ScenarioCheck:
    """The findings about one scenario.

    Attributes:
        token: Token of the scenario.
        findings: Findings, in the order of the checks.
        samples: Number of samples (agents × frames).
        files: Present and missing files.
        velocity: Fit of the labels' velocities.
        hashes: Hashes of the files (`tables.scan.content_hashes`); empty if they are unreadable.
    """

    token: str
    findings: tuple[Finding, ...]
    samples: int
    files: tuple[FileCount, ...]
    velocity: VelocityFit = NO_FIT
    hashes: str = ""

    def to_json(self) -> str:
        """Return the check as a JSON object that `of_json` reads."""
        return json.dumps(asdict(self))

    @classmethod
    def of_json(cls, text: bytes) -> ScenarioCheck:
        """Rebuild a check from what `to_json` wrote."""
        # `json.loads` accepts lone surrogates, which file names may contain.
        values = json.loads(text)
        return as_record(values, cls)


def check_key(scenario: ScenarioFolder, *, deep: bool) -> str:
    """Return a digest of everything that determines the check of a scenario.

    This is the devkit, the settings, and the names, sizes and times of the scenario's files.
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
    """The findings about a release.

    Attributes:
        dataroot: Folder of the release.
        version: `v1` or `v1-mini`.
        deep: Whether sensor files were decoded.
        scenarios: Number of scenarios examined.
        samples: Number of their samples (agents × frames).
        findings: Findings, sorted by scenario (worst first), then by severity (worst first).
        files: Present and missing files.
        velocity: Frame in which the labels' velocities best fit the displacements.
        velocity_frames: Scenario → frame of its labels' velocities; None if unknown.
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
        """Number of findings of each severity."""
        counts = Counter(finding.severity for finding in self.findings)
        return {severity: counts[severity] for severity in SEVERITIES}

    @property
    def is_good(self) -> bool:
        """Whether every finding is a note, or also known in the real release."""
        for finding in self.findings:
            if finding.severity != "note" and not finding.known:
                return False
        return True

    def to_dict(self) -> dict[str, Any]:
        """Return the report as a dictionary for JSON."""
        # `super()` fails: a dataclass with slots is another class than its body refers to.
        content = Report.to_dict(self)
        content["counts"] = self.counts
        content["velocity"]["best"] = self.velocity.best
        return content

    def to_text(self, *, notes: bool = False, whole: bool = False) -> str:
        """Format the findings for a terminal, worst scenario first.

        Args:
            notes: Whether to list findings of severity `note` as well.
            whole: Whether to list all findings of a scenario.
        """
        max_lines = _MAX_SCENARIO_LINES
        if whole:
            max_lines = sys.maxsize
        scenario_blocks = self._scenario_blocks(max_lines, notes=notes)
        closing_blocks = self._closing_blocks(notes=notes)
        return "\n\n".join([self._heading(), *scenario_blocks, *closing_blocks])

    def _heading(self) -> str:
        depth = "checked labels, calib, meta and file names (--deep decodes all files)"
        if self.deep:
            depth = "decoded every file"
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
            present_severities = [severity for severity in SEVERITIES if counts[severity]]
            summary = ", ".join(
                counted(counts[severity], severity) for severity in present_severities
            )
            lines = [f"{scenario or 'the release'}  ({summary})"]
            lines += map(_finding_line, findings[:max_lines])
            if len(findings) > max_lines:
                lines.append(f"  … and {len(findings) - max_lines} more {_ALL_LISTED_HINT}")
            yield "\n".join(lines)

    def _closing_blocks(self, *, notes: bool) -> Iterator[str]:
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
        """Return a line per kind of finding, by severity, the most frequent first."""
        kinds = [(finding.severity, finding.code, finding.known) for finding in self.findings]
        counts = sorted(Counter(kinds).items(), key=lambda item: (-item[1], item[0][1]))
        lines = [f"{'finding':<24} {'severity':<8} {'count':>8}"]
        for listed_severity in SEVERITIES:
            for (severity, code, is_known), count in counts:
                if severity == listed_severity:
                    note = "  known in the real release" if is_known else ""
                    lines.append(f"{code:<24} {severity:<8} {count:>8}{note}")
        return "\n".join(lines)

    def _velocity_text(self) -> str:
        """Describe the frame of the labels' velocities, and how many scenarios and boxes fit it."""
        fit = self.velocity
        best_frame = "in none of the known frames"
        if fit.best:
            best_frame = VELOCITY_FRAMES[fit.best]
        counts = Counter(self.velocity_frames.values()).most_common()
        scenarios = ", ".join(
            f"{name or 'unknown'} in {counted(count, 'scenario')}" for name, count in counts
        )
        return f"label velocities: {best_frame}\n  {scenarios}; {fit.to_text()}"


def worst_first(findings: Sequence[Finding]) -> list[Finding]:
    """Sort findings by scenario; the ones with the most errors, then warnings, come first.

    Within a scenario, the worst finding comes first.
    """
    counts = Counter((finding.scenario, finding.severity) for finding in findings)

    def sort_key(finding: Finding) -> tuple[object, ...]:
        scenario = finding.scenario
        badness = [-counts[scenario, severity] for severity in SEVERITIES]
        rank = SEVERITIES.index(finding.severity)
        return (scenario is not None, badness, scenario or "", rank)

    return sorted(findings, key=sort_key)


def _finding_line(finding: Finding) -> str:
    note = ""
    if finding.known:
        note = " (known in the real release)"
    return f"  {finding.severity:<7} {finding.code}: {finding}{note}"


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

    No index is needed; if there is an outdated one, it is reported.

    Args:
        root: Dataroot of the release, as for `DeepAccident`: a folder, archives, or a URL.
        version: `v1` or `v1-mini`.
        deep: Whether to also decode every image, point cloud and BEV array, and to compare it with
            the labels.
        scenarios: Tokens of the scenarios to examine; None for all.
        parts: Folder in which the findings of each scenario are stored. Repeating the call only
            does the remaining work, and several processes can share it. Scenarios whose files have
            changed are examined again. With None, nothing is stored.
        **engine: `workers`, `executor` and `progress` (`parallel.Engine`).

    Raises:
        DatarootError: If the folder is missing or contains no release, or part of it
            cannot be listed.
        VersionError: If the version is unknown, or not in this folder.
        TokenError: If a token of `scenarios` is not in the release.
        ConfigError: If `parts` cannot be written to.
    """
    layout = readable_release(root, version)
    store = None
    if parts is not None:
        folder = writable_folder(parts)
        store = Store(folder, folder, "is validating scenarios", ConfigError)
    folders = chosen_scenarios(layout, scenarios)
    checks = _ScenarioChecker(deep=deep, store=store).run(folders, **engine)
    return _make_report(layout, checks, scenarios, root=root, deep=deep)


@dataclass(frozen=True, slots=True, kw_only=True)
class _ScenarioChecker:
    """Checks scenarios; cheap to pickle.

    Attributes:
        deep: Whether sensor files are decoded.
        store: Findings of this call and earlier ones; None to store nothing.
    """

    deep: bool
    store: Store | None

    def __call__(self, scenario: ScenarioFolder) -> ScenarioCheck:
        """Check one scenario, unless its findings are stored."""
        if self.store is None:
            return check_scenario(scenario, deep=self.deep)
        # The key is computed before any file is read, so that later edits change it.
        key = check_key(scenario, deep=self.deep)
        name = _store_name(scenario)
        stored = self.store.read_result(name, key)
        if stored is not None:
            return ScenarioCheck.of_json(stored)
        check = check_scenario(scenario, deep=self.deep)
        self.store.write_result(name, key, check.to_json().encode())
        return check

    def run(
        self, scenarios: Sequence[ScenarioFolder], **engine: Unpack[Engine]
    ) -> list[ScenarioCheck]:
        """Check all scenarios."""
        reads = tuple({path for scenario in scenarios for path in places_of(scenario.root)})
        label = "Validating scenarios"
        if self.store is None:
            return run_batch(self, scenarios, label=label, places=Places(reads=reads), **engine)
        with self.store.shared():
            places = Places(reads=reads, writes=(self.store.folder,))
            items = {_store_name(scenario): scenario for scenario in scenarios}
            checks = self.store.run(self, items, label=label, places=places, **engine)
            return list(checks.values())


def _store_name(scenario: ScenarioFolder) -> str:
    path = Path(scenario.folder, scenario.token)
    return path.as_posix()


def _make_report(
    layout: ReleaseLayout,
    checks: Sequence[ScenarioCheck],
    scenarios: Collection[str] | None,
    *,
    root: Dataroot,
    deep: bool,
) -> ValidationReport:
    """Build the report from the scenarios' checks, and find faults of the release itself."""
    part = read_part_manifest(layout.root)
    readable, split_findings = check_split_files(layout)
    tokens = {None, *(check.token for check in checks)}
    all_findings = [finding for finding in split_findings if finding.scenario in tokens]
    if scenarios is None:
        all_findings += _find_strays(layout, part)
    all_findings += _find_outdated(layout, checks)
    counts = ((check.token, check.files) for check in checks)
    files = completeness(readable, counts, str(root), selected=scenarios is not None, part=part)
    for sentence in files.unreadable_archives:
        error = ReleaseError(sentence)
        all_findings.append(finding_of(error, "archive-unreadable", None))
    compared = Counter[str]()
    for check in checks:
        all_findings += check.findings
        for count in check.files:
            if deep or count.channel in _SMALL_KINDS:
                compared[f"{count.channel} files"] += count.expected - count.missing
    if part is not None:
        # The manifest says which agents are there.
        all_findings = [finding for finding in all_findings if finding.code != "agent-missing"]
        all_findings += _find_missing_in_part(part, files)
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
    """Find what is wrong, odd or missing in one scenario's present files; worst first.

    Args:
        dataset: Release that contains the scenario.
        scenario: Token or record; the scenario may have been left out as broken.
        deep: Whether to decode its sensor files as well; see `validate_release`.

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
    """Find everything that is wrong in one scenario's files.

    First, the functions that index a scenario report what prevents indexing. The content of the
    files is checked only if they report nothing.
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
        # The checks look for absurd numbers, which may overflow here.
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
            elif "intrinsic-form" not in {finding.code for finding in scenario_findings}:
                scenario_findings += check_first_images(subject, inventory)
    return ScenarioCheck(
        token=scenario.token,
        findings=tuple(scenario_findings),
        samples=len(scan.agents) * scan.num_frames,
        files=files_of(scenario),
        velocity=velocity,
        hashes="" if files is None else files.hashes,
    )


def _find_outdated(layout: ReleaseLayout, checks: Sequence[ScenarioCheck]) -> Findings:
    """Yield a finding for each scenario whose files differ from the ones that were indexed."""
    index = current_index(layout)
    if index is None or not index.tables:
        return
    # A damaged index is reported when the release is opened.
    with suppress(IndexStoreError):
        indexed = Tables(index.tables_folder).hashes
        for check in checks:
            hashes = indexed.get(check.token)
            if check.hashes and hashes and hashes.as_dict() != json.loads(check.hashes):
                message = "its label, calib or meta files have changed since it was indexed"
                yield make_finding("index-outdated", check.token, check.token, message)


def _find_missing_in_part(part: PartManifest, files: Completeness) -> Findings:
    """Yield findings about files that a part lacks, and about an interrupted export of it."""
    code = "part-incomplete"
    if part.release is None:
        yield make_finding(code, None, files.dataroot, "the export of this part was interrupted")
    for token, kinds in files.lacking.items():
        counts = [counted(count, f"{kind} file") for kind, count in kinds.items()]
        yield make_finding(code, token, token, f"lacks {', '.join(counts)}")


def _find_strays(layout: ReleaseLayout, part: PartManifest | None) -> Findings:
    """Yield findings about scenarios that a part lacks, and about strays.

    Strays are files and folders that look like parts of a release but are unused. `part` is the
    manifest of a part of a release, or None.
    """
    if part is not None:
        present = {scenario.token for scenario in layout.scenarios}
        for token in part.contents:
            if token not in present:
                message = f"lacks the scenario {token}"
                yield make_finding("part-incomplete", None, str(layout.root), message)
    for folder, name in names_without_calib(layout):
        location = str(folder / "*" / "calib" / name)
        message = "has labels, meta or sensor files but no calib files, and is excluded"
        yield make_finding("calib-missing", None, location, message)
    for path, likeness in find_ignored_paths(layout.root):
        if likeness is None:
            message = "the link leads to nothing, or to a folder above it"
            yield make_finding("link-leads-nowhere", None, str(path), message)
        else:
            message = f"is ignored; it looks like {likeness}"
            yield make_finding("folder-left-aside", None, str(path), message)
    if isinstance(layout.root, StorePath):
        message = "is ignored; it looks like an unfinished download"
        for archive in Path(layout.root.store.place).rglob(_UNFINISHED_PATTERN):
            yield make_finding("archive-unfinished", None, str(archive), message)
