"""The eight symmetries of a square grid: how predictions may lie that were mirrored, turned or transposed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from deepaccident_devkit.arrays import AnyArray, FloatArray
from deepaccident_devkit.geometry.bev_grid import ORIENTATIONS, Orientation, turned


@dataclass(frozen=True, slots=True)
class Symmetry:
    """A point x forward, y left of the truth is found at x_sign · x, y_sign · y, or with x and y swapped before that.

    Attributes:
        name: `mirrored x`, `turned by 90°`, …
        says: what one sees then.
        swapped: whether x and y change places.
        x_sign: 1 or −1.
        y_sign: 1 or −1.
    """

    name: str
    says: str
    swapped: bool
    x_sign: int
    y_sign: int

    @property
    def matrix(self) -> FloatArray:
        """(2, 2) from true to found, of columns x, y."""
        x, y = float(self.x_sign), float(self.y_sign)
        return np.array([[0.0, x], [y, 0.0]] if self.swapped else [[x, 0.0], [0.0, y]])

    def apply(self, points: FloatArray) -> FloatArray:
        """Points (…, 2) where they are found."""
        result: FloatArray = points @ self.matrix.T
        return result

    def undo(self, points: FloatArray) -> FloatArray:
        """Points (…, 2) as found, where they should be."""
        result: FloatArray = points @ self.matrix
        return result

    def undo_raster(self, raster: AnyArray) -> AnyArray:
        """A raster (…, rows, columns) in the devkit's orientation as found, with each cell where it should be."""
        flipped = raster[..., :: self.y_sign, :: self.x_sign]
        return flipped.swapaxes(-1, -2) if self.swapped else flipped


IDENTITY: Final = Symmetry("as given", "", swapped=False, x_sign=1, y_sign=1)
SYMMETRIES: Final = (
    Symmetry("mirrored x", "what is ahead is behind", swapped=False, x_sign=-1, y_sign=1),
    Symmetry("mirrored y", "what is on the left is on the right", swapped=False, x_sign=1, y_sign=-1),
    Symmetry("transposed", "x and y have changed places", swapped=True, x_sign=1, y_sign=1),
    Symmetry("anti-transposed", "x and y have changed places, both negated", swapped=True, x_sign=-1, y_sign=-1),
    Symmetry("turned by 90°", "what is ahead is on the left", swapped=True, x_sign=-1, y_sign=1),
    Symmetry("turned by 180°", "what is ahead on the left is behind on the right", swapped=False, x_sign=-1, y_sign=-1),
    Symmetry("turned by 270°", "what is ahead is on the right", swapped=True, x_sign=1, y_sign=-1),
)
"""All but the one that changes nothing; turns are counter-clockwise, seen from above."""
_PATTERN: Final = np.arange(4).reshape(2, 2)
"""The smallest raster that no symmetry leaves as it is."""


def orientation_mistaken(symmetry: Symmetry, stated: Orientation) -> Orientation | None:
    """The orientation that maps must be in to look like this where another one is stated; None if there is none."""
    found = turned(_PATTERN, stated)
    for other in ORIENTATIONS:
        if other != stated and np.array_equal(symmetry.undo_raster(found), turned(_PATTERN, other)):
            return other
    return None
