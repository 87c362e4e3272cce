"""A scenario's file: a head, a table of where each image lies, and the images.

The head is `MAGIC`, then the numbers of rows and cameras as little-endian int64. A row is an agent at a frame. The
table (rows, cameras, 2) of such numbers has each image's first byte in the file and its length, 0 for an image that
the release lacked.
"""

from __future__ import annotations

import mmap
from collections.abc import Iterable
from pathlib import Path
from typing import Final

import numpy as np

from deepaccident_devkit.arrays import IntArray
from deepaccident_devkit.errors import SensorFileError
from deepaccident_devkit.reading import check_size, fault_text, open_file

MAGIC: Final = b"DAimages"
_NUMBER: Final = np.dtype("<i8")
_HEAD: Final = len(MAGIC) + 2 * _NUMBER.itemsize


def file_bytes(rows: int, cameras: int, images: int) -> int:
    """The size of a file with images of so many bytes together."""
    return _HEAD + rows * cameras * 2 * _NUMBER.itemsize + images


def write_images(path: Path, rows: int, cameras: int, images: Iterable[bytes | None]) -> None:
    """Write a file; the images are ordered by row, then camera, None for one that is not there."""
    table = np.zeros((rows, cameras, 2), dtype=_NUMBER)
    with path.open("wb") as file:
        file.write(MAGIC + np.array([rows, cameras], dtype=_NUMBER).tobytes() + table.tobytes())
        for place, content in zip(np.ndindex(rows, cameras), images, strict=True):
            if content is not None:
                table[place] = file.tell(), len(content)
                file.write(content)
        file.seek(_HEAD)
        file.write(table.tobytes())


class ImagesFile:
    """A file, mapped into memory. It is not pickled; who needs it elsewhere opens it there.

    Attributes:
        rows: agents at frames.
    """

    def __init__(self, path: Path, cameras: int) -> None:
        """Map it; raises SensorFileError if it is not there, not whole, or not of so many cameras."""
        try:
            with open_file(path) as file:
                self._bytes = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
            self._table = self._checked_table(cameras)
        except (OSError, ValueError) as error:
            raise SensorFileError(
                f"{path}: {fault_text(error)}; remove the cache of images and make it again"
            ) from error
        self.rows = len(self._table)

    def image(self, row: int, camera: int) -> memoryview | None:
        """The bytes of an image, not copied; None if the release lacked it."""
        start, length = self._table[row, camera].tolist()
        return memoryview(self._bytes)[start : start + length] if length else None

    def has(self, row: int, camera: int) -> bool:
        """Whether an image is in it."""
        return bool(self._table[row, camera, 1])

    def _checked_table(self, wanted: int) -> IntArray:
        """The table; raises ValueError or OSError."""
        numbers = np.frombuffer(self._bytes, dtype=_NUMBER, offset=len(MAGIC), count=2) if self._is_ours() else None
        if numbers is None:
            raise ValueError("is no file of cached images")
        rows, cameras = numbers.tolist()
        if cameras != wanted:
            raise ValueError(f"has {cameras} cameras, and its cache {wanted}")
        check_size(file_bytes(rows, cameras, 0), "bundle", "its table")
        if rows < 0 or file_bytes(rows, cameras, 0) > len(self._bytes):
            raise ValueError("is cut off")
        table = np.frombuffer(self._bytes, dtype=_NUMBER, offset=_HEAD, count=rows * cameras * 2)
        table = table.reshape(rows, cameras, 2)
        if table.size and (
            table.min() < 0 or table.max() > len(self._bytes) or table.sum(axis=2).max() > len(self._bytes)
        ):
            raise ValueError("is cut off")
        check_size(int(table[..., 1].max(initial=0)), "image", "an image")
        return table.astype(np.int64, copy=False)

    def _is_ours(self) -> bool:
        return len(self._bytes) >= _HEAD and self._bytes[: len(MAGIC)] == MAGIC
