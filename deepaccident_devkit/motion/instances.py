"""Instances from a model's maps, with the same id in all frames, and their paths."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from types import MappingProxyType
from typing import Final, Literal, get_args

import numpy as np

from deepaccident_devkit.errors import ConfigError, GeometryError
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.geometry.bev_grid import (
    ORIENTATIONS,
    Orientation,
    cells_in,
    to_orientation,
)
from deepaccident_devkit.motion.config import LabelProtocol, label_protocol
from deepaccident_devkit.motion.grouping import (
    LABEL_LOGIT,
    FrameGroups,
    MotionHeads,
    group_cells,
    link_frames,
    sum_by_id,
)
from deepaccident_devkit.motion.reference_arithmetic.contours import first_hulls, redrawn_cells
from deepaccident_devkit.motion.reference_arithmetic.peaks import find_peaks
from deepaccident_devkit.support.arrays import (
    AnyArray,
    BoolArray,
    FloatArray,
    IntArray,
    ShortRepr,
    checked_count,
    checked_flag,
    checked_setting,
    readonly,
)
from deepaccident_devkit.support.text import choice

Foreground = Literal["argmax", "sigmoid"]
FOREGROUND_THRESHOLD: Final = 0.4
"""Threshold for the foreground rule `sigmoid`, compared with the sigmoid of the actor's logit."""
_MAX_CENTERS = 2**24


@dataclass(frozen=True, slots=True, kw_only=True)
class PostProcessing:
    """Rules for extracting instances from a model's maps.

    The defaults are the rules that the released code uses for VPQ. See docs/released_code.md,
    Post-processing.

    Attributes:
        foreground: Which cells are actors. `argmax`: the actor's logit is higher than the
            background's. `sigmoid`: the sigmoid of the actor's logit exceeds
            `FOREGROUND_THRESHOLD`, whatever the background's logit is.
        labels_bypass_sigmoid: Whether `sigmoid` recognises labels (`MotionHeads.from_labels`) by a
            highest logit of 10 and a lowest of 0. It then compares the actor's logit itself with
            the threshold, because the sigmoid of a logit of 0 would exceed the released threshold.
        center_threshold: Centerness that a cell must exceed to be a centre.
        max_centers: Maximum number of centres per frame; if there are more, the first ones in
            row-major order are kept, not the highest.
        scan: Orientation in which row-major order is taken; the order also decides between equally
            near centres. Heads in another orientation are converted to it, and the result is
            converted back.
        link_distance: Distance in cells. An instance takes over the id of an instance of the
            previous frame if it is closer than this to where the flow moves that instance.
        redraw: Whether to rasterise boxes along the paths of the first frame's instances, for the
            accident evaluation.
    """

    foreground: Foreground = "argmax"
    labels_bypass_sigmoid: bool = True
    center_threshold: float = 0.1
    max_centers: int = 100
    scan: Orientation = "released"
    link_distance: float = 10.0
    redraw: bool = False

    def __post_init__(self) -> None:
        """Raise ChoiceError or ConfigError unless the values are valid."""
        values = {
            "foreground": choice("foreground", self.foreground, get_args(Foreground)),
            "labels_bypass_sigmoid": checked_flag(
                "labels_bypass_sigmoid", self.labels_bypass_sigmoid
            ),
            "center_threshold": checked_setting(
                "center_threshold", self.center_threshold, "a number from 0", 0.0
            ),
            "max_centers": checked_count(
                "max_centers", self.max_centers, "centres of a frame", _MAX_CENTERS
            ),
            "scan": choice("scan", self.scan, ORIENTATIONS),
            "link_distance": checked_setting(
                "link_distance", self.link_distance, "a number of cells from 0", 0.0
            ),
            "redraw": checked_flag("redraw", self.redraw),
        }
        for name, value in values.items():
            object.__setattr__(self, name, value)


POST_PROCESSING: Final[Mapping[str, PostProcessing]] = MappingProxyType(
    {
        "motion": PostProcessing(),
        "accident": PostProcessing(foreground="sigmoid", link_distance=8.0, redraw=True),
        "fiery": PostProcessing(link_distance=3.0, scan="fiery"),
    }
)
"""Settings by name: the released motion (IoU, VPQ) and accident evaluations, and FIERY's."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class InstancePath(ShortRepr):
    """Path of an instance of the first frame; arrays are read-only.

    Attributes:
        frames: Frames in which the instance occurs, shape (n,), int64, ascending from 0.
        centers: Row and column of the mean of its cells in these frames, shape (n, 2), float64 with
            values of float32.
        cell_counts: Number of its cells in each frame, shape (T,), int64; 0 in frames where it does
            not occur.
    """

    frames: IntArray
    centers: FloatArray
    cell_counts: IntArray

    def __post_init__(self) -> None:
        """Freeze the arrays."""
        for field in fields(self):
            values = getattr(self, field.name)
            object.__setattr__(self, field.name, readonly(values))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LinkedInstances(ShortRepr):
    """Instances of one prediction over T frames of H × W cells; arrays are read-only.

    Attributes:
        settings: Rules for extracting the instances.
        orientation: Orientation of the cells, as in the heads.
        instance: Ids that are the same in all frames, shape (T, H, W), int32, 0 elsewhere.
        frame_instance: Ids of each frame before linking, shape (T, H, W), int32, 1 to I without
            gaps, 0 elsewhere.
        redrawn: Ids of boxes rasterised along the paths, shape (T, H, W), int32, 0 elsewhere; None
            unless `settings.redraw`.
        frame_centers: Rows and columns of the centres around which each frame's cells were grouped,
            T arrays of shape (K, 2), int64.
        paths: Id → path, for the instances of the first frame; ids ascend.
    """

    settings: PostProcessing
    orientation: Orientation
    instance: AnyArray
    frame_instance: AnyArray
    redrawn: AnyArray | None
    frame_centers: Sequence[IntArray]
    paths: Mapping[int, InstancePath]

    def __post_init__(self) -> None:
        """Freeze arrays and maps."""
        object.__setattr__(self, "instance", readonly(self.instance))
        object.__setattr__(self, "frame_instance", readonly(self.frame_instance))
        if self.redrawn is not None:
            object.__setattr__(self, "redrawn", readonly(self.redrawn))
        frame_centers = tuple(readonly(centers) for centers in self.frame_centers)
        object.__setattr__(self, "frame_centers", frame_centers)
        object.__setattr__(self, "paths", MappingProxyType(dict(self.paths)))

    @property
    def centers(self) -> dict[int, FloatArray]:
        """Id → row and column in each frame of `paths[id].frames`, shape (n, 2)."""
        centers = {}
        for identity, path in self.paths.items():
            centers[identity] = path.centers
        return centers


def predict_instances(
    heads: MotionHeads, settings: PostProcessing | str = "motion"
) -> LinkedInstances:
    """Extract instances and link them, so that an instance has the same id in all frames.

    The result equals the released code's. See docs/released_code.md, Post-processing and FIERY's
    own labels.

    Args:
        heads: A model's maps, or labels as a perfect prediction (`MotionHeads.from_labels`).
        settings: Name in `POST_PROCESSING`, or settings of your own.

    Raises:
        ChoiceError: There are no settings of that name.
        ConfigError: `heads` is not a `MotionHeads`, or `settings` is neither a name nor a
            `PostProcessing`.
    """
    rules = post_processing(settings)
    if not isinstance(heads, MotionHeads):
        raise ConfigError(
            f"heads: expected MotionHeads, found {type(heads).__name__}; make them from labels "
            "with MotionHeads.from_labels, or from a model's maps with from_arrays"
        )
    scan = _Scan(heads.segmentation.shape[-2:], heads.orientation, rules.scan)
    centerness = scan.maps(heads.centerness[:, 0])
    foreground = scan.maps(foreground_cells(heads.segmentation, rules))
    peaks = [find_peaks(frame, rules.center_threshold, rules.max_centers) for frame in centerness]
    positions = []
    for frame_foreground, frame_peaks in zip(foreground, peaks, strict=True):
        has_peaks = len(frame_peaks) > 0
        positions.append(np.stack(np.nonzero(frame_foreground & has_peaks)))
    groups = _group_frames(heads, peaks, positions, scan)
    frame_ids = [group.ids for group in groups]
    linked_ids = link_frames(groups, rules.link_distance)
    cell_ids = []
    for linked, own_ids in zip(linked_ids, frame_ids, strict=True):
        cell_ids.append(linked[own_ids])
    centers, counts = _average_positions(groups, linked_ids)
    redrawn = None
    if rules.redraw:
        hulls = first_hulls(positions[0], groups[0].ids, groups[0].instances)
        box_cells, box_ids = redrawn_cells(hulls, centers, counts > 0, scan.scanned_shape)
        redrawn = scan.raster(box_cells, box_ids)
    paths = {}
    turned_centers = scan.points(centers)
    for index, cell_counts in enumerate(counts):
        frames = np.flatnonzero(cell_counts)
        path_centers = turned_centers[index, frames]
        paths[index + 1] = InstancePath(
            frames=frames, centers=path_centers, cell_counts=cell_counts
        )
    return LinkedInstances(
        settings=rules,
        orientation=heads.orientation,
        instance=scan.raster(positions, cell_ids),
        frame_instance=scan.raster(positions, frame_ids),
        redrawn=redrawn,
        frame_centers=[scan.points(frame_peaks) for frame_peaks in peaks],
        paths=paths,
    )


def _group_frames(
    heads: MotionHeads, peaks: Sequence[IntArray], positions: Sequence[IntArray], scan: _Scan
) -> list[FrameGroups]:
    """Return the instances of each frame before linking.

    Args:
        heads: Maps of a model.
        peaks: Rows and columns of each frame's peaks in the scanned orientation, shape (K, 2).
        positions: Rows and columns of each frame's foreground cells in the scanned orientation,
            shape (2, P).
        scan: Conversion between the heads' and the scanned orientation.
    """
    groups = []
    for frame, (frame_peaks, position) in enumerate(zip(peaks, positions, strict=True)):
        offset = scan.vectors_at(position, heads.offset[frame], heads.ignore_index)
        flow = scan.vectors_at(position, heads.flow[frame], heads.ignore_index)
        all_cells = position.shape[1] == heads.offset[frame, 0].size
        group = group_cells(
            frame_peaks, position.astype(np.float32), offset, flow, all_cells=all_cells
        )
        groups.append(group)
    return groups


def foreground_cells(segmentation: AnyArray, rules: PostProcessing) -> BoolArray:
    """Return whether each cell is an actor according to the settings, shape (T, H, W).

    Args:
        segmentation: Logits of background and actor of one prediction, shape (T, 2, H, W).
        rules: The settings.
    """
    background = segmentation[:, 0]
    actor = segmentation[:, 1]
    if rules.foreground == "argmax":
        return np.asarray(actor > background)
    threshold = np.float32(FOREGROUND_THRESHOLD)
    if rules.labels_bypass_sigmoid and segmentation.max() == LABEL_LOGIT:
        if segmentation.min() == 0:
            return np.asarray(actor > threshold)
    # A float32 sigmoid exceeds the threshold from half-way to the next float32 on. Comparing the
    # logits with the logit of that point avoids computing an exponential for every cell.
    next_value = np.nextafter(threshold, np.float32(1))
    half_way = (float(threshold) + float(next_value)) / 2
    logit_threshold = np.float32(np.log(half_way / (1 - half_way)))
    return np.asarray(actor > logit_threshold)


def post_processing(settings: PostProcessing | str) -> PostProcessing:
    """Look up settings by name; a `PostProcessing` is returned unchanged.

    Raise ChoiceError for an unknown name, and ConfigError for any other type.
    """
    if isinstance(settings, PostProcessing):
        return settings
    if not isinstance(settings, str):
        raise ConfigError(
            f"post-processing: expected PostProcessing or the name of one, found {settings!r}"
        )
    return POST_PROCESSING[choice("post-processing", settings, POST_PROCESSING)]


def trajectories(
    linked: LinkedInstances,
    grid: BevGrid,
    protocol: str | LabelProtocol = "released",
    *,
    half_cell_shift: bool | None = None,
) -> dict[int, FloatArray]:
    """Return the paths of the first frame's instances in metres.

    Args:
        linked: Result of `predict_instances`.
        grid: Ground that the cells cover, in any orientation.
        protocol: Protocol of the labels, or of the labels that the model was trained on. If it has
            the quirk `half_cell_shift`, the shift is undone: a cell then represents its corner with
            the lowest row and column in the protocol's native orientation.
        half_cell_shift: Replaces the protocol's value; if False, a cell always represents its
            centre. None keeps the protocol's value.

    Returns:
        Id → positions in the maps' ego frame at the frames `linked.paths[id].frames`, shape (n, 2):
        x forward, y left, metres.

    Raises:
        GeometryError: The grid does not have the shape of the instance maps.
        ChoiceError: There is no protocol of that name.
    """
    shape = grid.with_orientation(linked.orientation).shape
    if linked.instance.shape[1:] != shape:
        raise GeometryError(
            f"grid: has {shape} cells, but the instances have {linked.instance.shape[1:]}"
        )
    rules = label_protocol(protocol)
    if half_cell_shift is not None:
        rules = replace(rules, half_cell_shift=half_cell_shift)
    point_in_cell = np.array(rules.place_in_cell)
    low, _, size = np.array([grid.x, grid.y]).T
    paths = {}
    for identity, points in linked.centers.items():
        cells = _reorient_points(points, shape, linked.orientation, "devkit")
        paths[identity] = low + (cells[:, ::-1] + point_in_cell) * size
    return paths


def _average_positions(
    groups: Sequence[FrameGroups], linked_ids: Sequence[IntArray]
) -> tuple[FloatArray, IntArray]:
    """Return the centres and cell counts of the first frame's instances 1 to I in T frames.

    Returns:
        Mean rows and columns, shape (I, T, 2), 0 where an instance has no cells; and cell counts,
        shape (I, T).
    """
    num_ids = groups[0].instances + 1
    frame_sums = []
    for group, ids in zip(groups, linked_ids, strict=True):
        columns = [group.count, *group.position_sum]
        frame_sums.append([sum_by_id(ids, column, num_ids) for column in columns])
    sums = np.stack(frame_sums)
    counts = sums[:, 0]
    means = sums[:, 1:] / np.maximum(counts, 1)[:, None]
    centers = means.astype(np.float32).astype(np.float64)
    return centers.transpose(2, 0, 1)[1:], counts.T[1:].astype(np.int64)


@dataclass(frozen=True, slots=True)
class _Scan:
    """Conversion from the heads' orientation to the scanned orientation, and back.

    Attributes:
        shape: Rows and columns in the heads' orientation.
        heads: The heads' orientation.
        scan: The scanned orientation.
    """

    shape: tuple[int, int]
    heads: Orientation
    scan: Orientation

    @property
    def scanned_shape(self) -> tuple[int, int]:
        """Rows and columns of the scanned orientation."""
        is_transposed = (self.heads == "fiery") != (self.scan == "fiery")
        if is_transposed:
            return self.shape[::-1]
        return self.shape

    def maps(self, maps: AnyArray) -> AnyArray:
        """Return the heads' maps (…, H, W) in the scanned orientation."""
        return to_orientation(maps, vectors=False, source=self.heads, target=self.scan)

    def vectors_at(self, position: IntArray, vectors: AnyArray, ignore: int | None) -> AnyArray:
        """Return the heads' vectors at some cells, in the scanned orientation, shape (2, P).

        Args:
            position: Rows and columns of the cells in the scanned orientation, shape (2, P).
            vectors: Vectors in the heads' orientation, shape (2, H, W).
            ignore: Value of undefined vectors; None if all are defined.
        """
        flat_vectors = vectors.reshape(2, -1)
        cell_vectors = flat_vectors.take(self._flatten_position(position), axis=1)
        # Each cell is treated as a raster of its own: no cell moves, only the vectors rotate.
        rasters = cell_vectors.T[..., None, None]
        turned = to_orientation(
            rasters, vectors=True, source=self.heads, target=self.scan, ignore=ignore
        )
        return turned[..., 0, 0].T

    def raster(self, positions: Sequence[IntArray], ids: Sequence[IntArray]) -> AnyArray:
        """Draw ids into rasters in the heads' orientation, shape (T, H, W), int32.

        Args:
            positions: Rows and columns of each frame's cells in the scanned orientation, shape (2,
                P).
            ids: Ids of each frame's cells, shape (P,).
        """
        rasters = np.zeros((len(positions), *self.shape), dtype=np.int32)
        for raster, position, cell_ids in zip(rasters, positions, ids, strict=True):
            raster.reshape(-1)[self._flatten_position(position)] = cell_ids
        return rasters

    def points(self, points: AnyArray) -> AnyArray:
        """Convert rows and columns (…, 2) from the scanned to the heads' orientation."""
        return _reorient_points(points, self.scanned_shape, self.scan, self.heads)

    def _flatten_position(self, position: IntArray) -> IntArray:
        """Convert scanned rows and columns to flat indices in the heads' orientation."""
        scanned_row, scanned_column = position
        row, column = cells_in(
            scanned_row, scanned_column, self.scanned_shape, self.scan, self.heads
        )
        cell = row * self.shape[1] + column
        return np.asarray(cell)


def _reorient_points(
    points: AnyArray, shape: tuple[int, int], source: Orientation, target: Orientation
) -> AnyArray:
    """Convert rows and columns (…, 2) of a raster of `shape` cells to another orientation."""
    rows = points[..., 0]
    columns = points[..., 1]
    return np.stack(cells_in(rows, columns, shape, source, target), axis=-1)
