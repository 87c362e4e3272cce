"""Instances from a model's maps, with the same id in all frames, and their paths."""

from __future__ import annotations

import math
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
    sums_by,
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
"""Sigmoid of an actor's logit that a cell of the foreground `sigmoid` must exceed."""
_MAX_CENTERS: Final = 2**24


@dataclass(frozen=True, slots=True, kw_only=True)
class PostProcessing:
    """Rules by which instances are found in a model's maps.

    The defaults are the released rules for VPQ. See docs/released_code.md, Post-processing.

    Attributes:
        foreground: Rule for the cells of actors: `argmax` of both logits (background where they are
            equal), or `sigmoid`: the cells with a sigmoid of the actor's logit above
            `FOREGROUND_THRESHOLD`, for any logit of the background.
        labels_bypass_sigmoid: Whether logits are treated as labels (`MotionHeads.from_labels`) with
            `sigmoid`, if the highest of all logits is 10 and the lowest 0. The actor's logit itself
            is then compared with the threshold: the sigmoid of its 0 would be above the released
            threshold.
        center_threshold: Centerness that a centre must exceed.
        max_centers: Largest number of centres of a frame; if there are more, the first ones in
            row-major order count, not the highest.
        scan: Orientation in which cells are in that order; it also decides between equally near
            centres. Heads in another orientation are turned to it, and the result is turned back.
        link_distance: Distance below which an instance has the id of one of the frame before, moved
            by the flow, cells.
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
"""Settings of the released evaluation of motion (IoU, VPQ) and of accidents, and of FIERY."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class InstancePath(ShortRepr):
    """Path of an instance of the first frame; arrays are read-only.

    Attributes:
        frames: Frames that have the instance, shape (n,), int64, rising from 0.
        centers: Row and column of the mean of its cells in these frames, shape (n, 2), float64 (a
            float32's value).
        cell_counts: Number of its cells in each frame, shape (T,), int64, 0 in frames without it.
    """

    frames: IntArray
    centers: FloatArray
    cell_counts: IntArray

    def __post_init__(self) -> None:
        """Freeze the arrays."""
        for item in fields(self):
            object.__setattr__(self, item.name, readonly(getattr(self, item.name)))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LinkedInstances(ShortRepr):
    """Instances of one prediction over T frames of H × W cells; arrays are read-only.

    Attributes:
        settings: Rules by which they were found.
        orientation: Orientation of the cells, that of the heads.
        instance: Ids that are the same in all frames, shape (T, H, W), int32, 0 elsewhere.
        frame_instance: Ids of each frame before linking, shape (T, H, W), int32, 1 to I without
            gaps, 0 elsewhere.
        redrawn: Ids of boxes rasterised along the paths, shape (T, H, W), int32, 0 elsewhere; None
            without `settings.redraw`.
        frame_centers: Rows and columns of each frame's centres of groups, T arrays of shape (K, 2),
            int64.
        paths: Instances of the first frame by id, ascending.
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
        return {identity: path.centers for identity, path in self.paths.items()}


def predict_instances(
    heads: MotionHeads, settings: PostProcessing | str = "motion"
) -> LinkedInstances:
    """Return instances with the same id in all frames, as the released code finds them.

    See docs/released_code.md, Post-processing and FIERY's own labels.

    Args:
        heads: Maps of a model, or `MotionHeads.from_labels`.
        settings: Name in `POST_PROCESSING`, or settings of your own.

    Raises:
        ChoiceError: No settings have that name.
        ConfigError: `heads` are no heads, or `settings` no settings.
    """
    rules = post_processing(settings)
    if not isinstance(heads, MotionHeads):
        raise ConfigError(
            f"heads: expected MotionHeads, found {type(heads).__name__}; MotionHeads.from_labels "
            "takes labels, from_arrays a model's maps"
        )
    scan = _Scan(heads.segmentation.shape[-2:], heads.orientation, rules.scan)
    centerness = scan.maps(heads.centerness[:, 0])
    foreground = scan.maps(foreground_cells(heads.segmentation, rules))
    peaks = [find_peaks(frame, rules.center_threshold, rules.max_centers) for frame in centerness]
    positions = []
    for frame_foreground, frame_peaks in zip(foreground, peaks, strict=True):
        positions.append(np.stack(np.nonzero(frame_foreground & (len(frame_peaks) > 0))))
    groups = _grouped(heads, peaks, positions, scan)
    frame_ids = [group.ids for group in groups]
    linked_ids = link_frames(groups, rules.link_distance)
    ids = [linked[own_ids] for linked, own_ids in zip(linked_ids, frame_ids, strict=True)]
    centers, counts = _centers_and_counts(groups, linked_ids)
    redrawn = None
    if rules.redraw:
        hulls = first_hulls(positions[0], groups[0].ids, groups[0].instances)
        redrawn = scan.raster(*redrawn_cells(hulls, centers, counts > 0, scan.scanned_shape))
    paths = {}
    turned_centers = scan.points(centers)
    for identity, (points, cells) in enumerate(zip(turned_centers, counts, strict=True), start=1):
        paths[identity] = InstancePath(
            frames=np.flatnonzero(cells), centers=points[cells > 0], cell_counts=cells
        )
    return LinkedInstances(
        settings=rules,
        orientation=heads.orientation,
        instance=scan.raster(positions, ids),
        frame_instance=scan.raster(positions, frame_ids),
        redrawn=redrawn,
        frame_centers=[scan.points(frame_peaks) for frame_peaks in peaks],
        paths=paths,
    )


def _grouped(
    heads: MotionHeads, peaks: Sequence[IntArray], positions: Sequence[IntArray], scan: _Scan
) -> list[FrameGroups]:
    """Return the instances of each frame before linking.

    Args:
        heads: Maps of a model.
        peaks: Scanned rows and columns of each frame's peaks, shape (K, 2).
        positions: Scanned rows and columns of each frame's foreground, shape (2, P).
        scan: Change of orientation.
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
    """Return which cells are actors by the settings, shape (T, H, W).

    Args:
        segmentation: Logits of background and actor of one prediction, shape (T, 2, H, W).
        rules: The settings.
    """
    background = segmentation[:, 0]
    actor = segmentation[:, 1]
    if rules.foreground == "argmax":
        return np.asarray(actor > background)
    threshold = np.float32(FOREGROUND_THRESHOLD)
    if rules.labels_bypass_sigmoid:
        if segmentation.max() == LABEL_LOGIT and segmentation.min() == 0:
            return np.asarray(actor > threshold)
    # A float32 sigmoid exceeds the threshold from half-way to the next float32 on. The logits are
    # compared with that point's own logit, which needs no exponential of every cell.
    next_value = np.nextafter(threshold, np.float32(1))
    half_way = (float(threshold) + float(next_value)) / 2
    return np.asarray(actor > np.float32(np.log(half_way / (1 - half_way))))


def post_processing(settings: PostProcessing | str) -> PostProcessing:
    """Return settings by their name, or settings unchanged; raises ChoiceError or ConfigError."""
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
        protocol: Protocol of the labels, or of the labels that the model learned. If it has the
            `half_cell_shift`, the shift is undone: a cell stands for its corner with the lowest row
            and column in the protocol's native orientation.
        half_cell_shift: Value that replaces the protocol's own; with False a cell always stands for
            its middle.

    Returns:
        Id → positions, shape (n, 2), x forward, y left, metres in the maps' ego frame, at the
        frames `linked.paths[id].frames`.

    Raises:
        GeometryError: The grid has other rows and columns than the instances.
        ChoiceError: No such protocol.
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
    low, size = np.array([(low, size) for low, _, size in (grid.x, grid.y)]).T
    paths = {}
    for identity, points in linked.centers.items():
        cells = _points_in(points, shape, linked.orientation, "devkit")[:, ::-1]
        paths[identity] = low + (cells + point_in_cell) * size
    return paths


def _centers_and_counts(
    groups: Sequence[FrameGroups], linked_ids: Sequence[IntArray]
) -> tuple[FloatArray, IntArray]:
    """Return the centres and cell counts of the first frame's instances 1 to I in T frames.

    Returns:
        Mean rows and columns, shape (I, T, 2), 0 where there are none; and counts, shape (I, T).
    """
    num_ids = groups[0].instances + 1
    frame_counts = []
    frame_sums = []
    for group, ids in zip(groups, linked_ids, strict=True):
        frame_counts.append(sums_by(ids, group.count, num_ids))
        frame_sums.append([sums_by(ids, component, num_ids) for component in group.position_sum])
    counts = np.stack(frame_counts)
    means = np.stack(frame_sums) / np.maximum(counts, 1)[:, None]
    centers = means.astype(np.float32).astype(np.float64)
    return centers.transpose(2, 0, 1)[1:], counts.T[1:].astype(np.int64)


@dataclass(frozen=True, slots=True)
class _Scan:
    """Change from the heads' orientation to the scanned orientation, and back.

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
        return self.shape[::-1] if is_transposed else self.shape

    def maps(self, maps: AnyArray) -> AnyArray:
        """Return the heads' maps (…, H, W) in the scanned orientation."""
        return to_orientation(maps, vectors=False, source=self.heads, target=self.scan)

    def vectors_at(self, position: IntArray, vectors: AnyArray, ignore: int | None) -> AnyArray:
        """Return the heads' vectors at some cells, in the scanned orientation, shape (2, P).

        Args:
            position: Scanned rows and columns of the cells, shape (2, P).
            vectors: Vectors in the heads' orientation, shape (2, H, W).
            ignore: Value of undefined vectors; None if all are defined.
        """
        cell_vectors = np.take(vectors.reshape(2, -1), self._flat(position), axis=1)
        # Rasters of one cell each: no cell moves, only the vectors turn.
        rasters = cell_vectors.T[..., None, None]
        turned = to_orientation(
            rasters, vectors=True, source=self.heads, target=self.scan, ignore=ignore
        )
        return turned[..., 0, 0].T

    def raster(self, positions: Sequence[IntArray], ids: Sequence[IntArray]) -> AnyArray:
        """Return rasters of ids in the heads' orientation, shape (T, H, W), int32.

        Args:
            positions: Scanned rows and columns of each frame's cells, shape (2, P).
            ids: Ids of each frame's cells, shape (P,).
        """
        result = np.zeros((len(positions), math.prod(self.shape)), dtype=np.int32)
        for frame, position, values in zip(result, positions, ids, strict=True):
            frame[self._flat(position)] = values
        return result.reshape(-1, *self.shape)

    def points(self, points: AnyArray) -> AnyArray:
        """Return scanned rows and columns (…, 2) in the heads' orientation."""
        return _points_in(points, self.scanned_shape, self.scan, self.heads)

    def _flat(self, position: IntArray) -> IntArray:
        """Return the indices of scanned cells in a flat raster of the heads' orientation."""
        row, column = cells_in(position[0], position[1], self.scanned_shape, self.scan, self.heads)
        return np.asarray(row * self.shape[1] + column)


def _points_in(
    points: AnyArray, shape: tuple[int, int], source: Orientation, target: Orientation
) -> AnyArray:
    """Return rows and columns (…, 2) of one orientation, with `shape` cells, in another."""
    return np.stack(cells_in(points[..., 0], points[..., 1], shape, source, target), axis=-1)
