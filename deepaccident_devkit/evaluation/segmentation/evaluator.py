"""`SegmentationEvaluator`: intersection over union of segmented cells (task `segmentation`)."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar, Final, Literal, get_args

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import ConfigError, EvaluationError
from deepaccident_devkit.evaluation.drawing import Drawing, Role
from deepaccident_devkit.evaluation.evaluator import Counts, Evaluator, ratio
from deepaccident_devkit.evaluation.predictions import cells_within
from deepaccident_devkit.evaluation.segmentation.outputs import (
    CAMERA_CLASSES,
    SegmentationOutput,
    drawn_cells,
)
from deepaccident_devkit.evaluation.task import Row, TaskResult
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion import BEV_CLASSES, TagRule, cell_tags, segmentation_of
from deepaccident_devkit.support.arrays import AnyArray, BoolArray
from deepaccident_devkit.support.text import settle_choices

# Name of a range → side length, in metres, of the square around the ego in which cells count.
SEGMENTED_RANGES: Final[Mapping[str, float]] = MappingProxyType(
    {"30x30": 30.0, "100x100": 100.0, "all": 1e9}
)
ClassSet = Literal["bev5", "camera"]
CLASS_SETS: Final[Mapping[str, tuple[str, ...]]] = MappingProxyType(
    {"bev5": BEV_CLASSES, "camera": CAMERA_CLASSES}
)
"""Name of a set of classes → its classes: those of the paper, or 17 of CARLA's tags."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SegmentationProtocol:
    """Options of the segmentation metrics.

    Attributes:
        classes: `bev5` for `motion.BEV_CLASSES`, whose masks may overlap; `camera` for
            `CAMERA_CLASSES`, of which a cell has one.
        tag_rule: How a cell gets its tag if the classes are `camera` (`motion.TagRule`).
        thresholds: Smallest scores of a predicted cell. If there are several, the best one counts
            for each class and range, so it is chosen by means of the truth.
        absent_is_zero: Whether a class that neither the truth nor the predictions contain counts as
            0 (True) or is left out (False).
    """

    classes: ClassSet = "bev5"
    tag_rule: TagRule = "majority"
    thresholds: tuple[float, ...] = (0.5,)
    absent_is_zero: bool = False

    def __post_init__(self) -> None:
        """Check the fields; raise ChoiceError or ConfigError if one is invalid."""
        settle_choices(self, {"classes": get_args(ClassSet), "tag_rule": get_args(TagRule)})
        in_range = [0 <= threshold <= 1 for threshold in self.thresholds]
        if not in_range or not all(in_range):
            raise ConfigError(
                f"thresholds: expected scores from 0 to 1, such as [0.5], found {self.thresholds}"
            )


SEGMENTATION_PROTOCOLS: Final[Mapping[str, SegmentationProtocol]] = MappingProxyType(
    {
        "clean": SegmentationProtocol(),
        "onebev": SegmentationProtocol(
            classes="camera",
            tag_rule="corner",
            thresholds=(0.35, 0.4, 0.45, 0.5, 0.55, 0.6, 0.65),
            absent_is_zero=True,
        ),
    }
)
"""Name → rules. `clean` counts as torchmetrics' MultilabelJaccardIndex does, without unknown cells;
`onebev` as OneBEV does on its grid, ±48 m in cells of 0.48 m."""


def segmentation_truth(
    dataset: Dataset, token: str, grid: BevGrid, protocol: SegmentationProtocol | None = None
) -> tuple[SegmentationOutput, BoolArray]:
    """Return the true classes of a sample's cells, and which cells the truth knows, (H, W).

    Args:
        dataset: Release with the BEV camera's files.
        token: Token of the sample.
        grid: Cells in the current ego frame.
        protocol: Rules; None for `clean`.

    Raises:
        TokenError: If the sample is unknown.
        MissingFileError: If the BEV camera's file was not downloaded; the test split has none.
        SensorFileError: If the file cannot be read.
    """
    rules = protocol or SegmentationProtocol()
    image = dataset.load_bev(token)
    if rules.classes == "bev5":
        segmentation = segmentation_of(image, grid)
        truth = SegmentationOutput(classes=BEV_CLASSES, grid=grid, masks=segmentation.masks)
        known = segmentation.known
    else:
        tags, known = cell_tags(image, grid, rules.tag_rule)
        truth = SegmentationOutput.from_labels(tags, grid=grid)
    return truth, known


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class SegmentationResult(TaskResult):
    """Segmentation metrics of a set of samples.

    Attributes:
        ranges: Range (`30x30`, `100x100`, and `all` for all cells of the predictions) → metrics in
            percent. `iou` maps each class to the intersection over union of its cells over all
            samples, which is NaN if neither the truth nor the predictions contain the class;
            `miou` is the mean of the classes that have one.
        samples: Number of samples.
    """

    rows: ClassVar[tuple[Row, ...]] = (
        Row("ranges/100x100/miou", "%", "higher", name="miou 100x100"),
        Row("ranges/100x100/iou/*", "%", "higher", name="iou *"),
        Row("ranges/30x30/miou", "%", "higher", name="miou 30x30"),
        Row("ranges/*/miou", "%", "higher", is_headline=False),
        Row("ranges/*/iou/*", "%", "higher", is_headline=False),
    )
    ranges: Mapping[str, Mapping[str, Any]]
    samples: int


class SegmentationEvaluator(Evaluator[SegmentationResult]):
    """Evaluator of BEV segmentation: intersection over union by class and range.

    Counts are summed over all samples, so large classes in few samples weigh as many.

    >>> SegmentationEvaluator().compute().ranges["30x30"]["miou"]
    nan
    """

    task = "segmentation"
    description = "Evaluate segmented BEV maps: IoU by class and range."
    result_kinds: ClassVar[tuple[str, ...]] = ("segmentation",)
    protocols = SEGMENTATION_PROTOCOLS
    result_class = SegmentationResult
    main_numbers: ClassVar[tuple[str, ...]] = ("ranges/100x100/miou", "ranges/30x30/miou")
    has_horizon = False

    protocol: SegmentationProtocol

    def truth(
        self, dataset: Dataset, token: str, form: Any, _horizon: float, /
    ) -> tuple[SegmentationOutput, BoolArray]:
        """Return the true classes of the sample's cells, and which cells count (H, W)."""
        return segmentation_truth(dataset, token, form.grid, self.protocol)

    def update(
        self,
        token: str,
        prediction: SegmentationOutput,
        truth: SegmentationOutput,
        known: BoolArray,
    ) -> None:
        """Count one sample.

        Args:
            token: Token of the sample.
            prediction: Prediction of a model, in any orientation and order of the classes.
            truth: True masks of the sample for the same area.
            known: (H, W) which cells of the truth count.

        Raises:
            EvaluationError: If the prediction has another type or grid or lacks a class, or the
                sample was counted before with other counts.
        """
        true = known & np.asarray(truth.masks)
        cells = []
        for threshold in self.protocol.thresholds:
            predicted = known & compared_masks(prediction, truth, threshold)
            cells.append(count_cells(predicted, true, truth.grid))
        self.add(token, {"samples": 1, "cells": cells})

    def drawing(self, _dataset: Dataset, _token: str, prediction: Any, /, *truth: Any) -> Drawing:
        """Describe cells by outcome; for several thresholds, at the middle one."""
        true, known = truth
        thresholds = self.protocol.thresholds
        predicted = compared_masks(prediction, true, thresholds[len(thresholds) // 2])
        found = predicted & true.masks
        outcomes: dict[Role, AnyArray] = {
            "truth": found,
            "right": found,
            "missed": true.masks & ~predicted,
            "false": predicted & ~true.masks,
        }
        cells = []
        for role, masks in outcomes.items():
            cells.append(drawn_cells(known & masks, true.grid, role))
        return Drawing(cells=tuple(cells))

    def result_of(self, counts: Collection[Counts]) -> SegmentationResult:
        """Compute the metrics from the counts of samples, in any order."""
        (pooled,) = self.pooled(counts)
        common, predicted, true = np.moveaxis(pooled["cells"], 2, 0)
        with np.errstate(invalid="ignore"):
            percents = 100 * common / (predicted + true - common)
        best_percents = np.fmax.reduce(percents)
        if self.protocol.absent_is_zero:
            best_percents = np.nan_to_num(best_percents)
        ranges = {}
        for name, values in zip(SEGMENTED_RANGES, best_percents.tolist(), strict=True):
            iou = dict(zip(CLASS_SETS[self.protocol.classes], values, strict=True))
            present = [value for value in values if not math.isnan(value)]
            ranges[name] = {"miou": ratio(math.fsum(present), len(present)), "iou": iou}
        return SegmentationResult(ranges=ranges, samples=pooled["samples"])

    def pooled(self, counts: Collection[Counts]) -> list[Counts]:
        """Sum the counts; the list has a single entry, whose cells are an array."""
        num_classes = len(CLASS_SETS[self.protocol.classes])
        shape = (len(self.protocol.thresholds), len(SEGMENTED_RANGES), 3, num_classes)
        cells = np.zeros(shape, dtype=np.int64)
        for sample in counts:
            cells += sample["cells"]
        return [{"samples": sum(sample["samples"] for sample in counts), "cells": cells}]


def compared_masks(
    prediction: object, truth: SegmentationOutput, threshold: float = 0.5
) -> BoolArray:
    """Return predicted masks (C, H, W) with the classes and the orientation of the truth.

    Raises:
        EvaluationError: If the prediction has another type or grid, or lacks a class.
    """
    if not isinstance(prediction, SegmentationOutput):
        raise EvaluationError(
            f"prediction: expected a SegmentationOutput, found {type(prediction).__name__}; make "
            "one with SegmentationOutput.from_arrays(masks=…, grid=…)"
        )
    grid = prediction.grid
    if (grid.x, grid.y) != (truth.grid.x, truth.grid.y):
        raise EvaluationError(f"prediction: expected cells of {truth.grid}, found {grid}")
    missing = [name for name in truth.classes if name not in prediction.classes]
    if missing:
        raise EvaluationError(
            f"prediction: lacks the classes {', '.join(missing)}, which are evaluated, and has "
            f"{', '.join(prediction.classes)}; predict them, or evaluate other classes (such as "
            "--switch classes=camera)"
        )
    layers = [prediction.classes.index(name) for name in truth.classes]
    masks = grid.reorient(prediction.masks_at(threshold), truth.grid.orientation)
    compared: BoolArray = masks[layers]
    return compared


def count_cells(predicted: BoolArray, true: BoolArray, grid: BevGrid) -> list[list[list[int]]]:
    """Count the cells of C classes in each of `SEGMENTED_RANGES`.

    Args:
        predicted: (C, H, W) predicted masks, without unknown cells.
        true: (C, H, W) true masks, without unknown cells.
        grid: Cells and orientation of the masks.

    Returns:
        For each range, numbers of common, predicted and true cells by class.
    """
    layers = (predicted & true, predicted, true)
    counts = []
    for extent in SEGMENTED_RANGES.values():
        in_range = cells_within(grid, extent)
        counts_in_range = []
        for masks in layers:
            counts_in_range.append([int(np.count_nonzero(mask[in_range])) for mask in masks])
        counts.append(counts_in_range)
    return counts
