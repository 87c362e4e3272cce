"""Stretches of zero bytes in JPEG files, as a full disk or a broken download leaves them; decoders pass over them."""

import re
from collections.abc import Iterator

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
    for start, stop in _telling_scans(content):
        zeros = content.find(bytes(ZEROS), start, stop)
        if zeros >= 0:
            data = content[zeros:stop]
            return zeros, len(data) - len(data.lstrip(b"\0"))
    return None


def _telling_scans(content: bytes) -> Iterator[tuple[int, int]]:
    """Where the coded data of those scans begin and end in which zero bytes are a fault."""
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
            if sequential and _cannot_be_even(body, first_symbols):
                yield place, stop
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
