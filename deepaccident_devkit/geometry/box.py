"""`Box`: one oriented box, immutable, with the names of the nuScenes devkit."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.arrays import FloatArray, as_floats, checked
from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.geometry import quaternions
from deepaccident_devkit.geometry.boxes import Boxes, checked_boxes
from deepaccident_devkit.geometry.se3 import SE3
from deepaccident_devkit.nuscenes_names import BOX, without_names
from deepaccident_devkit.taxonomy import CATEGORIES

if TYPE_CHECKING:
    from pyquaternion import Quaternion


@without_names(BOX)
class Box:
    """One oriented box in a right-handed coordinate frame: a view of one row of `Boxes`.

    Two differences from the nuScenes devkit's box: `translate` and `rotate` return a new box and change nothing in
    place, and `size` is length, width, height (`wlh` gives the nuScenes order).
    """

    __slots__ = ("_boxes", "instance_token", "token")

    def __init__(self, boxes: Boxes, token: str | None = None, instance_token: str | None = None) -> None:
        """Wrap the only row of `boxes`; raises GeometryError if there are none or several."""
        if len(checked_boxes("boxes", boxes)) != 1:
            raise GeometryError(f"a Box is one row of Boxes, found {len(boxes)}; pick one with Boxes.select([i])")
        self._boxes = boxes
        self.token = token
        self.instance_token = instance_token

    @property
    def frame(self) -> str:
        """The coordinate frame of centre, orientation and velocity."""
        return self._boxes.frame

    @property
    def center(self) -> FloatArray:
        """(3,) metres, read-only."""
        return as_floats(self._boxes.center[0])

    @property
    def size(self) -> FloatArray:
        """(3,) full length, width, height, metres, read-only."""
        return as_floats(self._boxes.size[0])

    @property
    def wlh(self) -> FloatArray:
        """(3,) width, length, height, metres: the nuScenes order."""
        return as_floats(self._boxes.size[0][[1, 0, 2]])

    @property
    def orientation(self) -> Quaternion:
        """The box's axes in `frame`, as a pyquaternion unit quaternion."""
        from pyquaternion import Quaternion

        return Quaternion(self._boxes.rotation[0].copy())

    @property
    def rotation_matrix(self) -> FloatArray:
        """The box's axes in `frame` (3, 3)."""
        return quaternions.to_matrix(self._boxes.rotation[0])

    @property
    def yaw(self) -> float:
        """Heading about z of `frame`, radians in (−π, π]."""
        return float(self._boxes.yaw[0])

    @property
    def velocity(self) -> FloatArray:
        """(3,) m/s over the ground, NaN if unknown, read-only."""
        return as_floats(self._boxes.velocity[0])

    @property
    def category(self) -> str:
        """The category's name."""
        return CATEGORIES[int(self._boxes.category[0])]

    @property
    def actor_id(self) -> int:
        """The label's id: −100 is the recording agent, −1 an untracked actor."""
        return int(self._boxes.actor_id[0])

    @property
    def num_lidar_pts(self) -> int:
        """Points of the recording agent's LiDAR in the box."""
        return int(self._boxes.num_lidar_pts[0])

    @property
    def camera_visible(self) -> bool:
        """Whether any camera of the recording agent sees it."""
        return bool(self._boxes.camera_visible[0])

    def corners(self) -> FloatArray:
        """The eight corners (3, 8) metres: four in front, then four behind (nuScenes order)."""
        return as_floats(self._boxes.corners()[0].T)

    def bottom_corners(self) -> FloatArray:
        """The lower face's corners (3, 4): front right, front left, rear left, rear right."""
        return as_floats(self._boxes.bottom_corners()[0].T)

    def translate(self, translation: ArrayLike) -> Box:
        """A new box moved by (3,) metres in its frame."""
        moved = SE3.from_rotation(np.eye(3), checked("translation", translation, (3,)))
        return self.transform(moved, self.frame)

    def rotate(self, quaternion: Quaternion) -> Box:
        """A new box turned about its frame's origin: centre, orientation and velocity."""
        return self.transform(SE3.from_quaternion(quaternion), self.frame)

    def transform(self, target_from_source: SE3, frame: str) -> Box:
        """The same box in another frame. Raises GeometryError."""
        return Box(self._boxes.transform(target_from_source, frame), self.token, self.instance_token)

    def __repr__(self) -> str:
        """Category, id, frame and pose on one line."""
        x, y, z = self.center.tolist()
        length, width, height = self.size.tolist()
        return (
            f"Box({self.category} {self.actor_id}, {self.frame} [{x:.2f}, {y:.2f}, {z:.2f}], "
            f"size [{length:.2f}, {width:.2f}, {height:.2f}], yaw {self.yaw:.3f}, points {self.num_lidar_pts})"
        )
