"""What readers of the release's files share: bytes and lines, with the devkit's errors if they cannot be read; numbers.

Words that stand for numbers may have any length.
"""

import re
from typing import Final

import numpy as np

from deepaccident_devkit.errors import MissingFileError, ReleaseError
from deepaccident_devkit.release.store import ReleasePath
from deepaccident_devkit.support.arrays import AnyArray, BoolArray
from deepaccident_devkit.support.reading import FileKind, fault_text, read_bytes

REMEDY: Final = "restore the file from its archive"
_NUMBER: Final = re.compile(r"[+-]?((\d+\.?\d*|\.\d+)(e[+-]?\d+)?|nan|inf|infinity)", re.ASCII | re.IGNORECASE)
LARGEST: Final = 1e9
"""Metres, m/s, pixels, …: a larger number is damage and counts as infinite; it would overflow where it is squared."""
_INTEGER: Final = re.compile(r"(-?)0*(\d{1,19})", re.ASCII)


def read_content(path: ReleasePath, kind: FileKind, fault: type[ReleaseError], remedy: str = REMEDY) -> bytes:
    """A file's bytes.

    Raises:
        MissingFileError: there is no such file.
        ReleaseError: of the type `fault`, if it cannot be read: a folder or a pipe, too large for its kind, no
            permission, a failing disk.
    """
    try:
        return read_bytes(path, kind)
    except FileNotFoundError:
        raise MissingFileError(f"{path}: no such file; unpack the archive that holds it") from None
    except OSError as error:
        raise fault(f"{path}: {fault_text(error)}; {remedy}") from error


def read_lines(path: ReleasePath, kind: FileKind, fault: type[ReleaseError], remedy: str = REMEDY) -> list[str]:
    """The lines of a UTF-8 file, without line ends.

    Raises as `read_content` does, and `fault` if the file is no text.
    """
    try:
        return read_content(path, kind, fault, remedy).decode("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise fault(f"{path}: not a text file ({error.reason}); {remedy}") from error


def in_range(numbers: AnyArray | float) -> BoolArray:
    """Which numbers are neither NaN nor infinite, nor as large as no sound file has them."""
    small: BoolArray = np.abs(numbers) <= np.float64(LARGEST)  # half precision has no 1e9
    return small


def number_of(word: str) -> float | None:
    """The number that a word says, NaN and infinity included; None if it says none."""
    return float(word) if _NUMBER.fullmatch(word) else None


def integer_of(word: str) -> int | None:
    """The integer of 64 bits that a word says; None if it says none. Python itself reads no more than 4,300 digits."""
    found = _INTEGER.fullmatch(word)
    value = int(found[1] + found[2]) if found else 2**63
    return value if -(2**63) <= value < 2**63 else None
