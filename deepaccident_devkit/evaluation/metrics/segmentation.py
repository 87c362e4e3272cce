"""`BevSegmentationEvaluator`: intersection over union of the classes on the ground."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from math import fsum, isnan, nan
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.arrays import BoolArray, checked
from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.evaluation.metrics.evaluator import Counts, Evaluator, ratio
from deepaccident_devkit.evaluation.metrics.frozen_mappings import FrozenMappings, plain
from deepaccident_devkit.motion import BEV_CLASSES, BevSegmentation


@dataclass(frozen=True, slots=True, kw_only=True)
class BevSegmentationResult(FrozenMappings):
    """Shares of the cells that prediction and truth have in common.

    Attributes:
        mean_iou: the mean over the classes that there are, in %; NaN if there is none.
        iou: class of `motion.BEV_CLASSES` → intersection over union in %, of the cells of all samples together; NaN
            where neither side has any.
        cells: class → how many cells are hit, predicted wrongly and missed.
        samples: number of samples.
    """

    mean_iou: float
    iou: Mapping[str, float]
    cells: Mapping[str, tuple[int, int, int]]
    samples: int

    def as_dict(self) -> dict[str, Any]:
        """All of it, as JSON holds it; None for classes that are nowhere."""
        return {
            "samples": self.samples,
            "mIoU": plain(self.mean_iou),
            "IoU": plain(self.iou),
            "cells": plain(self.cells),
        }


class BevSegmentationEvaluator(Evaluator[BevSegmentationResult]):
    """Counts cells by sample and class; cells that the truth does not know do not count."""

    @property
    def settings(self) -> dict[str, Any]:
        """The classes, in their order."""
        return {"classes": list(BEV_CLASSES)}

    def update(self, token: str, prediction: BevSegmentation | ArrayLike, truth: BevSegmentation) -> None:
        """Take a sample.

        Args:
            token: the sample's.
            prediction: (5, H, W), a layer a class of `motion.BEV_CLASSES`, true where it is predicted, on the truth's
                grid and in its orientation; or such targets.
            truth: what `motion.bev_segmentation` gives.

        Raises:
            GeometryError: the prediction has another shape or grid, or holds anything but true and false (0 and 1).
            EvaluationError: the sample came before, with another result.
        """
        predicted = _layers(token, prediction, truth) & truth.known
        there = truth.masks & truth.known
        hit, said, true = (np.count_nonzero(each, axis=(1, 2)) for each in (predicted & there, predicted, there))
        columns = {"hit": hit.tolist(), "in_vain": (said - hit).tolist(), "missed": (true - hit).tolist()}
        self.add(token, columns)

    def result_of(self, counts: Collection[Counts]) -> BevSegmentationResult:
        """The metrics of some samples' counts, in any order."""
        names = ("hit", "in_vain", "missed")
        cells = {
            one: tuple(sum(each[name][position] for each in counts) for name in names)
            for position, one in enumerate(BEV_CLASSES)
        }
        iou = {one: 100 * ratio(numbers[0], sum(numbers)) for one, numbers in cells.items()}
        known = [value for value in iou.values() if not isnan(value)]
        return BevSegmentationResult(
            mean_iou=fsum(known) / len(known) if known else nan,
            iou=iou,
            cells={one: (hit, vain, missed) for one, (hit, vain, missed) in cells.items()},
            samples=len(counts),
        )


def _layers(token: str, prediction: BevSegmentation | ArrayLike, truth: BevSegmentation) -> BoolArray:
    if isinstance(prediction, BevSegmentation):
        if prediction.grid != truth.grid:
            raise GeometryError(f"{token}: prediction on {prediction.grid}, truth on {truth.grid}; use one grid")
        return prediction.masks
    given = checked(f"{token}: prediction", prediction, truth.masks.shape, None)
    if given.dtype != np.bool_ and not np.isin(given, (0, 1)).all():
        raise GeometryError(f"{token}: prediction holds other numbers than 0 and 1; compare scores with a threshold")
    return given.astype(bool)
