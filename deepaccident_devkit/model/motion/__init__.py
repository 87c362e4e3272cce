"""The motion head: distributions of the latent, future states by flow and GRU, decoders, labels and losses."""

from deepaccident_devkit.model.motion.decoders import LatentDistribution, MotionMaps
from deepaccident_devkit.model.motion.head import (
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
    "MotionMaps",
    "MotionOutputs",
    "MotionTargets",
    "frame_mask",
    "motion_losses",
]
