"""Exports of many scenarios: planned, written unit by unit in parallel, resumed where they were stopped."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from deepaccident_devkit.errors import ExportError, NotAvailableError
from deepaccident_devkit.export.bulk.format import Format, Plan, Unit
from deepaccident_devkit.export.bulk.manifest import PARTS, Manifest, remove_parts, writing_to
from deepaccident_devkit.export.bulk.output import Output, Tally
from deepaccident_devkit.files import write_bytes
from deepaccident_devkit.json_text import parsed_json
from deepaccident_devkit.parallel import run_batch
from deepaccident_devkit.reading import read_bytes
from deepaccident_devkit.release.fingerprints import digest_of, scenario_hashes
from deepaccident_devkit.selection import find

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from deepaccident_devkit.dataset import Dataset

_DONE = "done.json"


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

    Args:
        dataset: the release.
        folder: made where needed; or one with an unfinished export with the same settings.
        form: the format, with which scenarios and agents, and its own settings.
        workers: processes; None chooses by the amount of work.
        executor: any executor of `concurrent.futures` to run on, in place of own workers.
        progress: whether to show a bar.
        dry_run: only plan.
        on_plan: called with the plan and the bytes that are free, before anything is written.

    Raises:
        ConfigError: the folder holds an export with other settings; it is left as it is.
        ExportError: the folder holds something else, there is too little room, it cannot be written to, or it was made
            from another state of the release.
        NotAvailableError: no scenario is left to export.
        ChoiceError, FieldError: no such split or filter.
        ReleaseError: a file of the release cannot be read.
        WorkerError: a worker was killed.
    """
    if not os.fspath(folder):
        raise ExportError("expected a folder for the export, found an empty path; give '.' for the current one")
    root = Path(folder).expanduser().absolute()
    scenarios = _chosen(dataset, form)
    settings = {**form.settings(), "version": dataset.version}
    manifest = Manifest.of(root, form.name, settings, form.beside)
    units = form.units(dataset, scenarios)
    task = _Work(dataset, root, form)
    plan = sum(run_batch(task.plan, units, workers=workers, executor=executor, label="planning"), Plan())
    need, free = plan.bytes + (plan.linked_bytes if form.link == "copy" else 0), _free(root)
    if on_plan is not None:
        on_plan(plan, free)
    if not manifest.complete and need - _already(root, form.name) > free:
        raise ExportError(
            f"{root}: the export needs about {need / 1e9:.1f} GB, and {free / 1e9:.1f} GB are free; choose another "
            "disk, or fewer scenarios or agents"
        )
    if dry_run:
        return Exported(folder=root, plan=plan, written=0, kept=0, tally=Tally())
    with writing_to(root):
        manifest = Manifest.of(root, form.name, settings, form.beside)
        if manifest.complete:
            _check_release(dataset, manifest, root, workers)
            remove_parts(root, form.name)
            return Exported(folder=root, plan=plan, written=0, kept=len(units), tally=manifest.tally)
        manifest.write(root)
        done = run_batch(task.write, units, workers=workers, executor=executor, label=form.name, progress=progress)
        manifest = _finished(task, units, done, settings)
        manifest.write(root)
        remove_parts(root, form.name)
    written = sum(each.new for each in done)
    return Exported(folder=root, plan=plan, written=written, kept=len(units) - written, tally=manifest.tally)


@dataclass(frozen=True, slots=True)
class _Done:
    """A unit that was written: the hashes of its scenarios and its counts, and whether that was now."""

    scenarios: Mapping[str, str]
    tally: Tally
    new: bool


@dataclass(frozen=True, slots=True)
class _Work:
    """What workers do; cheap to pickle."""

    dataset: Dataset
    root: Path
    form: Format

    def parts(self, unit: Unit) -> Path:
        """The folder of a unit's parts."""
        return self.root / PARTS / self.form.name / unit.name

    def plan(self, unit: Unit) -> Plan:
        """About how much a unit is."""
        return self.form.plan(self.dataset, unit)

    def write(self, unit: Unit) -> _Done:
        """Write a unit, unless it was written from the same files before."""
        hashes = _hashes(self.dataset, unit.scenarios)
        found = self._found(unit, hashes)
        if found is not None:
            return _Done(hashes, found, new=False)
        shutil.rmtree(self.parts(unit), ignore_errors=True)
        output = Output(self.root, self.parts(unit), self.form.link)
        self.form.write(self.dataset, unit, output)
        record = {"scenarios": hashes, "written": output.tally.as_dict()}
        write_bytes(self.parts(unit) / _DONE, json.dumps(record).encode())
        return _Done(hashes, output.tally, new=True)

    def _found(self, unit: Unit, hashes: Mapping[str, str]) -> Tally | None:
        """The counts of a unit that was written from files with these hashes; None if there is none."""
        found = _record(self.parts(unit))
        return found[1] if found is not None and found[0] == hashes else None


def _record(parts: Path) -> tuple[Mapping[str, str], Tally] | None:
    """The hashes of a unit's scenarios, and the unit's counts; None if it is not done."""
    try:
        record = parsed_json(read_bytes(parts / _DONE, "bundle"))
        return dict(record["scenarios"]), Tally.of(record["written"])
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None


def _chosen(dataset: Dataset, form: Format) -> list[str]:
    """The tokens of the scenarios to export, in the table's order."""
    of_split = None if form.split is None else dataset.split_scenarios(form.split)
    found = [record["token"] for record in find(dataset, *form.where)]
    chosen = [token for token in found if of_split is None or token in of_split]
    if not chosen:
        raise NotAvailableError("no scenario of this release has that split and matches; change --split or --where")
    return chosen


def _finished(task: _Work, units: Sequence[Unit], done: Sequence[_Done], settings: Mapping[str, Any]) -> Manifest:
    """Write what spans units; the manifest of the complete export."""
    output = Output(task.root, task.root / PARTS / task.form.name, task.form.link)
    task.form.finish(task.dataset, units, output, task.parts)
    scenarios: dict[str, str] = {}
    for each in done:
        scenarios.update(each.scenarios)
        output.tally.add(each.tally)
    return Manifest(
        name=task.form.name,
        settings=settings,
        fingerprint=digest_of(scenarios),
        scenarios=scenarios,
        tally=output.tally,
    )


def _hashes(dataset: Dataset, scenarios: Sequence[str], workers: int | None = 1) -> dict[str, str]:
    """Token → hash of a scenario's label, meta and calib files."""
    hashes = scenario_hashes(dataset, scenarios, workers=workers)
    return {token: digest_of(each.as_dict()) for token, each in hashes.items()}


def _check_release(dataset: Dataset, manifest: Manifest, root: Path, workers: int | None) -> None:
    """Raise ExportError if the release is not what a complete export was made from."""
    now = _hashes(dataset, tuple(manifest.scenarios), workers)
    changed = sorted(token for token, digest in manifest.scenarios.items() if now.get(token) != digest)
    if changed:
        raise ExportError(
            f"{root}: was made from another state of the release ({len(changed)} scenarios have changed since, such as "
            f"{changed[0]}); choose another folder"
        )


def _free(folder: Path) -> int:
    """Bytes that are free where a folder is or will be."""
    there = next(each for each in (folder, *folder.parents) if each.exists())
    return shutil.disk_usage(there).free


def _already(root: Path, name: str) -> int:
    """Bytes of an unfinished export, about: those of the units that are done."""
    records = map(_record, (root / PARTS / name).glob("*"))
    return sum(tally.bytes for _, tally in filter(None, records))
