"""Targets of BEV semantic segmentation, from the camera above the agent."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion.augmentation import Augmentation
from deepaccident_devkit.release import BevImage
from deepaccident_devkit.release.npz import TAGS
from deepaccident_devkit.support.arrays import BoolArray, IntArray, ShortRepr, readonly
from deepaccident_devkit.support.text import choice
from deepaccident_devkit.taxonomy import BEV_RESOLUTION, BEV_SHAPE

BEV_CLASSES: Final = ("road", "lane_line", "sidewalk", "vehicle", "pedestrian")
"""The classes of the targets, in their order."""
_TAGS: Final = tuple(
    TAGS[tag] for tag in ("road", "road_line", "sidewalk", "vehicle", "pedestrian")
)
COVERAGE: Final[Mapping[str, float]] = {
    "road": 0.5,
    "lane_line": 0.0,
    "sidewalk": 0.5,
    "vehicle": 0.5,
    "pedestrian": 0.0,
}
"""The share of a cell that a class must cover; 0: any part is enough, for classes that are thinner than a cell."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BevSegmentation(ShortRepr):
    """The classes that cover each cell around an agent; arrays are read-only.

    Attributes:
        grid: the cells and how they lie.
        masks: (5, H, W) bool, one layer for each of `BEV_CLASSES`. Only the upper surface counts: no road beneath a
            car, nothing beneath a bridge or a tree.
        known: (H, W) bool, whether the cell is within the camera's ±60 m; outside all masks are False.
    """

    grid: BevGrid
    masks: BoolArray
    known: BoolArray

    def __post_init__(self) -> None:
        """Freeze the arrays."""
        object.__setattr__(self, "masks", readonly(self.masks))
        object.__setattr__(self, "known", readonly(self.known))

    def mask(self, name: str) -> BoolArray:
        """(H, W) bool, the layer of a class. Raises ChoiceError."""
        return np.asarray(self.masks[BEV_CLASSES.index(choice("class", name, BEV_CLASSES))])


def bev_segmentation(
    dataset: Dataset,
    sample: RowArgument,
    grid: BevGrid | None = None,
    *,
    augmentation: Augmentation | None = None,
) -> BevSegmentation:
    """The segmentation targets of a sample on a grid of its ego frame.

    Args:
        dataset: the release.
        sample: token or record.
        grid: cells, right-handed metres; None for ±50 m in cells of 0.5 m.
        augmentation: turns, scales or mirrors the ground as it does labels; None for no change.

    Raises:
        TokenError: no such sample.
        MissingFileError: the BEV camera's file was not downloaded (the test split has none).
        SensorFileError: the file cannot be read.
    """
    return segmentation_of(dataset.load_bev(sample), grid or BevGrid(), augmentation=augmentation)


def segmentation_of(
    image: BevImage,
    grid: BevGrid,
    *,
    augmentation: Augmentation | None = None,
) -> BevSegmentation:
    """The targets on a grid, from a BEV camera's array; arguments and errors as in `bev_segmentation`."""
    index = _pixels_of_cells(grid, augmentation)
    tags = np.append(image.semantic.reshape(-1), np.uint8(0))[index]
    needed = [max(1, math.ceil(COVERAGE[name] * index.shape[-1])) for name in BEV_CLASSES]
    layers = [
        np.count_nonzero(tags == tag, axis=-1) >= pixels
        for tag, pixels in zip(_TAGS, needed, strict=True)
    ]
    return BevSegmentation(
        grid=grid, masks=np.stack(layers), known=np.all(index < image.semantic.size, axis=-1)
    )


@functools.lru_cache(maxsize=4)
def _pixels_of_cells(grid: BevGrid, augmentation: Augmentation | None) -> IntArray:
    """(H, W, P) flat indices of the pixels at P points spread evenly over each cell; outside the image, its size."""
    size_x, size_y = grid.x[2], grid.y[2]
    per_cell = [max(1, round(size / BEV_RESOLUTION)) for size in (size_x, size_y)]
    within = [(np.arange(count) + 0.5) / count - 0.5 for count in per_cell]
    spread = np.stack(np.meshgrid(within[0] * size_x, within[1] * size_y), axis=-1).reshape(-1, 2)
    points = grid.centers()[:, :, None] + spread
    if augmentation is not None:
        points = points @ np.linalg.inv(augmentation.matrix)[:2, :2].T
    # from the middle of the image to a pixel's centre there are whole pixels and a half
    row, column = (
        np.rint(BEV_SHAPE[axis] / 2 - 0.5 - points[..., axis] / BEV_RESOLUTION) for axis in (0, 1)
    )
    inside = (row >= 0) & (row < BEV_SHAPE[0]) & (column >= 0) & (column < BEV_SHAPE[1])
    return readonly(
        np.where(inside, row * BEV_SHAPE[1] + column, BEV_SHAPE[0] * BEV_SHAPE[1]).astype(np.int64)
    )
