"""Warping rasters into another ego frame: transforms, and the source cell or point of each cell.

Arguments are right-handed 6-vectors and matrices. Transforms between frames, past moments and
agents are products of the motions in between, in the handedness of the protocol's native
orientation; `stretched` and `fiery` compute them in float32 as their source code does, `exact` in
float64.

Rasters are sampled in a protocol's `native` orientation, with matrices of that orientation's
handedness, by one of three rules (`WarpRule`):

- `stretched`: the released `FeatureWarper` (docs/released_code.md, Warps), which is BEVerse's.
  Sample points lie at linspace(−49.75, 50, 200) along either axis instead of at the cells' centres,
  and the outermost of them are treated as the grid's ends: without motion, cell i samples 0.4975 +
  0.9975 i, which nearest sampling rounds to i, and which blurs bilinear sampling by up to half a
  cell. Each rounding to float32 is reproduced (except for the angles of `egomotion`), since the
  last bit decides for points that lie on the border between two cells. Grids that are not centred
  on the ego do not occur in the released code; they are stretched about their own middle.
- `exact`: cell centres, in float64; without motion every cell keeps its value, in either mode.
- `fiery`: FIERY's (docs/released_code.md, FIERY's own labels), native in `fiery`. Cell centres.
  Only the yaw and the planar translation of the motion's 6-vector are used, combined as source =
  Rot(−yaw) · target + (−tx, +ty): the lateral shift has the wrong sign, and neither shift is
  rotated. FIERY has only square grids centred on the ego; other grids are measured in metres from
  the ego.

The transform is rigid (or A · rigid · A⁻¹ with an augmentation A). Points lie on the plane z = 0,
and only x and y of the transformed points are used. `source_from_target` maps points of the
result's frame to points of the raster's frame; `sampling_matrix` computes it from the released
code's arguments, which go the other way.
"""

import functools
from collections.abc import Callable, Mapping
from itertools import accumulate
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.geometry import BevGrid, conventions
from deepaccident_devkit.geometry.bev_grid import Orientation, axes_of
from deepaccident_devkit.geometry.conventions import flip_pose, flip_six_vector
from deepaccident_devkit.motion.augmentation import Augmentation
from deepaccident_devkit.motion.config import LabelProtocol, label_protocol
from deepaccident_devkit.motion.reference_arithmetic import single_precision
from deepaccident_devkit.motion.reference_arithmetic.single_precision import (
    OUTSIDE,
    CellIndices,
    SamplingLine,
    blend_cells,
    exact_lines,
    fiery_lines,
    stretched_lines,
    take_cells,
)
from deepaccident_devkit.support.arrays import AnyArray, as_numbers, checked
from deepaccident_devkit.support.text import choice
from deepaccident_devkit.v2x import future_egomotion

WarpMode = Literal["nearest", "bilinear"]
# Maximum number of cells that float32 can index exactly.
_MAX_CELLS = 2**24


class _Arithmetic(NamedTuple):
    """The matrix functions for one precision."""

    matrices: Callable[[AnyArray], AnyArray]
    rigid_inverse: Callable[[AnyArray], AnyArray]
    inverse: Callable[[AnyArray], AnyArray]
    product: Callable[[AnyArray, AnyArray], AnyArray]


_SINGLE = _Arithmetic(
    single_precision.pose_matrices,
    single_precision.rigid_inverse,
    single_precision.inverse,
    single_precision.product,
)
_DOUBLE = _Arithmetic(conventions.matrices_of_six, np.linalg.inv, np.linalg.inv, np.matmul)
_ARITHMETIC: Mapping[str, _Arithmetic] = {
    "stretched": _SINGLE,
    "fiery": _SINGLE,
    "exact": _DOUBLE,
}


def egomotion(world_from_ego: ArrayLike, valid: ArrayLike, rules: LabelProtocol) -> AnyArray:
    """Compute `v2x.future_egomotion` in a protocol's arithmetic, shape (T, 6), float32.

    The poses have the shape (T + 1, 4, 4), and `valid` marks the ones that exist. The released code
    stores poses in float32. If a sample point lies on a border between cells, the poses' last bits
    decide which cell it belongs to.
    """
    if rules.warp == "exact":
        return future_egomotion(world_from_ego, valid).astype(np.float32)
    poses = checked("world_from_ego", world_from_ego, (None, 4, 4)).astype(np.float32)
    known = checked("valid", valid, (len(poses),), np.bool_)
    has_motion = known[:-1] & known[1:]
    motion = np.zeros((len(has_motion), 6), dtype=np.float32)
    next_from_world = single_precision.rigid_inverse(poses[1:][has_motion])
    # torch's atan2 is not correctly rounded, so its angles can differ in the last bit: where a
    # sample point lies on a border between cells, a cell can differ (seen in one cell of three
    # among about 330 warped outputs of the released code).
    next_from_this = single_precision.fused_product(next_from_world, poses[:-1][has_motion])
    motion[has_motion] = conventions.six_vectors_of(next_from_this).astype(np.float32)
    return motion


def present_from_frames(
    egomotion: ArrayLike, rules: LabelProtocol, augmentation: Augmentation | None = None
) -> AnyArray:
    """Return the transforms from the present and each future frame to the present.

    The transform from frame i is C_i = E_0⁻¹ E_1⁻¹ … E_{i−1}⁻¹; the result has the shape (T, 4, 4).
    With an augmentation A, C becomes A C A⁻¹.

    Args:
        egomotion: `next_from_this` from the present on, shape (T, 6); the last row is not used.
        rules: Protocol of the labels.
        augmentation: Augmentation of all frames; None for none.
    """
    arithmetic = _ARITHMETIC[rules.warp]
    next_from_this = _make_native_matrices(egomotion, rules)[:-1]
    this_from_next = arithmetic.rigid_inverse(next_from_this)
    identity = np.eye(4, dtype=this_from_next.dtype)
    chain = accumulate(this_from_next, arithmetic.product, initial=identity)
    return _augment_transforms(np.stack(list(chain)), rules, augmentation)


def frames_from_next(
    egomotion: ArrayLike, rules: LabelProtocol, augmentation: Augmentation | None = None
) -> AnyArray:
    """Return the transforms from each frame's next frame to that frame, shape (T, 4, 4).

    `egomotion` is `next_from_this`, shape (T, 6). It is inverted by the protocol's own method.
    """
    next_from_this = _make_native_matrices(egomotion, rules)
    this_from_next = _ARITHMETIC[rules.warp].inverse(next_from_this)
    return _augment_transforms(this_from_next, rules, augmentation)


def present_from_past(
    egomotion: ArrayLike, rules: LabelProtocol, augmentation: Augmentation | None = None
) -> AnyArray:
    """Return the transforms from past moments to the present, shape (P, 4, 4), oldest first.

    The released code and FIERY multiply the motions in chronological order, E_0 E_1, so their
    transforms are wrong for all but the latest past moment; `exact` multiplies E_1 E_0.

    Args:
        egomotion: `next_from_this` of the past moments, shape (P, 6), the oldest first.
        rules: Protocol of the labels.
        augmentation: Augmentation of all moments; None for none.
    """
    product = _ARITHMETIC[rules.warp].product
    transforms = _make_native_matrices(egomotion, rules)
    for moment in reversed(range(len(transforms) - 1)):
        step = transforms[moment]
        later = transforms[moment + 1]
        if rules.warp == "exact":
            transforms[moment] = product(later, step)
        else:
            transforms[moment] = product(step, later)
    return _augment_transforms(transforms, rules, augmentation)


def ego_from_agents(
    relative_pose: ArrayLike, rules: LabelProtocol, augmentation: Augmentation | None = None
) -> AnyArray:
    """Return the transforms from agents' frames to the ego's, shape (K, 4, 4).

    The relative poses are right-handed 6-vectors (K, 6). Raise GeometryError for any other shape.
    """
    transforms = _make_native_matrices(relative_pose, rules)
    return _augment_transforms(transforms, rules, augmentation)


def _make_native_matrices(six_vectors: ArrayLike, rules: LabelProtocol) -> AnyArray:
    """Convert right-handed 6-vectors to matrices in the protocol's handedness and precision."""
    vectors = checked("egomotion", six_vectors, (None, 6))
    if not rules.right_handed:
        vectors = flip_six_vector(vectors)
    return _ARITHMETIC[rules.warp].matrices(vectors)


def _augment_transforms(
    transforms: AnyArray, rules: LabelProtocol, augmentation: Augmentation | None
) -> AnyArray:
    """Return A · transforms · A⁻¹ for an augmentation A."""
    if augmentation is None or not len(transforms):
        return transforms
    arithmetic = _ARITHMETIC[rules.warp]
    matrix = augmentation.matrix
    if not rules.right_handed:
        matrix = flip_pose(matrix)
    matrix = matrix[None].astype(transforms.dtype)
    augmented = arithmetic.product(matrix, transforms)
    return arithmetic.product(augmented, arithmetic.inverse(matrix))


def sampling_matrix(target_from_source: ArrayLike, rules: LabelProtocol) -> AnyArray:
    """Invert transforms (N, 4, 4) to `source_from_target`, in the protocol's float32 or float64."""
    shape = (None, 4, 4)
    if rules.warp == "stretched":
        transforms = checked("target_from_source", target_from_source, shape, np.float32)
        return single_precision.inverse(transforms)
    exact_transforms = checked("target_from_source", target_from_source, shape)
    return np.asarray(np.linalg.inv(exact_transforms))


def nearest_indices(
    source_from_target: ArrayLike,
    grid: BevGrid,
    rules: LabelProtocol,
    *,
    orientation: Orientation | None = None,
) -> CellIndices:
    """Return the source cell of each target cell, shape (H · W,): row · W + column.

    The index is `OUTSIDE` where the sample point is off the grid. A point half-way between two
    cells belongs to the even one.

    Args:
        source_from_target: Transform in metres and the protocol's handedness, shape (4, 4).
        grid: Cells of both rasters.
        rules: Protocol of the labels.
        orientation: Orientation of both rasters; None for the protocol's native one.

    Raises:
        GeometryError: The transform is not finite, or the grid has too many cells.
    """
    points = sample_points(source_from_target, grid, rules)
    return rounded_points(points, grid, rules, orientation)


def rounded_points(
    points: tuple[AnyArray, AnyArray],
    grid: BevGrid,
    rules: LabelProtocol,
    orientation: Orientation | None = None,
) -> CellIndices:
    """Return the same as `nearest_indices`, from the sample points."""
    if grid.cells > _MAX_CELLS:
        raise GeometryError(
            f"grid: {grid.cells} cells are more than a warp supports; choose at most {_MAX_CELLS}"
        )
    row = np.rint(points[0])
    column = np.rint(points[1])
    rows, columns = row.shape
    is_outside = (row < 0) | (row >= rows)
    is_outside |= column < 0
    is_outside |= column >= columns
    native = rules.native
    raster_orientation = orientation or native
    raster_grid = grid.with_orientation(raster_orientation)
    first, row_step, column_step = _number_cells(raster_grid, native)
    # The array of rows is turned into the indices, in place.
    row *= row_step
    column *= column_step
    row += column
    row += first
    np.copyto(row, OUTSIDE, where=is_outside)
    cells = row.astype(np.int32)  # first to int32, then to intp: three times as fast
    native_grid = grid.with_orientation(native)
    raster_cells = native_grid.reorient(cells, raster_orientation)
    return raster_cells.astype(np.intp).ravel()


def warp(
    raster: ArrayLike,
    source_from_target: ArrayLike,
    grid: BevGrid,
    rules: LabelProtocol,
    mode: WarpMode = "nearest",
    *,
    fill: float = 0,
    orientation: Orientation | None = None,
) -> AnyArray:
    """Warp rasters (…, H, W) into another frame, all by the same transform.

    Only cells move: vectors in them are not rotated.

    Args:
        raster: Rasters, shape (…, H, W).
        source_from_target: Transform, as in `nearest_indices`.
        grid: Cells of the rasters.
        rules: Protocol of the labels.
        mode: Sampling mode.
        fill: Value outside the grid; if `bilinear`, it blends into the cells at the border.
        orientation: Orientation of the rasters, as in `nearest_indices`.

    Returns:
        Rasters of the same dtype if `nearest`, float32 if `bilinear`.

    Raises:
        GeometryError: As in `nearest_indices`.
        ChoiceError: There is no such mode.
    """
    native = rules.native
    raster_grid = grid.with_orientation(orientation or native)
    source = np.asarray(raster)
    native_source = raster_grid.reorient(source, native)  # a view; raises for other shapes
    if checked_mode(mode) == "nearest":
        indices = nearest_indices(source_from_target, grid, rules, orientation=orientation)
        flat_source = source.reshape(*source.shape[:-2], -1)
        return take_cells(flat_source, indices, fill).reshape(source.shape)
    result = np.empty(source.shape, dtype=np.float32)
    points = sample_points(source_from_target, grid, rules)
    raster_grid.reorient(result, native)[...] = blend_cells(native_source, points, fill)
    return result


def checked_mode(mode: WarpMode) -> WarpMode:
    """Return `mode`, or raise ChoiceError if there is no such mode."""
    return choice("mode", mode, get_args(WarpMode))


def sample_points(
    source_from_target: ArrayLike, grid: BevGrid, rules: LabelProtocol
) -> tuple[AnyArray, AnyArray]:
    """Return the rows and columns at which each target cell samples the source, each (H, W).

    Units are cells, where 0 is the first cell's centre, in native orientation; the dtype is float64
    if the warp is `exact`, otherwise float32. Raise GeometryError if the transform is not finite.
    """
    matrix = checked("source_from_target", source_from_target, (4, 4))
    rows, columns = sampling_lines(matrix[None], grid, rules)
    return rows.points(0), columns.points(0)


def sampling_lines(
    matrices: AnyArray, grid: BevGrid, rules: LabelProtocol
) -> tuple[SamplingLine, SamplingLine]:
    """Return the lines from which `sample_points` computes its rows and columns.

    The lines allow sampling of only some cells. The matrices have the shape (N, 4, 4). Raise
    GeometryError if a number is not finite.
    """
    if not np.isfinite(matrices).all():
        raise GeometryError(
            "source_from_target: not all numbers are finite; remove frames without a pose"
        )
    if rules.warp == "fiery":
        six_vectors = conventions.six_vectors_of(np.linalg.inv(matrices)).astype(np.float32)
        components = six_vectors.T[..., None]
        return fiery_lines(components[0], components[1], components[5], grid.x, grid.y)
    native = grid.with_orientation(rules.native)
    if native.orientation == "fiery":
        row_axis = 0
    else:
        row_axis = 1
    column_axis = 1 - row_axis
    # Keep the axes along rows and columns, in metres, for points with z = 0.
    planes = matrices[:, [row_axis, column_axis]][:, :, [row_axis, column_axis, 3]]
    if rules.warp == "exact":
        return exact_lines(planes, axes_of(native))
    return stretched_lines(planes.astype(np.float32), axes_of(native))


@functools.lru_cache(maxsize=64)
def _number_cells(grid: BevGrid, native: Orientation) -> tuple[int, int, int]:
    """Return how cells in native orientation are numbered in the orientation of `grid`.

    Returns:
        Number of the first cell, step from one row to the next, and step from one column to the
        next.
    """
    numbers = np.arange(grid.cells).reshape(grid.shape)
    native_numbers = grid.reorient(numbers, native)
    rows, columns = native_numbers.shape
    first = native_numbers.item(0, 0)
    row_span = native_numbers.item(rows - 1, 0) - first
    column_span = native_numbers.item(0, columns - 1) - first
    row_step = row_span // max(rows - 1, 1)
    column_step = column_span // max(columns - 1, 1)
    return first, row_step, column_step


def past_to_present(
    features: ArrayLike,
    egomotion: ArrayLike,
    *,
    grid: BevGrid | None = None,
    protocol: str | LabelProtocol = "released",
    mode: WarpMode = "nearest",
    augmentation: Augmentation | None = None,
) -> AnyArray:
    """Warp an agent's maps from past moments into its present ego frame.

    The last map, which is the present's, is not changed.

    Args:
        features: Maps in the orientation of `grid`, shape (T, …, H, W), the oldest first.
        egomotion: Right-handed 6-vectors, shape (≥ T − 1, 6), `next_from_this` from the oldest
            moment on, such as `MotionLabels.future_egomotion`; further rows are not used.
        grid: Cells of the maps; None for the released cells in the devkit's orientation.
        protocol: Protocol with the sampling rule and the order of the motions (see
            `present_from_past`).
        mode: Sampling mode.
        augmentation: Augmentation of all maps; None for none.

    Returns:
        Maps of the same shape; of the same dtype if `nearest`, float32 if `bilinear`.

    Raises:
        GeometryError: The shapes do not fit together.
        ChoiceError: There is no such protocol or mode.
    """
    maps = _check_maps(features)
    motion = checked("egomotion", egomotion, (None, 6))
    num_past = len(maps) - 1
    if num_past > len(motion):
        raise GeometryError(f"egomotion: expected at least {num_past} rows for {len(maps)} maps")
    rules = label_protocol(protocol)
    transforms = present_from_past(motion[:num_past], rules, augmentation)
    return _warp_maps(maps, range(num_past), transforms, rules, grid, mode)


def agents_to_ego(
    features: ArrayLike,
    relative_pose: ArrayLike,
    *,
    grid: BevGrid | None = None,
    protocol: str | LabelProtocol = "released",
    mode: WarpMode = "nearest",
    augmentation: Augmentation | None = None,
) -> AnyArray:
    """Warp agents' maps from one moment into the ego's frame.

    The first map, which is the ego's, is not changed. The result and the errors are as in
    `past_to_present`.

    Args:
        features: Maps in the orientation of `grid`, shape (K, …, H, W), the ego's first.
        relative_pose: Right-handed 6-vectors `ego_from_agent`, shape (K, 6), as
            `v2x.relative_pose_to_ego` returns them.
        grid: Cells of the maps; None for the released cells in the devkit's orientation.
        protocol: Protocol with the sampling rule.
        mode: Sampling mode.
        augmentation: Augmentation of all maps; None for none.
    """
    maps = _check_maps(features)
    poses = checked("relative_pose", relative_pose, (len(maps), 6))
    rules = label_protocol(protocol)
    transforms = ego_from_agents(poses[1:], rules, augmentation)
    return _warp_maps(maps, range(1, len(maps)), transforms, rules, grid, mode)


def _check_maps(features: ArrayLike) -> AnyArray:
    """Return features as an array (K, …, H, W), or raise GeometryError."""
    maps = as_numbers("features", features, "maps (K, …, H, W)", dtype=None)
    if maps.ndim < 3 or not len(maps):
        raise GeometryError(
            f"features: expected at least one map of shape (K, …, H, W), found {maps.shape}"
        )
    return maps


def _warp_maps(
    maps: AnyArray,
    moved: range,
    target_from_source: AnyArray,
    rules: LabelProtocol,
    grid: BevGrid | None,
    mode: WarpMode,
) -> AnyArray:
    """Copy the maps, and warp the ones at the indices `moved` by their transforms."""
    grid = grid or BevGrid()
    orientation = grid.orientation
    dtype = maps.dtype
    if checked_mode(mode) == "bilinear":
        dtype = np.dtype(np.float32)
    result = maps.astype(dtype)
    matrices = sampling_matrix(target_from_source, rules)
    for index, matrix in zip(moved, matrices, strict=True):
        result[index] = warp(maps[index], matrix, grid, rules, mode, orientation=orientation)
    return result
