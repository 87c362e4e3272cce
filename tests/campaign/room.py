"""What a case is made of: the room where it happens, what is done there, and the kind of file that is changed."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any


@dataclass(frozen=True, slots=True)
class Room:
    """Where a case happens.

    Attributes:
        home: the copies of all healthy files; only the case's folder is changed.
        tree: the case's folder in it.
        victim: the file that is changed.
        scratch: an empty folder.
        healthy: the path of the unchanged file.
    """

    home: Path
    tree: Path
    victim: Path
    scratch: Path
    healthy: Path


Read = Callable[[Room], Any]
Judge = Callable[[Room, Any], "str | None"]


@dataclass(frozen=True, slots=True)
class Action:
    """One thing that a user does with a file.

    Attributes:
        read: does it.
        judge: what is wrong with what was read, None if nothing; it is asked only if something was read.
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
        apart: whether it has a seed of its own, so that it changes no case of the others.
    """

    name: str
    form: str
    folder: str
    pattern: str
    actions: tuple[Action, ...] = field(repr=False)
    apart: bool = False

    def files(self, tree: Path) -> list[Path]:
        """The files of this kind."""
        return sorted(path for path in tree.glob(self.pattern) if path.is_file())
