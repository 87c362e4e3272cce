"""Attention over agents and over windows of maps: the building blocks of CoBEVT and V2X-ViT."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from deepaccident_devkit.plugins.model.images.swin import relative_positions

# Kinds of agents: vehicle 0, infrastructure 1.
_NUM_AGENT_KINDS = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class Windows:
    """A division of maps into windows.

    If the size does not divide H or W, rows are added after the last row and columns after the last
    column; the mask marks them.

    Attributes:
        size: Rows and columns of a window.
        strided: Whether a window consists of cells spread evenly over the complete map (CoBEVT's
            grid) instead of neighbouring cells.
    """

    size: int
    strided: bool = False

    def split(self, x: Tensor) -> Tensor:
        """Split maps (B, A, H, W, C) into tokens (B · windows, A · size², C).

        Tokens are ordered by agent, row and column. The features of added cells are 0.
        """
        size = self.size
        added_rows = -x.shape[2] % size
        added_columns = -x.shape[3] % size
        padded = functional.pad(x, (0, 0, 0, added_columns, 0, added_rows))
        batch, agents, height, width, channels = padded.shape
        rows = height // size
        columns = width // size
        if self.strided:
            windows = padded.view(batch, agents, size, rows, size, columns, channels)
            windows = windows.permute(0, 3, 5, 1, 2, 4, 6)
        else:
            windows = padded.view(batch, agents, rows, size, columns, size, channels)
            windows = windows.permute(0, 2, 4, 1, 3, 5, 6)
        return windows.reshape(batch * rows * columns, agents * size * size, channels)

    def join(self, tokens: Tensor, shape: torch.Size) -> Tensor:
        """Join tokens (B · windows, A · size², C) to maps (B, A, H, W, C).

        `shape` is (B, A, H, W) of the maps before `split`.
        """
        batch, agents, height, width = shape
        size = self.size
        rows = -(-height // size)
        columns = -(-width // size)
        windows = tokens.view(batch, rows, columns, agents, size, size, -1)
        if self.strided:
            maps = windows.permute(0, 3, 4, 1, 5, 2, 6)
        else:
            maps = windows.permute(0, 3, 1, 4, 2, 5, 6)
        maps = maps.reshape(batch, agents, rows * size, columns * size, -1)
        return maps[:, :, :height, :width]

    def split_mask(self, mask: Tensor) -> Tensor:
        """Split masks (B, A, H, W) into (B · windows, A · size²) bool; added cells are False."""
        tokens = self.split(mask[..., None].to(torch.uint8))
        return tokens[..., 0].bool()


class PreNorm(nn.Module):
    """A layer with a layer norm before it, added to its input: x + layer(LayerNorm(x))."""

    def __init__(self, channels: int, layer: nn.Module) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(channels)
        self.layer = layer

    def forward(self, x: Tensor, *arguments: Any) -> Tensor:
        """Transform (…, C) to (…, C); other arguments are passed on to the layer."""
        normalised = self.norm(x)
        return x + self.layer(normalised, *arguments)


class FeedForward(nn.Module):
    """A linear layer, a GELU and a second linear layer; dropout follows each linear layer."""

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
    """Apply attention within M sets of L tokens, (M, L, 3 · C); return (M, L, C).

    In queries, keys and values, the channels of one head follow another head's. The bias (heads
    or 1, L, L), [query, key], is added to the scaled products. `keys` (M, L) bool marks the tokens
    that can be attended to, at least one in each set; None for all.
    """
    query, key, value = qkv.unflatten(-1, (3, heads, -1)).permute(2, 0, 3, 1, 4)
    scaled_query = query * query.shape[-1] ** -0.5
    score = scaled_query @ key.transpose(-1, -2)
    # In place, here and in the next lines: scores are by far the largest tensors of a module.
    score += bias
    if keys is not None:
        score.masked_fill_(~keys[:, None, None, :], -torch.inf)
    attended = score.softmax(-1).to(value.dtype) @ value
    return attended.transpose(1, 2).flatten(2)


class LinearByKind(nn.Module):
    """A linear layer with separate weights for each kind of agent."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        bound = channels**-0.5
        weight = torch.empty(_NUM_AGENT_KINDS, channels, channels)
        bias = torch.empty(_NUM_AGENT_KINDS, channels)
        self.weight = nn.Parameter(weight.uniform_(-bound, bound))
        self.bias = nn.Parameter(bias.uniform_(-bound, bound))

    def forward(self, x: Tensor, agent_kind: Tensor) -> Tensor:
        """Transform (B, A, M, C), with kinds (B, A), to (B, A, M, C)."""
        weight = self.weight[agent_kind].transpose(-1, -2)
        bias = self.bias[agent_kind][:, :, None]
        return x @ weight + bias


class AgentAttention(nn.Module):
    """Attention of each agent to all agents' features of the same cell.

    With kinds τ: a_ij = q_iᵀ W_att[τ_i, τ_j] k_j / √d, a `softmax` over the agents j that the mask
    shows, o_i = Out_{τ_i} Σ_j a_ij (v_j W_msg[τ_i, τ_j]); for each head.
    """

    def __init__(self, channels: int, heads: int, dropout: float) -> None:
        super().__init__()
        self.heads = heads
        size = channels // heads
        self.query = LinearByKind(channels)
        self.key = LinearByKind(channels)
        self.value = LinearByKind(channels)
        self.out = LinearByKind(channels)
        shape = (_NUM_AGENT_KINDS * _NUM_AGENT_KINDS, heads, size, size)
        self.relation_att = nn.Parameter(torch.empty(shape))
        self.relation_msg = nn.Parameter(torch.empty(shape))
        bound = (3 / size) ** 0.5
        for relation in (self.relation_att, self.relation_msg):
            nn.init.uniform_(relation, -bound, bound)
        self.dropout = nn.Dropout(dropout)

    def forward(self, x: Tensor, mask: Tensor, agent_is_infra: Tensor) -> Tensor:
        """Apply attention to maps (B, A, H, W, C); return the same shape.

        The mask has shape (B, A, H, W), the kinds (B, A).
        """
        agent_kind = agent_is_infra.long()
        cells = x.flatten(2, 3)
        query = self._split_heads(self.query(cells, agent_kind))
        key = self._split_heads(self.key(cells, agent_kind))
        value = self._split_heads(self.value(cells, agent_kind))
        scale = query.shape[-1] ** -0.5
        key = key.transpose(-1, -2)
        scores_by_kind = []
        for other_kind in range(_NUM_AGENT_KINDS):
            relation = self.relation_att[_NUM_AGENT_KINDS * agent_kind + other_kind]
            related_query = _apply_relation(query, relation)
            scores_by_kind.append(related_query * scale @ key)
        is_infra = agent_is_infra[:, None, None, None, :]
        is_visible = mask.flatten(2).transpose(1, 2)[:, None, :, None, :]
        score = torch.where(is_infra, scores_by_kind[1], scores_by_kind[0])
        score = score.masked_fill(~is_visible, -torch.inf)
        weight = score.softmax(-1).to(value.dtype)
        messages = []
        for other_kind in range(_NUM_AGENT_KINDS):
            kind_weight = weight * (is_infra == bool(other_kind))
            relation = self.relation_msg[_NUM_AGENT_KINDS * agent_kind + other_kind]
            messages.append(_apply_relation(kind_weight @ value, relation))
        message = messages[0] + messages[1]
        merged = message.permute(0, 3, 2, 1, 4).flatten(3)
        return self.dropout(self.out(merged, agent_kind)).view_as(x)

    def _split_heads(self, x: Tensor) -> Tensor:
        """Return (B, A, M, C) as (B, heads, M, A, C / heads)."""
        by_head = x.unflatten(-1, (self.heads, -1))
        return by_head.permute(0, 3, 2, 1, 4)


def _apply_relation(x: Tensor, relation: Tensor) -> Tensor:
    """Multiply each agent's features by its matrix (B, A, heads, d, d), to (B, heads, M, A, d)."""
    return torch.einsum("bhmip,bihpq->bhmiq", x, relation)


class WindowAttention(nn.Module):
    """Attention among the cells of a window of one agent's map.

    The relative bias is the same for all heads.
    """

    positions: Tensor

    def __init__(self, channels: int, windows: Windows, heads: int, dropout: float) -> None:
        super().__init__()
        self.windows = windows
        self.heads = heads
        self.to_qkv = nn.Linear(channels, 3 * channels, bias=False)
        self.to_out = nn.Sequential(nn.Linear(channels, channels), nn.Dropout(dropout))
        span = 2 * windows.size - 1
        self.pos_embedding = nn.Parameter(torch.randn(span, span))
        # The original's bias is indexed by key − query.
        positions = relative_positions(windows.size).T.contiguous()
        self.register_buffer("positions", positions, persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        """Apply attention to maps (M, 1, H, W, C); return the same shape.

        Cells that are added to fill the windows are not attended to.
        """
        windows = self.windows
        map_shape = x.shape[:4]
        keys = None
        if x.shape[2] % windows.size or x.shape[3] % windows.size:
            all_cells = torch.ones(map_shape, dtype=torch.bool, device=x.device)
            keys = windows.split_mask(all_cells)
        bias = self.pos_embedding.flatten()[self.positions][None]
        qkv = windows.split(self.to_qkv(x))
        attended = attention(qkv, self.heads, bias, keys)
        return windows.join(self.to_out(attended), map_shape)


class SplitAttention(nn.Module):
    """A weighted sum of branches.

    Each channel's weights are a `softmax` over the branches, computed from the mean over the map.
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
        """Merge maps (M, 1, H, W, C), one for each branch, into one map."""
        stacked = torch.stack(results, -2)
        means = stacked.sum(-2).mean((2, 3), keepdim=True)
        score = self.weigh(means).unflatten(-1, (self.branches, -1))
        return (stacked * score.softmax(-2)).sum(-2)


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
        """Apply attention to maps (B, A, H, W, C); return the same shape."""
        maps = x.flatten(0, 1)[:, None]
        results = [branch(maps) for branch in self.branches]
        return self.split_attention(results).view_as(x)
