"""Looking at a whole release, or at one scenario: the checks in their order."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import TokenError
from deepaccident_devkit.parallel import run_batch
from deepaccident_devkit.release import ReleaseLayout, ScenarioFolder, find_release
from deepaccident_devkit.release.layout import names_without_calib
from deepaccident_devkit.tables import Finding
from deepaccident_devkit.tables.build import read_scenario
from deepaccident_devkit.tables.scan import scan_scenario
from deepaccident_devkit.tables.split_assignment import SplitAssignment
from deepaccident_devkit.tables.velocities import VelocityFit, fit_velocities, total_fit
from deepaccident_devkit.taxonomy import EXPECTED_MINI_SCENARIOS, EXPECTED_SCENARIOS
from deepaccident_devkit.validation.agreement import check_agreement
from deepaccident_devkit.validation.inventory import Recording, absences, take_inventory
from deepaccident_devkit.validation.labels import check_labels
from deepaccident_devkit.validation.poses import check_poses
from deepaccident_devkit.validation.report import (
    UNKNOWN_SPLIT,
    Coverage,
    ValidationReport,
    empty_recordings,
    worst_first,
)
from deepaccident_devkit.validation.sensors import check_sensors
from deepaccident_devkit.validation.split_files import check_splits
from deepaccident_devkit.validation.story import check_story
from deepaccident_devkit.validation.subject import make_finding, subject_of
from deepaccident_devkit.validation.untracked import check_untracked
from deepaccident_devkit.validation.velocities import check_velocities

_NO_FIT = total_fit([])


@dataclass(frozen=True, slots=True, kw_only=True)
class ScenarioCheck:
    """What was found in one scenario.

    Attributes:
        token: the scenario's.
        findings: in the order of the checks.
        samples: agents times frames.
        recordings: which agents have which kinds of file.
        velocity: what the labels' velocities fit.
    """

    token: str
    findings: tuple[Finding, ...]
    samples: int
    recordings: frozenset[Recording]
    velocity: VelocityFit = _NO_FIT


def validate_release(
    root: Path,
    version: str = "v1",
    *,
    deep: bool = False,
    workers: int | None = None,
    scenarios: Collection[str] | None = None,
    progress: bool = False,
) -> ValidationReport:
    """Look for everything that is wrong, odd or missing in a release; needs no index and writes nothing.

    Args:
        root: the release's folder.
        version: `v1` or `v1-mini`.
        deep: also decode every image, point cloud and BEV array and hold them against the labels.
        workers: processes to use; see `parallel.run_batch`.
        scenarios: tokens of the scenarios to look at; None for all.
        progress: whether to show a progress bar.

    Raises:
        DatarootError: the folder is missing, holds no release, or a part of it cannot be listed.
        VersionError: the version is unknown or not under this folder.
        TokenError: one of `scenarios` is not there.
        WorkerError: a worker was killed.
    """
    layout = find_release(root, version)
    chosen = [folder for folder in layout.scenarios if scenarios is None or folder.token in scenarios]
    unknown = sorted(set(scenarios or ()) - {folder.token for folder in chosen})
    if unknown:
        raise TokenError(f"{root}: has no scenario {unknown[0]!r}; its folders name {len(layout.scenarios)} others")
    checks = run_batch(
        partial(check_scenario, deep=deep), chosen, workers=workers, label="validating scenarios", progress=progress
    )
    splits, of_release = check_splits(layout)
    tokens = {check.token for check in checks}
    of_release = [finding for finding in of_release if finding.scenario is None or finding.scenario in tokens]
    of_release += _strays(layout) if scenarios is None else ()
    return ValidationReport(
        dataroot=str(root),
        version=version,
        deep=deep,
        scenarios=len(checks),
        samples=sum(check.samples for check in checks),
        findings=worst_first([*of_release, *(finding for check in checks for finding in check.findings)]),
        coverage=_coverage(version, checks if scenarios is None else [], splits),
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
    token = scenario.get("token") if isinstance(scenario, Mapping) else scenario
    if not isinstance(token, str):
        raise TokenError(f"scenario: expected a token or a record with one, found {scenario!r}")
    report = validate_release(dataset.dataroot, dataset.version, deep=deep, workers=1, scenarios=[token])
    return [finding for finding in report.findings if finding.scenario == token]


def check_scenario(scenario: ScenarioFolder, *, deep: bool = False) -> ScenarioCheck:
    """All findings in one scenario's files.

    The functions that index a scenario find what keeps it from being indexed. The meaning of its files is checked only
    if they find nothing.
    """
    scan = scan_scenario(scenario)
    inventory, of_files = take_inventory(scenario, scan)
    found = [*scan.problems, *absences(scenario, scan), *of_files]
    recordings = {*inventory.frames, *((agent, "calib") for agent in scan.agents)}
    recordings |= {(agent, "label") for agent in scan.labelled}
    files, faults = (None, []) if scan.problems or not scan.agents else read_scenario(scenario, scan)
    found += faults
    velocity = _NO_FIT
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
        recordings=frozenset(recordings),
        velocity=velocity,
    )


def _strays(layout: ReleaseLayout) -> Iterator[Finding]:
    for folder, name in names_without_calib(layout):
        what = "has labels, meta or sensor files, but no calib files of any agent, and is left out"
        yield make_finding("calib-missing", None, str(folder / "*" / "calib" / name), what)


def _coverage(version: str, checks: Sequence[ScenarioCheck], splits: SplitAssignment) -> Coverage:
    """Scenarios and recordings by split; the mini release counts as one; nothing where only some were looked at."""
    if not checks:
        return Coverage(scenarios={}, expected={}, recordings={})
    mini = version == "v1-mini"
    scenarios: dict[str, int] = {}
    recordings: dict[str, dict[str, dict[str, int]]] = {}
    for check in checks:
        split = version if mini else splits.split_of.get(check.token, UNKNOWN_SPLIT)
        scenarios[split] = scenarios.get(split, 0) + 1
        counts = recordings.setdefault(split, empty_recordings())
        for agent, kind in check.recordings:
            counts[agent][kind] += 1
    return Coverage(
        scenarios=scenarios,
        expected={version: EXPECTED_MINI_SCENARIOS} if mini else EXPECTED_SCENARIOS,
        recordings=recordings,
    )
