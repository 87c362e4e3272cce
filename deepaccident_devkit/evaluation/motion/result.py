"""`MotionResult`: the motion metrics of some samples."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from deepaccident_devkit.evaluation.frozen_mappings import FrozenMappings


@dataclass(frozen=True, slots=True, kw_only=True)
class RangeResult:
    """Metrics within one range.

    Attributes:
        iou: intersection over union of the actors' cells, percent.
        pq: video panoptic quality, percent.
        sq: segmentation quality of the instances found, percent.
        rq: recognition quality, percent.
        true_positive: instances found, frame by frame.
        false_positive: instances predicted that are nobody.
        false_negative: instances missed.
    """

    iou: float
    pq: float
    sq: float
    rq: float
    true_positive: int
    false_positive: int
    false_negative: int


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionResult(FrozenMappings):
    """Motion metrics of some samples.

    Attributes:
        ranges: by name (`30x30`, `100x100`), of the last prediction, which in the released order is the mean.
        min_ade: metres: mean error of the paths over their frames, of the best of all predictions; NaN without any.
        min_fde: metres: their error at the last frame; likewise.
        miss_rate: share of the paths that end too far away, in [0, 1]; likewise.
        paths: how many true paths have a partner in some prediction: what the three are means over.
        path_accuracy: tp / (tp + fp / 2 + fn / 2) of the last prediction's paths, in [0, 1]; NaN without any.
        path_true_positive: paths of the last prediction that have a partner.
        path_false_positive: those that have none.
        path_false_negative: true paths without one.
        samples: how many.
        frames: compared, of all samples.
        notes: sentences that a reader of the numbers should know.
    """

    ranges: Mapping[str, RangeResult]
    min_ade: float
    min_fde: float
    miss_rate: float
    paths: int
    path_accuracy: float
    path_true_positive: int
    path_false_positive: int
    path_false_negative: int
    samples: int
    frames: int
    notes: tuple[str, ...] = ()
