"""The columns of `Boxes`: their shapes and types, and the checks of what a caller gives for them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.support.arrays import AnyArray, FloatArray
from deepaccident_devkit.taxonomy import CATEGORIES

COLUMNS: dict[str, tuple[tuple[int | None, ...], type]] = {
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
_FINITE = ("center", "size", "rotation")
_UNIT_TOLERANCE = 1e-3
"""How far the norm of a quaternion may be from 1; it is then scaled to 1."""


def check_numbers(columns: dict[str, AnyArray]) -> None:
    """Check that centres, sizes and rotations are finite, and sizes not negative; raises GeometryError."""
    for name in _FINITE:
        bad = ~np.isfinite(columns[name]).all(axis=1)
        if bad.any():
            raise GeometryError(
                f"Boxes.{name}: expected finite numbers, found {columns[name][bad][0].tolist()} in row "
                f"{np.argmax(bad)}; leave such boxes out"
            )
    negative = (columns["size"] < 0).any(axis=1)
    if negative.any():
        raise GeometryError(
            f"Boxes.size: expected lengths, widths and heights from 0, found {columns['size'][negative][0].tolist()} "
            f"in row {np.argmax(negative)}"
        )


def unit(rotation: FloatArray) -> FloatArray:
    """The quaternions (N, 4) scaled to norm 1; before, they must have it up to 0.001, else GeometryError."""
    norm = np.linalg.norm(rotation, axis=1)
    off = np.abs(norm - 1)
    if (off > _UNIT_TOLERANCE).any():
        row = int(np.argmax(off))
        raise GeometryError(
            f"Boxes.rotation: expected unit quaternions w, x, y, z, found {rotation[row].tolist()} in row {row}"
        )
    return rotation / norm[:, None] if (off > 1e-12).any() else rotation


def category_codes(category: ArrayLike) -> AnyArray:
    """The codes of categories that are given as codes or names; raises GeometryError."""
    given = np.asarray(category)
    if given.dtype.kind not in "US":
        if not np.isin(given, range(len(CATEGORIES))).all():
            raise GeometryError(
                f"category codes are 0 to {len(CATEGORIES) - 1} ({', '.join(CATEGORIES)}), found {given}"
            )
        return given.astype(np.int8)
    names = [str(name) for name in given.ravel()]
    unknown = sorted(set(names) - set(CATEGORIES))
    if unknown:
        raise GeometryError(f"unknown category {unknown}; known are {', '.join(CATEGORIES)}")
    return np.array([CATEGORIES.index(name) for name in names], dtype=np.int8).reshape(given.shape)
