"""What decoders pass over in JPEG files: zero bytes, as a full disk leaves them, and data that end early."""

import re
from collections.abc import Iterator
from io import BytesIO
from typing import Any

import numpy as np

from deepaccident_devkit.arrays import ByteArray

ZEROS = 64
"""Zero bytes in a row from which on they are a fault."""
_MARKER_LENGTH = 2
_MARKER = re.compile(rb"\xff+[^\x00\xff]", re.DOTALL)
_SCAN_END = re.compile(rb"\xff+[^\x00\xd0-\xd7\xff]", re.DOTALL)
"""Any marker but the restart markers, which stand inside a scan."""
_SEQUENTIAL = (0xC0, 0xC1)
_HUFFMAN_TABLES, _SCAN, _END = 0xC4, 0xDA, 0xD9
_ALONE = (0x01, 0xD8, *range(0xD0, 0xD8))
"""Markers without a length."""
_END_OF_BLOCK = 0x00
_GREY = (126.0, 130.0)
"""The brightness that decoders give to blocks whose data are missing: 128, and what rounding does to it."""
_SHARES = (0.299, 0.587, 0.114)
"""Of red, green and blue in the brightness."""
_MORE = bytes(range(1, 251)) * 40
"""Data that a decoder of a whole picture does not look at."""


def zero_stretch(content: bytes) -> tuple[int, int] | None:
    """The place and length of a stretch of zero bytes in a JPEG's picture data that no encoder writes.

    Zero bits always stand for the first symbol of each Huffman table, followed by the lowest of its values. If that of
    a table for AC coefficients is not the end of a block, as in the standard table of the grey channel, then zero bits
    are blocks whose coefficients are negative one after the other up to the last. `ZEROS` bytes hold several of them,
    which no picture has. Where a scan's tables begin with the end of a block (those made to fit a flat picture;
    chroma alone), zero bytes are an even surface, and nothing is said; nor of progressive and arithmetic coding.

    Returns:
        Offset and length in bytes; None if there is none, or the file is no sequential JPEG.
    """
    if not content.startswith(b"\xff\xd8"):
        return None
    for start, stop, even in _scans(content):
        zeros = -1 if even else content.find(bytes(ZEROS), start, stop)
        if zeros >= 0:
            data = content[zeros:stop]
            return zeros, len(data) - len(data.lstrip(b"\0"))
    return None


def ends_early(content: bytes, image: ByteArray) -> bool:
    """Whether the coded data of a sequential JPEG end before its picture (H, W, 3) does: the rest of it is grey.

    More data before the end then change the picture, which needs them.
    """
    least, most = _GREY
    if not least < image[-1, -1] @ _SHARES < most:
        return False
    stop = max((stop for _, stop, _ in _scans(content)), default=None)
    return stop is not None and not np.array_equal(_decoded(content[:stop] + _MORE + content[stop:]), image)


def _decoded(content: bytes) -> Any:
    """The picture in a file's bytes; None if it is damaged."""
    from PIL import Image

    try:
        with Image.open(BytesIO(content), formats=("JPEG",)) as image:
            return np.asarray(image.convert("RGB"))
    except (OSError, ValueError, SyntaxError):
        return None


def _scans(content: bytes) -> Iterator[tuple[int, int, bool]]:
    """Where the coded data of each scan of a sequential JPEG begin and end, and whether zero bytes may be in them."""
    first_symbols: dict[int, int] = {}
    sequential, place = False, _MARKER_LENGTH
    while (found := _MARKER.match(content, place)) is not None:
        marker, place = content[found.end() - 1], found.end()
        if marker == _END:
            return
        if marker in _ALONE:
            continue
        body = content[place + 2 : place + int.from_bytes(content[place : place + 2], "big")]
        place += 2 + len(body)
        sequential |= marker in _SEQUENTIAL
        if marker == _HUFFMAN_TABLES:
            first_symbols.update(_first_symbols(body))
        elif marker == _SCAN:
            end = _SCAN_END.search(content, place)
            stop = end.start() if end else len(content)
            if sequential:
                yield place, stop, not _cannot_be_even(body, first_symbols)
            place = stop


def _first_symbols(body: bytes) -> dict[int, int]:
    """Class and number of each table of a DHT segment → its first symbol, whose code is zeros alone."""
    symbols = {}
    place = 0
    while place + 17 < len(body):
        symbols[body[place]] = body[place + 17]
        place += 17 + sum(body[place + 1 : place + 17])
    return symbols


def _cannot_be_even(header: bytes, first_symbols: dict[int, int]) -> bool:
    """Whether some component of a scan has an AC table that does not begin with the end of a block."""
    components = header[0] if header else 0
    tables = [0x10 | (selector & 0x0F) for selector in header[2 : 1 + 2 * components : 2]]
    return any(first_symbols.get(table, _END_OF_BLOCK) != _END_OF_BLOCK for table in tables)
