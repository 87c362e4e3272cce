"""Zip archives that are read in place: what they hold, and the bytes of one member."""

from __future__ import annotations

import errno
import struct
import zipfile
import zlib
from pathlib import PurePosixPath
from typing import BinaryIO, Final

import numpy as np

from deepaccident_devkit.errors import MOST_TOLD, DatarootError, shortened
from deepaccident_devkit.release.store.members import Listing, Member, is_release_file, release_folder
from deepaccident_devkit.support.reading import (
    DAMAGED_ARCHIVE,
    LIMITS_VARIABLE,
    RefusedFileError,
    check_end,
    fault_text,
    limit_of,
)

HEAD_LENGTH: Final = 30
"""Bytes of a member's head before its name."""
LONGEST_HEAD: Final = HEAD_LENGTH + 512
"""Bytes that are read at once in place of a head's true length: a name, and more fields than any program adds."""
_HEAD: Final = struct.Struct("<4s22xHH")
_SIGNATURE: Final = b"PK\x03\x04"
_ENCRYPTED: Final = 1
_METHODS: Final = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_REMEDY: Final = "fetch the archive again"


def list_zip(file: BinaryIO, archive: str, shown: str, size: int) -> Listing:
    """The files of a release that an archive holds; only its directory is read.

    Args:
        file: the archive.
        archive: its path from the store's place: the folders on it and its name without `.zip` count as folders that
            lead to the members.
        shown: the archive in errors.
        size: its bytes.

    Raises:
        DatarootError: it is no zip, truncated or damaged, or a member is encrypted or compressed by an unknown method.
    """
    try:
        check_end(file, limit_of("archive"))
        with zipfile.ZipFile(file) as opened:
            entries = opened.infolist()
    except RefusedFileError as error:  # by the gate, or by a URL
        sound = f"; if the archive is sound, set {LIMITS_VARIABLE}=archive=4G" if error.errno == errno.EFBIG else ""
        raise DatarootError(f"{shown}: {fault_text(error)}{sound}") from error
    except DAMAGED_ARCHIVE as error:
        told = shortened(fault_text(error), MOST_TOLD)
        raise DatarootError(f"{shown}: not a readable zip archive ({told}); {_REMEDY}") from error
    leading = PurePosixPath(archive).with_suffix("").parts
    folder_of: dict[str, str | None] = {}
    number_of: dict[str, int] = {}
    folder, names, rows = [], [], []
    for entry in entries:
        above, _, name = entry.filename.replace("\\", "/").rpartition("/")  # old tools of Windows write backslashes
        if above not in folder_of:
            folder_of[above] = release_folder((*leading, *PurePosixPath(above).parts))
        found = folder_of[above]
        if found is None or not name or not is_release_file(found, name):
            continue
        _check_entry(entry, shown, size)
        folder.append(number_of.setdefault(found, len(number_of)))
        names.append(name)
        deflated = entry.compress_type == zipfile.ZIP_DEFLATED
        rows.append((entry.header_offset, entry.compress_size, entry.file_size, entry.CRC, deflated))
    columns = zip(*rows, strict=True) if rows else ((),) * 5
    numbers = {name: np.array(column) for name, column in zip(Member._fields[1:], columns, strict=True)}
    return Listing(archive=archive, folders=[*number_of], folder=np.array(folder, int), names=names, numbers=numbers)


def member_bytes(content: bytes, member: Member) -> bytes:
    """The bytes of a member of an archive, from those that are stored; checksums are not compared.

    Raises:
        RefusedFileError: they do not decode to as many bytes as the archive says.
    """
    if member.deflated:
        decoder = zlib.decompressobj(-zlib.MAX_WBITS)
        try:
            content = decoder.decompress(content, member.size + 1)
        except zlib.error as error:
            raise damaged(f"cannot be decompressed ({error})") from error
    if len(content) != member.size:
        raise damaged(f"{len(content):,} bytes in place of {member.size:,}")
    return content


def head_length(head: bytes) -> int:
    """Bytes before a member's content, by the beginning of its head; raises RefusedFileError if there is no head."""
    if len(head) < HEAD_LENGTH:
        raise damaged("the archive ends before it")
    signature, name, extra = _HEAD.unpack_from(head)
    if signature != _SIGNATURE:
        raise damaged("no head at its place")
    return HEAD_LENGTH + int(name) + int(extra)


def damaged(what: str) -> RefusedFileError:
    """The error of a member that cannot be read, whose clause says why."""
    return RefusedFileError(errno.EIO, f"damaged in its archive ({what})")


def _check_entry(entry: zipfile.ZipInfo, shown: str, size: int) -> None:
    """Raise DatarootError if a member cannot be read in place."""
    fault = ""
    if entry.flag_bits & _ENCRYPTED:
        fault = "encrypted; unpack the archive with its password"
    elif entry.compress_type not in _METHODS:
        fault = f"compressed by method {entry.compress_type}; unpack the archive, or pack it again as an ordinary zip"
    elif not 0 <= entry.header_offset <= size - HEAD_LENGTH - entry.compress_size:
        fault = f"said to lie beyond the archive; {_REMEDY}"
    elif entry.compress_type == zipfile.ZIP_STORED and entry.compress_size != entry.file_size:
        fault = f"stored with two sizes; {_REMEDY}"
    if fault:
        raise DatarootError(f"{shown}: its member {shortened(entry.filename)} is {fault}")
