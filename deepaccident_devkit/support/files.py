"""Files, written so that a reader sees either the old file or the complete new one.

While it is written, a file has a temporary name in the same folder,
`.NAME.HOST-PROCESS-START-NUMBER.tmp`. If the writer is killed, the file remains until another
process writes into that folder, which removes it. The number is random, so an attacker cannot put a
link there in advance.

A folder may contain other people's files, including links. `place_in` and `remove_in` ensure that
code only writes and removes below the folder. Devices, pipes, sockets and folders are never
replaced by a file.
"""

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

from deepaccident_devkit.errors import ConfigError, OutputFolderError
from deepaccident_devkit.support.reading import irregular_text
from deepaccident_devkit.support.text import PathType, path_of

# A temporary name. Earlier versions wrote `.NAME.PROCESS.tmp`; a library may add the suffix that it
# writes by.
_TEMPORARY = re.compile(
    r"\.(?P<name>.+?)\."
    r"(?:(?P<host>[0-9a-f]{8})-(?P<process>[1-9]\d{0,9})-(?P<start>\d+)-)?\d+\.tmp(?:\.\w+)?",
    re.DOTALL,
)
_PLAIN_LENGTH = 120
# Number of characters of the final name in a temporary name: names have at most 255 bytes.
_NAME_LENGTH = 50
# Seconds without a change after which a temporary file of another host is abandoned, since its
# processes cannot be seen from here.
_ABANDONED_AFTER_S = 24 * 3600.0
# Folders whose entries stand for open files and devices, such as `/dev/stdout`.
_SYSTEM_FOLDER = re.compile(r"/(proc|dev(?!/shm))(/.*)?")


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path in the same folder; rename it to `path` if the block succeeds.

    If the block fails, the temporary file is removed. If something other than a regular file is at
    `path`, OutputFolderError is raised before anything is written.
    """
    _check_replaceable(path)
    temporary = _prepare_temporary_path(path)
    try:
        yield temporary
        os.replace(temporary, path)  # noqa: PTH105 - the atomic one on every platform
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def replacing_folder(path: Path) -> Iterator[Path]:
    """Yield a new empty folder next to `path`; it replaces `path` if the block succeeds.

    If the block fails, the new folder is removed. `path` must not exist or must be empty, so
    nothing is ever deleted.
    """
    temporary = _prepare_temporary_path(path)
    try:
        temporary.mkdir()
        yield temporary
        if path.is_dir():
            path.rmdir()
        os.replace(temporary, path)  # noqa: PTH105
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def check_free(out: Path) -> None:
    """Raise ConfigError unless `out` is missing or an empty folder, so that it can be made."""
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ConfigError(
            f"{out}: exists and is not an empty folder; choose another folder, or remove this one"
        )


def temporary_path(path: Path) -> Path:
    """Return a path next to `path` that no other thread, process or host uses."""
    name = path.name[:_NAME_LENGTH]
    writer = _format_writer_name(os.getpid())
    number = secrets.randbits(32)
    return path.with_name(f".{name}.{writer}-{number}.tmp")


def temporary_of(name: str) -> str | None:
    """Return the final name of a temporary name, or its beginning; None for other names."""
    match = _TEMPORARY.fullmatch(name)
    if match:
        return match["name"]
    return None


def remove_leftovers(folder: Path, dead: Collection[str] = ()) -> None:
    """Remove the temporary files and folders of dead writers, as far as they can be removed.

    A writer on this host is dead if no process has its number and its start time, and a writer on
    another host if nothing was changed for a day. A name without a host, as earlier versions gave,
    may belong to another program, and stays. `dead` are final names that only dead writers can
    have, on any host: the caller holds the lock that every writer of these files needs.
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

    It may if `path` is missing, a regular file, a link to one, or a link that leads nowhere.
    Nothing is made in a folder of devices.
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


def _prepare_temporary_path(path: Path) -> Path:
    """Return a temporary path in a folder that exists and is free of leftovers."""
    path.parent.mkdir(parents=True, exist_ok=True)
    _remove_leftovers_once(path.parent)
    return temporary_path(path)


@lru_cache(maxsize=1024)
def _remove_leftovers_once(folder: Path) -> None:
    """Remove a folder's leftovers once per process, since 100,000 files may be written to it."""
    remove_leftovers(folder)


def _is_abandoned(entry: os.DirEntry[str]) -> bool:
    match = _TEMPORARY.fullmatch(entry.name)
    if match is None or match["host"] is None:
        return False
    if match["host"] != _hash_host_name():
        return time.time() - entry.stat(follow_symlinks=False).st_mtime > _ABANDONED_AFTER_S
    return not _is_running(int(match["process"]), match["start"])


def _is_running(process: int, start: str) -> bool:
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:  # another user's
        pass
    return _read_start_time(process) in (start, None)


@lru_cache(maxsize=1)
def _format_writer_name(process: int) -> str:
    """Return a name that no other process has, `HOST-PROCESS-START`."""
    start = _read_start_time(process) or 0
    return f"{_hash_host_name()}-{process}-{start}"


@cache
def _hash_host_name() -> str:
    """Return eight digits for the host, or for the container, which numbers its own processes."""
    try:
        numbering = os.readlink("/proc/self/ns/pid")  # noqa: PTH115 - a name, not a file's path
    except OSError:
        numbering = ""
    host = f"{platform.node()} {numbering}"
    return hashlib.blake2b(host.encode(), digest_size=4).hexdigest()


def _read_start_time(process: int) -> str | None:
    """Return the start time of a process, in ticks of the system's clock.

    It is empty if the process has ended, and None if the system does not show it.
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
    """Write a file into one of the devkit's own folders; a pipe or a socket there is replaced."""
    if path.exists() and not (path.is_file() or path.is_dir()):
        path.unlink()
    write_bytes(path, content)


def place_in(folder: Path, path: str | PurePath, *, opened: bool = False) -> Path:
    """Return a path below a folder; raise OutputFolderError if it could lead outside.

    Writing or removing it changes nothing outside the folder, since no folder on the way is a link.
    This holds at the moment of the call, so call it for each file right before it is used. The
    folder itself may be a link. The file may be one too unless it is `opened` (like a lock, or a
    folder that others write into), since `replacing` and `remove_in` follow no link. If `opened`,
    the path may be empty and then stands for the folder itself.
    """
    relative = PurePath(path)
    if relative.is_absolute() or ".." in relative.parts or not (relative.parts or opened):
        raise OutputFolderError(
            f"{folder}: {str(path)!r} is not a path below it; give another folder"
        )
    target = folder / relative
    first = 0 if opened else 1  # a file that is replaced or removed may be a link
    paths_below = [target, *target.parents][first : len(relative.parts)]
    for path_below in paths_below:
        # Path.is_symlink raises for a name that is too long.
        if os.path.islink(path_below):  # noqa: PTH114
            raise OutputFolderError(
                f"{path_below}: is a symbolic link, which the devkit never creates; remove it, or "
                f"give another folder than {folder}"
            )
    return target


def remove_in(folder: Path, path: str | PurePath) -> None:
    """Remove a file, or a folder with its contents, below a folder, if it exists.

    A link itself is removed, never its target. OSError is raised if the removal fails, and the
    error of `place_in` if the path leads outside.
    """
    target = place_in(folder, path)
    while os.path.isdir(target) and not os.path.islink(target):  # noqa: PTH112, PTH114 - as above
        with suppress(FileNotFoundError):  # another process removes it, too
            shutil.rmtree(target)
    if os.path.lexists(target):
        target.unlink(missing_ok=True)


def plain_names(names: Iterable[str], reserved: Iterable[str] = ()) -> dict[str, str]:
    """Return name → an unused name of a file or folder that is not in `reserved`.

    It consists of letters, digits, `_`, `-` and `.` only.
    """
    used = {name.lower() for name in reserved}
    new_names = {}
    for name in names:
        short_name = re.sub(r"[^A-Za-z0-9_.-]", "_", name)[:_PLAIN_LENGTH]
        if not short_name.strip("."):
            short_name = f"_{short_name}"
        candidate = short_name
        number = 2
        while candidate.lower() in used:
            candidate = f"{short_name}_{number}"
            number += 1
        used.add(candidate.lower())
        new_names[name] = candidate
    return new_names


def is_writable_folder(path: Path) -> bool:
    """Return whether files can be made in a folder, which is made and tried with a file."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            return True
    except OSError:
        return False


def writable_folder(folder: PathType) -> Path:
    """Return the path of a writable folder, which is created if it does not exist.

    Raises:
        ConfigError: If it is not a path, if it or a folder above it is a file, or if it may not be
            written to.
    """
    path = path_of(folder, "expected a folder to write to")
    if is_writable_folder(path):
        return path
    for folder_above in (path, *path.parents):
        if os.path.isfile(folder_above):  # noqa: PTH113 - Path.is_file raises where it may not look
            raise ConfigError(
                f"{path}: cannot be written, as {folder_above} is a file; give a folder"
            )
    raise ConfigError(f"{path}: no file can be written there; give a folder that you can write to")
