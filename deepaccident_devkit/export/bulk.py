"""Exports of many scenarios in any format, written unit by unit in parallel and resumable.

A folder has one manifest for each format and, next to it, a hidden store (`parallel.store`). For
each unit, the store holds its parts, a journal of the paths that the unit writes, and a record as
soon as the unit is done. The journal lets a later call remove files that it would not write today:
files of scenarios that have changed or are no longer selected. The parts let a complete export take
in new sensor files without being rewritten. Once an export is complete, all parts are packed into
one hidden file, `.deepaccident-<format>.zip`, and the store is removed.
"""

from __future__ import annotations

import json
import os
import re
import zipfile
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from deepaccident_devkit.errors import (
    ConfigError,
    ExportError,
    MissingFileError,
    NotAvailableError,
    ReleaseError,
    shortened,
)
from deepaccident_devkit.export.format import Format, LinkKind, Output, Tally, Unit, flat_name
from deepaccident_devkit.release.fingerprints import (
    checked_hashes,
    digest_of,
    scenario_folders,
    sensor_digest,
)
from deepaccident_devkit.release.layout import ScenarioFolder
from deepaccident_devkit.selection import find
from deepaccident_devkit.support.files import (
    place_in,
    remove_in,
    remove_leftovers,
    replacing,
    temporary_of,
    write_bytes,
)
from deepaccident_devkit.support.json_text import parsed_record
from deepaccident_devkit.support.parallel import (
    Engine,
    Failure,
    Places,
    Store,
    Tried,
    check_failures,
    run_batch,
)
from deepaccident_devkit.support.reading import (
    DAMAGED_ARCHIVE,
    fault_text,
    open_zip,
    read_bytes,
    read_member,
)
from deepaccident_devkit.support.text import PathType, counted, differing_text, path_of
from deepaccident_devkit.support.values import NamedValues
from deepaccident_devkit.support.version import __version__

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.dataset import Dataset

__all__ = [
    "Exported",
    "Format",
    "LinkKind",
    "Manifest",
    "Output",
    "Tally",
    "Unit",
    "export_release",
    "flat_name",
]

_STORE_FOLDER = ".deepaccident-parts"
_MANIFEST_SUFFIX = ".manifest.json"
_RECORD_NAME = "done"
_JOURNAL_SUFFIX = ".paths"
# Paths that no export writes into a journal: they lead out of its folder or to its own hidden
# files. A journal with such a path was edited.
_FORBIDDEN_PATH = re.compile(
    r"(.*/)?(\.{0,2}|\.deepaccident[^/]*|[^/]*\.manifest\.json)(/.*)?", re.DOTALL
)
# Largest number of characters of a path; no system opens a longer one.
_MAX_PATH_LENGTH = 4096
# Incremented when the content of a record changes.
_RECORD_VERSION = 2
# Key of the hash of the list of a scenario's sensor files, next to the hashes of its truth.
_SENSORS_KEY = "sensors"
# Hashes of each scenario's files, by kind, by scenario.
States: TypeAlias = "Mapping[str, dict[str, str | None]]"
# A unit and the states of its scenarios.
_Job: TypeAlias = "tuple[Unit, States | Failure]"


@dataclass(frozen=True, slots=True, kw_only=True)
class Exported:
    """Counts of an export, or, for a dry run, of the units that are still to be written.

    Attributes:
        folder: Folder of the export.
        written: Number of units that this call wrote or, for a dry run, would write.
        kept: Number of units that existed already.
        tally: Counts of everything in the folder; for a dry run, estimates for the missing units,
            with all the disk space that they take as `bytes`.
        selection: For a dry run, a line about all files to export, if the format counts them.
    """

    folder: Path
    written: int
    kept: int
    tally: Tally
    selection: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class MadeFrom:
    """What a complete export was made from.

    Attributes:
        fingerprint: Fingerprint of the truth of the exported scenarios (`release.fingerprints`).
        scenarios: Hashes of each scenario's label, meta and calib files, by kind, and, where sensor
            files matter, of their list (`sensors`), by scenario token.
    """

    fingerprint: str
    scenarios: dict[str, dict[str, str | None]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Manifest:
    """Contents of an export's folder, as stored in `<format>.manifest.json`.

    Attributes:
        what: Fixed text that identifies such a file.
        format: Name of the format.
        devkit: Version of the devkit that wrote it.
        settings: All settings that decide what is written.
        release: Sources of the export; None until it is complete.
        written: Counts of everything that was written.
        contents: What the format says about its files, once it is complete; few formats do.
    """

    what: Literal["DeepAccident export"] = "DeepAccident export"
    format: str
    devkit: str = __version__
    settings: dict[str, Any]
    release: MadeFrom | None = None
    written: Tally = field(default_factory=Tally)
    contents: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def of(cls, folder: Path, form: Format | type[Format], settings: dict[str, Any]) -> Manifest:
        """Return the manifest of a folder, or a new one for an empty folder, and change nothing.

        Args:
            folder: Folder of the export; it need not exist.
            form: The format.
            settings: Settings of the export.

        Raises:
            ConfigError: If the folder holds an export with other settings.
            ExportError: If it holds something else, is a file, or has a manifest that cannot be
                read.
        """
        own_name = f"{form.name}{_MANIFEST_SUFFIX}"
        try:
            names: list[str] = []
            # The folder is listed before its manifest is looked for, because another process may
            # write the manifest at this moment, and only afterwards any other file.
            if folder.exists():
                names = sorted(path.name for path in folder.iterdir())
            has_manifest = (folder / own_name).exists()
        except NotADirectoryError as error:
            raise ExportError(f"{folder}: is a file; give a folder") from error
        except OSError as error:
            raise ExportError(
                f"{folder}: cannot be read ({error}); choose another folder"
            ) from error
        if has_manifest:
            manifest = cls.read(folder, form.name)
            manifest.check(folder, settings)
            return manifest
        # A killed export may have left files with the other names.
        foreign = [
            name
            for name in names
            if not name.startswith(".deepaccident-") and temporary_of(name) is None
        ]
        is_shared = any(f"{name}{_MANIFEST_SUFFIX}" in names for name in form.compatible_formats)
        if foreign and not is_shared:
            raise ExportError(
                f"{folder}: is not empty ({shortened(foreign[0])}) and contains no {form.name} "
                "export; choose a new folder"
            )
        return cls(format=form.name, settings=settings)

    @classmethod
    def read(cls, folder: Path, name: str) -> Manifest:
        """Read the manifest of a format in a folder.

        Raises ExportError if it cannot be read or belongs to another format.
        """
        path = folder / f"{name}{_MANIFEST_SUFFIX}"
        try:
            manifest = parsed_record(read_bytes(path, "bundle"), cls)
            if manifest.format != name:
                raise ValueError("another format's")
        except (OSError, ValueError) as error:
            fault = f"is not the manifest of a {name} export ({error})"
            if isinstance(error, OSError):
                fault = fault_text(error)
            raise ExportError(f"{path}: {fault}; export again into an empty folder") from error
        return manifest

    def write(self, folder: Path) -> None:
        """Write the manifest into the folder of the export."""
        values = asdict(self)
        if not self.contents:
            del values["contents"]
        text = f"{json.dumps(values, indent=1)}\n"
        write_bytes(folder / f"{self.format}{_MANIFEST_SUFFIX}", text.encode())

    def check(self, folder: Path, settings: Mapping[str, Any]) -> None:
        """Raise ConfigError, with the differences, unless the manifest has these settings."""
        text = differing_text(self.settings, settings)
        if text:
            raise ConfigError(
                f"{folder}: contains a {self.format} export with other settings ({text}); choose "
                "another folder"
            )


def export_release(
    dataset: Dataset,
    folder: PathType,
    form: Format,
    *,
    dry_run: bool = False,
    **engine: Unpack[Engine],
) -> Exported:
    """Write scenarios of a release in another format, or continue an interrupted export.

    Several processes that make the same call share the scenarios.

    A continued export equals an uninterrupted one: scenarios with label, meta or calib files that
    have changed meanwhile are written again. A complete export is compared with the release: units
    with sensor files that were added, removed or changed in size are written again, and any other
    change is an error.

    Args:
        dataset: The release.
        folder: Folder of the export, which is created if necessary, or may hold an export with the
            same settings.
        form: The format, with its scenarios, its agents and its own settings.
        dry_run: Whether to only estimate the size. One scenario is then written into a temporary
            folder of the system, and `folder` is not created.
        **engine: `workers`, `executor` and `progress`; see `parallel.Engine`.

    Raises:
        ConfigError: If the folder holds an export with other settings; it stays unchanged.
        ExportError: If the folder holds something else, cannot be written to, or was made from
            other scenarios or another state of them.
        OutputFolderError: If a link in the folder leads out of it; nothing is written there.
        NotAvailableError: If no scenario or no sample is left to export, or the release has no such
            split.
        ChoiceError, FieldError: If there is no such filter, or `workers` is less than 1.
        IndexStoreError: If label, meta or calib files have changed since the index was made.
        SomeFailedError: If files of some scenarios cannot be read; the others are written, and the
            same call continues.
        WorkerError: If a worker was killed, or cannot do the work.
    """
    root = path_of(folder, "expected a folder for the export", error=ExportError).absolute()
    scenarios = _select_scenarios(dataset, form)
    settings = {**form.settings(), "version": dataset.version}
    manifest = Manifest.of(root, form, settings)
    command = digest_of({"format": form.name, "settings": settings, "of": scenarios})
    export = Export(dataset, form, root, command)
    units = form.units(dataset, scenarios)
    selection = form.survey(dataset, scenarios, root)
    if dry_run:
        return replace(_estimate_export(export, manifest, units), selection=selection)
    form.check(dataset, root)
    folders = scenario_folders(dataset, scenarios)
    absent = [token for token in scenarios if token not in folders]
    if absent:
        raise MissingFileError(
            f"{dataset.dataroot}: scenario {absent[0]} no longer exists; open the release again"
        )
    groups = [[folders[token] for token in unit.scenarios] for unit in units]
    # The caller's own progress bar only shows units that are written.
    comparing: Engine = {**engine, "progress": engine.get("progress") is True}
    # A new export does this too, so that workers that cannot do the work fail before a folder is
    # created.
    states = run_batch(
        Tried(export.read_states),
        groups,
        label="Comparing scenarios",
        places=Places(reads=dataset.places),
        **comparing,
    )
    jobs = {unit.name: (unit, state) for unit, state in zip(units, states, strict=True)}
    if manifest.release:
        check_failures(zip(jobs, states, strict=True), str(root))
        if _is_current(root, manifest.release.scenarios, _collect_states(jobs)):
            return Exported(folder=root, written=0, kept=len(units), tally=manifest.written)
    complete, written = export.complete(manifest, jobs, engine)
    return Exported(folder=root, written=written, kept=len(units) - written, tally=complete.written)


def _estimate_export(export: Export, manifest: Manifest, units: Sequence[Unit]) -> Exported:
    """Return the result of a dry run, with estimates for the units that are missing."""
    missing = []
    if not manifest.release:
        missing = [unit for unit in units if not export.is_written(unit)]
    num_kept = len(units) - len(missing)
    tally = export.estimate(missing, is_new=num_kept == 0)
    return Exported(folder=export.root, written=len(missing), kept=num_kept, tally=tally)


@dataclass(frozen=True, slots=True)
class _FinishedUnit:
    """A finished unit: its counts and whether this call wrote it."""

    tally: Tally
    is_new: bool


@dataclass(frozen=True, slots=True)
class Export:
    """An export to a format into a folder; it is cheap to pickle.

    Attributes:
        dataset: The release.
        form: The format.
        root: Folder of the export.
        command: Digest of all arguments of the export.
    """

    dataset: Dataset
    form: Format
    root: Path
    command: str = ""

    @property
    def store(self) -> Store:
        """Store of finished units, which keeps other processes from writing the same units."""
        folder = place_in(self.root, _STORE_FOLDER, opened=True)
        return Store(folder, self.root, "is writing an export", ExportError, self.command)

    @property
    def parts_folder(self) -> Path:
        """Folder for the parts of this format; raises OutputFolderError if it is a link."""
        return self.store.path(self.form.name)

    def parts(self, unit: Unit) -> Path:
        """Return the folder for the parts of one unit."""
        return self.parts_folder / unit.name

    def is_written(self, unit: Unit) -> bool:
        """Return whether the store has a record of a unit, for any state of its files."""
        return (self.parts(unit) / _RECORD_NAME).exists()

    def estimate(self, units: Sequence[Unit], *, is_new: bool) -> Tally:
        """Return the counts of units, estimated from the first readable scenario with a sample.

        Args:
            units: Units that are still to be written.
            is_new: Whether the folder has no other unit yet.

        Raises:
            NotAvailableError: If no scenario has a sample, and the export is new.
            ExportError: If the scenario that is tried cannot be written.
        """
        scenarios: list[str] = []
        for unit in units:
            scenarios += unit.scenarios
        has_failed = False
        for token in scenarios:
            try:
                tally = self._try_scenario(token)
            except ReleaseError:  # The export itself lists such scenarios.
                has_failed = True
                continue
            except OSError as error:
                raise ExportError(
                    f"a trial export of a scenario failed ({error}); free space there"
                ) from error
            if tally.samples:
                return _scale_tally(tally, len(scenarios), len(units))
        if is_new and not has_failed:
            raise NotAvailableError(self.form.empty_reason)
        return Tally()

    def _try_scenario(self, scenario: str) -> Tally:
        """Write a scenario into a temporary folder, and return its counts.

        Its `bytes` are all the disk space that it takes.
        """
        with TemporaryDirectory() as folder:
            output = Output(Path(folder, "out"), Path(folder, "parts"), self.form.link)
            self.form.write(self.dataset, Unit(name="one", scenarios=(scenario,)), output)
            measured_folder = output.parts
            if "copy" in (self.form.link, *output.tally.linked):
                output.tally.bytes = 0
                measured_folder = Path(folder)
            for path in measured_folder.rglob("*"):
                if path.is_file():
                    output.tally.bytes += path.stat().st_size
        return output.tally

    def read_states(self, folders: Sequence[ScenarioFolder]) -> States:
        """Read the hashes of the truth of scenarios and of the lists of their sensor files."""
        sensors = self.form.sensors()
        states = {}
        for folder in folders:
            state = checked_hashes(self.dataset, folder).as_dict()
            if sensors:
                state[_SENSORS_KEY] = sensor_digest(folder, sensors)
            states[folder.token] = state
        return states

    def complete(
        self, first_manifest: Manifest, jobs: Mapping[str, _Job], engine: Engine
    ) -> tuple[Manifest, int]:
        """Write the missing units, possibly while other processes write the same export.

        Args:
            first_manifest: The manifest as this call found it.
            jobs: Each unit with the states of its scenarios, by the unit's name.
            engine: `workers`, `executor` and `progress`.

        Returns:
            The manifest, and the number of units that this call wrote.
        """
        store = self.store
        settings = first_manifest.settings

        def find_completed() -> Manifest | None:
            """Return the manifest if another process has completed the export meanwhile."""
            manifest = Manifest.of(self.root, self.form, settings)
            if manifest.release and not first_manifest.release:
                return manifest
            return None

        def begin() -> None:
            if find_completed() is None:
                self._unpack_parts()
                Manifest(format=self.form.name, settings=settings).write(self.root)
                self._remove_other_units(jobs)

        with store.shared(begin, tidy=self._remove_half_written) as turn:
            manifest = find_completed()
            if manifest is not None:
                self.store.remove(keep=True)
                return manifest, 0
            places = Places(reads=self.dataset.places, writes=(self.root,))
            units = store.run(
                self.write, jobs, label=f"Exporting to {self.form.name}", places=places, **engine
            )
            if turn.alone() and find_completed() is None:
                manifest = self._finish_export(jobs, list(units.values()), settings)
                self._remove_store()
                manifest.write(self.root)
            else:
                manifest = Manifest.of(self.root, self.form, settings)
        return manifest, sum(unit.is_new for unit in units.values())

    def write(self, job: _Job) -> _FinishedUnit:
        """Write a unit, unless it has already been written from the same files."""
        unit, states = job
        if isinstance(states, Failure):
            raise ReleaseError(states.message)
        key = digest_of({"devkit": __version__, "record": _RECORD_VERSION, "states": states})
        name = f"{self.form.name}/{unit.name}/{_RECORD_NAME}"
        content = self.store.read_result(name, key)
        if content is not None:
            return _FinishedUnit(parsed_record(content, Tally), is_new=False)
        with self._open_output(unit) as output:
            self.form.write(self.dataset, unit, output)
        self.store.write_result(name, key, json.dumps(asdict(output.tally)).encode())
        return _FinishedUnit(output.tally, is_new=True)

    def _finish_export(
        self,
        jobs: Mapping[str, _Job],
        finished_units: Sequence[_FinishedUnit],
        settings: NamedValues,
    ) -> Manifest:
        """Write the files that span units, and return the manifest of the complete export.

        Raises NotAvailableError, and removes the export, if it has no sample.
        """
        if not any(unit.tally.samples for unit in finished_units):
            self._remove_other_units(())
            self._remove_store(pack=False)
            remove_in(self.root, f"{self.form.name}{_MANIFEST_SUFFIX}")
            with suppress(OSError):  # The folder has another export.
                self.root.rmdir()
            raise NotAvailableError(self.form.empty_reason)
        with self._open_output() as output:
            self.form.finish(self.dataset, [unit for unit, _ in jobs.values()], output, self.parts)
        for unit in finished_units:
            output.tally.add(unit.tally)
        states = _collect_states(jobs)
        fingerprint = digest_of(_remove_sensor_states(states))
        made_from = MadeFrom(fingerprint=fingerprint, scenarios=dict(sorted(states.items())))
        return Manifest(
            format=self.form.name,
            settings=settings,
            release=made_from,
            written=output.tally,
            contents=output.contents,
        )

    @contextmanager
    def _open_output(self, unit: Unit | None = None) -> Iterator[Output]:
        """Yield the output of a unit, or of the files that span units; only the caller writes it.

        Each path is noted before anything is written there. Files that earlier calls left half
        written, even on another host, are removed at the beginning. Files that only earlier calls
        wrote are removed at the end.
        """
        name = ""
        if unit is not None:
            name = unit.name
            remove_in(self.parts_folder, name)
        journal = self.parts_folder / f"{name}{_JOURNAL_SUFFIX}"
        earlier_paths = _read_journal(journal)
        paths = set[str]()
        folders = {place_in(self.root, path).parent for path in earlier_paths}
        earlier_names = [PurePosixPath(path).name for path in earlier_paths]
        for folder in folders:
            remove_leftovers(folder, earlier_names)
        # This makes a new file, which replaces a link.
        write_bytes(journal, _encode_paths(earlier_paths))
        with journal.open("ab", buffering=0) as file:

            def note(path: str) -> None:
                paths.add(path)
                file.write(f"{path}\0".encode())

            yield Output(self.root, self.parts_folder / name, self.form.link, note=note)
        self._remove_paths(earlier_paths - paths)
        write_bytes(journal, _encode_paths(paths))

    def _remove_other_units(self, names: Collection[str]) -> None:
        """Remove the files of all units except the named ones.

        Paths that the named units have noted too are retained: a program that copies a folder may
        leave a second journal of a unit, with another name.
        """
        journals = {}
        for journal in sorted(self.parts_folder.glob(f"[!.]*{_JOURNAL_SUFFIX}")):
            journals[journal.name.removesuffix(_JOURNAL_SUFFIX)] = journal
        other_names = journals.keys() - names
        if not other_names:  # In this case no journal need be read.
            return
        retained_paths = set[str]()
        for name in journals.keys() - other_names:
            for path in _read_journal(journals[name]):
                retained_paths.add(path)
                parents = PurePosixPath(path).parents
                retained_paths.update(parent.as_posix() for parent in parents)
        for name in sorted(other_names):
            self._remove_paths(_read_journal(journals[name]) - retained_paths)
            remove_in(self.parts_folder, name)
            journals[name].unlink()

    def _remove_paths(self, paths: Collection[str]) -> None:
        """Remove files or folders with their contents, and the folders that this empties."""
        for path in sorted(paths):
            remove_in(self.root, path)
            with suppress(OSError):
                os.removedirs((self.root / path).parent)

    def _remove_half_written(self) -> None:
        """Remove temporary files of dead processes, while only the caller uses the folder.

        A worker that a scheduler considers lost may still be alive, and continues.
        """
        targets = {temporary_of(path.name) or "" for path in self.root.iterdir()}
        # Only a process with exclusive use of the folder writes a manifest.
        manifests = [name for name in targets if name.endswith(_MANIFEST_SUFFIX)]
        remove_leftovers(self.root, manifests)
        for folder, _, _ in os.walk(self.root):
            remove_leftovers(Path(folder))

    def _remove_store(self, *, pack: bool = True) -> None:
        """Remove the store, after packing its parts into one file if sensor files may change."""
        if pack and self.form.sensors():
            self._pack_parts()
        self.store.drop(self.form.name)
        # Another format may have a record in the store.
        has_records = any(self.store.folder.glob("kept/*"))
        self.store.remove(keep=has_records)

    def _pack_parts(self) -> None:
        """Pack all parts into one archive, without dates."""
        with replacing(self._archive) as temporary, zipfile.ZipFile(temporary, "w") as archive:
            for path in sorted(self.parts_folder.rglob("*")):
                if not path.is_file() or path.is_symlink():
                    continue
                name = path.relative_to(self.parts_folder).as_posix()
                if name.isprintable():  # Zip does not support other names, which no export writes.
                    archive.writestr(zipfile.ZipInfo(name), read_bytes(path, "archive"))

    @property
    def _archive(self) -> Path:
        return place_in(self.root, f".deepaccident-{self.form.name}.zip")

    def _unpack_parts(self) -> None:
        """Unpack the parts of a complete export; raise ExportError if the archive is damaged."""
        if not self._archive.exists():
            return
        try:
            with open_zip(self._archive) as archive:
                for entry in archive.infolist():
                    path = place_in(self.parts_folder, entry.filename)
                    write_bytes(path, read_member(archive, entry, "archive"))
        except OSError:
            raise
        except DAMAGED_ARCHIVE as error:
            remedy = "remove this file, and the next run writes the whole export again"
            raise ExportError(f"{self._archive}: {fault_text(error)}; {remedy}") from error
        self._archive.unlink()


def _scale_tally(tally: Tally, scenarios: int, units: int) -> Tally:
    """Return the counts of many scenarios, estimated from the counts of one.

    Args:
        tally: Counts of one scenario.
        scenarios: Number of scenarios.
        units: Number of units; a unit has one file for all its scenarios.
    """
    return Tally(
        samples=tally.samples * scenarios,
        files=tally.files * units,
        bytes=tally.bytes * scenarios,
        linked={link: count * scenarios for link, count in tally.linked.items()},
    )


def _select_scenarios(dataset: Dataset, form: Format) -> list[str]:
    """Return the tokens of the scenarios to export, in the order of the table."""
    split_scenarios = None
    if form.split is not None:
        split_scenarios = dataset.split_scenarios(form.split)
    tokens = [record["token"] for record in find(dataset, *form.where)]
    if split_scenarios is not None:
        tokens = [token for token in tokens if token in split_scenarios]
    if not tokens:
        raise NotAvailableError(
            "no scenario of this release is in that split and matches the filters; change them"
        )
    return tokens


def _collect_states(jobs: Mapping[str, _Job]) -> dict[str, dict[str, str | None]]:
    """Return the states of the scenarios of all units without a failure."""
    all_states: dict[str, dict[str, str | None]] = {}
    for _, states in jobs.values():
        if not isinstance(states, Failure):
            all_states.update(states)
    return all_states


def _remove_sensor_states(states: States) -> dict[str, NamedValues]:
    """Return the states of scenarios without their sensor files."""
    truth = {}
    for token, state in states.items():
        truth[token] = {name: value for name, value in state.items() if name != _SENSORS_KEY}
    return truth


def _is_current(root: Path, exported: States, present: States) -> bool:
    """Return whether a complete export was made from the sensor files that now exist.

    Raises ExportError if it was made from different label, meta or calib files.
    """
    old_truth = _remove_sensor_states(exported)
    new_truth = _remove_sensor_states(present)
    tokens = sorted({*old_truth, *new_truth})
    changed = [token for token in tokens if old_truth.get(token) != new_truth.get(token)]
    if changed:
        raise ExportError(
            f"{root}: the release or the split file has changed since this export "
            f"({counted(len(changed), 'scenario')}, such as {changed[0]}); choose another folder"
        )
    return exported == present


def _read_journal(journal: Path) -> set[str]:
    """Read the paths in a journal; return an empty set if it cannot be read.

    If a process was killed, its last path may be cut off, but nothing was written there yet.
    """
    try:
        paths = read_bytes(journal, "bundle").decode().split("\0")[:-1]
    except (OSError, ValueError):
        return set()
    short_paths = [path for path in paths if len(path) <= _MAX_PATH_LENGTH]
    return {path for path in short_paths if not _FORBIDDEN_PATH.fullmatch(path)}


def _encode_paths(paths: Collection[str]) -> bytes:
    """Return the content of a journal with these paths."""
    terminated_paths = [f"{path}\0" for path in sorted(paths)]
    return "".join(terminated_paths).encode()
