"""Boxes that labels show at a frame, and the positions of their corners in the ego frame.

The released code turns label rows into mmdet3d boxes and moves the boxes, all in float32 and in
CARLA's left-handed frames. The cells depend on the rounding, so its steps are repeated here one by
one (docs/released_code.md, Conventions and samples, Motion labels).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
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
"""Key of the ego's own box in `MotionLabels.id_map`, as in the released code."""
# The released code's box of an agent without a row of its own, with the size of a Lincoln car.
_DEFAULT_SIZE: Final = (3.99, 1.85, 1.62)
# mmdet3d's corners 0, 3, 7, 4 from above, in lengths and widths.
_CORNERS: Final = np.array([[-1, -1], [-1, 1], [1, 1], [1, -1]], dtype=np.float32) / 2
_UP: Final = np.array([0, 0, 1, 0, 0, 0, 0], dtype=np.float32)
# Corners farther away are moved to this distance, which is far outside the grid.
_MAX_CORNER_CELLS: Final = 2**24
_PEDESTRIAN: Final = CATEGORIES.index("pedestrian")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameBoxes(ShortRepr):
    """Boxes that an agent annotated at one moment, in its LiDAR frame, right-handed.

    Arrays are read-only.

    Attributes:
        center: Centres, shape (N, 3), float64, metres.
        size: Lengths, widths, heights, shape (N, 3), float64, metres.
        yaw: Headings about z, shape (N,), float64, radians.
        actor_id: Actor ids, shape (N,), int64; −100 is the agent's own row, −1 an untracked
            actor's.
        category: Positions in `taxonomy.CATEGORIES`, shape (N,), int.
        visible: Whether any agent that counts sees the actor, shape (N,), bool
            (docs/released_code.md, Visibility and attributes).
        ego_from_lidar: Transform to the ego frame, shape (4, 4), float64; for a protocol with
            `pose="yaw"` to the ego frame without its lean.
    """

    center: FloatArray
    size: FloatArray
    yaw: FloatArray
    actor_id: IntArray
    category: AnyArray
    visible: BoolArray
    ego_from_lidar: FloatArray

    def __post_init__(self) -> None:
        """Check and freeze the arrays; raises GeometryError."""
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
                remedy = "leave out such rows"
                if name == "ego_from_lidar":
                    remedy = "give None for a frame without a pose"
                raise GeometryError(f"FrameBoxes.{name}: row {row} is not finite; {remedy}")
            object.__setattr__(self, name, readonly(array))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FramePolygons(ShortRepr):
    """Polygons of one moment, in the order in which they are rasterised; arrays are read-only.

    Attributes:
        corners: x and y of the footprints' corners in the moment's ego frame, shape (n, 4, 2),
            metres, right-handed; float32, or float64 for boxes with `pose="yaw"`.
        key: Actor ids, shape (n,), int64; the ego's own box is −101.
    """

    corners: AnyArray
    key: IntArray

    def __post_init__(self) -> None:
        """Check and freeze the arrays; raises GeometryError."""
        is_double = getattr(self.corners, "dtype", None) == np.float64
        dtype = np.float64 if is_double else np.float32
        corners = checked("FramePolygons.corners", self.corners, (None, 4, 2), dtype)
        object.__setattr__(self, "corners", readonly(corners))
        key = checked("FramePolygons.key", self.key, (len(corners),), np.int64)
        object.__setattr__(self, "key", readonly(key))


class Polygons(NamedTuple):
    """Polygons of F frames in the order in which they are rasterised; fields as in `FramePolygons`.

    Attributes:
        corners: x and y of the corners, shape (n, 4, 2).
        frame: Numbers of the frames, shape (n,), int64, ascending.
        key: Actor ids, shape (n,), int64.
    """

    corners: AnyArray
    frame: IntArray
    key: IntArray

    @classmethod
    def of(cls, frames: Sequence[FramePolygons | None]) -> Polygons:
        """Return the polygons of all frames, one frame after another."""
        corners = [np.zeros((0, 4, 2), dtype=np.float32)]
        keys = [np.zeros(0, dtype=np.int64)]
        frame_numbers = [np.zeros(0, dtype=np.int64)]
        for number, frame in enumerate(frames):
            if frame is not None:
                corners.append(frame.corners)
                keys.append(frame.key)
                frame_numbers.append(np.full(len(frame.key), number, dtype=np.int64))
        return cls(np.concatenate(corners), np.concatenate(frame_numbers), np.concatenate(keys))


class Footprints(NamedTuple):
    """Rasterised polygons of all frames in the order of their frames, in native orientation.

    Attributes:
        corners: Columns and rows of the corners, shape (n, V, 2), int64.
        frame: Numbers of the frames, shape (n,), int64, ascending.
        identity: Ids from 1, shape (n,), int64.
        top: 1 + the number of the polygon on top of each cell, 0 where there is none, shape (frames
            · cells,), int32.
    """

    corners: IntArray
    frame: IntArray
    identity: IntArray
    top: AnyArray


def box_polygons(
    frames: Sequence[FrameBoxes | None], config: MotionLabelConfig, *, is_vehicle: bool = True
) -> list[FramePolygons | None]:
    """Return the polygons of boxes that labels show, frame by frame from the present on.

    Args:
        frames: Boxes of each label frame; None where there is no recording.
        config: Configuration of the labels.
        is_vehicle: Whether the agent is a vehicle, with a box of its own (the infrastructure has
            none).

    Returns:
        Each frame's polygons, the ego's own first, then the others in the order of their rows; None
        where there is no recording.

    Raises:
        GeometryError: A frame is neither `FrameBoxes` nor None.
    """
    polygons = polygons_of(BoxRows.of(frames, is_vehicle=is_vehicle), config)
    ends = polygons.frame.searchsorted(np.arange(len(frames)), side="right").tolist()
    frame_polygons: list[FramePolygons | None] = []
    for frame, start, end in zip(frames, [0, *ends], ends, strict=False):
        if frame is None:
            frame_polygons.append(None)
        else:
            corners = polygons.corners[start:end]
            frame_polygons.append(FramePolygons(corners=corners, key=polygons.key[start:end]))
    return frame_polygons


def polygons_of(boxes: BoxRows, config: MotionLabelConfig) -> Polygons:
    """Return the polygons of boxes that labels show.

    In each frame the ego's own is the first, then follow the others by their rows.
    """
    pose = flip_pose(boxes.ego_from_lidar).astype(np.float32)
    constructed = _constructed(boxes.center, boxes.size, boxes.yaw)
    moved = _moved(constructed, pose[boxes.frame])
    own, own_frame = _own_boxes(boxes, moved, pose, config)
    drawn = _are_drawn(boxes, config)
    other_corners: AnyArray
    if config.rules.pose == "yaw":
        other_corners = _leaning_corners(boxes, config.augmentation)[drawn]
    else:
        other_corners = _corners(_augmented(moved[drawn], config.augmentation))
    if not config.rules.own_box_not_augmented:
        own = _augmented(own, config.augmentation)
    own_key = np.full(len(own), OWN_BOX_ID, dtype=np.int64)
    corners = np.concatenate([_corners(own), other_corners])
    frame = np.concatenate([own_frame, boxes.frame[drawn]])
    key = np.concatenate([own_key, boxes.actor_id[drawn]])
    order = np.argsort(frame, kind="stable")
    return Polygons(corners[order], frame[order], key[order])


def footprints_of(
    polygons: Polygons, ids: IntArray, frames: int, config: MotionLabelConfig
) -> Footprints:
    """Rasterise the polygons of frames in native orientation; later polygons lie on top.

    Args:
        polygons: Polygons of all frames.
        ids: Id of each polygon, shape (n,).
        frames: Number of frames.
        config: Configuration of the labels.
    """
    native = config.grid.with_orientation(config.rules.native)
    corners = polygons.corners
    if config.rules.pose != "yaw":
        corners = corners.astype(np.float32, copy=False)
    x = corners[..., 0]
    y = corners[..., 1]
    if not config.rules.right_handed:
        y = -y
    position = np.stack((y, x) if native.orientation == "fiery" else (x, y), axis=-1)
    low, _, size = np.array(axes_of(native)[::-1]).T
    if config.rules.half_cell_shift:
        first_center = (low + size / 2).astype(np.float32)
        cell = size.astype(np.float32)
        cells: AnyArray = np.rint((position - first_center + cell / np.float32(2)) / cell)
    else:
        cells = np.floor((position.astype(np.float64) - low) / size)
    vertices = np.clip(cells, -_MAX_CORNER_CELLS, _MAX_CORNER_CELLS).astype(np.int64)
    top = topmost(vertices, native.shape, polygons.frame, frames)
    return Footprints(vertices, polygons.frame, ids, top)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BoxRows:
    """M boxes of the label frames of S samples; frames are numbered through all samples, T of each.

    Fields of the same name are as in `FrameBoxes`, finite and right-handed.

    Attributes:
        frame: Numbers of the frames, shape (M,), int64, ascending.
        center: Centres, shape (M, 3), float64.
        size: Lengths, widths, heights, shape (M, 3), float64.
        yaw: Headings about z, shape (M,), float64.
        actor_id: Actor ids, shape (M,), int64.
        category: Positions in `taxonomy.CATEGORIES`, shape (M,), int.
        visible: Whether any agent that counts sees the actor, shape (M,), bool.
        ego_from_lidar: Transforms to the ego frames, shape (S · T, 4, 4), float64; the identity
            where there is no recording.
        has_own: Whether the agent, at this frame of its recording, is a vehicle with a box of its
            own, shape (S, T), bool.
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
        """Return the boxes of one sample; raises GeometryError."""
        for frame in frames:
            if not isinstance(frame, FrameBoxes | None):
                raise GeometryError(
                    f"frames: expected FrameBoxes, or None beyond the recording, found {frame!r}"
                )
        all_frames = [_NO_BOXES if frame is None else frame for frame in frames]
        parts = [_NO_BOXES, *all_frames]
        counts = [len(boxes.actor_id) for boxes in all_frames]
        poses = [boxes.ego_from_lidar for boxes in all_frames]
        return cls(
            frame=np.repeat(np.arange(len(frames)), counts),
            center=np.concatenate([boxes.center for boxes in parts]),
            size=np.concatenate([boxes.size for boxes in parts]),
            yaw=np.concatenate([boxes.yaw for boxes in parts]),
            actor_id=np.concatenate([boxes.actor_id for boxes in parts]),
            category=np.concatenate([boxes.category for boxes in parts]),
            visible=np.concatenate([boxes.visible for boxes in parts]),
            ego_from_lidar=np.reshape(poses, (-1, 4, 4)),
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


def _are_drawn(boxes: BoxRows, config: MotionLabelConfig) -> BoolArray:
    """Return which rows are rasterised, shape (M,). Own rows are not: `_own_boxes` has them."""
    rows: BoolArray = boxes.actor_id != OWN_ACTOR_ID
    if config.only_vehicle:
        rows &= boxes.category != _PEDESTRIAN
    if not config.filter_invisible:
        return rows
    ids, actor = np.unique(boxes.actor_id, return_inverse=True)
    visible = np.zeros((boxes.has_own.size, len(ids)), dtype=bool)
    visible[boxes.frame[boxes.visible], actor[boxes.visible]] = True
    by_sample = visible.reshape(*boxes.has_own.shape, len(ids))
    if config.rules.drawn_when == "present":
        by_sample[:] = by_sample[:, :1]
    elif config.rules.drawn_when == "since":
        by_sample[:] = np.logical_or.accumulate(by_sample, axis=1)
    by_id: BoolArray = visible[boxes.frame, actor]
    if not config.rules.untracked_share_an_id:
        by_id = np.where(boxes.actor_id == UNTRACKED_ID, boxes.visible, by_id)
    return rows & by_id


def _own_boxes(
    boxes: BoxRows, moved: Float32Array, pose: Float32Array, config: MotionLabelConfig
) -> tuple[Float32Array, IntArray]:
    """Return the ego's own boxes in the ego frames, at most one for each frame.

    Args:
        boxes: Boxes of all frames.
        moved: The same boxes in mmdet3d's form in the ego frames, shape (M, 7).
        pose: Left-handed transforms to the ego frames, shape (S · T, 4, 4).
        config: Configuration of the labels.

    Returns:
        Boxes in mmdet3d's form, shape (n, 7), and the numbers of their frames, shape (n,).
    """
    rules = config.rules
    frames = np.arange(boxes.has_own.size)
    rows = np.flatnonzero(boxes.actor_id == OWN_ACTOR_ID)
    own = np.zeros((len(frames), 7), dtype=np.float32)
    own[boxes.frame[rows[::-1]]] = moved[rows[::-1]]  # the first one of a frame counts
    if rules.own_box_moved_twice:
        own -= own[:, 5:6] / 2 * _UP
    count = np.bincount(boxes.frame[rows], minlength=len(frames))
    is_default = rules.own_box_default & (count != 1)
    begin, end = boxes.frame.searchsorted([frames, frames + 1])
    z = np.append(boxes.center[:, 2], 0)[np.where(begin < end, begin, -1)]
    zeros = np.zeros_like(z)
    center = np.stack([zeros, zeros, z], axis=1)
    default_boxes = _constructed(center, np.tile(_DEFAULT_SIZE, (len(z), 1)), zeros)
    own[is_default] = default_boxes[is_default]
    is_moved = is_default | rules.own_box_moved_twice
    own[is_moved] = _moved(own[is_moved], pose[is_moved])
    exists = boxes.has_own.reshape(-1) & (is_default | (count > 0))
    drawn = np.flatnonzero(exists & config.draw_ego)
    return own[drawn], drawn


def _constructed(center: FloatArray, size: FloatArray, yaw: FloatArray) -> Float32Array:
    """Return right-handed boxes in mmdet3d's form, shape (N, 7), float32.

    The columns are x, y (right), z of the bottom, length, width, height, yaw.
    """
    boxes = np.column_stack([center * (1, -1, 1), size, yaw]).astype(np.float32)
    boxes[:, 2] -= boxes[:, 5] / 2
    return boxes


def _moved(boxes: Float32Array, pose: Float32Array) -> Float32Array:
    """Move boxes by left-handed poses (N, 4, 4) as mmdet3d's rotate and translate do.

    It rotates by the transposed rotations of the poses.
    """
    rotated = single_precision.product(pose[:, :3, :3], boxes[:, :3, None])[..., 0]
    center = rotated + pose[:, :3, 3]
    # Computed in float64 and then rounded: equal to torch's in nearly all cases, unlike numpy's own
    # float32.
    turn = np.arctan2(pose[:, 0, 1].astype(np.float64), pose[:, 0, 0]).astype(np.float32)
    return np.column_stack([center, boxes[:, 3:6], boxes[:, 6] + turn])


def _augmented(boxes: Float32Array, augmentation: Augmentation | None) -> Float32Array:
    """Turn, scale and flip mmdet3d's boxes; the flip swaps front and rear as old mmdet3d does."""
    if augmentation is None:
        return boxes
    turn = replace(augmentation, scale=1.0, flip=False).matrix
    pose = flip_pose(turn).astype(np.float32)
    moved = _moved(boxes, np.broadcast_to(pose, (len(boxes), 4, 4)))
    moved[:, :6] *= np.float32(augmentation.scale)
    if augmentation.flip:
        moved[:, 1] *= -1
        moved[:, 6] = np.float32(np.pi) - moved[:, 6]
    return moved


def _corners(boxes: Float32Array) -> Float32Array:
    """Return x forward and y left of the bottom corners 0, 3, 7, 4 of mmdet3d's boxes.

    The shape is (N, 4, 2), float32.
    """
    offsets = _CORNERS * boxes[:, None, 3:5]
    along = offsets[..., 0]
    across = offsets[..., 1]
    sine, cosine = single_precision.sines_and_cosines(boxes[:, 6, None])
    x = along * cosine + across * sine + boxes[:, 0, None]
    y = along * -sine + across * cosine + boxes[:, 1, None]
    return np.stack([x, -y], axis=-1)


def _leaning_corners(boxes: BoxRows, augmentation: Augmentation | None) -> FloatArray:
    """Return x forward and y left of the bottom corners of boxes that turn in all axes.

    The shape is (M, 4, 2).
    """
    ends = boxes.frame.searchsorted(np.arange(len(boxes.ego_from_lidar)), side="right").tolist()
    corners = []
    for pose, start, end in zip(boxes.ego_from_lidar, [0, *ends], ends, strict=False):
        size = np.abs(boxes.size[start:end])  # labels may have negative sizes
        lidar_boxes = Boxes.from_arrays(
            boxes.center[start:end], size, boxes.yaw[start:end], frame="lidar"
        )
        ego_boxes = lidar_boxes.transform(trusted_se3(pose), "ego")
        corners.append(ego_boxes.bottom_corners()[..., :2])
    matrix = np.eye(4) if augmentation is None else augmentation.matrix
    return np.concatenate(corners) @ matrix[:2, :2].T
