"""The official metrics, and those that the paper describes: motion, accidents, detection, segmentation from above.

Functions of arrays count (`segmentation`, `panoptic`, `trajectory_errors`, the modules of `accident` and `detection`);
evaluators keep the counts by sample and sum them; `breakdown` sums them by attribute.
"""

from deepaccident_devkit.evaluation.accident import (
    AccidentContext,
    AccidentEvaluator,
    AccidentResult,
    BoxAccidents,
    BoxTruth,
    PaperAccidents,
    accident_context,
    accidents_of,
    box_truth,
)
from deepaccident_devkit.evaluation.attributes import SampleAttributes, sample_attributes
from deepaccident_devkit.evaluation.bev_segmentation import BevSegmentationEvaluator, BevSegmentationResult
from deepaccident_devkit.evaluation.breakdowns import Bootstrap, Breakdown, breakdown
from deepaccident_devkit.evaluation.detection import (
    DetectedBoxes,
    DetectionEvaluator,
    DetectionResult,
    detection_truth,
    nuscenes_summary,
)
from deepaccident_devkit.evaluation.evaluator import Evaluator
from deepaccident_devkit.evaluation.losses import LostInstance, lost_instances
from deepaccident_devkit.evaluation.motion import MotionEvaluator, MotionResult, motion_counts
from deepaccident_devkit.evaluation.panoptic import vpq, vpq_counts
from deepaccident_devkit.evaluation.predictions import Accident, MotionOutput, instances_of
from deepaccident_devkit.evaluation.run import evaluate_samples
from deepaccident_devkit.evaluation.segmentation import segmentation_counts
from deepaccident_devkit.evaluation.trajectory_matching import match_trajectories

__all__ = [
    "Accident",
    "AccidentContext",
    "AccidentEvaluator",
    "AccidentResult",
    "BevSegmentationEvaluator",
    "BevSegmentationResult",
    "Bootstrap",
    "BoxAccidents",
    "BoxTruth",
    "Breakdown",
    "DetectedBoxes",
    "DetectionEvaluator",
    "DetectionResult",
    "Evaluator",
    "LostInstance",
    "MotionEvaluator",
    "MotionOutput",
    "MotionResult",
    "PaperAccidents",
    "SampleAttributes",
    "accident_context",
    "accidents_of",
    "box_truth",
    "breakdown",
    "detection_truth",
    "evaluate_samples",
    "instances_of",
    "lost_instances",
    "match_trajectories",
    "motion_counts",
    "nuscenes_summary",
    "sample_attributes",
    "segmentation_counts",
    "vpq",
    "vpq_counts",
]
