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
from deepaccident_devkit.exact import single_precision
from deepaccident_devkit.exact.polygon_fill import topmost
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.geometry.bev_grid import axes_of
from deepaccident_devkit.geometry.conventions import flip_pose
from deepaccident_devkit.geometry.se3 import trusted_se3
from deepaccident_devkit.motion.augmentation import Augmentation
from deepaccident_devkit.motion.config import MotionLabelConfig
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
_DEFAULT_SIZE: Final = (3.99, 1.85, 1.62)
"""The agent's box in the released code if it finds no row of the agent itself; it has the size of a Lincoln car."""
_CORNERS: Final = np.array([[-1, -1], [-1, 1], [1, 1], [1, -1]], dtype=np.float32) / 2
"""mmdet3d's corners 0, 3, 7, 4 from above, in lengths and widths."""
_UP: Final = np.array([0, 0, 1, 0, 0, 0, 0], dtype=np.float32)
_COLUMNS: Final = attrgetter("center", "size", "yaw", "actor_id", "category", "visible")
_FAR: Final = 2**24
"""In cells: corners farther away are moved to this distance, which is far outside the grid."""
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
                remedy = "give None for a frame without a pose" if name == "ego_from_lidar" else "leave out such rows"
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
        corners = checked("FramePolygons.corners", self.corners, (None, 4, 2), np.float64 if double else np.float32)
        object.__setattr__(self, "corners", readonly(corners))
        object.__setattr__(self, "key", readonly(checked("FramePolygons.key", self.key, (len(corners),), np.int64)))


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
    for given in frames:
        if not isinstance(given, FrameBoxes | None):
            raise GeometryError(f"frames: expected FrameBoxes, or None beyond the recording, found {given!r}")
    there = [number for number, frame in enumerate(frames) if frame is not None]
    known = [frame for frame in frames if frame is not None]
    result: list[FramePolygons | None] = [None] * len(frames)
    if not known:
        return result
    boxes, number = _Joined.of(known), np.arange(len(known))
    moved = _moved(boxes.values, boxes.pose[boxes.frame])
    own, own_frame = (
        _own_boxes(known, moved, boxes.pose, config) if config.draw_ego and is_vehicle else (moved[:0], number[:0])
    )
    drawn = _drawn(boxes, first=there[0], config=config)
    others: AnyArray = _corners(_augmented(moved[drawn], config.augmentation))
    if config.rules.pose == "yaw":
        others = _leaning_corners(known, config.augmentation)[drawn]
    if not config.rules.own_box_not_augmented:
        own = _augmented(own, config.augmentation)
    frame = np.concatenate([own_frame, boxes.frame[drawn]])
    order = np.argsort(frame, kind="stable")
    key = np.concatenate([np.full(len(own), OWN_BOX_ID, dtype=np.int64), boxes.actor_id[drawn]])[order]
    corners = np.concatenate([_corners(own), others])[order]
    ends = frame[order].searchsorted(number, side="right").tolist()
    for index, start, end in zip(there, [0, *ends], ends, strict=False):
        result[index] = FramePolygons(corners=corners[start:end], key=key[start:end])
    return result


def footprints_of(polygons: Sequence[FramePolygons | None], ids: IntArray, config: MotionLabelConfig) -> Footprints:
    """The polygons with these ids, rasterised in native orientation; later polygons lie on top."""
    native = config.grid.with_orientation(config.rules.native)
    there = [(number, frame) for number, frame in enumerate(polygons) if frame is not None]
    corners = np.concatenate([np.zeros((0, 4, 2), dtype=np.float32), *[frame.corners for _, frame in there]])
    frame = np.repeat([number for number, _ in there], [len(frame.key) for _, frame in there]).astype(np.int64)
    given = corners if config.rules.pose == "yaw" else corners.astype(np.float32, copy=False)
    x, y = given[..., 0], given[..., 1] if config.rules.right_handed else -given[..., 1]
    place = np.stack((y, x) if native.orientation == "fiery" else (x, y), axis=-1)
    low, _, size = np.array(axes_of(native)[::-1]).T
    if config.rules.half_cell_shift:
        first_center, cell = (low + size / 2).astype(np.float32), size.astype(np.float32)
        cells: AnyArray = np.rint((place - first_center + cell / np.float32(2)) / cell)
    else:
        cells = np.floor((place.astype(np.float64) - low) / size)
    vertices = np.clip(cells, -_FAR, _FAR).astype(np.int64)
    return Footprints(vertices, frame, ids, topmost(vertices, native.shape, frame, len(polygons)))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Joined:
    """The rows of several frames, M in all, as the released code holds them.

    Attributes:
        frame: (M,) which of the frames.
        values: (M, 7) float32, `_constructed`'s.
        actor_id: (M,) int64.
        category: (M,) int64.
        visible: (M,) bool.
        pose: (frames, 4, 4) float32, `ego_from_lidar`, left-handed.
    """

    frame: IntArray
    values: Float32Array
    actor_id: IntArray
    category: AnyArray
    visible: BoolArray
    pose: Float32Array

    @classmethod
    def of(cls, frames: Sequence[FrameBoxes]) -> _Joined:
        columns = zip(*map(_COLUMNS, frames), strict=True)
        center, size, yaw, actor_id, category, visible = map(np.concatenate, columns)
        return cls(
            frame=np.repeat(np.arange(len(frames)), [len(frame.actor_id) for frame in frames]),
            values=_constructed(center, size, yaw),
            actor_id=actor_id,
            category=category,
            visible=visible,
            pose=flip_pose([frame.ego_from_lidar for frame in frames]).astype(np.float32),
        )


def _drawn(boxes: _Joined, first: int, config: MotionLabelConfig) -> BoolArray:
    """Which rows are rasterised; `first` is the number of the first frame. Own rows are not: `_own_boxes` has them."""
    rows: BoolArray = boxes.actor_id != OWN_ACTOR_ID
    if config.only_vehicle:
        rows &= boxes.category != _PEDESTRIAN
    if not config.filter_invisible:
        return rows
    ids, actor = np.unique(boxes.actor_id, return_inverse=True)
    seen = np.zeros((len(boxes.pose), len(ids)), dtype=bool)
    seen[boxes.frame[boxes.visible], actor[boxes.visible]] = True
    if config.rules.drawn_when == "present":
        seen[:] = seen[0] if first == 0 else False
    elif config.rules.drawn_when == "since":
        seen = np.logical_or.accumulate(seen)
    by_id: BoolArray = seen[boxes.frame, actor]
    if not config.rules.untracked_share_an_id:
        by_id = np.where(boxes.actor_id == UNTRACKED_ID, boxes.visible, by_id)
    return rows & by_id


def _own_boxes(
    frames: Sequence[FrameBoxes], moved: Float32Array, pose: Float32Array, config: MotionLabelConfig
) -> tuple[Float32Array, IntArray]:
    """The ego's own boxes in the ego frames, at most one for each frame, and the numbers of their frames."""
    rules, own, of_frame, to_move = config.rules, [], [], []
    start = 0
    for number, frame in enumerate(frames):
        rows = np.flatnonzero(frame.actor_id == OWN_ACTOR_ID)
        default = rules.own_box_default and len(rows) != 1
        if default:
            z = frame.center[0, 2] if len(frame.center) else 0.0
            own.append(_constructed(np.array([[0, 0, z]]), np.array([_DEFAULT_SIZE]), np.zeros(1))[0])
        elif len(rows):
            own.append(moved[start + rows[0]])
            if rules.own_box_moved_twice:
                own[-1] = own[-1] - own[-1][5] / 2 * _UP
        if default or len(rows):
            of_frame.append(number)
            to_move.append(default or rules.own_box_moved_twice)
        start += len(frame.actor_id)
    boxes, which = np.array(own, dtype=np.float32).reshape(-1, 7), np.array(to_move, dtype=bool)
    numbers = np.array(of_frame, dtype=np.int64)
    boxes[which] = _moved(boxes[which], pose[numbers[which]])
    return boxes, numbers


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
    yaw = boxes[:, 6] + turned
    return np.column_stack([xyz, boxes[:, 3:6], yaw])


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


def _leaning_corners(frames: Sequence[FrameBoxes], augmentation: Augmentation | None) -> FloatArray:
    """(M, 4, 2) x forward, y left of the bottom corners of all frames' boxes, which turn with the whole rotation."""
    corners = [
        Boxes.from_arrays(each.center, np.abs(each.size), each.yaw, frame="lidar")  # labels may have negative sizes
        .transform(trusted_se3(each.ego_from_lidar), "ego")
        .bottom_corners()[..., :2]
        for each in frames
    ]
    return np.concatenate(corners) @ (np.eye(4) if augmentation is None else augmentation.matrix)[:2, :2].T
