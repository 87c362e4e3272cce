"""How well a model foresees where all actors are: IoU, VPQ, minADE, minFDE, miss rate."""

from deepaccident_devkit.evaluation.motion.evaluator import (
    MOTION_PROTOCOLS,
    MotionEvaluator,
    MotionProtocol,
    MotionResult,
    RangeResult,
    motion_counts,
)

__all__ = [
    "MOTION_PROTOCOLS",
    "MotionEvaluator",
    "MotionProtocol",
    "MotionResult",
    "RangeResult",
    "motion_counts",
]
