"""`SegmentationOutput`: the predicted classes of the cells around an agent."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.evaluation.drawing import Drawing, DrawnCells, Role
from deepaccident_devkit.evaluation.predictions import checked_grid
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.geometry.bev_grid import Orientation
from deepaccident_devkit.motion import BEV_CLASSES
from deepaccident_devkit.support.arrays import AnyArray, BoolArray, FrozenArrays, checked

CAMERA_CLASSES: Final = tuple(
    str(tag) for tag in (1, 2, 4, 5, 6, 7, 8, 9, 10, 11, 14, 15, 17, 19, 20, 21, 22)
)
"""Classes that are CARLA's semantic tags, as text; OneBEV evaluates these 17."""
# Tags that results can contain; 0 is unlabelled.
_TAG_CLASSES = tuple(map(str, range(1, 23)))
# Largest value of a score that is stored as uint8.
_MAX_BYTE = 255


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SegmentationOutput(FrozenArrays):
    """Predicted classes of the cells around an agent, as masks or as scores; arrays are read-only.

    Attributes:
        classes: Names of the C classes, in the order of the layers. They are names of
            `motion.BEV_CLASSES`, or CARLA's semantic tags as text, such as `"7"`.
        grid: Cells and orientation of the layers, in the current ego frame.
        masks: (C, H, W) bool, which may overlap; None if `scores` are passed.
        scores: (C, H, W) floats in [0, 1]; None if `masks` are passed. Scores that are passed as
            uint8 are divided by 255.
    """

    classes: tuple[str, ...]
    grid: BevGrid
    masks: AnyArray | None = None
    scores: AnyArray | None = None

    def __post_init__(self) -> None:
        """Check and freeze.

        Raises:
            GeometryError: If a class is unknown or repeated, masks and scores are both passed or
                both missing, or an array has the wrong shape, type or values.
        """
        grid = checked_grid(self.grid, None)
        classes = checked_classes(self.classes)
        object.__setattr__(self, "classes", classes)
        shape = (len(classes), *grid.shape)
        if (self.masks is None) == (self.scores is None):
            raise GeometryError("segmentation output: give either masks or scores")
        if self.masks is not None:
            masks = checked("masks", self.masks, shape, None)
            object.__setattr__(self, "masks", _checked_masks(masks))
        if self.scores is not None:
            scores = checked("scores", self.scores, shape, None)
            object.__setattr__(self, "scores", _checked_scores(scores))
        FrozenArrays.__post_init__(self)

    @classmethod
    def from_arrays(
        cls,
        *,
        masks: ArrayLike | None = None,
        scores: ArrayLike | None = None,
        classes: Iterable[str] = BEV_CLASSES,
        grid: BevGrid,
        orientation: Orientation | None = None,
    ) -> SegmentationOutput:
        """Create a prediction from the arrays of a model, from any framework.

        Args:
            masks: (C, H, W) bool, or 0 and 1; None if `scores` are passed.
            scores: (C, H, W) probabilities, not logits; None if `masks` are passed.
            classes: Names of the C classes, in the order of the layers.
            grid: Cells of the layers.
            orientation: Orientation of the layers; None for the grid's.

        Raises:
            GeometryError: As for the constructor.
            ChoiceError: If the orientation does not exist.
        """
        layers: dict[str, Any] = {"classes": classes, "masks": masks, "scores": scores}
        return cls(grid=checked_grid(grid, orientation), **layers)

    @classmethod
    def from_labels(cls, labels: ArrayLike, *, grid: BevGrid) -> SegmentationOutput:
        """Create masks of `CAMERA_CLASSES` from one tag per cell.

        Args:
            labels: (H, W) CARLA's semantic tags; cells with other tags have no class.
            grid: Cells and orientation of the labels.

        Raises:
            GeometryError: If the labels have the wrong shape, or are not whole numbers.
        """
        tags = checked("labels", labels, checked_grid(grid, None).shape, np.int64)
        class_tags = np.array(CAMERA_CLASSES, dtype=np.int64)
        return cls(classes=CAMERA_CLASSES, grid=grid, masks=tags == class_tags[:, None, None])

    def masks_at(self, threshold: float) -> BoolArray:
        """Return the masks, or the cells with at least this score, (C, H, W)."""
        if self.scores is None:
            masks: BoolArray = np.asarray(self.masks)
            return masks
        above: BoolArray = self.scores >= threshold
        return above

    def drawing(self) -> Drawing:
        """Describe the predicted cells for a picture."""
        cells = drawn_cells(self.masks_at(0.5), self.grid, "predicted")
        return Drawing(cells=(cells,))


def checked_classes(names: object) -> tuple[str, ...]:
    """Return names of classes as a tuple; raise GeometryError if one is unknown or repeated."""
    classes = tuple(names) if isinstance(names, Iterable) else ()
    if not classes or isinstance(names, str):
        raise GeometryError(
            f"classes: expected the names of the layers, such as {BEV_CLASSES}, found {names!r}"
        )
    known_names = (*BEV_CLASSES, *_TAG_CLASSES)
    for position, name in enumerate(classes):
        if name not in known_names:
            raise GeometryError(
                f"classes: expected {', '.join(BEV_CLASSES)}, or CARLA's tags from '1' to '22', "
                f"found {name!r}"
            )
        if name in classes[:position]:
            raise GeometryError(f"classes: {name!r} appears twice; give each class one layer")
    return classes


def _checked_masks(masks: AnyArray) -> BoolArray:
    """Return masks as bool; raise GeometryError if they are not True and False, or 0 and 1."""
    if masks.dtype.kind == "b":
        return masks
    low, high = masks.min(initial=0), masks.max(initial=0)
    if masks.dtype.kind == "f" or low < 0 or high > 1:
        raise GeometryError(
            f"masks: expected True and False, or 0 and 1, found {masks.dtype} from {low:g} to "
            f"{high:g}; give probabilities as scores, and a map of CARLA's tags to from_labels"
        )
    return masks.astype(bool)


def _checked_scores(scores: AnyArray) -> AnyArray:
    """Return scores as floats; raise GeometryError unless all of them are in [0, 1]."""
    if scores.dtype == np.uint8:
        return scores.astype(np.float32) / _MAX_BYTE
    low = scores.min(initial=1)
    high = scores.max(initial=0)
    if scores.dtype.kind != "f" or not (low >= 0 and high <= 1):
        raise GeometryError(
            "scores: expected finite floats from 0 to 1, or uint8 from 0 to 255, found "
            f"{scores.dtype} from {low:g} to {high:g}; store the sigmoid of logits"
        )
    return scores


def drawn_cells(masks: BoolArray, grid: BevGrid, role: Role) -> DrawnCells:
    """Describe the cells of masks (C, H, W) for a picture, with one id per class.

    If masks overlap, the last one is drawn, since small classes come last.
    """
    numbers = np.arange(1, len(masks) + 1)[:, None, None]
    instance = grid.reorient((masks * numbers).max(axis=0), "devkit")
    return DrawnCells(
        instance=instance[None],
        grid=grid.with_orientation("devkit"),
        times=np.zeros(1),
        role=role,
        label="found" if role == "truth" else role,
    )
