"""Motion labels from boxes: which cells an actor takes, under which id, and where it is at the next frame."""

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

# The largest id: float32 holds all whole numbers up to here.
_MOST_IDS: Final = 2**24
# exp(−x) is 0 in float32 from here on.
_VANISHED: Final = 104.0
# In cells, around a footprint: half a cell for the nearest sampling, and some for the rounding of the points.
_MARGIN: Final = 0.75
# In cells: with the first sample point farther away, the rounding of float32 would outgrow the margin.
_FARTHEST: Final = 2.0**16


def motion_labels_from_boxes(
    frames: Sequence[FrameBoxes | None],
    egomotion: ArrayLike,
    config: MotionLabelConfig | str | None = None,
    *,
    valid: ArrayLike | None = None,
    is_vehicle: bool = True,
    id_map: Mapping[int, int] | None = None,
) -> MotionLabels:
    """The motion labels of boxes, each frame in its own ego frame.

    Args:
        frames: what the agent annotated at each of `config.label_frames` moments from the present on; None where there
            is no recording.
        egomotion: (R, 6) `next_from_this` ego poses, right-handed, R = `config.frames`, from the first past frame on,
            as `v2x.future_egomotion` gives them; converted to float32.
        config: what labels show, or the name of a preset; None for the released ones in the devkit's orientation.
        valid: (R,) bool, which frames are in the recording; if None, all except those that are None in `frames`.
        is_vehicle: whether the agent is a vehicle, with a box of its own (the infrastructure has none).
        id_map: actor id → its id in an earlier sample. The released code keeps ids while a worker reads samples of one
            scenario and agent. With None ids start at 1.

    Raises:
        GeometryError: another number of frames or rows, or a motion that is not finite.
        ConfigError: a wrong id, or any id where the protocol does not keep ids between samples.
        ChoiceError: no such preset.
    """
    chosen = resolved_label_config(config)
    polygons = box_polygons(frames, chosen, is_vehicle=is_vehicle)
    return labels_from_polygons(polygons, egomotion, chosen, valid=valid, id_map=id_map)


def labels_from_polygons(
    polygons: Sequence[FramePolygons | None],
    egomotion: ArrayLike,
    config: MotionLabelConfig | str | None = None,
    *,
    valid: ArrayLike | None = None,
    id_map: Mapping[int, int] | None = None,
) -> MotionLabels:
    """The motion labels of footprints, each frame in its own ego frame; see `motion_labels_from_boxes`."""
    config = resolved_label_config(config)
    if len(polygons) != config.label_frames:
        raise GeometryError(
            f"frames: expected {config.label_frames}, the present and {config.future_frames} after it, "
            f"found {len(polygons)}; give None for frames beyond the recording"
        )
    motion = checked("egomotion", egomotion, (config.frames, 6), np.float32)
    if not np.isfinite(motion).all():
        raise GeometryError(
            "egomotion: not all numbers are finite; set rows without a motion to zero"
        )
    past = config.receptive_field - 1
    there = np.array([True] * past + [frame is not None for frame in polygons])
    known = there if valid is None else there & checked("valid", valid, (config.frames,), np.bool_)
    return next(labels_of(Polygons.of(polygons), motion[None], known[None], config, id_map))


def labels_of(
    polygons: Polygons,
    egomotion: Float32Array,
    valid: BoolArray,
    config: MotionLabelConfig,
    id_map: Mapping[int, int] | None,
) -> Iterator[MotionLabels]:
    """The labels of S samples, whose frames are numbered one after another: all but the maps is computed at once.

    `egomotion` (S, R, 6) is finite, `valid` (S, R); each sample's ids continue `id_map`. Raises ConfigError.
    """
    past, frames = config.receptive_field - 1, config.label_frames
    ids, continued = _numbered(
        polygons, len(valid), config, {} if id_map is None else _checked_ids(id_map, config)
    )
    footprints = footprints_of(polygons, ids, len(valid) * frames, config)
    covered = _covered(footprints, config)
    centers = covered.centers()
    this_from_next = frames_from_next(
        egomotion[:, past:].reshape(-1, 6)[:-1], config.rules, config.augmentation
    )
    following = following_centers(
        footprints, sampling_matrix(this_from_next, config.rules), config, covered.ids
    )
    following[np.isnan(centers)] = np.nan
    del footprints  # else its cells stay until the last sample
    for sample, own_ids in enumerate(continued):
        first, last = sample * frames, (sample + 1) * frames
        shown = covered.between(first, last)
        maps = label_maps(
            shown, centers[first:last], following[first:last], ~valid[sample, past:], config
        )
        yield maps.labels(config, egomotion[sample], valid[sample], own_ids)


def _checked_ids(id_map: Mapping[int, int], config: MotionLabelConfig) -> dict[int, int]:
    """A copy of the map to continue, or ConfigError."""
    if not config.rules.ids_kept_between_samples:
        raise ConfigError(
            "id_map: ids of this protocol count from 1 in every sample; leave it out, or choose a protocol with "
            "ids_kept_between_samples=True"
        )
    if not isinstance(id_map, Mapping):
        raise ConfigError(f"id_map: expected a mapping of actor ids to ids, found {id_map!r}")
    return {
        checked_whole("id_map", actor, "actor ids", ConfigError): checked_count(
            "id_map", given, "an id of labels", _MOST_IDS
        )
        for actor, given in id_map.items()
    }


def _numbered(
    polygons: Polygons, samples: int, config: MotionLabelConfig, id_map: dict[int, int]
) -> tuple[IntArray, list[dict[int, int]]]:
    """The id of each polygon, and each sample's extended map; ids count from 1 in the order of rasterising."""
    ids: list[int] = []
    maps = [id_map.copy() for _ in range(samples)]
    nobody = None if config.rules.untracked_share_an_id else UNTRACKED_ID
    starts = polygons.frame.searchsorted(np.arange(1, samples) * config.label_frames)
    for continued, keys in zip(maps, np.split(polygons.key, starts), strict=True):
        highest = max(continued.values(), default=0)
        for key in keys.tolist():
            if key == nobody or key not in continued:
                highest += 1
                if key != nobody:
                    continued[key] = highest
            ids.append(highest if key == nobody else continued[key])
    return np.array(ids, dtype=np.int64), maps


def _covered(footprints: Footprints, config: MotionLabelConfig) -> CoveredCells:
    """The cells of the footprints, in native orientation."""
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
    """The cells that instances cover at some frames, P in all, in one orientation.

    Attributes:
        frame: (P,) int64, number of the frame.
        row: (P,) int64.
        column: (P,) int64.
        identity: (P,) int64, ids from 1.
        frames: number of frames.
        ids: highest id of all frames.
    """

    frame: IntArray
    row: IntArray
    column: IntArray
    identity: IntArray
    frames: int
    ids: int

    def between(self, first: int, last: int) -> CoveredCells:
        """Those of the frames from `first` to before `last`, which are numbered from 0 then; frames must ascend."""
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
        """(P,) frame · (1 + ids) + identity."""
        return self.frame * (1 + self.ids) + self.identity

    def centers(self) -> Float32Array:
        """(frames, 1 + ids, 2) the cell nearest to the mean of each instance's cells, half to even; NaN for none."""
        slot, slots = self.slot, self.frames * (1 + self.ids)
        count = np.bincount(slot, minlength=slots).astype(np.float32)
        # sums of whole numbers are exact in float32, except on huge grids: so the mean is torch's
        rows = np.bincount(slot, weights=self.row, minlength=slots).astype(np.float32)
        columns = np.bincount(slot, weights=self.column, minlength=slots).astype(np.float32)
        with np.errstate(invalid="ignore"):
            means: Float32Array = np.rint(np.stack([rows, columns], axis=-1) / count[:, None])
        return means.reshape(self.frames, 1 + self.ids, 2)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LabelMaps:
    """The maps of `MotionLabels`, T frames in the configuration's orientation."""

    segmentation: AnyArray
    instance: AnyArray
    centerness: AnyArray
    offset: AnyArray
    flow: AnyArray

    @classmethod
    def empty(cls, config: MotionLabelConfig) -> LabelMaps:
        """Maps of frames without any actor.

        They share one piece of memory, which is kept for the next sample, as those of five samples are.
        """
        frames, (height, width) = config.label_frames, config.grid.shape
        count = frames * height * width
        keep_freed(5 * count * 25)
        memory = np.empty(count * 25, dtype=np.uint8)
        memory[: 16 * count].view(np.float32)[:] = config.ignore_index
        memory[16 * count :] = 0
        two, one = (frames, 2, height, width), (frames, height, width)
        return cls(
            offset=memory[: 8 * count].view(np.float32).reshape(two),
            flow=memory[8 * count : 16 * count].view(np.float32).reshape(two),
            centerness=memory[16 * count : 20 * count]
            .view(np.float32)
            .reshape(frames, 1, height, width),
            instance=memory[20 * count : 24 * count].view(np.int32).reshape(one),
            segmentation=memory[24 * count :].reshape(one),
        )

    def labels(
        self,
        config: MotionLabelConfig,
        egomotion: Float32Array,
        valid: BoolArray,
        id_map: dict[int, int],
    ) -> MotionLabels:
        """The labels with these maps."""
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
    following: Float32Array,
    missing: BoolArray,
    config: MotionLabelConfig,
) -> LabelMaps:
    """The maps of instances, from native cells and centres (T, 1 + ids, 2) here and at the next frame, or NaN.

    `missing` (T,) says which frames are not in the recording.
    """
    maps, target = LabelMaps.empty(config), config.grid.orientation
    native = config.grid.with_orientation(config.rules.native)
    source, shape = native.orientation, native.shape
    row, column = cells_in(covered.row, covered.column, shape, source, target)
    cell = row * config.grid.shape[1] + column
    before = covered.frame * native.cells
    cell += before
    maps.segmentation.reshape(-1)[cell] = 1
    maps.instance.reshape(-1)[cell] = covered.identity
    slot = covered.slot
    (down, along), (next_down, next_along) = (
        np.array([centers, following]).reshape(2, -1, 2).swapaxes(1, 2).copy()
    )
    from_row = down.take(slot) - covered.row.astype(np.float32)
    from_column = along.take(slot) - covered.column.astype(np.float32)
    offset = vectors_in(from_row, from_column, source, target)
    flow = vectors_in(next_down - down, next_along - along, source, target)
    cell += before  # offset and flow have two channels
    for channel in range(2):
        for raster, vector in ((maps.offset, offset[channel]), (maps.flow, flow[channel])):
            values = np.where(np.isnan(vector), np.float32(config.ignore_index), vector)
            raster.reshape(-1)[cell] = values if raster is maps.offset else values.take(slot)
        cell += native.cells
    frame, identity = np.nonzero(~np.isnan(centers[..., 0]))
    peak_row, peak_column = centers[frame, identity].astype(np.int64).T
    peak_row, peak_column = cells_in(peak_row, peak_column, shape, source, target)
    _draw_peaks(maps.centerness, frame, np.stack([peak_row, peak_column], axis=1), config.sigma)
    if not config.rules.missing_frames_are_empty:
        for mark in (maps.segmentation, maps.instance, maps.centerness):
            mark[missing] = config.ignore_index
    return maps


def _draw_peaks(centerness: AnyArray, frame: IntArray, center: IntArray, sigma: float) -> None:
    """Put peaks around centres (n, 2), row and column, of frames (n,) into (T, 1, H, W); the higher value counts."""
    import cv2

    shape = centerness.shape[-2:]
    peak = _peak(sigma, max(shape))
    reach = len(peak) // 2
    first, last = np.maximum(center - reach, 0), np.minimum(center + reach + 1, shape)
    bounds = np.hstack([first, last, first - center + reach, last - center + reach]).tolist()
    for number, (top, left, bottom, right, above, before, below, behind) in zip(
        frame.tolist(), bounds, strict=True
    ):
        part = centerness[number, 0, top:bottom, left:right]
        cv2.max(
            part, peak[above:below, before:behind], part
        )  # half of numpy's time: it goes from row to row faster


@functools.lru_cache(maxsize=8)
def _peak(sigma: float, farthest: int) -> Float32Array:
    """(2 r + 1, 2 r + 1) exp(−d² / σ²) around a centre in float32, until it is 0 or the grid ends."""
    radius = min(math.floor(sigma * math.sqrt(_VANISHED)), farthest)
    steps = np.arange(-radius, radius + 1, dtype=np.float32)
    squares = np.add.outer(steps**2, steps**2) / np.float32(sigma**2)
    return np.exp(-squares.astype(np.float64)).astype(np.float32)


class _Runs(NamedTuple):
    """Cells of target frames that can sample a footprint, in R pieces of rows; a footprint's cells appear only once.

    Attributes:
        polygon: (R,) the footprint.
        frame: (R,) the target frame.
        row: (R,) the row there.
        first: (R,) the first column.
        length: (R,) how many cells.
    """

    polygon: IntArray
    frame: IntArray
    row: IntArray
    first: IntArray
    length: IntArray


def following_centers(
    footprints: Footprints, next_from_this: AnyArray, config: MotionLabelConfig, ids: int
) -> Float32Array:
    """(F, 1 + ids, 2) centres of the instances at the next frame, warped to each frame; NaN where they are not seen.

    `next_from_this` (F − 1, 4, 4) is as `sampling_matrix` gives it, finite. A sample's last frame has no next one.
    """
    grid, rules = config.grid.with_orientation(config.rules.native), config.rules
    lines = sampling_lines(next_from_this, grid, rules)
    spread = even_spread(lines, grid)
    runs = None if spread is None else runs_near(footprints, *spread, grid)
    polygon, row, column = (
        _seen_anywhere(footprints, next_from_this, grid, rules)
        if runs is None
        else _seen_near(footprints, runs, lines, grid)
    )
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


def _seen_anywhere(
    footprints: Footprints, matrices: AnyArray, grid: BevGrid, rules: LabelProtocol
) -> tuple[IntArray, IntArray, IntArray]:
    """Footprints that cells of the frames before sample, and the cells' rows and columns; all cells are looked at."""
    maps = footprints.top.reshape(-1, grid.cells)[1:]
    sampled = [
        np.append(top, np.int32(0)).take(nearest_indices(matrix, grid, rules))
        for matrix, top in zip(matrices, maps, strict=True)
    ]
    joined = np.concatenate([np.zeros(0, dtype=np.int64), *sampled])
    cell = np.flatnonzero(joined)
    row, column = np.divmod(cell % grid.cells, grid.shape[1])
    return joined[cell] - 1, row, column


def _seen_near(
    footprints: Footprints, runs: _Runs, lines: tuple[SamplingLine, SamplingLine], grid: BevGrid
) -> tuple[IntArray, IntArray, IntArray]:
    """The same; only the runs' cells are looked at."""
    rows, columns = grid.shape
    run = np.repeat(np.arange(len(runs.length)), runs.length)
    before = np.cumsum(runs.length) - runs.length
    column = np.arange(len(run)) + (runs.first + runs.frame * columns - before).take(run)
    # the points are near the grid, so int32 holds them; below 0, uint32 is large
    down = np.rint(lines[0].points_of(runs.frame, runs.row, column, run)).astype(np.int32)
    along = np.rint(lines[1].points_of(runs.frame, runs.row, column, run)).astype(np.int32)
    inside = down.view(np.uint32) < rows
    inside &= along.view(np.uint32) < columns
    source = ((runs.frame + 1) * grid.cells).take(run)
    source += down * np.int32(columns)
    source += along
    inside &= footprints.top.take(source, mode="clip") == (runs.polygon + 1).astype(np.int32).take(
        run
    )
    seen = np.flatnonzero(inside)
    of_run = run[seen]
    return runs.polygon[of_run], runs.row[of_run], column[seen] - runs.frame[of_run] * columns


def runs_near(
    footprints: Footprints, origin: FloatArray, inverse: FloatArray, grid: BevGrid
) -> _Runs | None:
    """The cells around the footprints of all frames but the first; None if these are more than a few frames' cells."""
    polygon = np.flatnonzero(footprints.frame > 0)
    corners, frame = footprints.corners[polygon, :, ::-1], footprints.frame[polygon] - 1
    last = np.array(grid.shape) - 1
    low, high = np.minimum(np.maximum([corners.min(axis=1), corners.max(axis=1)], 0), last)
    center = (inverse[frame] @ ((low + high) / 2 - origin[frame])[..., None])[..., 0]
    reach = (np.abs(inverse)[frame] @ ((high - low) / 2 + _MARGIN)[..., None])[..., 0]
    first = np.maximum(np.ceil(center - reach), 0).astype(np.int64)
    count = np.maximum(np.minimum(np.floor(center + reach), last).astype(np.int64) - first + 1, 0)
    if (count[:, 0] * count[:, 1]).sum() > len(footprints.top):
        return None
    of_run = np.repeat(np.arange(len(count)), count[:, 0])
    before = np.cumsum(count[:, 0]) - count[:, 0]
    return _Runs(
        polygon=polygon[of_run],
        frame=frame[of_run],
        row=np.arange(len(of_run)) + (first[:, 0] - before)[of_run],
        first=first[of_run, 1],
        length=count[of_run, 1],
    )


def even_spread(
    lines: tuple[SamplingLine, SamplingLine], grid: BevGrid
) -> tuple[FloatArray, FloatArray] | None:
    """The first cells' sample points (N, 2), and (N, 2, 2) how far target cells lie apart for each cell of the source.

    None where the points are too far away, or too near to each other or too far apart, for what is done with it.
    """
    rows, columns = grid.shape
    if min(rows, columns) < 2:
        return None
    points = np.array(
        [
            line.finish(
                line.of_row[:, [0, -1, 0]] + line.of_column[:, [0, 0, -1]] + line.shift[:, None]
            )
            for line in lines
        ],
        dtype=np.float64,
    )
    steps = (points[..., 1:] - points[..., :1]) / (rows - 1, columns - 1)
    (down, along), (down_column, along_column) = steps.transpose(0, 2, 1)
    scale = down * along_column - along * down_column
    if (
        not (np.abs(points) < _FARTHEST).all()
        or not ((np.abs(scale) > 0.25) & (np.abs(scale) < 4)).all()
    ):
        return None
    inverse = np.array([[along_column, -along], [-down_column, down]]) / scale
    return points[..., 0].T, inverse.transpose(2, 0, 1)
