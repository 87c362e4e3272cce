"""The image encoder of a configuration, its neck, and a small backbone for CPUs."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.plugins.model.images.swin import Swin, SwinConfig

# ImageNet's statistics of R, G, B in [0, 1]; the published weights of Swin expect them.
_IMAGENET_MEAN = (0.485, 0.456, 0.406)
_IMAGENET_STD = (0.229, 0.224, 0.225)


class FpnNeck(nn.Module):
    """Neck that merges a fine and a coarse map (the released FPN_LSS).

    The coarse map is enlarged and concatenated with the fine one; two convolutions follow.

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
        padding = first_kernel // 2
        layers = nn.Sequential(
            nn.Conv2d(in_channels, out_channels, first_kernel, padding=padding, bias=False),
            nn.BatchNorm2d(out_channels),
            nn.ReLU(inplace=True),
            nn.Conv2d(out_channels, out_channels, 3, padding=1, bias=False),
            nn.BatchNorm2d(out_channels),
            nn.ReLU(inplace=True),
        )
        self.up = nn.ModuleDict({"conv": layers})

    def forward(self, maps: tuple[Tensor, Tensor]) -> Tensor:
        """Merge the maps (N, C, h', w') and (N, C', h'', w''), the fine one first.

        Return one map (N, `out_channels`, h', w').
        """
        fine, coarse = maps
        enlarged = functional.interpolate(
            coarse, fine.shape[-2:], mode="bilinear", align_corners=True
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
        """Check the number of widths; raise ConfigError if it is wrong."""
        if len(self.widths) != 3:
            raise ConfigError(f"widths: expected three numbers of channels, found {self.widths!r}")


class SmallConv(nn.Module):
    """The devkit's small backbone: convolutions with stride 2, and a residual block for each map.

    Attributes:
        out_channels: Channels of the two maps.
    """

    def __init__(self, config: SmallConvConfig) -> None:
        super().__init__()
        first, second, third = config.widths
        self.out_channels = (third, config.branch)
        self.fine = nn.Sequential(
            _make_halving_layers(3, first),
            _make_halving_layers(first, second),
            _make_halving_layers(second, third),
            _Residual(third),
        )
        halving = _make_halving_layers(third, config.branch)
        self.coarse = nn.Sequential(halving, _Residual(config.branch))

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Encode images (N, 3, h, w) as maps at 1/8 and 1/16 of their resolution, rounded up."""
        fine = self.fine(images)
        return fine, self.coarse(fine)


class _Residual(nn.Module):
    """Two convolutions with a ReLU between them, added to their input."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            *_make_convolution(channels, channels),
            nn.ReLU(inplace=True),
            *_make_convolution(channels, channels),
        )

    def forward(self, features: Tensor) -> Tensor:
        """Transform features (N, C, H, W); return the same shape."""
        return (features + self.layers(features)).relu()


def _make_halving_layers(in_channels: int, out_channels: int) -> nn.Sequential:
    """Return the layers that halve the resolution."""
    layers = _make_convolution(in_channels, out_channels, stride=2)
    return nn.Sequential(*layers, nn.ReLU(inplace=True))


def _make_convolution(
    in_channels: int, out_channels: int, *, stride: int = 1
) -> tuple[nn.Conv2d, nn.BatchNorm2d]:
    """Return a 3 × 3 convolution and its batch norm."""
    convolution = nn.Conv2d(in_channels, out_channels, 3, stride, padding=1, bias=False)
    return convolution, nn.BatchNorm2d(out_channels)


EncoderConfig = SwinConfig | SmallConvConfig


def image_encoder(config: EncoderConfig) -> tuple[Swin | SmallConv, FpnNeck]:
    """Build a backbone and its neck; `neck(backbone(images))` are the features.

    Together they map (N, 3, h, w) to (N, `config.neck_channels`, h', w'), where h' and w' are h /
    `config.stride` and w / `config.stride`, rounded up. They are separate modules because the
    release stores them under the names `img_backbone` and `img_neck`.

    Raises:
        ConfigError: The configuration is for neither of the two encoders.
    """
    if not isinstance(config, EncoderConfig):
        raise ConfigError(f"expected a SwinConfig or a SmallConvConfig, found {config!r}")
    backbone: Swin | SmallConv
    if isinstance(config, SwinConfig):
        backbone = Swin(config)
        first_kernel = 3
    else:
        backbone = SmallConv(config)
        # Most of the small neck's computation would be in the first convolution, so its kernel
        # is small.
        first_kernel = 1
    in_channels = sum(backbone.out_channels)
    return backbone, FpnNeck(in_channels, config.neck_channels, first_kernel=first_kernel)


def normalise_images(images: Tensor) -> Tensor:
    """Return RGB images (…, 3, h, w) uint8 as normalised floats.

    Values are divided by 255; then ImageNet's mean is subtracted, and the result is divided by
    ImageNet's standard deviation.

    Raises:
        ConfigError: The images are not uint8, so they may already have been normalised.
    """
    if images.dtype != torch.uint8:
        raise ConfigError(
            f"images: expected uint8, found {images.dtype}; load them with "
            "ImageConfig(dtype='uint8')"
        )
    mean = torch.tensor(_IMAGENET_MEAN, device=images.device)[:, None, None]
    std = torch.tensor(_IMAGENET_STD, device=images.device)[:, None, None]
    return (images / 255 - mean) / std
