"""Bad readers, one for each way to fail: the campaign must notice each."""

import os
import signal
import time
from pathlib import Path
from typing import Any, NoReturn

from campaign.kind import Action, Kind, Room
from campaign.mutations import MARKER
from deepaccident_devkit.errors import DeepAccidentError, ReleaseError


def _hangs(_room: Room) -> None:
    until = time.process_time() + 60
    while time.process_time() < until:
        pass


def _writes_outside(room: Room) -> None:
    (room.outside / "new.txt").write_bytes(b"")


def _takes_memory(_room: Room) -> int:
    return len(bytearray(400 << 20))


def _asks_for_memory(_room: Room) -> int:
    try:
        return len(bytearray(1 << 40))
    except MemoryError as error:
        raise ReleaseError(f"{_room.victim}: too large") from error


def _raises_another(room: Room) -> NoReturn:
    raise KeyError(room.victim)


def _raises(error: DeepAccidentError) -> NoReturn:
    raise error


def _dies(_room: Room) -> None:
    os.kill(os.getpid(), signal.SIGSEGV)


def _runs_code(room: Room) -> None:
    (room.victim.parent / MARKER).mkdir()


class _AsItIsError(ReleaseError):
    """Says its whole message, and shortens and escapes nothing."""

    def __init__(self, message: str) -> None:
        super().__init__()
        self._message = message

    def __str__(self) -> str:
        return self._message


def _unless_healthy(read: Any) -> Any:
    """Healthy files are read well: only the file's changed content is met by the fault."""
    return lambda room: (
        "healthy" if room.victim.read_bytes() == room.healthy.read_bytes() else read(room)
    )


_READERS = {
    "hang": Action(_unless_healthy(_hangs)),
    "memory": Action(_unless_healthy(_takes_memory)),
    "memory, asked for": Action(_unless_healthy(_asks_for_memory)),
    "foreign": Action(_unless_healthy(_raises_another)),
    "message": Action(
        _unless_healthy(lambda room: _raises(_AsItIsError(f"{room.victim}: {'x' * 2000}")))
    ),
    "message, nameless": Action(
        _unless_healthy(lambda _: _raises(ReleaseError("something is wrong")))
    ),
    "crash": Action(_unless_healthy(_dies)),
    "message, of a terminal": Action(
        _unless_healthy(lambda room: _raises(_AsItIsError(f"{room.victim}: \x1b[2J")))
    ),
    "outside": Action(_unless_healthy(_writes_outside)),
    "code": Action(_unless_healthy(_runs_code)),
    "wrong": Action(
        lambda room: Path(room.victim).read_bytes(),
        lambda room, read: None if read == room.healthy.read_bytes() else "other bytes",
    ),
    "wrong, too lenient": Action(
        lambda room: Path(room.victim).read_bytes(),
        lambda _, read: None if len(read.decode().split()) > 1 else "few",
    ),
    "refused": Action(
        _unless_healthy(lambda room: _raises(ReleaseError(f"{room.victim}: damaged")))
    ),
    "read": Action(lambda room: room.victim.read_bytes()),
}
KINDS = {
    name: Kind(name, "text", "small", "train.txt", (action,)) for name, action in _READERS.items()
}
"""By the verdict that each should get, and more words where a verdict has several."""
