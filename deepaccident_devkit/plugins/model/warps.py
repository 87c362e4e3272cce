"""Transforms between frames of moments and agents, and BEV feature maps in another frame, with gradients.

The sibling of `geometry.conventions` and `motion.warping`, for whole batches. Maps lie [row = y ascending, column = x
ascending], and transforms have the maps' handedness; nothing here depends on which it is. Products are written as sums,
because `autocast` would round a matrix product to bfloat16, and metres need more digits than that.
"""

from __future__ import annotations

from itertools import accumulate
from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional

from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.geometry.bev_grid import Axis
from deepaccident_devkit.motion.warping import WarpMode

Chain = Literal["released", "exact"]


def matrices_from_six(six: Tensor) -> Tensor:
    """6-vectors (…, 6), metres and radians → rigid matrices (…, 4, 4), as `geometry.conventions.matrices_of_six`."""
    cx, cy, cz = torch.cos(six[..., 3:]).unbind(-1)
    sx, sy, sz = torch.sin(six[..., 3:]).unbind(-1)
    tx, ty, tz = six[..., :3].unbind(-1)
    zero, one = torch.zeros_like(tx), torch.ones_like(tx)
    rows = (
        (cy * cz, -cy * sz, sy, tx),
        (cx * sz + sx * sy * cz, cx * cz - sx * sy * sz, -sx * cy, ty),
        (sx * sz - cx * sy * cz, sx * cz + cx * sy * sz, cx * cy, tz),
        (zero, zero, zero, one),
    )
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def six_from_matrices(matrix: Tensor) -> Tensor:
    """Rigid matrices (…, 4, 4) → 6-vectors (…, 6), metres and radians; the inverse of `matrices_from_six`."""
    m12, m22 = matrix[..., 1, 2], matrix[..., 2, 2]
    rx = torch.atan2(-m12, m22)
    ry = torch.atan2(matrix[..., 0, 2], torch.hypot(m12, m22))
    rz = torch.atan2(-matrix[..., 0, 1], matrix[..., 0, 0])
    return torch.cat([matrix[..., :3, 3], torch.stack([rx, ry, rz], -1)], -1)


def between_augmented(
    target_from_source: Tensor, target_bev: Tensor | None, source_bev: Tensor | None
) -> Tensor:
    """A transform of frames → the one between their augmented maps (…, 4, 4): A_target · transform · A_source⁻¹."""
    if target_bev is not None:
        target_from_source = _product(target_bev, target_from_source)
    if source_bev is not None:
        target_from_source = _product(target_from_source, torch.linalg.inv(source_bev))
    return target_from_source


def present_from_past_batch(
    egomotion: Tensor, *, chain: Chain = "exact", bev_transform: Tensor | None = None
) -> Tensor:
    """Transforms of the past frames to the present, (N, P − 1, 4, 4), the oldest first, as are the egomotion's rows.

    The rows are `next_from_this`, (N, P − 1, 6). Their product is E_{P−2} … E_t (`exact`), or in the `released` chain
    E_t … E_{P−2}, which is wrong from the second frame before the present on. With a BEV augmentation A (N, 4, 4) it
    becomes A · product · A⁻¹.
    """
    way = _product if chain == "exact" else lambda later, earlier: _product(earlier, later)
    products = list(accumulate(matrices_from_six(egomotion).unbind(1)[::-1], way))
    stacked = (
        torch.stack(products[::-1], 1) if products else egomotion.new_zeros(len(egomotion), 0, 4, 4)
    )
    return _augmented(stacked, bev_transform)


def _product(first: Tensor, second: Tensor) -> Tensor:
    return (first[..., :, :, None] * second[..., None, :, :]).sum(-2)


def _augmented(transforms: Tensor, bev_transform: Tensor | None) -> Tensor:
    """A · transforms · A⁻¹ of transforms (N, T, 4, 4) and A (N, 4, 4)."""
    matrix = None if bev_transform is None else bev_transform[:, None]
    return between_augmented(transforms, matrix, matrix)


def precise(values: Tensor) -> Tensor:
    """In float32 at least, if mixed precision made them coarser: sums over maps overflow half precision."""
    return values.to(torch.promote_types(values.dtype, torch.float32))


FeatureWarpRule = Literal["stretched", "exact"]


def warp_features(
    features: Tensor,
    target_from_source: Tensor,
    grid: BevGrid,
    *,
    warp: FeatureWarpRule = "exact",
    mode: WarpMode = "bilinear",
) -> Tensor:
    """Feature maps (N, C, H, W) as the target's frame sees them; zero outside the source's grid.

    `exact` samples at the centres of the target's cells. `stretched` is the released FeatureWarper's rule, which
    blurs by up to half a cell even without motion (`motion.warping`). Points lie on the plane z = 0; of the
    inverse transform (N, 4, 4), metres, only rows x, y and columns x, y and translation count. The result has the
    features' dtype; it is sampled in float32 at least.
    """
    points = _sample_points(target_from_source, grid, warp)
    working = features if features.dtype == torch.float64 else features.float()
    sampled = functional.grid_sample(
        working,
        points.to(working.dtype),
        mode=mode,
        padding_mode="zeros",
        align_corners=warp == "stretched",
    )
    return sampled.to(features.dtype)


def inside_mask(
    target_from_source: Tensor, grid: BevGrid, *, warp: FeatureWarpRule = "exact"
) -> Tensor:
    """(N, H, W) bool: the cells that the source's grid covers, by nearest sampling, of transforms (N, 4, 4), metres."""
    ones = target_from_source.new_ones(len(target_from_source), 1, *grid.shape)
    return warp_features(ones, target_from_source, grid, warp=warp, mode="nearest")[:, 0] > 0.5


def features_to_ego(
    features: Tensor, ego_from_agent: Tensor, grid: BevGrid, *, warp: FeatureWarpRule = "exact"
) -> Tensor:
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
    warped = warp_features(
        partners.flatten(0, 1), ego_from_agent[:, 1:].flatten(0, 1), grid, warp=warp
    )
    return torch.cat([features[:, :1], warped.view_as(partners)], 1)


def agents_mask(
    agent_valid: Tensor, ego_from_agent: Tensor, grid: BevGrid, *, warp: FeatureWarpRule = "exact"
) -> Tensor:
    """(B, A, H, W) bool: where each agent has something to say in the ego's frame; the ego, slot 0, everywhere.

    Transforms (B, A, 4, 4), metres, are the identity where an agent is missing.
    """
    inside = inside_mask(ego_from_agent.flatten(0, 1), grid, warp=warp).unflatten(
        0, agent_valid.shape
    )
    mask = inside & agent_valid[..., None, None]
    mask[:, 0] = True
    return mask


def _sample_points(target_from_source: Tensor, grid: BevGrid, warp: FeatureWarpRule) -> Tensor:
    """(N, H, W, 2) the point x, y of the source that each cell samples; −1 and 1 are the grid's ends."""
    source_from_target = torch.linalg.inv(target_from_source)
    columns, rows = (_coordinates(axis, warp, source_from_target) for axis in (grid.x, grid.y))
    points = []
    for number, (low, high, _) in enumerate((grid.x, grid.y)):
        along_x, along_y, shift = (
            source_from_target[:, number, column, None, None] for column in (0, 1, 3)
        )
        metres = along_x * columns[None, None, :] + along_y * rows[None, :, None] + shift
        points.append((metres - (low + high) / 2) / ((high - low) / 2))
    return torch.stack(points, -1)


def _coordinates(axis: Axis, warp: FeatureWarpRule, like: Tensor) -> Tensor:
    """(n,) metres: the centres of an axis' cells; if stretched, from the first centre to the *end*, evenly."""
    low, high, size = axis
    last = high if warp == "stretched" else high - size / 2
    return torch.linspace(
        low + size / 2, last, round((high - low) / size), dtype=like.dtype, device=like.device
    )
