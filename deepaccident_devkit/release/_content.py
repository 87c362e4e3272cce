"""The bytes and lines of the release's small files, with the devkit's errors if they cannot be read."""

import os
from pathlib import Path

from deepaccident_devkit.errors import MissingFileError, ReleaseError
from deepaccident_devkit.files import irregular_text

_USUAL_SIZE = 1 << 16
_FLAGS = os.O_RDONLY | getattr(os, "O_BINARY", 0) | getattr(os, "O_NONBLOCK", 0)  # no waiting for a pipe


def read_content(path: Path, fault: type[ReleaseError], remedy: str) -> bytes:
    """A file's bytes. Plain system calls: `open` would double the time of a small file.

    Raises:
        MissingFileError: there is no such file.
        ReleaseError: of the kind `fault`, if it cannot be read: a folder or a pipe, no permission, a failing disk.
    """
    try:
        descriptor = os.open(path, _FLAGS)
        try:
            if (irregular := irregular_text(os.fstat(descriptor).st_mode)) is not None:
                raise fault(f"{path}: {irregular}; {remedy}")
            content = os.read(descriptor, _USUAL_SIZE)
            while more := os.read(descriptor, _USUAL_SIZE):
                content += more
        finally:
            os.close(descriptor)
    except FileNotFoundError:
        raise MissingFileError(f"{path}: no such file; unpack the archive that holds it") from None
    except OSError as error:
        raise fault(f"{path}: cannot be read ({error.strerror}); {remedy}") from error
    return content


def check_regular(path: Path, fault: type[ReleaseError], remedy: str) -> None:
    """Refuse what is no regular file, for readers that open files themselves; they report a missing file."""
    try:
        irregular = irregular_text(path.stat().st_mode)
    except OSError:
        return
    if irregular is not None:
        raise fault(f"{path}: {irregular}; {remedy}")


def read_lines(path: Path, fault: type[ReleaseError], remedy: str) -> list[str]:
    """The lines of a UTF-8 file, without line ends.

    Raises as `read_content` does, and `fault` if the file is no text.
    """
    try:
        return read_content(path, fault, remedy).decode("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise fault(f"{path}: not a text file ({error.reason}); {remedy}") from error
