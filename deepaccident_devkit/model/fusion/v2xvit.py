"""V2X-ViT's fusion: attention over agents of two kinds in each cell, then over windows of each agent's map.

After Xu et al., V2X-ViT: Vehicle-to-Everything Cooperative Perception with Vision Transformer (ECCV 2022). The
DeepAccident paper names it; the released code has none. Warping and masks, which the original does inside, are done
outside.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.model.fusion.attention import AgentAttention, FeedForward, MultiWindowAttention, PreNorm
from deepaccident_devkit.model.fusion.simple import Fusion, visible
from deepaccident_devkit.support.text import settle_choices


@dataclass(frozen=True, slots=True, kw_only=True)
class V2XViTConfig:
    """Blocks of agent attention, window attention and a feed-forward layer.

    Attributes:
        channels: C.
        depth: how many blocks.
        heads: of the attention over agents.
        windows: rows and columns of the windows of each branch.
        window_heads: heads of each branch.
        dropout: in all three parts of a block.
        delay_rate: places of the sinusoid a step of delay; 2 in the original.
        masked_cells: `hidden`: what the mask hides counts nowhere. `windowed`: no other agent attends to it, but it
            reaches its neighbours through the windows, as in the original.
    """

    channels: int
    depth: int = 3
    heads: int = 4
    windows: tuple[int, ...] = (4, 8, 16)
    window_heads: tuple[int, ...] = (4, 2, 1)
    dropout: float = 0.3
    delay_rate: int = 2
    masked_cells: Literal["hidden", "windowed"] = "hidden"

    def __post_init__(self) -> None:
        """Check the words and that the heads share the channels evenly; raises ConfigError."""
        settle_choices(self, {"masked_cells": ("hidden", "windowed")}, error=ConfigError)
        if len(self.windows) != len(self.window_heads):
            raise ConfigError(
                f"window_heads: expected one number for each of {len(self.windows)} windows, found {self.window_heads}"
            )
        for name, heads in (("heads", self.heads), *(("window_heads", count) for count in self.window_heads)):
            if self.channels % heads:
                raise ConfigError(f"{name}: {heads} do not divide {self.channels} channels; choose a divisor")


class DelayEncoding(nn.Module):
    """A linear layer of a sinusoid of the delay, added to all cells of an agent."""

    def __init__(self, channels: int, delay_rate: int) -> None:
        super().__init__()
        self.channels, self.delay_rate = channels, delay_rate
        self.linear = nn.Linear(channels, channels)

    def forward(self, delay: Tensor) -> Tensor:
        """(B, A) steps → (B, A, C)."""
        return self.linear(sinusoid(self.delay_rate * delay, self.channels).to(self.linear.weight.dtype))


def sinusoid(place: Tensor, channels: int) -> Tensor:
    """(…,) → (…, C) float32: sines and cosines by turns, of wavelengths from 2π to 10000 · 2π places, over √C."""
    rate = torch.arange(0, channels, 2, device=place.device) * (-math.log(10000) / channels)
    angle = place[..., None] * rate.exp()
    return torch.stack([angle.sin(), angle.cos()], -1).flatten(-2)[..., :channels] / math.sqrt(channels)


class Block(nn.Module):
    """Attention over agents, over windows, and a feed-forward layer."""

    def __init__(self, config: V2XViTConfig) -> None:
        super().__init__()
        width = config.channels
        self.agents = PreNorm(width, AgentAttention(width, config.heads, config.dropout))
        self.windows = PreNorm(width, MultiWindowAttention(width, config.windows, config.window_heads, config.dropout))
        self.feed_forward = PreNorm(width, FeedForward(width, width, config.dropout))

    def forward(self, x: Tensor, mask: Tensor, agent_is_infra: Tensor) -> Tensor:
        """Maps (B, A, H, W, C), mask (B, A, H, W) and kinds (B, A) → the same shape as the maps."""
        return self.feed_forward(self.windows(self.agents(x, mask, agent_is_infra)))


class V2XViTFusion(Fusion):
    """The delay's encoding, blocks, and of their result the ego's map."""

    def __init__(self, config: V2XViTConfig) -> None:
        super().__init__()
        self.config = config
        self.delay_encoding = DelayEncoding(config.channels, config.delay_rate)
        self.blocks = nn.ModuleList(Block(config) for _ in range(config.depth))

    def forward(self, x: Tensor, mask: Tensor, agent_is_infra: Tensor, delay: Tensor) -> Tensor:
        """As `Fusion.forward`."""
        tokens = (visible(x, mask) if self.config.masked_cells == "hidden" else x).movedim(2, -1)
        tokens = tokens + self.delay_encoding(delay)[:, :, None, None]
        for block in self.blocks:
            tokens = block(tokens, mask, agent_is_infra)
        return tokens[:, 0].movedim(-1, 1)
