"""Camera images for models: resized, cropped and scaled, with matching intrinsics."""

from __future__ import annotations

import operator
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final, Literal, SupportsIndex, get_args

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.arrays import AnyArray, ByteArray, FloatArray, checked
from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ConfigError, GeometryError
from deepaccident_devkit.taxonomy import CAMERAS
from deepaccident_devkit.text import choice, settle_choices
from deepaccident_devkit.v2x.projection import camera_of

ImageDtype = Literal["float32", "uint8"]
_NO_MEAN: Final = (0.0, 0.0, 0.0)
_NO_STD: Final = (1.0, 1.0, 1.0)


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
    """

    resize: tuple[int, int] | None = None
    crop: tuple[int, int, int, int] | None = None
    dtype: ImageDtype = "float32"
    mean: tuple[float, float, float] = _NO_MEAN
    std: tuple[float, float, float] = _NO_STD
    cameras: tuple[str, ...] = CAMERAS

    def __post_init__(self) -> None:
        """Check every field, and convert sequences to tuples."""
        if self.resize is not None:
            self._set("resize", _pixels("resize", self.resize, "height and width", (1, 1)))
        if self.crop is not None:
            self._set("crop", _pixels("crop", self.crop, "top, left, height and width", (0, 0, 1, 1)))
            if self.resize is not None:
                _check_crop(self.crop, self.resize)
        settle_choices(self, {"dtype": get_args(ImageDtype)}, error=ConfigError)
        for name in ("mean", "std"):
            self._set(name, _channels(name, getattr(self, name)))
        if min(self.std) <= 0:
            raise ConfigError(f"std: expected numbers above 0, found {self.std}")
        if self.dtype == "uint8" and (self.mean, self.std) != (_NO_MEAN, _NO_STD):
            raise ConfigError("mean and std: uint8 images are not scaled; choose dtype='float32', or leave them out")
        self._set("cameras", _cameras(self.cameras))

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
        from PIL import Image

        lens, image = camera_of(dataset, camera), dataset.load_image(camera)
        if self.resize is not None and image.shape[:2] != self.resize:
            image = np.asarray(Image.fromarray(image).resize(self.resize[::-1], Image.Resampling.BILINEAR))
        height, width = image.shape[:2]
        intrinsic: FloatArray = np.diag([width / lens.width, height / lens.height, 1.0]) @ lens.intrinsic
        if self.crop is not None:
            _check_crop(self.crop, (height, width))
            top, left, height, width = self.crop
            image = image[top : top + height, left : left + width]
            intrinsic[:2, 2] -= (left, top)
        return image, intrinsic

    def stacked(self, images: list[ByteArray]) -> AnyArray:
        """Images of one size as one array (C, 3, h, w) of `dtype`. Raises ConfigError if their sizes differ."""
        sizes = sorted({image.shape[:2] for image in images})
        if len(sizes) > 1:
            raise ConfigError(f"the cameras' images have different sizes, {sizes[0]} and {sizes[-1]}; choose resize=")
        pixels = np.ascontiguousarray(np.stack(images).transpose(0, 3, 1, 2))
        if self.dtype == "uint8":
            return pixels
        scaled = pixels.astype(np.float32) / np.float32(255)
        if (self.mean, self.std) == (_NO_MEAN, _NO_STD):
            return scaled
        mean, std = (np.array(three, dtype=np.float32)[:, None, None] for three in (self.mean, self.std))
        return (scaled - mean) / std


def _pixels(name: str, given: Iterable[SupportsIndex], meaning: str, least: Sequence[int]) -> tuple[int, ...]:
    try:
        numbers = tuple(operator.index(number) for number in given)
    except TypeError:
        numbers = ()
    if len(numbers) != len(least) or any(number < low for number, low in zip(numbers, least, strict=True)):
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
    listed = () if isinstance(given, str) or not isinstance(given, Iterable) else tuple(given)
    names = tuple(choice("cameras", name, CAMERAS, error=ConfigError) for name in listed)
    if not names or len(set(names)) != len(names):
        raise ConfigError(f"cameras: expected a tuple of some of {', '.join(CAMERAS)}, each once; found {given!r}")
    return names


def _check_crop(crop: tuple[int, int, int, int], size: tuple[int, int]) -> None:
    top, left, height, width = crop
    if top + height > size[0] or left + width > size[1]:
        raise ConfigError(
            f"crop: rows {top} to {top + height} and columns {left} to {left + width} reach beyond an image of "
            f"{size[0]} × {size[1]} (height × width); choose a smaller part"
        )
