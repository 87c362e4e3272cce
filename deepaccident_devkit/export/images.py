"""Camera images for models: resized, cropped and scaled, with matching intrinsics."""

from __future__ import annotations

import math
import operator
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate
from math import gcd
from typing import Any, Final, Literal, NamedTuple, SupportsIndex, get_args

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
_NO_MEAN: Final = (0.0, 0.0, 0.0)
_NO_STD: Final = (1.0, 1.0, 1.0)


class VirtualCamera(NamedTuple):
    """A pinhole camera that takes the place of another one, with its pose: cameras of two rigs then look alike.

    The image is scaled until its focal length is this one, to a whole pixel of its size, and moved by whole pixels
    until its principal point is in the middle; what the camera did not see is black. So K is exact, and a little off
    what is asked for.

    Attributes:
        focal: focal length, pixels.
        height: of the image, pixels.
        width: of the image, pixels.
    """

    focal: float
    height: int
    width: int

    def taken(
        self, image: ByteArray, lens: PinholeCamera, decode: Decoding
    ) -> tuple[ByteArray, FloatArray]:
        """The image (height, width, 3) of a camera's whole one, and its K."""
        height = max(round(lens.height * self.focal / lens.intrinsic[1, 1]), 1)
        width = max(round(lens.width * self.focal / lens.intrinsic[0, 0]), 1)
        intrinsic = lens.resized(width, height).intrinsic.copy()
        left, top = (
            np.rint(intrinsic[:2, 2] - (self.width / 2, self.height / 2)).astype(int).tolist()
        )
        intrinsic[:2, 2] -= (left, top)
        result = np.zeros((3, self.height, self.width), dtype=np.uint8).transpose(1, 2, 0)
        rows, columns = (
            slice(max(first, 0), min(first + shown, whole))
            for first, shown, whole in ((top, self.height, height), (left, self.width, width))
        )
        if rows.start < rows.stop and columns.start < columns.stop:
            part = (rows.start, columns.start, rows.stop - rows.start, columns.stop - columns.start)
            seen = resized_part(image, (height, width), part, decode)
            result[
                rows.start - top : rows.stop - top, columns.start - left : columns.stop - left
            ] = seen
        return result, intrinsic


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageConfig:
    """How images are prepared; checked when made, raises ConfigError.

    Attributes:
        resize: height and width to which a whole image is resized; None keeps the stored size.
        crop: top, left, height and width of the part to keep, in pixels of the resized image; None keeps all.
        dtype: `float32` in [0, 1], or `uint8` as decoded.
        mean: subtracted from the channels R, G, B in [0, 1]; `float32` only.
        std: the channels are then divided by this; `float32` only.
        cameras: the cameras, in this order.
        decode: how images are resized: `full`, or `scaled` in two thirds of the time, with slightly other pixels
            (docs/training.md). `full` decodes whole images and resizes as Pillow's bilinear filter; `scaled` decodes
            JPEG at the smallest of 1/1, 1/2, 1/4 and 1/8 that is no smaller than `resize` and resizes as OpenCV's area
            filter. A pixel is at most 1 of 255 from what these libraries make, but where `scaled` shrinks one axis and
            grows the other, for which OpenCV has another filter.
        virtual_camera: in place of `resize` and `crop`: the pinhole camera that all images look as if taken by.
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
            self._set("resize", _pixels("resize", self.resize, "height and width", (1, 1)))
        if self.crop is not None:
            self._set(
                "crop", _pixels("crop", self.crop, "top, left, height and width", (0, 0, 1, 1))
            )
            if self.resize is not None:
                _check_crop(self.crop, self.resize)
        settle_choices(
            self, {"dtype": get_args(ImageDtype), "decode": get_args(Decoding)}, error=ConfigError
        )
        for name in ("mean", "std"):
            self._set(name, _channels(name, getattr(self, name)))
        if min(self.std) <= 0:
            raise ConfigError(f"std: expected numbers above 0, found {self.std}")
        if self.dtype == "uint8" and (self.mean, self.std) != (_NO_MEAN, _NO_STD):
            raise ConfigError(
                "mean and std: uint8 images are not scaled; choose dtype='float32', or leave them out"
            )
        self._set("cameras", _cameras(self.cameras))
        if self.virtual_camera is not None:
            focal, *size = self.virtual_camera
            height, width = _pixels("virtual_camera", size, "height and width", (1, 1))
            self._set("virtual_camera", VirtualCamera(focal, height, width))
            if not 0 < focal < math.inf or (self.resize, self.crop) != (None, None):
                raise ConfigError(
                    "virtual_camera: expected a focal length above 0, and no resize or crop beside it"
                )

    def _set(self, name: str, value: object) -> None:
        object.__setattr__(self, name, value)

    def load(self, dataset: Dataset, camera: RowArgument) -> tuple[ByteArray, FloatArray]:
        """An image (h, w, 3) uint8 RGB, resized and cropped, and its intrinsic (3, 3).

        Pixel centres are at 0.5, 1.5, …, as everywhere in the devkit: a point at (u, v) of the whole image is at
        (u · width' / width − left, v · height' / height − top).

        Raises:
            TokenError: no such image.
            MissingFileError: it was not downloaded.
            SensorFileError: it cannot be read.
            ConfigError: the crop reaches beyond the image.
        """
        lens = dataset.camera(camera)
        if self.virtual_camera is not None:
            image = dataset.load_image(camera)
            return self.virtual_camera.taken(
                image, lens.resized(image.shape[1], image.shape[0]), self.decode
            )
        if self.resize is not None:
            image = dataset.load_image(
                camera, min_size=self.resize if self.decode == "scaled" else None
            )
            return resized_part(image, self.resize, self.crop, self.decode), self.intrinsic(
                lens, self.resize
            )
        image = dataset.load_image(camera)
        height, width = image.shape[:2]
        return self.cropped(image), self.intrinsic(lens, (height, width))

    def cropped(self, image: ByteArray) -> ByteArray:
        """The part to keep of a resized image (h, w, 3), as a view; raises ConfigError if it reaches beyond it."""
        if self.crop is None:
            return image
        _check_crop(self.crop, (image.shape[0], image.shape[1]))
        top, left, height, width = self.crop
        return image[top : top + height, left : left + width]

    def intrinsic(self, lens: PinholeCamera, size: tuple[int, int]) -> FloatArray:
        """The intrinsic (3, 3) of a camera's image that was resized to `size`, height and width, then cropped."""
        height, width = size
        intrinsic: FloatArray = lens.resized(width, height).intrinsic.copy()
        if self.crop is not None:
            top, left, _, _ = self.crop
            intrinsic[:2, 2] -= (left, top)
        return intrinsic

    def values(self, images: ByteArray, known: BoolArray) -> AnyArray:
        """Images (A, P, C, 3, h, w) uint8 as an array of `dtype`; where `known` (A, P) is False they stay 0."""
        if self.dtype == "uint8":
            return images
        result = (np.empty if known.all() else np.zeros)(images.shape, dtype=np.float32)
        mean, std = (
            np.array(three, dtype=np.float32)[:, None, None] for three in (self.mean, self.std)
        )
        scale, shift = np.float32(1) / (np.float32(255) * std), mean / std
        for a, p in np.argwhere(known).tolist():
            for image, out in zip(
                images[a, p], result[a, p], strict=True
            ):  # one fits into the processor's cache
                np.copyto(out, image)
                np.multiply(out, scale, out=out)
                np.subtract(out, shift, out=out)
        return result


def resized_part(
    image: ByteArray,
    size: tuple[int, int],
    crop: tuple[int, int, int, int] | None,
    decode: Decoding,
) -> ByteArray:
    """A part (top, left, height, width) of an image (H, W, 3) resized to `size`; None is all of it.

    Args:
        image: the whole image.
        size: height and width to which all of it would be resized; little more than the part is made.
        crop: the part.
        decode: which filter: of `full`, weights fall linearly with the distance, over two pixels of the smaller of both
            images in each direction, as of Pillow's bilinear filter; of `scaled`, they are the areas that pixels share,
            as of OpenCV's area filter.

    Returns:
        (height, width, 3), the view of an array (3, height, width): as `ImageConfig.decode` says.
    """
    import cv2

    top, left, height, width = crop or (0, 0, *size)
    rows = _resampled(image.reshape(len(image), -1), size[0], range(top, top + height), decode)
    turned: Any = cv2.transpose(rows.reshape(height, -1, 3)).reshape(-1, 3 * height)
    columns = _resampled(turned, size[1], range(left, left + width), decode).reshape(
        width, height, 3
    )
    return np.stack([cv2.transpose(each) for each in cv2.split(columns)], dtype=np.uint8).transpose(
        1, 2, 0
    )


def _resampled(rows: ByteArray, new: int, part: range, decode: Decoding) -> ByteArray:
    """A part of the `new` rows to which rows (old, n) are resized: running means of old rows, many at once."""
    import cv2

    if len(rows) == new:
        return rows[part.start : part.stop]
    result = np.empty((len(part), rows.shape[1]), dtype=np.uint8)
    groups = _groups(len(rows), new, part, decode)
    means = np.zeros((max(len(made) for made, _ in groups), rows.shape[1]), dtype=np.float32)
    for made, olds in groups:
        out = result[made.start - part.start : made.stop - part.start : made.step]
        if len(olds) == 2:
            (first, whole), (second, rest) = olds
            cv2.addWeighted(rows[first], whole - rest, rows[second], rest, 0, out)
        else:
            mean = means[: len(made)]
            for old, share in olds:
                cv2.accumulateWeighted(rows[old], mean, share)
            cv2.convertScaleAbs(mean, out)
    return result


@lru_cache
def _groups(
    old: int, new: int, part: range, decode: Decoding
) -> list[tuple[range, list[tuple[slice, float]]]]:
    """Which of `new` rows are the same means of the `old` rows near them, and of which.

    Returns:
        For each group its rows, those that lie alike between the old ones, and a list of the old rows: the first one
        of the mean for each row of the group, and so on, with their share in the mean of all up to them. Places are
        counted in the 2 `new`-th part of an old row, and so in whole numbers.
    """
    reach = 2 * max(old, new) if decode == "full" else old
    step, stride = new // gcd(old, new), old // gcd(old, new)
    edge = -((old - reach) // (2 * old))  # so many rows at both ends reach beyond the old ones
    inner = range(max(part.start, edge), min(part.stop, new - edge))
    groups = []
    for made in [range(i, i + 1) for i in part if i not in inner] + [
        inner[i::step] for i in range(step) if inner[i:]
    ]:
        centre = (2 * made[0] + 1) * old
        rows = range(
            max((centre - reach) // (2 * new), 0), min(-((-centre - reach) // (2 * new)), old)
        )
        near = [reach - abs((2 * row + 1) * new - centre) for row in rows]
        weights = [
            max(each, 0) if decode == "full" else min(each + new, 2 * min(old, new))
            for each in near
        ]
        shares = [
            (slice(row, row + stride * (len(made) - 1) + 1, stride), weight / total)
            for row, weight, total in zip(rows, weights, accumulate(weights), strict=True)
            if weight
        ]
        groups.append((made, shares))
    return groups


def _pixels(
    name: str, given: Iterable[SupportsIndex], meaning: str, least: Sequence[int]
) -> tuple[int, ...]:
    try:
        numbers = tuple(operator.index(number) for number in given)
    except TypeError:
        numbers = ()
    if len(numbers) != len(least) or any(
        number < low for number, low in zip(numbers, least, strict=True)
    ):
        raise ConfigError(f"{name}: expected {meaning} in pixels, found {given!r}")
    return numbers


def _channels(name: str, given: ArrayLike) -> tuple[float, ...]:
    try:
        numbers = checked(name, given, (3,))
    except GeometryError:
        numbers = np.full(3, np.nan)
    if not np.isfinite(numbers).all():
        raise ConfigError(f"{name}: expected a number for each of R, G and B, found {given!r}")
    return tuple(numbers.tolist())


def _cameras(given: Iterable[str]) -> tuple[str, ...]:
    names = choices("cameras", given, CAMERAS, error=ConfigError)
    if len(set(names)) != len(names):
        raise ConfigError(f"cameras: expected each camera once, found {given!r}")
    return names


def _check_crop(crop: tuple[int, int, int, int], size: tuple[int, int]) -> None:
    top, left, height, width = crop
    if top + height > size[0] or left + width > size[1]:
        raise ConfigError(
            f"crop: rows {top} to {top + height} and columns {left} to {left + width} reach beyond an image of "
            f"{size[0]} × {size[1]} (height × width); choose a smaller part"
        )
