"""Pinhole cameras with the usual optical axes: x right, y down, z forward."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Final, get_args

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.errors import ChoiceError, GeometryError
from deepaccident_devkit.geometry.boxes import Boxes, checked_boxes
from deepaccident_devkit.support.arrays import (
    AnyArray,
    BoolArray,
    FloatArray,
    FrozenArrays,
    checked,
    checked_number,
    checked_whole,
    readonly,
)
from deepaccident_devkit.taxonomy import BEV_CAMERA, LIDAR, Frame

VISIBLE_DEPTH = 1.0
"""A corner in the image counts as seen from this distance on, metres (as in the nuScenes
devkit)."""
IN_FRONT_DEPTH = 0.1
"""All corners of a visible box must be deeper than this, metres (as in the nuScenes devkit)."""
# The known frames whose axes are not optical.
_NO_PINHOLE: Final = (*get_args(Frame), LIDAR, BEV_CAMERA)


class BoxVisibility(IntEnum):
    """How much of a box an image shows, with the nuScenes devkit's names and numbers.

    A lower number is stricter: a box that meets `ALL` meets `ANY` too, and every box meets `NONE`.
    So `camera.box_visibility(boxes) <= BoxVisibility.ANY` are the boxes that the nuScenes devkit
    lists by default.
    """

    ALL = 0
    """All corners are in the image and in front of the camera."""
    ANY = 1
    """A corner is in the image, and all are in front of the camera."""
    NONE = 2
    """No condition."""


@dataclass(frozen=True, slots=True, eq=False)
class PinholeCamera(FrozenArrays):
    """A camera without distortion.

    Attributes:
        intrinsic: (3, 3) float64, K = [[f, 0, cx], [0, f, cy], [0, 0, 1]], pixels.
        width: Width of the image, pixels.
        height: Height of the image, pixels.
    """

    intrinsic: FloatArray
    width: int
    height: int

    def __post_init__(self) -> None:
        """Check the values; raises GeometryError."""
        intrinsic = checked("PinholeCamera.intrinsic", self.intrinsic, (3, 3)).copy()
        if not np.isfinite(intrinsic).all():
            raise GeometryError(
                f"PinholeCamera.intrinsic: expected finite numbers, found {intrinsic.tolist()}"
            )
        object.__setattr__(self, "intrinsic", readonly(intrinsic))
        for name in ("width", "height"):
            object.__setattr__(self, name, _pixels(f"PinholeCamera.{name}", getattr(self, name)))

    @classmethod
    def from_field_of_view(cls, width: int, height: int, horizontal: float) -> PinholeCamera:
        """Return a camera with its optical axis in the middle of the image.

        Args:
            width: Width of the image, pixels.
            height: Height of the image, pixels.
            horizontal: Horizontal field of view, radians.

        Raises:
            GeometryError: the image has no pixels, or the field of view is not between 0 and π.
        """
        width = _pixels("width", width)
        height = _pixels("height", height)
        angle = checked_number("horizontal", horizontal, "a field of view in radians")
        if not 0 < angle < np.pi:
            raise GeometryError(
                f"horizontal: expected a field of view between 0 and π radians, found {horizontal}"
            )
        focal = width / 2 / np.tan(angle / 2)
        return cls(
            np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]), width, height
        )

    def resized(self, width: int, height: int) -> PinholeCamera:
        """Return the camera of the same picture at another size, pixels; raises GeometryError."""
        scale = np.diag([width / self.width, height / self.height, 1.0])
        return PinholeCamera(scale @ self.intrinsic, width, height)

    def project(self, points: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return pixels (N, 2) as (u, v), and depths (N,) in metres, of points (N, 3).

        Pixels of points that are not in front of the camera (depth ≤ 0) or are infinite are NaN.

        Args:
            points: (N, 3) metres in the optical frame.
        """
        xyz = checked("points", points, (None, 3))
        depth: FloatArray = xyz[:, 2]
        positive_depth = np.where(depth > 0, depth, np.nan)
        with np.errstate(invalid="ignore"):
            pixels: FloatArray = (xyz / positive_depth[:, None]) @ self.intrinsic[:2].T
        return pixels, depth

    def in_image(
        self,
        pixels: ArrayLike,
        depth: ArrayLike | None = None,
        *,
        min_depth: float = 0.0,
        margin: float = 0.0,
    ) -> BoolArray:
        """Return which pixels (N, 2) lie in the image, 0 ≤ u < width and 0 ≤ v < height.

        NaN does not.

        Args:
            pixels: (N, 2) as (u, v).
            depth: (N,) metres along the optical axis; without it only the pixels count.
            min_depth: Points that are not deeper than this do not count, metres.
            margin: Width of a strip along the edges that does not count, pixels; a negative one
                makes the image larger.
        """
        uv = checked("pixels", pixels, (None, 2))
        u = uv[:, 0]
        v = uv[:, 1]
        is_inside: BoolArray = (u >= margin) & (u < self.width - margin)
        is_inside &= (v >= margin) & (v < self.height - margin)
        if depth is not None:
            is_inside &= checked("depth", depth, (len(uv),)) > min_depth
        return is_inside

    def box_visibility(self, boxes: Boxes) -> AnyArray:
        """Return the strictest `BoxVisibility` that each of N boxes meets, shape (N,), int8.

        As in the nuScenes devkit, a corner is seen if it is in the image and deeper than 1 m, and a
        box with a corner that is not deeper than 0.1 m is `NONE`. (There pixels with u = 0 or v = 0
        are outside of the image; here they are inside.)

        Args:
            boxes: Boxes in this camera's optical frame.

        Raises:
            GeometryError: they are not boxes, or are in the frame of world, ego, LiDAR or the BEV
                camera.
        """
        if checked_boxes("boxes", boxes).frame in _NO_PINHOLE:
            raise GeometryError(
                f"expected boxes in this camera's optical frame, found {boxes.frame!r}; "
                "transform them by camera_from_source first"
            )
        pixels, depth = self.project(boxes.corners().reshape(-1, 3))
        is_seen = self.in_image(pixels, depth, min_depth=VISIBLE_DEPTH).reshape(-1, 8)
        in_front = (depth > IN_FRONT_DEPTH).reshape(-1, 8).all(axis=1)
        conditions = [in_front & is_seen.all(axis=1), in_front & is_seen.any(axis=1)]
        levels = [BoxVisibility.ALL, BoxVisibility.ANY]
        return np.select(conditions, levels, BoxVisibility.NONE).astype(np.int8)

    def boxes_in_image(self, boxes: Boxes, level: BoxVisibility = BoxVisibility.ANY) -> BoolArray:
        """Return which of N boxes of this camera's optical frame meet `level`, shape (N,).

        Raises:
            ChoiceError: there is no such level.
            GeometryError: as in `box_visibility`.
        """
        if level not in list(BoxVisibility):
            names = ", ".join(f"BoxVisibility.{option.name}" for option in BoxVisibility)
            raise ChoiceError(f"level: expected one of {names}, found {level!r}")
        return np.asarray(self.box_visibility(boxes) <= level)


def _pixels(name: str, value: object) -> int:
    """Return a number of pixels from 1 as an int; raises GeometryError."""
    number = checked_whole(name, value, "a whole number of pixels from 1")
    if number < 1:
        raise GeometryError(f"{name}: expected a whole number of pixels from 1, found {number}")
    return number
