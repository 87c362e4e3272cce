"""Exports of many scenarios, the same for every format: written unit by unit in parallel, resumed where they stopped.

A folder has one manifest a format, and hidden beside it the store of what is written (`parallel.store`): of each unit
its parts, a journal of the paths that it writes, and a record once it is done. By the paths a call removes what an
earlier one wrote and would not be written today: of a scenario whose files have changed since, or that is not chosen
any more. By the parts a complete export gets new sensor files without being written as a whole. Once it is complete,
all of them lie packed in one hidden file, `.deepaccident-<format>.zip`, and the store is gone.
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

_FOLDER: Final = ".deepaccident-parts"
_ENDING: Final = ".manifest.json"
_DONE: Final = "done"
_PATHS: Final = ".paths"
# Paths that no export notes: out of its folder, or to what it keeps there itself. Somebody else wrote those.
_REFUSED: Final = re.compile(
    r"(.*/)?(\.{0,2}|\.deepaccident[^/]*|[^/]*\.manifest\.json)(/.*)?", re.DOTALL
)
# Characters of a path; no system opens a longer one.
_LONGEST: Final = 4096
# Counts up when the content of a done-record changes.
_RECORD: Final = 2
# Name of the hash of the list of a scenario's sensor files, beside the hashes of its truth.
_SENSORS: Final = "sensors"
States: TypeAlias = "Mapping[str, dict[str, str | None]]"
# A unit, and the states of its scenarios.
_Job: TypeAlias = "tuple[Unit, States | Failure]"


@dataclass(frozen=True, slots=True, kw_only=True)
class Exported:
    """What an export did, or for a dry run, what is left to do.

    Attributes:
        folder: where it is.
        written: units that were written now; for a dry run, that would be.
        kept: units that were there already.
        tally: counts of all that is in the folder; for a dry run, about of what would be written, and `bytes` are all
            that it takes of the disk.
    """

    folder: Path
    written: int
    kept: int
    tally: Tally


@dataclass(frozen=True, slots=True, kw_only=True)
class MadeFrom:
    """What a complete export was made from.

    Attributes:
        fingerprint: of the truth of the exported scenarios (`release.fingerprints`).
        scenarios: token → hashes of its label, meta and calib files, by kind, and of the list of its sensor files,
            `sensors`, where these matter.
    """

    fingerprint: str
    scenarios: dict[str, dict[str, str | None]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Manifest:
    """What a folder holds, as it stands in `<format>.manifest.json`.

    Attributes:
        what: what such a file is.
        format: its name.
        devkit: the version that wrote it.
        settings: everything that decides what is written.
        release: what it was made from; None until it is complete.
        written: counts of all that is there.
    """

    what: Literal["DeepAccident export"] = "DeepAccident export"
    format: str
    devkit: str = __version__
    settings: dict[str, Any]
    release: MadeFrom | None = None
    written: Tally = field(default_factory=Tally)

    @classmethod
    def of(cls, folder: Path, form: Format | type[Format], settings: dict[str, Any]) -> Manifest:
        """The manifest of a folder into which an export will be written; changes nothing.

        Args:
            folder: it need not exist.
            form: the format.
            settings: of the export.

        Raises:
            ConfigError: the folder holds an export with other settings.
            ExportError: it holds something else, is a file, or its manifest cannot be read.
        """
        own = f"{form.name}{_ENDING}"
        try:
            # before the look for a manifest: another process may write that now, and files only after it
            others = sorted(path.name for path in folder.iterdir()) if folder.exists() else []
            is_begun = (folder / own).exists()
        except NotADirectoryError as error:
            raise ExportError(f"{folder}: is a file; give a folder") from error
        except OSError as error:
            raise ExportError(
                f"{folder}: cannot be read ({error}); choose another folder"
            ) from error
        if is_begun:
            found = cls.read(folder, form.name)
            found.check(folder, settings)
            return found
        # a killed export may have left what it keeps alone
        strange = [
            each
            for each in others
            if not each.startswith(".deepaccident-") and temporary_of(each) is None
        ]
        if strange and not any(f"{each}{_ENDING}" in others for each in form.beside):
            raise ExportError(
                f"{folder}: is not empty ({shortened(strange[0])}) and holds no {form.name} export; choose a new folder"
            )
        return cls(format=form.name, settings=settings)

    @classmethod
    def read(cls, folder: Path, name: str) -> Manifest:
        """The manifest that a folder has of a format; raises ExportError."""
        path = folder / f"{name}{_ENDING}"
        try:
            found = parsed_record(read_bytes(path, "bundle"), cls)
            if found.format != name:
                raise ValueError("another format's")
        except (OSError, ValueError) as error:
            fault = (
                fault_text(error)
                if isinstance(error, OSError)
                else f"is no manifest of a {name} export ({error})"
            )
            raise ExportError(f"{path}: {fault}; export again into an empty folder") from error
        return found

    def write(self, folder: Path) -> None:
        """Write it into its folder."""
        write_bytes(
            folder / f"{self.format}{_ENDING}", f"{json.dumps(asdict(self), indent=1)}\n".encode()
        )

    def check(self, folder: Path, settings: Mapping[str, Any]) -> None:
        """Refuse other settings; raises ConfigError that names what differs."""
        if text := differing_text(self.settings, settings):
            raise ConfigError(
                f"{folder}: holds an export to {self.format} with other settings ({text}); choose another folder"
            )


def export_release(
    dataset: Dataset,
    folder: str | os.PathLike[str],
    form: Format,
    *,
    dry_run: bool = False,
    **how: Unpack[Engine],
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
        dry_run: only say about how much it will be: one scenario is written into a temporary folder of the system, and
            the folder is not made.
        **how: `workers`, `executor` and `progress`, as `parallel.Engine` says.

    Raises:
        ConfigError: the folder holds an export with other settings; it is left as it is.
        ExportError: the folder holds something else, cannot be written to, or was made from other scenarios or another
            state of them.
        OutputFolderError: a link in the folder leads out of it; nothing is written there.
        NotAvailableError: no scenario or no sample is left to export, or the release has no such split.
        ChoiceError, FieldError: no such filter, or `workers` is less than 1.
        IndexStoreError: label, meta or calib files have changed since the index was made.
        SomeFailedError: files of some scenarios cannot be read; the others are written, and the same call continues.
        WorkerError: a worker was killed, or cannot do the work.
    """
    root = path_of(folder, "expected a folder for the export", error=ExportError).absolute()
    scenarios = _chosen(dataset, form)
    settings = {**form.settings(), "version": dataset.version}
    manifest = Manifest.of(root, form, settings)
    command = digest_of({"format": form.name, "settings": settings, "of": scenarios})
    export, units = Export(dataset, form, root, command), form.units(dataset, scenarios)
    if dry_run:
        left = [] if manifest.release else [unit for unit in units if not export.is_written(unit)]
        tally = export.estimate(left, alone=len(left) == len(units))
        return Exported(folder=root, written=len(left), kept=len(units) - len(left), tally=tally)
    form.check(dataset, root)
    folders = scenario_folders(dataset, scenarios)
    if absent := [token for token in scenarios if token not in folders]:
        raise MissingFileError(
            f"{dataset.dataroot}: scenario {absent[0]} is gone; open the release again"
        )
    groups = [[folders[token] for token in unit.scenarios] for unit in units]
    comparing: Engine = {
        **how,
        "progress": how.get("progress") is True,
    }  # a caller's bar is for what is written
    # also if nothing is there yet: workers that cannot do the work say so before a folder is made
    states = run_batch(
        Tried(export.states),
        groups,
        label="comparing",
        places=Places(reads=dataset.places),
        **comparing,
    )
    jobs = {unit.name: (unit, found) for unit, found in zip(units, states, strict=True)}
    if manifest.release:
        check_failures(zip(jobs, states, strict=True), str(root))
        if _is_current(root, manifest.release.scenarios, _all_states(jobs)):
            return Exported(folder=root, written=0, kept=len(units), tally=manifest.written)
    whole, written = export.completed(manifest, jobs, how)
    return Exported(folder=root, written=written, kept=len(units) - written, tally=whole.written)


@dataclass(frozen=True, slots=True)
class _Done:
    """A unit that was written: its counts, and whether that was now."""

    tally: Tally
    new: bool


@dataclass(frozen=True, slots=True)
class Export:
    """An export of a format in a folder; cheap to pickle. The command is a digest of all that is asked for."""

    dataset: Dataset
    form: Format
    root: Path
    command: str = ""

    @property
    def store(self) -> Store:
        """What says which units are done, and keeps others from writing the same."""
        return Store(
            place_in(self.root, _FOLDER, opened=True),
            self.root,
            "writes an export",
            ExportError,
            self.command,
        )

    @property
    def kept(self) -> Path:
        """The folder of the parts of this format, there or not; raises OutputFolderError if it is behind a link."""
        return self.store.path(self.form.name)

    def parts(self, unit: Unit) -> Path:
        """The folder of a unit's parts."""
        return self.kept / unit.name

    def is_written(self, unit: Unit) -> bool:
        """Whether there is a record that a unit was written, from whatever files."""
        return (self.parts(unit) / _DONE).exists()

    def estimate(self, units: Sequence[Unit], *, alone: bool) -> Tally:
        """About how much units that are left are, by the first scenario that has a sample and can be read.

        Raises NotAvailableError if no scenario has a sample and nothing else is in the folder yet (`alone`);
        ExportError.
        """
        scenarios, failed = [token for unit in units for token in unit.scenarios], False
        for token in scenarios:
            try:
                tally = self._tried(token)
            except ReleaseError:  # the export itself lists such scenarios
                failed = True
                continue
            except OSError as error:
                raise ExportError(
                    f"a scenario cannot be tried ({error}); make room there"
                ) from error
            if tally.samples:
                count = len(scenarios)
                linked = {way: number * count for way, number in tally.linked.items()}
                files, size = (
                    tally.files * len(units),
                    tally.bytes * count,
                )  # a unit of many has one file for all
                return Tally(samples=tally.samples * count, files=files, bytes=size, linked=linked)
        if alone and not failed:
            raise NotAvailableError(self.form.nothing)
        return Tally()

    def _tried(self, scenario: str) -> Tally:
        """The counts of a scenario that is written into a temporary folder; `bytes` are all that it takes."""
        with TemporaryDirectory() as folder:
            output = Output(Path(folder, "out"), Path(folder, "parts"), self.form.link)
            self.form.write(self.dataset, Unit(name="one", scenarios=(scenario,)), output)
            if self.form.link == "copy":
                output.tally.bytes, measured = 0, Path(folder)
            else:
                measured = output.parts
            output.tally.bytes += sum(
                each.stat().st_size for each in measured.rglob("*") if each.is_file()
            )
        return output.tally

    def states(self, folders: Sequence[ScenarioFolder]) -> States:
        """What is compared of scenarios: the hashes of their truth, and of the lists of their sensor files."""
        sensors = self.form.sensors()
        return {
            folder.token: checked_hashes(self.dataset, folder).as_dict()
            | ({_SENSORS: sensor_digest(folder, sensors)} if sensors else {})
            for folder in folders
        }

    def completed(
        self, before: Manifest, jobs: Mapping[str, _Job], how: Engine
    ) -> tuple[Manifest, int]:
        """Write what is left, beside others that write it; the manifest, and how many units are new."""
        store = self.store

        def by_another() -> Manifest | None:
            """The manifest, if another process has completed the export meanwhile."""
            found = Manifest.of(self.root, self.form, before.settings)
            return found if found.release and not before.release else None

        def begin() -> None:
            if by_another() is None:
                self._take_out()
                Manifest(format=self.form.name, settings=before.settings).write(self.root)
                self._remove_others(jobs)

        with store.shared(begin, tidy=self._remove_half_written) as turn:
            if (whole := by_another()) is not None:
                self.store.remove(keep=True)
                return whole, 0
            places = Places(reads=self.dataset.places, writes=(self.root,))
            done = store.run(self.write, jobs, label=self.form.name, places=places, **how)
            if turn.alone() and by_another() is None:
                whole = self._finished(jobs, list(done.values()), before.settings)
                self._put_away()
                whole.write(self.root)
            else:
                whole = Manifest.of(self.root, self.form, before.settings)
        return whole, sum(each.new for each in done.values())

    def write(self, job: _Job) -> _Done:
        """Write a unit, unless it was written from the same files before."""
        unit, states = job
        if isinstance(states, Failure):
            raise ReleaseError(states.message)
        key = digest_of({"devkit": __version__, "record": _RECORD, "states": states})
        name = f"{self.form.name}/{unit.name}/{_DONE}"
        if (content := self.store.kept(name, key)) is not None:
            return _Done(parsed_record(content, Tally), new=False)
        with self._output(unit) as output:
            self.form.write(self.dataset, unit, output)
        self.store.keep(name, key, json.dumps(asdict(output.tally)).encode())
        return _Done(output.tally, new=True)

    def _finished(
        self, jobs: Mapping[str, _Job], done: Sequence[_Done], settings: dict[str, Any]
    ) -> Manifest:
        """Write what spans units; the manifest of the complete export. If there is no sample, nothing is left."""
        if not any(each.tally.samples for each in done):
            self._remove_others(())
            self._put_away(pack=False)
            remove_in(self.root, f"{self.form.name}{_ENDING}")
            with suppress(OSError):  # there is another export
                self.root.rmdir()
            raise NotAvailableError(self.form.nothing)
        with self._output() as output:
            self.form.finish(self.dataset, [unit for unit, _ in jobs.values()], output, self.parts)
        for each in done:
            output.tally.add(each.tally)
        scenarios = _all_states(jobs)
        made_from = MadeFrom(
            fingerprint=digest_of(_truth(scenarios)), scenarios=dict(sorted(scenarios.items()))
        )
        return Manifest(
            format=self.form.name, settings=settings, release=made_from, written=output.tally
        )

    @contextmanager
    def _output(self, unit: Unit | None = None) -> Iterator[Output]:
        """Yield where to write a unit that the caller has alone, or without one what spans units.

        Each path is noted before something is written there. What earlier calls left half-written is removed at the
        beginning, also of another host's; what only they wrote, at the end.
        """
        name = "" if unit is None else unit.name
        if unit is not None:
            remove_in(self.kept, name)
        journal = self.kept / f"{name}{_PATHS}"
        earlier, now = _noted(journal), set[str]()
        for folder in {place_in(self.root, path).parent for path in earlier}:
            remove_leftovers(folder, [PurePosixPath(path).name for path in earlier])
        write_bytes(
            journal, "".join(f"{path}\0" for path in sorted(earlier)).encode()
        )  # a new file, and no link
        with journal.open("ab", buffering=0) as file:

            def note(path: str) -> None:
                now.add(path)
                file.write(f"{path}\0".encode())

            yield Output(self.root, self.kept / name, self.form.link, note=note)
        self._remove_paths(earlier - now)
        write_bytes(journal, "".join(f"{path}\0" for path in sorted(now)).encode())

    def _remove_others(self, names: Collection[str]) -> None:
        """Remove what was written of units that are not among these, but nothing that these have noted too.

        A program that copies a folder may leave a second journal of a unit, with another name.
        """
        journals = {
            path.name.removesuffix(_PATHS): path
            for path in sorted(self.kept.glob(f"[!.]*{_PATHS}"))
        }
        others = journals.keys() - names
        if not others:  # then no journal need be read
            return
        own = {path for name in journals.keys() - others for path in _noted(journals[name])}
        own |= {parent.as_posix() for path in own for parent in PurePosixPath(path).parents}
        for name in sorted(others):
            self._remove_paths(_noted(journals[name]) - own)
            remove_in(self.kept, name)
            journals[name].unlink()

    def _remove_paths(self, paths: Collection[str]) -> None:
        """Remove files or whole folders, and the folders that are empty then."""
        for path in sorted(paths):
            remove_in(self.root, path)
            with suppress(OSError):
                os.removedirs((self.root / path).parent)

    def _remove_half_written(self) -> None:
        """Remove temporary files of dead processes; a worker that a scheduler took for lost may live, and goes on.

        The caller has the folder alone.
        """
        begun = {temporary_of(each.name) or "" for each in self.root.iterdir()}
        remove_leftovers(
            self.root, [each for each in begun if each.endswith(_ENDING)]
        )  # who has it alone writes those
        for each, _, _ in os.walk(self.root):
            remove_leftovers(Path(each))

    def _put_away(self, *, pack: bool = True) -> None:
        """Remove the store; sensor files may change later, so what a later call needs then is packed into one file."""
        if pack and self.form.sensors():
            with replacing(self._archive) as temporary, zipfile.ZipFile(temporary, "w") as archive:
                for path in sorted(
                    path
                    for path in self.kept.rglob("*")
                    if path.is_file() and not path.is_symlink()
                ):
                    name = path.relative_to(self.kept).as_posix()
                    if not name.isprintable():
                        continue  # a stranger's, and zip has no such names
                    archive.writestr(
                        zipfile.ZipInfo(name), read_bytes(path, "archive")
                    )  # without a date
        self.store.drop(self.form.name)
        self.store.remove(keep=any(self.store.folder.glob("kept/*")))  # another format's

    @property
    def _archive(self) -> Path:
        return place_in(self.root, f".deepaccident-{self.form.name}.zip")

    def _take_out(self) -> None:
        """Unpack what a complete export has put away; raises ExportError if that is damaged."""
        if not self._archive.exists():
            return
        try:
            with open_zip(self._archive) as archive:
                for entry in archive.infolist():
                    write_bytes(
                        place_in(self.kept, entry.filename), read_member(archive, entry, "archive")
                    )
        except OSError:
            raise
        except DAMAGED_ARCHIVE as error:
            remedy = "remove it, and the export is written again as a whole"
            raise ExportError(f"{self._archive}: {fault_text(error)}; {remedy}") from error
        self._archive.unlink()


def _chosen(dataset: Dataset, form: Format) -> list[str]:
    """The tokens of the scenarios to export, in the table's order."""
    of_split = None if form.split is None else dataset.split_scenarios(form.split)
    found = [record["token"] for record in find(dataset, *form.where)]
    chosen = [token for token in found if of_split is None or token in of_split]
    if not chosen:
        raise NotAvailableError(
            "no scenario of this release is in that split and matches the filters; change them"
        )
    return chosen


def _all_states(jobs: Mapping[str, _Job]) -> dict[str, dict[str, str | None]]:
    """The states of the scenarios of all units, none of which has failed."""
    return {
        token: state
        for _, states in jobs.values()
        if not isinstance(states, Failure)
        for token, state in states.items()
    }


def _truth(states: States) -> dict[str, dict[str, Any]]:
    """States of scenarios without their sensor files."""
    return {
        token: {name: each for name, each in state.items() if name != _SENSORS}
        for token, state in states.items()
    }


def _is_current(root: Path, before: States, now: States) -> bool:
    """Whether a complete export has the sensor files of today; raises ExportError if its truth was another."""
    old, new = _truth(before), _truth(now)
    changed = sorted(token for token in {*old, *new} if old.get(token) != new.get(token))
    if changed:
        raise ExportError(
            f"{root}: was made from another state of the release, or a split file ({len(changed)} scenarios have "
            f"changed, come or gone since, such as {changed[0]}); choose another folder"
        )
    return before == now


def _noted(journal: Path) -> set[str]:
    """The paths in a journal; of a killed process the last one may be cut off, and is not written then."""
    try:
        paths = read_bytes(journal, "bundle").decode().split("\0")[:-1]
    except (OSError, ValueError):
        return set()
    return {path for path in paths if len(path) <= _LONGEST and not _REFUSED.fullmatch(path)}
