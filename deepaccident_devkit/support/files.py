"""Files, written so that a reader sees either the old or the whole new one.

What is being written has a temporary name in the same folder, `.NAME.HOST-PROCESS-START-NUMBER.tmp`. If the writer is
killed it stays, and the next process that writes into that folder removes it. The number is random, so that nobody can
put a link there beforehand.

A folder may hold a stranger's files, and links among them. `place_in` and `remove_in` keep what is written below it and
removed from it inside. Devices, pipes, sockets and folders are never replaced by a file.
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

# A temporary name. Earlier versions wrote `.NAME.PROCESS.tmp`; a library may add the suffix that it writes by.
_TEMPORARY: Final = re.compile(
    r"\.(?P<name>.+?)\.(?:(?P<host>[0-9a-f]{8})-(?P<process>[1-9]\d{0,9})-(?P<start>\d+)-)?\d+\.tmp(?:\.\w+)?",
    re.DOTALL,
)
_PLAIN_LENGTH: Final = 120
# Characters of the final name that a temporary name has: names of files end at 255 bytes.
_NAME_LENGTH: Final = 50
# Seconds after the last change of a temporary file of another host, whose processes cannot be seen from here.
_ABANDONED_AFTER: Final = 24 * 3600.0
# Folders whose entries stand for open files and devices, such as `/dev/stdout`.
_SYSTEM_FOLDER: Final = re.compile(r"/(proc|dev(?!/shm))(/.*)?")


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path in the same folder; rename it to `path` if the block succeeds, else remove it.

    Raises OutputFolderError, before anything is written, if something other than a regular file stands at `path`.
    """
    _check_replaceable(path)
    temporary = _begun(path)
    try:
        yield temporary
        os.replace(temporary, path)  # noqa: PTH105 - the atomic one on every platform
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def replacing_folder(path: Path) -> Iterator[Path]:
    """Yield a new empty folder beside `path`; it takes the place of `path` if the block succeeds, else is removed.

    `path` itself must be missing or empty, so that nothing is ever deleted for it.
    """
    temporary = _begun(path)
    try:
        temporary.mkdir()
        yield temporary
        if path.is_dir():
            path.rmdir()
        os.replace(temporary, path)  # noqa: PTH105
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def check_free(out: Path) -> None:
    """Raise ConfigError unless a folder can be made there: nothing is, or an empty folder."""
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ConfigError(
            f"{out}: exists and is not an empty folder; choose another folder, or remove this one"
        )


def temporary_path(path: Path) -> Path:
    """A path beside `path` that no other thread, process or host uses."""
    return path.with_name(
        f".{path.name[:_NAME_LENGTH]}.{_writer(os.getpid())}-{secrets.randbits(32)}.tmp"
    )


def temporary_of(name: str) -> str | None:
    """The (beginning of the) final name that belongs to a temporary name; None if it is no temporary name."""
    found = _TEMPORARY.fullmatch(name)
    return found["name"] if found else None


def remove_leftovers(folder: Path, dead: Collection[str] = ()) -> None:
    """Remove the temporary files and folders of dead writers; what cannot be removed is left to the next time.

    A writer on this host is dead if no process has its number and its start time; one on another host if nothing was
    changed for a day. A name without a host, as earlier versions gave, may be another program's, and is left. `dead`
    are final names whose writers are dead, on whatever host: the caller holds a lock without which nobody writes these.
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
    """Raise OutputFolderError unless a file may be renamed to `path`: it is missing, a regular file or a link to one.

    A link that leads nowhere may be replaced. Nothing is made in a folder of devices.
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


def _begun(path: Path) -> Path:
    """A temporary path, whose folder is there and rid of leftovers."""
    path.parent.mkdir(parents=True, exist_ok=True)
    _rid_of_leftovers(path.parent)
    return temporary_path(path)


@lru_cache(maxsize=1024)
def _rid_of_leftovers(folder: Path) -> None:
    """Remove leftovers once a process: a folder may get 100,000 files."""
    remove_leftovers(folder)


def _is_abandoned(entry: os.DirEntry[str]) -> bool:
    found = _TEMPORARY.fullmatch(entry.name)
    if found is None or found["host"] is None:
        return False
    if found["host"] != _host():
        return time.time() - entry.stat(follow_symlinks=False).st_mtime > _ABANDONED_AFTER
    return not _is_running(int(found["process"]), found["start"])


def _is_running(process: int, start: str) -> bool:
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:  # another user's
        pass
    return _start(process) in (start, None)


@lru_cache(maxsize=1)
def _writer(process: int) -> str:
    """What names this process among all: `HOST-PROCESS-START`."""
    return f"{_host()}-{process}-{_start(process) or 0}"


@cache
def _host() -> str:
    """Eight digits for the host, or for the container: its processes have numbers of their own."""
    try:
        numbering = os.readlink("/proc/self/ns/pid")  # noqa: PTH115 - a name, not a file's path
    except OSError:
        numbering = ""
    return hashlib.blake2b(f"{platform.node()} {numbering}".encode(), digest_size=4).hexdigest()


def _start(process: int) -> str | None:
    """When a process began, in ticks of the system's clock; "" if it has ended, None if the system does not say."""
    try:
        status = Path(f"/proc/{process}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return None
    state, *facts = status.rpartition(")")[
        2
    ].split()  # after its name, which may have brackets itself
    return (
        "" if state in "ZX" else facts[18]
    )  # a killed process whose parent does not ask for it is there still


def write_bytes(path: Path, content: bytes) -> None:
    """Write `content` to `path` atomically, making its folder where needed."""
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def write_own(path: Path, content: bytes) -> None:
    """Write a file in a folder that only the devkit writes to; a pipe or a socket in its place is damage, and goes."""
    if path.exists() and not (path.is_file() or path.is_dir()):
        path.unlink()
    write_bytes(path, content)


def place_in(folder: Path, path: str | PurePath, *, opened: bool = False) -> Path:
    """The path of something below a folder; writing or removing it changes nothing outside, or OutputFolderError.

    No folder on the way is a link. This is so at the moment of the call: ask for each file, right before it is used.
    The given folder may be a link. So may the file, if it is not `opened` (as a lock, or a folder into which others
    write): `replacing` and `remove_in` follow no link. The path may be empty, for the folder itself, if that is
    `opened`.
    """
    inside = PurePath(path)
    if inside.is_absolute() or ".." in inside.parts or not (inside.parts or opened):
        raise OutputFolderError(f"{folder}: {str(path)!r} is no path below it; give another folder")
    place = folder / inside
    for part in [place, *place.parents][not opened : len(inside.parts)]:
        if os.path.islink(part):  # noqa: PTH114 - Path.is_symlink raises for a name that is too long
            raise OutputFolderError(
                f"{part}: a symbolic link, which no devkit makes; remove it, or give another folder than {folder}"
            )
    return place


def remove_in(folder: Path, path: str | PurePath) -> None:
    """Remove a file or a whole folder below a folder, if it is there; of a link the link itself, never its target.

    Raises what `place_in` does, and OSError.
    """
    place = place_in(folder, path)
    while os.path.isdir(place) and not os.path.islink(place):  # noqa: PTH112, PTH114 - as above
        with suppress(FileNotFoundError):  # another process removes it, too
            shutil.rmtree(place)
    if os.path.lexists(place):
        place.unlink(missing_ok=True)


def plain_names(names: Iterable[str], taken: Iterable[str] = ()) -> dict[str, str]:
    """Name → the name of a file or folder of its own, none of `taken`: letters, digits, `_`, `-` and `.` alone."""
    used = {name.lower() for name in taken}
    plain: dict[str, str] = {}
    for name in names:
        short = re.sub(r"[^A-Za-z0-9_.-]", "_", name)[:_PLAIN_LENGTH]
        short = short if short.strip(".") else f"_{short}"
        chosen, number = short, 2
        while chosen.lower() in used:
            chosen, number = f"{short}_{number}", number + 1
        used.add(chosen.lower())
        plain[name] = chosen
    return plain


def is_writable_folder(path: Path) -> bool:
    """Whether files can be made in `path`: makes the folder and one file in it."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            return True
    except OSError:
        return False


def writable_folder(folder: str | os.PathLike[str]) -> Path:
    """A folder that files can be written to, made if it is not there.

    Raises:
        ConfigError: it is no path, it or a folder above it is a file, or it may not be written to.
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
