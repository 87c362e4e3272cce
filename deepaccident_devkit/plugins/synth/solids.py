"""Six-faced solids: all of the synthetic world except the ground is made of them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from deepaccident_devkit.geometry.boxes import CORNER_SIGNS
from deepaccident_devkit.support.arrays import (
    BoolArray,
    ByteArray,
    FloatArray,
    IntArray,
    checked,
    readonly,
)

Color = tuple[int, int, int]
"""Red, green, blue, 0 to 255."""
FACES = np.array(
    [[0, 1, 2, 3], [4, 7, 6, 5], [0, 3, 7, 4], [1, 5, 6, 2], [0, 4, 5, 1], [3, 2, 6, 7]]
)
"""Corners (in the order of `CORNER_SIGNS`) of the faces front, rear, left, right, top, bottom, in
counter-clockwise order seen from outside the solid."""
FRONT, REAR, LEFT, RIGHT, TOP, BOTTOM = range(6)
FACES_A_SOLID = len(FACES)
GLASS: Color = (52, 66, 80)


@dataclass(frozen=True, slots=True, eq=False)
class Solids:
    """P convex solids of eight corners and six flat faces; arrays are read-only.

    Attributes:
        corners: Corners in the order of `CORNER_SIGNS`, shape (P, 8, 3), float64, metres.
        colors: RGB colours of each face in white light, shape (P, 6, 3), uint8.
        facade: Truth values, shape (P,): whether the upright faces carry rows of windows.
        main: Truth values, shape (P,): whether it is so large that seeing it is seeing its owner.
    """

    corners: FloatArray
    colors: ByteArray
    facade: BoolArray
    main: BoolArray

    def __post_init__(self) -> None:
        """Check the shapes; raises GeometryError."""
        count = len(self.corners)
        columns = {
            "corners": (count, 8, 3),
            "colors": (count, 6, 3),
            "facade": (count,),
            "main": (count,),
        }
        types = {"corners": np.float64, "colors": np.uint8, "facade": np.bool_, "main": np.bool_}
        for name, shape in columns.items():
            array = checked(f"Solids.{name}", getattr(self, name), shape, types[name])
            object.__setattr__(self, name, readonly(array))

    def __len__(self) -> int:
        """Return the number of solids."""
        return len(self.corners)

    def select(self, rows: IntArray) -> "Solids":
        """Return the solids of some rows (K,), in that order."""
        columns = [getattr(self, name)[rows] for name in Solids.__slots__]
        return Solids(*columns)


@dataclass(frozen=True, slots=True)
class Block:
    """One solid to build: an upright box with an upper face that may be smaller than its lower one.

    Attributes:
        x: Extent from, to, metres.
        y: Extent from, to, metres.
        z: Extent from, to, metres.
        color: Colour of all faces.
        glass: Faces that have the colour `GLASS` instead.
        inset: Reduction of the upper face at the front, at the rear and at each side, metres.
        facade: Whether the upright faces carry rows of windows, as in `Solids`.
        main: Whether it is so large that seeing it is seeing its owner, as in `Solids`.
    """

    x: tuple[float, float]
    y: tuple[float, float]
    z: tuple[float, float]
    color: Color
    glass: tuple[int, ...] = ()
    inset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    facade: bool = False
    main: bool = True


def build(blocks: Sequence[Block]) -> Solids:
    """Build the solids of blocks, in order."""
    corners = np.array([_corners(block) for block in blocks])
    colors = np.array([_colors(block) for block in blocks], dtype=np.uint8)
    return Solids(
        corners.reshape(-1, 8, 3),
        colors.reshape(-1, 6, 3),
        np.array([block.facade for block in blocks], dtype=bool),
        np.array([block.main for block in blocks], dtype=bool),
    )


def concatenate_solids(parts: Sequence[Solids]) -> Solids:
    """Concatenate the solids of `parts`, in order."""
    columns = []
    for name in Solids.__slots__:
        columns.append(np.concatenate([getattr(part, name) for part in parts]))
    return Solids(*columns)


def face_corners(corners: FloatArray) -> FloatArray:
    """Return the four corners of every face, shape (P·6, 4, 3), of solids (P, 8, 3)."""
    return corners[:, FACES].reshape(-1, 4, 3)


def face_planes(quads: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the planes of faces (F, 4, 3).

    Returns:
        Outward unit normals (F, 3) and offsets (F,) with normal · p = offset.
    """
    diagonal = quads[:, 2] - quads[:, 0]
    other_diagonal = quads[:, 3] - quads[:, 1]
    normals = np.cross(diagonal, other_diagonal)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    offsets = np.einsum("fk,fk->f", normals, quads[:, 0])
    return normals, offsets


def _corners(block: Block) -> FloatArray:
    """Return the corners (8, 3) of a block, metres."""
    low = np.array([block.x[0], block.y[0], block.z[0]], dtype=np.float64)
    high = np.array([block.x[1], block.y[1], block.z[1]], dtype=np.float64)
    corners = np.where(CORNER_SIGNS > 0, high, low)
    front, rear, side = block.inset
    upper = CORNER_SIGNS[:, 2] > 0
    along = np.where(CORNER_SIGNS[:, 0] > 0, -front, rear)
    shift = np.column_stack([along, -side * CORNER_SIGNS[:, 1]])
    corners[upper, :2] += shift[upper]
    return corners


def _colors(block: Block) -> list[Color]:
    """Return the colours of a block's faces."""
    return [GLASS if face in block.glass else block.color for face in range(FACES_A_SOLID)]
