"""Exports of many scenarios in any format, written unit by unit in parallel and resumable.

A folder has one manifest a format, and beside it a hidden store of what is written
(`parallel.store`): of each unit its parts, a journal of the paths that it writes, and a record once
it is done. The journal lets a later call remove files that it would not write today: of scenarios
with changed files, or that are no longer selected. The parts let a complete export get new sensor
files without being rewritten. Once it is complete, all parts are packed in one hidden file,
`.deepaccident-<format>.zip`, and the store is removed.
"""

from __future__ import annotations

import json
import os
import re
import zipfile
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Final, Literal, TypeAlias

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
from deepaccident_devkit.support.text import differing_text, path_of
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

_STORE_FOLDER: Final = ".deepaccident-parts"
_MANIFEST_SUFFIX: Final = ".manifest.json"
_RECORD_NAME: Final = "done"
_JOURNAL_SUFFIX: Final = ".paths"
# Paths that no export writes into a journal: out of its folder, or to its own hidden files. A
# journal with such a path was edited.
_FORBIDDEN_PATH: Final = re.compile(
    r"(.*/)?(\.{0,2}|\.deepaccident[^/]*|[^/]*\.manifest\.json)(/.*)?", re.DOTALL
)
# In characters; no system opens a longer path.
_MAX_PATH_LENGTH: Final = 4096
# Incremented when the content of a record changes.
_RECORD_VERSION: Final = 2
# Key of the hash of the list of a scenario's sensor files, beside the hashes of its truth.
_SENSORS_KEY: Final = "sensors"
States: TypeAlias = "Mapping[str, dict[str, str | None]]"
# A unit, and the states of its scenarios.
_Job: TypeAlias = "tuple[Unit, States | Failure]"


@dataclass(frozen=True, slots=True, kw_only=True)
class Exported:
    """Counts of an export, or for a dry run of the units that are still to be written.

    Attributes:
        folder: Folder of the export.
        written: Number of units that were written now; for a dry run, that would be.
        kept: Number of units that existed already.
        tally: Counts of everything in the folder; for a dry run, estimates for the missing units,
            where `bytes` is all the disk space that they take.
    """

    folder: Path
    written: int
    kept: int
    tally: Tally


@dataclass(frozen=True, slots=True, kw_only=True)
class MadeFrom:
    """Sources of a complete export.

    Attributes:
        fingerprint: Fingerprint of the truth of the exported scenarios (`release.fingerprints`).
        scenarios: Token → hashes of its label, meta and calib files, by kind, and of the list of
            its sensor files, `sensors`, where these matter.
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
    """

    what: Literal["DeepAccident export"] = "DeepAccident export"
    format: str
    devkit: str = __version__
    settings: dict[str, Any]
    release: MadeFrom | None = None
    written: Tally = field(default_factory=Tally)

    @classmethod
    def of(cls, folder: Path, form: Format | type[Format], settings: dict[str, Any]) -> Manifest:
        """Return the manifest of a folder for an export; changes nothing.

        Args:
            folder: Folder of the export; it need not exist.
            form: The format.
            settings: Settings of the export.

        Raises:
            ConfigError: the folder holds an export with other settings.
            ExportError: it holds something else, is a file, or its manifest cannot be read.
        """
        own_name = f"{form.name}{_MANIFEST_SUFFIX}"
        try:
            # listed before the manifest is looked for: another process may write the manifest at
            # this moment, and writes other files only after it
            names = sorted(path.name for path in folder.iterdir()) if folder.exists() else []
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
        foreign = [name for name in names if not _is_leftover(name)]
        is_shared = any(f"{name}{_MANIFEST_SUFFIX}" in names for name in form.beside)
        if foreign and not is_shared:
            raise ExportError(
                f"{folder}: is not empty ({shortened(foreign[0])}) and holds no {form.name} "
                "export; choose a new folder"
            )
        return cls(format=form.name, settings=settings)

    @classmethod
    def read(cls, folder: Path, name: str) -> Manifest:
        """Return the manifest of a format in a folder; raises ExportError."""
        path = folder / f"{name}{_MANIFEST_SUFFIX}"
        try:
            manifest = parsed_record(read_bytes(path, "bundle"), cls)
            if manifest.format != name:
                raise ValueError("another format's")
        except (OSError, ValueError) as error:
            fault = f"is no manifest of a {name} export ({error})"
            if isinstance(error, OSError):
                fault = fault_text(error)
            raise ExportError(f"{path}: {fault}; export again into an empty folder") from error
        return manifest

    def write(self, folder: Path) -> None:
        """Write it into its folder."""
        text = f"{json.dumps(asdict(self), indent=1)}\n"
        write_bytes(folder / f"{self.format}{_MANIFEST_SUFFIX}", text.encode())

    def check(self, folder: Path, settings: Mapping[str, Any]) -> None:
        """Raise ConfigError with the differences if it has other settings."""
        text = differing_text(self.settings, settings)
        if text:
            raise ConfigError(
                f"{folder}: holds an export to {self.format} with other settings ({text}); choose "
                "another folder"
            )


def _is_leftover(name: str) -> bool:
    """Return whether a killed export may have left a file of this name."""
    return name.startswith(".deepaccident-") or temporary_of(name) is not None


def export_release(
    dataset: Dataset,
    folder: str | os.PathLike[str],
    form: Format,
    *,
    dry_run: bool = False,
    **engine: Unpack[Engine],
) -> Exported:
    """Write scenarios of a release in another format; the same call continues an interrupted one.

    Several processes that make the same call share the scenarios.

    A continued export equals an undisturbed one: scenarios with label, meta or calib files that
    have changed since are written again. A complete export is compared with the release: units with
    sensor files that were added, removed or changed in size are written again; other changes raise
    an error.

    Args:
        dataset: The release.
        folder: Folder of the export, created if necessary; or one with an export with the same
            settings.
        form: The format, with its scenarios and agents, and its own settings.
        dry_run: Whether to only estimate the size: one scenario is written into a temporary folder
            of the system, and the folder is not created.
        **engine: `workers`, `executor` and `progress`, see `parallel.Engine`.

    Raises:
        ConfigError: the folder holds an export with other settings; it stays unchanged.
        ExportError: the folder holds something else, cannot be written to, or was made from other
            scenarios or another state of them.
        OutputFolderError: a link in the folder leads out of it; nothing is written there.
        NotAvailableError: no scenario or no sample is left to export, or the release has no such
            split.
        ChoiceError, FieldError: no such filter, or `workers` is less than 1.
        IndexStoreError: label, meta or calib files have changed since the index was made.
        SomeFailedError: files of some scenarios cannot be read; the others are written, and the
            same call continues.
        WorkerError: a worker was killed, or cannot do the work.
    """
    root = path_of(folder, "expected a folder for the export", error=ExportError).absolute()
    scenarios = _select_scenarios(dataset, form)
    settings = {**form.settings(), "version": dataset.version}
    manifest = Manifest.of(root, form, settings)
    command = digest_of({"format": form.name, "settings": settings, "of": scenarios})
    export = Export(dataset, form, root, command)
    units = form.units(dataset, scenarios)
    if dry_run:
        return _estimated(export, manifest, units)
    form.check(dataset, root)
    folders = scenario_folders(dataset, scenarios)
    absent = [token for token in scenarios if token not in folders]
    if absent:
        raise MissingFileError(
            f"{dataset.dataroot}: scenario {absent[0]} is gone; open the release again"
        )
    groups = [[folders[token] for token in unit.scenarios] for unit in units]
    # a progress bar of the caller is only for units that are written
    comparing: Engine = {**engine, "progress": engine.get("progress") is True}
    # also for a new export: workers that cannot do the work fail before a folder is created
    states = run_batch(
        Tried(export.states),
        groups,
        label="comparing",
        places=Places(reads=dataset.places),
        **comparing,
    )
    jobs = {unit.name: (unit, state) for unit, state in zip(units, states, strict=True)}
    if manifest.release:
        check_failures(zip(jobs, states, strict=True), str(root))
        if _is_current(root, manifest.release.scenarios, _all_states(jobs)):
            return Exported(folder=root, written=0, kept=len(units), tally=manifest.written)
    complete, written = export.complete(manifest, jobs, engine)
    return Exported(folder=root, written=written, kept=len(units) - written, tally=complete.written)


def _estimated(export: Export, manifest: Manifest, units: Sequence[Unit]) -> Exported:
    """Return the result of a dry run."""
    missing = []
    if not manifest.release:
        missing = [unit for unit in units if not export.is_written(unit)]
    tally = export.estimate(missing, is_new=len(missing) == len(units))
    return Exported(
        folder=export.root, written=len(missing), kept=len(units) - len(missing), tally=tally
    )


@dataclass(frozen=True, slots=True)
class _Done:
    """A finished unit: its counts, and whether it was written by this call."""

    tally: Tally
    new: bool


@dataclass(frozen=True, slots=True)
class Export:
    """An export of a format in a folder; cheap to pickle.

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
        """Store of finished units, which keeps other processes from writing the same."""
        folder = place_in(self.root, _STORE_FOLDER, opened=True)
        return Store(folder, self.root, "writes an export", ExportError, self.command)

    @property
    def parts_folder(self) -> Path:
        """Folder of this format's parts, existing or not; raises OutputFolderError for a link."""
        return self.store.path(self.form.name)

    def parts(self, unit: Unit) -> Path:
        """Return the folder of a unit's parts."""
        return self.parts_folder / unit.name

    def is_written(self, unit: Unit) -> bool:
        """Return whether a record of a unit exists, from any state of its files."""
        return (self.parts(unit) / _RECORD_NAME).exists()

    def estimate(self, units: Sequence[Unit], *, is_new: bool) -> Tally:
        """Estimate the counts of units from the first readable scenario that has a sample.

        Args:
            units: Units that are still to be written.
            is_new: Whether the folder has no other unit yet.

        Raises:
            NotAvailableError: no scenario has a sample, and the export is new.
            ExportError: a scenario cannot be written to try it.
        """
        scenarios = [token for unit in units for token in unit.scenarios]
        has_failed = False
        for token in scenarios:
            try:
                tally = self._try_scenario(token)
            except ReleaseError:  # the export itself lists such scenarios
                has_failed = True
                continue
            except OSError as error:
                raise ExportError(
                    f"a scenario cannot be tried ({error}); make room there"
                ) from error
            if tally.samples:
                return _scaled(tally, len(scenarios), len(units))
        if is_new and not has_failed:
            raise NotAvailableError(self.form.nothing)
        return Tally()

    def _try_scenario(self, scenario: str) -> Tally:
        """Return the counts of a scenario in a temporary folder; `bytes` is all that it takes."""
        with TemporaryDirectory() as folder:
            output = Output(Path(folder, "out"), Path(folder, "parts"), self.form.link)
            self.form.write(self.dataset, Unit(name="one", scenarios=(scenario,)), output)
            measured = output.parts
            if self.form.link == "copy":
                output.tally.bytes, measured = 0, Path(folder)
            files = [path for path in measured.rglob("*") if path.is_file()]
            output.tally.bytes += sum(path.stat().st_size for path in files)
        return output.tally

    def states(self, folders: Sequence[ScenarioFolder]) -> States:
        """Return the hashes of scenarios' truth, and of the lists of their sensor files."""
        sensors = self.form.sensors()
        states = {}
        for folder in folders:
            state = checked_hashes(self.dataset, folder).as_dict()
            if sensors:
                state = state | {_SENSORS_KEY: sensor_digest(folder, sensors)}
            states[folder.token] = state
        return states

    def complete(
        self, before: Manifest, jobs: Mapping[str, _Job], engine: Engine
    ) -> tuple[Manifest, int]:
        """Write the missing units, beside other processes that write the same export.

        Args:
            before: The manifest as this call found it.
            jobs: Name of a unit → the unit and the states of its scenarios.
            engine: `workers`, `executor` and `progress`.

        Returns:
            The manifest, and the number of units that are new.
        """
        store = self.store

        def completed_elsewhere() -> Manifest | None:
            """Return the manifest, if another process has completed the export meanwhile."""
            manifest = Manifest.of(self.root, self.form, before.settings)
            if manifest.release and not before.release:
                return manifest
            return None

        def begin() -> None:
            if completed_elsewhere() is None:
                self._unpack_parts()
                Manifest(format=self.form.name, settings=before.settings).write(self.root)
                self._remove_other_units(jobs)

        with store.shared(begin, tidy=self._remove_half_written) as turn:
            manifest = completed_elsewhere()
            if manifest is not None:
                self.store.remove(keep=True)
                return manifest, 0
            places = Places(reads=self.dataset.places, writes=(self.root,))
            done = store.run(self.write, jobs, label=self.form.name, places=places, **engine)
            if turn.alone() and completed_elsewhere() is None:
                manifest = self._finish(jobs, list(done.values()), before.settings)
                self._remove_store()
                manifest.write(self.root)
            else:
                manifest = Manifest.of(self.root, self.form, before.settings)
        return manifest, sum(unit.new for unit in done.values())

    def write(self, job: _Job) -> _Done:
        """Write a unit, unless it was written from the same files before."""
        unit, states = job
        if isinstance(states, Failure):
            raise ReleaseError(states.message)
        key = digest_of({"devkit": __version__, "record": _RECORD_VERSION, "states": states})
        name = f"{self.form.name}/{unit.name}/{_RECORD_NAME}"
        content = self.store.kept(name, key)
        if content is not None:
            return _Done(parsed_record(content, Tally), new=False)
        with self._output(unit) as output:
            self.form.write(self.dataset, unit, output)
        self.store.keep(name, key, json.dumps(asdict(output.tally)).encode())
        return _Done(output.tally, new=True)

    def _finish(
        self, jobs: Mapping[str, _Job], done: Sequence[_Done], settings: dict[str, Any]
    ) -> Manifest:
        """Write files that span units and return the manifest of the complete export.

        Without any sample, the export is removed and NotAvailableError raised.
        """
        if not any(unit.tally.samples for unit in done):
            self._remove_other_units(())
            self._remove_store(pack=False)
            remove_in(self.root, f"{self.form.name}{_MANIFEST_SUFFIX}")
            with suppress(OSError):  # another export is in the folder
                self.root.rmdir()
            raise NotAvailableError(self.form.nothing)
        with self._output() as output:
            self.form.finish(self.dataset, [unit for unit, _ in jobs.values()], output, self.parts)
        for unit in done:
            output.tally.add(unit.tally)
        scenarios = _all_states(jobs)
        made_from = MadeFrom(
            fingerprint=digest_of(_truth(scenarios)), scenarios=dict(sorted(scenarios.items()))
        )
        return Manifest(
            format=self.form.name, settings=settings, release=made_from, written=output.tally
        )

    @contextmanager
    def _output(self, unit: Unit | None = None) -> Iterator[Output]:
        """Yield the output of a unit that only the caller writes, or of the files that span units.

        Each path is noted before something is written there. Files that earlier calls left half
        written are removed at the beginning, also files of another host; files that only earlier
        calls wrote are removed at the end.
        """
        name = ""
        if unit is not None:
            name = unit.name
            remove_in(self.parts_folder, name)
        journal = self.parts_folder / f"{name}{_JOURNAL_SUFFIX}"
        earlier_paths, paths = _read_journal(journal), set[str]()
        folders = {place_in(self.root, path).parent for path in earlier_paths}
        earlier_names = [PurePosixPath(path).name for path in earlier_paths]
        for folder in folders:
            remove_leftovers(folder, earlier_names)
        write_bytes(journal, _journal_bytes(earlier_paths))  # a new file, and no link
        with journal.open("ab", buffering=0) as file:

            def note(path: str) -> None:
                paths.add(path)
                file.write(f"{path}\0".encode())

            yield Output(self.root, self.parts_folder / name, self.form.link, note=note)
        self._remove_paths(earlier_paths - paths)
        write_bytes(journal, _journal_bytes(paths))

    def _remove_other_units(self, names: Collection[str]) -> None:
        """Remove the files of units that are not among these, except paths that these also noted.

        A program that copies a folder may leave a second journal of a unit, with another name.
        """
        journals = {}
        for journal in sorted(self.parts_folder.glob(f"[!.]*{_JOURNAL_SUFFIX}")):
            journals[journal.name.removesuffix(_JOURNAL_SUFFIX)] = journal
        other_names = journals.keys() - names
        if not other_names:  # then no journal need be read
            return
        retained_paths = set[str]()
        for name in journals.keys() - other_names:
            for path in _read_journal(journals[name]):
                retained_paths.add(path)
                retained_paths.update(parent.as_posix() for parent in PurePosixPath(path).parents)
        for name in sorted(other_names):
            self._remove_paths(_read_journal(journals[name]) - retained_paths)
            remove_in(self.parts_folder, name)
            journals[name].unlink()

    def _remove_paths(self, paths: Collection[str]) -> None:
        """Remove files or folders with their contents, and the folders that are empty then."""
        for path in sorted(paths):
            remove_in(self.root, path)
            with suppress(OSError):
                os.removedirs((self.root / path).parent)

    def _remove_half_written(self) -> None:
        """Remove temporary files of dead processes; only the caller uses the folder.

        A worker that a scheduler believed lost may still live, and goes on.
        """
        targets = {temporary_of(path.name) or "" for path in self.root.iterdir()}
        # manifests are written only by a process that has the folder to itself
        manifests = [name for name in targets if name.endswith(_MANIFEST_SUFFIX)]
        remove_leftovers(self.root, manifests)
        for folder, _, _ in os.walk(self.root):
            remove_leftovers(Path(folder))

    def _remove_store(self, *, pack: bool = True) -> None:
        """Remove the store; pack its parts into one file if sensor files may change later."""
        if pack and self.form.sensors():
            self._pack_parts()
        self.store.drop(self.form.name)
        # another format may have a record in the store
        self.store.remove(keep=any(self.store.folder.glob("kept/*")))

    def _pack_parts(self) -> None:
        """Pack all parts into one file; it has no dates."""
        with replacing(self._archive) as temporary, zipfile.ZipFile(temporary, "w") as archive:
            for path in sorted(self.parts_folder.rglob("*")):
                if not path.is_file() or path.is_symlink():
                    continue
                name = path.relative_to(self.parts_folder).as_posix()
                if name.isprintable():  # other names are foreign, and zip does not support them
                    archive.writestr(zipfile.ZipInfo(name), read_bytes(path, "archive"))

    @property
    def _archive(self) -> Path:
        return place_in(self.root, f".deepaccident-{self.form.name}.zip")

    def _unpack_parts(self) -> None:
        """Unpack the parts of a complete export; raises ExportError if the archive is damaged."""
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
            remedy = "remove it, and the export is written again as a whole"
            raise ExportError(f"{self._archive}: {fault_text(error)}; {remedy}") from error
        self._archive.unlink()


def _scaled(tally: Tally, scenarios: int, units: int) -> Tally:
    """Return the counts of many scenarios, estimated from the counts of one.

    A unit of many scenarios has one file for all of them.
    """
    return Tally(
        samples=tally.samples * scenarios,
        files=tally.files * units,
        bytes=tally.bytes * scenarios,
        linked={link: count * scenarios for link, count in tally.linked.items()},
    )


def _select_scenarios(dataset: Dataset, form: Format) -> list[str]:
    """Return the tokens of the scenarios to export, in the table's order."""
    split_scenarios = None if form.split is None else dataset.split_scenarios(form.split)
    tokens = [record["token"] for record in find(dataset, *form.where)]
    if split_scenarios is not None:
        tokens = [token for token in tokens if token in split_scenarios]
    if not tokens:
        raise NotAvailableError(
            "no scenario of this release is in that split and matches the filters; change them"
        )
    return tokens


def _all_states(jobs: Mapping[str, _Job]) -> dict[str, dict[str, str | None]]:
    """Return the states of the scenarios of all units without a failure."""
    all_states: dict[str, dict[str, str | None]] = {}
    for _, states in jobs.values():
        if not isinstance(states, Failure):
            all_states.update(states)
    return all_states


def _truth(states: States) -> dict[str, dict[str, Any]]:
    """Return the states of scenarios without their sensor files."""
    truth = {}
    for token, state in states.items():
        truth[token] = {name: value for name, value in state.items() if name != _SENSORS_KEY}
    return truth


def _is_current(root: Path, before: States, now: States) -> bool:
    """Return whether a complete export has the present sensor files.

    Raises ExportError if it was made from another truth.
    """
    old_truth, new_truth = _truth(before), _truth(now)
    changed = sorted(
        token for token in {*old_truth, *new_truth} if old_truth.get(token) != new_truth.get(token)
    )
    if changed:
        raise ExportError(
            f"{root}: was made from another state of the release, or a split file ({len(changed)} "
            f"scenarios have changed, come or gone since, such as {changed[0]}); choose another "
            "folder"
        )
    return before == now


def _read_journal(journal: Path) -> set[str]:
    """Return the paths in a journal.

    The last path of a killed process may be cut off; nothing was written there yet.
    """
    try:
        paths = read_bytes(journal, "bundle").decode().split("\0")[:-1]
    except (OSError, ValueError):
        return set()
    short_paths = (path for path in paths if len(path) <= _MAX_PATH_LENGTH)
    return {path for path in short_paths if not _FORBIDDEN_PATH.fullmatch(path)}


def _journal_bytes(paths: Collection[str]) -> bytes:
    """Return the content of a journal."""
    return "".join(f"{path}\0" for path in sorted(paths)).encode()
