"""Checks of single settings. They make numpy's scalars Python's own, so equal configurations are written alike."""

from __future__ import annotations

import math

import numpy as np

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.support.arrays import checked_number, checked_whole


def flag(name: str, value: object) -> bool:
    """True or False, or ConfigError."""
    if not isinstance(value, bool | np.bool_):
        raise ConfigError(f"{name}: expected True or False, found {value!r}")
    return bool(value)


def count(name: str, value: object, what: str, most: int) -> int:
    """A whole number from 1 to `most`, or ConfigError, which says what it counts."""
    expected = f"a whole number from 1 to {most:,} ({what})"
    found = 0 if isinstance(value, bool | np.bool_) else checked_whole(name, value, expected, ConfigError)
    if not 1 <= found <= most:
        raise ConfigError(f"{name}: expected {expected}, found {value!r}")
    return found


def number(name: str, value: object, expected: str, least: float = -math.inf, most: float = math.inf) -> float:
    """A finite number from `least` to `most`, or ConfigError."""
    found = math.nan if isinstance(value, bool | np.bool_) else checked_number(name, value, expected, ConfigError)
    if not (math.isfinite(found) and least <= found <= most):
        raise ConfigError(f"{name}: expected {expected}, found {value!r}")
    return found
