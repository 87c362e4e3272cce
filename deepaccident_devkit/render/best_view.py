"""Which camera shows an actor best, and where in its image."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.geometry import Boxes, PinholeCamera
from deepaccident_devkit.geometry.boxes import CORNER_SIGNS
from deepaccident_devkit.geometry.camera import IN_FRONT_DEPTH
from deepaccident_devkit.render.boxes import bounds_in_image
from deepaccident_devkit.render.legends import is_there
from deepaccident_devkit.support.arrays import FloatArray, as_floats
from deepaccident_devkit.taxonomy import CAMERAS
from deepaccident_devkit.v2x.poses import camera_of

_STEPS: Final = np.stack(np.meshgrid(*[np.linspace(-1, 1, 5)] * 3), axis=-1).reshape(-1, 1, 3)
_LATTICE: Final = ((1 + CORNER_SIGNS * _STEPS) / 2).prod(axis=2)
"""(125, 8) weights of a box's corners, of points spread evenly over it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BestView:
    """The image in which some boxes are largest, even if other things hide them.

    Attributes:
        camera: token of the image (sample data).
        shown: sum of the shares of the boxes that are in the image, rounded to hundredths.
        area: pixels² of the image that their bounds cover.
        bounds: left, top, right and bottom of what is in the image of those boxes, pixels.
    """

    camera: str
    shown: float
    area: float
    bounds: tuple[float, float, float, float]


def best_view(
    dataset: Dataset, samples: Iterable[str], boxes: Boxes, channels: Sequence[str] = CAMERAS
) -> BestView | None:
    """The view of boxes, in world, that shows most of them; of equal views, the one that shows them largest.

    A view whose image was not downloaded only counts if there is no other.

    Args:
        dataset: the release.
        samples: tokens of the samples whose cameras are compared, at the moment of the boxes.
        boxes: any number.
        channels: of the cameras that are compared.

    Returns:
        The first best view; None if no camera has any part of a box in its image.

    Raises:
        TokenError: no such sample.
    """
    views = [_view(dataset, f"{sample}/{channel}", boxes) for sample in samples for channel in channels]
    there = [view for view in views if view is not None]
    return max(there, key=lambda view: (is_there(dataset, view.camera), view.shown, view.area), default=None)


def _view(dataset: Dataset, camera: str, boxes: Boxes) -> BestView | None:
    sample, channel = camera.rsplit("/", 1)
    lens = camera_of(dataset, camera)
    optical = boxes.transform(dataset.world_from(sample, channel).inverse(), channel)
    shown = _shares_in_image(optical, lens)
    seen = shown > 0
    if not seen.any():
        return None
    bounds = bounds_in_image(optical.select(seen), lens)
    (left, top), (right, bottom) = bounds[:, :2].min(axis=0).tolist(), bounds[:, 2:].max(axis=0).tolist()
    return BestView(
        camera=camera,
        shown=round(float(shown.sum()), 2),
        area=float((bounds[:, 2:] - bounds[:, :2]).prod(axis=1).sum()),
        bounds=(left, top, right, bottom),
    )


def _shares_in_image(optical: Boxes, lens: PinholeCamera) -> FloatArray:
    """Which share (N,) of the volume of each box of the camera's frame is in its image."""
    points = _LATTICE @ optical.corners()
    pixels, depth = lens.project(points.reshape(-1, 3))
    inside = lens.in_image(pixels, depth, min_depth=IN_FRONT_DEPTH)
    return as_floats(inside.reshape(points.shape[:2]).mean(axis=1))


def crop_about(
    bounds: tuple[float, float, float, float], *, width: int, height: int, share: float = 0.25
) -> tuple[float, float, float, float]:
    """Left, top, right and bottom of a part of an image, of the image's shape, with the bounds in its middle.

    Args:
        bounds: left, top, right and bottom, pixels.
        width: of the image.
        height: of the image.
        share: of the image's width that the part has at least. If possible it is twice as wide and high as the bounds.
    """
    left, top, right, bottom = bounds
    scale = min(1.0, max(share, 2 * (right - left) / width, 2 * (bottom - top) / height))
    half = scale * width / 2, scale * height / 2
    u = min(max((left + right) / 2, half[0]), width - half[0])
    v = min(max((top + bottom) / 2, half[1]), height - half[1])
    return u - half[0], v - half[1], u + half[0], v + half[1]
