"""`FpnNeck`: a fine and a coarse feature map → one map of the fine one's size."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional


class FpnNeck(nn.Module):
    """The coarse map is enlarged, set beside the fine one, and both go through two convolutions (released FPN_LSS).

    Attributes:
        out_channels: of the result.
    """

    def __init__(self, in_channels: int, out_channels: int, *, first_kernel: int = 3) -> None:
        """Make the layers.

        Args:
            in_channels: of both maps together.
            out_channels: of the result.
            first_kernel: size of the first convolution's kernel, 3 in the release; an odd number.
        """
        super().__init__()
        self.out_channels = out_channels
        layers = nn.Sequential(
            nn.Conv2d(in_channels, out_channels, first_kernel, padding=first_kernel // 2, bias=False),
            nn.BatchNorm2d(out_channels),
            nn.ReLU(inplace=True),
            nn.Conv2d(out_channels, out_channels, 3, padding=1, bias=False),
            nn.BatchNorm2d(out_channels),
            nn.ReLU(inplace=True),
        )
        self.up = nn.ModuleDict({"conv": layers})

    def forward(self, maps: tuple[Tensor, Tensor]) -> Tensor:
        """The maps (N, C, h', w') and (N, C', h'', w''), the fine one first, as one map (N, `out_channels`, h', w')."""
        fine, coarse = maps
        enlarged = functional.interpolate(coarse, size=fine.shape[-2:], mode="bilinear", align_corners=True)
        return self.up["conv"](torch.cat([fine, enlarged], 1))
