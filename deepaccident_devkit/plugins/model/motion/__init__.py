"""The motion head: distributions of the latent, future states, decoders, labels and losses.

Future states are predicted by flow and GRU.
"""

from deepaccident_devkit.plugins.model.motion.decoders import (
    LatentDistribution,
    PredictedMotionMaps,
)
from deepaccident_devkit.plugins.model.motion.head import (
    MotionHead,
    MotionHeadConfig,
    MotionLossConfig,
    MotionOutputs,
    MotionTargets,
    frame_mask,
    motion_losses,
)

__all__ = [
    "LatentDistribution",
    "MotionHead",
    "MotionHeadConfig",
    "MotionLossConfig",
    "MotionOutputs",
    "MotionTargets",
    "PredictedMotionMaps",
    "frame_mask",
    "motion_losses",
]
