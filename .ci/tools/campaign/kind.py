"""What a kind of files is, and where a case of it happens."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from campaign.healthy import opened
from deepaccident_devkit import DeepAccident


@dataclass(frozen=True, slots=True)
class Room:
    """Where a case happens.

    Attributes:
        home: the copies of all healthy files; only the case's folder is changed.
        tree: the case's folder in it.
        victim: the file that is changed.
        scratch: an empty folder.
        outside: a folder that nothing may change, though links and paths lead there.
        healthy: the path of the unchanged file.
    """

    home: Path
    tree: Path
    victim: Path
    scratch: Path
    outside: Path
    healthy: Path


Read = Callable[[Room], Any]
Judge = Callable[[Room, Any], "str | None"]


@dataclass(frozen=True, slots=True)
class Action:
    """One thing that a user does with a file.

    Attributes:
        read: does it.
        judge: what is wrong with what was read, None if nothing; it is asked only if something was
            read.
    """

    read: Read
    judge: Judge = lambda _room, _read: None


@dataclass(frozen=True, slots=True)
class Kind:
    """One kind of file.

    Attributes:
        name: in the table.
        form: which mutations are made for it.
        folder: of the healthy tree; a case has a copy of it.
        pattern: of the files in it, of which a case changes one.
        actions: what is done with it, one after another; a refusal does not end them.
        needs: a package without which this kind is left out; empty for none.
        writes: whether the actions write into the folder.
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
        """Whether the package that it needs is installed."""
        return not self.needs or find_spec(self.needs) is not None

    def files(self, tree: Path) -> list[Path]:
        """The files of this kind that are not empty."""
        return sorted(
            path for path in tree.glob(self.pattern) if path.is_file() and path.stat().st_size
        )


@cache
def dataset_of(home: Path) -> DeepAccident:
    """What is evaluated and exported; it is never changed."""
    return opened(home / "release", home / "index")
