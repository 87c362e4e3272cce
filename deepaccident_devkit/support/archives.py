"""Zip archives and the arrays in them: checked before anything large is made, and compared with their checksums."""

import errno
import io
import math
import os
import struct
import tokenize
import zipfile
import zlib
from pathlib import Path
from typing import BinaryIO, Final

import numpy as np

from deepaccident_devkit.errors import shortened
from deepaccident_devkit.support.arrays import AnyArray
from deepaccident_devkit.support.reading import FileKind, RefusedFileError, check_size, open_file

_END, _LARGE_END, _LOCATOR = b"PK\x05\x06", b"PK\x06\x06", b"PK\x06\x07"
"""How the end of an archive, the end of a large one, and what leads to that, begin."""
_END_LENGTH, _LARGE_END_LENGTH, _LOCATOR_LENGTH = 22, 56, 20
_LONGEST_END: Final = _LARGE_END_LENGTH + _LOCATOR_LENGTH + _END_LENGTH + (1 << 16) - 1
"""Bytes at the end of a file among which its archive's end is: the last of it is a comment."""
_MOST_DIRECTORY: Final = 4 << 20
"""Bytes of the directory of a results file or a bundle."""
_HEADER_READERS: Final = {(1, 0): "read_array_header_1_0", (2, 0): "read_array_header_2_0"}
DAMAGED_ARCHIVE: Final = (
    OSError,
    ValueError,
    EOFError,
    KeyError,
    MemoryError,
    OverflowError,
    RuntimeError,
    SyntaxError,  # a damaged array header
    NotImplementedError,  # an unknown version
    UnicodeError,
    struct.error,  # a directory of the archive that ends early
    tokenize.TokenError,  # an array header with an open bracket
    zipfile.BadZipFile,
    zlib.error,
)
"""What reading a damaged archive, or an array in it, can raise."""


def open_zip(source: Path | bytes) -> zipfile.ZipFile:
    """The archive in a file or in its bytes, whose directory Python can read without much memory.

    Raises:
        OSError: there is no such regular file, or its directory is too large.
        zipfile.BadZipFile: it is no zip, or does not begin at its first and end at its last byte.
    """
    with io.BytesIO(source) if isinstance(source, bytes) else open_file(source) as file:
        check_end(file, _MOST_DIRECTORY)
    # opened again by its path, so that the archive closes the file
    archive = zipfile.ZipFile(io.BytesIO(source) if isinstance(source, bytes) else source)
    if min([entry.header_offset for entry in archive.infolist()], default=0):
        archive.close()
        raise zipfile.BadZipFile("bytes precede the archive")
    return archive


def read_member(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, kind: FileKind) -> bytes:
    """The content of an archive's member, which agrees with its stored size and its checksum.

    Raises:
        OSError: it would be larger than its kind may be, or the file cannot be read.
        zipfile.BadZipFile: it is encrypted, compressed by another method than deflation, or does not agree.
        zlib.error: it cannot be unpacked.
    """
    for size in (entry.file_size, entry.compress_size):
        check_size(size, kind, shortened(entry.filename))
    if entry.flag_bits & 1 or entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise zipfile.BadZipFile("a member is encrypted or compressed by an unknown method")
    try:
        with archive.open(entry) as file:
            content = file.read(entry.file_size + 1)  # not all that it unpacks to
    except EOFError:
        raise zipfile.BadZipFile("a member ends early") from None
    if len(content) != entry.file_size:
        raise zipfile.BadZipFile(f"a member has {len(content):,} bytes, its stored size is {entry.file_size:,}")
    return content


def read_array(archive: zipfile.ZipFile, name: str, kind: FileKind) -> AnyArray:
    """The array `<name>.npy` of an archive; raises `DAMAGED_ARCHIVE`, a KeyError if it is not there."""
    return array_of(read_member(archive, archive.getinfo(f"{name}.npy"), kind), kind)


def array_of(content: bytes, kind: FileKind) -> AnyArray:
    """The array of numbers or text in the bytes of a `.npy`, which has the size that its header says; writable.

    Raises:
        OSError: it would be larger than its kind may be.
        ValueError: it is damaged, or holds something else.
        Exception: another of `DAMAGED_ARCHIVE`.
    """
    file = io.BytesIO(content)
    version = np.lib.format.read_magic(file)
    if version not in _HEADER_READERS:
        raise ValueError(f"version {version} of its array is unknown")
    shape, fortran, dtype = getattr(np.lib.format, _HEADER_READERS[version])(file)
    if dtype.kind not in "biufcU" or min(shape, default=0) < 0:
        raise ValueError(f"expected numbers or text, found shape {shape} of {shortened(str(dtype))}")
    size, there = math.prod(shape) * dtype.itemsize, len(content) - file.tell()
    check_size(size, kind, "its array")
    if size != there:
        raise ValueError(f"its array has {there:,} bytes, but its shape {shape} of {dtype} needs {size:,}")
    flat: AnyArray = np.frombuffer(content, dtype, offset=file.tell()).copy()
    return flat.reshape(shape[::-1]).T if fortran else flat.reshape(shape)


def check_end(file: BinaryIO, most: int) -> None:
    """Look at the end of an archive before Python reads its directory, which takes some twenty times as much memory.

    Raises:
        RefusedFileError: the directory has more than `most` bytes.
        zipfile.BadZipFile: the file does not end with an archive's end.
    """
    size = file.seek(0, os.SEEK_END)
    start = file.seek(max(0, size - _LONGEST_END))
    tail = file.read(_LONGEST_END)
    end = tail.rfind(_END)
    if end < 0:
        raise zipfile.BadZipFile("not a zip archive" if size else "the file is empty")
    if end + _END_LENGTH + _number(tail, end + 20, 2) != len(tail):
        raise zipfile.BadZipFile("bytes follow the end of the archive")
    directory, large = _number(tail, end + 12, 4), end - _LOCATOR_LENGTH
    if large >= 0 and tail.startswith(_LOCATOR, large):
        record = large - _LARGE_END_LENGTH
        if not tail.startswith(_LARGE_END, max(0, record)) or _number(tail, large + 8, 8) != start + record:
            raise zipfile.BadZipFile("its end is damaged")
        directory = _number(tail, record + 40, 8)
    if directory > most:
        raise RefusedFileError(errno.EFBIG, f"the archive's directory has {directory:,} bytes, more than {most:,}")


def _number(content: bytes, place: int, length: int) -> int:
    return int.from_bytes(content[place : place + length], "little")
