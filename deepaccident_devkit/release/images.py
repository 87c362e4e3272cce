"""`Camera_*/*.jpg`: the camera images."""

import re
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from deepaccident_devkit.errors import MOST_TOLD, SensorFileError, shortened
from deepaccident_devkit.release.store import REMEDY, ReleasePath, read_content, real_path
from deepaccident_devkit.support.arrays import ByteArray
from deepaccident_devkit.support.files import write_bytes
from deepaccident_devkit.support.reading import check_size, fault_text, open_file

JPEG_QUALITY = 90
# What decoding a damaged image can raise.
_DAMAGED = (
    OSError,
    SyntaxError,
    ValueError,
    struct.error,
    EOFError,
    MemoryError,
    OverflowError,
    zlib.error,
)
# Others have decoders that start programs.
_FORMATS = ("JPEG", "PNG")
_BYTES_A_PIXEL = 3
# In the data of a JPEG.
_MARKER = re.compile(rb"\xff[^\x00]", re.DOTALL)


def read_image(
    path: ReleasePath,
    *,
    raw: bool = False,
    least: tuple[int, int] | None = None,
    size: tuple[int, int] | None = None,
) -> ByteArray:
    """An image as (H, W, 3) uint8, RGB.

    Args:
        path: the file.
        raw: return the pixels in the file's own mode, without conversion to RGB: (H, W) for a grey image.
        least: a height and width that suffice: a JPEG is decoded at 1/2, 1/4 or 1/8 of its size (rounded up) if that
            is no smaller, which takes less time. None decodes all of it.
        size: height and width to which what was decoded is resized, by Pillow's bilinear filter; None keeps its own.

    Raises:
        MissingFileError: there is no such file.
        SensorFileError: it is truncated, neither JPEG nor PNG, too large, or no file. (Of a truncated one, OpenCV
            returns a half-grey picture.)
    """
    return decode_image(path, read_image_bytes(path), raw=raw, least=least, size=size)


def read_image_bytes(path: ReleasePath) -> bytes:
    """An image file's bytes; raises MissingFileError, and SensorFileError if it is no file or too large."""
    return read_content(path, "image", SensorFileError)


def decode_image(
    path: ReleasePath,
    content: bytes,
    *,
    raw: bool = False,
    least: tuple[int, int] | None = None,
    size: tuple[int, int] | None = None,
) -> ByteArray:
    """The image in the bytes of a file, which errors name; as `read_image` returns it."""
    from PIL import Image

    with _opened(path, content, _FORMATS) as image:
        whole, drafted = image.width, None if least is None else image.draft(None, least[::-1])
        if size is None and image.mode == "RGB" and _is_plain_jpeg(content):
            return _decoded_jpeg(content, round(whole / drafted[1][2]) if drafted else 1)
        image.load()
        picture = image if raw or image.mode == "RGB" else image.convert("RGB")
        if size is not None and picture.size != size[::-1]:
            picture = picture.resize(size[::-1], Image.Resampling.BILINEAR)
        return np.array(picture)


def _is_plain_jpeg(content: bytes) -> bool:
    """Whether it is a JPEG whose only marker after the first start of a scan is its end.

    Of others, damaged or cut off, OpenCV returns what it could decode, and raises nothing.
    """
    marker = _MARKER.search(content, content.find(b"\xff\xda") + 2)
    return marker is not None and marker[0] == b"\xff\xd9" and marker.end() == len(content)


def _decoded_jpeg(content: bytes, scale: int) -> ByteArray:
    """A plain JPEG of three channels at 1/1, 1/2, 1/4 or 1/8: Pillow's pixels, which need no copies here."""
    import cv2

    rgb = getattr(cv2, "IMREAD_COLOR_RGB", 0)  # since OpenCV 4.11
    flags = (
        cv2.IMREAD_IGNORE_ORIENTATION
        | (rgb or cv2.IMREAD_COLOR)
        | scale // 2 * cv2.IMREAD_REDUCED_GRAYSCALE_2
    )
    pixels: Any = cv2.imdecode(np.frombuffer(content, dtype=np.uint8), flags)
    if pixels is None:
        raise ValueError("its picture cannot be decoded")
    return np.asarray(pixels if rgb else cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def image_size(path: ReleasePath, content: bytes | None = None) -> tuple[int, int]:
    """Width and height that an image's head says, of its bytes if they are known; a real file is read no further.

    Raises SensorFileError, as `read_image` does.
    """
    if content is None and not isinstance(path, Path):
        content = read_image_bytes(path)
    with _opened(path, content, _FORMATS) as image:
        return image.width, image.height


def read_jpeg(path: ReleasePath) -> tuple[bytes, tuple[int, int]]:
    """A JPEG file's bytes, and the width and height that its head says; the picture itself is not decoded.

    Raises as `read_image` does.
    """
    content = read_image_bytes(path)
    with _opened(path, content, _FORMATS[:1]) as image:
        return content, image.size


def write_image(path: Path, image: ByteArray) -> None:
    """Write an RGB image (H, W, 3) uint8 as JPEG."""
    write_bytes(path, encode_jpeg(path, image))


def encode_jpeg(path: ReleasePath, image: ByteArray, quality: int = JPEG_QUALITY) -> bytes:
    """An RGB image (H, W, 3) uint8 as the bytes of a JPEG file, which errors name; raises SensorFileError."""
    import cv2

    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or not image.size:
        raise SensorFileError(
            f"{path}: expected shape (H, W, 3) of uint8, found {image.shape} of {image.dtype}"
        )
    done, encoded = cv2.imencode(
        ".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality]
    )
    if not done:
        raise SensorFileError(f"{path}: an image of shape {image.shape} cannot be encoded as JPEG")
    return bytes(encoded.tobytes())


def picture_bytes(picture: Any, form: str, **how: Any) -> bytes:
    """A Pillow image as the bytes of a file of a format, such as PNG; `how` are Pillow's options of that format."""
    written = BytesIO()
    picture.save(written, form, **how)
    return written.getvalue()


@contextmanager
def _opened(path: ReleasePath, content: bytes | None, formats: tuple[str, ...]) -> Iterator[Any]:
    """Pillow's image of a file's bytes (None: a real file's), not too large; what it raises becomes SensorFileError."""
    from PIL import Image, UnidentifiedImageError

    bombs = (Image.DecompressionBombError, Image.DecompressionBombWarning)
    try:
        file = open_file(real_path(path)) if content is None else BytesIO(content)
        with file, Image.open(file, formats=formats) as image:
            check_size(_BYTES_A_PIXEL * image.width * image.height, "image", "its picture")
            yield image
    except (*_DAMAGED, *bombs) as error:
        known = not isinstance(error, UnidentifiedImageError)
        detail = fault_text(error) if known else f"expected {' or '.join(formats)}"
        raise SensorFileError(
            f"{path}: not a readable image ({shortened(detail, MOST_TOLD)}); {REMEDY}"
        ) from error
