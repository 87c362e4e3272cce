"""Which boxes labels show at a frame, and where their corners lie on the ground of the agent's ego frame.

The released code turns label rows into mmdet3d boxes and moves those, all in float32 and in CARLA's left-handed frames.
The cells depend on the rounding, so its steps are repeated here one by one (docs/released_code.md, Conventions and
samples, Motion labels).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Final, NamedTuple

import numpy as np

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.geometry.bev_grid import axes_of
from deepaccident_devkit.geometry.conventions import flip_pose
from deepaccident_devkit.geometry.se3 import trusted_se3
from deepaccident_devkit.motion.augmentation import Augmentation
from deepaccident_devkit.motion.config import MotionLabelConfig
from deepaccident_devkit.motion.reference_arithmetic import single_precision
from deepaccident_devkit.motion.reference_arithmetic.polygon_fill import topmost
from deepaccident_devkit.support.arrays import (
    AnyArray,
    BoolArray,
    Float32Array,
    FloatArray,
    IntArray,
    ShortRepr,
    checked,
    readonly,
)
from deepaccident_devkit.taxonomy import CATEGORIES, OWN_ACTOR_ID, UNTRACKED_ID

OWN_BOX_ID: Final = -101
"""Key of the ego's own box in `MotionLabels.id_map`, as the released code has it."""
# The agent's box in the released code if it finds no row of the agent itself; it has the size of a Lincoln car.
_DEFAULT_SIZE: Final = (3.99, 1.85, 1.62)
# mmdet3d's corners 0, 3, 7, 4 from above, in lengths and widths.
_CORNERS: Final = np.array([[-1, -1], [-1, 1], [1, 1], [1, -1]], dtype=np.float32) / 2
_UP: Final = np.array([0, 0, 1, 0, 0, 0, 0], dtype=np.float32)
_COLUMNS: Final = attrgetter("center", "size", "yaw", "actor_id", "category", "visible")
# In cells: corners farther away are moved to this distance, which is far outside the grid.
_FAR: Final = 2**24
_PEDESTRIAN: Final = CATEGORIES.index("pedestrian")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameBoxes(ShortRepr):
    """The boxes that an agent annotated at one moment, in its LiDAR frame, right-handed; arrays are read-only.

    Attributes:
        center: (N, 3) float64, metres.
        size: (N, 3) float64, length, width, height, metres.
        yaw: (N,) float64, heading about z, radians.
        actor_id: (N,) int64; −100 is the agent's own row, −1 an untracked actor's.
        category: (N,) int, position in `taxonomy.CATEGORIES`.
        visible: (N,) bool, whether any agent whose sight counts sees the actor (docs/released_code.md, Visibility and
            attributes).
        ego_from_lidar: (4, 4) float64; for a protocol with `pose="yaw"` to the ego's frame without its lean.
    """

    center: FloatArray
    size: FloatArray
    yaw: FloatArray
    actor_id: IntArray
    category: AnyArray
    visible: BoolArray
    ego_from_lidar: FloatArray

    def __post_init__(self) -> None:
        """Check and freeze; raises GeometryError."""
        count = len(checked("FrameBoxes.center", self.center, (None, 3)))
        shapes: dict[str, tuple[tuple[int, ...], type]] = {
            "center": ((count, 3), np.float64),
            "size": ((count, 3), np.float64),
            "yaw": ((count,), np.float64),
            "actor_id": ((count,), np.int64),
            "category": ((count,), np.int64),
            "visible": ((count,), np.bool_),
            "ego_from_lidar": ((4, 4), np.float64),
        }
        for name, (shape, dtype) in shapes.items():
            array = checked(f"FrameBoxes.{name}", getattr(self, name), shape, dtype)
            if dtype is np.float64 and not np.isfinite(array).all():
                row = int(np.argwhere(~np.isfinite(array))[0, 0])
                remedy = (
                    "give None for a frame without a pose"
                    if name == "ego_from_lidar"
                    else "leave out such rows"
                )
                raise GeometryError(f"FrameBoxes.{name}: row {row} is not finite; {remedy}")
            object.__setattr__(self, name, readonly(array))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FramePolygons(ShortRepr):
    """The polygons of one moment, in the order in which they are rasterised; arrays are read-only.

    Attributes:
        corners: (n, 4, 2) float32 (float64 of boxes by `pose="yaw"`), x and y of the footprints' corners in the
            moment's ego frame, metres, right-handed.
        key: (n,) int64, actor ids; the ego's own box is −101.
    """

    corners: AnyArray
    key: IntArray

    def __post_init__(self) -> None:
        """Check and freeze; raises GeometryError."""
        double = getattr(self.corners, "dtype", None) == np.float64
        corners = checked(
            "FramePolygons.corners",
            self.corners,
            (None, 4, 2),
            np.float64 if double else np.float32,
        )
        object.__setattr__(self, "corners", readonly(corners))
        object.__setattr__(
            self, "key", readonly(checked("FramePolygons.key", self.key, (len(corners),), np.int64))
        )


class Polygons(NamedTuple):
    """The polygons of F frames in the order in which they are rasterised; fields as in `FramePolygons`.

    Attributes:
        corners: (n, 4, 2).
        frame: (n,) int64, ascending.
        key: (n,) int64.
    """

    corners: AnyArray
    frame: IntArray
    key: IntArray

    @classmethod
    def of(cls, frames: Sequence[FramePolygons | None]) -> Polygons:
        """Those of all frames, one after another."""
        there = [(number, frame) for number, frame in enumerate(frames) if frame is not None]
        return cls(
            np.concatenate(
                [np.zeros((0, 4, 2), dtype=np.float32), *[frame.corners for _, frame in there]]
            ),
            np.repeat(
                [number for number, _ in there], [len(frame.key) for _, frame in there]
            ).astype(np.int64),
            np.concatenate([np.zeros(0, dtype=np.int64), *[frame.key for _, frame in there]]),
        )


class Footprints(NamedTuple):
    """Rasterised polygons of all frames in the order of their frames, in native orientation.

    Attributes:
        corners: (n, V, 2) int64, column and row.
        frame: (n,) int64, ascending.
        identity: (n,) int64, ids from 1.
        top: (frames · cells,) int32, 1 + the polygon on top of each cell, 0 where there is none.
    """

    corners: IntArray
    frame: IntArray
    identity: IntArray
    top: AnyArray


def box_polygons(
    frames: Sequence[FrameBoxes | None], config: MotionLabelConfig, *, is_vehicle: bool = True
) -> list[FramePolygons | None]:
    """The polygons of boxes that labels show, frame by frame from the present on.

    Args:
        frames: the boxes of each label frame; None where there is no recording.
        config: what is rasterised.
        is_vehicle: whether the agent is a vehicle, with a box of its own (the infrastructure has none).

    Returns:
        Each frame's polygons, the ego's own first, then the others in the order of their rows; None where there is
        no recording.

    Raises:
        GeometryError: a frame is neither `FrameBoxes` nor None.
    """
    polygons = polygons_of(BoxRows.of(frames, is_vehicle=is_vehicle), config)
    ends = polygons.frame.searchsorted(np.arange(len(frames)), side="right").tolist()
    return [
        None
        if frame is None
        else FramePolygons(corners=polygons.corners[start:end], key=polygons.key[start:end])
        for frame, start, end in zip(frames, [0, *ends], ends, strict=False)
    ]


def polygons_of(boxes: BoxRows, config: MotionLabelConfig) -> Polygons:
    """The polygons of boxes that labels show; in each frame the ego's own first, then the others by their rows."""
    pose = flip_pose(boxes.ego_from_lidar).astype(np.float32)
    moved = _moved(_constructed(boxes.center, boxes.size, boxes.yaw), pose[boxes.frame])
    own, own_frame = _own_boxes(boxes, moved, pose, config)
    drawn = _drawn(boxes, config)
    others: AnyArray = (
        _leaning_corners(boxes, config.augmentation)[drawn]
        if config.rules.pose == "yaw"
        else _corners(_augmented(moved[drawn], config.augmentation))
    )
    if not config.rules.own_box_not_augmented:
        own = _augmented(own, config.augmentation)
    frame = np.concatenate([own_frame, boxes.frame[drawn]])
    order = np.argsort(frame, kind="stable")
    key = np.concatenate([np.full(len(own), OWN_BOX_ID, dtype=np.int64), boxes.actor_id[drawn]])
    return Polygons(np.concatenate([_corners(own), others])[order], frame[order], key[order])


def footprints_of(
    polygons: Polygons, ids: IntArray, frames: int, config: MotionLabelConfig
) -> Footprints:
    """The polygons of frames with these ids, rasterised in native orientation; later polygons lie on top."""
    native = config.grid.with_orientation(config.rules.native)
    given = (
        polygons.corners
        if config.rules.pose == "yaw"
        else polygons.corners.astype(np.float32, copy=False)
    )
    x, y = given[..., 0], given[..., 1] if config.rules.right_handed else -given[..., 1]
    place = np.stack((y, x) if native.orientation == "fiery" else (x, y), axis=-1)
    low, _, size = np.array(axes_of(native)[::-1]).T
    if config.rules.half_cell_shift:
        first_center, cell = (low + size / 2).astype(np.float32), size.astype(np.float32)
        cells: AnyArray = np.rint((place - first_center + cell / np.float32(2)) / cell)
    else:
        cells = np.floor((place.astype(np.float64) - low) / size)
    vertices = np.clip(cells, -_FAR, _FAR).astype(np.int64)
    return Footprints(
        vertices, polygons.frame, ids, topmost(vertices, native.shape, polygons.frame, frames)
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BoxRows:
    """The boxes of S samples' label frames, M in all; frames are numbered through all samples, T of each.

    Fields that `FrameBoxes` has too are as they are there, finite and right-handed.

    Attributes:
        frame: (M,) int64, ascending.
        center: (M, 3) float64.
        size: (M, 3) float64.
        yaw: (M,) float64.
        actor_id: (M,) int64.
        category: (M,) int.
        visible: (M,) bool.
        ego_from_lidar: (S · T, 4, 4) float64; the identity where there is no recording.
        has_own: (S, T) bool, whether the agent, at this frame of its recording, is a vehicle with a box of its own.
    """

    frame: IntArray
    center: FloatArray
    size: FloatArray
    yaw: FloatArray
    actor_id: IntArray
    category: AnyArray
    visible: BoolArray
    ego_from_lidar: FloatArray
    has_own: BoolArray

    @classmethod
    def of(cls, frames: Sequence[FrameBoxes | None], *, is_vehicle: bool) -> BoxRows:
        """Those of one sample; raises GeometryError."""
        for given in frames:
            if not isinstance(given, FrameBoxes | None):
                raise GeometryError(
                    f"frames: expected FrameBoxes, or None beyond the recording, found {given!r}"
                )
        known = [_NO_BOXES if frame is None else frame for frame in frames]
        center, size, yaw, actor_id, category, visible = (
            np.concatenate(columns)
            for columns in zip(*map(_COLUMNS, [_NO_BOXES, *known]), strict=True)
        )
        return cls(
            frame=np.repeat(np.arange(len(frames)), [len(frame.actor_id) for frame in known]),
            center=center,
            size=size,
            yaw=yaw,
            actor_id=actor_id,
            category=category,
            visible=visible,
            ego_from_lidar=np.reshape([frame.ego_from_lidar for frame in known], (-1, 4, 4)),
            has_own=np.array([[frame is not None and is_vehicle for frame in frames]]),
        )


_NO_BOXES: Final = FrameBoxes(
    center=np.zeros((0, 3)),
    size=np.zeros((0, 3)),
    yaw=np.zeros(0),
    actor_id=np.zeros(0, dtype=np.int64),
    category=np.zeros(0, dtype=np.int64),
    visible=np.zeros(0, dtype=bool),
    ego_from_lidar=np.eye(4),
)


def _drawn(boxes: BoxRows, config: MotionLabelConfig) -> BoolArray:
    """Which rows are rasterised. Own rows are not: `_own_boxes` has them."""
    rows: BoolArray = boxes.actor_id != OWN_ACTOR_ID
    if config.only_vehicle:
        rows &= boxes.category != _PEDESTRIAN
    if not config.filter_invisible:
        return rows
    ids, actor = np.unique(boxes.actor_id, return_inverse=True)
    seen = np.zeros((boxes.has_own.size, len(ids)), dtype=bool)
    seen[boxes.frame[boxes.visible], actor[boxes.visible]] = True
    of_sample = seen.reshape(*boxes.has_own.shape, len(ids))
    if config.rules.drawn_when == "present":
        of_sample[:] = of_sample[:, :1]
    elif config.rules.drawn_when == "since":
        of_sample[:] = np.logical_or.accumulate(of_sample, axis=1)
    by_id: BoolArray = seen[boxes.frame, actor]
    if not config.rules.untracked_share_an_id:
        by_id = np.where(boxes.actor_id == UNTRACKED_ID, boxes.visible, by_id)
    return rows & by_id


def _own_boxes(
    boxes: BoxRows, moved: Float32Array, pose: Float32Array, config: MotionLabelConfig
) -> tuple[Float32Array, IntArray]:
    """The ego's own boxes in the ego frames, at most one for each frame, and the numbers of their frames."""
    rules, frames = config.rules, np.arange(boxes.has_own.size)
    rows = np.flatnonzero(boxes.actor_id == OWN_ACTOR_ID)
    own = np.zeros((len(frames), 7), dtype=np.float32)
    own[boxes.frame[rows[::-1]]] = moved[rows[::-1]]  # the first one of a frame counts
    if rules.own_box_moved_twice:
        own -= own[:, 5:6] / 2 * _UP
    count = np.bincount(boxes.frame[rows], minlength=len(frames))
    default = rules.own_box_default & (count != 1)
    first, last = boxes.frame.searchsorted([frames, frames + 1])
    z = np.append(boxes.center[:, 2], 0)[np.where(first < last, first, -1)]
    at = np.stack([np.zeros_like(z), np.zeros_like(z), z], axis=1)
    own[default] = _constructed(at, np.tile(_DEFAULT_SIZE, (len(z), 1)), np.zeros_like(z))[default]
    twice = default | rules.own_box_moved_twice
    own[twice] = _moved(own[twice], pose[twice])
    shown = np.flatnonzero(boxes.has_own.reshape(-1) & (default | (count > 0)) & config.draw_ego)
    return own[shown], shown


def _constructed(center: FloatArray, size: FloatArray, yaw: FloatArray) -> Float32Array:
    """Right-handed boxes as mmdet3d's: (N, 7) float32 x, y (right), z of the bottom, l, w, h, yaw."""
    boxes = np.column_stack([center * (1, -1, 1), size, yaw]).astype(np.float32)
    boxes[:, 2] -= boxes[:, 5] / 2
    return boxes


def _moved(boxes: Float32Array, pose: Float32Array) -> Float32Array:
    """mmdet3d's rotate by the transposed rotations of left-handed poses (N, 4, 4), then translate."""
    xyz = single_precision.product(pose[:, :3, :3], boxes[:, :3, None])[..., 0] + pose[:, :3, 3]
    # computed in float64 and then rounded: equal to torch's in nearly all cases, unlike numpy's own float32
    turned = np.arctan2(pose[:, 0, 1].astype(np.float64), pose[:, 0, 0]).astype(np.float32)
    return np.column_stack([xyz, boxes[:, 3:6], boxes[:, 6] + turned])


def _augmented(boxes: Float32Array, augmentation: Augmentation | None) -> Float32Array:
    """mmdet3d's boxes turned, scaled and flipped; the flip swaps front and rear as old mmdet3d does."""
    if augmentation is None:
        return boxes
    turn = replace(augmentation, scale=1.0, flip=False).matrix
    moved = _moved(boxes, np.broadcast_to(flip_pose(turn).astype(np.float32), (len(boxes), 4, 4)))
    moved[:, :6] *= np.float32(augmentation.scale)
    if augmentation.flip:
        moved[:, 1] *= -1
        moved[:, 6] = np.float32(np.pi) - moved[:, 6]
    return moved


def _corners(boxes: Float32Array) -> Float32Array:
    """(N, 4, 2) float32 x forward, y left of mmdet3d's boxes' bottom corners 0, 3, 7, 4."""
    around, yaw = _CORNERS * boxes[:, None, 3:5], boxes[:, 6, None]
    sine, cosine = single_precision.sines_and_cosines(yaw)
    x = around[..., 0] * cosine + around[..., 1] * sine + boxes[:, 0, None]
    y = around[..., 0] * -sine + around[..., 1] * cosine + boxes[:, 1, None]
    return np.stack([x, -y], axis=-1)


def _leaning_corners(boxes: BoxRows, augmentation: Augmentation | None) -> FloatArray:
    """(M, 4, 2) x forward, y left of the bottom corners of the boxes, which turn with the whole rotation."""
    ends = boxes.frame.searchsorted(np.arange(len(boxes.ego_from_lidar)), side="right").tolist()
    corners = [
        Boxes.from_arrays(
            boxes.center[start:end],
            np.abs(boxes.size[start:end]),  # labels may have negative ones
            boxes.yaw[start:end],
            frame="lidar",
        )
        .transform(trusted_se3(pose), "ego")
        .bottom_corners()[..., :2]
        for pose, start, end in zip(boxes.ego_from_lidar, [0, *ends], ends, strict=False)
    ]
    return (
        np.concatenate(corners)
        @ (np.eye(4) if augmentation is None else augmentation.matrix)[:2, :2].T
    )
