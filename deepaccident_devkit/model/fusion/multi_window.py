"""V2X-ViT's attention in windows of several sizes, each agent's map for itself."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from deepaccident_devkit.model.fusion.transformer import attention
from deepaccident_devkit.model.fusion.windows import Windows, relative_positions


class WindowAttention(nn.Module):
    """Attention among the cells of a window of one agent's map; the relative bias is the same for all heads."""

    positions: Tensor

    def __init__(self, channels: int, windows: Windows, heads: int, dropout: float) -> None:
        super().__init__()
        self.windows, self.heads = windows, heads
        self.to_qkv = nn.Linear(channels, 3 * channels, bias=False)
        self.to_out = nn.Sequential(nn.Linear(channels, channels), nn.Dropout(dropout))
        span = 2 * windows.size - 1
        self.pos_embedding = nn.Parameter(torch.randn(span, span))
        # the original's bias goes by key − query
        self.register_buffer("positions", relative_positions(windows.size).T.contiguous(), persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        """Maps (M, 1, H, W, C) → the same shape; cells added to fill the windows are not attended to."""
        keys = None
        if x.shape[2] % self.windows.size or x.shape[3] % self.windows.size:
            keys = self.windows.split_mask(torch.ones(x.shape[:4], dtype=torch.bool, device=x.device))
        bias = self.pos_embedding.flatten()[self.positions][None]
        attended = attention(self.windows.split(self.to_qkv(x)), self.heads, bias, keys)
        return self.windows.join(self.to_out(attended), x.shape[:4])


class SplitAttention(nn.Module):
    """Σ of branches, each channel with a `softmax` over the branches of weights found in the mean over the map."""

    def __init__(self, channels: int, branches: int) -> None:
        super().__init__()
        self.branches = branches
        self.weigh = nn.Sequential(
            nn.Linear(channels, channels, bias=False),
            nn.LayerNorm(channels),
            nn.ReLU(),
            nn.Linear(channels, branches * channels, bias=False),
        )

    def forward(self, results: list[Tensor]) -> Tensor:
        """As many maps (M, 1, H, W, C) as branches → one."""
        stacked = torch.stack(results, -2)
        score = self.weigh(stacked.sum(-2).mean((2, 3), keepdim=True))
        return (stacked * score.unflatten(-1, (self.branches, -1)).softmax(-2)).sum(-2)


class MultiWindowAttention(nn.Module):
    """Window attention with windows of several sizes, joined by split attention; each agent's map for itself."""

    def __init__(self, channels: int, sizes: Sequence[int], heads: Sequence[int], dropout: float) -> None:
        super().__init__()
        self.branches = nn.ModuleList(
            WindowAttention(channels, Windows(size=size), count, dropout)
            for size, count in zip(sizes, heads, strict=True)
        )
        self.split_attention = SplitAttention(channels, len(sizes))

    def forward(self, x: Tensor) -> Tensor:
        """Maps (B, A, H, W, C) → the same shape."""
        maps = x.flatten(0, 1)[:, None]
        return self.split_attention([branch(maps) for branch in self.branches]).view_as(x)
