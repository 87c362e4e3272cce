"""What a format writes into an export's folder, and the counts of it."""

from __future__ import annotations

import copy
import errno
import os
import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal

from deepaccident_devkit.errors import SensorFileError
from deepaccident_devkit.files import place_in, remove_in, replacing, replacing_folder, write_bytes
from deepaccident_devkit.reading import fault_text, open_file, read_bytes
from deepaccident_devkit.release.store import ReleasePath, StorePath

Link = Literal["hard", "symbolic", "copy"]
_NO_LINKS: Final = (errno.EXDEV, errno.EPERM, errno.EACCES, errno.EMLINK, errno.ENOTSUP, errno.ENOSYS)
"""What a file system answers that cannot make a link; a full disk is another matter."""
MALFORMED: Final = (ValueError, KeyError, TypeError, AttributeError, ArithmeticError)
"""What `Tally.of` and other readers of JSON raise for a value that is not as it should be."""


@dataclass(slots=True, kw_only=True)
class Tally:
    """Counts of what was written.

    Attributes:
        files: written, not linked or copied.
        bytes: in them.
        linked: way → files of the release that were linked or copied.
        left_out: what → how much of it the format cannot hold, or is not in this (partial) release.
    """

    files: int = 0
    bytes: int = 0
    linked: Counter[str] = field(default_factory=Counter)
    left_out: Counter[str] = field(default_factory=Counter)

    def add(self, other: Tally) -> None:
        """Count what another one counts."""
        self.files += other.files
        self.bytes += other.bytes
        self.linked += other.linked
        self.left_out += other.left_out

    def __add__(self, other: Tally) -> Tally:
        """Both together."""
        both = copy.deepcopy(self)
        both.add(other)
        return both

    def as_dict(self) -> dict[str, Any]:
        """For a manifest; names in order."""
        return {
            "files": self.files,
            "bytes": self.bytes,
            "linked": dict(sorted(self.linked.items())),
            "left_out": dict(sorted(self.left_out.items())),
        }

    @classmethod
    def of(cls, read: Mapping[str, Any]) -> Tally:
        """Of `as_dict`; raises one of `MALFORMED` for anything else."""
        return cls(
            files=int(read["files"]),
            bytes=int(read["bytes"]),
            linked=Counter({str(name): int(count) for name, count in read["linked"].items()}),
            left_out=Counter({str(name): int(count) for name, count in read["left_out"].items()}),
        )


class Output:
    """The folder that a unit is written into. Each file is complete or absent, and counted.

    Attributes:
        folder: where paths begin.
        parts: a folder of the unit's own for what `finish` puts together; gone when the export is complete.
        tally: the counts so far.
    """

    def __init__(
        self,
        folder: Path,
        parts: Path,
        link: Link,
        tally: Tally | None = None,
        note: Callable[[str], object] = lambda _: None,
    ) -> None:
        """Write below `folder`, and link the release's files in this way or, where that cannot be, in the next one.

        `note` is called with each path before something is written there.
        """
        self.folder, self.parts, self.tally = folder, parts, Tally() if tally is None else tally
        self._link, self._note = link, note

    def __repr__(self) -> str:
        return f"<output in {self.folder}>"

    def write(self, path: str, content: bytes) -> None:
        """Write a file; the path is relative to the folder."""
        write_bytes(self._place(path), content)
        self._count(len(content))

    @contextmanager
    def file(self, path: str) -> Iterator[Path]:
        """Yield a temporary path for a file that is written piece by piece."""
        with replacing(self._place(path)) as temporary:
            yield temporary
            size = temporary.stat().st_size
        self._count(size)

    @contextmanager
    def whole_folder(self, path: str) -> Iterator[Output]:
        """Yield the output of a folder whose files all appear at once, in the place of an older one."""
        target = self._place(path)
        remove_in(self.folder, path)
        with replacing_folder(target) as temporary:
            yield Output(temporary, self.parts, self._link, self.tally)

    def link(self, source: ReleasePath, path: str, *, symbolic: bool = True) -> None:
        """Link a file of the release: hard, else symbolic, else copied, as one out of an archive is.

        Args:
            source: the file.
            path: relative to the folder.
            symbolic: whether it may be a symbolic link, which shows the path of the file in the release.

        Raises:
            SensorFileError: it cannot be read.
        """
        try:
            if isinstance(source, StorePath):
                write_bytes(self._place(path), read_bytes(source, "image"))
                self.tally.linked["copy"] += 1
                return
            real = Path(os.path.realpath(source))
            open_file(real).close()
        except OSError as error:
            raise SensorFileError(f"{source}: {fault_text(error)}; restore it from its archive") from error
        with replacing(self._place(path)) as temporary:
            self.tally.linked[_linked(real, temporary, self._link, symbolic=symbolic)] += 1

    def leave_out(self, what: str, count: int = 1) -> None:
        """Count what is not written; `what` is a plural in plain words, such as `untracked boxes`."""
        if count:
            self.tally.left_out[what] += count

    def _place(self, path: str) -> Path:
        self._note(path)
        return place_in(self.folder, path)

    def _count(self, size: int) -> None:
        self.tally.files += 1
        self.tally.bytes += size


def _linked(source: Path, target: Path, link: Link, *, symbolic: bool) -> Link:
    """Make `target` show `source`, and say how."""
    if link == "hard":
        try:
            os.link(source, target)
        except OSError as error:
            if error.errno not in _NO_LINKS:
                raise
        else:
            return "hard"
    if symbolic and link in ("hard", "symbolic"):
        try:
            target.symlink_to(source)
        except OSError as error:
            if error.errno not in _NO_LINKS:
                raise
        else:
            return "symbolic"
    shutil.copyfile(source, target)
    return "copy"
