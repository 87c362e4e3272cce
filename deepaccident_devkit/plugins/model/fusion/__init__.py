"""Fusion of several agents' BEV maps.

`fusion` builds the module that a config describes; all modules have the interface `Fusion`.
`PoolFusion` is a mean or maximum, and `ReleasedFusion` the fusion in the released code.
`DiscoNetFusion`, `CobevtFusion` and `V2XViTFusion` are implemented from their papers, because they
are not in the released code.
"""

from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.plugins.model.fusion.simple import (
    RELEASED_EGO_CHANNELS,
    Agent3D,
    Agent3DConfig,
    DiscoNetConfig,
    DiscoNetFusion,
    Fusion,
    PoolFusion,
    PoolFusionConfig,
    ReleasedFusion,
    ReleasedFusionConfig,
)
from deepaccident_devkit.plugins.model.fusion.transformers import (
    CobevtConfig,
    CobevtFusion,
    V2XViTConfig,
    V2XViTFusion,
)

FusionConfig: TypeAlias = (
    PoolFusionConfig | ReleasedFusionConfig | DiscoNetConfig | CobevtConfig | V2XViTConfig
)
_MODULES: Mapping[type, Callable[[Any], Fusion]] = {
    PoolFusionConfig: PoolFusion,
    ReleasedFusionConfig: ReleasedFusion,
    DiscoNetConfig: DiscoNetFusion,
    CobevtConfig: CobevtFusion,
    V2XViTConfig: V2XViTFusion,
}


def fusion(config: FusionConfig) -> Fusion:
    """Build the fusion module that a config describes, with random initial weights.

    Raise ConfigError if the object is not a fusion's config.
    """
    if type(config) not in _MODULES:
        raise ConfigError(f"fusion: expected the config of a fusion module, found {config!r}")
    return _MODULES[type(config)](config)


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
