"""Camera images for models: resized, cropped and scaled, with matching intrinsics."""

import math
import operator
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate
from math import gcd
from typing import Any, Literal, NamedTuple, SupportsIndex, get_args

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ConfigError, GeometryError
from deepaccident_devkit.geometry import PinholeCamera
from deepaccident_devkit.support.arrays import AnyArray, BoolArray, ByteArray, FloatArray, checked
from deepaccident_devkit.support.text import choices, settle_choices
from deepaccident_devkit.taxonomy import CAMERAS

ImageDtype = Literal["float32", "uint8"]
Decoding = Literal["full", "scaled"]
_NO_MEAN = (0.0, 0.0, 0.0)
_NO_STD = (1.0, 1.0, 1.0)


class VirtualCamera(NamedTuple):
    """A pinhole camera with the pose of a real one, to compare images of two sensor setups.

    The image is scaled to this focal length, which is rounded so that the scaled size is in whole
    pixels. The image is then shifted by whole pixels until the principal point is in the middle.
    Areas that the real camera did not see are black. K is therefore exact, but differs slightly
    from the requested one.

    Attributes:
        focal: Focal length in pixels.
        height: Height of the image in pixels.
        width: Width of the image in pixels.
    """

    focal: float
    height: int
    width: int

    def capture(
        self, image: ByteArray, lens: PinholeCamera, decode: Decoding
    ) -> tuple[ByteArray, FloatArray]:
        """Return the image of this camera, shape (height, width, 3), and its K.

        Args:
            image: The full image of the real camera.
            lens: The real camera.
            decode: Filter that resizes the image.
        """
        scaled_height = max(round(lens.height * self.focal / lens.intrinsic[1, 1]), 1)
        scaled_width = max(round(lens.width * self.focal / lens.intrinsic[0, 0]), 1)
        intrinsic = lens.resized(scaled_width, scaled_height).intrinsic.copy()
        corner = np.rint(intrinsic[:2, 2] - (self.width / 2, self.height / 2))
        left, top = corner.astype(int).tolist()
        intrinsic[:2, 2] -= (left, top)
        result = np.zeros((3, self.height, self.width), dtype=np.uint8).transpose(1, 2, 0)
        first_row = max(top, 0)
        first_column = max(left, 0)
        num_rows = min(top + self.height, scaled_height) - first_row
        num_columns = min(left + self.width, scaled_width) - first_column
        if num_rows > 0 and num_columns > 0:
            size = (scaled_height, scaled_width)
            crop = (first_row, first_column, num_rows, num_columns)
            target = result[first_row - top :, first_column - left :]
            target[:num_rows, :num_columns] = resized_part(image, size, crop, decode)
        return result, intrinsic


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageConfig:
    """Preparation of images; raises ConfigError on creation if a field is impossible.

    Attributes:
        resize: Height and width to which the full image is resized; None for the stored size.
        crop: Top, left, height and width of the retained part, in pixels of the resized image; None
            for all of it.
        dtype: Type of the values: `float32` in [0, 1], or `uint8` as decoded.
        mean: Values that are subtracted from the channels R, G, B in [0, 1]; only for `float32`.
        std: Values by which the channels are then divided; only for `float32`.
        cameras: Cameras, in this order.
        decode: Way to resize images: `full`, or `scaled` in two thirds of the time, with slightly
            different pixels (docs/training.md). `full` decodes full images and resizes like
            Pillow's bilinear filter; `scaled` decodes JPEG at the smallest of 1/1, 1/2, 1/4 and 1/8
            that is no smaller than `resize` and resizes like OpenCV's area filter. A pixel differs
            by at most 1 of 255 from these libraries, except where `scaled` shrinks one axis and
            enlarges the other, for which OpenCV has another filter.
        virtual_camera: Pinhole camera by which all images seem to be taken, instead of `resize` and
            `crop`.
    """

    resize: tuple[int, int] | None = None
    crop: tuple[int, int, int, int] | None = None
    dtype: ImageDtype = "float32"
    mean: tuple[float, float, float] = _NO_MEAN
    std: tuple[float, float, float] = _NO_STD
    cameras: tuple[str, ...] = CAMERAS
    decode: Decoding = "full"
    virtual_camera: VirtualCamera | None = None

    def __post_init__(self) -> None:
        """Check every field, and convert sequences to tuples."""
        if self.resize is not None:
            self._set("resize", check_pixels("resize", self.resize, "height and width", (1, 1)))
        if self.crop is not None:
            crop = check_pixels("crop", self.crop, "top, left, height and width", (0, 0, 1, 1))
            self._set("crop", crop)
            if self.resize is not None:
                _check_crop(self.crop, self.resize)
        allowed = {"dtype": get_args(ImageDtype), "decode": get_args(Decoding)}
        settle_choices(self, allowed, error=ConfigError)
        for name in ("mean", "std"):
            self._set(name, _check_channels(name, getattr(self, name)))
        if min(self.std) <= 0:
            raise ConfigError(f"std: expected numbers above 0, found {self.std}")
        if self.dtype == "uint8" and (self.mean, self.std) != (_NO_MEAN, _NO_STD):
            raise ConfigError(
                "mean and std: uint8 images are not scaled; choose dtype='float32', or "
                "remove mean and std"
            )
        cameras = choices("cameras", self.cameras, CAMERAS, error=ConfigError)
        if len(set(cameras)) != len(cameras):
            raise ConfigError(f"cameras: expected each camera once, found {self.cameras!r}")
        self._set("cameras", cameras)
        if self.virtual_camera is not None:
            focal, *size = self.virtual_camera
            height, width = check_pixels("virtual_camera", size, "height and width", (1, 1))
            self._set("virtual_camera", VirtualCamera(focal, height, width))
            has_other_size = (self.resize, self.crop) != (None, None)
            if not 0 < focal < math.inf or has_other_size:
                raise ConfigError(
                    "virtual_camera: expected a focal length above 0, and no resize or crop "
                    "together with it"
                )

    def _set(self, name: str, value: object) -> None:
        object.__setattr__(self, name, value)

    def load(self, dataset: Dataset, camera: RowArgument) -> tuple[ByteArray, FloatArray]:
        """Return an image (h, w, 3) uint8 RGB, resized and cropped, and its intrinsic (3, 3).

        Pixel centres are at 0.5, 1.5, …, as everywhere in the devkit: a point at (u, v) of the
        full image is at (u · width' / width − left, v · height' / height − top).

        Raises:
            TokenError: If there is no such image.
            MissingFileError: If the image was not downloaded.
            SensorFileError: If the image cannot be read.
            ConfigError: If the crop reaches beyond the image.
        """
        lens = dataset.camera(camera)
        if self.virtual_camera is not None:
            image = dataset.load_image(camera)
            image_lens = lens.resized(image.shape[1], image.shape[0])
            return self.virtual_camera.capture(image, image_lens, self.decode)
        if self.resize is not None:
            min_size = self.resize if self.decode == "scaled" else None
            image = dataset.load_image(camera, min_size=min_size)
            resized = resized_part(image, self.resize, self.crop, self.decode)
            return resized, self.intrinsic(lens, self.resize)
        image = dataset.load_image(camera)
        height, width = image.shape[:2]
        return self.cropped(image), self.intrinsic(lens, (height, width))

    def cropped(self, image: ByteArray) -> ByteArray:
        """Return the retained part of a resized image (h, w, 3), as a view.

        Raises ConfigError if it reaches beyond the image.
        """
        if self.crop is None:
            return image
        _check_crop(self.crop, (image.shape[0], image.shape[1]))
        top, left, height, width = self.crop
        return image[top : top + height, left : left + width]

    def intrinsic(self, lens: PinholeCamera, size: tuple[int, int]) -> FloatArray:
        """Return the intrinsic (3, 3) of a camera's image after resizing and cropping.

        Args:
            lens: The camera.
            size: Height and width of the resized image, before cropping.
        """
        height, width = size
        intrinsic: FloatArray = lens.resized(width, height).intrinsic.copy()
        if self.crop is not None:
            top, left, _, _ = self.crop
            intrinsic[:2, 2] -= (left, top)
        return intrinsic

    def values(self, images: ByteArray, known: BoolArray) -> AnyArray:
        """Convert images (A, P, C, 3, h, w) uint8 to an array of `dtype`.

        The values are 0 where `known` (A, P) is False.
        """
        if self.dtype == "uint8":
            return images
        make_array = np.empty if known.all() else np.zeros
        result = make_array(images.shape, dtype=np.float32)
        mean = np.array(self.mean, dtype=np.float32)[:, None, None]
        std = np.array(self.std, dtype=np.float32)[:, None, None]
        scale = np.float32(1) / (np.float32(255) * std)
        shift = mean / std
        for agent, moment in np.argwhere(known).tolist():
            # Images are converted one by one, because a single one fits into the processor's cache.
            for image, target in zip(images[agent, moment], result[agent, moment], strict=True):
                np.copyto(target, image)
                np.multiply(target, scale, out=target)
                np.subtract(target, shift, out=target)
        return result


def resized_part(
    image: ByteArray,
    size: tuple[int, int],
    crop: tuple[int, int, int, int] | None,
    decode: Decoding,
) -> ByteArray:
    """Resize an image (H, W, 3) to `size`, and return only a part of the result.

    Args:
        image: The full image.
        size: Height and width to which the full image would be resized; little more than the part
            is computed.
        crop: Top, left, height and width of the part; None for all.
        decode: Name of the filter. With `full`, weights fall linearly with the distance, over two
            pixels of the smaller of both images in each direction, like Pillow's bilinear filter.
            With `scaled`, they are the areas by which pixels overlap, like OpenCV's area filter.

    Returns:
        Image (height, width, 3), the view of an array (3, height, width); see `ImageConfig.decode`.
    """
    import cv2

    top, left, height, width = crop or (0, 0, *size)
    row_range = range(top, top + height)
    column_range = range(left, left + width)
    rows = _resample(image.reshape(len(image), -1), size[0], row_range, decode)
    turned: Any = cv2.transpose(rows.reshape(height, -1, 3))
    columns = _resample(turned.reshape(-1, 3 * height), size[1], column_range, decode)
    channels = cv2.split(columns.reshape(width, height, 3))
    upright_channels = [cv2.transpose(channel) for channel in channels]
    return np.stack(upright_channels, dtype=np.uint8).transpose(1, 2, 0)


def _resample(rows: ByteArray, new: int, part: range, decode: Decoding) -> ByteArray:
    """Resize rows, and return only a part of the new ones.

    New rows are running means of old rows; many of them are computed at once.

    Args:
        rows: The old rows, shape (old, n).
        new: Number of rows to which the old ones are resized.
        part: Numbers of the new rows to return.
        decode: Name of the filter.
    """
    import cv2

    if len(rows) == new:
        return rows[part.start : part.stop]
    result = np.empty((len(part), rows.shape[1]), dtype=np.uint8)
    groups = _group_rows(len(rows), new, part, decode)
    largest_size = max(len(new_rows) for new_rows, _ in groups)
    means = np.zeros((largest_size, rows.shape[1]), dtype=np.float32)
    for new_rows, old_rows in groups:
        start = new_rows.start - part.start
        stop = new_rows.stop - part.start
        target = result[start : stop : new_rows.step]
        if len(old_rows) == 2:
            (first, total), (second, share) = old_rows
            cv2.addWeighted(rows[first], total - share, rows[second], share, 0, target)
        else:
            mean = means[: len(new_rows)]
            for old_row, share in old_rows:
                cv2.accumulateWeighted(rows[old_row], mean, share)
            cv2.convertScaleAbs(mean, target)
    return result


@lru_cache
def _group_rows(
    old: int, new: int, part: range, decode: Decoding
) -> list[tuple[range, list[tuple[slice, float]]]]:
    """Group the `new` rows that are the same means of the `old` rows near them.

    Returns:
        (new rows, list of steps) for each group. The new rows of a group have the same position
        relative to the old rows. Each step is a slice of the old rows, one old row for each new
        row, and its share in the mean of all steps so far. Positions are counted in units of
        1 / (2 `new`) of an old row, so that they are whole numbers.
    """
    reach = 2 * max(old, new) if decode == "full" else old
    divisor = gcd(old, new)
    step = new // divisor
    stride = old // divisor
    # Number of rows at each end that reach beyond the old ones.
    num_edge_rows = -((old - reach) // (2 * old))
    inner_rows = range(max(part.start, num_edge_rows), min(part.stop, new - num_edge_rows))
    row_groups = [range(row, row + 1) for row in part if row not in inner_rows]
    row_groups += [inner_rows[start::step] for start in range(step) if inner_rows[start:]]
    groups = []
    for new_rows in row_groups:
        centre = (2 * new_rows[0] + 1) * old
        start = max((centre - reach) // (2 * new), 0)
        stop = min(-((-centre - reach) // (2 * new)), old)
        old_rows = range(start, stop)
        overlaps = [reach - abs((2 * row + 1) * new - centre) for row in old_rows]
        if decode == "full":
            weights = [max(overlap, 0) for overlap in overlaps]
        else:
            weights = [min(overlap + new, 2 * min(old, new)) for overlap in overlaps]
        length = stride * (len(new_rows) - 1) + 1
        shares = []
        for row, weight, total in zip(old_rows, weights, accumulate(weights), strict=True):
            if weight:
                shares.append((slice(row, row + length, stride), weight / total))
        groups.append((new_rows, shares))
    return groups


def check_pixels(
    name: str, values: Iterable[SupportsIndex], meaning: str, minima: Sequence[int]
) -> tuple[int, ...]:
    """Return values as whole numbers of pixels.

    Args:
        name: Name of the argument, for the error.
        values: Numbers of pixels.
        meaning: Words for the numbers, such as `width and height`.
        minima: Smallest possible value of each number.

    Raises:
        ConfigError: If one is not a whole number, or is below its minimum.
    """
    try:
        numbers = tuple(map(operator.index, values))
    except TypeError:
        numbers = ()
    is_valid = len(numbers) == len(minima) and all(map(operator.ge, numbers, minima))
    if not is_valid:
        raise ConfigError(f"{name}: expected {meaning} in pixels, found {values!r}")
    return numbers


def _check_channels(name: str, values: ArrayLike) -> tuple[float, ...]:
    try:
        numbers = checked(name, values, (3,))
    except GeometryError:
        numbers = np.full(3, np.nan)
    if not np.isfinite(numbers).all():
        raise ConfigError(f"{name}: expected a number for each of R, G and B, found {values!r}")
    return tuple(numbers.tolist())


def _check_crop(crop: tuple[int, int, int, int], size: tuple[int, int]) -> None:
    top, left, height, width = crop
    if top + height > size[0] or left + width > size[1]:
        raise ConfigError(
            f"crop: rows {top} to {top + height} and columns {left} to {left + width} reach "
            f"beyond an image of {size[0]} × {size[1]} (height × width); choose a smaller part"
        )
