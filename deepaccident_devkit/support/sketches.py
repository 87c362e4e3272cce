"""Sketches: a few numbers from which the distance between two long vectors is estimated.

Each number is the sum of all values with random signs, which are the same for all vectors. The
differences between the numbers of two sketches are then, on average, as large as the distance of
the vectors: the square root of the sum of their values' squared differences.
"""

import hashlib
import math
from functools import cache
from typing import Any, TypeAlias

import numpy as np

from deepaccident_devkit.support.arrays import Float32Array, readonly

Sketch: TypeAlias = tuple[float, ...]
# Number of sums in a sketch.
_SUM_COUNT = 8
_UNKNOWN = 1e9
# Number of values after which the same signs are used again.
_PERIOD = 1 << 18


def sketch(values: Any) -> Sketch:
    """Return the sketch of an array's values, in their order."""
    flat = np.asarray(values, dtype=np.float32).ravel()
    signs = _make_signs().take(np.arange(flat.size), axis=1, mode="wrap")
    return whole_numbers(signs @ flat)


def whole_numbers(sums: Any) -> Sketch:
    """Return an array's values (N,) as whole numbers; NaN becomes a number far from all others."""
    known_sums = np.nan_to_num(sums, nan=_UNKNOWN)
    return tuple(map(round, known_sums.tolist()))


def distance(left_sketch: Sketch, right_sketch: Sketch) -> float:
    """Estimate the distance of the vectors of two sketches; infinite if one is not a sketch."""
    if len(left_sketch) != _SUM_COUNT or len(right_sketch) != _SUM_COUNT:
        return math.inf
    return math.dist(left_sketch, right_sketch) / math.sqrt(_SUM_COUNT)


@cache
def _make_signs() -> Float32Array:
    """Return the random sign of each value in each sum, shape (8, P), −1 or 1."""
    random_bytes = hashlib.shake_256(b"sketches").digest(_PERIOD)
    bits = np.unpackbits(np.frombuffer(random_bytes, dtype=np.uint8))
    bits_of_sums = bits.reshape(_SUM_COUNT, _PERIOD).astype(np.float32)
    return readonly(bits_of_sums * 2 - 1)
