"""The official metrics, and those that the paper describes: motion, accidents, detection, segmentation from above.

Functions of arrays count (`segmentation`, `panoptic`, `trajectory_errors`, the modules of `accident` and `detection`);
evaluators keep the counts by sample and sum them; `breakdown` sums them by attribute. `results` are predictions in
files, `runs` evaluates them into bundles that others can check, `sanity` and `explanation` tell why a number is what it
is, `warning` how early accidents are warned of.
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
from deepaccident_devkit.evaluation.results import Results, ResultsWriter, read_results
from deepaccident_devkit.evaluation.run import evaluate_samples
from deepaccident_devkit.evaluation.segmentation import segmentation_counts
from deepaccident_devkit.evaluation.trajectory_matching import match_trajectories
from deepaccident_devkit.evaluation.warning import WarningEvaluator, WarningResult

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
    "Results",
    "ResultsWriter",
    "SampleAttributes",
    "WarningEvaluator",
    "WarningResult",
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
    "read_results",
    "sample_attributes",
    "segmentation_counts",
    "vpq",
    "vpq_counts",
]
