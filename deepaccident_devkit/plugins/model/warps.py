"""Transforms between frames of moments and agents, and warps of BEV feature maps, with gradients.

The sibling of `geometry.conventions` and `motion.warping`, for complete batches. Maps are ordered
[row = y ascending, column = x ascending], and transforms have the maps' handedness; nothing here
depends on the handedness. Products are written as sums, because `autocast` would round a matrix
product to bfloat16, and metres need more digits than that.
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
    """Return rigid matrices (…, 4, 4) of 6-vectors (…, 6) in metres and radians.

    The convention is that of `geometry.conventions.matrices_of_six`.
    """
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
    """Return 6-vectors (…, 6) in metres and radians of rigid matrices (…, 4, 4).

    It is the inverse of `matrices_from_six`.
    """
    m12, m22 = matrix[..., 1, 2], matrix[..., 2, 2]
    rx = torch.atan2(-m12, m22)
    ry = torch.atan2(matrix[..., 0, 2], torch.hypot(m12, m22))
    rz = torch.atan2(-matrix[..., 0, 1], matrix[..., 0, 0])
    return torch.cat([matrix[..., :3, 3], torch.stack([rx, ry, rz], -1)], -1)


def between_augmented(
    target_from_source: Tensor, target_bev: Tensor | None, source_bev: Tensor | None
) -> Tensor:
    """Return the transform between two frames' augmented maps, (…, 4, 4).

    It is A_target · transform · A_source⁻¹.
    """
    if target_bev is not None:
        target_from_source = _product(target_bev, target_from_source)
    if source_bev is not None:
        target_from_source = _product(target_from_source, torch.linalg.inv(source_bev))
    return target_from_source


def present_from_past_batch(
    egomotion: Tensor, *, chain: Chain = "exact", bev_transform: Tensor | None = None
) -> Tensor:
    """Return transforms of the past frames to the present, oldest first, (N, P − 1, 4, 4).

    The egomotion's rows are `next_from_this` in the same order, (N, P − 1, 6). Their product is
    E_{P−2} … E_t (`exact`), or in the `released` chain E_t … E_{P−2}, which is wrong from the
    second frame before the present on. With a BEV augmentation A (N, 4, 4) it becomes A · product ·
    A⁻¹.
    """
    multiply = _product if chain == "exact" else lambda later, earlier: _product(earlier, later)
    latest_first = matrices_from_six(egomotion).unbind(1)[::-1]
    products = list(accumulate(latest_first, multiply))
    if products:
        transforms = torch.stack(products[::-1], 1)
    else:
        transforms = egomotion.new_zeros(len(egomotion), 0, 4, 4)
    return _augmented(transforms, bev_transform)


def _product(matrix: Tensor, factor: Tensor) -> Tensor:
    return (matrix[..., :, :, None] * factor[..., None, :, :]).sum(-2)


def _augmented(transforms: Tensor, bev_transform: Tensor | None) -> Tensor:
    """Return A · transforms · A⁻¹ of transforms (N, T, 4, 4) and A (N, 4, 4)."""
    matrix = None if bev_transform is None else bev_transform[:, None]
    return between_augmented(transforms, matrix, matrix)


def precise(values: Tensor) -> Tensor:
    """Return values in at least float32, if mixed precision reduced them.

    Sums over maps overflow half precision.
    """
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
    """Return feature maps (N, C, H, W) in the target's frame; zero outside the source's grid.

    `exact` samples at the centres of the target's cells. `stretched` is the released
    FeatureWarper's rule, which blurs by up to half a cell even without motion (`motion.warping`).
    Points lie on the plane z = 0; only rows x, y and columns x, y and translation of the inverse
    transform (N, 4, 4), metres, count. The result has the features' dtype; sampling is in at least
    float32.
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
    """Return the cells that the source's grid covers, (N, H, W) bool, by nearest sampling.

    Transforms have shape (N, 4, 4), metres.
    """
    filled = target_from_source.new_ones(len(target_from_source), 1, *grid.shape)
    return warp_features(filled, target_from_source, grid, warp=warp, mode="nearest")[:, 0] > 0.5


def features_to_ego(
    features: Tensor, ego_from_agent: Tensor, grid: BevGrid, *, warp: FeatureWarpRule = "exact"
) -> Tensor:
    """Return all agents' maps of one moment in the ego's frame, bilinear.

    The ego's own map, slot 0, is unchanged.

    Args:
        features: Maps, each in its agent's frame, shape (B, A, C, H, W).
        ego_from_agent: Transforms in metres, shape (B, A, 4, 4); slot 0 is not used; the identity
            if an agent is missing.
        grid: Cells of all maps.
        warp: Sampling rule.

    Returns:
        Maps, shape (B, A, C, H, W).
    """
    partners = features[:, 1:]
    warped = warp_features(
        partners.flatten(0, 1), ego_from_agent[:, 1:].flatten(0, 1), grid, warp=warp
    )
    return torch.cat([features[:, :1], warped.view_as(partners)], 1)


def agents_mask(
    agent_valid: Tensor, ego_from_agent: Tensor, grid: BevGrid, *, warp: FeatureWarpRule = "exact"
) -> Tensor:
    """Return the cells of the ego's frame that each agent covers, (B, A, H, W) bool.

    The ego, slot 0, covers all cells. Transforms (B, A, 4, 4), metres, are the identity if an agent
    is missing.
    """
    covered = inside_mask(ego_from_agent.flatten(0, 1), grid, warp=warp)
    mask = covered.unflatten(0, agent_valid.shape) & agent_valid[..., None, None]
    mask[:, 0] = True
    return mask


def _sample_points(target_from_source: Tensor, grid: BevGrid, warp: FeatureWarpRule) -> Tensor:
    """Return the source's point x, y that each cell samples, (N, H, W, 2).

    −1 and 1 are the ends of the grid.
    """
    source_from_target = torch.linalg.inv(target_from_source)
    columns, rows = (_coordinates(axis, warp, source_from_target) for axis in (grid.x, grid.y))
    points = []
    for number, (low, high, _) in enumerate((grid.x, grid.y)):
        x_factor, y_factor, shift = (
            source_from_target[:, number, column, None, None] for column in (0, 1, 3)
        )
        metres = x_factor * columns[None, None, :] + y_factor * rows[None, :, None] + shift
        points.append((metres - (low + high) / 2) / ((high - low) / 2))
    return torch.stack(points, -1)


def _coordinates(axis: Axis, warp: FeatureWarpRule, source_from_target: Tensor) -> Tensor:
    """Return the centres of an axis' cells in metres, (n,), in the dtype of the transforms.

    If stretched, they are evenly spaced from the first centre to the *end*.
    """
    low, high, size = axis
    end = high if warp == "stretched" else high - size / 2
    count = round((high - low) / size)
    return torch.linspace(
        low + size / 2, end, count, dtype=source_from_target.dtype, device=source_from_target.device
    )
