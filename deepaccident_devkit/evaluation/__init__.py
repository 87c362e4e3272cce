"""The metrics of the released code, of the paper, and of other public implementations.

Each task has a package that counts samples and sums the counts. `results` reads and writes files of
predictions. `runs` evaluates them to bundles that others can check, and looks for mistakes in
predictions (`runs.sanity`). `breakdown` groups results by attribute.
"""

from deepaccident_devkit.evaluation.accident import (
    AccidentContext,
    AccidentEvaluator,
    AccidentResult,
    BoxAccidents,
    BoxTruth,
    PaperAccidents,
    accident_context,
    box_truth,
    foreseen_accident,
)
from deepaccident_devkit.evaluation.breakdowns import (
    Breakdown,
    SampleAttributes,
    breakdown,
    sample_attributes,
)
from deepaccident_devkit.evaluation.counting import evaluate_samples
from deepaccident_devkit.evaluation.detection import (
    DetectedBoxes,
    DetectionEvaluator,
    DetectionResult,
    detection_truth,
)
from deepaccident_devkit.evaluation.evaluator import Evaluator
from deepaccident_devkit.evaluation.forecasting import (
    Forecast,
    ForecastingEvaluator,
    ForecastingResult,
)
from deepaccident_devkit.evaluation.instances import match_trajectories, vpq_counts
from deepaccident_devkit.evaluation.intervals import Resampling
from deepaccident_devkit.evaluation.motion import MotionEvaluator, MotionResult, motion_counts
from deepaccident_devkit.evaluation.planning import Plan, PlanningEvaluator, PlanningResult
from deepaccident_devkit.evaluation.predictions import Accident, MotionOutput, instances_of
from deepaccident_devkit.evaluation.results import Results, ResultsWriter, read_results
from deepaccident_devkit.evaluation.segmentation import (
    SegmentationEvaluator,
    SegmentationOutput,
    SegmentationResult,
)
from deepaccident_devkit.evaluation.tracking import (
    TrackingEvaluator,
    TrackingResult,
    TrackingTruth,
    Tracks,
    tracking_truth,
)
from deepaccident_devkit.evaluation.warning import (
    AnticipationResult,
    CleanWarnings,
    FieldResult,
    FieldWarnings,
    WarningEvaluator,
)

__all__ = [
    "Accident",
    "AccidentContext",
    "AccidentEvaluator",
    "AccidentResult",
    "AnticipationResult",
    "BoxAccidents",
    "BoxTruth",
    "Breakdown",
    "CleanWarnings",
    "DetectedBoxes",
    "DetectionEvaluator",
    "DetectionResult",
    "Evaluator",
    "FieldResult",
    "FieldWarnings",
    "Forecast",
    "ForecastingEvaluator",
    "ForecastingResult",
    "MotionEvaluator",
    "MotionOutput",
    "MotionResult",
    "PaperAccidents",
    "Plan",
    "PlanningEvaluator",
    "PlanningResult",
    "Resampling",
    "Results",
    "ResultsWriter",
    "SampleAttributes",
    "SegmentationEvaluator",
    "SegmentationOutput",
    "SegmentationResult",
    "TrackingEvaluator",
    "TrackingResult",
    "TrackingTruth",
    "Tracks",
    "WarningEvaluator",
    "accident_context",
    "box_truth",
    "breakdown",
    "detection_truth",
    "evaluate_samples",
    "foreseen_accident",
    "instances_of",
    "match_trajectories",
    "motion_counts",
    "read_results",
    "sample_attributes",
    "tracking_truth",
    "vpq_counts",
]
