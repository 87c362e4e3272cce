"""Camera images `Camera_*/*.jpg`."""

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
# Errors that decoding a damaged image can raise.
_DECODING_ERRORS = (
    OSError,
    SyntaxError,
    ValueError,
    struct.error,
    EOFError,
    MemoryError,
    OverflowError,
    zlib.error,
)
# Other formats have decoders that start programs.
_FORMATS = ("JPEG", "PNG")
_BYTES_PER_PIXEL = 3
# Marker in the data of a JPEG.
_MARKER_PATTERN = re.compile(rb"\xff[^\x00]", re.DOTALL)


def read_image(
    path: ReleasePath,
    *,
    raw: bool = False,
    min_size: tuple[int, int] | None = None,
    size: tuple[int, int] | None = None,
) -> ByteArray:
    """Read an image as RGB, shape (H, W, 3), uint8.

    Args:
        path: The file.
        raw: Whether to return the pixels in the file's own mode, without conversion to RGB: (H, W)
            for a grey image.
        min_size: Height and width that suffice: a JPEG is decoded at 1/2, 1/4 or 1/8 of its size
            (rounded up) if that is no smaller, which takes less time. None decodes the full size.
        size: Height and width to which the decoded image is resized, by Pillow's bilinear filter;
            None for no change.

    Raises:
        MissingFileError: There is no such file.
        SensorFileError: The file is truncated, neither JPEG nor PNG, too large, or no file. (OpenCV
            returns a half-grey picture for a truncated file.)
    """
    return decode_image(path, read_image_bytes(path), raw=raw, min_size=min_size, size=size)


def read_image_bytes(path: ReleasePath) -> bytes:
    """Read an image file's bytes.

    Raises MissingFileError, and SensorFileError if it is no file or too large.
    """
    return read_content(path, "image", SensorFileError)


def decode_image(
    path: ReleasePath,
    content: bytes,
    *,
    raw: bool = False,
    min_size: tuple[int, int] | None = None,
    size: tuple[int, int] | None = None,
) -> ByteArray:
    """Decode the image in the bytes of a file, as `read_image` does; the path is for errors."""
    from PIL import Image

    with _opened(path, content, _FORMATS) as image:
        full_width = image.width
        draft = None if min_size is None else image.draft(None, min_size[::-1])
        if size is None and image.mode == "RGB" and _is_plain_jpeg(content):
            return _decoded_jpeg(content, round(full_width / draft[1][2]) if draft else 1)
        image.load()
        picture = image if raw or image.mode == "RGB" else image.convert("RGB")
        if size is not None and picture.size != size[::-1]:
            picture = picture.resize(size[::-1], Image.Resampling.BILINEAR)
        return np.array(picture)


def _is_plain_jpeg(content: bytes) -> bool:
    """Return whether the only marker of a JPEG after the first start of a scan is its end.

    For other files, damaged or truncated, OpenCV returns the pixels that it could decode, and
    raises nothing.
    """
    marker = _MARKER_PATTERN.search(content, content.find(b"\xff\xda") + 2)
    return marker is not None and marker[0] == b"\xff\xd9" and marker.end() == len(content)


def _decoded_jpeg(content: bytes, scale: int) -> ByteArray:
    """Decode a plain JPEG of three channels at 1/1, 1/2, 1/4 or 1/8 of its size.

    The pixels equal Pillow's, without its copies.
    """
    import cv2

    rgb_flag = getattr(cv2, "IMREAD_COLOR_RGB", 0)  # since OpenCV 4.11
    scale_flag = scale // 2 * cv2.IMREAD_REDUCED_GRAYSCALE_2
    flags = cv2.IMREAD_IGNORE_ORIENTATION | (rgb_flag or cv2.IMREAD_COLOR) | scale_flag
    pixels: Any = cv2.imdecode(np.frombuffer(content, dtype=np.uint8), flags)
    if pixels is None:
        raise ValueError("its picture cannot be decoded")
    if not rgb_flag:
        pixels = cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB)
    return np.asarray(pixels, dtype=np.uint8)


def image_size(path: ReleasePath, content: bytes | None = None) -> tuple[int, int]:
    """Return the width and height in an image's head.

    Only the head of a real file is read, unless its bytes are known. Raises SensorFileError, as
    `read_image` does.
    """
    if content is None and not isinstance(path, Path):
        content = read_image_bytes(path)
    with _opened(path, content, _FORMATS) as image:
        return image.width, image.height


def read_jpeg(path: ReleasePath) -> tuple[bytes, tuple[int, int]]:
    """Return a JPEG file's bytes, and the width and height in its head.

    The picture itself is not decoded. Raises as `read_image` does.
    """
    content = read_image_bytes(path)
    with _opened(path, content, _FORMATS[:1]) as image:
        return content, image.size


def write_image(path: Path, image: ByteArray) -> None:
    """Write an RGB image (H, W, 3) uint8 as JPEG."""
    write_bytes(path, encode_jpeg(path, image))


def encode_jpeg(path: ReleasePath, image: ByteArray, quality: int = JPEG_QUALITY) -> bytes:
    """Return an RGB image (H, W, 3) uint8 as the bytes of a JPEG file.

    The path is for errors. Raises SensorFileError.
    """
    import cv2

    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or not image.size:
        raise SensorFileError(
            f"{path}: expected shape (H, W, 3) of uint8, found {image.shape} of {image.dtype}"
        )
    bgr_image = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    succeeded, encoded = cv2.imencode(".jpg", bgr_image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not succeeded:
        raise SensorFileError(f"{path}: an image of shape {image.shape} cannot be encoded as JPEG")
    return bytes(encoded.tobytes())


def picture_bytes(picture: Any, form: str, **options: Any) -> bytes:
    """Return a Pillow image as the bytes of a file of a format, such as PNG.

    The options are Pillow's for that format.
    """
    file = BytesIO()
    picture.save(file, form, **options)
    return file.getvalue()


@contextmanager
def _opened(path: ReleasePath, content: bytes | None, formats: tuple[str, ...]) -> Iterator[Any]:
    """Open a Pillow image of a file's bytes, or of a real file if they are None.

    Errors become SensorFileError, also for an image that is too large.
    """
    from PIL import Image, UnidentifiedImageError

    size_errors = (Image.DecompressionBombError, Image.DecompressionBombWarning)
    try:
        file = open_file(real_path(path)) if content is None else BytesIO(content)
        with file, Image.open(file, formats=formats) as image:
            check_size(_BYTES_PER_PIXEL * image.width * image.height, "image", "its picture")
            yield image
    except (*_DECODING_ERRORS, *size_errors) as error:
        if isinstance(error, UnidentifiedImageError):
            detail = f"expected {' or '.join(formats)}"
        else:
            detail = fault_text(error)
        raise SensorFileError(
            f"{path}: not a readable image ({shortened(detail, MOST_TOLD)}); {REMEDY}"
        ) from error
