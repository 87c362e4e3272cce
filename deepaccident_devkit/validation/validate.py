"""`validate`: all checks of a release, and their report."""

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
_LINES_A_SCENARIO = 8
_ALL_LISTED = "(--all lists all)"
# Names while a download is running: with `.part`, `.partial`, `.download` or `.crdownload` at their end.
_UNFINISHED = "*.zip.[cdp]*[dlt]"
# Kinds of files that are always read.
_READ = ("calib", "label", "meta")


@dataclass(frozen=True, slots=True, kw_only=True)
class ScenarioCheck:
    """What was found in one scenario.

    Attributes:
        token: the scenario's.
        findings: in the order of the checks.
        samples: agents times frames.
        files: how many are here and missing.
        velocity: what the labels' velocities fit.
        hashes: of the files, as of `tables.scan.content_hashes`; empty if they cannot be read.
    """

    token: str
    findings: tuple[Finding, ...]
    samples: int
    files: tuple[FileCount, ...]
    velocity: VelocityFit = NO_FIT
    hashes: str = ""

    def to_json(self) -> str:
        """One JSON object, from which `of_json` makes an equal one."""
        return json.dumps(asdict(self))

    @classmethod
    def of_json(cls, text: bytes) -> ScenarioCheck:
        """The check that `to_json` wrote."""
        return as_record(json.loads(text), cls)  # names of files may have half characters


def check_key(scenario: ScenarioFolder, *, deep: bool) -> str:
    """A digest of all that decides a scenario's check: the devkit, settings, names, sizes and times of its files."""
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
        return "\n\n".join(
            [self._head(), *self._scenario_blocks(most, notes=notes), *self._closing(notes=notes)]
        )

    def _head(self) -> str:
        depth = (
            "every file decoded"
            if self.deep
            else "labels, calib, meta and file names (--deep decodes the rest)"
        )
        return (
            f"DeepAccident {self.version} at {self.dataroot}\n"
            f"{counted(self.scenarios, 'scenario')}, {counted(self.samples, 'sample')}: {depth}"
        )

    def _scenario_blocks(self, most: int, *, notes: bool) -> Iterator[str]:
        by_scenario: dict[str | None, list[Finding]] = {}
        for finding in self.findings:
            if notes or finding.severity != "note":
                by_scenario.setdefault(finding.scenario, []).append(finding)
        for scenario, findings in by_scenario.items():
            counts = Counter(finding.severity for finding in findings)
            head = ", ".join(
                counted(counts[severity], severity) for severity in SEVERITIES if counts[severity]
            )
            lines = [f"{scenario or 'the release'}  ({head})"]
            lines += [_line(finding) for finding in findings[:most]]
            if len(findings) > most:
                lines.append(f"  … and {len(findings) - most} more {_ALL_LISTED}")
            yield "\n".join(lines)

    def _closing(self, *, notes: bool) -> Iterator[str]:
        by_code = Counter(
            (finding.severity, finding.code, finding.known) for finding in self.findings
        )
        if by_code:
            lines = (
                f"{code:<24} {severity:<8} {count:>8}{'  known of the release' if known else ''}"
                for severity in SEVERITIES
                for (grade, code, known), count in sorted(
                    by_code.items(), key=lambda item: (-item[1], item[0][1])
                )
                if grade == severity
            )
            yield "\n".join([f"{'kind':<24} {'how bad':<8} {'findings':>8}", *lines])
        if self.velocity.boxes:
            shares = ", ".join(
                f"{name} {count / self.velocity.boxes:.0%}"
                for name, count in self.velocity.fits.items()
            )
            best = (
                VELOCITY_FRAMES[self.velocity.best]
                if self.velocity.best
                else "in none of the known frames"
            )
            found = Counter(self.velocity_frames.values())
            scenarios = ", ".join(
                f"{name or 'unknown'} in {count}" for name, count in found.most_common()
            )
            yield (
                f"label velocities: {best}\n"
                f"  scenarios: {scenarios}; of {self.velocity.boxes:,} moving boxes fit: {shares}"
            )
        yield f"files: {self.files.section()}"
        yield self.basis_text()
        hidden = self.counts["note"] and not notes
        verdict = ", ".join(counted(self.counts[severity], severity) for severity in SEVERITIES)
        yield verdict + (" (--all lists the notes)" if hidden else "")


def worst_first(findings: Sequence[Finding]) -> list[Finding]:
    """Findings grouped by scenario: the one with the most errors first, then warnings; worst first within."""
    counts = Counter((finding.scenario, finding.severity) for finding in findings)

    def place(finding: Finding) -> tuple[object, ...]:
        badness = [-counts[finding.scenario, severity] for severity in SEVERITIES]
        rank = SEVERITIES.index(finding.severity)
        return (finding.scenario is not None, badness, finding.scenario or "", rank)

    return sorted(findings, key=place)


def _line(finding: Finding) -> str:
    known = " (known of the release)" if finding.known else ""
    return f"  {finding.severity:<7} {finding.code}: {finding}{known}"


def validate_release(
    root: Dataroot,
    version: str = "v1",
    *,
    deep: bool = False,
    scenarios: Collection[str] | None = None,
    parts: Path | None = None,
    **how: Unpack[Engine],
) -> ValidationReport:
    """Look for everything that is wrong, odd or missing in a release; needs no index, and says if one is out of date.

    Args:
        root: the release, as of `DeepAccident`: a folder, archives, or a URL.
        version: `v1` or `v1-mini`.
        deep: also decode every image, point cloud and BEV array and hold them against the labels.
        scenarios: tokens of the scenarios to look at; None for all.
        parts: folder to keep what was found in each scenario, so that the same call does only what is left, and several
            processes that are given it share the scenarios; one whose files have changed since is looked at again.
            None writes nothing.
        **how: `workers`, `executor` and `progress`, as `parallel.Engine` says.

    Raises:
        DatarootError: the folder is missing, holds no release, or a part of it cannot be listed.
        VersionError: the version is unknown or not under this folder.
        TokenError: one of `scenarios` is not there.
        ConfigError: `parts` cannot be written to.
    """
    layout = readable_release(root, version)
    folder = None if parts is None else writable_folder(parts)
    store = None if folder is None else Store(folder, folder, "validates scenarios", ConfigError)
    checks = _Work(deep=deep, store=store).run(chosen_scenarios(layout, scenarios), **how)
    return _report(layout, checks, scenarios, root=root, deep=deep)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Work:
    """What workers do; cheap to pickle.

    Attributes:
        deep: whether sensor files are decoded.
        store: what was found before, and is found now.
    """

    deep: bool
    store: Store | None

    def __call__(self, scenario: ScenarioFolder) -> ScenarioCheck:
        """Look at one scenario, unless that was done."""
        if self.store is None:
            return check_scenario(scenario, deep=self.deep)
        key = check_key(
            scenario, deep=self.deep
        )  # before anything is read: a later edit is noticed
        kept = self.store.kept(_name(scenario), key)
        if kept is not None:
            return ScenarioCheck.of_json(kept)
        check = check_scenario(scenario, deep=self.deep)
        self.store.keep(_name(scenario), key, check.to_json().encode())
        return check

    def run(
        self, scenarios: Sequence[ScenarioFolder], **how: Unpack[Engine]
    ) -> list[ScenarioCheck]:
        """Look at all of them."""
        reads = tuple({place for scenario in scenarios for place in places_of(scenario.root)})
        label = "validating scenarios"
        if self.store is None:
            return run_batch(self, scenarios, label=label, places=Places(reads=reads), **how)
        with self.store.shared():
            places, items = (
                Places(reads=reads, writes=(self.store.folder,)),
                {_name(each): each for each in scenarios},
            )
            return list(self.store.run(self, items, label=label, places=places, **how).values())


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
    """What was found in scenarios, and in the release as a whole."""
    readable, of_release = check_split_files(layout)
    tokens = {check.token for check in checks}
    of_release = [
        finding for finding in of_release if finding.scenario is None or finding.scenario in tokens
    ]
    of_release += _strays(layout) if scenarios is None else ()
    of_release += _outdated(layout, checks)
    counts = ((check.token, check.files) for check in checks)
    files = completeness(readable, counts, str(root), selected=scenarios is not None)
    for sentence in files.unreadable_archives:
        of_release.append(finding_of(ReleaseError(sentence), "archive-unreadable", None))
    here = Counter[str]()
    for file in (file for check in checks for file in check.files if deep or file.channel in _READ):
        here[f"{file.channel} files"] += file.expected - file.missing
    return ValidationReport(
        compared=dict(here),
        dataroot=str(root),
        version=layout.version,
        deep=deep,
        scenarios=len(checks),
        samples=sum(check.samples for check in checks),
        findings=worst_first(
            [*of_release, *(finding for check in checks for finding in check.findings)]
        ),
        files=files,
        velocity=total_fit([check.velocity for check in checks]),
        velocity_frames={check.token: check.velocity.best for check in checks},
    )


def findings(dataset: Dataset, scenario: RowArgument, *, deep: bool = False) -> list[Finding]:
    """What is wrong, odd or missing in one scenario, by the files as they are now; worst first.

    Args:
        dataset: the release.
        scenario: token or record; one that was left out as broken can be named too.
        deep: also decode its sensor files; see `validate_release`.

    Raises:
        TokenError: the release has no such scenario.
    """
    token = token_of(scenario)
    report = validate_release(
        dataset.dataroot, dataset.version, deep=deep, workers=1, scenarios=[token]
    )
    return [finding for finding in report.findings if finding.scenario == token]


@checksums_compared()
def check_scenario(scenario: ScenarioFolder, *, deep: bool = False) -> ScenarioCheck:
    """All findings in one scenario's files.

    The functions that index a scenario find what keeps it from being indexed. The meaning of its files is checked only
    if they find nothing.
    """
    scan = scan_scenario(scenario)
    inventory, of_files = take_inventory(scenario, scan)
    found = [*scan.problems, *absences(scenario, scan), *of_files]
    files, faults = (
        (None, []) if scan.problems or not scan.agents else read_scenario(scenario, scan)
    )
    found += faults
    velocity = NO_FIT
    if files is not None:
        with np.errstate(all="ignore"):  # absurd numbers are what is looked for
            subject = subject_of(files)
            velocity = fit_velocities(subject.boxes, subject.velocity)
            found += [
                *check_poses(subject),
                *check_labels(subject),
                *check_agreement(subject),
                *check_untracked(subject),
                *check_velocities(subject, velocity),
                *check_story(subject),
                *(check_sensors(subject, inventory) if deep else ()),
            ]
    return ScenarioCheck(
        token=scenario.token,
        findings=tuple(found),
        samples=len(scan.agents) * scan.num_frames,
        files=files_of(scenario),
        velocity=velocity,
        hashes="" if files is None else files.hashes,
    )


def _outdated(layout: ReleaseLayout, checks: Sequence[ScenarioCheck]) -> Iterator[Finding]:
    """Find the scenarios whose files are not those that the index was made from."""
    index = current_index(layout)
    if index is None or not index.tables:
        return
    with suppress(IndexStoreError):  # a damaged index; opening the release reports it
        indexed = Tables(index.tables_folder).hashes
        for check in checks:
            before = indexed.get(check.token)
            if check.hashes and before and before.as_dict() != json.loads(check.hashes):
                what = "its label, calib or meta files have changed since the index was made"
                yield make_finding("index-outdated", check.token, check.token, what)


def _strays(layout: ReleaseLayout) -> Iterator[Finding]:
    for folder, name in names_without_calib(layout):
        what = "has labels, meta or sensor files, but no calib files of any agent, and is left out"
        yield make_finding("calib-missing", None, str(folder / "*" / "calib" / name), what)
    for path, meant in left_aside(layout.root):
        if meant is None:
            yield make_finding(
                "link-leads-nowhere",
                None,
                str(path),
                "its end is not there, or is a folder above it",
            )
        else:
            yield make_finding(
                "folder-left-aside", None, str(path), f"is not read; it looks like {meant}"
            )
    for path in (
        Path(layout.root.store.place).rglob(_UNFINISHED)
        if isinstance(layout.root, StorePath)
        else ()
    ):
        yield make_finding(
            "archive-unfinished", None, str(path), "is not read; it looks like half a download"
        )
