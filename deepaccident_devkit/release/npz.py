"""The one array of an `.npz` file: read without unpickling, written with fixed bytes."""

import io
import zipfile
import zlib
from pathlib import Path

import numpy as np

from deepaccident_devkit.arrays import AnyArray
from deepaccident_devkit.errors import MissingFileError, SensorFileError
from deepaccident_devkit.files import write_bytes

KEY = "data"
_REMEDY = "restore the file from its archive"


def read_npz(path: Path) -> AnyArray:
    """The array under `data`, or the only one there is.

    Raises:
        MissingFileError: there is no such file.
        SensorFileError: it is empty, truncated, holds several arrays and none of them `data`, or objects.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:  # noqa: TID251 - this is the reader to call instead
            if not isinstance(archive, np.lib.npyio.NpzFile):
                raise SensorFileError(f"{path}: expected an npz archive, found a bare array; {_REMEDY}")
            return _only_array(path, archive)
    except FileNotFoundError:
        raise MissingFileError(f"{path}: no such file; unpack the archive that holds it") from None
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile, zlib.error) as error:
        if isinstance(error, SensorFileError):
            raise
        size = path.stat().st_size if path.is_file() else 0
        detail = "the file is empty" if size == 0 else str(error)
        raise SensorFileError(f"{path}: not a readable npz archive ({detail}); {_REMEDY}") from error


def write_npz(path: Path, array: AnyArray) -> None:
    """Write `array` under `data`, compressed; the same array gives the same bytes."""
    member = io.BytesIO()
    np.lib.format.write_array(member, np.ascontiguousarray(array), allow_pickle=False)
    archive = io.BytesIO()
    fast = 1  # a BEV array of 4.3 MB takes 10 ms; the default level takes 30 and saves little
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED, compresslevel=fast) as file:
        file.writestr(zipfile.ZipInfo(f"{KEY}.npy"), member.getvalue(), zipfile.ZIP_DEFLATED, fast)
    write_bytes(path, archive.getvalue())


def _only_array(path: Path, archive: "np.lib.npyio.NpzFile") -> AnyArray:
    names = list(archive.files)
    if KEY in names:
        return archive[KEY]
    if len(names) != 1:
        found = ", ".join(names) or "no array"
        raise SensorFileError(f"{path}: expected an array named '{KEY}', found {found}; {_REMEDY}")
    return archive[names[0]]
