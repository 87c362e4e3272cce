"""The boxes that appear in the labels at each frame, and their corners in the ego frame.

The released code turns label rows into mmdet3d boxes and moves the boxes, all in float32 and in
CARLA's left-handed frames. The resulting cells depend on the rounding, so its steps are reproduced
here one by one (docs/released_code.md, Conventions and samples, Motion labels).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
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
    NO_INDICES,
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
# The box, the size of a Lincoln car, that the released code assumes for an agent that has no
# row.
_DEFAULT_SIZE = (3.99, 1.85, 1.62)
# mmdet3d's corners 0, 3, 7, 4 from above, in lengths and widths.
_CORNERS = np.array([[-1, -1], [-1, 1], [1, 1], [1, -1]], dtype=np.float32) / 2
_UP = np.array([0, 0, 1, 0, 0, 0, 0], dtype=np.float32)
# Corners farther away are clamped to this distance, which is far outside the grid.
_MAX_CORNER_CELLS = 2**24
_PEDESTRIAN = CATEGORIES.index("pedestrian")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameBoxes(ShortRepr):
    """Boxes that an agent annotated at one moment, in its LiDAR frame, right-handed.

    Arrays are read-only.

    Attributes:
        center: Centres, shape (N, 3), float64, metres.
        size: Lengths, widths, heights, shape (N, 3), float64, metres.
        yaw: Headings about z, shape (N,), float64, radians.
        actor_id: Actor ids, shape (N,), int64; −100 marks the agent's own row, −1 the row of an
            untracked actor.
        category: Indices into `taxonomy.CATEGORIES`, shape (N,), int.
        visible: Whether the actor is seen by any agent whose view counts, shape (N,), bool
            (docs/released_code.md, Visibility and attributes).
        ego_from_lidar: Transform to the ego frame, shape (4, 4), float64; for a protocol with
            `pose="yaw"`, to the ego frame without roll and pitch.
    """

    center: FloatArray
    size: FloatArray
    yaw: FloatArray
    actor_id: IntArray
    category: AnyArray
    visible: BoolArray
    ego_from_lidar: FloatArray

    def __post_init__(self) -> None:
        """Check and freeze the arrays; raise GeometryError if one has a wrong shape or type."""
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
            is_finite = np.isfinite(array)
            if not is_finite.all():
                row = int(np.argwhere(~is_finite)[0, 0])
                remedy = "remove such rows"
                if name == "ego_from_lidar":
                    remedy = "give None for a frame without a pose"
                raise GeometryError(f"FrameBoxes.{name}: row {row} is not finite; {remedy}")
            object.__setattr__(self, name, readonly(array))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FramePolygons(ShortRepr):
    """Polygons at one moment, in the order in which they are rasterised; arrays are read-only.

    Attributes:
        corners: x and y of the footprints' corners in the moment's ego frame, shape (n, 4, 2),
            metres, right-handed; float32, or float64 for boxes with `pose="yaw"`.
        key: Actor ids, shape (n,), int64; the ego's own box is −101.
    """

    corners: AnyArray
    key: IntArray

    def __post_init__(self) -> None:
        """Check and freeze the arrays; raise GeometryError if one has a wrong shape or type."""
        is_double = getattr(self.corners, "dtype", None) == np.float64
        corners_dtype = np.float64 if is_double else np.float32
        corners = checked("FramePolygons.corners", self.corners, (None, 4, 2), corners_dtype)
        object.__setattr__(self, "corners", readonly(corners))
        key = checked("FramePolygons.key", self.key, (len(corners),), np.int64)
        object.__setattr__(self, "key", readonly(key))


class Polygons(NamedTuple):
    """Polygons at F frames in the order in which they are rasterised.

    The fields are as in `FramePolygons`.

    Attributes:
        corners: x and y of the corners, shape (n, 4, 2).
        frame: Index of each polygon's frame, shape (n,), int64, ascending.
        key: Actor ids, shape (n,), int64.
    """

    corners: AnyArray
    frame: IntArray
    key: IntArray

    @classmethod
    def of(cls, frames: Sequence[FramePolygons | None]) -> Polygons:
        """Return the polygons of all frames, one frame after another."""
        corners = [np.zeros((0, 4, 2), dtype=np.float32)]
        keys = [NO_INDICES]
        frame_numbers = [NO_INDICES]
        for number, frame in enumerate(frames):
            if frame is not None:
                corners.append(frame.corners)
                keys.append(frame.key)
                frame_numbers.append(np.full(len(frame.key), number, dtype=np.int64))
        return cls(np.concatenate(corners), np.concatenate(frame_numbers), np.concatenate(keys))


class Footprints(NamedTuple):
    """Rasterised polygons of all frames, sorted by frame, in native orientation.

    Attributes:
        corners: Columns and rows of the corners, shape (n, V, 2), int64.
        frame: Index of each polygon's frame, shape (n,), int64, ascending.
        identity: Ids from 1, shape (n,), int64.
        top: 1 + the index of the topmost polygon at each cell; 0 where there is none; shape (frames
            · cells,), int32.
    """

    corners: IntArray
    frame: IntArray
    identity: IntArray
    top: AnyArray


def box_polygons(
    frames: Sequence[FrameBoxes | None], config: MotionLabelConfig, *, is_vehicle: bool = True
) -> list[FramePolygons | None]:
    """Return the polygons of the boxes that appear in labels, frame by frame from the present on.

    Args:
        frames: Boxes of each label frame; None where there is no recording.
        config: Configuration of the labels.
        is_vehicle: Whether the agent is a vehicle, which has a box of its own; the infrastructure
            has none.

    Returns:
        Each frame's polygons, the ego's own first, then the others in row order; None where there
        is no recording.

    Raises:
        GeometryError: A frame is neither `FrameBoxes` nor None.
    """
    polygons = make_polygons(BoxRows.of(frames, is_vehicle=is_vehicle), config)
    bounds = polygons.frame.searchsorted(np.arange(len(frames) + 1)).tolist()
    frame_polygons: list[FramePolygons | None] = []
    for frame, (start, end) in zip(frames, pairwise(bounds), strict=True):
        if frame is None:
            frame_polygons.append(None)
            continue
        corners = polygons.corners[start:end]
        key = polygons.key[start:end]
        frame_polygons.append(FramePolygons(corners=corners, key=key))
    return frame_polygons


def make_polygons(boxes: BoxRows, config: MotionLabelConfig) -> Polygons:
    """Return the polygons of the boxes that appear in labels.

    In each frame the ego's own box comes first; the others follow in row order.
    """
    augmentation = config.augmentation
    pose = flip_pose(boxes.ego_from_lidar).astype(np.float32)
    lidar_boxes = _construct_boxes(boxes.center, boxes.size, boxes.yaw)
    ego_boxes = _move_boxes(lidar_boxes, pose[boxes.frame])
    own, own_frame = _own_boxes(boxes, ego_boxes, pose, config)
    is_drawn = _are_drawn(boxes, config)
    other_corners: AnyArray
    if config.rules.pose == "yaw":
        other_corners = _compute_leaning_corners(boxes, augmentation)[is_drawn]
    else:
        other_corners = _compute_corners(_augment_boxes(ego_boxes[is_drawn], augmentation))
    if not config.rules.own_box_not_augmented:
        own = _augment_boxes(own, augmentation)
    own_key = np.full(len(own), OWN_BOX_ID, dtype=np.int64)
    corners = np.concatenate([_compute_corners(own), other_corners])
    frame = np.concatenate([own_frame, boxes.frame[is_drawn]])
    key = np.concatenate([own_key, boxes.actor_id[is_drawn]])
    order = np.argsort(frame, kind="stable")
    return Polygons(corners[order], frame[order], key[order])


def rasterise_polygons(
    polygons: Polygons, ids: IntArray, frames: int, config: MotionLabelConfig
) -> Footprints:
    """Rasterise the polygons of all frames in native orientation; later polygons lie on top.

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
    column_and_row = (x, y)
    if native.orientation == "fiery":
        column_and_row = (y, x)
    position = np.stack(column_and_row, axis=-1)
    low, _, size = np.array(axes_of(native)[::-1]).T
    if config.rules.half_cell_shift:
        first_center = (low + size / 2).astype(np.float32)
        cell_size = size.astype(np.float32)
        half_cell = cell_size / np.float32(2)
        cells: AnyArray = np.rint((position - first_center + half_cell) / cell_size)
    else:
        cells = np.floor((position.astype(np.float64) - low) / size)
    vertices = np.clip(cells, -_MAX_CORNER_CELLS, _MAX_CORNER_CELLS).astype(np.int64)
    top = topmost(vertices, native.shape, polygons.frame, frames)
    return Footprints(vertices, polygons.frame, ids, top)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BoxRows:
    """M boxes at the T label frames of each of S samples; all frames are numbered consecutively.

    Fields of the same name are as in `FrameBoxes`, finite and right-handed.

    Attributes:
        frame: Index of each box's frame, shape (M,), int64, ascending.
        center: Centres, shape (M, 3), float64.
        size: Lengths, widths, heights, shape (M, 3), float64.
        yaw: Headings about z, shape (M,), float64.
        actor_id: Actor ids, shape (M,), int64.
        category: Indices into `taxonomy.CATEGORIES`, shape (M,), int.
        visible: Whether the actor is seen by any agent whose view counts, shape (M,), bool.
        ego_from_lidar: Transforms to the ego frames, shape (S · T, 4, 4), float64; the identity
            where there is no recording.
        has_own: Whether the agent is a vehicle that has a box of its own at this frame, shape (S,
            T), bool.
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
        """Return the boxes of one sample.

        Raise GeometryError if a frame is neither `FrameBoxes` nor None.
        """
        for frame in frames:
            if not isinstance(frame, FrameBoxes | None):
                raise GeometryError(
                    f"frames: expected FrameBoxes, or None beyond the recording, found {frame!r}"
                )
        frame_boxes = [frame or _NO_BOXES for frame in frames]
        counts = [len(boxes.actor_id) for boxes in frame_boxes]
        poses = [boxes.ego_from_lidar for boxes in frame_boxes]
        has_own = [frame is not None and is_vehicle for frame in frames]
        columns = {}
        for name in ("center", "size", "yaw", "actor_id", "category", "visible"):
            frame_columns = [getattr(boxes, name) for boxes in (_NO_BOXES, *frame_boxes)]
            columns[name] = np.concatenate(frame_columns)
        return cls(
            frame=np.repeat(np.arange(len(frames)), counts),
            ego_from_lidar=np.reshape(poses, (-1, 4, 4)),
            has_own=np.array([has_own]),
            **columns,
        )


_NO_BOXES = FrameBoxes(
    center=np.zeros((0, 3)),
    size=np.zeros((0, 3)),
    yaw=np.zeros(0),
    actor_id=NO_INDICES,
    category=NO_INDICES,
    visible=np.zeros(0, dtype=bool),
    ego_from_lidar=np.eye(4),
)


def _are_drawn(boxes: BoxRows, config: MotionLabelConfig) -> BoolArray:
    """Return whether each row is rasterised, shape (M,).

    The agent's own rows are not rasterised here: `_own_boxes` returns their boxes.
    """
    is_drawn: BoolArray = boxes.actor_id != OWN_ACTOR_ID
    if config.only_vehicle:
        is_drawn &= boxes.category != _PEDESTRIAN
    if not config.filter_invisible:
        return is_drawn
    ids, actor = np.unique(boxes.actor_id, return_inverse=True)
    visible = np.zeros((boxes.has_own.size, len(ids)), dtype=bool)
    visible[boxes.frame[boxes.visible], actor[boxes.visible]] = True
    by_sample = visible.reshape(*boxes.has_own.shape, len(ids))
    if config.rules.drawn_when == "present":
        by_sample[:] = by_sample[:, :1]
    elif config.rules.drawn_when == "since":
        by_sample[:] = np.logical_or.accumulate(by_sample, axis=1)
    is_visible: BoolArray = visible[boxes.frame, actor]
    if not config.rules.untracked_share_an_id:
        is_untracked = boxes.actor_id == UNTRACKED_ID
        is_visible = np.where(is_untracked, boxes.visible, is_visible)
    return is_drawn & is_visible


def _own_boxes(
    boxes: BoxRows, ego_boxes: Float32Array, pose: Float32Array, config: MotionLabelConfig
) -> tuple[Float32Array, IntArray]:
    """Return the ego's own boxes in the ego frames, at most one per frame.

    Args:
        boxes: Boxes of all frames.
        ego_boxes: The same boxes in mmdet3d's layout, in the ego frames, shape (M, 7).
        pose: Left-handed transforms to the ego frames, shape (S · T, 4, 4).
        config: Configuration of the labels.

    Returns:
        Boxes in mmdet3d's layout, shape (n, 7), and the index of each box's frame, shape (n,).
    """
    rules = config.rules
    frames = np.arange(boxes.has_own.size)
    rows = np.flatnonzero(boxes.actor_id == OWN_ACTOR_ID)
    own = np.zeros((len(frames), 7), dtype=np.float32)
    last_first = rows[::-1]
    own[boxes.frame[last_first]] = ego_boxes[last_first]  # only a frame's first one counts
    if rules.own_box_moved_twice:
        own -= own[:, 5:6] / 2 * _UP
    counts = np.bincount(boxes.frame[rows], minlength=len(frames))
    is_default = rules.own_box_default & (counts != 1)
    begins, ends = boxes.frame.searchsorted([frames, frames + 1])
    first_rows = np.where(begins < ends, begins, -1)
    z = np.append(boxes.center[:, 2], 0)[first_rows]
    zeros = np.zeros_like(z)
    center = np.stack([zeros, zeros, z], axis=1)
    default_boxes = _construct_boxes(center, np.tile(_DEFAULT_SIZE, (len(z), 1)), zeros)
    own[is_default] = default_boxes[is_default]
    is_moved = is_default | rules.own_box_moved_twice
    own[is_moved] = _move_boxes(own[is_moved], pose[is_moved])
    exists = boxes.has_own.reshape(-1) & (is_default | (counts > 0))
    drawn_frames = np.flatnonzero(exists & config.draw_ego)
    return own[drawn_frames], drawn_frames


def _construct_boxes(center: FloatArray, size: FloatArray, yaw: FloatArray) -> Float32Array:
    """Convert right-handed boxes to mmdet3d's layout, shape (N, 7), float32.

    The columns are x, y (right), z of the bottom, length, width, height, yaw.
    """
    boxes = np.column_stack([center * (1, -1, 1), size, yaw]).astype(np.float32)
    boxes[:, 2] -= boxes[:, 5] / 2
    return boxes


def _move_boxes(boxes: Float32Array, pose: Float32Array) -> Float32Array:
    """Move boxes by left-handed poses (N, 4, 4), as mmdet3d's rotate and translate do.

    mmdet3d rotates by the transposed rotation matrices of the poses.
    """
    rotation = pose[:, :3, :3]
    rotated = single_precision.product(rotation, boxes[:, :3, None])
    center = rotated[..., 0] + pose[:, :3, 3]
    # Computed in float64 and then rounded: nearly always equal to torch's result, unlike numpy's
    # float32.
    turn = np.arctan2(rotation[:, 0, 1].astype(np.float64), rotation[:, 0, 0])
    yaw = boxes[:, 6] + turn.astype(np.float32)
    return np.column_stack([center, boxes[:, 3:6], yaw])


def _augment_boxes(boxes: Float32Array, augmentation: Augmentation | None) -> Float32Array:
    """Rotate, scale and flip mmdet3d's boxes; like old mmdet3d, the flip swaps front and rear."""
    if augmentation is None:
        return boxes
    rotation = replace(augmentation, scale=1.0, flip=False)
    pose = flip_pose(rotation.matrix).astype(np.float32)
    moved = _move_boxes(boxes, np.broadcast_to(pose, (len(boxes), 4, 4)))
    moved[:, :6] *= np.float32(augmentation.scale)
    if augmentation.flip:
        moved[:, 1] *= -1
        moved[:, 6] = np.float32(np.pi) - moved[:, 6]
    return moved


def _compute_corners(boxes: Float32Array) -> Float32Array:
    """Return x (forward) and y (left) of the bottom corners 0, 3, 7, 4 of mmdet3d's boxes.

    The shape is (N, 4, 2), float32.
    """
    offsets = _CORNERS * boxes[:, None, 3:5]
    along = offsets[..., 0]
    across = offsets[..., 1]
    sine, cosine = single_precision.sines_and_cosines(boxes[:, 6, None])
    x = along * cosine + across * sine + boxes[:, 0, None]
    y = along * -sine + across * cosine + boxes[:, 1, None]
    return np.stack([x, -y], axis=-1)


def _compute_leaning_corners(boxes: BoxRows, augmentation: Augmentation | None) -> FloatArray:
    """Return x (forward) and y (left) of the bottom corners of boxes with roll and pitch.

    The shape is (M, 4, 2).
    """
    bounds = boxes.frame.searchsorted(np.arange(len(boxes.ego_from_lidar) + 1)).tolist()
    corners = []
    for pose, (start, end) in zip(boxes.ego_from_lidar, pairwise(bounds), strict=True):
        center = boxes.center[start:end]
        size = np.abs(boxes.size[start:end])  # labels may have negative sizes
        yaw = boxes.yaw[start:end]
        lidar_boxes = Boxes.from_arrays(center, size, yaw, frame="lidar")
        ego_boxes = lidar_boxes.transform(trusted_se3(pose), "ego")
        corners.append(ego_boxes.bottom_corners()[..., :2])
    matrix = np.eye(4) if augmentation is None else augmentation.matrix
    return np.concatenate(corners) @ matrix[:2, :2].T
