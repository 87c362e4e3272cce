"""Arrays in a shard, the members `<token>/<name>.npy` of a zip archive: never unpickled, nor larger than expected."""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Sequence
from typing import IO, Final

import numpy as np

from deepaccident_devkit.arrays import AnyArray
from deepaccident_devkit.evaluation.results.faults import ContentError, at
from deepaccident_devkit.files import DAMAGED_ARCHIVE

Length = int | range
"""Of an axis: how long it must be, or may be."""
_FIRST_DATE: Final = (1980, 1, 1, 0, 0, 0)


def member_name(token: str, name: str) -> str:
    """What a sample's array is called in the archive."""
    return f"{token}/{name}.npy"


def put_array(archive: zipfile.ZipFile, token: str, name: str, array: AnyArray) -> None:
    """Add an array to an archive; the same bytes whenever that is."""
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, np.ascontiguousarray(array), version=(1, 0), allow_pickle=False)
    entry = zipfile.ZipInfo(member_name(token, name), _FIRST_DATE)
    entry.external_attr = 0o644 << 16
    maps_of_floats = array.dtype.kind == "f" and array.ndim > 3  # noise: deflating takes a second and saves nothing
    way = zipfile.ZIP_STORED if maps_of_floats else zipfile.ZIP_DEFLATED
    archive.writestr(entry, buffer.getvalue(), way, compresslevel=6)


def take_array(archive: zipfile.ZipFile, token: str, name: str, shape: Sequence[Length], kinds: str) -> AnyArray:
    """An array of an archive.

    Args:
        archive: open.
        token: of the sample.
        name: of the array.
        shape: what it must have; checked before anything but the header is decompressed.
        kinds: numpy's letters of the kinds of element types that it may have.

    Raises:
        ContentError: begins with the array's name and says what is wrong with it.
    """
    with at(name):
        try:
            entry = archive.getinfo(member_name(token, name))
        except KeyError:
            raise ContentError(f"is missing; expected the member {member_name(token, name)}") from None
        try:
            with archive.open(entry) as file:
                return _array(file, entry.file_size, shape, kinds)
        except ContentError:
            raise
        except DAMAGED_ARCHIVE as error:
            raise ContentError(f"cannot be read ({error}); the file is damaged, copy it again") from error


def _array(file: IO[bytes], size: int, shape: Sequence[Length], kinds: str) -> AnyArray:
    version = np.lib.format.read_magic(file)
    if version != (1, 0):
        raise ContentError(f"expected npy format 1.0, as numpy.save writes numbers, found {version}")
    found, by_columns, dtype = np.lib.format.read_array_header_1_0(file)
    if dtype.hasobject:
        raise ContentError("holds Python objects, a pickle; store numbers")
    if dtype.kind not in kinds:
        expected = " or ".join(_KINDS[kind] for kind in kinds)
        raise ContentError(f"expected {expected}, found {dtype}")
    if len(found) != len(shape) or any(have not in _range(want) for want, have in zip(shape, found, strict=True)):
        raise ContentError(f"expected shape {_shape_text(shape)}, found {found}")
    length = math.prod(found) * dtype.itemsize
    if size - file.tell() != length:
        raise ContentError(f"expected {length} bytes of numbers, found {size - file.tell()}")
    content = file.read(length)
    if len(content) != length:
        raise ContentError(f"expected {length} bytes of numbers, found only {len(content)}")
    flat: AnyArray = np.frombuffer(content, dtype)
    return flat.reshape(found[::-1]).T if by_columns else flat.reshape(found)


_KINDS: Final = {"u": "unsigned whole numbers", "i": "whole numbers", "f": "floats"}


def _range(length: Length) -> range:
    return range(length, length + 1) if isinstance(length, int) else length


def _shape_text(shape: Sequence[Length]) -> str:
    texts = [str(each) if isinstance(each, int) else f"{each.start} to {each.stop - 1}" for each in shape]
    return f"({', '.join(texts)})" if len(texts) > 1 else f"({texts[0]},)"
