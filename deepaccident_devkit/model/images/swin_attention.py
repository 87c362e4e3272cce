"""Attention of a Swin Transformer: within windows, every second time of a shifted map."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional


class WindowAttention(nn.Module):
    """Multi-head self-attention of the tokens of one window, with a learned bias for each relative position."""

    relative_position_index: Tensor

    def __init__(self, channels: int, heads: int, window: int) -> None:
        super().__init__()
        self.heads = heads
        self.relative_position_bias_table = nn.Parameter(torch.zeros((2 * window - 1) ** 2, heads))
        self.register_buffer("relative_position_index", relative_positions(window))
        self.qkv = nn.Linear(channels, 3 * channels)
        self.proj = nn.Linear(channels, channels)

    def forward(self, tokens: Tensor, together: Tensor | None = None) -> Tensor:
        """Attend.

        Args:
            tokens: (N, K, L, C): K windows of each image, L tokens each.
            together: (K, L, L) bool, which tokens may see each other; None for all.

        Returns:
            (N, K, L, C).
        """
        channels = tokens.shape[-1]
        # (N, K, L, 3C) → query, key and value, each (N, K, heads, L, C / heads)
        parts = self.qkv(tokens).unflatten(-1, (3, self.heads, channels // self.heads))
        query, key, value = parts.permute(3, 0, 1, 4, 2, 5).unbind(0)
        scores = (query * query.shape[-1] ** -0.5) @ key.transpose(-1, -2)
        scores = scores + self.relative_position_bias_table[self.relative_position_index].permute(2, 0, 1)
        if together is not None:
            scores = scores.masked_fill(~together[:, None], -torch.inf)
        return self.proj((scores.softmax(-1) @ value).transpose(2, 3).flatten(3))


class ShiftedWindowAttention(nn.Module):
    """A map cut into windows of which each attends to itself; `shift` moves the windows, and the map is a torus.

    A map that is not a whole number of windows is filled with zeros on the right and at the bottom. As in the release,
    tokens see the filling as they see others.
    """

    def __init__(self, channels: int, heads: int, window: int, shift: int) -> None:
        super().__init__()
        self.window, self.shift = window, shift
        self.w_msa = WindowAttention(channels, heads, window)

    def forward(self, features: Tensor) -> Tensor:
        """Features (N, h, w, C) → the same shape."""
        height, width = features.shape[1:3]
        padded = functional.pad(features, (0, 0, 0, -width % self.window, 0, -height % self.window))
        rows, columns = padded.shape[1:3]
        together = None
        if self.shift:
            padded = padded.roll((-self.shift, -self.shift), (1, 2))
            together = neighbours(rows, columns, self.window, self.shift, padded.device)
        attended = self.w_msa(windows_of(padded, self.window), together)
        result = map_of(attended, rows, columns)
        if self.shift:
            result = result.roll((self.shift, self.shift), (1, 2))
        return result[:, :height, :width]


def relative_positions(window: int) -> Tensor:
    """(L, L) int64 for L = window² tokens: the row of the bias table for a query (first axis) and a key."""
    row, column = torch.meshgrid(torch.arange(window), torch.arange(window), indexing="ij")
    down = row.flatten()[:, None] - row.flatten() + window - 1
    along = column.flatten()[:, None] - column.flatten() + window - 1
    return down * (2 * window - 1) + along


def windows_of(features: Tensor, window: int) -> Tensor:
    """A map (N, h, w, C) of whole windows as (N, K, L, C): K windows in reading order of L = window² tokens."""
    count, rows, columns, channels = features.shape
    cut = features.view(count, rows // window, window, columns // window, window, channels)
    return cut.transpose(2, 3).reshape(count, -1, window * window, channels)


def map_of(windows: Tensor, rows: int, columns: int) -> Tensor:
    """The map (N, rows, columns, C) that `windows_of` cut."""
    count, _, tokens, channels = windows.shape
    window = round(tokens**0.5)
    cut = windows.view(count, rows // window, columns // window, window, window, channels)
    return cut.transpose(2, 3).reshape(count, rows, columns, channels)


def neighbours(rows: int, columns: int, window: int, shift: int, device: torch.device | str | None = None) -> Tensor:
    """Which tokens of the windows of a shifted map may see each other, (K, L, L) bool.

    Those that lay beside each other before the shift: not the two sides of the map that it brought together.
    """
    # in the last row and column of windows the last `shift` steps come from the other side
    down, along = ((torch.arange(size, device=device) >= size - shift).long() for size in (rows, columns))
    sides = windows_of((2 * down[:, None] + along)[None, :, :, None], window)[0, :, :, 0]
    return sides[:, :, None] == sides[:, None, :]
