"""How well a model foresees where everybody is: IoU, VPQ, minADE, minFDE, miss rate."""

from deepaccident_devkit.evaluation.motion.counts import motion_counts
from deepaccident_devkit.evaluation.motion.evaluator import MotionEvaluator
from deepaccident_devkit.evaluation.motion.protocol import MOTION_PROTOCOLS, MotionProtocol
from deepaccident_devkit.evaluation.motion.result import MotionResult, RangeResult

__all__ = [
    "MOTION_PROTOCOLS",
    "MotionEvaluator",
    "MotionProtocol",
    "MotionResult",
    "RangeResult",
    "motion_counts",
]
