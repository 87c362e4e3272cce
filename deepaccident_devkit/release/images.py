"""Camera images `Camera_*/*.jpg`."""

import math
import re
import struct
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from deepaccident_devkit.errors import MAX_REASON_LENGTH, ConfigError, SensorFileError, shortened
from deepaccident_devkit.release.store import REMEDY, ReleasePath, read_content, real_path
from deepaccident_devkit.support.arrays import ByteArray
from deepaccident_devkit.support.files import write_bytes
from deepaccident_devkit.support.reading import check_size, open_file, reason_text

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
# Decoders of other formats may start programs.
_FORMATS = ("JPEG", "PNG")
_BYTES_PER_PIXEL = 3
# Largest difference between the size of an image and twice the principal point.
_SIZE_TOLERANCE_PX = 1
# Height and width; for the header of an image, width and height.
ImageSize: TypeAlias = tuple[int, int]
# Any marker in a JPEG's data, the marker that starts a scan, and the marker of the end.
_MARKER_PATTERN = re.compile(rb"\xff[^\x00]", re.DOTALL)
_SCAN_MARKER = b"\xff\xda"
_END_MARKER = b"\xff\xd9"


def read_image(
    path: ReleasePath,
    *,
    raw: bool = False,
    min_size: ImageSize | None = None,
    size: ImageSize | None = None,
) -> ByteArray:
    """Read an image as RGB, shape (H, W, 3), uint8.

    Args:
        path: The file.
        raw: Whether to return the pixels in the file's mode, without conversion to RGB: (H, W) for
            a grey image.
        min_size: Smallest acceptable height and width: a JPEG is decoded at 1/2, 1/4 or 1/8 of its
            size (rounded up), which is faster, if the result is at least this large. None decodes
            the full size.
        size: Height and width to which the decoded image is resized with Pillow's bilinear filter;
            None does not resize.

    Raises:
        MissingFileError: If the file does not exist.
        SensorFileError: If the file is truncated, neither JPEG nor PNG, too large, or not a regular
            file. (OpenCV returns a half-grey picture for a truncated file.)
    """
    content = read_image_bytes(path)
    return decode_image(path, content, raw=raw, min_size=min_size, size=size)


def read_image_bytes(path: ReleasePath) -> bytes:
    """Read an image file's bytes.

    MissingFileError is raised if it does not exist, SensorFileError if it is too large or not a
    regular file.
    """
    return read_content(path, "image", SensorFileError)


def decode_image(
    path: ReleasePath,
    content: bytes,
    *,
    raw: bool = False,
    min_size: ImageSize | None = None,
    size: ImageSize | None = None,
) -> ByteArray:
    """Decode the image in a file's bytes, like `read_image`; the path is for error messages."""
    from PIL import Image

    with _open_picture(path, content, _FORMATS) as image:
        full_width = image.width
        draft = None
        if min_size is not None:
            draft = image.draft(None, min_size[::-1])
        if size is None and image.mode == "RGB" and _is_plain_jpeg(content):
            scale = 1
            if draft:
                _, draft_box = draft  # left, top, width and height
                scale = round(full_width / draft_box[2])
            return _decode_jpeg(content, scale)
        image.load()
        picture = image if raw or image.mode == "RGB" else image.convert("RGB")
        if size is not None and picture.size != size[::-1]:
            picture = picture.resize(size[::-1], Image.Resampling.BILINEAR)
        return np.array(picture)


def _is_plain_jpeg(content: bytes) -> bool:
    """Return whether a JPEG has one scan, followed only by the end marker.

    If other files are damaged or truncated, OpenCV raises no error and returns the pixels that it
    could decode.
    """
    scan_start = content.find(_SCAN_MARKER) + len(_SCAN_MARKER)
    marker = _MARKER_PATTERN.search(content, scan_start)
    if marker is None or marker[0] != _END_MARKER:
        return False
    return marker.end() == len(content)


def _decode_jpeg(content: bytes, scale: int) -> ByteArray:
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


def image_size(path: ReleasePath, content: bytes | None = None) -> ImageSize:
    """Return the width and height in an image's header.

    Only the header is read from a file on disk, unless `content` is passed. SensorFileError is
    raised under the same conditions as by `read_image`.
    """
    if content is None and not isinstance(path, Path):
        content = read_image_bytes(path)
    with _open_picture(path, content, _FORMATS) as image:
        return image.width, image.height


def read_jpeg(path: ReleasePath) -> tuple[bytes, ImageSize]:
    """Read a JPEG file's bytes, and the width and height in its header.

    The picture itself is not decoded. The errors are as in `read_image`.
    """
    content = read_image_bytes(path)
    with _open_picture(path, content, _FORMATS[:1]) as image:
        return content, image.size


def calib_fault(size: ImageSize, calib_size: Iterable[float]) -> str | None:
    """Return how the width and height of an image contradict calib; None if they do not."""
    width, height = calib_size
    if np.allclose(size, (width, height), rtol=0, atol=_SIZE_TOLERANCE_PX):
        return None
    return f"is {size[0]}x{size[1]}, but calib is for {width:.0f}x{height:.0f}"


def fitting_size(size: ImageSize | None, image_size: ImageSize) -> ImageSize:
    """Return the width and height of resized images: `size`, or their own size for None.

    Raises:
        ConfigError: If `size` has another aspect ratio than the images, or exceeds their size.
    """
    if size is None:
        return image_size
    fault = aspect_fault(size, image_size)
    if fault is not None:
        raise ConfigError(f"size: {fault}")
    return size


def aspect_fault(size: ImageSize, image_size: ImageSize) -> str | None:
    """Return why images cannot be resized to `size`, with a size that fits; None if they can.

    A size fits if it is not larger than the images and keeps their aspect ratio up to rounding:
    one side is the whole number that is nearest to what the other side requires.

    Args:
        size: Width and height that were asked for, pixels.
        image_size: Width and height of the images, pixels.
    """
    width, height = size
    full_width, full_height = image_size
    is_smaller = 0 < width <= full_width and 0 < height <= full_height
    distortion = abs(height * full_width - width * full_height)
    is_undistorted = 2 * distortion <= max(image_size)
    if is_smaller and is_undistorted:
        return None
    full_steps = math.gcd(full_width, full_height)
    step_width = full_width // full_steps
    step_height = full_height // full_steps
    max_steps = min(width // step_width, height // step_height, full_steps)
    steps = max_steps // 2 * 2 or full_steps  # videos need even sizes
    return (
        f"images of {full_width}x{full_height} cannot become {width}x{height} without being "
        f"enlarged or distorted; choose a multiple of {step_width}x{step_height}, such as "
        f"{steps * step_width}x{steps * step_height}"
    )


def write_image(path: Path, image: ByteArray) -> None:
    """Write an RGB image (H, W, 3) uint8 as JPEG."""
    write_bytes(path, encode_jpeg(path, image))


def encode_jpeg(path: ReleasePath, image: ByteArray, quality: int = JPEG_QUALITY) -> bytes:
    """Encode an RGB image (H, W, 3) uint8 as the bytes of a JPEG file.

    SensorFileError, with the path, is raised if the array has another shape or type.
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
    """Encode a Pillow image as the bytes of a file in the format `form`, such as PNG.

    The options are Pillow's for the format.
    """
    file = BytesIO()
    picture.save(file, form, **options)
    return file.getvalue()


@contextmanager
def _open_picture(
    path: ReleasePath, content: bytes | None, formats: tuple[str, ...]
) -> Iterator[Any]:
    """Open a Pillow image from a file's bytes; if they are None, from the file on disk.

    Every error becomes a SensorFileError, including the error for an image that is too large.
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
            detail = reason_text(error)
        raise SensorFileError(
            f"{path}: not a readable image ({shortened(detail, MAX_REASON_LENGTH)}); {REMEDY}"
        ) from error
