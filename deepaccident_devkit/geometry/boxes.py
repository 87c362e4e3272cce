"""`Boxes`: the oriented boxes of a sample as a struct of arrays; `Box` is the one-row view of it."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.arrays import AnyArray, BoolArray, FloatArray, IntArray, checked, readonly
from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.geometry import quaternions
from deepaccident_devkit.geometry.se3 import SE3
from deepaccident_devkit.taxonomy import CATEGORIES

CORNER_SIGNS = np.array(
    [[1, 1, 1], [1, -1, 1], [1, -1, -1], [1, 1, -1], [-1, 1, 1], [-1, -1, 1], [-1, -1, -1], [-1, 1, -1]],
    dtype=np.float64,
)
"""Signs of (length, width, height) of the eight corners: four in front, then four behind, each from upper left
clockwise seen from the front's inside (the nuScenes devkit's order, with y left)."""
BOTTOM_CORNERS = (2, 3, 7, 6)

_COLUMNS: dict[str, tuple[tuple[int | None, ...], type]] = {
    "center": ((None, 3), np.float64),
    "size": ((None, 3), np.float64),
    "rotation": ((None, 4), np.float64),
    "velocity": ((None, 3), np.float64),
    "category": ((None,), np.int8),
    "actor_id": ((None,), np.int64),
    "num_lidar_pts": ((None,), np.int64),
    "camera_visible": ((None,), np.bool_),
    "row": ((None,), np.int64),
}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Boxes:
    """N oriented boxes in one right-handed frame; immutable, arrays are read-only.

    Attributes:
        frame: the frame of all of it: `world`, `ego`, `lidar` or a camera channel (then optical axes).
        center: (N, 3) float64, metres.
        size: (N, 3) float64, full length, width, height, metres.
        rotation: (N, 4) float64, unit quaternions w, x, y, z: the box's axes (x along its length) in `frame`.
        velocity: (N, 3) float64, m/s over the ground (not relative to the agent), NaN where unknown.
        category: (N,) int8, index into `taxonomy.CATEGORIES`.
        actor_id: (N,) int64, the label's id; −100 is the recording agent, −1 untracked.
        num_lidar_pts: (N,) int64, LiDAR points of the recording agent in the box.
        camera_visible: (N,) bool, seen by any of the recording agent's cameras.
        row: (N,) int64, row of each box among those of its label file, counted from 0.
    """

    frame: str
    center: FloatArray
    size: FloatArray
    rotation: FloatArray
    velocity: FloatArray
    category: AnyArray
    actor_id: IntArray
    num_lidar_pts: IntArray
    camera_visible: BoolArray
    row: IntArray

    def __post_init__(self) -> None:
        """Check the columns' shapes; raises GeometryError."""
        count = len(np.atleast_1d(np.asarray(self.center)))
        for name, (shape, dtype) in _COLUMNS.items():
            array = checked(f"Boxes.{name}", getattr(self, name), (count, *shape[1:]), dtype)
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
        """Boxes that stand upright in `frame`: centers (N, 3), sizes (N, 3), yaw (N,) radians.

        `category` holds indices or names; the other columns default to what is not known (velocity NaN, id −1,
        no points, not visible).
        """
        heading = checked("Boxes.yaw", yaw, (None,))
        count = len(heading)
        given = {
            "velocity": np.full((count, 3), np.nan),
            "actor_id": np.full(count, -1),
            "num_lidar_pts": np.zeros(count),
            "camera_visible": np.zeros(count, dtype=bool),
            "row": np.arange(count),
            **columns,
        }
        unknown = set(given) - set(_COLUMNS)
        if unknown:
            raise GeometryError(f"Boxes has no column {sorted(unknown)}; it has {list(_COLUMNS)}")
        return cls(
            frame=frame,
            center=center,  # type: ignore[arg-type]  # checked in __post_init__
            size=size,  # type: ignore[arg-type]
            rotation=quaternions.from_yaw(heading),
            category=_category_codes(category, count),
            **given,  # type: ignore[arg-type]
        )

    def __len__(self) -> int:
        """Number of boxes."""
        return len(self.center)

    @property
    def yaw(self) -> FloatArray:
        """Heading of each box's length axis about z of `frame`, (N,) radians in (−π, π]."""
        return quaternions.yaw_of(self.rotation)

    @property
    def category_names(self) -> list[str]:
        """The category of each box by name."""
        return [CATEGORIES[code] for code in self.category.tolist()]

    def select(self, which: ArrayLike) -> Boxes:
        """The boxes that a mask (N,) or an integer array of rows picks.

        Raises:
            GeometryError: `which` is neither, or names a row that is not there.
        """
        picked = np.asarray(which)
        if picked.ndim != 1:
            raise GeometryError(f"expected a mask ({len(self)},) or an array of rows, found {which!r}")
        try:
            columns = {name: getattr(self, name)[picked if picked.size else []] for name in _COLUMNS}
        except IndexError as error:
            raise GeometryError(f"{which!r} does not pick from {len(self)} boxes: {error}") from error
        return trusted_boxes(self.frame, columns)

    def transform(self, target_from_source: SE3, frame: str) -> Boxes:
        """The same boxes in another frame: centers, rotations and velocities move, sizes stay."""
        turn = target_from_source.rotation
        turn_transposed = turn.T
        return trusted_boxes(
            frame,
            {
                "center": self.center @ turn_transposed + target_from_source.translation,
                "size": self.size,
                "rotation": self.rotation @ quaternions.single_left_multiplier(turn).T,
                "velocity": self.velocity @ turn_transposed,
                "category": self.category,
                "actor_id": self.actor_id,
                "num_lidar_pts": self.num_lidar_pts,
                "camera_visible": self.camera_visible,
                "row": self.row,
            },
        )

    def corners(self) -> FloatArray:
        """The eight corners of each box, (N, 8, 3) metres, in the order of `CORNER_SIGNS`."""
        offsets = self.size[:, None, :] / 2 * CORNER_SIGNS
        result: FloatArray = offsets @ np.swapaxes(quaternions.to_matrix(self.rotation), 1, 2)
        return result + self.center[:, None, :]

    def bottom_corners(self) -> FloatArray:
        """The four corners of each box's lower face, (N, 4, 3): front right, front left, rear left, rear right."""
        return self.corners()[:, BOTTOM_CORNERS]

    def contains(self, points: ArrayLike) -> BoolArray:
        """Which points (P, 3) of the same frame lie in which box, faces included: (N, P) bool."""
        given = checked("points", points, (None, 3))
        inside = np.empty((len(self), len(given)), dtype=bool)
        axes = quaternions.to_matrix(self.rotation)
        for index, (center, half) in enumerate(zip(self.center, self.size / 2, strict=True)):
            near = np.flatnonzero((np.abs(given - center) <= np.linalg.norm(half)).all(axis=1))
            inside[index] = False
            inside[index, near] = (np.abs((given[near] - center) @ axes[index]) <= half).all(axis=1)
        return inside


def trusted_boxes(frame: str, columns: dict[str, AnyArray]) -> Boxes:
    """Boxes over columns that are right by construction: the hot path, which checks nothing.

    `columns` holds every column of `Boxes`; the arrays must be fresh or read-only, and become read-only.
    """
    result = object.__new__(Boxes)
    put = object.__setattr__
    put(result, "frame", frame)
    for name, array in columns.items():
        array.setflags(write=False)
        put(result, name, array)
    return result


def concatenate(parts: list[Boxes], frame: str) -> Boxes:
    """All boxes of `parts`, in order; every part must be in `frame`."""
    for part in parts:
        if part.frame != frame:
            raise GeometryError(f"boxes of frame {part.frame!r} cannot join those of {frame!r}; transform them first")
    names = [field.name for field in fields(Boxes) if field.name != "frame"]
    return trusted_boxes(frame, {name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


def _category_codes(category: ArrayLike | None, count: int) -> AnyArray:
    if category is None:
        return np.zeros(count, dtype=np.int8)
    given = np.asarray(category)
    if given.dtype.kind not in "US":
        if not np.isin(given, range(len(CATEGORIES))).all():
            raise GeometryError(
                f"category codes are 0 to {len(CATEGORIES) - 1} ({', '.join(CATEGORIES)}), found {given}"
            )
        return given.astype(np.int8)
    names = [str(name) for name in given]
    unknown = sorted(set(names) - set(CATEGORIES))
    if unknown:
        raise GeometryError(f"unknown category {unknown}; known are {', '.join(CATEGORIES)}")
    return np.array([CATEGORIES.index(name) for name in names], dtype=np.int8)
