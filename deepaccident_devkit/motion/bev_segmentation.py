"""Targets for BEV semantic segmentation, from the camera above the agent."""

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Literal, get_args

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion.augmentation import Augmentation
from deepaccident_devkit.release import BevImage
from deepaccident_devkit.release.npz import TAGS
from deepaccident_devkit.support.arrays import (
    BoolArray,
    ByteArray,
    FloatArray,
    IntArray,
    ShortRepr,
    readonly,
)
from deepaccident_devkit.support.text import choice
from deepaccident_devkit.taxonomy import BEV_RESOLUTION, BEV_SHAPE

BEV_CLASSES: Final = ("road", "lane_line", "sidewalk", "vehicle", "pedestrian")
"""Classes of the targets, in the order of the masks."""
# Names of these classes among the semantic tags, in the same order.
_TAG_NAMES = ("road", "road_line", "sidewalk", "vehicle", "pedestrian")
COVERAGE: Final[Mapping[str, float]] = {
    "road": 0.5,
    "lane_line": 0.0,
    "sidewalk": 0.5,
    "vehicle": 0.5,
    "pedestrian": 0.0,
}
"""Smallest fraction of a cell that a class must cover.

With a fraction of 0, which suits classes thinner than a cell, one pixel is enough.
"""
TagRule = Literal["majority", "corner"]
"""How a cell gets a single tag: the tag of most of its pixels (of equally many the lowest), or the
tag of the pixel in its rear left corner."""
# Distance of a point from a cell's corner, metres, so that it is inside the corner's pixel.
_INSIDE_CORNER_M = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BevSegmentation(ShortRepr):
    """The classes that cover each cell around an agent; arrays are read-only.

    Attributes:
        grid: Cells and their orientation.
        masks: One layer for each of `BEV_CLASSES`, shape (5, H, W), bool. Only the topmost surface
            counts: the road beneath a car and anything beneath a bridge or a tree is not marked.
        known: Whether each cell is within ±60 m of the agent, the view of the overhead BEV camera,
            shape (H, W), bool. All masks are False outside it.
    """

    grid: BevGrid
    masks: BoolArray
    known: BoolArray

    def __post_init__(self) -> None:
        """Freeze the arrays."""
        object.__setattr__(self, "masks", readonly(self.masks))
        object.__setattr__(self, "known", readonly(self.known))

    def mask(self, name: str) -> BoolArray:
        """Return a class's layer, (H, W) bool; raise ChoiceError if there is no such class."""
        index = BEV_CLASSES.index(choice("class", name, BEV_CLASSES))
        layer: BoolArray = self.masks[index]
        return layer


def bev_segmentation(
    dataset: Dataset,
    sample: RowArgument,
    grid: BevGrid | None = None,
    *,
    augmentation: Augmentation | None = None,
) -> BevSegmentation:
    """Return the segmentation targets of a sample on a grid in its ego frame.

    Args:
        dataset: The release.
        sample: Token or record.
        grid: Cells, right-handed metres; None for ±50 m in cells of 0.5 m.
        augmentation: Rotation, scale and flip of the ground, as for labels; None for no change.

    Raises:
        TokenError: There is no such sample.
        MissingFileError: The BEV camera's file was not downloaded (the test split has none).
        SensorFileError: The file cannot be read.
    """
    image = dataset.load_bev(sample)
    target_grid = grid or BevGrid()
    return segmentation_of(image, target_grid, augmentation=augmentation)


def segmentation_of(
    image: BevImage,
    grid: BevGrid,
    *,
    augmentation: Augmentation | None = None,
) -> BevSegmentation:
    """Return the targets on a grid, computed from the image of a BEV camera.

    Arguments and errors are as in `bev_segmentation`.
    """
    pixels = _find_pixels(grid, augmentation)
    tags = _tags_at(image, pixels)
    layers = []
    for name, tag_name in zip(BEV_CLASSES, _TAG_NAMES, strict=True):
        min_pixels = max(1, math.ceil(COVERAGE[name] * pixels.shape[-1]))
        num_pixels = np.count_nonzero(tags == TAGS[tag_name], axis=-1)
        layers.append(num_pixels >= min_pixels)
    known = np.all(pixels < image.semantic.size, axis=-1)
    return BevSegmentation(grid=grid, masks=np.stack(layers), known=known)


def cell_tags(
    image: BevImage, grid: BevGrid, rule: TagRule = "majority"
) -> tuple[ByteArray, BoolArray]:
    """Return one of CARLA's semantic tags for each cell, and which cells are known, (H, W) each.

    Args:
        image: Image of a BEV camera.
        grid: Cells, right-handed metres.
        rule: How a cell gets its tag; pixels outside the image have the tag 0.

    Raises:
        ChoiceError: If the rule does not exist.
    """
    if choice("rule", rule, get_args(TagRule)) == "majority":
        pixels = _find_pixels(grid, None)
        tags = _tags_at(image, pixels).reshape(-1, pixels.shape[-1])
        num_tags = int(tags.max()) + 1
        first_bin = num_tags * np.arange(len(tags))[:, None]
        counts = np.bincount((first_bin + tags).reshape(-1), minlength=num_tags * len(tags))
        most_frequent = counts.reshape(-1, num_tags).argmax(axis=1).astype(np.uint8)
        cell_tag = most_frequent.reshape(grid.shape)
    else:
        _, _, x_size = grid.x
        _, _, y_size = grid.y
        to_corner = np.array([_INSIDE_CORNER_M - x_size / 2, y_size / 2 - _INSIDE_CORNER_M])
        pixels = _pixels_at(grid.centers() + to_corner)[..., None]
        cell_tag = _tags_at(image, pixels[..., 0])
    return cell_tag, np.all(pixels < image.semantic.size, axis=-1)


def _tags_at(image: BevImage, pixels: IntArray) -> ByteArray:
    """Return the tags at flat indices of pixels; 0 outside the image."""
    padded_image: ByteArray = np.append(image.semantic.reshape(-1), np.uint8(0))
    return padded_image[pixels]


@functools.lru_cache(maxsize=8)
def _find_pixels(grid: BevGrid, augmentation: Augmentation | None) -> IntArray:
    """Return the flat indices of the pixels at P points spread evenly over each cell.

    The shape is (H, W, P). The index of a point outside the image is the number of pixels.
    """
    offsets = []
    for _, _, cell_size in (grid.x, grid.y):
        count = max(1, round(cell_size / BEV_RESOLUTION))
        shares = (np.arange(count) + 0.5) / count - 0.5
        offsets.append(shares * cell_size)
    cell_points = np.stack(np.meshgrid(*offsets), axis=-1).reshape(-1, 2)
    points = grid.centers()[:, :, None] + cell_points
    if augmentation is not None:
        ego_from_augmented = np.linalg.inv(augmentation.matrix)
        points = points @ ego_from_augmented[:2, :2].T
    return readonly(_pixels_at(points))


def _pixels_at(points: FloatArray) -> IntArray:
    """Return the flat indices of the pixels at points (…, 2); the number of pixels outside."""
    num_rows, num_columns = BEV_SHAPE
    # A pixel's centre is an integer and a half pixels away from the middle of the image.
    row = np.rint(num_rows / 2 - 0.5 - points[..., 0] / BEV_RESOLUTION)
    column = np.rint(num_columns / 2 - 0.5 - points[..., 1] / BEV_RESOLUTION)
    inside = (row >= 0) & (row < num_rows) & (column >= 0) & (column < num_columns)
    pixels = np.where(inside, row * num_columns + column, num_rows * num_columns)
    return pixels.astype(np.int64)
