"""Images → features: backbones, and the neck that merges a backbone's two feature maps.

backbone, neck = image_encoder(SwinConfig())
features = neck(backbone(normalised(images)))  # (N, 3, h, w) uint8 → (N, 512, h / 16, w / 16)
"""

from deepaccident_devkit.plugins.model.images.encoder import (
    EncoderConfig,
    FpnNeck,
    SmallConv,
    SmallConvConfig,
    image_encoder,
    normalise_images,
)
from deepaccident_devkit.plugins.model.images.swin import Swin, SwinConfig, from_official

__all__ = [
    "EncoderConfig",
    "FpnNeck",
    "SmallConv",
    "SmallConvConfig",
    "Swin",
    "SwinConfig",
    "from_official",
    "image_encoder",
    "normalise_images",
]
