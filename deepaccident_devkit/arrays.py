"""Array aliases and the checks that turn what a caller passes into what a record holds."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from deepaccident_devkit.errors import GeometryError

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
ByteArray = NDArray[np.uint8]
AnyArray = NDArray[Any]


def checked(name: str, values: ArrayLike, shape: Sequence[int | None], dtype: DTypeLike = np.float64) -> AnyArray:
    """Return `values` as an array of `dtype`, or raise GeometryError if its shape is another.

    Args:
        name: how the error names the array.
        values: what the caller passed.
        shape: the expected shape, None where any length is good.
        dtype: the element type wanted; an array that has it already is not copied.
    """
    try:
        array = np.asarray(values, dtype=dtype)
    except (TypeError, ValueError) as error:
        message = f"{name}: expected an array of shape {_shape_text(shape)}, found {type(values).__name__}"
        raise GeometryError(f"{message} ({error})") from error
    if array.ndim != len(shape) or any(
        want is not None and want != have for want, have in zip(shape, array.shape, strict=True)
    ):
        raise GeometryError(f"{name}: expected shape {_shape_text(shape)}, found {array.shape}")
    return array


def as_floats(values: ArrayLike) -> FloatArray:
    """`values` as float64; arrays that are float64 already are not copied."""
    return np.asarray(values, dtype=np.float64)


def readonly(array: AnyArray) -> AnyArray:
    """Return a read-only view of `array`; the caller's own array stays writable."""
    view = array.view()
    view.flags.writeable = False
    return view


def _shape_text(shape: Sequence[int | None]) -> str:
    return "(" + ", ".join("N" if length is None else str(length) for length in shape) + ")"
