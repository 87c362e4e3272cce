"""Files: written so that a reader sees either the old or the whole new one; opened only if they are regular files."""

import hashlib
import os
import shutil
import stat
import struct
import tempfile
import tokenize
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

DAMAGED_ARCHIVE = (
    OSError,
    ValueError,
    EOFError,
    KeyError,
    MemoryError,
    OverflowError,
    RuntimeError,  # an encrypted member
    SyntaxError,  # a damaged array header
    NotImplementedError,  # an unknown compression
    UnicodeError,
    struct.error,  # a directory of the archive that ends early
    tokenize.TokenError,  # an array header with an open bracket
    zipfile.BadZipFile,
    zlib.error,
)
"""What reading a damaged `.npz` archive can raise."""
_BLOCK = 1 << 20


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path in the same folder; rename it to `path` if the block succeeds, else remove it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
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
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
    try:
        yield temporary
        temporary.chmod(0o777 & ~_umask())
        if path.is_dir():
            path.rmdir()
        os.replace(temporary, path)  # noqa: PTH105
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def write_bytes(path: Path, content: bytes) -> None:
    """Write `content` to `path` atomically, making its folder where needed."""
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def file_checksum(path: Path) -> str:
    """A checksum of a file's bytes; 1.8 GB of tables take 2 s."""
    checksum = hashlib.blake2b(digest_size=16)
    with path.open("rb") as file:
        while block := file.read(_BLOCK):
            checksum.update(block)
    return checksum.hexdigest()


def irregular_text(mode: int) -> str | None:
    """What is in a file's place, by the mode that `stat` gives: `not a regular file (a named pipe)`; else None.

    Opening a pipe waits for its writer, and a device may have no end.
    """
    if stat.S_ISREG(mode):
        return None
    kind = {stat.S_IFDIR: "a folder", stat.S_IFIFO: "a named pipe", stat.S_IFSOCK: "a socket"}.get(stat.S_IFMT(mode))
    return f"not a regular file ({kind or 'a device'})"


def is_writable_folder(path: Path) -> bool:
    """Whether files can be made in `path`: makes the folder and one file in it."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            return True
    except OSError:
        return False


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
