"""`Boxes`: oriented boxes of a sample as arrays; `Box`: a view of one row.

`Box` has the attribute names of nuScenes.
"""

from __future__ import annotations

import operator
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import repeat
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar, overload

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.geometry import box_arrays, quaternions
from deepaccident_devkit.geometry.box_arrays import BOX_COLUMNS
from deepaccident_devkit.geometry.conventions import checked_frame
from deepaccident_devkit.geometry.se3 import SE3, checked_transform
from deepaccident_devkit.support.arrays import (
    NO_INDICES,
    AnyArray,
    BoolArray,
    FloatArray,
    FrozenArrays,
    IntArray,
    as_floats,
    checked,
    readonly,
)
from deepaccident_devkit.support.nuscenes_names import (
    BOX,
    BOX_MADE,
    with_keywords_named,
    without_names,
)
from deepaccident_devkit.support.text import PictureRepr, counted
from deepaccident_devkit.support.values import NamedValues
from deepaccident_devkit.taxonomy import ACTOR, CAMERAS, CATEGORIES, OWN_ACTOR_ID, UNTRACKED_ID

if TYPE_CHECKING:
    from pyquaternion import Quaternion

_Value = TypeVar("_Value")
CORNER_SIGNS = np.array(
    [
        [1, 1, 1],
        [1, -1, 1],
        [1, -1, -1],
        [1, 1, -1],
        [-1, 1, 1],
        [-1, -1, 1],
        [-1, -1, -1],
        [-1, 1, -1],
    ],
    dtype=np.float64,
)
"""Signs of (length, width, height) of the eight corners, in the nuScenes devkit's order.

The four in front come first, then the four behind; each four are clockwise from the upper left, as
seen by a viewer in the box who looks forward (with y left).
"""
# Indices of the lower corners: front right, front left, rear left, rear right.
BOTTOM_CORNERS = (2, 3, 7, 6)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Boxes(FrozenArrays, PictureRepr):
    """N oriented boxes in one right-handed coordinate frame, as read-only copies of the arrays.

    Attributes:
        frame: Coordinate frame: `world`, `ego`, `lidar` or a camera channel (then with optical
            axes).
        center: (N, 3) float64 centres, metres.
        size: (N, 3) float64 full length, width, height, metres.
        rotation: (N, 4) float64 unit quaternions w, x, y, z: the box's axes (x along its length) in
            `frame`.
        velocity: (N, 3) float64 velocities over the ground (not relative to the agent), m/s, NaN if
            unknown.
        category: (N,) int8 index into `taxonomy.CATEGORIES`.
        actor_id: (N,) int64 id in the label; −100 is the recording agent, −1 an untracked actor.
        num_lidar_pts: (N,) int64 number of LiDAR points of the recording agent in the box.
        camera_visible: (N,) bool, whether any of the recording agent's cameras sees the box.
        row: (N,) int64 row of the box in its label file, counted from 0.
        sample: Token of the sample whose label contains all boxes; None if the boxes come from
            several samples or from none.
        scenario: Token of the scenario that all boxes come from; None if they come from several
            scenarios or from none.
        own_actor_id: CARLA id of the agent whose own row has the actor id −100; −1 if it is
            unknown, or if there are such rows of several agents.
    """

    # Where the boxes are.
    frame: str
    center: FloatArray
    size: FloatArray
    rotation: FloatArray
    velocity: FloatArray
    # What they are.
    category: AnyArray
    actor_id: IntArray
    num_lidar_pts: IntArray
    camera_visible: BoolArray
    # Which label they come from.
    row: IntArray
    sample: str | None = None
    scenario: str | None = None
    own_actor_id: int = UNTRACKED_ID

    def __post_init__(self) -> None:
        """Check shapes and numbers.

        Raises:
            GeometryError: If a shape is wrong or a number is invalid.
        """
        checked_frame("Boxes.frame", self.frame)
        for name in ("sample", "scenario"):
            token = getattr(self, name)
            if not (token is None or isinstance(token, str)):
                raise GeometryError(f"Boxes.{name}: expected a token or None, found {token!r}")
        count = len(checked("Boxes.center", self.center, (None, 3)))
        columns: dict[str, AnyArray] = {}
        for name, (shape, dtype) in BOX_COLUMNS.items():
            values = getattr(self, name)
            if name == "category":
                values = box_arrays.category_codes(values)
            columns[name] = checked(f"Boxes.{name}", values, (count, *shape[1:]), dtype).copy()
        box_arrays.check_numbers(columns)
        columns["rotation"] = box_arrays.unit_quaternions(columns["rotation"])
        for name, array in columns.items():
            object.__setattr__(self, name, readonly(array))

    @classmethod
    def from_arrays(
        cls,
        center: ArrayLike,
        size: ArrayLike,
        yaw: ArrayLike,
        *,
        frame: str = "world",
        category: ArrayLike | None = None,
        **columns: ArrayLike,
    ) -> Boxes:
        """Return upright boxes in `frame` (rotated about z only).

        Args:
            center: (N, 3) centres, metres.
            size: (N, 3) full length, width, height, metres.
            yaw: (N,) headings, radians, counter-clockwise.
            frame: Coordinate frame of all values.
            category: (N,) indices or names of categories; None for cars.
            **columns: Other columns of `Boxes`; by default they are unknown (velocity NaN, id −1,
                no points, not visible).

        Raises:
            GeometryError: If a shape is wrong, a number or category is invalid, or a column is
                unknown.
        """
        heading = checked("Boxes.yaw", yaw, (None,))
        count = len(heading)
        if category is None:
            category = np.zeros(count, dtype=np.int8)
        all_columns: NamedValues = {
            "category": category,
            "velocity": np.full((count, 3), np.nan),
            "actor_id": np.full(count, -1),
            "num_lidar_pts": np.zeros(count),
            "camera_visible": np.zeros(count, dtype=bool),
            "row": np.arange(count),
            **columns,
        }
        unknown = set(all_columns) - set(BOX_COLUMNS)
        if unknown:
            raise GeometryError(
                f"Boxes has no column {sorted(unknown)}; it has {list(BOX_COLUMNS)}"
            )
        return cls(
            frame=frame,
            center=center,  # type: ignore[arg-type]  # checked in __post_init__
            size=size,  # type: ignore[arg-type]
            rotation=quaternions.from_yaw(heading),
            **all_columns,
        )

    def __len__(self) -> int:
        """Return the number of boxes."""
        return len(self.center)

    @overload
    def __getitem__(self, key: int | np.integer[Any]) -> Box: ...
    @overload
    def __getitem__(self, key: slice | Sequence[int] | Sequence[bool] | AnyArray) -> Boxes: ...
    def __getitem__(self, key: Any) -> Box | Boxes:
        """Return one box by its index, or the boxes of a slice, a mask or an array of rows.

        Negative indices count from the end. A mask has shape (N,).

        Raises:
            IndexError: If the index is out of range.
            GeometryError: If `key` is none of these, or does not fit the number of boxes (see
                `select`).
        """
        if isinstance(key, slice):
            return self._select(key)
        try:
            number = operator.index(key)
        except TypeError:
            return self.select(key)
        if isinstance(key, bool):
            return self.select(key)
        if not -len(self) <= number < len(self):
            raise IndexError(f"no box {number} among {counted(len(self), 'box')}")
        row = number % len(self)
        box = self._select(slice(row, row + 1))
        token = None if box.token is None else box.token[0]
        instance_token = None if box.instance_token is None else box.instance_token[0]
        return Box(box, token, instance_token)

    def __iter__(self) -> Iterator[Box]:
        """Yield each box, which takes a few microseconds; for many boxes, use the arrays."""
        tokens = self.token or repeat(None)
        instance_tokens = self.instance_token or repeat(None)
        rows = zip(range(len(self)), tokens, instance_tokens, strict=False)
        for row, token, instance_token in rows:
            yield Box(self._select(slice(row, row + 1)), token, instance_token)

    def __array__(self, dtype: object = None, copy: object = None) -> NoReturn:
        """Raise GeometryError, because boxes consist of several arrays.

        Without this method, numpy would make an array of objects.
        """
        raise GeometryError("Boxes contain several arrays; give one array, such as boxes.center")

    def __repr__(self) -> str:
        """Return number, frame and categories of the boxes."""
        title = f"{len(self)} in {self.frame}"
        counts = Counter(self.category_names).most_common()
        if not counts:
            return f"Boxes({title})"
        texts = [f"{count} {name}" for name, count in counts]
        return f"Boxes({title}: {', '.join(texts)})"

    @property
    def token(self) -> list[str] | None:
        """Tokens of the N annotations; None if the boxes come from several samples or from none."""
        if self.sample is None:
            return None
        return [f"{self.sample}/{row}" for row in self.row.tolist()]

    @property
    def instance_token(self) -> list[str | None] | None:
        """Tokens of the N actors, None for untracked ones; None if the scenario is not known."""
        if self.scenario is None:
            return None
        prefix = f"{self.scenario}/{ACTOR}/"
        own_token = None
        if self.own_actor_id != UNTRACKED_ID:
            own_token = f"{prefix}{self.own_actor_id}"
        special_tokens = {OWN_ACTOR_ID: own_token, UNTRACKED_ID: None}
        tokens = []
        for actor_id in self.actor_id.tolist():
            token = special_tokens.get(actor_id, f"{prefix}{actor_id}")
            tokens.append(token)
        return tokens

    @property
    def yaw(self) -> FloatArray:
        """(N,) heading of each box's length axis about z of `frame`, radians in (−π, π]."""
        return quaternions.yaw_of(self.rotation)

    @property
    def category_names(self) -> list[str]:
        """Category names of the N boxes."""
        return [CATEGORIES[code] for code in self.category.tolist()]

    def select(self, rows: ArrayLike) -> Boxes:
        """Return the boxes that a mask (N,) or an integer array of rows selects.

        Raises:
            GeometryError: If `rows` is neither of the two, or a row does not exist.
        """
        selection = np.asarray(rows)
        if selection.ndim != 1:
            raise GeometryError(
                f"expected a mask ({len(self)},) or an array of rows, found {rows!r}"
            )
        if not selection.size:
            selection = NO_INDICES
        try:
            return self._select(selection)
        except IndexError as error:
            raise GeometryError(
                f"{rows!r} does not pick from {len(self)} boxes: {error}"
            ) from error

    def transform(self, target_from_source: SE3, frame: str) -> Boxes:
        """Transform the boxes to `frame`; raise GeometryError if an argument is invalid."""
        checked_transform("target_from_source", target_from_source)
        checked_frame("frame", frame)
        rotation = target_from_source.rotation
        multiplier = quaternions.single_left_multiplier(rotation)
        return trusted_boxes(
            frame,
            {
                "center": self.center @ rotation.T + target_from_source.translation,
                "size": self.size,
                "rotation": self.rotation @ multiplier.T,
                "velocity": self.velocity @ rotation.T,
                "category": self.category,
                "actor_id": self.actor_id,
                "num_lidar_pts": self.num_lidar_pts,
                "camera_visible": self.camera_visible,
                "row": self.row,
            },
            self.sample,
            self.scenario,
            self.own_actor_id,
        )

    def corners(self) -> FloatArray:
        """Return the eight corners of each box, (N, 8, 3) metres, ordered as `CORNER_SIGNS`."""
        offsets = self.size[:, None, :] / 2 * CORNER_SIGNS
        rotation = quaternions.to_matrix(self.rotation)
        rotated_offsets: FloatArray = offsets @ np.swapaxes(rotation, 1, 2)
        return rotated_offsets + self.center[:, None, :]

    def bottom_corners(self) -> FloatArray:
        """Return the four corners of each box's lower face, (N, 4, 3) metres.

        The order is front right, front left, rear left, rear right.
        """
        return self.corners()[:, BOTTOM_CORNERS]

    def contains(self, points: ArrayLike) -> BoolArray:
        """Return whether each point lies in each box, faces included, shape (N, P).

        Args:
            points: (P, 3) metres in the same coordinate frame.
        """
        xyz = checked("points", points, (None, 3))
        is_inside = np.zeros((len(self), len(xyz)), dtype=bool)
        is_inside[self._points_within(xyz)] = True
        return is_inside

    def count_points(self, points: ArrayLike) -> IntArray:
        """Return the number of points in each box, faces included, shape (N,) int64.

        Args:
            points: (P, 3) metres in the same coordinate frame.
        """
        xyz = checked("points", points, (None, 3))
        boxes, _ = self._points_within(xyz)
        return np.bincount(boxes, minlength=len(self)).astype(np.int64)

    def iou_bev(self, other: Boxes) -> FloatArray:
        """Return the IoU of the footprints of these N boxes and M others, shape (N, M).

        IoU (intersection over union) is in [0, 1]. A footprint is the rectangle of length × width
        at the box's yaw: a tilted box is treated as upright in the frame, with the same centre,
        size and yaw. If both boxes have no area, the IoU is 0.

        Raises:
            GeometryError: If the frames differ, or are a camera's, where z points forward.
        """
        self._check_ground(other)
        common_areas = box_arrays.intersection_areas(self._footprints(), other._footprints())
        return _over_union(common_areas, self.size[:, :2], other.size[:, :2])

    def iou_3d(self, other: Boxes) -> FloatArray:
        """Return the IoU of the volumes of these N boxes and M others, shape (N, M).

        IoU (intersection over union) is in [0, 1]. The common volume is the footprints' common area
        times the common height. This is exact for upright boxes, like labels in the LiDAR frame; a
        tilted box is treated as upright, with the same centre, size and yaw. If both boxes have no
        volume, the IoU is 0.

        Raises:
            GeometryError: If the frames differ, or are a camera's, where z points forward.
        """
        self._check_ground(other)
        common_areas = box_arrays.intersection_areas(self._footprints(), other._footprints())
        bottom, top = self._heights()
        other_bottom, other_top = other._heights()
        common_top = np.minimum(top[:, None], other_top)
        common_bottom = np.maximum(bottom[:, None], other_bottom)
        common_volumes = common_areas * np.maximum(common_top - common_bottom, 0)
        return _over_union(common_volumes, self.size, other.size)

    def distance_bev(self, other: Boxes) -> FloatArray:
        """Return the gaps between the footprints of these N boxes and M others, (N, M), metres.

        A gap is 0 if the two touch or overlap. Footprints and errors are as in `iou_bev`.
        """
        self._check_ground(other)
        footprints = self._footprints()
        return box_arrays.gaps(footprints, other._footprints())

    def _select(self, rows: slice | AnyArray) -> Boxes:
        """Return the boxes of a slice, mask or rows; raise IndexError if a row does not exist."""
        columns = {}
        for name in BOX_COLUMNS:
            columns[name] = getattr(self, name)[rows]
        return trusted_boxes(self.frame, columns, self.sample, self.scenario, self.own_actor_id)

    def _points_within(self, points: FloatArray) -> tuple[IntArray, IntArray]:
        """Return indices of boxes and of points (P, 3), one pair for each point in a box."""
        axes = quaternions.to_matrix(self.rotation)
        return box_arrays.points_in_boxes(points, self.center, self.size / 2, axes)

    def _footprints(self) -> FloatArray:
        """Return x, y, length, width and yaw of each box, shape (N, 5)."""
        position = self.center[:, :2]
        extent = self.size[:, :2]
        return np.column_stack([position, extent, self.yaw])

    def _heights(self) -> tuple[FloatArray, FloatArray]:
        """Return the lowest and highest z of the boxes, (N,) each, as if they were upright."""
        z = self.center[:, 2]
        half_height = self.size[:, 2] / 2
        return z - half_height, z + half_height

    def _check_ground(self, other: Boxes) -> None:
        """Raise GeometryError unless `other` is in the same frame and z points up in it."""
        checked_boxes("other", other)
        if other.frame != self.frame:
            raise GeometryError(
                f"boxes of frame {self.frame!r} cannot be compared with those of {other.frame!r}; "
                "transform them first"
            )
        if self.frame in CAMERAS:
            raise GeometryError(
                f"boxes of {self.frame} have no ground plane, as z points forward in this frame; "
                "transform the boxes to ego or lidar"
            )


def trusted_boxes(
    frame: str,
    columns: dict[str, AnyArray],
    sample: str | None = None,
    scenario: str | None = None,
    own_actor_id: int = UNTRACKED_ID,
) -> Boxes:
    """Return boxes from columns that are known to be correct, without checking them.

    Args:
        frame: Coordinate frame.
        columns: All columns of `Boxes`; arrays must be new or read-only, and are made read-only.
        sample: Token of the sample whose label contains all boxes, or None.
        scenario: Token of the scenario that all boxes come from, or None.
        own_actor_id: CARLA id of the agent whose own row has the id −100, or −1.
    """
    boxes = object.__new__(Boxes)
    set_field = object.__setattr__
    set_field(boxes, "frame", frame)
    set_field(boxes, "sample", sample)
    set_field(boxes, "scenario", scenario)
    set_field(boxes, "own_actor_id", own_actor_id)
    for name, array in columns.items():
        array.setflags(write=False)
        set_field(boxes, name, array)
    return boxes


def concatenate(parts: list[Boxes], frame: str) -> Boxes:
    """Return all boxes of `parts`, in order.

    Raises:
        GeometryError: If a part is not in `frame`.
    """
    for part in parts:
        if part.frame != frame:
            raise GeometryError(
                f"boxes of frame {part.frame!r} cannot join those of {frame!r}; transform them "
                "first"
            )
    columns = {}
    for name in BOX_COLUMNS:
        columns[name] = np.concatenate([getattr(part, name) for part in parts])
    own_parts = [part for part in parts if (part.actor_id == OWN_ACTOR_ID).any()]
    return trusted_boxes(
        frame,
        columns,
        _common_value((part.sample for part in parts), None),
        _common_value((part.scenario for part in parts), None),
        _common_value((part.own_actor_id for part in own_parts), UNTRACKED_ID),
    )


def _common_value(values: Iterable[_Value], fallback: _Value) -> _Value:
    """Return the value that all `values` equal, or the fallback if they differ or there is none."""
    distinct = set(values)
    if len(distinct) == 1:
        return distinct.pop()
    return fallback


def _over_union(common: FloatArray, sizes: FloatArray, other_sizes: FloatArray) -> FloatArray:
    """Return the IoU, shape (N, M), from common areas or volumes; 0 where both sizes are 0.

    Args:
        common: (N, M) common areas or volumes.
        sizes: (N, axes) sizes of the first boxes.
        other_sizes: (M, axes) sizes of the second boxes.
    """
    products = sizes.prod(axis=1)[:, None]
    union = products + other_sizes.prod(axis=1) - common
    zeros = np.zeros_like(common)
    shares = np.divide(common, union, out=zeros, where=union > 0)
    return as_floats(shares.clip(0, 1))


def checked_boxes(name: str, boxes: object) -> Boxes:
    """Return `boxes` if they are `Boxes`; otherwise raise a GeometryError that names `name`."""
    if not isinstance(boxes, Boxes):
        raise GeometryError(
            f"{name}: expected Boxes, found {type(boxes).__name__}; da.boxes(sample, frame=…) "
            "gives the boxes of a sample, and Boxes.from_arrays makes boxes from arrays"
        )
    return boxes


@without_names(BOX)
class Box:
    """One oriented box in a right-handed coordinate frame: a view of one row of `Boxes`.

    Two differences from the nuScenes devkit's box: `translate` and `rotate` return a new box and
    leave this one as it is, and `size` is length, width, height (`wlh` has the nuScenes order).
    """

    __slots__ = ("_boxes", "instance_token", "token")

    def __init__(
        self,
        boxes: Boxes,
        token: str | None = None,
        instance_token: str | None = None,
        **unknown: NoReturn,
    ) -> None:
        """Wrap the only row of `boxes`; raise GeometryError unless there is exactly one."""
        if unknown or not isinstance(boxes, Boxes):
            raise GeometryError(
                f"a Box is one row of Boxes, found {type(boxes).__name__}; {BOX_MADE}"
            )
        if len(boxes) != 1:
            raise GeometryError(
                f"a Box is one row of Boxes, found {len(boxes)}; pick one with boxes[i]"
            )
        self._boxes = boxes
        self.token = token
        self.instance_token = instance_token

    @classmethod
    def from_wlh(
        cls,
        center: ArrayLike,
        wlh: ArrayLike,
        orientation: Quaternion | ArrayLike,
        *,
        frame: str,
        category: str = "car",
        velocity: ArrayLike = (np.nan, np.nan, np.nan),
    ) -> Box:
        """Make one box from numbers, like nuScenes' `Box(center, wlh, orientation)`.

        Args:
            center: (3,) centre, metres.
            wlh: (3,) full width, length, height, metres: the nuScenes order (`Boxes` start with the
                length).
            orientation: The box's axes in `frame`, as a unit quaternion (a pyquaternion object, or
                four numbers w, x, y, z).
            frame: Frame of all values: `world`, `ego`, `lidar` or a camera channel.
            category: Name of the category.
            velocity: (3,) velocity over the ground, m/s, NaN where unknown.

        Raises:
            GeometryError: If a shape is wrong, or a number, the frame or the category is invalid.
        """
        width, length, height = checked("wlh", wlh, (3,))
        boxes = Boxes.from_arrays(
            checked("center", center, (3,))[None],
            [[length, width, height]],
            [0.0],
            frame=frame,
            category=[category],
            velocity=checked("velocity", velocity, (3,))[None],
        )
        wxyz = checked("orientation", getattr(orientation, "elements", orientation), (4,))
        return cls(replace(boxes, rotation=wxyz[None]))

    @property
    def frame(self) -> str:
        """Coordinate frame of centre, orientation and velocity."""
        return self._boxes.frame

    @property
    def center(self) -> FloatArray:
        """(3,) centre, metres, read-only."""
        return as_floats(self._boxes.center[0])

    @property
    def size(self) -> FloatArray:
        """(3,) full length, width, height, metres, read-only."""
        return as_floats(self._boxes.size[0])

    @property
    def wlh(self) -> FloatArray:
        """(3,) width, length, height, metres: the nuScenes order."""
        size = self._boxes.size[0]
        return as_floats(size[[1, 0, 2]])

    @property
    def orientation(self) -> Quaternion:
        """Axes of the box in `frame`, as a pyquaternion unit quaternion."""
        from pyquaternion import Quaternion

        return Quaternion(self._boxes.rotation[0].copy())

    @property
    def rotation_matrix(self) -> FloatArray:
        """Axes of the box in `frame`, (3, 3)."""
        quaternion = self._boxes.rotation[0]
        return quaternions.to_matrix(quaternion)

    @property
    def yaw(self) -> float:
        """Heading about z of `frame`, radians in (−π, π]."""
        return float(self._boxes.yaw[0])

    @property
    def velocity(self) -> FloatArray:
        """(3,) velocity over the ground, m/s, NaN if unknown, read-only."""
        return as_floats(self._boxes.velocity[0])

    @property
    def category(self) -> str:
        """Name of the category."""
        code = int(self._boxes.category[0])
        return CATEGORIES[code]

    @property
    def actor_id(self) -> int:
        """Id in the label: −100 is the recording agent, −1 an untracked actor."""
        return int(self._boxes.actor_id[0])

    @property
    def num_lidar_pts(self) -> int:
        """Number of points of the recording agent's LiDAR in the box."""
        return int(self._boxes.num_lidar_pts[0])

    @property
    def camera_visible(self) -> bool:
        """Whether any camera of the recording agent sees the box."""
        return bool(self._boxes.camera_visible[0])

    @with_keywords_named
    def corners(self) -> FloatArray:
        """Return the eight corners (3, 8), metres, in the nuScenes devkit's order.

        The four in front come first, then the four behind.
        """
        corners = self._boxes.corners()[0]
        return as_floats(corners.T)

    def bottom_corners(self) -> FloatArray:
        """Return the corners of the lower face (3, 4), metres.

        The order is front right, front left, rear left, rear right.
        """
        corners = self._boxes.bottom_corners()[0]
        return as_floats(corners.T)

    @with_keywords_named
    def translate(self, translation: ArrayLike) -> Box:
        """Return a new box moved by (3,) metres in its frame."""
        moved = SE3.from_rotation(np.eye(3), checked("translation", translation, (3,)))
        return self.transform(moved, self.frame)

    def rotate(self, quaternion: Quaternion) -> Box:
        """Return a new box, rotated about its frame's origin (centre, orientation and velocity)."""
        rotation = SE3.from_quaternion(quaternion)
        return self.transform(rotation, self.frame)

    def transform(self, target_from_source: SE3, frame: str) -> Box:
        """Transform the box to `frame`; raise GeometryError if an argument is invalid."""
        boxes = self._boxes.transform(target_from_source, frame)
        return Box(boxes, self.token, self.instance_token)

    def __repr__(self) -> str:
        """Return category, id, frame and pose on one line."""
        x, y, z = self.center.tolist()
        length, width, height = self.size.tolist()
        return (
            f"Box({self.category} {self.actor_id}, {self.frame} [{x:.2f}, {y:.2f}, {z:.2f}], "
            f"size [{length:.2f}, {width:.2f}, {height:.2f}], yaw {self.yaw:.3f}, "
            f"points {self.num_lidar_pts})"
        )
