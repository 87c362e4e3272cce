"""Segmented BEV maps, compared with the images of BEV cameras: the task `segmentation`."""

from deepaccident_devkit.evaluation.segmentation.evaluator import (
    SEGMENTATION_PROTOCOLS,
    SegmentationEvaluator,
    SegmentationProtocol,
    SegmentationResult,
    compared_masks,
    segmentation_truth,
)
from deepaccident_devkit.evaluation.segmentation.outputs import (
    CAMERA_CLASSES,
    SegmentationOutput,
    checked_classes,
)

__all__ = [
    "CAMERA_CLASSES",
    "SEGMENTATION_PROTOCOLS",
    "SegmentationEvaluator",
    "SegmentationOutput",
    "SegmentationProtocol",
    "SegmentationResult",
    "checked_classes",
    "compared_masks",
    "segmentation_truth",
]
