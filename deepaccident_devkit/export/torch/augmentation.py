"""The bird's-eye-view transform A (rotation, scale, flip) on boxes, points and poses, and random ones for training.

All agents' ego frames are transformed in the same way: a point p becomes A p, a pose W between two ego frames becomes
A W A⁻¹, and transforms from an ego frame to a sensor undo A first, so that points fall on the same pixels as before.
Images do not change.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.arrays import AnyArray, FloatArray, as_floats, checked, checked_number
from deepaccident_devkit.errors import ConfigError, GeometryError
from deepaccident_devkit.geometry import Boxes, LidarPointCloud, six_vectors
from deepaccident_devkit.motion import Augmentation


@dataclass(frozen=True, slots=True, kw_only=True)
class RandomAugmentation:
    """Draws an `Augmentation` from a generator; the defaults are BEVerse's ranges.

    Attributes:
        rotation: the largest angle in either direction, radians; uniform.
        scale: the smallest and the largest factor; uniform.
        flip: the probability of mirroring left and right.
    """

    rotation: float = math.radians(22.5)
    scale: tuple[float, float] = (0.95, 1.05)
    flip: float = 0.5

    def __post_init__(self) -> None:
        """Check the ranges; raises ConfigError."""
        name = "random augmentation: "
        rotation = checked_number(f"{name}rotation", self.rotation, "radians", ConfigError)
        if not 0 <= rotation < math.inf:
            raise ConfigError(f"{name}rotation is {self.rotation}; choose finite radians from 0")
        try:
            scale = tuple(checked("scale", self.scale, (2,)).tolist())
        except GeometryError:
            scale = (math.nan, math.nan)
        if not 0 < scale[0] <= scale[1] < math.inf:
            raise ConfigError(f"{name}scale is {self.scale!r}; choose (smallest, largest) above 0")
        flip = checked_number(f"{name}flip", self.flip, "a probability", ConfigError)
        if not 0 <= flip <= 1:
            raise ConfigError(f"{name}flip is {self.flip}; choose a probability from 0 to 1")
        for field, value in (("rotation", rotation), ("scale", scale), ("flip", flip)):
            object.__setattr__(self, field, value)

    def __call__(self, generator: np.random.Generator) -> Augmentation:
        """One draw."""
        return Augmentation(
            rotation=float(generator.uniform(-self.rotation, self.rotation)),
            scale=float(generator.uniform(*self.scale)),
            flip=bool(generator.random() < self.flip),
        )


def augmented_boxes(boxes: Boxes, augmentation: Augmentation) -> FloatArray:
    """Boxes of an ego frame in the augmented one, (M, 9): x y z l w h yaw vx vy.

    Right-handed, z of the centre; metres, radians in (−π, π], m/s; NaN velocities stay NaN. As in the released code
    sizes and velocities scale too. The released flip turns yaw into π − yaw, which swaps front and rear; here the
    heading of a mirrored box is mirrored like its velocity.
    """
    turn = augmentation.matrix[:2, :2]
    heading = np.column_stack([np.cos(boxes.yaw), np.sin(boxes.yaw)]) @ turn.T
    return np.column_stack(
        [
            transformed(augmentation.matrix, boxes.center),
            boxes.size * augmentation.scale,
            np.arctan2(heading[:, 1], heading[:, 0]),
            boxes.velocity[:, :2] @ turn.T,
        ]
    )


def augmented_points(cloud: LidarPointCloud, augmentation: Augmentation) -> AnyArray:
    """A cloud of an ego frame in the augmented one, (N, 4) float32: x y z in metres, and the unchanged intensity."""
    return np.column_stack([transformed(augmentation.matrix, cloud.xyz), cloud.intensity]).astype(np.float32)


def augmented_pose(pose: ArrayLike, augmentation: Augmentation) -> FloatArray:
    """Poses (…, 4, 4) between two ego frames as poses between the two augmented ones: A W A⁻¹."""
    matrix = augmentation.matrix
    return as_floats(matrix @ as_floats(pose) @ np.linalg.inv(matrix))


def augmented_six_vectors(six: ArrayLike, augmentation: Augmentation) -> FloatArray:
    """The same for 6-vectors (…, 6): translations are scaled; rotations stay rotations, even with a flip."""
    return six_vectors.from_matrices(augmented_pose(six_vectors.to_matrices(six), augmentation))


def transformed(matrix: FloatArray, points: FloatArray) -> FloatArray:
    """Points (N, 3) moved by an affine matrix (4, 4)."""
    return as_floats(points @ matrix[:3, :3].T + matrix[:3, 3])
