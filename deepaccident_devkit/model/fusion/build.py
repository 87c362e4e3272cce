"""Which module a config stands for."""

from __future__ import annotations

from typing import TypeAlias

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.model.fusion.cobevt import CobevtConfig, CobevtFusion
from deepaccident_devkit.model.fusion.disconet import DiscoNetConfig, DiscoNetFusion
from deepaccident_devkit.model.fusion.interface import Fusion
from deepaccident_devkit.model.fusion.simple import (
    PoolFusion,
    PoolFusionConfig,
    ReleasedFusion,
    ReleasedFusionConfig,
)
from deepaccident_devkit.model.fusion.v2xvit import V2XViTConfig, V2XViTFusion

FusionConfig: TypeAlias = PoolFusionConfig | ReleasedFusionConfig | DiscoNetConfig | CobevtConfig | V2XViTConfig


def fusion(config: FusionConfig) -> Fusion:
    """The fusion module that a config describes, with fresh weights. Raises ConfigError: another object."""
    match config:
        case PoolFusionConfig():
            return PoolFusion(config)
        case ReleasedFusionConfig():
            return ReleasedFusion(config)
        case DiscoNetConfig():
            return DiscoNetFusion(config)
        case CobevtConfig():
            return CobevtFusion(config)
        case V2XViTConfig():
            return V2XViTFusion(config)
        case _:
            raise ConfigError(f"fusion: expected the config of a fusion module, found {config!r}")
