"""Attention over agents and windows of maps: the parts of CoBEVT and V2X-ViT."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from deepaccident_devkit.plugins.model.images.swin import relative_positions

# Kinds of agents: vehicle 0, infrastructure 1.
_KIND_COUNT = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class Windows:
    """The division of maps into windows.

    If the size does not divide H or W, rows are added after the last row and columns after the last
    column; the mask marks them.

    Attributes:
        size: Rows and columns of a window.
        strided: Whether a window has cells that are spread evenly over the complete map (CoBEVT's
            grid) instead of neighbours.
    """

    size: int
    strided: bool = False

    def split(self, x: Tensor) -> Tensor:
        """Split maps (B, A, H, W, C) into tokens (B · windows, A · size², C).

        Tokens are ordered by agent, row and column; added cells are 0.
        """
        size = self.size
        padded = functional.pad(x, (0, 0, 0, -x.shape[3] % size, 0, -x.shape[2] % size))
        batch, agents, height, width, channels = padded.shape
        rows, columns = height // size, width // size
        if self.strided:
            parts = padded.view(batch, agents, size, rows, size, columns, channels)
            parts = parts.permute(0, 3, 5, 1, 2, 4, 6)
        else:
            parts = padded.view(batch, agents, rows, size, columns, size, channels)
            parts = parts.permute(0, 2, 4, 1, 3, 5, 6)
        return parts.reshape(batch * rows * columns, agents * size * size, channels)

    def join(self, tokens: Tensor, shape: torch.Size) -> Tensor:
        """Join tokens (B · windows, A · size², C) to maps (B, A, H, W, C).

        `shape` is (B, A, H, W) of the maps before `split`.
        """
        batch, agents, height, width = shape
        size = self.size
        rows, columns = -(-height // size), -(-width // size)
        parts = tokens.view(batch, rows, columns, agents, size, size, -1)
        order = (0, 3, 4, 1, 5, 2, 6) if self.strided else (0, 3, 1, 4, 2, 5, 6)
        maps = parts.permute(order).reshape(batch, agents, rows * size, columns * size, -1)
        return maps[:, :, :height, :width]

    def split_mask(self, mask: Tensor) -> Tensor:
        """Split masks (B, A, H, W) into (B · windows, A · size²) bool; added cells are False."""
        tokens = self.split(mask[..., None].to(torch.uint8))
        return tokens[..., 0].bool()


class PreNorm(nn.Module):
    """x + layer(LayerNorm(x))."""

    def __init__(self, channels: int, layer: nn.Module) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(channels)
        self.layer = layer

    def forward(self, x: Tensor, *arguments: Any) -> Tensor:
        """Transform (…, C) to (…, C); the other arguments are passed to the layer."""
        return x + self.layer(self.norm(x), *arguments)


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
        """Transform (…, C) to (…, C)."""
        return self.net(x)


def attention(qkv: Tensor, heads: int, bias: Tensor, keys: Tensor | None) -> Tensor:
    """Attend within M sets of L tokens, (M, L, 3 · C); return (M, L, C).

    Queries, keys and values have the heads' channels one after the other. The bias (heads or 1, L,
    L), [query, key], is added to the scaled products. `keys` (M, L) bool are the tokens that can be
    attended to, at least one a set; None for all.
    """
    query, key, value = qkv.unflatten(-1, (3, heads, -1)).permute(2, 0, 3, 1, 4)
    score = (query * query.shape[-1] ** -0.5) @ key.transpose(-1, -2)
    # In place, here and in the next lines: scores are by far the largest tensors of a module.
    score += bias
    if keys is not None:
        score.masked_fill_(~keys[:, None, None, :], -torch.inf)
    return (score.softmax(-1).to(value.dtype) @ value).transpose(1, 2).flatten(2)


class LinearByKind(nn.Module):
    """A linear layer with separate weights for each kind of agent."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        bound = channels**-0.5
        self.weight = nn.Parameter(
            torch.empty(_KIND_COUNT, channels, channels).uniform_(-bound, bound)
        )
        self.bias = nn.Parameter(torch.empty(_KIND_COUNT, channels).uniform_(-bound, bound))

    def forward(self, x: Tensor, kind: Tensor) -> Tensor:
        """Transform (B, A, M, C), with kinds (B, A), to (B, A, M, C)."""
        return x @ self.weight[kind].transpose(-1, -2) + self.bias[kind][:, :, None]


class AgentAttention(nn.Module):
    """Attention of each agent to all agents' features of the same cell.

    With kinds τ: a_ij = q_iᵀ W_att[τ_i, τ_j] k_j / √d, a `softmax` over the agents j that the mask
    shows, o_i = Out_{τ_i} Σ_j a_ij (v_j W_msg[τ_i, τ_j]); for each head.
    """

    def __init__(self, channels: int, heads: int, dropout: float) -> None:
        super().__init__()
        self.heads = heads
        size = channels // heads
        self.query, self.key, self.value, self.out = (LinearByKind(channels) for _ in range(4))
        self.relation_att = nn.Parameter(torch.empty(_KIND_COUNT * _KIND_COUNT, heads, size, size))
        self.relation_msg = nn.Parameter(torch.empty(_KIND_COUNT * _KIND_COUNT, heads, size, size))
        for relation in (self.relation_att, self.relation_msg):
            nn.init.uniform_(relation, -((3 / size) ** 0.5), (3 / size) ** 0.5)
        self.dropout = nn.Dropout(dropout)

    def forward(self, x: Tensor, mask: Tensor, agent_is_infra: Tensor) -> Tensor:
        """Attend in maps (B, A, H, W, C); return the same shape.

        The mask has shape (B, A, H, W), the kinds (B, A).
        """
        kind = agent_is_infra.long()
        cells = x.flatten(2, 3)
        query, key, value = (
            self._by_head(layer(cells, kind)) for layer in (self.query, self.key, self.value)
        )
        scale = query.shape[-1] ** -0.5
        scores_by_kind = [
            self._related(query, self.relation_att, kind, other) * scale @ key.transpose(-1, -2)
            for other in range(_KIND_COUNT)
        ]
        is_infra = agent_is_infra[:, None, None, None, :]
        is_visible = mask.flatten(2).transpose(1, 2)[:, None, :, None, :]
        score = torch.where(is_infra, scores_by_kind[1], scores_by_kind[0])
        score = score.masked_fill(~is_visible, -torch.inf)
        weight = score.softmax(-1).to(value.dtype)
        messages = []
        for other in range(_KIND_COUNT):
            values_of_kind = weight * (is_infra == bool(other)) @ value
            messages.append(self._related(values_of_kind, self.relation_msg, kind, other))
        merged = (messages[0] + messages[1]).permute(0, 3, 2, 1, 4).flatten(3)
        return self.dropout(self.out(merged, kind)).view_as(x)

    def _by_head(self, x: Tensor) -> Tensor:
        """Return (B, A, M, C) as (B, heads, M, A, C / heads)."""
        return x.unflatten(-1, (self.heads, -1)).permute(0, 3, 2, 1, 4)

    @staticmethod
    def _related(x: Tensor, relation: Tensor, kind: Tensor, other: int) -> Tensor:
        """Return (B, heads, M, A, d), each agent times the matrix of its kind and another kind."""
        return torch.einsum("bhmip,bihpq->bhmiq", x, relation[_KIND_COUNT * kind + other])


class WindowAttention(nn.Module):
    """Attention among the cells of a window of one agent's map.

    The relative bias is the same for all heads.
    """

    positions: Tensor

    def __init__(self, channels: int, windows: Windows, heads: int, dropout: float) -> None:
        super().__init__()
        self.windows, self.heads = windows, heads
        self.to_qkv = nn.Linear(channels, 3 * channels, bias=False)
        self.to_out = nn.Sequential(nn.Linear(channels, channels), nn.Dropout(dropout))
        span = 2 * windows.size - 1
        self.pos_embedding = nn.Parameter(torch.randn(span, span))
        # The original's bias is indexed by key − query.
        self.register_buffer(
            "positions", relative_positions(windows.size).T.contiguous(), persistent=False
        )

    def forward(self, x: Tensor) -> Tensor:
        """Attend in maps (M, 1, H, W, C); return the same shape.

        Cells that are added to fill the windows are not attended to.
        """
        keys = None
        if x.shape[2] % self.windows.size or x.shape[3] % self.windows.size:
            keys = self.windows.split_mask(
                torch.ones(x.shape[:4], dtype=torch.bool, device=x.device)
            )
        bias = self.pos_embedding.flatten()[self.positions][None]
        attended = attention(self.windows.split(self.to_qkv(x)), self.heads, bias, keys)
        return self.windows.join(self.to_out(attended), x.shape[:4])


class SplitAttention(nn.Module):
    """Weighted sum of branches.

    Each channel has a `softmax` over the branches of weights, which follow from the mean over the
    map.
    """

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
        """Join maps (M, 1, H, W, C), one for each branch, to one map."""
        stacked = torch.stack(results, -2)
        score = self.weigh(stacked.sum(-2).mean((2, 3), keepdim=True))
        return (stacked * score.unflatten(-1, (self.branches, -1)).softmax(-2)).sum(-2)


class MultiWindowAttention(nn.Module):
    """Window attention with windows of several sizes, joined by split attention.

    Each agent's map is treated separately.
    """

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
        """Attend in maps (B, A, H, W, C); return the same shape."""
        maps = x.flatten(0, 1)[:, None]
        return self.split_attention([branch(maps) for branch in self.branches]).view_as(x)
