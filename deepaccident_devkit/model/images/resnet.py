"""ResNet-18 and ResNet-50 as image backbones, with the parameter names and shapes of torchvision's models."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Final, Literal, get_args

from torch import Tensor, nn

from deepaccident_devkit.errors import ConfigError

Depth = Literal[18, 50]
_BLOCKS: Final = {18: (2, 2, 2, 2), 50: (3, 4, 6, 3)}
_WIDTHS: Final = (64, 128, 256, 512)


@dataclass(frozen=True, slots=True, kw_only=True)
class ResNetConfig:
    """Which ResNet.

    Attributes:
        depth: 18 or 50 layers.
        neck_channels: of the features.
        stride: pixels of the image a step of the features.
    """

    depth: Depth = 18
    neck_channels: int = 512
    stride: ClassVar[int] = 16

    def __post_init__(self) -> None:
        """Check the depth; raises ConfigError."""
        if self.depth not in get_args(Depth):
            raise ConfigError(f"depth: expected {' or '.join(map(str, get_args(Depth)))}, found {self.depth!r}")


class ResNet(nn.Module):
    """He et al., Deep residual learning, without the classifier; bottlenecks have their stride in the 3×3 layer.

    A state dict of torchvision's fits with `strict=False`: only `fc.weight` and `fc.bias` are left over.

    Attributes:
        out_channels: of the two maps.
    """

    def __init__(self, config: ResNetConfig) -> None:
        super().__init__()
        block = BasicBlock if config.depth == 18 else Bottleneck
        self.out_channels = (_WIDTHS[2] * block.expansion, _WIDTHS[3] * block.expansion)
        self.conv1 = nn.Conv2d(3, 64, 7, 2, padding=3, bias=False)
        self.bn1 = nn.BatchNorm2d(64)
        self.relu = nn.ReLU(inplace=True)
        self.maxpool = nn.MaxPool2d(3, 2, padding=1)
        first, second, third, fourth = _BLOCKS[config.depth]
        self.layer1 = _layer(block, 64, _WIDTHS[0], first, stride=1)
        self.layer2 = _layer(block, _WIDTHS[0] * block.expansion, _WIDTHS[1], second)
        self.layer3 = _layer(block, _WIDTHS[1] * block.expansion, _WIDTHS[2], third)
        self.layer4 = _layer(block, _WIDTHS[2] * block.expansion, _WIDTHS[3], fourth)
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Images (N, 3, h, w) → maps at 1/16 and 1/32 of their resolution, sizes rounded up."""
        features = self.maxpool(self.relu(self.bn1(self.conv1(images))))
        fine = self.layer3(self.layer2(self.layer1(features)))
        return fine, self.layer4(fine)


class BasicBlock(nn.Module):
    """Two 3×3 convolutions beside a shortcut."""

    expansion: ClassVar[int] = 1

    def __init__(self, in_channels: int, width: int, *, stride: int = 1) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(in_channels, width, 3, stride, padding=1, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = nn.Conv2d(width, width, 3, padding=1, bias=False)
        self.bn2 = nn.BatchNorm2d(width)
        self.relu = nn.ReLU(inplace=True)
        self.downsample = _shortcut(in_channels, width, stride)

    def forward(self, features: Tensor) -> Tensor:
        """Features (N, C, h, w) → (N, width, h / stride, w / stride)."""
        inner = self.relu(self.bn1(self.conv1(features)))
        return self.relu(self.bn2(self.conv2(inner)) + _carried(self.downsample, features))


class Bottleneck(nn.Module):
    """Convolutions of 1×1, 3×3 and 1×1, the last with four times the width, beside a shortcut."""

    expansion: ClassVar[int] = 4

    def __init__(self, in_channels: int, width: int, *, stride: int = 1) -> None:
        super().__init__()
        out_channels = width * self.expansion
        self.conv1 = nn.Conv2d(in_channels, width, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = nn.Conv2d(width, width, 3, stride, padding=1, bias=False)
        self.bn2 = nn.BatchNorm2d(width)
        self.conv3 = nn.Conv2d(width, out_channels, 1, bias=False)
        self.bn3 = nn.BatchNorm2d(out_channels)
        self.relu = nn.ReLU(inplace=True)
        self.downsample = _shortcut(in_channels, out_channels, stride)

    def forward(self, features: Tensor) -> Tensor:
        """Features (N, C, h, w) → (N, 4 · width, h / stride, w / stride)."""
        inner = self.relu(self.bn1(self.conv1(features)))
        inner = self.relu(self.bn2(self.conv2(inner)))
        return self.relu(self.bn3(self.conv3(inner)) + _carried(self.downsample, features))


def _layer(
    block: type[BasicBlock | Bottleneck], in_channels: int, width: int, count: int, *, stride: int = 2
) -> nn.Sequential:
    """Blocks of one resolution; the first has the stride."""
    others = [block(width * block.expansion, width) for _ in range(count - 1)]
    return nn.Sequential(block(in_channels, width, stride=stride), *others)


def _shortcut(in_channels: int, out_channels: int, stride: int) -> nn.Sequential | None:
    """A projection where the shapes differ."""
    if stride == 1 and in_channels == out_channels:
        return None
    return nn.Sequential(nn.Conv2d(in_channels, out_channels, 1, stride, bias=False), nn.BatchNorm2d(out_channels))


def _carried(shortcut: nn.Sequential | None, features: Tensor) -> Tensor:
    return features if shortcut is None else shortcut(features)
