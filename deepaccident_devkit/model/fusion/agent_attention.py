"""V2X-ViT's heterogeneous attention over agents: vehicles and infrastructure have weights of their own."""

from __future__ import annotations

import torch
from torch import Tensor, nn

KINDS = 2
"""Vehicle 0, infrastructure 1."""


class LinearByKind(nn.Module):
    """A linear layer with other weights for each kind of agent."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        bound = channels**-0.5
        self.weight = nn.Parameter(torch.empty(KINDS, channels, channels).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.empty(KINDS, channels).uniform_(-bound, bound))

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
        self.relation_att = nn.Parameter(torch.empty(KINDS * KINDS, heads, size, size))
        self.relation_msg = nn.Parameter(torch.empty(KINDS * KINDS, heads, size, size))
        for relation in (self.relation_att, self.relation_msg):
            nn.init.uniform_(relation, -((3 / size) ** 0.5), (3 / size) ** 0.5)
        self.dropout = nn.Dropout(dropout)

    def forward(self, x: Tensor, mask: Tensor, agent_is_infra: Tensor) -> Tensor:
        """Maps (B, A, H, W, C), mask (B, A, H, W) and kinds (B, A) → the same shape as the maps."""
        kind = agent_is_infra.long()
        cells = x.flatten(2, 3)
        query, key, value = (self._by_head(layer(cells, kind)) for layer in (self.query, self.key, self.value))
        scale = query.shape[-1] ** -0.5
        by_kind = [
            self._related(query, self.relation_att, kind, other) * scale @ key.transpose(-1, -2)
            for other in range(KINDS)
        ]
        infra = agent_is_infra[:, None, None, None, :]
        shown = mask.flatten(2).transpose(1, 2)[:, None, :, None, :]
        score = torch.where(infra, by_kind[1], by_kind[0]).masked_fill(~shown, -torch.inf)
        weight = score.softmax(-1).to(value.dtype)
        messages = [
            self._related(weight * (infra == bool(other)) @ value, self.relation_msg, kind, other)
            for other in range(KINDS)
        ]
        merged = (messages[0] + messages[1]).permute(0, 3, 2, 1, 4).flatten(3)
        return self.dropout(self.out(merged, kind)).view_as(x)

    def _by_head(self, x: Tensor) -> Tensor:
        """(B, A, M, C) → (B, heads, M, A, C / heads)."""
        return x.unflatten(-1, (self.heads, -1)).permute(0, 3, 2, 1, 4)

    @staticmethod
    def _related(x: Tensor, relation: Tensor, kind: Tensor, other: int) -> Tensor:
        """(B, heads, M, A, d), each agent's through the matrix of its kind and another kind."""
        return torch.einsum("bhmip,bihpq->bhmiq", x, relation[KINDS * kind + other])
