"""The one array of an `.npz` file: read without unpickling, written with fixed bytes."""

import io
import zipfile
from pathlib import Path

import numpy as np

from deepaccident_devkit.archives import DAMAGED_ARCHIVE, array_of, open_zip, read_member
from deepaccident_devkit.arrays import AnyArray
from deepaccident_devkit.errors import SensorFileError
from deepaccident_devkit.files import write_bytes
from deepaccident_devkit.reading import MOST_TOLD, FileKind, fault_text, shortened
from deepaccident_devkit.release._content import REMEDY, read_content
from deepaccident_devkit.release.store import ReleasePath

KEY = "data"
_ENDING = ".npy"
_BARE_ARRAY = b"\x93NUMPY"
"""How a `.npy` file begins."""
FAST = 1
"""Level of compression: a BEV array of 4.3 MB takes 10 ms; zlib's default level takes 20 to 30, for a quarter of it."""


def read_npz(path: ReleasePath, kind: FileKind) -> AnyArray:
    """The array under `data`, or the only one in the file, of numbers.

    Raises:
        MissingFileError: there is no such file.
        SensorFileError: it is no file, empty, truncated, too large for its kind, disagrees with its sizes or checksum,
            holds several arrays and none of them `data`, or objects.
    """
    content = read_content(path, kind, SensorFileError)
    try:
        with open_zip(content) as archive:
            return array_of(read_member(archive, _array_member(path, archive), kind), kind)
    except DAMAGED_ARCHIVE as error:
        if isinstance(error, SensorFileError):
            raise
        detail = "expected an npz archive, found a bare array" if content.startswith(_BARE_ARRAY) else ""
        detail = detail or f"not a readable npz archive ({shortened(fault_text(error), MOST_TOLD)})"
        raise SensorFileError(f"{path}: {detail}; {REMEDY}") from error


def write_npz(path: Path, array: AnyArray, *, level: int = FAST) -> None:
    """Write `array` under `data`, compressed by zlib's `level`, 0 to 9; the same array gives the same bytes."""
    member = io.BytesIO()
    np.lib.format.write_array(member, np.ascontiguousarray(array), allow_pickle=False)
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED, compresslevel=level) as file:
        file.writestr(zipfile.ZipInfo(f"{KEY}{_ENDING}"), member.getvalue(), zipfile.ZIP_DEFLATED, level)
    write_bytes(path, archive.getvalue())


def _array_member(path: ReleasePath, archive: zipfile.ZipFile) -> zipfile.ZipInfo:
    entries = [entry for entry in archive.infolist() if entry.filename.endswith(_ENDING)]
    named = [entry for entry in entries if entry.filename == f"{KEY}{_ENDING}"] or entries
    if len(named) != 1:
        found = ", ".join(entry.filename.removesuffix(_ENDING) for entry in entries) or "no array"
        raise SensorFileError(f"{path}: expected an array named '{KEY}', found {shortened(found)}; {REMEDY}")
    return named[0]
