"""Attention over agents and over windows of maps: the parts of the transformers CoBEVT and V2X-ViT."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from deepaccident_devkit.plugins.model.images.swin import relative_positions


@dataclass(frozen=True, slots=True, kw_only=True)
class Windows:
    """How maps are divided.

    If the size does not divide H or W, rows below and columns to the right are added; the mask tells them.

    Attributes:
        size: rows and columns of a window.
        strided: a window has cells spread evenly over the whole map (CoBEVT's grid), not neighbours.
    """

    size: int
    strided: bool = False

    def split(self, x: Tensor) -> Tensor:
        """Maps (B, A, H, W, C) → tokens (B · windows, A · size², C), by agent, row and column; added cells are 0."""
        size = self.size
        padded = functional.pad(x, (0, 0, 0, -x.shape[3] % size, 0, -x.shape[2] % size))
        batch, agents, height, width, channels = padded.shape
        down, along = height // size, width // size
        if self.strided:
            parts = padded.view(batch, agents, size, down, size, along, channels).permute(
                0, 3, 5, 1, 2, 4, 6
            )
        else:
            parts = padded.view(batch, agents, down, size, along, size, channels).permute(
                0, 2, 4, 1, 3, 5, 6
            )
        return parts.reshape(batch * down * along, agents * size * size, channels)

    def join(self, tokens: Tensor, shape: torch.Size) -> Tensor:
        """Tokens (B · windows, A · size², C) → maps (B, A, H, W, C) of the shape that `split` had."""
        batch, agents, height, width = shape
        size = self.size
        down, along = -(-height // size), -(-width // size)
        parts = tokens.view(batch, down, along, agents, size, size, -1)
        order = (0, 3, 4, 1, 5, 2, 6) if self.strided else (0, 3, 1, 4, 2, 5, 6)
        maps = parts.permute(order).reshape(batch, agents, down * size, along * size, -1)
        return maps[:, :, :height, :width]

    def split_mask(self, mask: Tensor) -> Tensor:
        """Masks (B, A, H, W) → (B · windows, A · size²) bool; added cells are False."""
        return self.split(mask[..., None].to(torch.uint8))[..., 0].bool()


class PreNorm(nn.Module):
    """x + layer(LayerNorm(x))."""

    def __init__(self, channels: int, layer: nn.Module) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(channels)
        self.layer = layer

    def forward(self, x: Tensor, *others: Any) -> Tensor:
        """(…, C) → (…, C); the other arguments go to the layer as they are."""
        return x + self.layer(self.norm(x), *others)


class FeedForward(nn.Module):
    """Linear, GELU, linear, each with dropout."""

    def __init__(self, channels: int, hidden: int, dropout: float) -> None:
        super().__init__()
        self.net = nn.Sequential(
            nn.Linear(channels, hidden),
            nn.GELU(),
            nn.Dropout(dropout),
            nn.Linear(hidden, channels),
            nn.Dropout(dropout),
        )

    def forward(self, x: Tensor) -> Tensor:
        """(…, C) → (…, C)."""
        return self.net(x)


def attention(qkv: Tensor, heads: int, bias: Tensor, keys: Tensor | None) -> Tensor:
    """Self-attention within M sets of L tokens, (M, L, 3 · C) → (M, L, C).

    Queries, keys and values have the heads' channels one after the other. The bias (heads or 1, L, L), [query, key], is
    added to the scaled products; `keys` (M, L) bool can be attended to, at least one a set; None for all.
    """
    query, key, value = qkv.unflatten(-1, (3, heads, -1)).permute(2, 0, 3, 1, 4)
    score = (query * query.shape[-1] ** -0.5) @ key.transpose(-1, -2)
    score += bias  # in place, here and below: scores are by far the largest tensors of a module
    if keys is not None:
        score.masked_fill_(~keys[:, None, None, :], -torch.inf)
    return (score.softmax(-1).to(value.dtype) @ value).transpose(1, 2).flatten(2)


# Vehicle 0, infrastructure 1.
_KINDS = 2


class LinearByKind(nn.Module):
    """A linear layer with other weights for each kind of agent."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        bound = channels**-0.5
        self.weight = nn.Parameter(torch.empty(_KINDS, channels, channels).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.empty(_KINDS, channels).uniform_(-bound, bound))

    def forward(self, x: Tensor, kind: Tensor) -> Tensor:
        """(B, A, M, C) and kinds (B, A) → (B, A, M, C)."""
        return x @ self.weight[kind].transpose(-1, -2) + self.bias[kind][:, :, None]


class AgentAttention(nn.Module):
    """Each agent attends to all agents' features of the same cell.

    With kinds τ: a_ij = q_iᵀ W_att[τ_i, τ_j] k_j / √d, a `softmax` over the agents j that the mask shows,
    o_i = Out_{τ_i} Σ_j a_ij (v_j W_msg[τ_i, τ_j]); for each head.
    """

    def __init__(self, channels: int, heads: int, dropout: float) -> None:
        super().__init__()
        self.heads = heads
        size = channels // heads
        self.query, self.key, self.value, self.out = (LinearByKind(channels) for _ in range(4))
        self.relation_att = nn.Parameter(torch.empty(_KINDS * _KINDS, heads, size, size))
        self.relation_msg = nn.Parameter(torch.empty(_KINDS * _KINDS, heads, size, size))
        for relation in (self.relation_att, self.relation_msg):
            nn.init.uniform_(relation, -((3 / size) ** 0.5), (3 / size) ** 0.5)
        self.dropout = nn.Dropout(dropout)

    def forward(self, x: Tensor, mask: Tensor, agent_is_infra: Tensor) -> Tensor:
        """Maps (B, A, H, W, C), mask (B, A, H, W) and kinds (B, A) → the same shape as the maps."""
        kind = agent_is_infra.long()
        cells = x.flatten(2, 3)
        query, key, value = (
            self._by_head(layer(cells, kind)) for layer in (self.query, self.key, self.value)
        )
        scale = query.shape[-1] ** -0.5
        by_kind = [
            self._related(query, self.relation_att, kind, other) * scale @ key.transpose(-1, -2)
            for other in range(_KINDS)
        ]
        infra = agent_is_infra[:, None, None, None, :]
        shown = mask.flatten(2).transpose(1, 2)[:, None, :, None, :]
        score = torch.where(infra, by_kind[1], by_kind[0]).masked_fill(~shown, -torch.inf)
        weight = score.softmax(-1).to(value.dtype)
        messages = [
            self._related(weight * (infra == bool(other)) @ value, self.relation_msg, kind, other)
            for other in range(_KINDS)
        ]
        merged = (messages[0] + messages[1]).permute(0, 3, 2, 1, 4).flatten(3)
        return self.dropout(self.out(merged, kind)).view_as(x)

    def _by_head(self, x: Tensor) -> Tensor:
        """(B, A, M, C) → (B, heads, M, A, C / heads)."""
        return x.unflatten(-1, (self.heads, -1)).permute(0, 3, 2, 1, 4)

    @staticmethod
    def _related(x: Tensor, relation: Tensor, kind: Tensor, other: int) -> Tensor:
        """(B, heads, M, A, d), each agent's through the matrix of its kind and another kind."""
        return torch.einsum("bhmip,bihpq->bhmiq", x, relation[_KINDS * kind + other])


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
        self.register_buffer(
            "positions", relative_positions(windows.size).T.contiguous(), persistent=False
        )

    def forward(self, x: Tensor) -> Tensor:
        """Maps (M, 1, H, W, C) → the same shape; cells added to fill the windows are not attended to."""
        keys = None
        if x.shape[2] % self.windows.size or x.shape[3] % self.windows.size:
            keys = self.windows.split_mask(
                torch.ones(x.shape[:4], dtype=torch.bool, device=x.device)
            )
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

    def __init__(
        self, channels: int, sizes: Sequence[int], heads: Sequence[int], dropout: float
    ) -> None:
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
