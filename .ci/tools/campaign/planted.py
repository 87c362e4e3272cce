"""Bad readers, one for each way to fail; the campaign must notice each of them."""

import os
import signal
import time
from typing import Any, NoReturn

from campaign.kind import Action, Kind, Read, Workspace
from campaign.mutations import MARKER
from deepaccident_devkit.errors import DeepAccidentError, ReleaseError


def _hang(_workspace: Workspace) -> None:
    end = time.process_time() + 60
    while time.process_time() < end:
        pass


def _write_outside(workspace: Workspace) -> None:
    (workspace.outside / "new.txt").write_bytes(b"")


def _take_memory(_workspace: Workspace) -> int:
    return len(bytearray(400 << 20))


def _request_memory(workspace: Workspace) -> int:
    try:
        return len(bytearray(1 << 40))
    except MemoryError as error:
        raise ReleaseError(f"{workspace.changed_file}: too large") from error


def _raise_foreign_error(workspace: Workspace) -> NoReturn:
    raise KeyError(workspace.changed_file)


def _raise(error: DeepAccidentError) -> NoReturn:
    raise error


def _crash(_workspace: Workspace) -> None:
    os.kill(os.getpid(), signal.SIGSEGV)


def _run_code(workspace: Workspace) -> None:
    (workspace.changed_file.parent / MARKER).mkdir()


class _VerbatimError(ReleaseError):
    """Error that neither shortens nor escapes its message."""

    def __init__(self, message: str) -> None:
        super().__init__()
        self._message = message

    def __str__(self) -> str:
        return self._message


def _fail_if_changed(read: Read) -> Action:
    """Return an action that reads healthy files well, and changed ones with a bad reader."""

    def read_if_changed(workspace: Workspace) -> Any:
        content = workspace.changed_file.read_bytes()
        if content == workspace.healthy_file.read_bytes():
            return "healthy"
        return read(workspace)

    return Action(read_if_changed)


def _read_bytes(workspace: Workspace) -> bytes:
    return workspace.changed_file.read_bytes()


def _judge_bytes(workspace: Workspace, output: bytes) -> str | None:
    if output == workspace.healthy_file.read_bytes():
        return None
    return "other bytes"


def _judge_words(_workspace: Workspace, output: bytes) -> str | None:
    if len(output.decode().split()) > 1:
        return None
    return "few"


_ACTIONS = {
    "hang": _fail_if_changed(_hang),
    "memory": _fail_if_changed(_take_memory),
    "memory, asked for": _fail_if_changed(_request_memory),
    "foreign": _fail_if_changed(_raise_foreign_error),
    "message": _fail_if_changed(
        lambda workspace: _raise(_VerbatimError(f"{workspace.changed_file}: {'x' * 2000}"))
    ),
    "message, nameless": _fail_if_changed(lambda _: _raise(ReleaseError("something is wrong"))),
    "crash": _fail_if_changed(_crash),
    "message, of a terminal": _fail_if_changed(
        lambda workspace: _raise(_VerbatimError(f"{workspace.changed_file}: \x1b[2J"))
    ),
    "outside": _fail_if_changed(_write_outside),
    "code": _fail_if_changed(_run_code),
    "wrong": Action(_read_bytes, _judge_bytes),
    "wrong, too lenient": Action(_read_bytes, _judge_words),
    "refused": _fail_if_changed(
        lambda workspace: _raise(ReleaseError(f"{workspace.changed_file}: damaged"))
    ),
    "read": Action(_read_bytes),
}
KINDS = {
    name: Kind(name, "text", "small", "train.txt", (action,)) for name, action in _ACTIONS.items()
}
"""Kinds named after the verdict that they should get, with more words if several share one."""
