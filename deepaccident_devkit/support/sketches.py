"""Sketches: a few numbers from which the distance between two long vectors is estimated.

Each number is the sum of all values, each with a sign drawn at random, the same signs everywhere.
The differences between the numbers of two sketches are then, on average, as large as the vectors
are apart: the square root of the sum of their values' squared differences.
"""

from __future__ import annotations

import hashlib
import math
from functools import cache
from typing import Any, Final, TypeAlias

import numpy as np

from deepaccident_devkit.support.arrays import Float32Array, readonly

Sketch: TypeAlias = tuple[float, ...]
# Number of sums in a sketch.
_SUM_COUNT: Final = 8
_UNKNOWN: Final = 1e9
# Number of values after which the same signs are used again.
_PERIOD: Final = 1 << 18


def sketch(values: Any) -> Sketch:
    """Return the sketch of an array's values, in their order."""
    flat = np.asarray(values, dtype=np.float32).ravel()
    signs = _signs().take(np.arange(flat.size), axis=1, mode="wrap")
    return whole_numbers(signs @ flat)


def whole_numbers(sums: Any) -> Sketch:
    """Return an array's values (N,) as whole numbers, far from all others where unknown."""
    return tuple(map(round, np.nan_to_num(sums, nan=_UNKNOWN).tolist()))


def distance(left_sketch: Sketch, right_sketch: Sketch) -> float:
    """Estimate how far the vectors of two sketches are apart; infinite if one is no sketch."""
    if len(left_sketch) != _SUM_COUNT or len(right_sketch) != _SUM_COUNT:
        return math.inf
    return math.dist(left_sketch, right_sketch) / math.sqrt(_SUM_COUNT)


@cache
def _signs() -> Float32Array:
    """Return the signs of a period's values in each sum, (8, P) of −1 and 1."""
    random_bytes = hashlib.shake_256(b"sketches").digest(_PERIOD)
    bits = np.unpackbits(np.frombuffer(random_bytes, dtype=np.uint8))
    return readonly(bits.reshape(_SUM_COUNT, _PERIOD).astype(np.float32) * 2 - 1)
