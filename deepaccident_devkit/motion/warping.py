"""Warping rasters into another ego frame: by which transform, and from which source cell or point each cell's value is.

6-vectors and matrices that go in are right-handed. Transforms of frames, past moments and agents are products of the
motions in between, in the handedness of the protocol's native orientation; `stretched` and `fiery` compute them in
float32 as their codes do, `exact` in float64.

Sampling is done in a protocol's `native` orientation, with matrices of that orientation's handedness, by one of
three rules (`WarpRule`):

- `stretched`: the released `FeatureWarper` (docs/released_code.md, Warps), which is BEVerse's. Sample points stand at
  linspace(−49.75, 50, 200) along either axis instead of at the cells' centres, and the outermost of them are treated
  as the grid's ends: without motion, cell i samples 0.4975 + 0.9975 i, which nearest sampling rounds to i, and which
  blurs bilinear sampling by up to half a cell. Each rounding to float32 is repeated, since the last bit decides for
  points that lie on the border between two cells (except for the angles of `egomotion`). Grids that
  are not centred on the ego have no meaning in the released code; they are stretched about their own middle.
- `exact`: cell centres, in float64; without motion every cell gets its own value, in either mode.
- `fiery`: FIERY's (docs/released_code.md, FIERY's own labels), native in `fiery`. Cell centres; of the motion only
  the 6-vector's yaw and planar translation count, combined as source = Rot(−yaw) · target + (−tx, +ty): the sideways
  shift has the wrong sign, and neither shift is turned. FIERY has only square grids centred on the ego; on others we
  measure in metres from the ego.

The transform is rigid (or A · rigid · A⁻¹ with an augmentation A). Points lie on the plane z = 0; only x and y of the
transformed points count. `source_from_target` maps points of the result's frame to points of the raster's frame:
`sampling_matrix` gets it from the released code's arguments, which go the other way.
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
# How many cells float32 can number.
_COUNTABLE: Final = 2**24


class _Arithmetic(NamedTuple):
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
    """`v2x.future_egomotion` of poses (T + 1, 4, 4) in a protocol's arithmetic: (T, 6) float32.

    The released code has the poses in float32. If a sample point lies on a border between cells, their last bits decide
    to which cell it belongs.
    """
    if rules.warp == "exact":
        return future_egomotion(world_from_ego, valid).astype(np.float32)
    poses = checked("world_from_ego", world_from_ego, (None, 4, 4)).astype(np.float32)
    known = checked("valid", valid, (len(poses),), np.bool_)
    both = known[:-1] & known[1:]
    motion = np.zeros((len(both), 6), dtype=np.float32)
    next_from_world = single_precision.rigid_inverse(poses[1:][both])
    # torch's atan2 is not correctly rounded, so its angles can differ in the last bit: at a tie, where a sample point
    # lies on a border between cells, a cell can (one in three of about 330 warped outputs of the released code)
    next_from_this = single_precision.fused_product(next_from_world, poses[:-1][both])
    motion[both] = conventions.six_vectors_of(next_from_this).astype(np.float32)
    return motion


def present_from_frames(
    egomotion: ArrayLike, rules: LabelProtocol, augmentation: Augmentation | None = None
) -> AnyArray:
    """Transforms (T, 4, 4) of the present and each future frame to the present: C_i = E_0⁻¹ E_1⁻¹ … E_{i−1}⁻¹.

    `egomotion` (T, 6) is `next_from_this` from the present on; of the last row nothing is used. Augmented, C becomes A
    C A⁻¹.
    """
    arithmetic = _ARITHMETIC[rules.warp]
    this_from_next = arithmetic.rigid_inverse(_native_matrices(egomotion, rules)[:-1])
    chain = accumulate(
        this_from_next, arithmetic.product, initial=np.eye(4, dtype=this_from_next.dtype)
    )
    return _augmented(np.stack(list(chain)), rules, augmentation)


def frames_from_next(
    egomotion: ArrayLike, rules: LabelProtocol, augmentation: Augmentation | None = None
) -> AnyArray:
    """Transforms (T, 4, 4) from each frame's next frame to that frame, of `next_from_this` (T, 6).

    The released code has a special way to invert these.
    """
    inverse = _ARITHMETIC[rules.warp].inverse(_native_matrices(egomotion, rules))
    return _augmented(inverse, rules, augmentation)


def present_from_past(
    egomotion: ArrayLike, rules: LabelProtocol, augmentation: Augmentation | None = None
) -> AnyArray:
    """Transforms (P, 4, 4) of past moments to the present, of their `next_from_this` (P, 6), the oldest first.

    The released code and FIERY multiply the motions in the order of time, E_0 E_1, and so are wrong from the second
    moment before the present on; `exact` multiplies E_1 E_0.
    """
    product, steps = _ARITHMETIC[rules.warp].product, _native_matrices(egomotion, rules)
    way = product if rules.warp == "exact" else lambda later, earlier: product(earlier, later)
    chain = list(accumulate(steps[::-1], way))
    return _augmented(np.reshape(chain[::-1], steps.shape), rules, augmentation)


def ego_from_agents(
    relative_pose: ArrayLike, rules: LabelProtocol, augmentation: Augmentation | None = None
) -> AnyArray:
    """Transforms (K, 4, 4) of agents' frames to the ego's from right-handed 6-vectors (K, 6); raises GeometryError."""
    return _augmented(_native_matrices(relative_pose, rules), rules, augmentation)


def _native_matrices(six: ArrayLike, rules: LabelProtocol) -> AnyArray:
    vectors = checked("egomotion", six, (None, 6))
    return _ARITHMETIC[rules.warp].matrices(
        vectors if rules.right_handed else flip_six_vector(vectors)
    )


def _augmented(
    transforms: AnyArray, rules: LabelProtocol, augmentation: Augmentation | None
) -> AnyArray:
    """A · transforms · A⁻¹."""
    if augmentation is None or not len(transforms):
        return transforms
    arithmetic = _ARITHMETIC[rules.warp]
    given = augmentation.matrix if rules.right_handed else flip_pose(augmentation.matrix)
    matrix = given[None].astype(transforms.dtype)
    return arithmetic.product(arithmetic.product(matrix, transforms), arithmetic.inverse(matrix))


def sampling_matrix(target_from_source: ArrayLike, rules: LabelProtocol) -> AnyArray:
    """`source_from_target` of transforms (N, 4, 4), as the protocol computes it: in float32 or float64."""
    if rules.warp == "stretched":
        return single_precision.inverse(
            checked("target_from_source", target_from_source, (None, 4, 4), np.float32)
        )
    return np.asarray(
        np.linalg.inv(checked("target_from_source", target_from_source, (None, 4, 4)))
    )


def nearest_indices(
    source_from_target: ArrayLike,
    grid: BevGrid,
    rules: LabelProtocol,
    *,
    orientation: Orientation | None = None,
) -> CellIndices:
    """The source cell (H · W,) of each target cell: row · W + column, `OUTSIDE` where the sample point is off the grid.

    `source_from_target` (4, 4) is in metres and the protocol's handedness. Both rasters lie in `orientation`, None for
    the protocol's native one. Points half-way between two cells go to the even one. Raises GeometryError.
    """
    return rounded_points(sample_points(source_from_target, grid, rules), grid, rules, orientation)


def rounded_points(
    points: tuple[AnyArray, AnyArray],
    grid: BevGrid,
    rules: LabelProtocol,
    orientation: Orientation | None = None,
) -> CellIndices:
    """`nearest_indices` from the sample points."""
    if grid.cells > _COUNTABLE:
        raise GeometryError(
            f"grid: {grid.cells} cells are more than a warp can number; choose at most {_COUNTABLE}"
        )
    row, column = np.rint(points[0]), np.rint(points[1])
    rows, columns = row.shape
    beside = (row < 0) | (row >= rows)
    beside |= column < 0
    beside |= column >= columns
    native = rules.native
    lying = native if orientation is None else orientation
    first, down, along = _numbering(grid.with_orientation(lying), native)
    row *= down
    column *= along
    row += column
    row += first
    np.copyto(row, OUTSIDE, where=beside)
    cells = row.astype(np.int32)  # first to int32, then to intp: three times as fast
    return grid.with_orientation(native).reorient(cells, lying).astype(np.intp).ravel()


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
    """Rasters (…, H, W) in another frame, all the same way: of the same dtype if `nearest`, float32 if `bilinear`.

    `source_from_target`, `orientation` and errors as in `nearest_indices`; `fill` is the value outside the grid, which
    mixes with the border's cells if bilinear. Only cells change places: vectors do not turn.
    """
    native = rules.native
    lying = grid.with_orientation(orientation or native)
    source = np.asarray(raster)
    by_native_rows = lying.reorient(source, native)  # a view; refuses other shapes
    if checked_mode(mode) == "nearest":
        indices = nearest_indices(source_from_target, grid, rules, orientation=orientation)
        return take_cells(source.reshape(*source.shape[:-2], -1), indices, fill).reshape(
            source.shape
        )
    result = np.empty(source.shape, dtype=np.float32)
    points = sample_points(source_from_target, grid, rules)
    lying.reorient(result, native)[...] = blend_cells(by_native_rows, points, fill)
    return result


def checked_mode(mode: WarpMode) -> WarpMode:
    """`mode`, or ChoiceError."""
    return choice("mode", mode, get_args(WarpMode))


def sample_points(
    source_from_target: ArrayLike, grid: BevGrid, rules: LabelProtocol
) -> tuple[AnyArray, AnyArray]:
    """Where in the source each target cell samples: rows and columns (H, W), in cells, 0 the first cell's centre.

    Native orientation; float32, but float64 if `exact`. Raises GeometryError.
    """
    matrix = checked("source_from_target", source_from_target, (4, 4))
    rows, columns = sampling_lines(matrix[None], grid, rules)
    return rows.points(0), columns.points(0)


def sampling_lines(
    matrices: AnyArray, grid: BevGrid, rules: LabelProtocol
) -> tuple[SamplingLine, SamplingLine]:
    """What `sample_points` computes its rows and columns from, for matrices (N, 4, 4): to sample only some cells.

    Raises GeometryError.
    """
    if not np.isfinite(matrices).all():
        raise GeometryError(
            "source_from_target: not all numbers are finite; leave out frames without a pose"
        )
    if rules.warp == "fiery":
        numbers = (
            conventions.six_vectors_of(np.linalg.inv(matrices)).astype(np.float32).T[..., None]
        )
        return fiery_lines(numbers[0], numbers[1], numbers[5], grid.x, grid.y)
    native = grid.with_orientation(rules.native)
    order = [0, 1] if native.orientation == "fiery" else [1, 0]
    planes = matrices[:, order][:, :, [*order, 3]]  # z = 0: metres along rows and columns
    if rules.warp == "exact":
        return exact_lines(planes, axes_of(native))
    return stretched_lines(planes.astype(np.float32), axes_of(native))


@functools.lru_cache(maxsize=64)
def _numbering(grid: BevGrid, native: Orientation) -> tuple[int, int, int]:
    """How `grid`'s orientation numbers the cells of the native one: the first, the step of a row, of a column."""
    numbers = grid.reorient(np.arange(grid.cells).reshape(grid.shape), native)
    first, below, beside = (
        int(corner) for corner in (numbers[0, 0], numbers[-1, 0], numbers[0, -1])
    )
    rows, columns = (max(count - 1, 1) for count in numbers.shape)
    return first, (below - first) // rows, (beside - first) // columns


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
        protocol: whose sampling rule, and whose order of the motions (see `present_from_past`).
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
    return _warped(
        maps,
        list(range(1, len(maps))),
        ego_from_agents(poses[1:], rules, augmentation),
        rules,
        grid,
        mode,
    )


def _maps(features: ArrayLike) -> AnyArray:
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
    """A copy of the maps in which those numbered `moved` are warped, each with its transform."""
    cells = BevGrid() if grid is None else grid
    result = maps.astype(maps.dtype if checked_mode(mode) == "nearest" else np.float32)
    for index, matrix in zip(moved, sampling_matrix(target_from_source, rules), strict=True):
        result[index] = warp(maps[index], matrix, cells, rules, mode, orientation=cells.orientation)
    return result
