"""3D convolution blocks over a sequence of BEV maps (B, C, T, H, W), causal: no step sees a later one.

The released TemporalBlock and Bottleneck3D, which it has from FIERY. The sequence is frames in the temporal model and
agents in the released fusion's unused part. Attributes have the names of the released state dict.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional


class ConvBnRelu3d(nn.Module):
    """A convolution without bias, batch norm and ReLU; keeps T, H and W.

    Args:
        in_channels: C of the input.
        out_channels: C of the output.
        kernel: steps, rows, columns; rows and columns odd.
    """

    def __init__(self, in_channels: int, out_channels: int, kernel: tuple[int, int, int] = (1, 1, 1)) -> None:
        super().__init__()
        padding = (0, kernel[1] // 2, kernel[2] // 2)
        self.conv = nn.Conv3d(in_channels, out_channels, kernel, padding=padding, bias=False)
        self.norm = nn.BatchNorm3d(out_channels)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, T, H, W) → (B, C', T, H, W); the steps before the first are zeros."""
        earlier = self.conv.kernel_size[0] - 1
        if earlier:
            x = functional.pad(x, (0, 0, 0, 0, earlier, 0))
        return functional.relu(self.norm(self.conv(x)))


class PooledStep(nn.Module):
    """The mean over the map and over each step and the one before, through a 1×1×1 convolution; in every cell."""

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        self.conv_bn_relu = ConvBnRelu3d(in_channels, out_channels)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, T, H, W) → (B, C', T, H, W); the first step is its own mean.

        As in the released code a further step, the last one's own mean, counts in the batch statistics.
        """
        means = x.mean((-2, -1), keepdim=True)
        pairs = torch.cat([means[:, :, :1], (means[:, :, 1:] + means[:, :, :-1]) / 2, means[:, :, -1:]], 2)
        return self.conv_bn_relu(pairs)[:, :, :-1].expand(-1, -1, -1, *x.shape[-2:])


class PyramidPooling(nn.Module):
    """The released pyramid of one level, the whole map."""

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        self.features = nn.ModuleList([PooledStep(in_channels, out_channels)])

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, T, H, W) → (B, C', T, H, W)."""
        return torch.cat([level(x) for level in self.features], 1)


class TemporalBlock(nn.Module):
    """Three convolution paths and a pooled one over a step and the one before, added to the input."""

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        half, third = in_channels // 2, in_channels // 3
        self.convolution_paths = nn.ModuleList(
            [
                nn.Sequential(ConvBnRelu3d(in_channels, half), ConvBnRelu3d(half, half, (2, 3, 3))),
                nn.Sequential(ConvBnRelu3d(in_channels, half), ConvBnRelu3d(half, half, (1, 3, 3))),
                ConvBnRelu3d(in_channels, half),
            ]
        )
        self.pyramid_pooling = PyramidPooling(in_channels, third)
        self.aggregation = nn.Sequential(ConvBnRelu3d(3 * half + third, out_channels))
        self.projection = (
            nn.Identity()
            if in_channels == out_channels
            else nn.Sequential(nn.Conv3d(in_channels, out_channels, 1, bias=False), nn.BatchNorm3d(out_channels))
        )

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, T, H, W) → (B, C', T, H, W)."""
        paths = [path(x) for path in self.convolution_paths]
        return self.projection(x) + self.aggregation(torch.cat([*paths, self.pyramid_pooling(x)], 1))


class Bottleneck3d(nn.Module):
    """1×1×1 to half the channels, 1×3×3, 1×1×1 back, added to the input."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        half = channels // 2
        self.layers = nn.Sequential()
        self.layers.add_module("conv_down_project", ConvBnRelu3d(channels, half))
        self.layers.add_module("conv", ConvBnRelu3d(half, half, (1, 3, 3)))
        self.layers.add_module("conv_up_project", ConvBnRelu3d(half, channels))

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, T, H, W) → the same shape."""
        return x + self.layers(x)
