"""Label maps and feature maps of other moments in the present's frame."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.exact.single_precision import OUTSIDE, CellIndices, blend_cells, take_cells
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.geometry.conventions import flip_pose
from deepaccident_devkit.motion.augmentation import Augmentation
from deepaccident_devkit.motion.config import MotionLabelConfig
from deepaccident_devkit.motion.protocols import LabelProtocol, label_protocol
from deepaccident_devkit.motion.warps.chains import ego_from_agents, present_from_frames, present_from_past
from deepaccident_devkit.motion.warps.warping import (
    WarpMode,
    checked_mode,
    rounded_points,
    sample_points,
    sampling_matrix,
    warp,
)
from deepaccident_devkit.support.arrays import AnyArray, BoolArray, FloatArray, as_numbers, checked


def maps_to_present(
    maps: Mapping[str, AnyArray],
    label_egomotion: AnyArray,
    missing: BoolArray,
    config: MotionLabelConfig,
    centerness: WarpMode,
) -> dict[str, AnyArray]:
    """The maps of `MotionLabels` with every frame warped to the present ego frame; the present itself stays as it is.

    Segmentation, instance, offset and flow take the nearest cell's values. The protocol says how (`warp`), what value
    cells from outside the grid have (`outside_is_zero`) and whether offset and flow turn with the frame
    (`vectors_not_rotated`). An augmentation of the configuration counts on both sides: A C A⁻¹ (docs/released_code.md,
    Warps). A missing frame that is all `ignore_index` (not `missing_frames_are_empty`) is not warped.

    Args:
        maps: segmentation, instance, centerness, offset and flow, each frame in its own ego frame.
        label_egomotion: (T, 6) right-handed 6-vectors from the present on.
        missing: (T,) which frames are not in the recording.
        config: of the labels.
        centerness: how to sample it.

    Raises:
        ChoiceError: no such mode.
    """
    centerness = checked_mode(centerness)
    rules = config.rules
    transforms = present_from_frames(label_egomotion, rules, config.augmentation)
    ignored = np.zeros_like(missing) if rules.missing_frames_are_empty else missing
    warped = _empty_like(maps)
    for name, given in maps.items():
        warped[name][:1] = given[:1]
        warped[name][ignored] = config.ignore_index
    matrices = sampling_matrix(transforms, rules)
    for frame in np.flatnonzero(~ignored[1:]) + 1:
        points = sample_points(matrices[frame], config.grid, rules)
        indices = rounded_points(points, config.grid, rules, config.grid.orientation)
        source, target = ({name: array[frame] for name, array in each.items()} for each in (maps, warped))
        _warp_instances(source, target, indices, config)
        if centerness == "nearest":
            target["centerness"][...] = _taken(source["centerness"], indices)
        else:
            _blend(source["centerness"], target["centerness"], points, config)
        if not rules.vectors_not_rotated:
            turn = _vector_turn(transforms[frame], config)
            here = target["instance"] != 0
            for name in ("offset", "flow"):
                _turn_vectors(target[name], here, turn, config.ignore_index)
    return warped


def _empty_like(maps: Mapping[str, AnyArray]) -> dict[str, AnyArray]:
    """Arrays of these shapes in one block, which the allocator keeps for the next sample.

    Separate arrays would be returned to the system each time, and to get their pages again costs more than the warps.
    """
    block = np.empty(sum(given.nbytes for given in maps.values()), dtype=np.uint8)
    result, start = {}, 0
    for name, given in sorted(maps.items(), key=lambda item: -item[1].itemsize):  # so that all are aligned
        end = start + given.nbytes
        result[name] = block[start:end].view(given.dtype).reshape(given.shape)
        start = end
    return result


def _warp_instances(
    source: dict[str, AnyArray], target: dict[str, AnyArray], indices: CellIndices, config: MotionLabelConfig
) -> None:
    """Fill one frame's instance, segmentation, offset and flow; the last three differ from the background on few cells.

    Outside instances segmentation is 0, offset and flow are `ignore_index` (see `MotionLabels`), so only the cells of
    instances are fetched.
    """
    target["instance"][...] = _taken(source["instance"], indices)
    on_instance = np.flatnonzero(target["instance"] != 0)  # seven times as fast on a mask as on integers
    fetched = indices[on_instance]
    background = np.full(indices.size, config.ignore_index, dtype=target["offset"].dtype)
    if config.rules.outside_is_zero:
        background *= indices != OUTSIDE
    for name, beside in (("segmentation", 0), ("offset", background), ("flow", background)):
        cells, filled = (each[name].reshape(-1, indices.size) for each in (source, target))
        filled[...] = beside
        for channel, values in zip(filled, cells, strict=True):
            channel[on_instance] = values[fetched]


def _taken(raster: AnyArray, indices: CellIndices) -> AnyArray:
    return take_cells(raster.reshape(-1), indices).reshape(raster.shape)


def _blend(source: AnyArray, target: AnyArray, points: tuple[AnyArray, AnyArray], config: MotionLabelConfig) -> None:
    given, filled = (config.grid.reorient(raster, config.rules.native) for raster in (source, target))
    filled[...] = blend_cells(given, points)


def _vector_turn(present_from_frame: AnyArray, config: MotionLabelConfig) -> FloatArray:
    """(2, 2) how offset and flow (rows, columns) of a frame turn when it is warped to the present."""
    transform = present_from_frame if config.rules.right_handed else flip_pose(present_from_frame)
    metres_from_cells = _metres_from_cells(config.grid)
    turn: FloatArray = np.linalg.inv(metres_from_cells) @ transform[:2, :2] @ metres_from_cells
    return turn


def _metres_from_cells(grid: BevGrid) -> FloatArray:
    """(2, 2) steps of a row and of a column → right-handed metres x and y."""
    x, y = grid.x[2], grid.y[2]
    if grid.orientation == "fiery":
        return np.diag([x, y])
    return np.array([[0, x], [y if grid.orientation == "devkit" else -y, 0]])


def _turn_vectors(vectors: AnyArray, here: AnyArray, turn: FloatArray, ignore: int) -> None:
    known = here & (vectors != ignore).any(axis=0)
    vectors[:, known] = turn @ vectors[:, known]


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
