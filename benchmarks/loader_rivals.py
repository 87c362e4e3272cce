"""What one would load training images with in place of the devkit: six cameras at 704 × 256 of 1600
× 900.

    from benchmarks.loader_rivals import rivals
    images = rivals()["simplejpeg"].load(paths, normalised=False)    # paths of six JPEG files to
    (6, 3, 256, 704)

Each is what a person writes who knows that library. `resize` smooths where it shrinks (it is
antialiased) or not, which takes less time and makes other pixels; a rival is compared with what
does the same.
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
        image: a file's path → (256, 704, 3) uint8, RGB; of torchvision (3, 256, 704).
        needs: what it takes from PyPI; a module of the same name, but for the two that have another
            one.
        smooth: whether it smooths where it shrinks.
        scaled: whether it decodes JPEG at half of its size.
    """

    image: Callable[[Path], Any]
    needs: tuple[str, ...]
    smooth: bool
    scaled: bool = False

    def load(self, paths: Sequence[Path], *, normalised: bool) -> Any:
        """(6, 3, 256, 704), uint8 or, normalised as for ImageNet, float32: an array or a tensor."""
        images = [self.image(path) for path in paths]
        if "torchvision" in self.needs:
            return _stacked_tensors(images, normalised=normalised)
        if not normalised:
            return np.stack([image.transpose(2, 0, 1) for image in images])
        mean, std = (
            np.float32(255) * np.float32(MEAN),
            np.float32(1) / (np.float32(255) * np.float32(STD)),
        )
        return np.stack(
            [((image.astype(np.float32) - mean) * std).transpose(2, 0, 1) for image in images]
        )


def rivals() -> dict[str, Rival]:
    """Name → those whose libraries are here, and run: torchvision needs the very torch that it was
    made for.
    """
    modules = {"pillow": "PIL", "opencv-python-headless": "cv2"}
    return {
        name: rival
        for name, rival in _RIVALS.items()
        if all(_runs(modules.get(need, need)) for need in rival.needs)
    }


def _runs(module: str) -> bool:
    try:
        import_module(module)
    except (ImportError, OSError, RuntimeError):
        return False
    return True


def _pillow(path: Path) -> Any:
    """As BEVDet's loader: resized whole, cropped, then an array. Its own resize is bicubic, which
    takes longer.
    """
    from PIL import Image

    top, left, height, width = CROP
    image = Image.open(path).resize(SIZE[::-1], Image.Resampling.BILINEAR)
    return np.array(image.crop((left, top, left + width, top + height)))


def _cv2(path: Path, interpolation: str) -> Any:
    import cv2

    read: Any = cv2.imread(str(path))
    image = cv2.resize(read, SIZE[::-1], interpolation=getattr(cv2, interpolation))
    return cv2.cvtColor(image[_ROWS], cv2.COLOR_BGR2RGB)


def _simplejpeg(path: Path, interpolation: str, *, scaled: bool = False) -> Any:
    import cv2
    import simplejpeg

    least = {"min_height": SIZE[0], "min_width": SIZE[1]} if scaled else {}
    image = simplejpeg.decode_jpeg(path.read_bytes(), **least)
    return cv2.resize(image, SIZE[::-1], interpolation=getattr(cv2, interpolation))[_ROWS]


def _torchvision(path: Path) -> Any:
    from torchvision.io import decode_jpeg, read_file
    from torchvision.transforms.v2 import functional

    return functional.resize(decode_jpeg(read_file(str(path))), list(SIZE), antialias=True)[
        :, _ROWS
    ]


def _stacked_tensors(images: Sequence[Any], *, normalised: bool) -> Any:
    import torch
    from torchvision.transforms.v2 import functional

    stacked = torch.stack(list(images))
    if not normalised:
        return stacked
    return functional.normalize(
        functional.to_dtype(stacked, torch.float32, scale=True), list(MEAN), list(STD)
    )


_CV2, _SIMPLEJPEG = ("opencv-python-headless",), ("simplejpeg", "opencv-python-headless")
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
