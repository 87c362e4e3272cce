"""`Camera_*/*.jpg`: the camera images."""

from pathlib import Path

import numpy as np

from deepaccident_devkit.arrays import ByteArray
from deepaccident_devkit.errors import MissingFileError, SensorFileError
from deepaccident_devkit.files import write_bytes
from deepaccident_devkit.release._content import check_regular

JPEG_QUALITY = 90
_REMEDY = "restore the file from its archive"


def read_image(path: Path, *, raw: bool = False) -> ByteArray:
    """An image as (H, W, 3) uint8, RGB.

    Args:
        path: the file.
        raw: return the pixels in the file's own mode, without conversion to RGB: (H, W) for a grey image.

    Raises:
        MissingFileError: there is no such file.
        SensorFileError: it is truncated, no image or no file. (Of a truncated one, OpenCV returns a half-grey
            picture.)
    """
    from PIL import Image

    check_regular(path, SensorFileError, _REMEDY)
    bombs = (Image.DecompressionBombError, Image.DecompressionBombWarning)  # a damaged header names a giant size

    try:
        with Image.open(path) as image:
            return np.array(image if raw else image.convert("RGB"))
    except FileNotFoundError:
        raise MissingFileError(f"{path}: no such file; unpack the archive that holds this camera") from None
    except (OSError, SyntaxError, ValueError, *bombs) as error:
        raise SensorFileError(f"{path}: not a readable image ({error}); {_REMEDY}") from error


def write_image(path: Path, image: ByteArray) -> None:
    """Write an RGB image (H, W, 3) uint8 as JPEG."""
    import cv2

    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or not image.size:
        raise SensorFileError(f"{path}: expected shape (H, W, 3) of uint8, found {image.shape} of {image.dtype}")
    done, encoded = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not done:
        raise SensorFileError(f"{path}: an image of shape {image.shape} cannot be encoded as JPEG")
    write_bytes(path, encoded.tobytes())
