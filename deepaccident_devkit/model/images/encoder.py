"""The image encoder that a configuration describes, and what images look like before it."""

from __future__ import annotations

from typing import Final

import torch
from torch import Tensor

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.model.images.necks import FpnNeck
from deepaccident_devkit.model.images.resnet import ResNet, ResNetConfig
from deepaccident_devkit.model.images.small_conv import SmallConv, SmallConvConfig
from deepaccident_devkit.model.images.swin import Swin, SwinConfig

EncoderConfig = SwinConfig | ResNetConfig | SmallConvConfig
_MEAN: Final = (0.485, 0.456, 0.406)
_STD: Final = (0.229, 0.224, 0.225)
"""Of ImageNet's R, G, B in [0, 1]; the published weights of Swin and ResNet expect them."""


def image_encoder(config: EncoderConfig) -> tuple[Swin | ResNet | SmallConv, FpnNeck]:
    """A backbone and its neck; `neck(backbone(images))` are the features.

    They map (N, 3, h, w) to (N, `config.neck_channels`, h', w'), with h' and w' the rounded up h / `config.stride` and
    w / `config.stride`. They come apart because the release keeps them under the names `img_backbone` and `img_neck`.

    Raises:
        ConfigError: the configuration is of none of the three encoders.
    """
    backbone: Swin | ResNet | SmallConv
    if isinstance(config, SwinConfig):
        backbone = Swin(config)
    elif isinstance(config, ResNetConfig):
        backbone = ResNet(config)
    elif isinstance(config, SmallConvConfig):
        backbone = SmallConv(config)
    else:
        raise ConfigError(f"expected a SwinConfig, a ResNetConfig or a SmallConvConfig, found {config!r}")
    # the small encoder saves time where most of its neck's work would be
    first_kernel = 1 if isinstance(config, SmallConvConfig) else 3
    return backbone, FpnNeck(sum(backbone.out_channels), config.neck_channels, first_kernel=first_kernel)


def normalised(images: Tensor) -> Tensor:
    """RGB images (…, 3, h, w) uint8 as floats: divided by 255, less ImageNet's mean, divided by its deviation.

    Raises:
        ConfigError: the images are not uint8, so that it is not known what was done to them.
    """
    if images.dtype != torch.uint8:
        raise ConfigError(f"images: expected uint8, found {images.dtype}; load them with ImageConfig(dtype='uint8')")
    mean, std = (torch.tensor(three, device=images.device)[:, None, None] for three in (_MEAN, _STD))
    return (images / 255 - mean) / std
