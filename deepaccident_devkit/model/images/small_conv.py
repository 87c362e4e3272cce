"""`SmallConv`: an image backbone small enough to be trained on a CPU, of 0.1 million weights."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor, nn

from deepaccident_devkit.errors import ConfigError


@dataclass(frozen=True, slots=True, kw_only=True)
class SmallConvConfig:
    """Sizes of the small encoder.

    Attributes:
        widths: channels at 1/2, 1/4 and 1/8 of the image's resolution.
        branch: channels at 1/16.
        neck_channels: of the features.
        stride: pixels of the image a step of the features.
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
        out_channels: of the two maps.
    """

    def __init__(self, config: SmallConvConfig) -> None:
        super().__init__()
        first, second, third = config.widths
        self.out_channels = (third, config.branch)
        self.fine = nn.Sequential(_halved(3, first), _halved(first, second), _halved(second, third), _Residual(third))
        self.coarse = nn.Sequential(_halved(third, config.branch), _Residual(config.branch))

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Images (N, 3, h, w) → maps at 1/8 and 1/16 of their resolution, sizes rounded up."""
        fine = self.fine(images)
        return fine, self.coarse(fine)


class _Residual(nn.Module):
    def __init__(self, channels: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            *_convolution(channels, channels), nn.ReLU(inplace=True), *_convolution(channels, channels)
        )

    def forward(self, features: Tensor) -> Tensor:
        return (features + self.layers(features)).relu()


def _halved(in_channels: int, out_channels: int) -> nn.Sequential:
    return nn.Sequential(*_convolution(in_channels, out_channels, stride=2), nn.ReLU(inplace=True))


def _convolution(in_channels: int, out_channels: int, *, stride: int = 1) -> tuple[nn.Conv2d, nn.BatchNorm2d]:
    convolution = nn.Conv2d(in_channels, out_channels, 3, stride, padding=1, bias=False)
    return convolution, nn.BatchNorm2d(out_channels)
