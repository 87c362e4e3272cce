"""BEV feature maps in another frame, with gradients: of past moments in the present, of partners in the ego's frame.

The torch sibling of `motion.warps.warping`, for whole batches. Maps lie [row = y ascending, column = x ascending], and
transforms have the maps' handedness; nothing here depends on which it is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional

from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.geometry.bev_grid import Axis

WarpRule = Literal["stretched", "exact"]
WarpMode = Literal["bilinear", "nearest"]


@dataclass(frozen=True, slots=True, kw_only=True)
class GridBounds:
    """The cells of a BEV feature map; row = y ascending, column = x ascending.

    Attributes:
        x: start, end and cell size along x, metres.
        y: start, end and cell size along y, metres.
    """

    x: Axis
    y: Axis

    def __post_init__(self) -> None:
        """Check the ranges as `geometry.BevGrid` does; raises ConfigError."""
        checked = BevGrid(x=self.x, y=self.y)
        object.__setattr__(self, "x", checked.x)
        object.__setattr__(self, "y", checked.y)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return BevGrid(x=self.x, y=self.y).shape


def warp_features(
    features: Tensor,
    target_from_source: Tensor,
    grid: GridBounds,
    *,
    warp: WarpRule = "exact",
    mode: WarpMode = "bilinear",
) -> Tensor:
    """Feature maps as the target's frame sees them; zero outside the source's grid.

    `exact` samples at the centres of the target's cells. `stretched` is the released FeatureWarper's rule, which
    blurs by up to half a cell even without motion (`motion.warps.warping`). Points lie on the plane z = 0; of the
    inverse transform only rows x, y and columns x, y and translation count.

    Args:
        features: (N, C, H, W) maps in the source's frame.
        target_from_source: (N, 4, 4) metres, invertible.
        grid: the cells of both maps.
        warp: where to sample.
        mode: how to sample.

    Returns:
        (N, C, H, W) of the features' dtype; sampled in float32 at least.
    """
    points = _sample_points(target_from_source, grid, warp)
    working = features if features.dtype == torch.float64 else features.float()
    sampled = functional.grid_sample(
        working, points.to(working.dtype), mode=mode, padding_mode="zeros", align_corners=warp == "stretched"
    )
    return sampled.to(features.dtype)


def inside_mask(target_from_source: Tensor, grid: GridBounds, *, warp: WarpRule = "exact") -> Tensor:
    """(N, H, W) bool: the target's cells that the source's grid covers, by nearest sampling.

    Args:
        target_from_source: (N, 4, 4) metres, invertible.
        grid: the cells of both maps.
        warp: where to sample.
    """
    ones = target_from_source.new_ones(len(target_from_source), 1, *grid.shape)
    return warp_features(ones, target_from_source, grid, warp=warp, mode="nearest")[:, 0] > 0.5


def agents_to_ego(features: Tensor, ego_from_agent: Tensor, grid: GridBounds, *, warp: WarpRule = "exact") -> Tensor:
    """All agents' maps of one moment in the ego's frame, bilinear; the ego's own, slot 0, stays as it is.

    Args:
        features: (B, A, C, H, W) maps, each in its agent's frame.
        ego_from_agent: (B, A, 4, 4) metres; slot 0 is not used; the identity where an agent is missing.
        grid: the cells of all maps.
        warp: where to sample.

    Returns:
        (B, A, C, H, W).
    """
    partners = features[:, 1:]
    warped = warp_features(partners.flatten(0, 1), ego_from_agent[:, 1:].flatten(0, 1), grid, warp=warp)
    return torch.cat([features[:, :1], warped.view_as(partners)], 1)


def agents_mask(agent_valid: Tensor, ego_from_agent: Tensor, grid: GridBounds, *, warp: WarpRule = "exact") -> Tensor:
    """(B, A, H, W) bool: where each agent has something to say in the ego's frame; the ego, slot 0, everywhere.

    Args:
        agent_valid: (B, A) bool, whether the agent is there.
        ego_from_agent: (B, A, 4, 4) metres; the identity where an agent is missing.
        grid: the cells of all maps.
        warp: where to sample.
    """
    inside = inside_mask(ego_from_agent.flatten(0, 1), grid, warp=warp).unflatten(0, agent_valid.shape)
    mask = inside & agent_valid[..., None, None]
    mask[:, 0] = True
    return mask


def _sample_points(target_from_source: Tensor, grid: GridBounds, warp: WarpRule) -> Tensor:
    """(N, H, W, 2) the point x, y of the source that each cell samples; −1 and 1 are the grid's ends."""
    source_from_target = torch.linalg.inv(target_from_source)
    columns, rows = (_coordinates(axis, warp, source_from_target) for axis in (grid.x, grid.y))
    points = []
    for number, (low, high, _) in enumerate((grid.x, grid.y)):
        along_x, along_y, shift = (source_from_target[:, number, column, None, None] for column in (0, 1, 3))
        metres = along_x * columns[None, None, :] + along_y * rows[None, :, None] + shift
        points.append((metres - (low + high) / 2) / ((high - low) / 2))
    return torch.stack(points, -1)


def _coordinates(axis: Axis, warp: WarpRule, like: Tensor) -> Tensor:
    """(n,) metres: the centres of an axis' cells; if stretched, from the first centre to the *end*, evenly."""
    low, high, size = axis
    last = high if warp == "stretched" else high - size / 2
    return torch.linspace(low + size / 2, last, round((high - low) / size), dtype=like.dtype, device=like.device)
