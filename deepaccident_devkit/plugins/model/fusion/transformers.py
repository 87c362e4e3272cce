"""Fusion by attention over all agents' cells: CoBEVT, and V2X-ViT with agents of two kinds.

After Xu et al., CoBEVT: Cooperative Bird's Eye View Semantic Segmentation with Sparse Transformers
(CoRL 2022), fused axial attention, and V2X-ViT: Vehicle-to-Everything Cooperative Perception with
Vision Transformer (ECCV 2022). The DeepAccident paper lists both; the released code contains
neither. The caller warps and masks the maps.
"""

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
        expansion: Hidden channels of the feed-forward layers, in multiples of C.
        dropout: Dropout after attention and in the feed-forward layers.
        agents: Maximum number of slots; used only with `agent_relation="slots"`.
        agent_relation: Relation between two agents on which the learned bias depends. `classes`: an
            agent and itself, the ego and a partner, or two partners. `slots`: the difference
            between their slots, as in the original, so that the partners' order matters.
        masked_cells: Treatment of cells that the mask hides. `hidden`: they have no effect.
            `averaged`: no cell attends to them, but they are included in the final mean over the
                agents, as in the original.
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
        """Check the values, and that heads divide channels evenly; raise ConfigError otherwise."""
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
        self.config = config
        self.windows = windows
        width = config.channels
        num_relations = _RELATION_COUNT
        if config.agent_relation == "slots":
            num_relations = 2 * config.agents - 1
        self.to_qkv = nn.Linear(width, 3 * width, bias=False)
        output_layer = nn.Linear(width, width, bias=False)
        self.to_out = nn.Sequential(output_layer, nn.Dropout(config.dropout))
        positions_per_relation = (2 * windows.size - 1) ** 2
        bias_table = torch.empty(num_relations * positions_per_relation, config.heads)
        self.bias_table = nn.Parameter(bias_table)
        nn.init.trunc_normal_(self.bias_table, std=0.02)
        self.register_buffer("positions", relative_positions(windows.size), persistent=False)

    def forward(self, x: Tensor, mask: Tensor) -> Tensor:
        """Attend in maps (B, A, H, W, C); return the same shape.

        Only cells that the mask (B, A, H, W) shows are attended to.
        """
        qkv = self.windows.split(self.to_qkv(x))
        bias = self.bias(x.shape[1])
        keys = self.windows.split_mask(mask)
        attended = attention(qkv, self.config.heads, bias, keys)
        return self.windows.join(self.to_out(attended), x.shape[:4])

    def bias(self, agents: int) -> Tensor:
        """Return the bias between query and key (agent and cell), (heads, A · size², A · size²).

        Raises ConfigError if there are too many agents.
        """
        relation = self._relate_agents(agents)[:, None, :, None]
        positions_per_relation = (2 * self.windows.size - 1) ** 2
        index = relation * positions_per_relation + self.positions[None, :, None, :]
        flat_index = index.flatten(2, 3).flatten(0, 1)
        return self.bias_table[flat_index].permute(2, 0, 1)

    def _relate_agents(self, agents: int) -> Tensor:
        """Return the index of the relation between each pair of agents, (A, A)."""
        slots = torch.arange(agents, device=self.positions.device)
        difference = slots[:, None] - slots[None, :]
        if self.config.agent_relation == "slots":
            if agents > self.config.agents:
                raise ConfigError(
                    f"agents: the bias is for {self.config.agents} slots, found {agents}; raise "
                    "CobevtConfig.agents"
                )
            return difference + self.config.agents - 1
        has_ego = (slots[:, None] == 0) | (slots[None, :] == 0)
        relations = torch.where(has_ego, 1, 2)
        return relations.masked_fill(difference == 0, 0)


class AxialLayer(nn.Module):
    """Attention in windows and over the complete map, each followed by a feed-forward layer."""

    def __init__(self, config: CobevtConfig) -> None:
        super().__init__()
        width = config.channels
        hidden = config.expansion * width
        windows = Windows(size=config.window)
        grid = Windows(size=config.window, strided=True)
        self.window_attention = PreNorm(width, AgentWindowAttention(config, windows))
        self.window_feed_forward = PreNorm(width, FeedForward(width, hidden, config.dropout))
        self.grid_attention = PreNorm(width, AgentWindowAttention(config, grid))
        self.grid_feed_forward = PreNorm(width, FeedForward(width, hidden, config.dropout))

    def forward(self, x: Tensor, mask: Tensor) -> Tensor:
        """Attend in maps (B, A, H, W, C) with mask (B, A, H, W); return the same shape."""
        x = self.window_attention(x, mask)
        x = self.window_feed_forward(x)
        x = self.grid_attention(x, mask)
        return self.grid_feed_forward(x)


class CobevtFusion(Fusion):
    """Layers of fused axial attention, the mean over agents, and a linear layer."""

    def __init__(self, config: CobevtConfig) -> None:
        super().__init__()
        self.config = config
        width = config.channels
        self.layers = nn.ModuleList(AxialLayer(config) for _ in range(config.depth))
        self.head = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, width))

    def forward(self, x: Tensor, mask: Tensor, agent_is_infra: Tensor, delay: Tensor) -> Tensor:  # noqa: ARG002
        """Fuse as `Fusion.forward`; kinds of agents and delays have no effect.

        Raises ConfigError if there are more agents than slots.
        """
        hides_masked = self.config.masked_cells == "hidden"
        if hides_masked:
            x = visible(x, mask)
        tokens = x.movedim(2, -1)
        for layer in self.layers:
            tokens = layer(tokens, mask)
        maps = tokens.movedim(-1, 2)
        if hides_masked:
            mean = masked_mean(maps, mask)
        else:
            mean = maps.mean(1)
        return self.head(mean.movedim(1, -1)).movedim(-1, 1)


@dataclass(frozen=True, slots=True, kw_only=True)
class V2XViTConfig:
    """Sizes and rules of blocks of agent attention, window attention and a feed-forward layer.

    Attributes:
        channels: Number C of channels.
        depth: Number of blocks.
        heads: Heads of the attention over agents.
        windows: Rows and columns of the windows of each branch.
        window_heads: Heads of each branch.
        dropout: Dropout probability in all three parts of a block.
        delay_rate: Positions along the sinusoid per step of delay; 2 in the original.
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
        """Check the values, and that heads divide channels evenly; raise ConfigError otherwise."""
        settle_choices(self, {"masked_cells": ("hidden", "windowed")}, error=ConfigError)
        if len(self.windows) != len(self.window_heads):
            raise ConfigError(
                f"window_heads: expected one number for each of {len(self.windows)} windows, found "
                f"{self.window_heads}"
            )
        head_counts = [("heads", self.heads)]
        for count in self.window_heads:
            head_counts.append(("window_heads", count))
        for name, heads in head_counts:
            if self.channels % heads:
                raise ConfigError(
                    f"{name}: {heads} do not divide {self.channels} channels; choose a divisor"
                )


class DelayEncoding(nn.Module):
    """A linear layer of the delay's sinusoidal encoding, added to all cells of an agent."""

    def __init__(self, channels: int, delay_rate: int) -> None:
        super().__init__()
        self.channels = channels
        self.delay_rate = delay_rate
        self.linear = nn.Linear(channels, channels)

    def forward(self, delay: Tensor) -> Tensor:
        """Return the encoding (B, A, C) of delays (B, A) in steps."""
        encoding = sinusoid(self.delay_rate * delay, self.channels)
        return self.linear(encoding.to(self.linear.weight.dtype))


def sinusoid(position: Tensor, channels: int) -> Tensor:
    """Return sines and cosines of positions (…,), alternating and divided by √C, (…, C) float32.

    Wavelengths are from 2π to 10000 · 2π positions.
    """
    log_step = -math.log(10000) / channels
    exponents = torch.arange(0, channels, 2, device=position.device) * log_step
    angle = position[..., None] * exponents.exp()
    pairs = torch.stack([angle.sin(), angle.cos()], -1)
    waves = pairs.flatten(-2)[..., :channels]
    return waves / math.sqrt(channels)


class _TransformerBlock(nn.Module):
    """Attention over agents, attention over windows, and a feed-forward layer."""

    def __init__(self, config: V2XViTConfig) -> None:
        super().__init__()
        width = config.channels
        self.agents = PreNorm(width, AgentAttention(width, config.heads, config.dropout))
        windows = MultiWindowAttention(width, config.windows, config.window_heads, config.dropout)
        self.windows = PreNorm(width, windows)
        self.feed_forward = PreNorm(width, FeedForward(width, width, config.dropout))

    def forward(self, x: Tensor, mask: Tensor, agent_is_infra: Tensor) -> Tensor:
        """Attend in maps (B, A, H, W, C); return the same shape.

        The mask has shape (B, A, H, W), the kinds (B, A).
        """
        x = self.agents(x, mask, agent_is_infra)
        x = self.windows(x)
        return self.feed_forward(x)


class V2XViTFusion(Fusion):
    """V2X-ViT: an encoding of the delay, then its blocks; the result is the ego's map."""

    def __init__(self, config: V2XViTConfig) -> None:
        super().__init__()
        self.config = config
        self.delay_encoding = DelayEncoding(config.channels, config.delay_rate)
        self.blocks = nn.ModuleList(_TransformerBlock(config) for _ in range(config.depth))

    def forward(self, x: Tensor, mask: Tensor, agent_is_infra: Tensor, delay: Tensor) -> Tensor:
        """Fuse as described for `Fusion.forward`."""
        if self.config.masked_cells == "hidden":
            x = visible(x, mask)
        tokens = x.movedim(2, -1)
        tokens = tokens + self.delay_encoding(delay)[:, :, None, None]
        for block in self.blocks:
            tokens = block(tokens, mask, agent_is_infra)
        return tokens[:, 0].movedim(-1, 1)
