"""What lies beside an export: of each unit its parts, the paths that it wrote, and a record that it is done.

By the paths the next call removes what an earlier one wrote and would not be written today: of a scenario whose files
have changed since, or that is not chosen any more. By the parts a complete export gets new sensor files without being
written as a whole.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Final

from deepaccident_devkit._version import __version__
from deepaccident_devkit.export.bulk.format import Unit
from deepaccident_devkit.export.bulk.output import MALFORMED, Link, Output, Tally
from deepaccident_devkit.files import held_lock, place_in, remove_in, remove_leftovers, write_bytes
from deepaccident_devkit.json_text import parsed_json
from deepaccident_devkit.reading import read_bytes

FOLDER: Final = ".deepaccident-parts"
_DONE: Final = "done.json"
_PATHS: Final = ".paths"
_LOCK: Final = ".lock"
_REFUSED: Final = re.compile(r"(.*/)?(\.{0,2}|\.deepaccident[^/]*|[^/]*\.manifest\.json)(/.*)?", re.DOTALL)
"""Paths that no export notes: out of its folder, or to what it keeps there itself. Somebody else wrote those."""
_LONGEST: Final = 4096
"""Characters of a path; no system opens a longer one."""


@dataclass(frozen=True, slots=True)
class Unfinished:
    """The folder of all that, for one format; cheap to pickle.

    Attributes:
        root: of the export.
        name: of the format.
    """

    root: Path
    name: str

    @property
    def folder(self) -> Path:
        """Its place, there or not; raises OutputFolderError if it is behind a link."""
        return place_in(self.root, f"{FOLDER}/{self.name}", opened=True)

    def parts(self, unit: Unit) -> Path:
        """The folder of a unit's parts."""
        return self.folder / unit.name

    def done(self, unit: Unit) -> tuple[Mapping[str, Any], Tally] | None:
        """The hashes of a unit's scenarios and the unit's counts; None if this devkit has not written it."""
        try:
            record = parsed_json(read_bytes(self.parts(unit) / _DONE, "bundle"))
            if record["devkit"] != __version__:
                return None
            return dict(record["scenarios"]), Tally.of(record["written"])
        except (OSError, *MALFORMED):
            return None

    def set_done(self, unit: Unit, scenarios: Mapping[str, Any], tally: Tally) -> None:
        """Record that a unit was written."""
        record = {"devkit": __version__, "scenarios": scenarios, "written": tally.as_dict()}
        write_bytes(self.parts(unit) / _DONE, json.dumps(record).encode())

    @contextmanager
    def alone(self, unit: Unit) -> Iterator[None]:
        """Keep other processes and hosts from writing the same unit in the block."""
        lock = held_lock(self.folder / f"{unit.name}{_LOCK}", f"writes {unit.name}")
        try:
            yield
        finally:
            lock.release()

    @contextmanager
    def output(self, link: Link, unit: Unit | None = None) -> Iterator[Output]:
        """Yield where to write a unit that the caller has alone, or without one what spans units.

        Each path is noted before something is written there. What earlier calls left half-written is removed at the
        beginning, also of another host's; what only they wrote, at the end.
        """
        name = "" if unit is None else unit.name
        if unit is not None:
            remove_in(self.folder, name)
        journal = self.folder / f"{name}{_PATHS}"
        earlier, now = _noted(journal), set[str]()
        self._remove_half_written(earlier)
        write_bytes(journal, "".join(f"{path}\0" for path in sorted(earlier)).encode())  # a new file, and no link
        with journal.open("ab", buffering=0) as file:

            def note(path: str) -> None:
                now.add(path)
                file.write(f"{path}\0".encode())

            yield Output(self.root, self.folder / name, link, note=note)
        self._remove_paths(earlier - now)
        write_bytes(journal, "".join(f"{path}\0" for path in sorted(now)).encode())

    def remove_others(self, units: Sequence[Unit]) -> None:
        """Remove what was written of units that are not among these, but nothing that these have noted too.

        A program that copies a folder may leave a second journal of a unit, with another name.
        """
        journals = {path.name.removesuffix(_PATHS): path for path in sorted(self.folder.glob(f"[!.]*{_PATHS}"))}
        others = journals.keys() - {unit.name for unit in units}
        if not others:  # then no journal need be read
            return
        kept = {path for name in journals.keys() - others for path in _noted(journals[name])}
        above = {parent.as_posix() for path in kept for parent in PurePosixPath(path).parents}
        for name in sorted(others):
            self._remove_paths(_noted(journals[name]) - kept - above)
            remove_in(self.folder, name)
            journals[name].unlink()
            (self.folder / f"{name}{_LOCK}").unlink(missing_ok=True)

    def remove(self) -> None:
        """Remove all of it."""
        remove_in(self.root, f"{FOLDER}/{self.name}")
        with suppress(OSError):  # another format's is there
            (self.root / FOLDER).rmdir()

    def _remove_half_written(self, paths: Collection[str]) -> None:
        """Remove the temporary files and folders of these paths."""
        names: dict[Path, set[str]] = {}
        for place in (place_in(self.root, path) for path in paths):
            names.setdefault(place.parent, set()).add(place.name)
        for folder, each in names.items():
            remove_leftovers(folder, each)

    def _remove_paths(self, paths: Collection[str]) -> None:
        """Remove files or whole folders, and the folders that are empty then."""
        for path in sorted(paths):
            remove_in(self.root, path)
            with suppress(OSError):
                os.removedirs((self.root / path).parent)


def _noted(journal: Path) -> set[str]:
    """The paths in a journal; of a killed process the last one may be cut off, and is not written then."""
    try:
        paths = read_bytes(journal, "bundle").decode().split("\0")[:-1]
    except (OSError, ValueError):
        return set()
    return {path for path in paths if len(path) <= _LONGEST and not _REFUSED.fullmatch(path)}
