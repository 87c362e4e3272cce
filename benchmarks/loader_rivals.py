"""Load training images with other libraries instead of the devkit: six cameras at 704 × 256 of 1600
× 900.

    from benchmarks.loader_rivals import rivals
    images = rivals()["simplejpeg"].load(paths, normalised=False)    # paths of six JPEG files to
    (6, 3, 256, 704)

Each rival is what a person writes who knows that library. `resize` smooths where it shrinks (it is
antialiased), or it does not, which takes less time and gives other pixels; a rival is compared with
the implementation that does the same.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

SIZE = (396, 704)
CROP = (140, 0, 256, 704)
MEAN = (0.485, 0.456, 0.406)
STD = (0.229, 0.224, 0.225)
_ROWS = slice(CROP[0], CROP[0] + CROP[2])


@dataclass(frozen=True)
class Rival:
    """A way to load six images.

    Attributes:
        image: Function from a file's path to (256, 704, 3) uint8, RGB; for torchvision (3, 256,
            704).
        needs: Packages on PyPI; the module has the same name, except for two packages.
        smooth: Whether it smooths where it shrinks.
        scaled: Whether it decodes JPEG at half of its size.
    """

    image: Callable[[Path], Any]
    needs: tuple[str, ...]
    smooth: bool
    scaled: bool = False

    def load(self, paths: Sequence[Path], *, normalised: bool) -> Any:
        """Return six images, (6, 3, 256, 704), as an array or a tensor: uint8, or float32 if
        normalised as for ImageNet.
        """
        images = [self.image(path) for path in paths]
        if "torchvision" in self.needs:
            return _stacked_tensors(images, normalised=normalised)
        if not normalised:
            return np.stack([image.transpose(2, 0, 1) for image in images])
        mean = np.float32(255) * np.float32(MEAN)
        factor = np.float32(1) / (np.float32(255) * np.float32(STD))
        normalised_images = [(image.astype(np.float32) - mean) * factor for image in images]
        return np.stack([image.transpose(2, 0, 1) for image in normalised_images])


def rivals() -> dict[str, Rival]:
    """Return, by name, the rivals that run here: torchvision needs the exact torch that it was
    built for.
    """
    module_names = {"pillow": "PIL", "opencv-python-headless": "cv2"}
    usable = {}
    for name, rival in _RIVALS.items():
        modules = [module_names.get(package, package) for package in rival.needs]
        if all(map(_can_import, modules)):
            usable[name] = rival
    return usable


def _can_import(module: str) -> bool:
    try:
        import_module(module)
    except (ImportError, OSError, RuntimeError):
        return False
    return True


def _pillow(path: Path) -> Any:
    """Load as BEVDet does: resize the whole image, crop, then make an array. Its own resize is
    bicubic, which takes longer.
    """
    from PIL import Image

    top, left, height, width = CROP
    image = Image.open(path).resize(SIZE[::-1], Image.Resampling.BILINEAR)
    return np.array(image.crop((left, top, left + width, top + height)))


def _cv2(path: Path, interpolation: str) -> Any:
    import cv2

    read = cv2.imread(str(path))
    image = cv2.resize(read, SIZE[::-1], interpolation=getattr(cv2, interpolation))
    return cv2.cvtColor(image[_ROWS], cv2.COLOR_BGR2RGB)


def _simplejpeg(path: Path, interpolation: str, *, scaled: bool = False) -> Any:
    import cv2
    import simplejpeg

    minimum = {"min_height": SIZE[0], "min_width": SIZE[1]} if scaled else {}
    image = simplejpeg.decode_jpeg(path.read_bytes(), **minimum)
    resized = cv2.resize(image, SIZE[::-1], interpolation=getattr(cv2, interpolation))
    return resized[_ROWS]


def _torchvision(path: Path) -> Any:
    from torchvision.io import decode_jpeg, read_file
    from torchvision.transforms.v2 import functional

    image = decode_jpeg(read_file(str(path)))
    return functional.resize(image, list(SIZE), antialias=True)[:, _ROWS]


def _stacked_tensors(images: Sequence[Any], *, normalised: bool) -> Any:
    import torch
    from torchvision.transforms.v2 import functional

    stacked = torch.stack(list(images))
    if not normalised:
        return stacked
    scaled = functional.to_dtype(stacked, torch.float32, scale=True)
    return functional.normalize(scaled, list(MEAN), list(STD))


_CV2 = ("opencv-python-headless",)
_SIMPLEJPEG = ("simplejpeg", "opencv-python-headless")
_RIVALS = {
    "pillow": Rival(_pillow, ("pillow",), smooth=True),
    "torchvision": Rival(_torchvision, ("torch", "torchvision"), smooth=True),
    "cv2_area": Rival(lambda path: _cv2(path, "INTER_AREA"), _CV2, smooth=True),
    "simplejpeg_area": Rival(
        lambda path: _simplejpeg(path, "INTER_AREA"), _SIMPLEJPEG, smooth=True
    ),
    "cv2": Rival(lambda path: _cv2(path, "INTER_LINEAR"), _CV2, smooth=False),
    "simplejpeg": Rival(lambda path: _simplejpeg(path, "INTER_LINEAR"), _SIMPLEJPEG, smooth=False),
    "simplejpeg_scaled_area": Rival(
        lambda path: _simplejpeg(path, "INTER_AREA", scaled=True),
        _SIMPLEJPEG,
        smooth=True,
        scaled=True,
    ),
    "simplejpeg_scaled": Rival(
        lambda path: _simplejpeg(path, "INTER_LINEAR", scaled=True),
        _SIMPLEJPEG,
        smooth=False,
        scaled=True,
    ),
}
