"""From a model's maps to instances with the same id in all frames, and their paths."""

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
_MOST_CENTERS: Final = 2**24


@dataclass(frozen=True, slots=True, kw_only=True)
class PostProcessing:
    """How instances are found in a model's maps; the defaults are the released ones for VPQ.

    See docs/released_code.md, Post-processing.

    Attributes:
        foreground: which cells are actors: `argmax` of both logits (background where they are equal), or `sigmoid`:
            those whose actor logit's sigmoid exceeds `FOREGROUND_THRESHOLD`, whatever the background's is.
        labels_bypass_sigmoid: with `sigmoid`, if the highest of all logits is 10 and the lowest 0, they are treated as
            labels (`MotionHeads.from_labels`), and the actor's logit itself is compared with the threshold: the sigmoid
            of its 0 would be above the released threshold.
        center_threshold: centerness that a centre must exceed.
        max_centers: how many centres a frame can have; if there are more, the first ones in row-major order are kept,
            not the highest.
        scan: the orientation in which cells are in that order; of several equally near centres, the first one in it is
            chosen. Heads in another orientation are turned to it, and the result is turned back.
        link_distance: cells; an instance has the id of one of the frame before if it is nearer than this to where the
            flow moves that one.
        redraw: rasterise boxes along the paths of the first frame's instances, for the accident evaluation.
    """

    foreground: Foreground = "argmax"
    labels_bypass_sigmoid: bool = True
    center_threshold: float = 0.1
    max_centers: int = 100
    scan: Orientation = "released"
    link_distance: float = 10.0
    redraw: bool = False

    def __post_init__(self) -> None:
        """Check the values; raises ChoiceError or ConfigError."""
        values = {
            "foreground": choice("foreground", self.foreground, get_args(Foreground)),
            "labels_bypass_sigmoid": checked_flag(
                "labels_bypass_sigmoid", self.labels_bypass_sigmoid
            ),
            "center_threshold": checked_setting(
                "center_threshold", self.center_threshold, "a number from 0", 0.0
            ),
            "max_centers": checked_count(
                "max_centers", self.max_centers, "centres of a frame", _MOST_CENTERS
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
"""The settings of the released evaluation of motion (IoU, VPQ) and of accidents, and those of FIERY."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class InstancePath(ShortRepr):
    """One instance of the first frame; arrays are read-only.

    Attributes:
        frames: (n,) int64 in which it is, rising from 0.
        centers: (n, 2) float64 row and column of the mean of its cells there (a float32's value).
        cell_counts: (T,) int64 how many cells it has in each frame, 0 where it is not.
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
    """The instances of one prediction over T frames of H × W cells in `orientation`; arrays are read-only.

    Attributes:
        settings: how they were found.
        orientation: how the cells lie; that of the heads.
        instance: (T, H, W) int32: ids that are the same in all frames, 0 elsewhere.
        frame_instance: (T, H, W) int32: each frame's own ids before linking, 1 to I without gaps, 0 elsewhere.
        redrawn: (T, H, W) int32: the ids of boxes rasterised along the paths, 0 elsewhere; None without
            `settings.redraw`.
        frame_centers: T times (K, 2) int64: rows and columns of the centres that cells were grouped around.
        paths: the instances of the first frame by id, ascending.
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
        object.__setattr__(
            self, "redrawn", None if self.redrawn is None else readonly(self.redrawn)
        )
        object.__setattr__(
            self, "frame_centers", tuple(readonly(centers) for centers in self.frame_centers)
        )
        object.__setattr__(self, "paths", MappingProxyType(dict(self.paths)))

    @property
    def centers(self) -> dict[int, FloatArray]:
        """Id → (n, 2) row and column in each frame of `paths[id].frames`."""
        return {identity: path.centers for identity, path in self.paths.items()}


def predict_instances(
    heads: MotionHeads, settings: PostProcessing | str = "motion"
) -> LinkedInstances:
    """Instances with the same id in all frames, as the released code finds them.

    See docs/released_code.md, Post-processing and FIERY's own labels.

    Args:
        heads: a model's maps, or `MotionHeads.from_labels`.
        settings: a name in `POST_PROCESSING`, or your own.

    Raises:
        ChoiceError: no settings have that name.
        ConfigError: `heads` are no heads, or `settings` no settings.
    """
    rules = post_processing(settings)
    if not isinstance(heads, MotionHeads):
        raise ConfigError(
            f"heads: expected MotionHeads, found {type(heads).__name__}; MotionHeads.from_labels takes labels, "
            "from_arrays a model's maps"
        )
    turn = _Turn(heads.segmentation.shape[-2:], heads.orientation, rules.scan)
    centerness = turn.maps(heads.centerness[:, 0])
    peaks = [find_peaks(frame, rules.center_threshold, rules.max_centers) for frame in centerness]
    foreground = turn.maps(foreground_cells(heads.segmentation, rules))
    positions = [
        np.stack(np.nonzero(here & (len(found) > 0)))
        for here, found in zip(foreground, peaks, strict=True)
    ]
    groups = [
        group_cells(
            found,
            position.astype(np.float32),
            turn.vectors_at(position, offset, heads.ignore_index),
            turn.vectors_at(position, flow, heads.ignore_index),
            all_cells=position.shape[1] == offset[0].size,
        )
        for found, position, offset, flow in zip(
            peaks, positions, heads.offset, heads.flow, strict=True
        )
    ]
    names = link_frames(groups, rules.link_distance)
    centers, counts = _paths(groups, names)
    redrawn = None
    if rules.redraw:
        hulls = first_hulls(positions[0], groups[0].ids, groups[0].instances)
        redrawn = turn.raster(*redrawn_cells(hulls, centers, counts > 0, turn.scanned_shape))
    return LinkedInstances(
        settings=rules,
        orientation=heads.orientation,
        instance=turn.raster(
            positions, [name[group.ids] for name, group in zip(names, groups, strict=True)]
        ),
        frame_instance=turn.raster(positions, [group.ids for group in groups]),
        redrawn=redrawn,
        frame_centers=[turn.points(frame) for frame in peaks],
        paths={
            identity: InstancePath(
                frames=np.flatnonzero(cells), centers=points[cells > 0], cell_counts=cells
            )
            for identity, (points, cells) in enumerate(
                zip(turn.points(centers), counts, strict=True), start=1
            )
        },
    )


def foreground_cells(segmentation: AnyArray, rules: PostProcessing) -> BoolArray:
    """(T, H, W) which cells are actors by the settings, of logits (T, 2, H, W) of one prediction: background, actor."""
    background, actor = segmentation[:, 0], segmentation[:, 1]
    if rules.foreground == "argmax":
        return np.asarray(actor > background)
    threshold = np.float32(FOREGROUND_THRESHOLD)
    if (
        rules.labels_bypass_sigmoid
        and segmentation.max() == LABEL_LOGIT
        and segmentation.min() == 0
    ):
        return np.asarray(actor > threshold)
    # A float32 sigmoid exceeds the threshold from half-way to the next float32 on. That point's own logit is compared
    # with instead, which needs no exponential of every cell.
    beyond = (float(threshold) + float(np.nextafter(threshold, np.float32(1)))) / 2
    return np.asarray(actor > np.float32(np.log(beyond / (1 - beyond))))


def post_processing(settings: PostProcessing | str) -> PostProcessing:
    """Settings by their name, or as they are given; raises ChoiceError or ConfigError."""
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
    """The paths of the first frame's instances in metres.

    Args:
        linked: from `predict_instances`.
        grid: what the cells cover, in any orientation.
        protocol: of the labels, or of the labels that the model learned. If it has the `half_cell_shift`, that is
            undone: a cell stands for its corner with the lowest row and column in the protocol's native orientation.
        half_cell_shift: in place of the protocol's own; with False a cell always stands for its middle.

    Returns:
        Id → (n, 2) x forward, y left, metres in the maps' ego frame, at the frames `linked.paths[id].frames`.

    Raises:
        GeometryError: the grid has other rows and columns than the instances.
        ChoiceError: no such protocol.
    """
    shape = grid.with_orientation(linked.orientation).shape
    if linked.instance.shape[1:] != shape:
        raise GeometryError(
            f"grid: has {shape} cells, but the instances have {linked.instance.shape[1:]}"
        )
    rules = label_protocol(protocol)
    if half_cell_shift is not None:
        rules = replace(rules, half_cell_shift=half_cell_shift)
    within = np.array(rules.place_in_cell)
    low, size = np.array([(low, size) for low, _, size in (grid.x, grid.y)]).T
    return {
        name: low
        + (_points_in(points, shape, linked.orientation, "devkit")[:, ::-1] + within) * size
        for name, points in linked.centers.items()
    }


def _paths(groups: Sequence[FrameGroups], names: Sequence[IntArray]) -> tuple[FloatArray, IntArray]:
    """(I, T, 2) mean rows and columns of the first frame's ids 1 to I, 0 where there are none, and (I, T) counts."""
    length = groups[0].instances + 1
    pairs = list(zip(groups, names, strict=True))
    counts = np.stack([sums_by(name, group.count, length) for group, name in pairs])
    sums = np.stack(
        [[sums_by(name, along, length) for along in group.position_sum] for group, name in pairs]
    )
    centers = (sums / np.maximum(counts, 1)[:, None]).astype(np.float32).astype(np.float64)
    return centers.transpose(2, 0, 1)[1:], counts.T[1:].astype(np.int64)


@dataclass(frozen=True, slots=True)
class _Turn:
    """From the heads' orientation, in which the shape is `shape`, to the scanned orientation, and back."""

    shape: tuple[int, int]
    heads: Orientation
    scan: Orientation

    @property
    def scanned_shape(self) -> tuple[int, int]:
        """Rows and columns of the scanned orientation."""
        return self.shape[::-1] if (self.heads == "fiery") != (self.scan == "fiery") else self.shape

    def maps(self, maps: AnyArray) -> AnyArray:
        """The heads' maps (…, H, W), in the scanned orientation."""
        return to_orientation(maps, vectors=False, source=self.heads, target=self.scan)

    def vectors_at(self, position: IntArray, vectors: AnyArray, ignore: int | None) -> AnyArray:
        """The heads' vectors (2, H, W) at scanned rows and columns (2, P), as (2, P) scanned ones."""
        taken = np.take(vectors.reshape(2, -1), self._flat(position), axis=1)
        rasters = taken.T[..., None, None]  # of one cell each: no cell moves, only the vectors turn
        turned = to_orientation(
            rasters, vectors=True, source=self.heads, target=self.scan, ignore=ignore
        )
        return turned[..., 0, 0].T

    def raster(self, positions: Sequence[IntArray], ids: Sequence[IntArray]) -> AnyArray:
        """(T, H, W) int32 in the heads' orientation, with `ids` (P,) at each frame's scanned positions (2, P)."""
        result = np.zeros((len(positions), math.prod(self.shape)), dtype=np.int32)
        for frame, position, values in zip(result, positions, ids, strict=True):
            frame[self._flat(position)] = values
        return result.reshape(-1, *self.shape)

    def points(self, points: AnyArray) -> AnyArray:
        """Scanned rows and columns (…, 2), in the heads' orientation."""
        return _points_in(points, self.scanned_shape, self.scan, self.heads)

    def _flat(self, position: IntArray) -> IntArray:
        row, column = cells_in(position[0], position[1], self.scanned_shape, self.scan, self.heads)
        return np.asarray(row * self.shape[1] + column)


def _points_in(
    points: AnyArray, shape: tuple[int, int], source: Orientation, target: Orientation
) -> AnyArray:
    """Rows and columns (…, 2) of one orientation, `shape` its cells, in another."""
    return np.stack(cells_in(points[..., 0], points[..., 1], shape, source, target), axis=-1)
