"""Differentiable transforms between moments and agents, and warps of BEV feature maps.

The counterpart of `geometry.conventions` and `motion.warping` for whole batches. Maps are ordered
[row = y ascending, column = x ascending], and transforms have the maps' handedness; no function
here depends on which one it is. Products are written as sums, because `autocast` would round a
matrix product to bfloat16, which is too coarse for metres.
"""

from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional

from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.geometry.bev_grid import Axis
from deepaccident_devkit.motion.warping import WarpMode

Chain = Literal["released", "exact"]
FeatureWarpRule = Literal["stretched", "exact"]
# Nearest sampling gives 1 within the source's grid and 0 outside.
_INSIDE_THRESHOLD = 0.5


def matrices_from_six(six: Tensor) -> Tensor:
    """Convert 6-vectors (…, 6; metres, radians) to rigid matrices (…, 4, 4).

    The convention is the same as in `geometry.conventions.matrices_of_six`.
    """
    cx, cy, cz = torch.cos(six[..., 3:]).unbind(-1)
    sx, sy, sz = torch.sin(six[..., 3:]).unbind(-1)
    tx, ty, tz = six[..., :3].unbind(-1)
    zeros = torch.zeros_like(tx)
    ones = torch.ones_like(tx)
    sx_sy = sx * sy
    cx_sy = cx * sy
    rows = (
        (cy * cz, -cy * sz, sy, tx),
        (cx * sz + sx_sy * cz, cx * cz - sx_sy * sz, -sx * cy, ty),
        (sx * sz - cx_sy * cz, sx * cz + cx_sy * sz, cx * cy, tz),
        (zeros, zeros, zeros, ones),
    )
    stacked_rows = [torch.stack(row, -1) for row in rows]
    return torch.stack(stacked_rows, -2)


def six_from_matrices(matrix: Tensor) -> Tensor:
    """Convert rigid matrices (…, 4, 4) to 6-vectors (…, 6) in metres and radians.

    This is the inverse of `matrices_from_six`.
    """
    first_row = matrix[..., 0, :]
    minus_sx_cy = matrix[..., 1, 2]
    cx_cy = matrix[..., 2, 2]
    rx = torch.atan2(-minus_sx_cy, cx_cy)
    ry = torch.atan2(first_row[..., 2], torch.hypot(minus_sx_cy, cx_cy))
    rz = torch.atan2(-first_row[..., 1], first_row[..., 0])
    angles = torch.stack([rx, ry, rz], -1)
    translation = matrix[..., :3, 3]
    return torch.cat([translation, angles], -1)


def between_augmented(
    target_from_source: Tensor, target_bev: Tensor | None, source_bev: Tensor | None
) -> Tensor:
    """Return the transform between two frames' augmented maps, (…, 4, 4).

    The result is A_target · transform · A_source⁻¹.
    """
    if target_bev is not None:
        target_from_source = _multiply(target_bev, target_from_source)
    if source_bev is not None:
        source_from_bev = torch.linalg.inv(source_bev)
        target_from_source = _multiply(target_from_source, source_from_bev)
    return target_from_source


def present_from_past_batch(
    egomotion: Tensor, *, chain: Chain = "exact", bev_transform: Tensor | None = None
) -> Tensor:
    """Return the transforms from past frames to the present, oldest first, (N, P − 1, 4, 4).

    The egomotion's rows are `next_from_this` in the same order, (N, P − 1, 6). The transform of
    frame t is E_{P−2} … E_t with the chain `exact`. With the chain `released` it is E_t … E_{P−2},
    which is wrong for all but the latest past frame. A BEV augmentation A (N, 4, 4) turns it into A
    · product · A⁻¹.
    """
    steps = matrices_from_six(egomotion)
    if not steps.shape[1]:
        return steps
    product = steps[:, -1]
    products = [product]
    for step in reversed(steps[:, :-1].unbind(1)):
        if chain == "exact":
            product = _multiply(product, step)
        else:
            product = _multiply(step, product)
        products.append(product)
    transforms = torch.stack(products[::-1], 1)
    if bev_transform is None:
        return transforms
    matrix = bev_transform[:, None]
    return between_augmented(transforms, matrix, matrix)


def _multiply(left: Tensor, right: Tensor) -> Tensor:
    """Return products of matrices (…, 4, 4), written as sums so that they stay precise."""
    terms = left[..., :, :, None] * right[..., None, :, :]
    return terms.sum(-2)


def precise(values: Tensor) -> Tensor:
    """Convert values to at least float32, in case mixed precision reduced them.

    Sums over maps overflow half precision.
    """
    dtype = torch.promote_types(values.dtype, torch.float32)
    return values.to(dtype)


def warp_features(
    features: Tensor,
    target_from_source: Tensor,
    grid: BevGrid,
    *,
    warp: FeatureWarpRule = "exact",
    mode: WarpMode = "bilinear",
) -> Tensor:
    """Warp feature maps (N, C, H, W) to the target's frame; zero outside the source's grid.

    `exact` samples at the centres of the target's cells. `stretched` is the rule of the released
    FeatureWarper, which blurs by up to half a cell even without motion (`motion.warping`). Points
    lie on the plane z = 0, so only the x and y rows of the inverse transform (N, 4, 4), in metres,
    are used, with their x, y and translation columns. The result has the features' dtype; sampling
    is in at least float32.
    """
    points = _find_sample_points(target_from_source, grid, warp)
    precise_features = precise(features)
    sampled = functional.grid_sample(
        precise_features,
        points.to(precise_features.dtype),
        mode=mode,
        padding_mode="zeros",
        align_corners=warp == "stretched",
    )
    return sampled.to(features.dtype)


def inside_mask(
    target_from_source: Tensor, grid: BevGrid, *, warp: FeatureWarpRule = "exact"
) -> Tensor:
    """Return whether the source's grid covers each cell, (N, H, W) bool, by nearest sampling.

    Transforms have shape (N, 4, 4), metres.
    """
    source_maps = target_from_source.new_ones(len(target_from_source), 1, *grid.shape)
    covered = warp_features(source_maps, target_from_source, grid, warp=warp, mode="nearest")
    return covered[:, 0] > _INSIDE_THRESHOLD


def features_to_ego(
    features: Tensor, ego_from_agent: Tensor, grid: BevGrid, *, warp: FeatureWarpRule = "exact"
) -> Tensor:
    """Warp all agents' maps of one moment to the ego's frame, with bilinear sampling.

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
    ego_from_partner = ego_from_agent[:, 1:].flatten(0, 1)
    warped = warp_features(partners.flatten(0, 1), ego_from_partner, grid, warp=warp)
    return torch.cat([features[:, :1], warped.view_as(partners)], 1)


def agents_mask(
    agent_valid: Tensor, ego_from_agent: Tensor, grid: BevGrid, *, warp: FeatureWarpRule = "exact"
) -> Tensor:
    """Return whether each agent covers each cell of the ego's frame, (B, A, H, W) bool.

    The ego, slot 0, covers all cells. Transforms (B, A, 4, 4), metres, are the identity if an agent
    is missing.
    """
    covered = inside_mask(ego_from_agent.flatten(0, 1), grid, warp=warp)
    mask = covered.unflatten(0, agent_valid.shape) & agent_valid[..., None, None]
    mask[:, 0] = True
    return mask


def _find_sample_points(target_from_source: Tensor, grid: BevGrid, warp: FeatureWarpRule) -> Tensor:
    """Return the point (x, y) of the source that each cell samples, (N, H, W, 2).

    Coordinates are normalised so that −1 and 1 are the ends of the grid.
    """
    source_from_target = torch.linalg.inv(target_from_source)
    x = _space_centers(grid.x, warp, source_from_target)
    y = _space_centers(grid.y, warp, source_from_target)[:, None]
    points = []
    for row, axis in enumerate((grid.x, grid.y)):
        factors = source_from_target[:, row, :, None, None]
        x_factor = factors[:, 0]
        y_factor = factors[:, 1]
        shift = factors[:, 3]
        metres = x_factor * x + y_factor * y + shift
        low, high, _ = axis
        middle = (low + high) / 2
        half_extent = (high - low) / 2
        points.append((metres - middle) / half_extent)
    return torch.stack(points, -1)


def _space_centers(axis: Axis, warp: FeatureWarpRule, like: Tensor) -> Tensor:
    """Return the centres of an axis' cells in metres, (n,), with the dtype and device of `like`.

    With `stretched`, they are evenly spaced from the first centre to the *end* of the axis.
    """
    low, high, size = axis
    first_center = low + size / 2
    last_center = high
    if warp == "exact":
        last_center -= size / 2
    count = round((high - low) / size)
    return torch.linspace(first_center, last_center, count, dtype=like.dtype, device=like.device)
