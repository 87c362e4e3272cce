"""The one array of an `.npz` file: read without unpickling, written with fixed bytes."""

import io
import zipfile
from pathlib import Path

import numpy as np

from deepaccident_devkit.arrays import AnyArray
from deepaccident_devkit.errors import MissingFileError, SensorFileError
from deepaccident_devkit.files import DAMAGED_ARCHIVE, write_bytes
from deepaccident_devkit.release._content import check_regular

KEY = "data"
_ENDING = ".npy"
_BARE_ARRAY = b"\x93NUMPY"
"""How a `.npy` file begins."""
FAST = 1
"""Level of compression: a BEV array of 4.3 MB takes 10 ms; zlib's default level takes 20 to 30, for a quarter of it."""
_REMEDY = "restore the file from its archive"


def read_npz(path: Path) -> AnyArray:
    """The array under `data`, or the only one in the file.

    Raises:
        MissingFileError: there is no such file.
        SensorFileError: it is no file, empty, truncated, holds several arrays and none of them `data`, or objects.
    """
    check_regular(path, SensorFileError, _REMEDY)
    try:
        with zipfile.ZipFile(path) as archive, archive.open(_array_member(path, archive)) as file:
            array: AnyArray = np.lib.format.read_array(file, allow_pickle=False)
            return array
    except FileNotFoundError:
        raise MissingFileError(f"{path}: no such file; unpack the archive that holds it") from None
    except DAMAGED_ARCHIVE as error:
        if isinstance(error, SensorFileError):
            raise
        raise SensorFileError(f"{path}: {_fault(path, error)}; {_REMEDY}") from error


def write_npz(path: Path, array: AnyArray, *, level: int = FAST) -> None:
    """Write `array` under `data`, compressed by zlib's `level`, 0 to 9; the same array gives the same bytes."""
    member = io.BytesIO()
    np.lib.format.write_array(member, np.ascontiguousarray(array), allow_pickle=False)
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED, compresslevel=level) as file:
        file.writestr(zipfile.ZipInfo(f"{KEY}{_ENDING}"), member.getvalue(), zipfile.ZIP_DEFLATED, level)
    write_bytes(path, archive.getvalue())


def _array_member(path: Path, archive: zipfile.ZipFile) -> str:
    names = [name for name in archive.namelist() if name.endswith(_ENDING)]
    if f"{KEY}{_ENDING}" in names:
        return f"{KEY}{_ENDING}"
    if len(names) != 1:
        found = ", ".join(name.removesuffix(_ENDING) for name in names) or "no array"
        raise SensorFileError(f"{path}: expected an array named '{KEY}', found {found}; {_REMEDY}")
    return names[0]


def _fault(path: Path, error: Exception) -> str:
    try:
        with path.open("rb") as file:
            start = file.read(len(_BARE_ARRAY))
    except OSError:
        return f"not a readable npz archive ({error})"
    if start == _BARE_ARRAY:
        return "expected an npz archive, found a bare array"
    return f"not a readable npz archive ({error if start else 'the file is empty'})"
