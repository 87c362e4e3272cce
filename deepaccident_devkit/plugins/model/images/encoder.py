"""The image encoder that a configuration describes, its neck, and a small backbone for CPUs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Final

import torch
from torch import Tensor, nn
from torch.nn import functional

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.plugins.model.images.swin import Swin, SwinConfig

# ImageNet's statistics of R, G, B in [0, 1]; the published weights of Swin expect them.
_IMAGENET_MEAN: Final = (0.485, 0.456, 0.406)
_IMAGENET_STD: Final = (0.229, 0.224, 0.225)


class FpnNeck(nn.Module):
    """Joins a fine and a coarse map (the released FPN_LSS).

    The coarse map is enlarged and concatenated with the fine one, and both go through two
    convolutions.

    Attributes:
        out_channels: Channels of the result.
    """

    def __init__(self, in_channels: int, out_channels: int, *, first_kernel: int = 3) -> None:
        """Build the layers.

        Args:
            in_channels: Channels of both maps together.
            out_channels: Channels of the result.
            first_kernel: Size of the first convolution's kernel, 3 in the release; an odd number.
        """
        super().__init__()
        self.out_channels = out_channels
        layers = nn.Sequential(
            nn.Conv2d(
                in_channels, out_channels, first_kernel, padding=first_kernel // 2, bias=False
            ),
            nn.BatchNorm2d(out_channels),
            nn.ReLU(inplace=True),
            nn.Conv2d(out_channels, out_channels, 3, padding=1, bias=False),
            nn.BatchNorm2d(out_channels),
            nn.ReLU(inplace=True),
        )
        self.up = nn.ModuleDict({"conv": layers})

    def forward(self, maps: tuple[Tensor, Tensor]) -> Tensor:
        """Join the maps (N, C, h', w') and (N, C', h'', w''), the fine one first.

        Return one map (N, `out_channels`, h', w').
        """
        fine, coarse = maps
        enlarged = functional.interpolate(
            coarse, size=fine.shape[-2:], mode="bilinear", align_corners=True
        )
        return self.up["conv"](torch.cat([fine, enlarged], 1))


@dataclass(frozen=True, slots=True, kw_only=True)
class SmallConvConfig:
    """Sizes of the small encoder.

    Attributes:
        widths: Channels at 1/2, 1/4 and 1/8 of the image's resolution.
        branch: Channels at 1/16.
        neck_channels: Channels of the features.
        stride: Pixels of the image per cell of the features.
    """

    widths: tuple[int, int, int] = (16, 24, 32)
    branch: int = 64
    neck_channels: int = 48
    stride: ClassVar[int] = 8

    def __post_init__(self) -> None:
        """Check the number of widths; raises ConfigError."""
        if len(self.widths) != 3:
            raise ConfigError(f"widths: expected three numbers of channels, found {self.widths!r}")


class SmallConv(nn.Module):
    """Convolutions with stride 2, and a residual block at each of the last two resolutions; ours.

    Attributes:
        out_channels: Channels of the two maps.
    """

    def __init__(self, config: SmallConvConfig) -> None:
        super().__init__()
        first, second, third = config.widths
        self.out_channels = (third, config.branch)
        self.fine = nn.Sequential(
            _halved(3, first), _halved(first, second), _halved(second, third), _Residual(third)
        )
        self.coarse = nn.Sequential(_halved(third, config.branch), _Residual(config.branch))

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Encode images (N, 3, h, w) as maps at 1/8 and 1/16 of their resolution, rounded up."""
        fine = self.fine(images)
        return fine, self.coarse(fine)


class _Residual(nn.Module):
    def __init__(self, channels: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            *_convolution(channels, channels),
            nn.ReLU(inplace=True),
            *_convolution(channels, channels),
        )

    def forward(self, features: Tensor) -> Tensor:
        return (features + self.layers(features)).relu()


def _halved(in_channels: int, out_channels: int) -> nn.Sequential:
    return nn.Sequential(*_convolution(in_channels, out_channels, stride=2), nn.ReLU(inplace=True))


def _convolution(
    in_channels: int, out_channels: int, *, stride: int = 1
) -> tuple[nn.Conv2d, nn.BatchNorm2d]:
    convolution = nn.Conv2d(in_channels, out_channels, 3, stride, padding=1, bias=False)
    return convolution, nn.BatchNorm2d(out_channels)


EncoderConfig = SwinConfig | SmallConvConfig


def image_encoder(config: EncoderConfig) -> tuple[Swin | SmallConv, FpnNeck]:
    """Return a backbone and its neck; `neck(backbone(images))` are the features.

    They map (N, 3, h, w) to (N, `config.neck_channels`, h', w'), with h' and w' the rounded up h /
    `config.stride` and w / `config.stride`. They are separate because the release stores them under
    the names `img_backbone` and `img_neck`.

    Raises:
        ConfigError: The configuration belongs to neither encoder.
    """
    if not isinstance(config, EncoderConfig):
        raise ConfigError(f"expected a SwinConfig or a SmallConvConfig, found {config!r}")
    backbone = Swin(config) if isinstance(config, SwinConfig) else SmallConv(config)
    # Most of the small neck's work would be in the first convolution, so its kernel is smaller.
    first_kernel = 1 if isinstance(config, SmallConvConfig) else 3
    in_channels = sum(backbone.out_channels)
    return backbone, FpnNeck(in_channels, config.neck_channels, first_kernel=first_kernel)


def normalised(images: Tensor) -> Tensor:
    """Return RGB images (…, 3, h, w) uint8 as normalised floats.

    They are divided by 255, reduced by ImageNet's mean and divided by its standard deviation.

    Raises:
        ConfigError: The images are not uint8, so it is unknown how they were processed.
    """
    if images.dtype != torch.uint8:
        raise ConfigError(
            f"images: expected uint8, found {images.dtype}; load them with "
            "ImageConfig(dtype='uint8')"
        )
    mean = torch.tensor(_IMAGENET_MEAN, device=images.device)[:, None, None]
    std = torch.tensor(_IMAGENET_STD, device=images.device)[:, None, None]
    return (images / 255 - mean) / std
