"""Warping rasters into another ego frame: transforms, and the source cell or point of each cell.

Arguments are right-handed 6-vectors and matrices. Transforms of frames, past moments and agents are
products of the motions in between, in the handedness of the protocol's native orientation;
`stretched` and `fiery` compute them in float32 as their codes do, `exact` in float64.

Rasters are sampled in a protocol's `native` orientation, with matrices of that orientation's
handedness, by one of three rules (`WarpRule`):

- `stretched`: the released `FeatureWarper` (docs/released_code.md, Warps), which is BEVerse's.
  Sample points stand at linspace(−49.75, 50, 200) along either axis instead of at the cells'
  centres, and the outermost of them are treated as the grid's ends: without motion, cell i samples
  0.4975 + 0.9975 i, which nearest sampling rounds to i, and which blurs bilinear sampling by up to
  half a cell. Each rounding to float32 is repeated, since the last bit decides for points that lie
  on the border between two cells (except for the angles of `egomotion`). Grids that are not centred
  on the ego do not occur in the released code; they are stretched about their own middle.
- `exact`: cell centres, in float64; without motion every cell gets its own value, in either mode.
- `fiery`: FIERY's (docs/released_code.md, FIERY's own labels), native in `fiery`. Cell centres;
  of the motion only the 6-vector's yaw and planar translation count, combined as source =
  Rot(−yaw) · target + (−tx, +ty): the sideways shift has the wrong sign, and neither shift is
  turned. FIERY has only square grids centred on the ego; other grids are measured in metres from
  the ego.

The transform is rigid (or A · rigid · A⁻¹ with an augmentation A). Points lie on the plane z = 0;
only x and y of the transformed points count. `source_from_target` maps points of the result's frame
to points of the raster's frame: `sampling_matrix` gets it from the released code's arguments, which
go the other way.
"""

import functools
from collections.abc import Callable, Mapping
from itertools import accumulate
from typing import Final, Literal, NamedTuple, get_args

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
# Float32 can number this many cells.
_MAX_CELLS: Final = 2**24


class _Arithmetic(NamedTuple):
    """Functions for matrices in one precision."""

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
_ARITHMETIC: Final[Mapping[str, _Arithmetic]] = {
    "stretched": _SINGLE,
    "fiery": _SINGLE,
    "exact": _DOUBLE,
}


def egomotion(world_from_ego: ArrayLike, valid: ArrayLike, rules: LabelProtocol) -> AnyArray:
    """Return `v2x.future_egomotion` of poses in a protocol's arithmetic, shape (T, 6), float32.

    The poses have the shape (T + 1, 4, 4). The released code has the poses in float32. If a sample
    point lies on a border between cells, their last bits decide to which cell it belongs.
    """
    if rules.warp == "exact":
        return future_egomotion(world_from_ego, valid).astype(np.float32)
    poses = checked("world_from_ego", world_from_ego, (None, 4, 4)).astype(np.float32)
    known = checked("valid", valid, (len(poses),), np.bool_)
    has_motion = known[:-1] & known[1:]
    motion = np.zeros((len(has_motion), 6), dtype=np.float32)
    next_from_world = single_precision.rigid_inverse(poses[1:][has_motion])
    # torch's atan2 is not correctly rounded, so its angles can differ in the last bit: at a tie,
    # where a sample point lies on a border between cells, a cell can differ (in one of three of
    # about 330 warped outputs of the released code).
    next_from_this = single_precision.fused_product(next_from_world, poses[:-1][has_motion])
    motion[has_motion] = conventions.six_vectors_of(next_from_this).astype(np.float32)
    return motion


def present_from_frames(
    egomotion: ArrayLike, rules: LabelProtocol, augmentation: Augmentation | None = None
) -> AnyArray:
    """Return the transforms of the present and each future frame to the present.

    They are C_i = E_0⁻¹ E_1⁻¹ … E_{i−1}⁻¹, shape (T, 4, 4). With an augmentation A, C becomes A C
    A⁻¹.

    Args:
        egomotion: `next_from_this` from the present on, shape (T, 6); the last row is not used.
        rules: Protocol of the labels.
        augmentation: Augmentation of all frames.
    """
    arithmetic = _ARITHMETIC[rules.warp]
    this_from_next = arithmetic.rigid_inverse(_native_matrices(egomotion, rules)[:-1])
    identity = np.eye(4, dtype=this_from_next.dtype)
    chain = accumulate(this_from_next, arithmetic.product, initial=identity)
    return _augmented(np.stack(list(chain)), rules, augmentation)


def frames_from_next(
    egomotion: ArrayLike, rules: LabelProtocol, augmentation: Augmentation | None = None
) -> AnyArray:
    """Return the transforms from each frame's next frame to that frame, shape (T, 4, 4).

    The released code has a special method to invert `next_from_this` (T, 6).
    """
    inverse = _ARITHMETIC[rules.warp].inverse(_native_matrices(egomotion, rules))
    return _augmented(inverse, rules, augmentation)


def present_from_past(
    egomotion: ArrayLike, rules: LabelProtocol, augmentation: Augmentation | None = None
) -> AnyArray:
    """Return the transforms of past moments to the present, shape (P, 4, 4), the oldest first.

    The released code and FIERY multiply the motions in the order of time, E_0 E_1, and are
    therefore wrong from the second moment before the present on; `exact` multiplies E_1 E_0.

    Args:
        egomotion: `next_from_this` of the past moments, shape (P, 6), the oldest first.
        rules: Protocol of the labels.
        augmentation: Augmentation of all moments.
    """
    product = _ARITHMETIC[rules.warp].product
    steps = _native_matrices(egomotion, rules)

    def reversed_product(later: AnyArray, earlier: AnyArray) -> AnyArray:
        return product(earlier, later)

    combine = product if rules.warp == "exact" else reversed_product
    chain = list(accumulate(steps[::-1], combine))
    return _augmented(np.reshape(chain[::-1], steps.shape), rules, augmentation)


def ego_from_agents(
    relative_pose: ArrayLike, rules: LabelProtocol, augmentation: Augmentation | None = None
) -> AnyArray:
    """Return the transforms of agents' frames to the ego's, shape (K, 4, 4).

    The relative poses are right-handed 6-vectors (K, 6). Raises GeometryError.
    """
    return _augmented(_native_matrices(relative_pose, rules), rules, augmentation)


def _native_matrices(six_vectors: ArrayLike, rules: LabelProtocol) -> AnyArray:
    """Return the matrices of right-handed 6-vectors in the protocol's handedness and precision."""
    vectors = checked("egomotion", six_vectors, (None, 6))
    if not rules.right_handed:
        vectors = flip_six_vector(vectors)
    return _ARITHMETIC[rules.warp].matrices(vectors)


def _augmented(
    transforms: AnyArray, rules: LabelProtocol, augmentation: Augmentation | None
) -> AnyArray:
    """Return A · transforms · A⁻¹ for an augmentation A."""
    if augmentation is None or not len(transforms):
        return transforms
    arithmetic = _ARITHMETIC[rules.warp]
    native = augmentation.matrix if rules.right_handed else flip_pose(augmentation.matrix)
    matrix = native[None].astype(transforms.dtype)
    changed = arithmetic.product(matrix, transforms)
    return arithmetic.product(changed, arithmetic.inverse(matrix))


def sampling_matrix(target_from_source: ArrayLike, rules: LabelProtocol) -> AnyArray:
    """Return `source_from_target` of transforms (N, 4, 4) in the protocol's float32 or float64."""
    shape = (None, 4, 4)
    if rules.warp == "stretched":
        transforms = checked("target_from_source", target_from_source, shape, np.float32)
        return single_precision.inverse(transforms)
    return np.asarray(np.linalg.inv(checked("target_from_source", target_from_source, shape)))


def nearest_indices(
    source_from_target: ArrayLike,
    grid: BevGrid,
    rules: LabelProtocol,
    *,
    orientation: Orientation | None = None,
) -> CellIndices:
    """Return the source cell of each target cell, shape (H · W,): row · W + column.

    It is `OUTSIDE` where the sample point is off the grid. Points half-way between two cells go to
    the even one.

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
    """Return `nearest_indices` from the sample points."""
    if grid.cells > _MAX_CELLS:
        raise GeometryError(
            f"grid: {grid.cells} cells are more than a warp can number; choose at most {_MAX_CELLS}"
        )
    row = np.rint(points[0])
    column = np.rint(points[1])
    rows, columns = row.shape
    is_outside = (row < 0) | (row >= rows)
    is_outside |= column < 0
    is_outside |= column >= columns
    native = rules.native
    raster_orientation = native if orientation is None else orientation
    first, row_step, column_step = _numbering(grid.with_orientation(raster_orientation), native)
    # The rows become the indices, in place.
    row *= row_step
    column *= column_step
    row += column
    row += first
    np.copyto(row, OUTSIDE, where=is_outside)
    cells = row.astype(np.int32)  # first to int32, then to intp: three times as fast
    native_grid = grid.with_orientation(native)
    return native_grid.reorient(cells, raster_orientation).astype(np.intp).ravel()


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

    Only cells move: vectors do not turn.

    Args:
        raster: Rasters, shape (…, H, W).
        source_from_target: Transform, as in `nearest_indices`.
        grid: Cells of the rasters.
        rules: Protocol of the labels.
        mode: How to sample.
        fill: Value outside the grid, which mixes with the border's cells if `bilinear`.
        orientation: Orientation of the rasters, as in `nearest_indices`.

    Returns:
        Rasters of the same dtype if `nearest`, float32 if `bilinear`.

    Raises:
        GeometryError: As in `nearest_indices`.
        ChoiceError: No such mode.
    """
    native = rules.native
    raster_grid = grid.with_orientation(orientation or native)
    source = np.asarray(raster)
    native_source = raster_grid.reorient(source, native)  # a view; refuses other shapes
    if checked_mode(mode) == "nearest":
        indices = nearest_indices(source_from_target, grid, rules, orientation=orientation)
        flat_source = source.reshape(*source.shape[:-2], -1)
        return take_cells(flat_source, indices, fill).reshape(source.shape)
    result = np.empty(source.shape, dtype=np.float32)
    points = sample_points(source_from_target, grid, rules)
    raster_grid.reorient(result, native)[...] = blend_cells(native_source, points, fill)
    return result


def checked_mode(mode: WarpMode) -> WarpMode:
    """Return `mode`, or raise ChoiceError."""
    return choice("mode", mode, get_args(WarpMode))


def sample_points(
    source_from_target: ArrayLike, grid: BevGrid, rules: LabelProtocol
) -> tuple[AnyArray, AnyArray]:
    """Return the rows and columns at which each target cell samples the source, each (H, W).

    They are in cells, 0 the first cell's centre, in native orientation; float32, but float64 if
    `exact`. Raises GeometryError.
    """
    matrix = checked("source_from_target", source_from_target, (4, 4))
    rows, columns = sampling_lines(matrix[None], grid, rules)
    return rows.points(0), columns.points(0)


def sampling_lines(
    matrices: AnyArray, grid: BevGrid, rules: LabelProtocol
) -> tuple[SamplingLine, SamplingLine]:
    """Return the lines from which `sample_points` computes its rows and columns.

    With them only some cells can be sampled. The matrices have the shape (N, 4, 4). Raises
    GeometryError.
    """
    if not np.isfinite(matrices).all():
        raise GeometryError(
            "source_from_target: not all numbers are finite; leave out frames without a pose"
        )
    if rules.warp == "fiery":
        six_vectors = conventions.six_vectors_of(np.linalg.inv(matrices)).astype(np.float32)
        components = six_vectors.T[..., None]
        return fiery_lines(components[0], components[1], components[5], grid.x, grid.y)
    native = grid.with_orientation(rules.native)
    order = [0, 1] if native.orientation == "fiery" else [1, 0]
    planes = matrices[:, order][:, :, [*order, 3]]  # z = 0: metres along rows and columns
    if rules.warp == "exact":
        return exact_lines(planes, axes_of(native))
    return stretched_lines(planes.astype(np.float32), axes_of(native))


@functools.lru_cache(maxsize=64)
def _numbering(grid: BevGrid, native: Orientation) -> tuple[int, int, int]:
    """Return how the orientation of `grid` numbers the cells of the native one.

    Returns:
        Number of the first cell, step of a row, and step of a column.
    """
    numbers = grid.reorient(np.arange(grid.cells).reshape(grid.shape), native)
    first, last_row, last_column = (
        int(corner) for corner in (numbers[0, 0], numbers[-1, 0], numbers[0, -1])
    )
    row_steps, column_steps = (max(count - 1, 1) for count in numbers.shape)
    return first, (last_row - first) // row_steps, (last_column - first) // column_steps


def past_to_present(
    features: ArrayLike,
    egomotion: ArrayLike,
    *,
    grid: BevGrid | None = None,
    protocol: str | LabelProtocol = "released",
    mode: WarpMode = "nearest",
    augmentation: Augmentation | None = None,
) -> AnyArray:
    """Warp an agent's maps of past moments into its present ego frame.

    The present, the last map, does not change.

    Args:
        features: Maps in the orientation of `grid`, shape (T, …, H, W), the oldest first.
        egomotion: Right-handed 6-vectors, shape (≥ T − 1, 6), `next_from_this` from the oldest
            moment on, such as `MotionLabels.future_egomotion`; further rows are not used.
        grid: Cells of the maps; None for the released cells in the devkit's orientation.
        protocol: Protocol with the sampling rule and the order of the motions (see
            `present_from_past`).
        mode: How to sample.
        augmentation: Augmentation of all maps.

    Returns:
        Maps of the same shape; of the same dtype if `nearest`, float32 if `bilinear`.

    Raises:
        GeometryError: Shapes that do not fit.
        ChoiceError: No such protocol or mode.
    """
    maps = _checked_maps(features)
    motion = checked("egomotion", egomotion, (None, 6))
    if len(maps) > len(motion) + 1:
        raise GeometryError(
            f"egomotion: expected at least {len(maps) - 1} rows for {len(maps)} maps"
        )
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
    """Warp agents' maps of one moment into the ego's frame.

    The ego's own map, the first one, does not change. The result and the errors are as in
    `past_to_present`.

    Args:
        features: Maps in the orientation of `grid`, shape (K, …, H, W), the ego's first.
        relative_pose: Right-handed 6-vectors `ego_from_agent`, shape (K, 6), as
            `v2x.relative_pose_to_ego` returns them.
        grid: Cells of the maps; None for the released cells in the devkit's orientation.
        protocol: Protocol with the sampling rule.
        mode: How to sample.
        augmentation: Augmentation of all maps.
    """
    maps = _checked_maps(features)
    poses = checked("relative_pose", relative_pose, (len(maps), 6))
    rules = label_protocol(protocol)
    transforms = ego_from_agents(poses[1:], rules, augmentation)
    return _warped(maps, list(range(1, len(maps))), transforms, rules, grid, mode)


def _checked_maps(features: ArrayLike) -> AnyArray:
    """Return features as an array (K, …, H, W), or raise GeometryError."""
    maps = as_numbers("features", features, "maps (K, …, H, W)", dtype=None)
    if maps.ndim < 3 or not len(maps):
        raise GeometryError(
            f"features: expected at least one map of shape (K, …, H, W), found {maps.shape}"
        )
    return maps


def _warped(
    maps: AnyArray,
    moved: list[int],
    target_from_source: AnyArray,
    rules: LabelProtocol,
    grid: BevGrid | None,
    mode: WarpMode,
) -> AnyArray:
    """Return a copy of the maps; the maps with numbers `moved` are warped by their transforms."""
    cells = BevGrid() if grid is None else grid
    orientation = cells.orientation
    result = maps.astype(maps.dtype if checked_mode(mode) == "nearest" else np.float32)
    for index, matrix in zip(moved, sampling_matrix(target_from_source, rules), strict=True):
        result[index] = warp(maps[index], matrix, cells, rules, mode, orientation=orientation)
    return result
