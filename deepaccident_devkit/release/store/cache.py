"""Copies of files that have no path of their own, in a folder of bounded size; who was not used the longest goes first.

Several processes use it at once: each file appears whole, and one that is removed while it is read stays readable.
"""

from __future__ import annotations

import hashlib
import os
from contextlib import suppress
from pathlib import Path
from typing import Final

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.support.files import place_in, remove_in, temporary_of, write_bytes
from deepaccident_devkit.support.reading import bytes_of, fault_text

FOLDER_VARIABLE: Final = "DEEPACCIDENT_CACHE"
SIZE_VARIABLE: Final = "DEEPACCIDENT_CACHE_SIZE"
_DEFAULT_SIZE: Final = "20G"
_LOOKED_AFTER: Final = 0.05
"""Part of the size that a process may add before it looks at the whole folder again."""
_KEPT: Final = 0.9
"""Part of the size that is left when something had to go."""


class FileCache:
    """A folder of copies."""

    def __init__(self, folder: Path, most: int) -> None:
        """Keep at most so many bytes in a folder, or a little more while several processes write."""
        self.folder, self.most = folder, most
        self._added = most  # so that the first one looks

    @classmethod
    def of_user(cls) -> FileCache:
        """The one that the environment names, else in the user's cache folder; raises ConfigError for a wrong size."""
        from platformdirs import user_cache_path

        most = bytes_of(os.environ.get(SIZE_VARIABLE) or _DEFAULT_SIZE)
        if most is None:
            raise ConfigError(f"{SIZE_VARIABLE}: expected bytes with K, M, G or T, such as {_DEFAULT_SIZE}")
        folder = os.environ.get(FOLDER_VARIABLE)
        place = Path(folder).expanduser() if folder else user_cache_path("deepaccident_devkit") / "files"
        return cls(place.absolute(), most)

    def path_of(self, identity: str, name: str) -> Path:
        """Where the copy of a file lies if it is there: `identity` tells it from all others, `name` is its own.

        Raises:
            OutputFolderError: it lies behind a link, which somebody put into the folder.
        """
        digest = hashlib.blake2b(identity.encode(errors="surrogateescape"), digest_size=16).hexdigest()
        return place_in(self.folder, f"{digest[:2]}/{digest[2:]}/{name}", opened=True)

    def found(self, path: Path, size: int) -> bool:
        """Whether a copy is there, whole; it counts as used now."""
        try:
            if path.stat().st_size != size:
                return False
            os.utime(path)
        except OSError:
            return False
        return True

    def put(self, path: Path, content: bytes) -> None:
        """Keep a copy.

        Raises:
            OSError: there is no room, or it cannot be written to; the message names the folder and the remedy.
        """
        try:
            self._make_room(len(content))
            write_bytes(path, content)
        except OSError as error:
            raise OSError(
                error.errno,
                f"cannot be kept in {self.folder}: {fault_text(error)}; make room there, or name another folder by "
                f"{FOLDER_VARIABLE} or fewer bytes by {SIZE_VARIABLE}",
            ) from error

    def _make_room(self, size: int) -> None:
        self._added += size
        if self._added <= _LOOKED_AFTER * self.most:
            return
        self._added = size
        there = self._there()
        total = sum(bytes_ for _, bytes_, _ in there) + size
        if total <= self.most:
            return
        for _, bytes_, path in sorted(there):
            if total <= _KEPT * self.most:
                break
            with suppress(OSError):  # another process removes it too
                remove_in(self.folder, path.relative_to(self.folder))
                path.parent.rmdir()
            total -= bytes_

    def _there(self) -> list[tuple[int, int, Path]]:
        """When each copy was used, its bytes, and where it is; none that is being written."""
        found = []
        for path in self.folder.glob("??/*/*"):
            with suppress(OSError):
                if temporary_of(path.name) is None:
                    status = path.stat()
                    found.append((status.st_mtime_ns, status.st_size, path))
        return found
