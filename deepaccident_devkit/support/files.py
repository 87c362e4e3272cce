"""Files, written so that a reader sees either the old or the complete new one.

While it is written, a file has a temporary name in the same folder,
`.NAME.HOST-PROCESS-START-NUMBER.tmp`. If the writer is killed the file stays, and the next process
that writes into that folder removes it. The number is random, so that nobody can put a link there
beforehand.

A folder may hold files of other people, and links among them. With `place_in` and `remove_in`, code
writes and removes only below it. Devices, pipes, sockets and folders are never replaced by a file.
"""

from __future__ import annotations

import hashlib
import os
import platform
import re
import secrets
import shutil
import tempfile
import time
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import cache, lru_cache
from pathlib import Path, PurePath
from typing import Final

from deepaccident_devkit.errors import ConfigError, OutputFolderError
from deepaccident_devkit.support.reading import irregular_text
from deepaccident_devkit.support.text import path_of

# A temporary name. Earlier versions wrote `.NAME.PROCESS.tmp`; a library may add the suffix that it
# writes by.
_TEMPORARY: Final = re.compile(
    r"\.(?P<name>.+?)\."
    r"(?:(?P<host>[0-9a-f]{8})-(?P<process>[1-9]\d{0,9})-(?P<start>\d+)-)?\d+\.tmp(?:\.\w+)?",
    re.DOTALL,
)
_PLAIN_LENGTH: Final = 120
# Characters of the final name in a temporary name: file names have at most 255 bytes.
_NAME_LENGTH: Final = 50
# Seconds without a change after which a temporary file of another host is abandoned, since its
# processes cannot be seen from here.
_ABANDONED_AFTER_S: Final = 24 * 3600.0
# Folders whose entries stand for open files and devices, such as `/dev/stdout`.
_SYSTEM_FOLDER: Final = re.compile(r"/(proc|dev(?!/shm))(/.*)?")


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path in the same folder; rename it to `path` if the block succeeds.

    Otherwise it is removed. Raises OutputFolderError, before anything is written, if something
    other than a regular file stands at `path`.
    """
    _check_replaceable(path)
    temporary = _prepared_path(path)
    try:
        yield temporary
        os.replace(temporary, path)  # noqa: PTH105 - the atomic one on every platform
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def replacing_folder(path: Path) -> Iterator[Path]:
    """Yield a new empty folder beside `path`; it replaces `path` if the block succeeds.

    Otherwise it is removed. `path` itself must be missing or empty, so that nothing is ever deleted
    for it.
    """
    temporary = _prepared_path(path)
    try:
        temporary.mkdir()
        yield temporary
        if path.is_dir():
            path.rmdir()
        os.replace(temporary, path)  # noqa: PTH105
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def check_free(out: Path) -> None:
    """Raise ConfigError unless a folder can be made there: nothing exists, or an empty folder."""
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ConfigError(
            f"{out}: exists and is not an empty folder; choose another folder, or remove this one"
        )


def temporary_path(path: Path) -> Path:
    """Return a path beside `path` that no other thread, process or host uses."""
    name, writer = path.name[:_NAME_LENGTH], _writer_name(os.getpid())
    return path.with_name(f".{name}.{writer}-{secrets.randbits(32)}.tmp")


def temporary_of(name: str) -> str | None:
    """Return the (beginning of the) final name of a temporary name; None for other names."""
    match = _TEMPORARY.fullmatch(name)
    if match:
        return match["name"]
    return None


def remove_leftovers(folder: Path, dead: Collection[str] = ()) -> None:
    """Remove the temporary files and folders of dead writers, as far as they can be removed.

    A writer on this host is dead if no process has its number and its start time; one on another
    host if nothing was changed for a day. A name without a host, as earlier versions gave, may
    belong to another program, and stays. `dead` are final names with dead writers, on whatever
    host: the caller holds a lock without which nobody writes these.
    """
    beginnings = {name[:_NAME_LENGTH] for name in dead}
    with suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            with suppress(OSError):  # another process removes it too
                if temporary_of(entry.name) not in beginnings and not _is_abandoned(entry):
                    continue
                if entry.is_dir(follow_symlinks=False):
                    shutil.rmtree(entry.path, ignore_errors=True)
                else:
                    Path(entry.path).unlink()


def _check_replaceable(path: Path) -> None:
    """Raise OutputFolderError unless a file may be renamed to `path`.

    It may if `path` is missing, a regular file or a link to one. A link that leads nowhere may be
    replaced. Nothing is made in a folder of devices.
    """
    fault = None
    if _SYSTEM_FOLDER.fullmatch(os.path.realpath(path.parent)):
        fault = "a device or an open file"
    elif os.path.exists(path):  # noqa: PTH110 - Path.exists raises for a name that is too long
        fault = irregular_text(path.stat().st_mode)
    if fault:
        raise OutputFolderError(
            f"{path}: {fault}, so it is not replaced; give the path of a new file"
        )


def _prepared_path(path: Path) -> Path:
    """Return a temporary path; its folder is made and freed from leftovers."""
    path.parent.mkdir(parents=True, exist_ok=True)
    _remove_leftovers_once(path.parent)
    return temporary_path(path)


@lru_cache(maxsize=1024)
def _remove_leftovers_once(folder: Path) -> None:
    """Remove leftovers once in a process, since a folder may get 100,000 files."""
    remove_leftovers(folder)


def _is_abandoned(entry: os.DirEntry[str]) -> bool:
    match = _TEMPORARY.fullmatch(entry.name)
    if match is None or match["host"] is None:
        return False
    if match["host"] != _host_name():
        return time.time() - entry.stat(follow_symlinks=False).st_mtime > _ABANDONED_AFTER_S
    return not _is_running(int(match["process"]), match["start"])


def _is_running(process: int, start: str) -> bool:
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:  # another user's
        pass
    return _start_time(process) in (start, None)


@lru_cache(maxsize=1)
def _writer_name(process: int) -> str:
    """Return the name of this process among all: `HOST-PROCESS-START`."""
    return f"{_host_name()}-{process}-{_start_time(process) or 0}"


@cache
def _host_name() -> str:
    """Return eight digits for the host, or for the container, which numbers its own processes."""
    try:
        numbering = os.readlink("/proc/self/ns/pid")  # noqa: PTH115 - a name, not a file's path
    except OSError:
        numbering = ""
    return hashlib.blake2b(f"{platform.node()} {numbering}".encode(), digest_size=4).hexdigest()


def _start_time(process: int) -> str | None:
    """Return when a process began, in ticks of the system's clock.

    Empty if it has ended, None if the system does not show it.
    """
    try:
        status = Path(f"/proc/{process}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return None
    # The fields follow the name, which may contain brackets itself.
    state, *fields = status.rpartition(")")[2].split()
    # A killed process remains listed until its parent asks for its exit status.
    if state in "ZX":
        return ""
    return fields[18]


def write_bytes(path: Path, content: bytes) -> None:
    """Write `content` to `path` atomically, making its folder if necessary."""
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def write_own(path: Path, content: bytes) -> None:
    """Write a file in a folder of the devkit's own; a pipe or a socket there is replaced."""
    if path.exists() and not (path.is_file() or path.is_dir()):
        path.unlink()
    write_bytes(path, content)


def place_in(folder: Path, path: str | PurePath, *, opened: bool = False) -> Path:
    """Return a path below a folder; raise OutputFolderError if it could lead outside.

    Writing or removing it changes nothing outside the folder: no folder on the way is a link. This
    holds at the moment of the call, so ask for each file right before it is used. The folder itself
    may be a link. So may the file, if it is not `opened` (as a lock, or a folder into which others
    write), since `replacing` and `remove_in` follow no link. The path may be empty, for the folder
    itself, if that is `opened`.
    """
    relative = PurePath(path)
    if relative.is_absolute() or ".." in relative.parts or not (relative.parts or opened):
        raise OutputFolderError(f"{folder}: {str(path)!r} is no path below it; give another folder")
    target = folder / relative
    for part in [target, *target.parents][not opened : len(relative.parts)]:
        # Path.is_symlink raises for a name that is too long.
        if os.path.islink(part):  # noqa: PTH114
            raise OutputFolderError(
                f"{part}: a symbolic link, which no devkit makes; remove it, or give another "
                f"folder than {folder}"
            )
    return target


def remove_in(folder: Path, path: str | PurePath) -> None:
    """Remove a file or a folder with its contents below a folder, if it exists.

    Of a link it removes the link itself, never its target. Raises what `place_in` does, and
    OSError.
    """
    target = place_in(folder, path)
    while os.path.isdir(target) and not os.path.islink(target):  # noqa: PTH112, PTH114 - as above
        with suppress(FileNotFoundError):  # another process removes it, too
            shutil.rmtree(target)
    if os.path.lexists(target):
        target.unlink(missing_ok=True)


def plain_names(names: Iterable[str], reserved: Iterable[str] = ()) -> dict[str, str]:
    """Return name → an unused name of a file or folder, none of `reserved`.

    It only has letters, digits, `_`, `-` and `.`.
    """
    used = {name.lower() for name in reserved}
    plain: dict[str, str] = {}
    for name in names:
        short = re.sub(r"[^A-Za-z0-9_.-]", "_", name)[:_PLAIN_LENGTH]
        short = short if short.strip(".") else f"_{short}"
        candidate, number = short, 2
        while candidate.lower() in used:
            candidate, number = f"{short}_{number}", number + 1
        used.add(candidate.lower())
        plain[name] = candidate
    return plain


def is_writable_folder(path: Path) -> bool:
    """Return whether files can be made in `path`; make the folder and one file in it."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            return True
    except OSError:
        return False


def writable_folder(folder: str | os.PathLike[str]) -> Path:
    """Return a folder that files can be written to, made if it does not exist.

    Raises:
        ConfigError: It is no path, it or a folder above it is a file, or it may not be written to.
    """
    path = path_of(folder, "expected a folder to write to")
    if is_writable_folder(path):
        return path
    for part in (path, *path.parents):
        if os.path.isfile(part):  # noqa: PTH113 - Path.is_file raises where it may not look
            raise ConfigError(
                f"{path}: no file can be written there, {part} is a file; give a folder"
            )
    raise ConfigError(f"{path}: no file can be written there; give a folder that you may write to")
