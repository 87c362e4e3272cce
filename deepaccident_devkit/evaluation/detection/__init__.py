"""Detection metrics: average precision and errors of boxes, by the released code's rules, the paper's and others."""

from deepaccident_devkit.evaluation.detection.boxes import DetectedBoxes
from deepaccident_devkit.evaluation.detection.evaluator import DetectionEvaluator
from deepaccident_devkit.evaluation.detection.matches import DetectionMatches, detection_matches
from deepaccident_devkit.evaluation.detection.nuscenes import NuScenesSummary, nuscenes_summary
from deepaccident_devkit.evaluation.detection.protocols import (
    DETECTION_PROTOCOLS,
    DetectionProtocol,
    detection_protocol,
)
from deepaccident_devkit.evaluation.detection.released_report import released_dict, released_text
from deepaccident_devkit.evaluation.detection.result import DetectionResult
from deepaccident_devkit.evaluation.detection.truth import detection_truth

__all__ = [
    "DETECTION_PROTOCOLS",
    "DetectedBoxes",
    "DetectionEvaluator",
    "DetectionMatches",
    "DetectionProtocol",
    "DetectionResult",
    "NuScenesSummary",
    "detection_matches",
    "detection_protocol",
    "detection_truth",
    "nuscenes_summary",
    "released_dict",
    "released_text",
]
