"""Exports of many scenarios: planned, written unit by unit in parallel, resumed where they were stopped."""

from __future__ import annotations

import logging
import os
import shutil
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from deepaccident_devkit.errors import ExportError, MissingFileError, NotAvailableError
from deepaccident_devkit.export.bulk.format import Format, Plan, Unit
from deepaccident_devkit.export.bulk.manifest import Manifest, remove_half_written
from deepaccident_devkit.export.bulk.output import Tally
from deepaccident_devkit.export.bulk.unfinished import Unfinished
from deepaccident_devkit.files import path_of
from deepaccident_devkit.parallel import Places, run_batch
from deepaccident_devkit.release.fingerprints import digest_of, folder_hashes, scenario_folders, sensor_digest
from deepaccident_devkit.release.layout import ScenarioFolder
from deepaccident_devkit.selection import find

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from deepaccident_devkit.dataset import Dataset

logger = logging.getLogger(__name__)

_SENSORS: Final = "sensors"
"""Name of the hash of the list of a scenario's sensor files, beside the hashes of its truth."""
Job: TypeAlias = tuple[Unit, tuple[ScenarioFolder, ...]]
"""A unit, and where its scenarios lie."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Exported:
    """What an export did.

    Attributes:
        folder: where it is.
        plan: of all of it.
        written: units that were written now.
        kept: units that were there already.
        tally: counts of all that is in the folder; empty for a dry run.
    """

    folder: Path
    plan: Plan
    written: int
    kept: int
    tally: Tally


def export_release(
    dataset: Dataset,
    folder: str | os.PathLike[str],
    form: Format,
    *,
    workers: int | None = None,
    executor: Executor | None = None,
    progress: bool = False,
    dry_run: bool = False,
    on_plan: Callable[[Plan, int], object] | None = None,
) -> Exported:
    """Write scenarios of a release in another format. If a call is interrupted, the same call continues it.

    Several processes that make the same call share the scenarios.

    What is continued equals an undisturbed call: scenarios whose label, meta or calib files have changed since are
    written again. A complete export is compared with the release: units whose sensor files have come, gone or changed
    their size are written again, and other changes are refused.

    Args:
        dataset: the release.
        folder: made where needed; or one with an export with the same settings.
        form: the format, with which scenarios and agents, and its own settings.
        workers: processes; None chooses by the amount of work.
        executor: any executor of `concurrent.futures` to run on, in place of own workers.
        progress: whether to show bars.
        dry_run: only plan; nothing is written, and the folder is not made.
        on_plan: called with the plan and the bytes that are free, before anything is written.

    Raises:
        ConfigError: the folder holds an export with other settings; it is left as it is.
        ExportError: the folder holds something else, there is too little room, it cannot be written to, or it was made
            from other scenarios or another state of them.
        OutputFolderError: a link in the folder leads out of it; nothing is written there.
        NotAvailableError: no scenario or no sample is left to export, or the release has no such split.
        ChoiceError, FieldError: no such filter, or `workers` is less than 1.
        SomeFailedError: files of some scenarios cannot be read; the others are written, and the same call continues.
        WorkerError: a worker was killed, or cannot do the work.
    """
    root = path_of(folder, "expected a folder for the export", error=ExportError).absolute()
    scenarios = _chosen(dataset, form)
    settings = {**form.settings(), "version": dataset.version}
    manifest = Manifest.of(root, form.name, settings, form.beside)
    unfinished = Unfinished(root, form.name, digest_of({"format": form.name, "settings": settings, "of": scenarios}))
    task, units = _Work(dataset, form, unfinished), form.units(dataset, scenarios)
    engine: dict[str, Any] = {"workers": workers, "executor": executor, "progress": progress}
    run: Callable[..., list[Any]] = partial(run_batch, **engine)
    plans = run(task.plan, units, label="planning", places=Places(reads=dataset.places))
    plan = sum(plans, Plan())
    if not plan.samples:
        raise NotAvailableError(form.nothing)
    free = shutil.disk_usage(next(each for each in (root, *root.parents) if each.exists())).free
    exported = partial(Exported, folder=root, plan=plan)
    if on_plan is not None:
        on_plan(plan, free)
    if not manifest.complete:
        _check_room(task, dict(zip(units, plans, strict=True)), free)
    if dry_run:
        return exported(written=0, kept=0, tally=Tally())
    form.check(dataset, root)
    folders = _folders(dataset, scenarios)
    compare = partial(run, task.state, list(folders.values()), label="comparing", places=Places(reads=dataset.places))
    if _is_current(manifest, root, folders, compare):
        return exported(written=0, kept=len(units), tally=manifest.tally)
    whole, written = _completed(task, manifest, units, folders, engine)
    return exported(written=written, kept=len(units) - written, tally=whole.tally)


def _completed(
    task: _Work,
    manifest: Manifest,
    units: Sequence[Unit],
    folders: Mapping[str, ScenarioFolder],
    engine: dict[str, Any],
) -> tuple[Manifest, int]:
    """Write what is left of an export, beside others that write it; its manifest, and how many units are new."""
    unfinished, form, dataset = task.unfinished, task.form, task.dataset
    root, settings = unfinished.root, manifest.settings

    def completed() -> Manifest | None:
        """The manifest, if another process has completed the export meanwhile."""
        found = Manifest.of(root, form.name, settings, form.beside)
        return found if found.complete and not manifest.complete else None

    def begin() -> None:
        if completed() is None:
            Manifest(name=form.name, settings=settings).write(root)
            unfinished.remove_others(units)

    with unfinished.store.shared(begin, tidy=partial(remove_half_written, root)) as turn:
        if (whole := completed()) is not None:
            unfinished.remove(keep=bool(form.sensors()))
            return whole, 0
        jobs = {unit.name: (unit, tuple(folders[token] for token in unit.scenarios)) for unit in units}
        places = Places(reads=dataset.places, writes=(root,))
        done = unfinished.store.run(task.write, jobs, label=form.name, places=places, **engine)
        if turn.alone() and completed() is None:
            whole = task.finished(units, list(done.values()), settings)
            unfinished.remove(keep=bool(form.sensors()))  # else no later download changes it
            whole.write(root)
        else:
            whole = Manifest.of(root, form.name, settings, form.beside)
    return whole, sum(each.new for each in done.values())


@dataclass(frozen=True, slots=True)
class _Done:
    """A unit that was written: the states of its scenarios and its counts, and whether that was now."""

    scenarios: Mapping[str, Any]
    tally: Tally
    new: bool


@dataclass(frozen=True, slots=True)
class _Work:
    """What workers do; cheap to pickle."""

    dataset: Dataset
    form: Format
    unfinished: Unfinished

    def plan(self, unit: Unit) -> Plan:
        """About how much a unit is."""
        return self.form.plan(self.dataset, unit)

    def state(self, folder: ScenarioFolder) -> dict[str, str | None]:
        """What is compared of a scenario: the hashes of its truth, and of the list of its sensor files."""
        sensors = self.form.sensors()
        listed = {_SENSORS: sensor_digest(folder, sensors)} if sensors else {}
        return {**folder_hashes(folder).as_dict(), **listed}

    def write(self, job: Job) -> _Done:
        """Write a unit, unless it was written from the same files before."""
        unit, folders = job
        states = {each.token: self.state(each) for each in folders}
        tally = self.unfinished.done(unit, states)
        if tally is not None:
            return _Done(states, tally, new=False)
        with self.unfinished.output(self.form.link, unit) as output:
            self.form.write(self.dataset, unit, output)
        self.unfinished.set_done(unit, states, output.tally)
        return _Done(states, output.tally, new=True)

    def finished(self, units: Sequence[Unit], done: Sequence[_Done], settings: Mapping[str, Any]) -> Manifest:
        """Write what spans units; the manifest of the complete export."""
        with self.unfinished.output(self.form.link) as output:
            self.form.finish(self.dataset, units, output, self.unfinished.parts)
        scenarios: dict[str, Any] = {}
        for each in done:
            scenarios.update(each.scenarios)
            output.tally.add(each.tally)
        return Manifest(
            name=self.form.name,
            settings=settings,
            fingerprint=digest_of(_truth(scenarios)),
            scenarios=scenarios,
            tally=output.tally,
        )


def _chosen(dataset: Dataset, form: Format) -> list[str]:
    """The tokens of the scenarios to export, in the table's order."""
    of_split = None if form.split is None else dataset.split_scenarios(form.split)
    found = [record["token"] for record in find(dataset, *form.where)]
    chosen = [token for token in found if of_split is None or token in of_split]
    if not chosen:
        raise NotAvailableError("no scenario of this release is in that split and matches the filters; change them")
    return chosen


def _check_room(task: _Work, plans: Mapping[Unit, Plan], free: int) -> None:
    """Raise ExportError if what is not written yet needs more bytes than are free."""
    left = sum((plan for unit, plan in plans.items() if not task.unfinished.is_written(unit)), Plan())
    need = left.bytes + (left.linked_bytes if task.form.link == "copy" else 0)
    if need > free:
        raise ExportError(
            f"{task.unfinished.root}: the export needs about {need / 1e9:.1f} GB, and {free / 1e9:.1f} GB are free; "
            "choose another disk, or fewer scenarios or agents"
        )


def _folders(dataset: Dataset, scenarios: Sequence[str]) -> dict[str, ScenarioFolder]:
    """Where scenarios lie."""
    folders = scenario_folders(dataset, scenarios)
    for token in scenarios:
        if token not in folders:
            raise MissingFileError(f"{dataset.dataroot}: scenario {token} is gone; open the release again")
    return folders


def _truth(states: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """States of scenarios without their sensor files."""
    return {token: {name: each for name, each in state.items() if name != _SENSORS} for token, state in states.items()}


def _is_current(
    manifest: Manifest, root: Path, scenarios: Collection[str], compare: Callable[[], Sequence[Mapping[str, Any]]]
) -> bool:
    """Whether an export is complete and has the sensor files of today; raises ExportError if its truth was another."""
    if not manifest.complete:
        return False
    now = dict(zip(scenarios, compare(), strict=True))
    before, after = _truth(manifest.scenarios), _truth(now)
    changed = sorted(token for token in {*before, *after} if before.get(token) != after.get(token))
    if changed:
        raise ExportError(
            f"{root}: was made from another state of the release, or a split file ({len(changed)} scenarios have "
            f"changed, come or gone since, such as {changed[0]}); choose another folder"
        )
    if before == manifest.scenarios and after != now:
        logger.warning(
            "%s: was made by an earlier version, which did not note the sensor files; whether some have come or gone "
            "since is unknown: if so, export again into an empty folder",
            root,
        )
        return True
    return manifest.scenarios == now
