"""The official metrics, and those that the paper describes: motion, accidents, detection, segmentation from above.

Functions of arrays count (`segmentation`, `vpq`, `trajectory_errors`, the modules of `accident` and `detection`);
evaluators keep the counts by sample and sum them; `breakdown` sums them by attribute.
"""

from deepaccident_devkit.evaluation.accident import (
    AccidentContext,
    AccidentEvaluator,
    AccidentResult,
    accident_context,
)
from deepaccident_devkit.evaluation.bev_segmentation import BevSegmentationEvaluator, BevSegmentationResult
from deepaccident_devkit.evaluation.breakdown import Bootstrap, Breakdown, breakdown
from deepaccident_devkit.evaluation.detection import (
    DetectedBoxes,
    DetectionEvaluator,
    DetectionResult,
    detection_truth,
    nuscenes_summary,
)
from deepaccident_devkit.evaluation.evaluator import Evaluator
from deepaccident_devkit.evaluation.motion import MotionEvaluator, MotionResult
from deepaccident_devkit.evaluation.predictions import Accident, MotionOutput, instances_of
from deepaccident_devkit.evaluation.run import evaluate_samples
from deepaccident_devkit.evaluation.sample_attributes import SampleAttributes, sample_attributes
from deepaccident_devkit.evaluation.segmentation import segmentation_counts
from deepaccident_devkit.evaluation.vpq import vpq, vpq_counts

__all__ = [
    "Accident",
    "AccidentContext",
    "AccidentEvaluator",
    "AccidentResult",
    "BevSegmentationEvaluator",
    "BevSegmentationResult",
    "Bootstrap",
    "Breakdown",
    "DetectedBoxes",
    "DetectionEvaluator",
    "DetectionResult",
    "Evaluator",
    "MotionEvaluator",
    "MotionOutput",
    "MotionResult",
    "SampleAttributes",
    "accident_context",
    "breakdown",
    "detection_truth",
    "evaluate_samples",
    "instances_of",
    "nuscenes_summary",
    "sample_attributes",
    "segmentation_counts",
    "vpq",
    "vpq_counts",
]
