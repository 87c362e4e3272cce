"""How well a model foresees where all actors are: IoU, VPQ, minADE, minFDE, miss rate."""

from deepaccident_devkit.evaluation.metrics.motion.evaluator import (
    MotionEvaluator,
    MotionResult,
    RangeResult,
    motion_counts,
)
from deepaccident_devkit.evaluation.metrics.motion.protocol import MOTION_PROTOCOLS, MotionProtocol

__all__ = [
    "MOTION_PROTOCOLS",
    "MotionEvaluator",
    "MotionProtocol",
    "MotionResult",
    "RangeResult",
    "motion_counts",
]
