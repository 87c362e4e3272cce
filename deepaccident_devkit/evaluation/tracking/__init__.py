"""Tracks of actors through a recording, compared with the labels: the task `tracking`."""

from deepaccident_devkit.evaluation.predicted_boxes import Tracks
from deepaccident_devkit.evaluation.tracking.clean import CleanTracking
from deepaccident_devkit.evaluation.tracking.evaluator import (
    TRACKING_PROTOCOLS,
    TrackingEvaluator,
)
from deepaccident_devkit.evaluation.tracking.nuscenes import NuScenesTracking
from deepaccident_devkit.evaluation.tracking.result import TrackingResult
from deepaccident_devkit.evaluation.tracking.truth import TrackingTruth, tracking_truth

__all__ = [
    "TRACKING_PROTOCOLS",
    "CleanTracking",
    "NuScenesTracking",
    "TrackingEvaluator",
    "TrackingResult",
    "TrackingTruth",
    "Tracks",
    "tracking_truth",
]
