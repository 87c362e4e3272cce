"""Looking at a whole release, or at one scenario: the checks in their order."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ConfigError, TokenError
from deepaccident_devkit.files import writable_folder
from deepaccident_devkit.parallel import Places, Store, run_batch
from deepaccident_devkit.release import ReleaseLayout, ScenarioFolder, find_release
from deepaccident_devkit.release.layout import left_aside, names_without_calib
from deepaccident_devkit.release.store import Dataroot, checksums_compared, open_dataroot, places_of
from deepaccident_devkit.tables import Finding
from deepaccident_devkit.tables.build import read_scenario
from deepaccident_devkit.tables.scan import scan_scenario
from deepaccident_devkit.tables.velocities import fit_velocities, total_fit
from deepaccident_devkit.validation.agreement import check_agreement
from deepaccident_devkit.validation.checks import NO_FIT, ScenarioCheck, check_key
from deepaccident_devkit.validation.completeness import chosen_scenarios, completeness
from deepaccident_devkit.validation.inventory import absences, take_inventory
from deepaccident_devkit.validation.labels import check_labels
from deepaccident_devkit.validation.poses import check_poses
from deepaccident_devkit.validation.report import ValidationReport, worst_first
from deepaccident_devkit.validation.sensors import check_sensors
from deepaccident_devkit.validation.split_files import check_splits
from deepaccident_devkit.validation.story import check_story
from deepaccident_devkit.validation.subject import make_finding, subject_of
from deepaccident_devkit.validation.untracked import check_untracked
from deepaccident_devkit.validation.velocities import check_velocities

if TYPE_CHECKING:
    from concurrent.futures import Executor


def validate_release(
    root: Dataroot,
    version: str = "v1",
    *,
    deep: bool = False,
    workers: int | None = None,
    executor: Executor | None = None,
    scenarios: Collection[str] | None = None,
    parts: Path | None = None,
    progress: bool = False,
) -> ValidationReport:
    """Look for everything that is wrong, odd or missing in a release; needs no index.

    Args:
        root: the release, as of `DeepAccident`: a folder, archives, or a URL.
        version: `v1` or `v1-mini`.
        deep: also decode every image, point cloud and BEV array and hold them against the labels.
        workers: processes to use; see `parallel.run_batch`.
        executor: any executor of `concurrent.futures` to run on, in place of own workers.
        scenarios: tokens of the scenarios to look at; None for all.
        parts: folder to keep what was found in each scenario, so that the same call does only what is left, and several
            processes that are given it share the scenarios; one whose files have changed since is looked at again.
            None writes nothing.
        progress: whether to show a progress bar.

    Raises:
        DatarootError: the folder is missing, holds no release, or a part of it cannot be listed.
        VersionError: the version is unknown or not under this folder.
        TokenError: one of `scenarios` is not there.
        ConfigError: `parts` cannot be written to.
        WorkerError: a worker was killed, or cannot do the work.
    """
    layout = find_release(open_dataroot(root), version)
    folder = None if parts is None else writable_folder(parts)
    store = None if folder is None else Store(folder, folder, "validates scenarios", ConfigError)
    how: dict[str, Any] = {"workers": workers, "executor": executor, "progress": progress}
    checks = _Work(deep=deep, store=store).run(chosen_scenarios(layout, scenarios), **how)
    return _report(layout, checks, scenarios, root=root, deep=deep, **how)


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
        key = check_key(scenario, deep=self.deep)  # before anything is read: a later edit is noticed
        kept = self.store.kept(_name(scenario), key)
        if kept is not None:
            return ScenarioCheck.of_json(kept)
        check = check_scenario(scenario, deep=self.deep)
        self.store.keep(_name(scenario), key, check.to_json().encode())
        return check

    def run(self, scenarios: Sequence[ScenarioFolder], **how: Any) -> list[ScenarioCheck]:
        """Look at all of them."""
        reads = tuple({place for scenario in scenarios for place in places_of(scenario.root)})
        how |= {"label": "validating scenarios"}
        if self.store is None:
            return run_batch(self, scenarios, places=Places(reads=reads), **how)
        with self.store.shared():
            places = Places(reads=reads, writes=(self.store.folder,))
            return list(self.store.run(self, {_name(each): each for each in scenarios}, places=places, **how).values())


def _name(scenario: ScenarioFolder) -> str:
    return Path(scenario.folder, scenario.token).as_posix()


def _report(
    layout: ReleaseLayout,
    checks: Sequence[ScenarioCheck],
    scenarios: Collection[str] | None,
    *,
    root: Dataroot,
    deep: bool,
    **how: Any,
) -> ValidationReport:
    """What was found in scenarios, and in the release as a whole."""
    readable, of_release = check_splits(layout)
    tokens = {check.token for check in checks}
    of_release = [finding for finding in of_release if finding.scenario is None or finding.scenario in tokens]
    of_release += _strays(layout) if scenarios is None else ()
    return ValidationReport(
        dataroot=str(root),
        version=layout.version,
        deep=deep,
        scenarios=len(checks),
        samples=sum(check.samples for check in checks),
        findings=worst_first([*of_release, *(finding for check in checks for finding in check.findings)]),
        files=completeness(readable, scenarios, str(root), lenient=True, **how),
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


@checksums_compared()
def check_scenario(scenario: ScenarioFolder, *, deep: bool = False) -> ScenarioCheck:
    """All findings in one scenario's files.

    The functions that index a scenario find what keeps it from being indexed. The meaning of its files is checked only
    if they find nothing.
    """
    scan = scan_scenario(scenario)
    inventory, of_files = take_inventory(scenario, scan)
    found = [*scan.problems, *absences(scenario, scan), *of_files]
    files, faults = (None, []) if scan.problems or not scan.agents else read_scenario(scenario, scan)
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
        velocity=velocity,
    )


def _strays(layout: ReleaseLayout) -> Iterator[Finding]:
    for folder, name in names_without_calib(layout):
        what = "has labels, meta or sensor files, but no calib files of any agent, and is left out"
        yield make_finding("calib-missing", None, str(folder / "*" / "calib" / name), what)
    for path, meant in left_aside(layout.root):
        if meant is None:
            yield make_finding("link-leads-nowhere", None, str(path), "its end is not there, or is a folder above it")
        else:
            yield make_finding("folder-left-aside", None, str(path), f"is not read; it looks like {meant}")
