"""Solids with six faces, which make up everything in the synthetic world except the ground."""

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
Span = tuple[float, float]
"""Start and end along an axis, metres."""
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
        facade: Whether each solid's upright faces carry rows of windows, shape (P,), bool.
        main: Whether each solid is a large part of its owner, so that seeing it means seeing the
            owner, shape (P,), bool.
    """

    corners: FloatArray
    colors: ByteArray
    facade: BoolArray
    main: BoolArray

    def __post_init__(self) -> None:
        """Check the shapes; raise GeometryError if one is wrong."""
        count = len(self.corners)
        shapes = {
            "corners": (count, 8, 3),
            "colors": (count, 6, 3),
            "facade": (count,),
            "main": (count,),
        }
        types = {"corners": np.float64, "colors": np.uint8, "facade": np.bool_, "main": np.bool_}
        for name, shape in shapes.items():
            array = checked(f"Solids.{name}", getattr(self, name), shape, types[name])
            object.__setattr__(self, name, readonly(array))

    def __len__(self) -> int:
        """Return the number of solids."""
        return len(self.corners)

    def select(self, rows: IntArray) -> "Solids":
        """Return the solids at some rows (K,), in that order."""
        columns = [getattr(self, name)[rows] for name in Solids.__slots__]
        return Solids(*columns)


@dataclass(frozen=True, slots=True)
class Block:
    """One solid to build: an upright box with an upper face that may be smaller than its lower one.

    Attributes:
        x: Extent from and to, metres.
        y: Extent from and to, metres.
        z: Start and end, metres.
        color: Colour of all faces.
        glass: Faces that have the colour `GLASS` instead.
        inset: How far the upper face is set back at the front, at the rear and at each side,
            metres.
        facade: Whether the upright faces carry rows of windows, as in `Solids`.
        main: Whether it is a large part of its owner, as in `Solids`.
    """

    x: Span
    y: Span
    z: Span
    color: Color
    glass: tuple[int, ...] = ()
    inset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    facade: bool = False
    main: bool = True


def build(blocks: Sequence[Block]) -> Solids:
    """Build the solids of blocks, in order."""
    corners = [_compute_corners(block) for block in blocks]
    colors = [_choose_face_colors(block) for block in blocks]
    has_facade = [block.facade for block in blocks]
    is_main = [block.main for block in blocks]
    return Solids(
        np.array(corners).reshape(-1, 8, 3),
        np.array(colors, dtype=np.uint8).reshape(-1, 6, 3),
        np.array(has_facade, dtype=bool),
        np.array(is_main, dtype=bool),
    )


def span_around(middle: float, half_length: float) -> Span:
    """Return the start and end of a span around its middle, metres."""
    return middle - half_length, middle + half_length


def center_span(half_length: float) -> Span:
    """Return the start and end of a span centred at 0, metres."""
    return -half_length, half_length


def both_sides(inner: float, outer: float) -> tuple[Span, Span]:
    """Return an extent in y on the left side, and the same one on the right side, metres."""
    return (inner, outer), (-outer, -inner)


def concatenate_solids(parts: Sequence[Solids]) -> Solids:
    """Concatenate the solids of `parts`, in order."""
    columns = []
    for name in Solids.__slots__:
        arrays = [getattr(part, name) for part in parts]
        columns.append(np.concatenate(arrays))
    return Solids(*columns)


def face_corners(corners: FloatArray) -> FloatArray:
    """Return the four corners of every face, shape (P·6, 4, 3), of solids (P, 8, 3)."""
    return corners[:, FACES].reshape(-1, 4, 3)


def face_planes(quads: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the planes of faces (F, 4, 3).

    Returns:
        Outward unit normals (F, 3), and offsets (F,), where normal · p = offset for points p on the
        face.
    """
    diagonal = quads[:, 2] - quads[:, 0]
    other_diagonal = quads[:, 3] - quads[:, 1]
    normals = np.cross(diagonal, other_diagonal)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    offsets = np.einsum("fk,fk->f", normals, quads[:, 0])
    return normals, offsets


def _compute_corners(block: Block) -> FloatArray:
    """Return the corners (8, 3) of a block, metres."""
    low, high = np.array([block.x, block.y, block.z], dtype=np.float64).T
    corners: FloatArray = np.where(CORNER_SIGNS > 0, high, low)
    x_sign, y_sign, z_sign = CORNER_SIGNS.T
    front, rear, side = block.inset
    shift = np.column_stack([np.where(x_sign > 0, -front, rear), -side * y_sign])
    is_upper = z_sign > 0
    corners[is_upper, :2] += shift[is_upper]
    return corners


def _choose_face_colors(block: Block) -> list[Color]:
    """Return the colours of a block's faces."""
    colors = [block.color] * FACES_A_SOLID
    for face in block.glass:
        colors[face] = GLASS
    return colors
