"""The parts that the transformers CoBEVT and V2X-ViT share; tokens have their channels last."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn


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
    """Self-attention within sets of tokens.

    Args:
        qkv: (M, L, 3 · C) queries, keys and values of M sets, each with the heads' channels one after the other.
        heads: how many.
        bias: (heads or 1, L, L) added to the scaled products, [query, key].
        keys: (M, L) bool, the tokens that can be attended to, at least one a set; None for all.

    Returns:
        (M, L, C).
    """
    query, key, value = qkv.unflatten(-1, (3, heads, -1)).permute(2, 0, 3, 1, 4)
    score = (query * query.shape[-1] ** -0.5) @ key.transpose(-1, -2)
    score += bias  # in place, here and below: scores are by far the largest tensors of a module
    if keys is not None:
        score.masked_fill_(~keys[:, None, None, :], -torch.inf)
    return (score.softmax(-1).to(value.dtype) @ value).transpose(1, 2).flatten(2)
