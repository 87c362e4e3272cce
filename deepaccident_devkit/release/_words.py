"""Numbers in the release's files: the largest that count, and their words in text files, of any length."""

import re
from typing import Final

import numpy as np

from deepaccident_devkit.arrays import AnyArray, BoolArray

_NUMBER: Final = re.compile(r"[+-]?((\d+\.?\d*|\.\d+)(e[+-]?\d+)?|nan|inf|infinity)", re.ASCII | re.IGNORECASE)
LARGEST: Final = 1e9
"""Metres, m/s, pixels, …: a larger number is damage and counts as infinite; it would overflow where it is squared."""
_INTEGER: Final = re.compile(r"(-?)0*(\d{1,19})", re.ASCII)


def in_range(numbers: AnyArray | float) -> BoolArray:
    """Which numbers are neither NaN nor infinite, nor as large as no sound file has them."""
    small: BoolArray = np.abs(numbers) <= np.float64(LARGEST)  # half precision has no 1e9
    return small


def number_of(word: str) -> float | None:
    """The number that a word says, NaN and infinity included; None if it says none."""
    return float(word) if _NUMBER.fullmatch(word) else None


def integer_of(word: str) -> int | None:
    """The integer of 64 bits that a word says; None if it says none. Python itself reads no more than 4,300 digits."""
    found = _INTEGER.fullmatch(word)
    value = int(found[1] + found[2]) if found else 2**63
    return value if -(2**63) <= value < 2**63 else None
