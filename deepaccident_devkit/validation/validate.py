"""Looking at a whole release, or at one scenario: the checks in their order."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import TokenError
from deepaccident_devkit.files import writable_folder, write_bytes
from deepaccident_devkit.parallel import Places, Shard, check_whole, run_batch
from deepaccident_devkit.release import ReleaseLayout, ScenarioFolder, find_release
from deepaccident_devkit.release.layout import left_aside, names_without_calib
from deepaccident_devkit.release.store import Dataroot, checksums_compared, open_dataroot, places_of
from deepaccident_devkit.tables import Finding
from deepaccident_devkit.tables.build import read_scenario
from deepaccident_devkit.tables.scan import scan_scenario
from deepaccident_devkit.tables.velocities import fit_velocities, total_fit
from deepaccident_devkit.validation.agreement import check_agreement
from deepaccident_devkit.validation.checks import NO_FIT, ScenarioCheck, kept_check, kept_path
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
        parts: folder to keep what was found in each scenario, so that the same call, or one of shards, does only what
            is left; of a scenario whose files have changed since, nothing is left. None writes nothing.
        progress: whether to show a progress bar.

    Raises:
        DatarootError: the folder is missing, holds no release, or a part of it cannot be listed.
        VersionError: the version is unknown or not under this folder.
        TokenError: one of `scenarios` is not there.
        ConfigError: `parts` cannot be written to.
        WorkerError: a worker was killed, or cannot do the work.
    """
    layout = find_release(open_dataroot(root), version)
    work = _Work(deep=deep, parts=None if parts is None else writable_folder(parts))
    how: dict[str, Any] = {"workers": workers, "executor": executor, "progress": progress}
    checks = work.run(chosen_scenarios(layout, scenarios), **how)
    return _report(layout, checks, scenarios, root=root, deep=deep, **how)


def validation_shard(root: Dataroot, shard: Shard, parts: Path, version: str = "v1", **how: Any) -> list[ScenarioCheck]:
    """Look at a part of a release, and keep what was found for `merged_validation`.

    Args:
        root: the release, as of `DeepAccident`: a folder, archives, or a URL.
        shard: which part of its scenarios, or of `scenarios`.
        parts: folder that all shards write into; what is there already is not done again.
        version: `v1` or `v1-mini`.
        **how: of `validate_release`: `deep`, `workers`, `executor`, `scenarios`, `progress`.

    Raises:
        ConfigError, DatarootError, VersionError, TokenError, WorkerError: as of `validate_release`.
    """
    layout = find_release(open_dataroot(root), version)
    chosen = shard.of(chosen_scenarios(layout, how.pop("scenarios", None)))
    return _Work(deep=how.pop("deep", False), parts=writable_folder(parts)).run(chosen, **how)


def merged_validation(root: Dataroot, parts: Path, version: str = "v1", **how: Any) -> ValidationReport:
    """What `validate_release` gives, from what the shards kept; arguments are those of `validation_shard`.

    Raises:
        UnfinishedError: a scenario is not done, or only with other settings, by another devkit, or with other files.
        DatarootError, VersionError, TokenError, WorkerError: as of `validate_release`.
    """
    layout = find_release(open_dataroot(root), version)
    scenarios, deep = how.pop("scenarios", None), how.pop("deep", False)
    checks = _Work(deep=deep, parts=parts, merge=True).run(chosen_scenarios(layout, scenarios), **how)
    return _report(layout, checks, scenarios, root=root, deep=deep, **how)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Work:
    """What workers do; cheap to pickle.

    Attributes:
        deep: whether sensor files are decoded.
        parts: folder of what was found before, and is found now.
        merge: whether nothing is looked at that is not there.
    """

    deep: bool
    parts: Path | None
    merge: bool = False

    def __call__(self, scenario: ScenarioFolder) -> ScenarioCheck | None:
        """Look at one scenario; None if it should be there and is not."""
        if self.parts is None:
            return check_scenario(scenario, deep=self.deep)
        path = kept_path(self.parts, scenario, deep=self.deep)  # before anything is read: a later edit is noticed
        check = kept_check(path)
        if check is None and not self.merge:
            check = check_scenario(scenario, deep=self.deep)
            write_bytes(path, check.to_json().encode())
        return check

    def run(self, scenarios: Sequence[ScenarioFolder], **how: Any) -> list[ScenarioCheck]:
        """Look at all of them; raises UnfinishedError if one is not there."""
        places = Places(
            reads=tuple({place for scenario in scenarios for place in places_of(scenario.root)}),
            writes=() if self.parts is None else (self.parts,),
        )
        found = run_batch(self, scenarios, label="validating scenarios", places=places, **how)
        names = [str(Path(scenario.folder, scenario.token)) for scenario in scenarios]
        done = {name: check for name, check in zip(names, found, strict=True) if check is not None}
        check_whole(names, done, self.parts)
        return list(done.values())


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
