"""Pinhole cameras with the usual optical axes: x right, y down, z forward."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import get_args

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
"""A corner in the image counts as seen if it is deeper than this, metres (nuScenes' value)."""
IN_FRONT_DEPTH = 0.1
"""All corners of a visible box must have a greater depth, metres (the nuScenes devkit's value)."""
# Frames whose axes are not optical.
_NO_PINHOLE = (*get_args(Frame), LIDAR, BEV_CAMERA)


class BoxVisibility(IntEnum):
    """How much of a box is in the image, with the nuScenes devkit's names and numbers.

    A lower number is stricter: a box that meets `ALL` meets `ANY` too, and every box meets `NONE`.
    `camera.box_visibility(boxes) <= BoxVisibility.ANY` is the mask of the boxes that the nuScenes
    devkit lists by default.
    """

    ALL = 0
    """All corners are in the image and in front of the camera."""
    ANY = 1
    """At least one corner is in the image, and all are in front of the camera."""
    NONE = 2
    """No condition."""


@dataclass(frozen=True, slots=True, eq=False)
class PinholeCamera(FrozenArrays):
    """A camera without distortion.

    Attributes:
        intrinsic: (3, 3) float64 matrix K = [[f, 0, cx], [0, f, cy], [0, 0, 1]], pixels.
        width: Width of the image, pixels.
        height: Height of the image, pixels.
    """

    intrinsic: FloatArray
    width: int
    height: int

    def __post_init__(self) -> None:
        """Raise GeometryError if K is not finite and (3, 3), or a size is not an int from 1."""
        intrinsic = checked("PinholeCamera.intrinsic", self.intrinsic, (3, 3)).copy()
        if not np.isfinite(intrinsic).all():
            raise GeometryError(
                f"PinholeCamera.intrinsic: expected finite numbers, found {intrinsic.tolist()}"
            )
        object.__setattr__(self, "intrinsic", readonly(intrinsic))
        for name in ("width", "height"):
            pixels = _pixels(f"PinholeCamera.{name}", getattr(self, name))
            object.__setattr__(self, name, pixels)

    @classmethod
    def from_field_of_view(cls, width: int, height: int, horizontal: float) -> PinholeCamera:
        """Return a camera whose optical axis passes through the middle of the image.

        Args:
            width: Width of the image, pixels.
            height: Height of the image, pixels.
            horizontal: Horizontal field of view, radians.

        Raises:
            GeometryError: If the image has no pixels, or the field of view is not between 0 and π.
        """
        width = _pixels("width", width)
        height = _pixels("height", height)
        angle = checked_number("horizontal", horizontal, "a field of view in radians")
        if not 0 < angle < np.pi:
            raise GeometryError(
                f"horizontal: expected a field of view between 0 and π radians, found {horizontal}"
            )
        middle_x = width / 2
        middle_y = height / 2
        focal_length = middle_x / np.tan(angle / 2)
        intrinsic = np.array([[focal_length, 0, middle_x], [0, focal_length, middle_y], [0, 0, 1]])
        return cls(intrinsic, width, height)

    def resized(self, width: int, height: int) -> PinholeCamera:
        """Return the camera for the resized image; raise GeometryError if a size is below 1."""
        x_scale = width / self.width
        y_scale = height / self.height
        scale = np.diag([x_scale, y_scale, 1.0])
        return PinholeCamera(scale @ self.intrinsic, width, height)

    def project(self, points: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Project points (N, 3) to pixels (N, 2), as (u, v), and depths (N,), metres.

        Points behind the camera (depth ≤ 0) and infinite points have NaN pixels.

        Args:
            points: (N, 3) positions in the optical frame, metres.
        """
        xyz = checked("points", points, (None, 3))
        depth: FloatArray = xyz[:, 2]
        positive_depth = np.where(depth > 0, depth, np.nan)
        with np.errstate(invalid="ignore"):
            directions = xyz / positive_depth[:, None]
            pixels: FloatArray = directions @ self.intrinsic[:2].T
        return pixels, depth

    def in_image(
        self,
        pixels: ArrayLike,
        depth: ArrayLike | None = None,
        *,
        min_depth: float = 0.0,
        margin: float = 0.0,
    ) -> BoolArray:
        """Return whether pixels lie in the image: 0 ≤ u < width and 0 ≤ v < height, shape (N,).

        NaN does not lie in the image.

        Args:
            pixels: (N, 2) pixels as (u, v).
            depth: (N,) metres along the optical axis; None checks only the pixels.
            min_depth: Depth that points must exceed, metres.
            margin: Width of a strip along the edges that counts as outside, pixels; a negative
                margin enlarges the image.
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

        The depths are the nuScenes devkit's: a corner is seen if it is in the image and deeper than
        1 m, and a box with a corner no deeper than 0.1 m is `NONE`. Pixels with u = 0 or v = 0 are
        inside the image, unlike in the nuScenes devkit.

        Args:
            boxes: Boxes in this camera's optical frame.

        Raises:
            GeometryError: If the argument is not `Boxes`, or the frame is world, ego, LiDAR or the
                BEV camera.
        """
        if checked_boxes("boxes", boxes).frame in _NO_PINHOLE:
            raise GeometryError(
                f"expected boxes in this camera's optical frame, found {boxes.frame!r}; "
                "transform them by camera_from_source first"
            )
        pixels, depth = self.project(boxes.corners().reshape(-1, 3))
        is_seen = self.in_image(pixels, depth, min_depth=VISIBLE_DEPTH).reshape(-1, 8)
        is_in_front = (depth > IN_FRONT_DEPTH).reshape(-1, 8).all(axis=1)
        visibility = np.full(len(boxes), BoxVisibility.NONE, dtype=np.int8)
        visibility[is_in_front & is_seen.any(axis=1)] = BoxVisibility.ANY
        visibility[is_in_front & is_seen.all(axis=1)] = BoxVisibility.ALL
        return visibility

    def boxes_in_image(self, boxes: Boxes, level: BoxVisibility = BoxVisibility.ANY) -> BoolArray:
        """Return whether each of N boxes in the optical frame meets `level`, shape (N,).

        Raises:
            ChoiceError: If the level is unknown.
            GeometryError: For the reasons given in `box_visibility`.
        """
        if level not in list(BoxVisibility):
            names = ", ".join(f"BoxVisibility.{option.name}" for option in BoxVisibility)
            raise ChoiceError(f"level: expected one of {names}, found {level!r}")
        return np.asarray(self.box_visibility(boxes) <= level)


def _pixels(name: str, value: object) -> int:
    """Return `value` as an int; raise GeometryError unless it is a whole number from 1."""
    number = checked_whole(name, value, "a whole number of pixels from 1")
    if number < 1:
        raise GeometryError(f"{name}: expected a whole number of pixels from 1, found {number}")
    return number
