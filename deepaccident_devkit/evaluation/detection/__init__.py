"""Detection metrics: average precision and errors of boxes, by the released code's rules, the paper's and others."""

from deepaccident_devkit.evaluation.detection.boxes import DetectedBoxes, detection_truth
from deepaccident_devkit.evaluation.detection.evaluator import DetectionEvaluator
from deepaccident_devkit.evaluation.detection.frame_counts import DetectionMatches, detection_matches
from deepaccident_devkit.evaluation.detection.protocols import (
    DETECTION_PROTOCOLS,
    DetectionProtocol,
    detection_protocol,
)
from deepaccident_devkit.evaluation.detection.result import DetectionResult

__all__ = [
    "DETECTION_PROTOCOLS",
    "DetectedBoxes",
    "DetectionEvaluator",
    "DetectionMatches",
    "DetectionProtocol",
    "DetectionResult",
    "detection_matches",
    "detection_protocol",
    "detection_truth",
]
