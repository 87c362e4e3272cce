"""Motion labels from boxes: the actors' cells and ids, and their positions at the next frame."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.errors import ConfigError, GeometryError
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.geometry.bev_grid import cells_in, vectors_in
from deepaccident_devkit.motion.box_polygons import (
    Footprints,
    FrameBoxes,
    FramePolygons,
    Polygons,
    box_polygons,
    rasterise_polygons,
)
from deepaccident_devkit.motion.config import (
    LabelProtocol,
    MotionLabelConfig,
    resolved_label_config,
)
from deepaccident_devkit.motion.labels import MotionLabels
from deepaccident_devkit.motion.reference_arithmetic.single_precision import SamplingLine
from deepaccident_devkit.motion.warping import (
    frames_from_next,
    nearest_indices,
    sampling_lines,
    sampling_matrix,
)
from deepaccident_devkit.support.arrays import (
    NO_INDICES,
    AnyArray,
    BoolArray,
    Float32Array,
    FloatArray,
    IntArray,
    checked,
    checked_count,
    checked_whole,
    keep_freed,
)
from deepaccident_devkit.taxonomy import UNTRACKED_ID

# Float32 represents all integers up to this id.
_MAX_ID = 2**24
# From this x on, exp(−x) is 0 in float32.
_ZERO_EXPONENT = 104.0
# Margin around a footprint: half a cell for the nearest sampling, and the rest for the rounding of
# the points.
_MARGIN_CELLS = 0.75
# If the first sample point were farther away, the rounding of float32 would outgrow the margin.
_MAX_POINT_CELLS = 2.0**16
# Permitted range of the distance between neighbouring sample points, in source cells.
_MIN_SCALE = 0.25
_MAX_SCALE = 4


def motion_labels_from_boxes(
    frames: Sequence[FrameBoxes | None],
    egomotion: ArrayLike,
    config: MotionLabelConfig | str | None = None,
    *,
    valid: ArrayLike | None = None,
    is_vehicle: bool = True,
    id_map: Mapping[int, int] | None = None,
) -> MotionLabels:
    """Make motion labels from boxes, each frame in its own ego frame.

    Args:
        frames: Boxes that the agent annotated at each of `config.label_frames` moments from the
            present on; None where there is no recording.
        egomotion: `next_from_this` ego poses, shape (R, 6), right-handed, R = `config.frames`, from
            the first past frame on, as `v2x.future_egomotion` returns them; converted to float32.
        config: Configuration of the labels, or the name of a preset; None for the released labels
            in the devkit's orientation.
        valid: Whether each frame is in the recording, shape (R,), bool; if None, all frames are in
            it except the ones that are None in `frames`.
        is_vehicle: Whether the agent is a vehicle, which has a box of its own; the infrastructure
            has none.
        id_map: Actor id → its id in an earlier sample's labels. The released code keeps ids while a
            worker reads samples of one scenario and agent. If None, ids start at 1.

    Raises:
        GeometryError: The number of frames or rows does not match the configuration, or a motion is
            not finite.
        ConfigError: An id is not valid, or ids are passed although the protocol does not keep ids
            between samples.
        ChoiceError: There is no preset of that name.
    """
    label_config = resolved_label_config(config)
    polygons = box_polygons(frames, label_config, is_vehicle=is_vehicle)
    return labels_from_polygons(polygons, egomotion, label_config, valid=valid, id_map=id_map)


def labels_from_polygons(
    polygons: Sequence[FramePolygons | None],
    egomotion: ArrayLike,
    config: MotionLabelConfig | str | None = None,
    *,
    valid: ArrayLike | None = None,
    id_map: Mapping[int, int] | None = None,
) -> MotionLabels:
    """Make motion labels from footprints, each frame in its own ego frame.

    Arguments and errors are as in `motion_labels_from_boxes`.
    """
    config = resolved_label_config(config)
    if len(polygons) != config.label_frames:
        raise GeometryError(
            f"frames: expected {config.label_frames} (the present and {config.future_frames} "
            f"after it), found {len(polygons)}; give None for frames beyond the recording"
        )
    motion = checked("egomotion", egomotion, (config.frames, 6), np.float32)
    if not np.isfinite(motion).all():
        raise GeometryError(
            "egomotion: not all numbers are finite; set rows without a motion to zero"
        )
    past_frames = config.receptive_field - 1
    exists = np.array([True] * past_frames + [frame is not None for frame in polygons])
    if valid is not None:
        exists = exists & checked("valid", valid, (config.frames,), np.bool_)
    all_polygons = Polygons.of(polygons)
    return next(make_labels(all_polygons, motion[None], exists[None], config, id_map))


def make_labels(
    polygons: Polygons,
    egomotion: Float32Array,
    valid: BoolArray,
    config: MotionLabelConfig,
    id_map: Mapping[int, int] | None,
) -> Iterator[MotionLabels]:
    """Yield the labels of S samples, whose frames are numbered consecutively.

    Everything except the maps is computed for all samples at once.

    Args:
        polygons: Polygons of all frames.
        egomotion: Finite `next_from_this` ego poses, shape (S, R, 6).
        valid: Whether each frame is in the recording, shape (S, R).
        config: Configuration of the labels.
        id_map: Actor id → its id in an earlier sample, which each sample continues; None to start
            at 1.

    Raises:
        ConfigError: An id is not valid, or ids are passed although the protocol does not keep ids
            between samples.
    """
    past_frames = config.receptive_field - 1
    frames = config.label_frames
    start_ids = {}
    if id_map is not None:
        start_ids = _check_ids(id_map, config)
    ids, id_maps = _assign_ids(polygons, len(valid), config, start_ids)
    footprints = rasterise_polygons(polygons, ids, len(valid) * frames, config)
    covered = _find_covered_cells(footprints, config)
    centers = covered.centers()
    motion = egomotion[:, past_frames:].reshape(-1, 6)[:-1]
    this_from_next = frames_from_next(motion, config.rules, config.augmentation)
    next_from_this = sampling_matrix(this_from_next, config.rules)
    next_centers = following_centers(footprints, next_from_this, config, covered.ids)
    next_centers[np.isnan(centers)] = np.nan
    del footprints  # otherwise its cells stay in memory until the last sample is done
    for sample, sample_ids in enumerate(id_maps):
        begin = sample * frames
        end = begin + frames
        cells = covered.between(begin, end)
        missing = ~valid[sample, past_frames:]
        maps = label_maps(cells, centers[begin:end], next_centers[begin:end], missing, config)
        yield maps.labels(config, egomotion[sample], valid[sample], sample_ids)


def _check_ids(id_map: Mapping[int, int], config: MotionLabelConfig) -> dict[int, int]:
    """Return a checked copy of the ids of an earlier sample, or raise ConfigError."""
    if not config.rules.ids_kept_between_samples:
        raise ConfigError(
            "id_map: ids of this protocol count from 1 in every sample; leave it out, or choose a "
            "protocol with ids_kept_between_samples=True"
        )
    if not isinstance(id_map, Mapping):
        raise ConfigError(f"id_map: expected a mapping of actor ids to ids, found {id_map!r}")
    checked_map = {}
    for actor, label_id in id_map.items():
        actor_id = checked_whole("id_map", actor, "actor ids", ConfigError)
        checked_map[actor_id] = checked_count("id_map", label_id, "an id of labels", _MAX_ID)
    return checked_map


def _assign_ids(
    polygons: Polygons, samples: int, config: MotionLabelConfig, id_map: dict[int, int]
) -> tuple[IntArray, list[dict[int, int]]]:
    """Assign ids to the polygons in the order in which they are rasterised, from 1.

    Returns:
        Id of each polygon, shape (n,), and the extended map of each sample.
    """
    ids = []
    id_maps = [id_map.copy() for _ in range(samples)]
    # Each polygon with this key becomes a separate instance.
    separate_key = None if config.rules.untracked_share_an_id else UNTRACKED_ID
    starts = polygons.frame.searchsorted(np.arange(1, samples) * config.label_frames)
    for sample_ids, keys in zip(id_maps, np.split(polygons.key, starts), strict=True):
        max_id = max(sample_ids.values(), default=0)
        for key in keys.tolist():
            if key == separate_key:
                max_id += 1
                ids.append(max_id)
                continue
            if key not in sample_ids:
                max_id += 1
                sample_ids[key] = max_id
            ids.append(sample_ids[key])
    return np.array(ids, dtype=np.int64), id_maps


def _find_covered_cells(footprints: Footprints, config: MotionLabelConfig) -> CoveredCells:
    """Return the cells of the footprints, in native orientation."""
    rows, columns = config.grid.with_orientation(config.rules.native).shape
    cells = np.flatnonzero(footprints.top != 0)  # of bools: twice as fast
    owner = footprints.top[cells] - 1
    frame = footprints.frame[owner]
    row = cells // columns  # rows of all frames, one frame after another
    return CoveredCells(
        frame=frame,
        row=row - frame * rows,
        column=cells - row * columns,
        identity=footprints.identity[owner],
        frames=len(footprints.top) // (rows * columns),
        ids=int(footprints.identity.max(initial=0)),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CoveredCells:
    """P cells that instances cover at some frames, in one orientation.

    Attributes:
        frame: Index of each cell's frame, shape (P,), int64.
        row: Rows, shape (P,), int64.
        column: Columns, shape (P,), int64.
        identity: Ids from 1, shape (P,), int64.
        frames: Number of frames.
        ids: Highest id of all frames.
    """

    frame: IntArray
    row: IntArray
    column: IntArray
    identity: IntArray
    frames: int
    ids: int

    def between(self, first: int, last: int) -> CoveredCells:
        """Return the cells of the frames from `first` up to but excluding `last`.

        The frames of the result are numbered from 0. The frames must ascend.
        """
        start, stop = self.frame.searchsorted([first, last]).tolist()
        cells = slice(start, stop)
        return CoveredCells(
            frame=self.frame[cells] - first,
            row=self.row[cells],
            column=self.column[cells],
            identity=self.identity[cells],
            frames=last - first,
            ids=self.ids,
        )

    @property
    def slot(self) -> IntArray:
        """Each cell's frame and instance as one index: frame · (1 + ids) + identity, shape (P,)."""
        slots_per_frame = 1 + self.ids
        return self.frame * slots_per_frame + self.identity

    def centers(self) -> Float32Array:
        """Return the cell nearest to the mean of each instance's cells, shape (frames, 1 + ids, 2).

        Halves are rounded to the even cell; NaN for instances without cells.
        """
        slot = self.slot
        num_slots = self.frames * (1 + self.ids)
        counts = np.bincount(slot, minlength=num_slots).astype(np.float32)
        # Sums of whole numbers are exact in float32, except on huge grids: the mean equals torch's.
        row_sum = np.bincount(slot, self.row, num_slots).astype(np.float32)
        column_sum = np.bincount(slot, self.column, num_slots).astype(np.float32)
        sums = np.stack([row_sum, column_sum], axis=-1)
        with np.errstate(invalid="ignore"):
            means: Float32Array = np.rint(sums / counts[:, None])
        return means.reshape(self.frames, 1 + self.ids, 2)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LabelMaps:
    """Maps of `MotionLabels` for T frames, in the configuration's orientation."""

    segmentation: AnyArray
    instance: AnyArray
    centerness: AnyArray
    offset: AnyArray
    flow: AnyArray

    @classmethod
    def empty(cls, config: MotionLabelConfig) -> LabelMaps:
        """Return maps of frames without any actor.

        The maps share one block of memory; the allocator keeps the blocks of five samples for
        reuse.
        """
        frames = config.label_frames
        height, width = config.grid.shape
        count = frames * height * width
        keep_freed(5 * count * 25)
        memory = np.empty(count * 25, dtype=np.uint8)
        memory[: 16 * count].view(np.float32)[:] = config.ignore_index
        memory[16 * count :] = 0
        offset = memory[: 8 * count].view(np.float32)
        flow = memory[8 * count : 16 * count].view(np.float32)
        centerness = memory[16 * count : 20 * count].view(np.float32)
        instance = memory[20 * count : 24 * count].view(np.int32)
        segmentation = memory[24 * count :]
        return cls(
            offset=offset.reshape(frames, 2, height, width),
            flow=flow.reshape(frames, 2, height, width),
            centerness=centerness.reshape(frames, 1, height, width),
            instance=instance.reshape(frames, height, width),
            segmentation=segmentation.reshape(frames, height, width),
        )

    def labels(
        self,
        config: MotionLabelConfig,
        egomotion: Float32Array,
        valid: BoolArray,
        id_map: dict[int, int],
    ) -> MotionLabels:
        """Return the labels with these maps."""
        return MotionLabels(
            config=config,
            segmentation=self.segmentation,
            instance=self.instance,
            centerness=self.centerness,
            offset=self.offset,
            flow=self.flow,
            future_egomotion=egomotion,
            valid=valid,
            id_map=id_map,
        )


def label_maps(
    covered: CoveredCells,
    centers: Float32Array,
    next_centers: Float32Array,
    missing: BoolArray,
    config: MotionLabelConfig,
) -> LabelMaps:
    """Draw the label maps of instances.

    Args:
        covered: Cells of the instances, in native orientation.
        centers: Rows and columns of the instances' centres in native orientation, shape (T, 1 +
            ids, 2); NaN where an instance is absent.
        next_centers: Centres at the next frame, with the same shape.
        missing: Whether each frame lies outside the recording, shape (T,).
        config: Configuration of the labels.
    """
    maps = LabelMaps.empty(config)
    native = config.grid.with_orientation(config.rules.native)
    source = native.orientation
    target = config.grid.orientation
    shape = native.shape
    row, column = cells_in(covered.row, covered.column, shape, source, target)
    cell = row * config.grid.shape[1] + column
    frame_start = covered.frame * native.cells
    cell += frame_start
    maps.segmentation.reshape(-1)[cell] = 1
    maps.instance.reshape(-1)[cell] = covered.identity
    slot = covered.slot
    center_row, center_column = centers.reshape(-1, 2).T.copy()
    next_row, next_column = next_centers.reshape(-1, 2).T.copy()
    down = center_row.take(slot) - covered.row.astype(np.float32)
    along = center_column.take(slot) - covered.column.astype(np.float32)
    offset = vectors_in(down, along, source, target)
    flow = vectors_in(next_row - center_row, next_column - center_column, source, target)
    cell += frame_start  # offset and flow have two channels
    for channel in range(2):
        channel_flow = _replace_nan(flow[channel], config)
        maps.offset.reshape(-1)[cell] = _replace_nan(offset[channel], config)
        maps.flow.reshape(-1)[cell] = channel_flow.take(slot)
        cell += native.cells
    frame, identity = np.nonzero(~np.isnan(centers[..., 0]))
    peak_row, peak_column = centers[frame, identity].astype(np.int64).T
    peak_cells = np.stack(cells_in(peak_row, peak_column, shape, source, target), axis=1)
    _draw_peaks(maps.centerness, frame, peak_cells, config.sigma)
    if not config.rules.missing_frames_are_empty:
        for raster in (maps.segmentation, maps.instance, maps.centerness):
            raster[missing] = config.ignore_index
    return maps


def _replace_nan(values: AnyArray, config: MotionLabelConfig) -> AnyArray:
    """Return values with `ignore_index` instead of NaN."""
    ignore_value = np.float32(config.ignore_index)
    return np.where(np.isnan(values), ignore_value, values)


def _draw_peaks(centerness: AnyArray, frame: IntArray, center: IntArray, sigma: float) -> None:
    """Draw peaks around centres into a map; where peaks overlap, the higher value counts.

    Args:
        centerness: Map to draw into, shape (T, 1, H, W).
        frame: Frames of the centres, shape (n,).
        center: Rows and columns of the centres, shape (n, 2).
        sigma: Radius of the peaks, cells.
    """
    import cv2

    shape = centerness.shape[-2:]
    peak = _compute_peak(sigma, max(shape))
    radius = len(peak) // 2
    begin = np.maximum(center - radius, 0)
    end = np.minimum(center + radius + 1, shape)
    peak_begin = begin - center + radius
    peak_end = end - center + radius
    bounds = np.hstack([begin, end, peak_begin, peak_end]).tolist()
    for number, peak_bounds in zip(frame.tolist(), bounds, strict=True):
        top, left, bottom, right, peak_top, peak_left, peak_bottom, peak_right = peak_bounds
        target = centerness[number, 0, top:bottom, left:right]
        source = peak[peak_top:peak_bottom, peak_left:peak_right]
        # This takes half of numpy's time, since it moves faster from row to row.
        cv2.max(target, source, target)


@functools.lru_cache(maxsize=8)
def _compute_peak(sigma: float, max_radius: int) -> Float32Array:
    """Return exp(−d² / σ²) around a centre, until it is 0 or the grid ends.

    The shape is (2 r + 1, 2 r + 1), float32.
    """
    radius = math.floor(sigma * math.sqrt(_ZERO_EXPONENT))
    radius = min(radius, max_radius)
    steps = np.arange(-radius, radius + 1, dtype=np.float32)
    squared_steps = steps**2
    squared_distances = np.add.outer(squared_steps, squared_steps)
    exponents = squared_distances / np.float32(sigma**2)
    return np.exp(-exponents.astype(np.float64)).astype(np.float32)


class _Runs(NamedTuple):
    """Cells of target frames that may sample a footprint, as R horizontal runs of cells.

    Each of a footprint's cells is in only one run.

    Attributes:
        polygon: Index of the footprint, shape (R,).
        frame: Target frame, shape (R,).
        row: Row in the target frame, shape (R,).
        first: First column, shape (R,).
        length: Number of cells, shape (R,).
    """

    polygon: IntArray
    frame: IntArray
    row: IntArray
    first: IntArray
    length: IntArray


def following_centers(
    footprints: Footprints, next_from_this: AnyArray, config: MotionLabelConfig, ids: int
) -> Float32Array:
    """Return the instances' centres at the frame after each frame, warped to the earlier frame.

    Args:
        footprints: Footprints of F frames.
        next_from_this: Finite transforms as `sampling_matrix` returns them, shape (F − 1, 4, 4).
        config: Configuration of the labels.
        ids: Highest id.

    Returns:
        Rows and columns, shape (F, 1 + ids, 2); NaN where an instance is absent, and in a sample's
        last frame, which has no next frame.
    """
    rules = config.rules
    grid = config.grid.with_orientation(rules.native)
    lines = sampling_lines(next_from_this, grid, rules)
    runs = None
    spread = even_spread(lines, grid)
    if spread is not None:
        origin, inverse = spread
        runs = find_runs(footprints, origin, inverse, grid)
    if runs is None:
        polygon, row, column = _find_sampled_cells(footprints, next_from_this, grid, rules)
    else:
        polygon, row, column = _find_sampled_cells_in_runs(footprints, runs, lines, grid)
    centers = CoveredCells(
        frame=footprints.frame[polygon] - 1,
        row=row,
        column=column,
        identity=footprints.identity[polygon],
        frames=len(next_from_this) + 1,
        ids=ids,
    ).centers()
    centers[config.label_frames - 1 :: config.label_frames] = np.nan
    return centers


def _find_sampled_cells(
    footprints: Footprints, matrices: AnyArray, grid: BevGrid, rules: LabelProtocol
) -> tuple[IntArray, IntArray, IntArray]:
    """Return the cells of all frames that sample a footprint of the next frame.

    Returns:
        Footprint, row and column of each such cell, each of shape (P,).
    """
    maps = footprints.top.reshape(-1, grid.cells)[1:]
    sampled = [NO_INDICES]
    for matrix, top in zip(matrices, maps, strict=True):
        padded = np.append(top, np.int32(0))
        sampled.append(padded.take(nearest_indices(matrix, grid, rules)))
    polygons = np.concatenate(sampled)
    cell = np.flatnonzero(polygons)
    row, column = np.divmod(cell % grid.cells, grid.shape[1])
    return polygons[cell] - 1, row, column


def _find_sampled_cells_in_runs(
    footprints: Footprints, runs: _Runs, lines: tuple[SamplingLine, SamplingLine], grid: BevGrid
) -> tuple[IntArray, IntArray, IntArray]:
    """Return the same cells as `_find_sampled_cells`, but search only the cells of runs."""
    rows, columns = grid.shape
    row_line, column_line = lines
    run = np.repeat(np.arange(len(runs.length)), runs.length)
    run_start = np.cumsum(runs.length) - runs.length
    first_column = runs.first + runs.frame * columns - run_start
    column = np.arange(len(run)) + first_column.take(run)
    # The points are close to the grid, so that int32 holds them; as uint32, negative values are
    # large.
    down = np.rint(row_line.points_of(runs.frame, runs.row, column, run)).astype(np.int32)
    along = np.rint(column_line.points_of(runs.frame, runs.row, column, run)).astype(np.int32)
    is_sampled = down.view(np.uint32) < rows
    is_sampled &= along.view(np.uint32) < columns
    next_frame_start = (runs.frame + 1) * grid.cells
    source = next_frame_start.take(run)
    source += down * np.int32(columns)
    source += along
    run_top = (runs.polygon + 1).astype(np.int32)
    is_sampled &= footprints.top.take(source, mode="clip") == run_top.take(run)
    cell = np.flatnonzero(is_sampled)
    cell_run = run[cell]
    cell_column = column[cell] - runs.frame[cell_run] * columns
    return runs.polygon[cell_run], runs.row[cell_run], cell_column


def find_runs(
    footprints: Footprints, origin: FloatArray, inverse: FloatArray, grid: BevGrid
) -> _Runs | None:
    """Return the runs of cells around the footprints of all frames except the first.

    Return None if there are more of these cells than the frames have altogether.

    Args:
        footprints: Footprints of all frames.
        origin: Sample points of the first cells, as `even_spread` returns them.
        inverse: Steps of target cells per source cell, as `even_spread` returns them.
        grid: The grid in native orientation.
    """
    polygon = np.flatnonzero(footprints.frame > 0)
    corners = footprints.corners[polygon, :, ::-1]
    frame = footprints.frame[polygon] - 1
    last_cell = np.array(grid.shape) - 1
    low = np.clip(corners.min(axis=1), 0, last_cell)
    high = np.clip(corners.max(axis=1), 0, last_cell)
    source_offset = (low + high) / 2 - origin[frame]
    source_reach = (high - low) / 2 + _MARGIN_CELLS
    center = (inverse[frame] @ source_offset[..., None])[..., 0]
    reach = (np.abs(inverse)[frame] @ source_reach[..., None])[..., 0]
    first = np.maximum(np.ceil(center - reach), 0).astype(np.int64)
    last = np.minimum(np.floor(center + reach), last_cell).astype(np.int64)
    num_rows, num_columns = np.maximum(last - first + 1, 0).T
    if (num_rows * num_columns).sum() > len(footprints.top):
        return None
    footprint = np.repeat(np.arange(len(num_rows)), num_rows)
    run_start = np.cumsum(num_rows) - num_rows
    first_row = first[:, 0] - run_start
    return _Runs(
        polygon=polygon[footprint],
        frame=frame[footprint],
        row=np.arange(len(footprint)) + first_row[footprint],
        first=first[footprint, 1],
        length=num_columns[footprint],
    )


def even_spread(
    lines: tuple[SamplingLine, SamplingLine], grid: BevGrid
) -> tuple[FloatArray, FloatArray] | None:
    """Return the first cells' sample points, and the steps of target cells per source cell.

    Returns:
        Rows and columns of the first cells' sample points, shape (N, 2); and steps of target cells
        per source cell, shape (N, 2, 2). None if the points are too far away for `find_runs`, too
        close together or too far apart.
    """
    rows, columns = grid.shape
    if min(rows, columns) < 2:
        return None
    line_points = []
    for line in lines:
        sums = line.of_row[:, [0, -1, 0]] + line.of_column[:, [0, 0, -1]] + line.shift[:, None]
        line_points.append(line.finish(sums))
    points = np.array(line_points, dtype=np.float64)
    steps = (points[..., 1:] - points[..., :1]) / (rows - 1, columns - 1)
    (down, along), (down_column, along_column) = steps.transpose(0, 2, 1)
    scale = down * along_column - along * down_column
    magnitude = np.abs(scale)
    if not (np.abs(points) < _MAX_POINT_CELLS).all():
        return None
    if not ((magnitude > _MIN_SCALE) & (magnitude < _MAX_SCALE)).all():
        return None
    inverse = np.array([[along_column, -along], [-down_column, down]]) / scale
    return points[..., 0].T, inverse.transpose(2, 0, 1)
