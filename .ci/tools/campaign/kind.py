"""The description of a kind of files, and the folders in which a case runs."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from campaign.healthy import open_release
from deepaccident_devkit import DeepAccident
from deepaccident_devkit.validation import validate_release

_MAX_SENTENCE_CHARACTERS = 2000
"""Length of the longest sentence that the validation may write about a file."""


@dataclass(frozen=True, slots=True)
class Workspace:
    """Folders and files of a case.

    Attributes:
        home: Folder with copies of all healthy files; a case changes only `folder` in it.
        folder: Folder of the case.
        changed_file: File that the case changes.
        scratch: Empty folder for indexes and other output.
        outside: Folder that nothing may change, although links and paths lead there.
        healthy_file: Unchanged original of `changed_file`.
    """

    home: Path
    folder: Path
    changed_file: Path
    scratch: Path
    outside: Path
    healthy_file: Path


Output = Mapping[str, Any]
"""Values that an action reads, by their tokens or names."""
Read = Callable[[Workspace], Any]
Judge = Callable[[Workspace, Any], "str | None"]


@dataclass(frozen=True, slots=True)
class Action:
    """One thing that a user does with a file.

    Attributes:
        read: Function that does it and returns what was read.
        judge: Function that returns what is wrong with the output of `read`, or None if nothing
            is. It is called only if `read` raises no error.
    """

    read: Read
    judge: Judge = lambda _workspace, _output: None


@dataclass(frozen=True, slots=True)
class Kind:
    """One kind of files.

    Attributes:
        name: Name in the table.
        form: Form of the files, which decides the mutations that fit.
        folder: Folder in the tree of healthy files; a case works on a copy of it.
        pattern: Glob pattern of the files in that folder; a case changes one of them.
        actions: Actions done with the file, one after another; a refusal does not end them.
        needs: Package without which this kind is left out; empty if none is needed.
        writes: Whether the actions write into the folder.
    """

    name: str
    form: str
    folder: str
    pattern: str
    actions: tuple[Action, ...] = field(repr=False)
    needs: str = ""
    writes: bool = False

    @property
    def can_be_read(self) -> bool:
        """Whether the package that this kind needs is installed."""
        return not self.needs or find_spec(self.needs) is not None

    def files(self, folder: Path) -> list[Path]:
        """Return the files of this kind in a folder, without empty ones."""
        files = [path for path in folder.glob(self.pattern) if path.is_file()]
        return sorted(path for path in files if path.stat().st_size)


@cache
def open_dataset(home: Path) -> DeepAccident:
    """Return the release that is evaluated and exported; it is never changed."""
    return open_release(home / "release", home / "index")


def read_findings(path: Path, *, deep: bool = False) -> list[str]:
    """Validate a release, in a folder or a zip; return its findings as sentences."""
    report = validate_release(path, workers=1, deep=deep)
    return [str(finding) for finding in report.findings]


def find_long_sentence(sentences: list[str]) -> str | None:
    """Return the fault of a sentence that is too long to read; None without one."""
    longest = max(map(len, sentences), default=0)
    if longest > _MAX_SENTENCE_CHARACTERS:
        return f"a sentence of {longest} characters"
    return None
