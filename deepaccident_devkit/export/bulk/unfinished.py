"""What lies beside an export: of each unit its parts, the paths that it wrote, and its counts once it is done.

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
from deepaccident_devkit.errors import ExportError
from deepaccident_devkit.export.bulk.format import Unit
from deepaccident_devkit.export.bulk.output import Link, Output, Tally
from deepaccident_devkit.files import place_in, remove_in, remove_leftovers, write_bytes
from deepaccident_devkit.json_text import parsed_json
from deepaccident_devkit.parallel import Store
from deepaccident_devkit.reading import read_bytes
from deepaccident_devkit.release.fingerprints import digest_of

FOLDER: Final = ".deepaccident-parts"
_DONE: Final = "done"
_PATHS: Final = ".paths"
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
        command: a digest of the format, its settings and what is exported.
    """

    root: Path
    name: str
    command: str = ""

    @property
    def store(self) -> Store:
        """What says which units are done, and keeps others from writing the same."""
        folder = place_in(self.root, FOLDER, opened=True)
        return Store(folder, self.root, "writes an export", ExportError, self.command)

    @property
    def folder(self) -> Path:
        """Its place, there or not; raises OutputFolderError if it is behind a link."""
        return self.store.path(self.name)

    def parts(self, unit: Unit) -> Path:
        """The folder of a unit's parts."""
        return self.folder / unit.name

    def is_written(self, unit: Unit) -> bool:
        """Whether there is a record that a unit was written, from whatever files."""
        return (self.parts(unit) / _DONE).exists()

    def done(self, unit: Unit, states: Mapping[str, Any]) -> Tally | None:
        """The counts of a unit; None if this devkit has not written it from files of these states."""
        content = self.store.kept(f"{self.name}/{unit.name}/{_DONE}", _key(states))
        return None if content is None else Tally.of(parsed_json(content))

    def set_done(self, unit: Unit, states: Mapping[str, Any], tally: Tally) -> None:
        """Record that a unit was written."""
        self.store.keep(f"{self.name}/{unit.name}/{_DONE}", _key(states), json.dumps(tally.as_dict()).encode())

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

    def remove(self, *, keep: bool) -> None:
        """Remove all of it, or with `keep` the locks alone."""
        if not keep:
            self.store.drop(self.name)
        self.store.remove(keep=any(self.store.folder.glob("kept/*")))  # another format's

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


def _key(states: Mapping[str, Any]) -> str:
    return digest_of({"devkit": __version__, "states": dict(states)})


def _noted(journal: Path) -> set[str]:
    """The paths in a journal; of a killed process the last one may be cut off, and is not written then."""
    try:
        paths = read_bytes(journal, "bundle").decode().split("\0")[:-1]
    except (OSError, ValueError):
        return set()
    return {path for path in paths if len(path) <= _LONGEST and not _REFUSED.fullmatch(path)}
