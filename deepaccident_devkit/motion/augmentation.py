"""A rotation, scale and flip of the bird's-eye view, applied to boxes, labels and poses alike.

See docs/released_code.md, Motion labels.
"""

import math
from dataclasses import dataclass

import numpy as np

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.support.arrays import FloatArray, checked_flag, checked_setting


@dataclass(frozen=True, slots=True, kw_only=True)
class Augmentation:
    """A training augmentation of the ground plane: rotation, then scale, then flip; right-handed.

    Attributes:
        rotation: Angle about z, radians, counter-clockwise.
        scale: Factor by which all lengths are multiplied.
        flip: Whether to swap left and right by negating y.
    """

    rotation: float = 0.0
    scale: float = 1.0
    flip: bool = False

    def __post_init__(self) -> None:
        """Raise ConfigError unless the values are in range."""
        rotation = checked_setting("augmentation: rotation", self.rotation, "finite radians")
        scale = checked_setting(
            "augmentation: scale", self.scale, "a factor above 0 (1 does not scale)"
        )
        if scale <= 0:
            raise ConfigError(
                "augmentation: scale: expected a factor above 0 (1 does not scale), "
                f"found {self.scale!r}"
            )
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "scale", scale)
        object.__setattr__(self, "flip", checked_flag("augmentation: flip", self.flip))

    @property
    def matrix(self) -> FloatArray:
        """A = flip · scale · rotation, a matrix from the ego frame to the augmented frame, (4, 4).

        Right-handed, metres.
        """
        cosine = math.cos(self.rotation)
        sine = math.sin(self.rotation)
        turn = np.eye(4)
        turn[:2, :2] = [[cosine, -sine], [sine, cosine]]
        y_sign = -1.0 if self.flip else 1.0
        mirror = np.diag([1.0, y_sign, 1.0, 1.0])
        stretch = np.diag([self.scale, self.scale, self.scale, 1.0])
        return np.asarray(mirror @ stretch @ turn)
