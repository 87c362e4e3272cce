"""Fusion of several agents' BEV maps: `fusion` makes the module of a config; all have the interface `Fusion`.

`PoolFusion` is a mean or maximum, `ReleasedFusion` what the released code does; `DiscoNetFusion`, `CobevtFusion` and
`V2XViTFusion` are written after their own papers, since the released code has none of them.
"""

from deepaccident_devkit.model.fusion.agent3d import Agent3D, Agent3DConfig
from deepaccident_devkit.model.fusion.build import FusionConfig, fusion
from deepaccident_devkit.model.fusion.cobevt import CobevtConfig, CobevtFusion
from deepaccident_devkit.model.fusion.disconet import DiscoNetConfig, DiscoNetFusion
from deepaccident_devkit.model.fusion.interface import Fusion
from deepaccident_devkit.model.fusion.simple import (
    RELEASED_EGO_CHANNELS,
    PoolFusion,
    PoolFusionConfig,
    ReleasedFusion,
    ReleasedFusionConfig,
)
from deepaccident_devkit.model.fusion.v2xvit import V2XViTConfig, V2XViTFusion

__all__ = [
    "RELEASED_EGO_CHANNELS",
    "Agent3D",
    "Agent3DConfig",
    "CobevtConfig",
    "CobevtFusion",
    "DiscoNetConfig",
    "DiscoNetFusion",
    "Fusion",
    "FusionConfig",
    "PoolFusion",
    "PoolFusionConfig",
    "ReleasedFusion",
    "ReleasedFusionConfig",
    "V2XViTConfig",
    "V2XViTFusion",
    "fusion",
]
