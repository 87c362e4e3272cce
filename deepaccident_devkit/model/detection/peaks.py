"""Peaks of the heatmap: a Gaussian at the cell of each box, wide enough for its size (CornerNet, CenterNet)."""

from __future__ import annotations

import torch
from torch import Tensor


def peak_radius(length: Tensor, width: Tensor, min_overlap: float) -> Tensor:
    """Radius of a box's peak in the heatmap, cells, before rounding and the least radius; the released formula.

    It is the smallest of three roots, in each of which the release divides by 2 where 2a would be right.

    Args:
        length: (N,) cells.
        width: (N,) cells.
        min_overlap: between 0 and 1.
    """
    total, area = length + width, length * width
    quadratics = (
        (1.0, total, area * (1 - min_overlap) / (1 + min_overlap)),
        (4.0, 2 * total, (1 - min_overlap) * area),
        (4 * min_overlap, -2 * min_overlap * total, (min_overlap - 1) * area),
    )
    roots = [(b + (b**2 - 4 * a * c).clamp(min=0).sqrt()) / 2 for a, b, c in quadratics]
    return torch.stack(roots).amin(dim=0)


def draw_peaks(heatmap: Tensor, layer: Tensor, cell: Tensor, radius: Tensor) -> None:
    """Draw Gaussians with σ = (2r + 1)/6 in squares of 2r + 1 cells; where they meet, the larger value stays.

    Args:
        heatmap: (L, H, W), changed in place.
        layer: (N,) int64, where each is drawn.
        cell: (N, 2) int64, column and row of each peak, inside the map.
        radius: (N,) int64, r in cells.
    """
    if not len(layer):
        return
    rows, columns = heatmap.shape[1:]
    reach = int(radius.max())
    offset = torch.arange(-reach, reach + 1, device=heatmap.device)
    column, row = cell[:, :1] + offset, cell[:, 1:] + offset  # (N, side)
    sigma = (2 * radius[:, None].to(heatmap.dtype) + 1) / 6
    bell = torch.exp(-(offset.to(heatmap.dtype) ** 2) / (2 * sigma**2)) * (offset.abs() <= radius[:, None])
    # what lies beyond an edge is moved onto it, where the Gaussian itself is larger
    place = row.clamp(0, rows - 1)[:, :, None] * columns + column.clamp(0, columns - 1)[:, None]
    place = place + layer[:, None, None] * (rows * columns)
    peaks = bell[:, :, None] * bell[:, None]
    heatmap.view(-1).scatter_reduce_(0, place.flatten(), peaks.flatten(), "amax")
