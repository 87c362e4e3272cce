"""What decoders pass over in JPEG files: zero bytes, as a full disk leaves them, and data that end early.

Pillow reports only a file that is cut.
"""

from io import BytesIO
from typing import Any, Final

import numpy as np

from deepaccident_devkit.arrays import ByteArray

ZEROS: Final = 64
"""Zero bytes in a row from which on they are a fault."""
_SCAN, _END = b"\xff\xda", b"\xff\xd9"
"""Markers of a scan's head and of the picture's end; coded data hold neither."""
_USUAL_CODES: Final = bytes.fromhex("100002010303020403050504040000017d")
"""In a JPEG's head: how many codes of each length grey's AC coefficients have; nearly all encoders write just these."""
_GREY = (126.0, 130.0)
"""The brightness that decoders give to blocks whose data are missing: 128, and what rounding does to it."""
_SHARES = (0.299, 0.587, 0.114)
"""Of red, green and blue in the brightness."""
_MORE = bytes(range(1, 251)) * 40
"""Data that a decoder of a whole picture does not look at."""


def zero_stretch(content: bytes) -> tuple[int, int] | None:
    """The place and length of a stretch of zero bytes in a JPEG's picture data that no encoder writes.

    With the usual codes, zero bits are coefficients that are negative one after the other up to a block's last.
    `ZEROS` bytes hold several such blocks, which no picture has. In codes made for one picture they can be an even
    surface, and nothing is said.

    Returns:
        Offset and length in bytes; None if there is none, or the file is no JPEG with the usual codes.
    """
    start, stop = _last_scan(content)
    if content.find(_USUAL_CODES, 0, start) < 0 or (zeros := content.find(bytes(ZEROS), start, stop)) < 0:
        return None
    data = content[zeros:stop]
    return zeros, len(data) - len(data.lstrip(b"\0"))


def ends_early(content: bytes, image: ByteArray) -> bool:
    """Whether the coded data of a JPEG end before its picture (H, W, 3) does: the rest of it is grey.

    More data before the end then change the picture, which needs them.
    """
    least, most = _GREY
    if not least < image[-1, -1] @ _SHARES < most:
        return False
    start, stop = _last_scan(content)
    longer = content[:stop].rstrip(b"\xff") + _MORE + content[stop:]  # a last 0xff would make a marker of what follows
    return start > 0 and not np.array_equal(_decoded(longer), image)


def _last_scan(content: bytes) -> tuple[int, int]:
    """Where the last scan of a JPEG begins, and where its coded data end; zero and the file's end if it has none."""
    start = max(content.rfind(_SCAN), 0)
    stop = content.find(_END, start)
    return start, stop if stop >= 0 else len(content)


def _decoded(content: bytes) -> Any:
    """The picture in a file's bytes; None if it is damaged."""
    from PIL import Image

    try:
        with Image.open(BytesIO(content), formats=("JPEG",)) as image:
            return np.asarray(image.convert("RGB"))
    except (OSError, ValueError, SyntaxError):
        return None
