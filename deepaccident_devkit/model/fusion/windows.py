"""Square windows of maps (B, A, H, W, C), as sets of tokens: neighbouring cells, or cells spread over the map."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional


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
            parts = padded.view(batch, agents, size, down, size, along, channels).permute(0, 3, 5, 1, 2, 4, 6)
        else:
            parts = padded.view(batch, agents, down, size, along, size, channels).permute(0, 2, 4, 1, 3, 5, 6)
        return parts.reshape(batch * down * along, agents * size * size, channels)

    def join(self, tokens: Tensor, shape: torch.Size) -> Tensor:
        """Tokens → the maps (B, A, H, W, C) that `split` had, without the added cells.

        Args:
            tokens: (B · windows, A · size², C).
            shape: B, A, H, W of the maps.
        """
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


def relative_positions(size: int) -> Tensor:
    """(size², size²) the number of query − key among the (2 · size − 1)² differences of rows and columns."""
    cells = torch.cartesian_prod(torch.arange(size), torch.arange(size))
    down, along = (cells[:, None] - cells[None, :] + size - 1).unbind(-1)
    return down * (2 * size - 1) + along
