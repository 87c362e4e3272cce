"""Which camera shows an actor best, and where in its image."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.geometry.camera import IN_FRONT_DEPTH
from deepaccident_devkit.render.missing import is_there
from deepaccident_devkit.taxonomy import CAMERAS, UNTRACKED_ID
from deepaccident_devkit.v2x.projection import camera_of


@dataclass(frozen=True, slots=True, kw_only=True)
class BestView:
    """The image in which some boxes are largest, even if other things hide them.

    Attributes:
        camera: token of the image (sample data).
        shown: sum of the shares of the boxes' surroundings that are in the image, rounded to hundredths.
        area: pixels² of the image that their surroundings cover.
        bounds: left, top, right and bottom of those boxes in the image, pixels.
    """

    camera: str
    shown: float
    area: float
    bounds: tuple[float, float, float, float]


def best_view(dataset: Dataset, samples: Iterable[str], boxes: Boxes) -> BestView | None:
    """The view of boxes, in world, that shows most of them; of equal views, the one that shows them largest.

    A view whose image was not downloaded only counts if there is no other.

    Args:
        dataset: the release.
        samples: tokens of the samples whose cameras are compared, at the moment of the boxes.
        boxes: at least one.

    Returns:
        The first best view; None if no camera has, in its image, any box that is entirely in front of it.

    Raises:
        TokenError: no such sample.
    """
    views = [_view(dataset, f"{sample}/{channel}", boxes) for sample in samples for channel in CAMERAS]
    there = [view for view in views if view is not None]
    return max(there, key=lambda view: (is_there(dataset, view.camera), view.shown, view.area), default=None)


def best_camera(dataset: Dataset, sample: str, boxes: Boxes) -> str:
    """The channel of a sample whose image shows most of some boxes, in world, without the agent itself.

    The front camera if no image shows any.

    Raises:
        TokenError: no such sample.
    """
    own = dataset.agent.get(sample.rsplit("/", 1)[0])["actor_id"]
    others = boxes.select(boxes.actor_id != (UNTRACKED_ID if own is None else own))
    view = best_view(dataset, [sample], others)
    return CAMERAS[0] if view is None else view.camera.rsplit("/", 1)[1]


def _view(dataset: Dataset, camera: str, boxes: Boxes) -> BestView | None:
    sample, channel = camera.rsplit("/", 1)
    lens = camera_of(dataset, camera)
    corners = boxes.transform(dataset.world_from(sample, channel).inverse(), channel).corners()
    corners = corners[(corners[..., 2] > IN_FRONT_DEPTH).all(axis=1)]
    pixels = lens.project(corners.reshape(-1, 3))[0].reshape(-1, 8, 2)
    low, high = pixels.min(axis=1), pixels.max(axis=1)
    whole = (high - low).prod(axis=1)
    low, high = (corner.clip(0, (lens.width, lens.height)) for corner in (low, high))
    inside = (high - low).prod(axis=1)
    seen = inside > 0
    if not seen.any():
        return None
    (left, top), (right, bottom) = low[seen].min(axis=0).tolist(), high[seen].max(axis=0).tolist()
    return BestView(
        camera=camera,
        shown=round(float((inside[seen] / whole[seen]).sum()), 2),
        area=float(inside.sum()),
        bounds=(left, top, right, bottom),
    )


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
