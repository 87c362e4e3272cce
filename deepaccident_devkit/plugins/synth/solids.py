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

# Red, green, blue, 0 to 255.
Color = tuple[int, int, int]

# Corners (in the order of `CORNER_SIGNS`) of the faces front, rear, left, right, top, bottom; counter-clockwise
# seen from outside.
FACES = np.array(
    [[0, 1, 2, 3], [4, 7, 6, 5], [0, 3, 7, 4], [1, 5, 6, 2], [0, 4, 5, 1], [3, 2, 6, 7]]
)
FRONT, REAR, LEFT, RIGHT, TOP, BOTTOM = range(6)
FACES_A_SOLID = len(FACES)


@dataclass(frozen=True, slots=True, eq=False)
class Solids:
    """P convex solids of eight corners and six flat faces; arrays are read-only.

    Attributes:
        corners: (P, 8, 3) float64, metres, in the order of `CORNER_SIGNS`.
        colors: (P, 6, 3) uint8, RGB of each face in white light.
        facade: (P,) bool, whether the upright faces carry rows of windows.
        main: (P,) bool, whether it is so large that who sees it sees its owner.
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
        """Number of solids."""
        return len(self.corners)

    def select(self, rows: IntArray) -> "Solids":
        """The solids of some rows (K,), in that order."""
        return Solids(*(getattr(self, name)[rows] for name in Solids.__slots__))


@dataclass(frozen=True, slots=True)
class Block:
    """One solid to build: an upright box whose upper face may be smaller than its lower one.

    Attributes:
        x: from, to, metres.
        y: from, to, metres.
        z: from, to, metres.
        color: the colour of all faces.
        glass: faces that have the colour `GLASS` instead.
        inset: by how much the upper face is smaller at the front, at the rear and at each side, metres.
        facade: as in `Solids`.
        main: as in `Solids`.
    """

    x: tuple[float, float]
    y: tuple[float, float]
    z: tuple[float, float]
    color: Color
    glass: tuple[int, ...] = ()
    inset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    facade: bool = False
    main: bool = True


GLASS: Color = (52, 66, 80)


def build(blocks: Sequence[Block]) -> Solids:
    """The solids of blocks, in order."""
    return Solids(
        np.array([_corners(block) for block in blocks]).reshape(-1, 8, 3),
        np.array([_colors(block) for block in blocks], dtype=np.uint8).reshape(-1, 6, 3),
        np.array([block.facade for block in blocks], dtype=bool),
        np.array([block.main for block in blocks], dtype=bool),
    )


def concatenate_solids(parts: Sequence[Solids]) -> Solids:
    """All solids of `parts`, in order."""
    return Solids(
        *(np.concatenate([getattr(part, name) for part in parts]) for name in Solids.__slots__)
    )


def face_corners(corners: FloatArray) -> FloatArray:
    """The four corners of every face, (P·6, 4, 3), of solids (P, 8, 3)."""
    return corners[:, FACES].reshape(-1, 4, 3)


def face_planes(quads: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Outward unit normals (F, 3) and offsets (F,) with normal · p = offset, of faces (F, 4, 3)."""
    normals = np.cross(quads[:, 2] - quads[:, 0], quads[:, 3] - quads[:, 1])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return normals, np.einsum("fk,fk->f", normals, quads[:, 0])


def _corners(block: Block) -> FloatArray:
    low = np.array([block.x[0], block.y[0], block.z[0]], dtype=np.float64)
    high = np.array([block.x[1], block.y[1], block.z[1]], dtype=np.float64)
    corners = np.where(CORNER_SIGNS > 0, high, low)
    front, rear, side = block.inset
    upper = CORNER_SIGNS[:, 2] > 0
    shift = np.column_stack(
        [np.where(CORNER_SIGNS[:, 0] > 0, -front, rear), -side * CORNER_SIGNS[:, 1]]
    )
    corners[upper, :2] += shift[upper]
    return corners


def _colors(block: Block) -> list[Color]:
    return [GLASS if face in block.glass else block.color for face in range(FACES_A_SOLID)]
