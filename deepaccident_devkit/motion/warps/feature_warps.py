"""Feature maps of past moments and of other agents in the present ego frame, for models that fuse them."""

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.arrays import AnyArray, as_numbers, checked
from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion.augmentation import Augmentation
from deepaccident_devkit.motion.protocols import LabelProtocol, label_protocol
from deepaccident_devkit.motion.warps.chains import ego_from_agents, present_from_past
from deepaccident_devkit.motion.warps.warping import WarpMode, checked_mode, sampling_matrix, warp


def past_to_present(
    features: ArrayLike,
    egomotion: ArrayLike,
    *,
    grid: BevGrid | None = None,
    protocol: str | LabelProtocol = "released",
    mode: WarpMode = "nearest",
    augmentation: Augmentation | None = None,
) -> AnyArray:
    """An agent's maps of past moments in its present ego frame; the present, the last one, stays as it is.

    Args:
        features: (T, …, H, W) maps in the orientation of `grid`, the oldest first.
        egomotion: (≥ T − 1, 6) right-handed 6-vectors, `next_from_this` from the oldest moment on, such as
            `MotionLabels.future_egomotion`; further rows are not used.
        grid: the maps' cells; the released ones in the devkit's orientation if None.
        protocol: whose sampling rule, and whose order of the motions (see `chains.present_from_past`).
        mode: how to sample.
        augmentation: the one that all maps have.

    Returns:
        The same shape; of the same dtype if `nearest`, float32 if `bilinear`.

    Raises:
        GeometryError: shapes that do not fit.
        ChoiceError: no such protocol or mode.
    """
    maps = _maps(features)
    motion = checked("egomotion", egomotion, (None, 6))
    if len(maps) > len(motion) + 1:
        raise GeometryError(f"egomotion: expected at least {len(maps) - 1} rows for {len(maps)} maps")
    rules = label_protocol(protocol)
    transforms = present_from_past(motion[: len(maps) - 1], rules, augmentation)
    return _warped(maps, list(range(len(maps) - 1)), transforms, rules, grid, mode)


def agents_to_ego(
    features: ArrayLike,
    relative_pose: ArrayLike,
    *,
    grid: BevGrid | None = None,
    protocol: str | LabelProtocol = "released",
    mode: WarpMode = "nearest",
    augmentation: Augmentation | None = None,
) -> AnyArray:
    """Agents' maps of one moment in the ego's frame; the ego's own, the first one, stays as it is.

    Args:
        features: (K, …, H, W) maps in the orientation of `grid`, the ego's first.
        relative_pose: (K, 6) right-handed 6-vectors `ego_from_agent`, as `v2x.relative_pose_to_ego` gives them.
        grid: see `past_to_present`, as for all later arguments, the result and the errors.
        protocol: whose sampling rule.
        mode: how to sample.
        augmentation: the one that all maps have.
    """
    maps = _maps(features)
    poses = checked("relative_pose", relative_pose, (len(maps), 6))
    rules = label_protocol(protocol)
    return _warped(maps, list(range(1, len(maps))), ego_from_agents(poses[1:], rules, augmentation), rules, grid, mode)


def _maps(features: ArrayLike) -> AnyArray:
    maps = as_numbers("features", features, "maps (K, …, H, W)", dtype=None)
    if maps.ndim < 3 or not len(maps):
        raise GeometryError(f"features: expected at least one map of shape (K, …, H, W), found {maps.shape}")
    return maps


def _warped(
    maps: AnyArray,
    moved: list[int],
    target_from_source: AnyArray,
    rules: LabelProtocol,
    grid: BevGrid | None,
    mode: WarpMode,
) -> AnyArray:
    """A copy of the maps in which those numbered `moved` are warped, each with its transform."""
    cells = BevGrid() if grid is None else grid
    result = maps.astype(maps.dtype if checked_mode(mode) == "nearest" else np.float32)
    for index, matrix in zip(moved, sampling_matrix(target_from_source, rules), strict=True):
        result[index] = warp(maps[index], matrix, cells, rules, mode, orientation=cells.orientation)
    return result
