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
"""Classes of the targets, in their order."""
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
"""Smallest share of a cell that a class must cover.

With 0 any part is enough, for classes that are thinner than a cell.
"""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BevSegmentation(ShortRepr):
    """Classes that cover each cell around an agent; arrays are read-only.

    Attributes:
        grid: Cells and their orientation.
        masks: Layer for each of `BEV_CLASSES`, shape (5, H, W), bool. Only the upper surface
            counts: no road beneath a car, nothing beneath a bridge or a tree.
        known: Whether the cell is within the camera's ±60 m, shape (H, W), bool; outside all masks
            are False.
    """

    grid: BevGrid
    masks: BoolArray
    known: BoolArray

    def __post_init__(self) -> None:
        """Freeze the arrays."""
        object.__setattr__(self, "masks", readonly(self.masks))
        object.__setattr__(self, "known", readonly(self.known))

    def mask(self, name: str) -> BoolArray:
        """Return the layer of a class, shape (H, W), bool. Raises ChoiceError."""
        index = BEV_CLASSES.index(choice("class", name, BEV_CLASSES))
        return np.asarray(self.masks[index])


def bev_segmentation(
    dataset: Dataset,
    sample: RowArgument,
    grid: BevGrid | None = None,
    *,
    augmentation: Augmentation | None = None,
) -> BevSegmentation:
    """Return the segmentation targets of a sample on a grid of its ego frame.

    Args:
        dataset: The release.
        sample: Token or record.
        grid: Cells, right-handed metres; None for ±50 m in cells of 0.5 m.
        augmentation: Rotation, scale and flip of the ground, as for labels; None for no change.

    Raises:
        TokenError: No such sample.
        MissingFileError: The BEV camera's file was not downloaded (the test split has none).
        SensorFileError: The file cannot be read.
    """
    return segmentation_of(dataset.load_bev(sample), grid or BevGrid(), augmentation=augmentation)


def segmentation_of(
    image: BevImage,
    grid: BevGrid,
    *,
    augmentation: Augmentation | None = None,
) -> BevSegmentation:
    """Return the targets on a grid from the image of a BEV camera.

    Arguments and errors are as in `bev_segmentation`.
    """
    pixels = _pixels_of_cells(grid, augmentation)
    tags = np.append(image.semantic.reshape(-1), np.uint8(0))[pixels]
    layers = []
    for name, tag in zip(BEV_CLASSES, _TAGS, strict=True):
        min_pixels = max(1, math.ceil(COVERAGE[name] * pixels.shape[-1]))
        layers.append(np.count_nonzero(tags == tag, axis=-1) >= min_pixels)
    known = np.all(pixels < image.semantic.size, axis=-1)
    return BevSegmentation(grid=grid, masks=np.stack(layers), known=known)


@functools.lru_cache(maxsize=4)
def _pixels_of_cells(grid: BevGrid, augmentation: Augmentation | None) -> IntArray:
    """Return flat indices of the pixels at P points spread evenly over each cell, shape (H, W, P).

    Outside the image the index is the size of the image.
    """
    offsets = []
    for size in (grid.x[2], grid.y[2]):
        count = max(1, round(size / BEV_RESOLUTION))
        offsets.append(((np.arange(count) + 0.5) / count - 0.5) * size)
    spread = np.stack(np.meshgrid(*offsets), axis=-1).reshape(-1, 2)
    points = grid.centers()[:, :, None] + spread
    if augmentation is not None:
        points = points @ np.linalg.inv(augmentation.matrix)[:2, :2].T
    num_rows, num_columns = BEV_SHAPE
    # From the middle of the image to a pixel's centre there are whole pixels and a half.
    row = np.rint(num_rows / 2 - 0.5 - points[..., 0] / BEV_RESOLUTION)
    column = np.rint(num_columns / 2 - 0.5 - points[..., 1] / BEV_RESOLUTION)
    inside = (row >= 0) & (row < num_rows) & (column >= 0) & (column < num_columns)
    pixels = np.where(inside, row * num_columns + column, num_rows * num_columns)
    return readonly(pixels.astype(np.int64))
