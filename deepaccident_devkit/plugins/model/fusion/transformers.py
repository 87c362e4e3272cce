"""Fusion by attention over all agents' cells: CoBEVT, and V2X-ViT with agents of two kinds.

After Xu et al., CoBEVT: Cooperative Bird's Eye View Semantic Segmentation with Sparse Transformers
(CoRL 2022), fused axial attention, and V2X-ViT: Vehicle-to-Everything Cooperative Perception with
Vision Transformer (ECCV 2022). The DeepAccident paper names them; the released code has neither.
Maps are warped and masked by the caller.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.plugins.model.fusion.attention import (
    AgentAttention,
    FeedForward,
    MultiWindowAttention,
    PreNorm,
    Windows,
    attention,
)
from deepaccident_devkit.plugins.model.fusion.simple import Fusion, masked_mean, visible
from deepaccident_devkit.plugins.model.images.swin import relative_positions
from deepaccident_devkit.support.text import settle_choices

# Relations of two agents: an agent and itself, the ego and a partner, two partners.
_RELATION_COUNT = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class CobevtConfig:
    """Sizes and rules of fused axial attention.

    Attributes:
        channels: Number C of channels.
        depth: Number of layers of window attention and grid attention.
        window: Rows and columns of a window.
        heads: Heads of each attention; C / 32 in the original.
        expansion: Hidden channels of the feed-forward layers, in C.
        dropout: Dropout after attention and in the feed-forward layers.
        agents: Maximum number of slots, only for `agent_relation="slots"`.
        agent_relation: The relation of two agents that the learned bias depends on. `classes`:
            itself, the ego and a partner, two partners. `slots`: the difference of their slots, as
            in the original, so that the partners' order matters.
        masked_cells: Treatment of cells that the mask hides. `hidden`: they have no effect.
            `averaged`: nobody attends to them, but they are in the final mean over the agents, as
            in the original.
    """

    channels: int
    depth: int = 3
    window: int = 8
    heads: int = 2
    expansion: int = 2
    dropout: float = 0.1
    agents: int = 5
    agent_relation: Literal["classes", "slots"] = "classes"
    masked_cells: Literal["hidden", "averaged"] = "hidden"

    def __post_init__(self) -> None:
        """Check the words and that the heads share the channels evenly; raises ConfigError."""
        words = {"agent_relation": ("classes", "slots"), "masked_cells": ("hidden", "averaged")}
        settle_choices(self, words, error=ConfigError)
        if self.channels % self.heads:
            raise ConfigError(
                f"heads: {self.heads} do not divide {self.channels} channels; choose a divisor"
            )


class AgentWindowAttention(nn.Module):
    """Attention among the cells of all agents within each window."""

    positions: Tensor

    def __init__(self, config: CobevtConfig, windows: Windows) -> None:
        super().__init__()
        self.config, self.windows = config, windows
        relations = _RELATION_COUNT if config.agent_relation == "classes" else 2 * config.agents - 1
        self.to_qkv = nn.Linear(config.channels, 3 * config.channels, bias=False)
        self.to_out = nn.Sequential(
            nn.Linear(config.channels, config.channels, bias=False), nn.Dropout(config.dropout)
        )
        self.bias_table = nn.Parameter(
            torch.empty(relations * (2 * windows.size - 1) ** 2, config.heads)
        )
        nn.init.trunc_normal_(self.bias_table, std=0.02)
        self.register_buffer("positions", relative_positions(windows.size), persistent=False)

    def forward(self, x: Tensor, mask: Tensor) -> Tensor:
        """Attend in maps (B, A, H, W, C); return the same shape.

        Only cells of the mask (B, A, H, W) are attended to.
        """
        qkv = self.windows.split(self.to_qkv(x))
        bias = self.bias(x.shape[1])
        attended = attention(qkv, self.config.heads, bias, self.windows.split_mask(mask))
        return self.windows.join(self.to_out(attended), x.shape[:4])

    def bias(self, agents: int) -> Tensor:
        """Return the bias by agent and cell of query and key, (heads, A · size², A · size²).

        Raises ConfigError if there are too many agents.
        """
        relation = self._relations(agents)[:, None, :, None]
        positions_per_relation = (2 * self.windows.size - 1) ** 2
        index = relation * positions_per_relation + self.positions[None, :, None, :]
        return self.bias_table[index.flatten(2, 3).flatten(0, 1)].permute(2, 0, 1)

    def _relations(self, agents: int) -> Tensor:
        """Return the number of the relation of a query's agent and a key's agent, (A, A)."""
        slots = torch.arange(agents, device=self.positions.device)
        difference = slots[:, None] - slots[None, :]
        if self.config.agent_relation == "slots":
            if agents > self.config.agents:
                raise ConfigError(
                    f"agents: the bias is for {self.config.agents} slots, found {agents}; raise "
                    "CobevtConfig.agents"
                )
            return difference + self.config.agents - 1
        with_ego = (slots[:, None] == 0) | (slots[None, :] == 0)
        return torch.where(difference == 0, 0, torch.where(with_ego, 1, 2))


class AxialLayer(nn.Module):
    """Attention in windows and over the complete map, each followed by a feed-forward layer."""

    def __init__(self, config: CobevtConfig) -> None:
        super().__init__()
        width, hidden = config.channels, config.expansion * config.channels
        self.window_attention = PreNorm(
            width, AgentWindowAttention(config, Windows(size=config.window))
        )
        self.window_feed_forward = PreNorm(width, FeedForward(width, hidden, config.dropout))
        self.grid_attention = PreNorm(
            width, AgentWindowAttention(config, Windows(size=config.window, strided=True))
        )
        self.grid_feed_forward = PreNorm(width, FeedForward(width, hidden, config.dropout))

    def forward(self, x: Tensor, mask: Tensor) -> Tensor:
        """Attend in maps (B, A, H, W, C) with mask (B, A, H, W); return the same shape."""
        x = self.window_feed_forward(self.window_attention(x, mask))
        return self.grid_feed_forward(self.grid_attention(x, mask))


class CobevtFusion(Fusion):
    """Layers of fused axial attention, the mean over agents, and a linear layer."""

    def __init__(self, config: CobevtConfig) -> None:
        super().__init__()
        self.config = config
        self.layers = nn.ModuleList(AxialLayer(config) for _ in range(config.depth))
        self.head = nn.Sequential(
            nn.LayerNorm(config.channels), nn.Linear(config.channels, config.channels)
        )

    def forward(self, x: Tensor, mask: Tensor, agent_is_infra: Tensor, delay: Tensor) -> Tensor:  # noqa: ARG002
        """Fuse as `Fusion.forward`; kinds of agents and delays have no effect.

        Raises ConfigError if there are more agents than slots.
        """
        hides_masked = self.config.masked_cells == "hidden"
        tokens = (visible(x, mask) if hides_masked else x).movedim(2, -1)
        for layer in self.layers:
            tokens = layer(tokens, mask)
        maps = tokens.movedim(-1, 2)
        pooled = masked_mean(maps, mask) if hides_masked else maps.mean(1)
        return self.head(pooled.movedim(1, -1)).movedim(-1, 1)


@dataclass(frozen=True, slots=True, kw_only=True)
class V2XViTConfig:
    """Sizes and rules of blocks of agent attention, window attention and a feed-forward layer.

    Attributes:
        channels: Number C of channels.
        depth: Number of blocks.
        heads: Heads of the attention over agents.
        windows: Rows and columns of the windows of each branch.
        window_heads: Heads of each branch.
        dropout: Dropout in all three parts of a block.
        delay_rate: Positions of the sinusoid per step of delay; 2 in the original.
        masked_cells: Treatment of cells that the mask hides. `hidden`: they have no effect.
            `windowed`: no other agent attends to them, but they reach their neighbours through the
            windows, as in the original.
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
                f"window_heads: expected one number for each of {len(self.windows)} windows, found "
                f"{self.window_heads}"
            )
        numbers_of_heads = [("heads", self.heads)]
        numbers_of_heads += [("window_heads", count) for count in self.window_heads]
        for name, heads in numbers_of_heads:
            if self.channels % heads:
                raise ConfigError(
                    f"{name}: {heads} do not divide {self.channels} channels; choose a divisor"
                )


class DelayEncoding(nn.Module):
    """A linear layer of a sinusoid of the delay, added to all cells of an agent."""

    def __init__(self, channels: int, delay_rate: int) -> None:
        super().__init__()
        self.channels, self.delay_rate = channels, delay_rate
        self.linear = nn.Linear(channels, channels)

    def forward(self, delay: Tensor) -> Tensor:
        """Return the encoding (B, A, C) of delays (B, A) in steps."""
        return self.linear(
            sinusoid(self.delay_rate * delay, self.channels).to(self.linear.weight.dtype)
        )


def sinusoid(position: Tensor, channels: int) -> Tensor:
    """Return sines and cosines of positions (…,), alternating and divided by √C, (…, C) float32.

    Wavelengths are from 2π to 10000 · 2π positions.
    """
    exponents = torch.arange(0, channels, 2, device=position.device) * (-math.log(10000) / channels)
    angle = position[..., None] * exponents.exp()
    waves = torch.stack([angle.sin(), angle.cos()], -1).flatten(-2)
    return waves[..., :channels] / math.sqrt(channels)


class _TransformerBlock(nn.Module):
    """Attention over agents, over windows, and a feed-forward layer."""

    def __init__(self, config: V2XViTConfig) -> None:
        super().__init__()
        width = config.channels
        self.agents = PreNorm(width, AgentAttention(width, config.heads, config.dropout))
        self.windows = PreNorm(
            width, MultiWindowAttention(width, config.windows, config.window_heads, config.dropout)
        )
        self.feed_forward = PreNorm(width, FeedForward(width, width, config.dropout))

    def forward(self, x: Tensor, mask: Tensor, agent_is_infra: Tensor) -> Tensor:
        """Attend in maps (B, A, H, W, C); return the same shape.

        The mask has shape (B, A, H, W), the kinds (B, A).
        """
        return self.feed_forward(self.windows(self.agents(x, mask, agent_is_infra)))


class V2XViTFusion(Fusion):
    """The delay's encoding and blocks; the result is the ego's map."""

    def __init__(self, config: V2XViTConfig) -> None:
        super().__init__()
        self.config = config
        self.delay_encoding = DelayEncoding(config.channels, config.delay_rate)
        self.blocks = nn.ModuleList(_TransformerBlock(config) for _ in range(config.depth))

    def forward(self, x: Tensor, mask: Tensor, agent_is_infra: Tensor, delay: Tensor) -> Tensor:
        """Fuse as `Fusion.forward`."""
        hides_masked = self.config.masked_cells == "hidden"
        tokens = (visible(x, mask) if hides_masked else x).movedim(2, -1)
        tokens = tokens + self.delay_encoding(delay)[:, :, None, None]
        for block in self.blocks:
            tokens = block(tokens, mask, agent_is_infra)
        return tokens[:, 0].movedim(-1, 1)
