"""Motion labels from boxes: cells and ids of the actors, and their positions at the next frame."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

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
    footprints_of,
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

# Float32 holds all whole numbers up to this id.
_MAX_ID: Final = 2**24
# exp(−x) is 0 in float32 from this exponent on.
_ZERO_EXPONENT: Final = 104.0
# Margin around a footprint: half a cell for the nearest sampling, and some for the rounding of the
# points.
_MARGIN_CELLS: Final = 0.75
# If the first sample point were farther away, the rounding of float32 would outgrow the margin.
_MAX_POINT_CELLS: Final = 2.0**16


def motion_labels_from_boxes(
    frames: Sequence[FrameBoxes | None],
    egomotion: ArrayLike,
    config: MotionLabelConfig | str | None = None,
    *,
    valid: ArrayLike | None = None,
    is_vehicle: bool = True,
    id_map: Mapping[int, int] | None = None,
) -> MotionLabels:
    """Return the motion labels of boxes, each frame in its own ego frame.

    Args:
        frames: Boxes that the agent annotated at each of `config.label_frames` moments from the
            present on; None where there is no recording.
        egomotion: `next_from_this` ego poses, shape (R, 6), right-handed, R = `config.frames`, from
            the first past frame on, as `v2x.future_egomotion` returns them; converted to float32.
        config: Configuration of the labels, or the name of a preset; None for the released labels
            in the devkit's orientation.
        valid: Whether each frame is in the recording, shape (R,), bool; if None, all frames are
            except the ones that are None in `frames`.
        is_vehicle: Whether the agent is a vehicle, with a box of its own (the infrastructure has
            none).
        id_map: Actor id → its id in an earlier sample. The released code keeps ids while a worker
            reads samples of one scenario and agent. With None ids start at 1.

    Raises:
        GeometryError: Another number of frames or rows, or a motion that is not finite.
        ConfigError: A wrong id, or any id where the protocol does not keep ids between samples.
        ChoiceError: No such preset.
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
    """Return the motion labels of footprints, each frame in its own ego frame.

    Arguments and errors are as in `motion_labels_from_boxes`.
    """
    config = resolved_label_config(config)
    if len(polygons) != config.label_frames:
        raise GeometryError(
            f"frames: expected {config.label_frames}, the present and {config.future_frames} after "
            f"it, found {len(polygons)}; give None for frames beyond the recording"
        )
    motion = checked("egomotion", egomotion, (config.frames, 6), np.float32)
    if not np.isfinite(motion).all():
        raise GeometryError(
            "egomotion: not all numbers are finite; set rows without a motion to zero"
        )
    past = config.receptive_field - 1
    present = np.array([True] * past + [frame is not None for frame in polygons])
    if valid is not None:
        present = present & checked("valid", valid, (config.frames,), np.bool_)
    labels = labels_of(Polygons.of(polygons), motion[None], present[None], config, id_map)
    return next(labels)


def labels_of(
    polygons: Polygons,
    egomotion: Float32Array,
    valid: BoolArray,
    config: MotionLabelConfig,
    id_map: Mapping[int, int] | None,
) -> Iterator[MotionLabels]:
    """Yield the labels of S samples with frames that are numbered through all samples.

    Everything except the maps is computed at once.

    Args:
        polygons: Polygons of all frames.
        egomotion: Finite `next_from_this` ego poses, shape (S, R, 6).
        valid: Whether each frame is in the recording, shape (S, R).
        config: Configuration of the labels.
        id_map: Actor id → its id in an earlier sample, which each sample continues; None to start
            at 1.

    Raises:
        ConfigError: A wrong id, or any id where the protocol does not keep ids between samples.
    """
    past = config.receptive_field - 1
    frames = config.label_frames
    start_ids = {} if id_map is None else _checked_ids(id_map, config)
    ids, id_maps = _numbered(polygons, len(valid), config, start_ids)
    footprints = footprints_of(polygons, ids, len(valid) * frames, config)
    covered = _covered(footprints, config)
    centers = covered.centers()
    motion = egomotion[:, past:].reshape(-1, 6)[:-1]
    this_from_next = frames_from_next(motion, config.rules, config.augmentation)
    next_from_this = sampling_matrix(this_from_next, config.rules)
    next_centers = following_centers(footprints, next_from_this, config, covered.ids)
    next_centers[np.isnan(centers)] = np.nan
    del footprints  # otherwise its cells stay in memory until the last sample
    for sample, sample_ids in enumerate(id_maps):
        begin = sample * frames
        end = (sample + 1) * frames
        cells = covered.between(begin, end)
        missing = ~valid[sample, past:]
        maps = label_maps(cells, centers[begin:end], next_centers[begin:end], missing, config)
        yield maps.labels(config, egomotion[sample], valid[sample], sample_ids)


def _checked_ids(id_map: Mapping[int, int], config: MotionLabelConfig) -> dict[int, int]:
    """Return a copy of the map to continue, or raise ConfigError."""
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


def _numbered(
    polygons: Polygons, samples: int, config: MotionLabelConfig, id_map: dict[int, int]
) -> tuple[IntArray, list[dict[int, int]]]:
    """Assign ids to the polygons in the order of rasterising, from 1.

    Returns:
        Id of each polygon, shape (n,), and each sample's extended map.
    """
    ids: list[int] = []
    id_maps = [id_map.copy() for _ in range(samples)]
    # Polygons with this key are an instance each.
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


def _covered(footprints: Footprints, config: MotionLabelConfig) -> CoveredCells:
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
        frame: Numbers of the frames, shape (P,), int64.
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
        """Return the cells of the frames from `first` to before `last`, numbered from 0.

        The frames must ascend.
        """
        cells = slice(*self.frame.searchsorted([first, last]).tolist())
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
        """Number of each cell's frame and instance: frame · (1 + ids) + identity, shape (P,)."""
        return self.frame * (1 + self.ids) + self.identity

    def centers(self) -> Float32Array:
        """Return the cell nearest to the mean of each instance's cells, shape (frames, 1 + ids, 2).

        Halves go to the even cell; NaN for instances without cells.
        """
        slot = self.slot
        num_slots = self.frames * (1 + self.ids)
        count = np.bincount(slot, minlength=num_slots).astype(np.float32)
        # Sums of whole numbers are exact in float32, except on huge grids: the mean equals torch's.
        rows = np.bincount(slot, weights=self.row, minlength=num_slots).astype(np.float32)
        columns = np.bincount(slot, weights=self.column, minlength=num_slots).astype(np.float32)
        with np.errstate(invalid="ignore"):
            means: Float32Array = np.rint(np.stack([rows, columns], axis=-1) / count[:, None])
        return means.reshape(self.frames, 1 + self.ids, 2)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LabelMaps:
    """Maps of `MotionLabels`, T frames in the configuration's orientation."""

    segmentation: AnyArray
    instance: AnyArray
    centerness: AnyArray
    offset: AnyArray
    flow: AnyArray

    @classmethod
    def empty(cls, config: MotionLabelConfig) -> LabelMaps:
        """Return maps of frames without any actor.

        They share one block of memory; the allocator keeps the blocks of five samples for the next
        ones.
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
    """Return the maps of instances.

    Args:
        covered: Cells of the instances, in native orientation.
        centers: Native rows and columns of the instances' centres, shape (T, 1 + ids, 2), or NaN.
        next_centers: Centres at the next frame in the same form.
        missing: Whether each frame is not in the recording, shape (T,).
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
    all_centers = np.array([centers, next_centers]).reshape(2, -1, 2)
    (down, along), (next_down, next_along) = all_centers.swapaxes(1, 2).copy()
    from_row = down.take(slot) - covered.row.astype(np.float32)
    from_column = along.take(slot) - covered.column.astype(np.float32)
    offset = vectors_in(from_row, from_column, source, target)
    flow = vectors_in(next_down - down, next_along - along, source, target)
    cell += frame_start  # offset and flow have two channels
    for channel in range(2):
        maps.offset.reshape(-1)[cell] = _without_nan(offset[channel], config)
        maps.flow.reshape(-1)[cell] = _without_nan(flow[channel], config).take(slot)
        cell += native.cells
    frame, identity = np.nonzero(~np.isnan(centers[..., 0]))
    peak_row, peak_column = centers[frame, identity].astype(np.int64).T
    peak_cells = np.stack(cells_in(peak_row, peak_column, shape, source, target), axis=1)
    _draw_peaks(maps.centerness, frame, peak_cells, config.sigma)
    if not config.rules.missing_frames_are_empty:
        for raster in (maps.segmentation, maps.instance, maps.centerness):
            raster[missing] = config.ignore_index
    return maps


def _without_nan(values: AnyArray, config: MotionLabelConfig) -> AnyArray:
    """Return values with `ignore_index` instead of NaN."""
    return np.where(np.isnan(values), np.float32(config.ignore_index), values)


def _draw_peaks(centerness: AnyArray, frame: IntArray, center: IntArray, sigma: float) -> None:
    """Draw peaks around centres into a map; the higher value counts.

    Args:
        centerness: Map to draw into, shape (T, 1, H, W).
        frame: Frames of the centres, shape (n,).
        center: Rows and columns of the centres, shape (n, 2).
        sigma: Radius of the peaks, cells.
    """
    import cv2

    shape = centerness.shape[-2:]
    peak = _peak(sigma, max(shape))
    radius = len(peak) // 2
    begin = np.maximum(center - radius, 0)
    end = np.minimum(center + radius + 1, shape)
    peak_begin = begin - center + radius
    peak_end = end - center + radius
    bounds = np.hstack([begin, end, peak_begin, peak_end]).tolist()
    for number, peak_bounds in zip(frame.tolist(), bounds, strict=True):
        top, left, bottom, right, peak_top, peak_left, peak_bottom, peak_right = peak_bounds
        part = centerness[number, 0, top:bottom, left:right]
        # This takes half of numpy's time: it goes from row to row faster.
        cv2.max(part, peak[peak_top:peak_bottom, peak_left:peak_right], part)


@functools.lru_cache(maxsize=8)
def _peak(sigma: float, max_radius: int) -> Float32Array:
    """Return exp(−d² / σ²) around a centre, until it is 0 or the grid ends.

    The shape is (2 r + 1, 2 r + 1), float32.
    """
    radius = min(math.floor(sigma * math.sqrt(_ZERO_EXPONENT)), max_radius)
    steps = np.arange(-radius, radius + 1, dtype=np.float32)
    squares = np.add.outer(steps**2, steps**2) / np.float32(sigma**2)
    return np.exp(-squares.astype(np.float64)).astype(np.float32)


class _Runs(NamedTuple):
    """Cells of target frames that can sample a footprint, in R runs of rows.

    Each of a footprint's cells is in only one run.

    Attributes:
        polygon: Number of the footprint, shape (R,).
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
    """Return the centres of the instances at the next frame, warped to each frame.

    Args:
        footprints: Footprints of F frames.
        next_from_this: Finite transforms as `sampling_matrix` returns them, shape (F − 1, 4, 4).
        config: Configuration of the labels.
        ids: Highest id.

    Returns:
        Rows and columns, shape (F, 1 + ids, 2); NaN where an instance is not visible. A sample's
        last frame has no next one.
    """
    rules = config.rules
    grid = config.grid.with_orientation(rules.native)
    lines = sampling_lines(next_from_this, grid, rules)
    spread = even_spread(lines, grid)
    runs = None if spread is None else runs_near(footprints, *spread, grid)
    if runs is None:
        polygon, row, column = _sampled_cells(footprints, next_from_this, grid, rules)
    else:
        polygon, row, column = _sampled_cells_of_runs(footprints, runs, lines, grid)
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


def _sampled_cells(
    footprints: Footprints, matrices: AnyArray, grid: BevGrid, rules: LabelProtocol
) -> tuple[IntArray, IntArray, IntArray]:
    """Return the cells that sample a footprint of the next frame, among all cells.

    Returns:
        Footprint, row and column of each such cell, each of shape (P,).
    """
    maps = footprints.top.reshape(-1, grid.cells)[1:]
    sampled = [np.zeros(0, dtype=np.int64)]
    for matrix, top in zip(matrices, maps, strict=True):
        padded = np.append(top, np.int32(0))
        sampled.append(padded.take(nearest_indices(matrix, grid, rules)))
    polygons = np.concatenate(sampled)
    cell = np.flatnonzero(polygons)
    row, column = np.divmod(cell % grid.cells, grid.shape[1])
    return polygons[cell] - 1, row, column


def _sampled_cells_of_runs(
    footprints: Footprints, runs: _Runs, lines: tuple[SamplingLine, SamplingLine], grid: BevGrid
) -> tuple[IntArray, IntArray, IntArray]:
    """Return `_sampled_cells` among the cells of runs."""
    rows, columns = grid.shape
    run = np.repeat(np.arange(len(runs.length)), runs.length)
    run_start = np.cumsum(runs.length) - runs.length
    column = np.arange(len(run)) + (runs.first + runs.frame * columns - run_start).take(run)
    # The points are close to the grid, so that int32 holds them; as uint32, negative values are
    # large.
    down = np.rint(lines[0].points_of(runs.frame, runs.row, column, run)).astype(np.int32)
    along = np.rint(lines[1].points_of(runs.frame, runs.row, column, run)).astype(np.int32)
    is_sampled = down.view(np.uint32) < rows
    is_sampled &= along.view(np.uint32) < columns
    source = ((runs.frame + 1) * grid.cells).take(run)
    source += down * np.int32(columns)
    source += along
    run_top = (runs.polygon + 1).astype(np.int32)
    is_sampled &= footprints.top.take(source, mode="clip") == run_top.take(run)
    cell = np.flatnonzero(is_sampled)
    cell_run = run[cell]
    cell_column = column[cell] - runs.frame[cell_run] * columns
    return runs.polygon[cell_run], runs.row[cell_run], cell_column


def runs_near(
    footprints: Footprints, origin: FloatArray, inverse: FloatArray, grid: BevGrid
) -> _Runs | None:
    """Return the cells around the footprints of all frames but the first.

    Return None if these are more cells than all frames have.

    Args:
        footprints: Footprints of all frames.
        origin: Sample points of the first cells, as `even_spread` returns them.
        inverse: Distances of target cells, as `even_spread` returns them.
        grid: The grid in native orientation.
    """
    polygon = np.flatnonzero(footprints.frame > 0)
    corners = footprints.corners[polygon, :, ::-1]
    frame = footprints.frame[polygon] - 1
    last_cell = np.array(grid.shape) - 1
    extent = np.maximum([corners.min(axis=1), corners.max(axis=1)], 0)
    low, high = np.minimum(extent, last_cell)
    source_offset = (low + high) / 2 - origin[frame]
    source_reach = (high - low) / 2 + _MARGIN_CELLS
    center = (inverse[frame] @ source_offset[..., None])[..., 0]
    reach = (np.abs(inverse)[frame] @ source_reach[..., None])[..., 0]
    first = np.maximum(np.ceil(center - reach), 0).astype(np.int64)
    last = np.minimum(np.floor(center + reach), last_cell).astype(np.int64)
    count = np.maximum(last - first + 1, 0)
    if (count[:, 0] * count[:, 1]).sum() > len(footprints.top):
        return None
    footprint = np.repeat(np.arange(len(count)), count[:, 0])
    run_start = np.cumsum(count[:, 0]) - count[:, 0]
    return _Runs(
        polygon=polygon[footprint],
        frame=frame[footprint],
        row=np.arange(len(footprint)) + (first[:, 0] - run_start)[footprint],
        first=first[footprint, 1],
        length=count[footprint, 1],
    )


def even_spread(
    lines: tuple[SamplingLine, SamplingLine], grid: BevGrid
) -> tuple[FloatArray, FloatArray] | None:
    """Return the sample points of the first cells, and the distances of target cells.

    Returns:
        Rows and columns of the first cells' sample points, shape (N, 2); and steps of target cells
        for each cell of the source, shape (N, 2, 2). None if the points are too far away, or too
        close to each other or too far apart, for `runs_near`.
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
    if not (np.abs(points) < _MAX_POINT_CELLS).all():
        return None
    if not ((np.abs(scale) > 0.25) & (np.abs(scale) < 4)).all():
        return None
    inverse = np.array([[along_column, -along], [-down_column, down]]) / scale
    return points[..., 0].T, inverse.transpose(2, 0, 1)
