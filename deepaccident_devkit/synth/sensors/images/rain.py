"""Rain between the camera and what it sees."""

import numpy as np

from deepaccident_devkit.arrays import ByteArray

_STREAKS = 520
"""Streaks of hard rain in a picture of any size."""
_SUBPIXEL = 16
"""Steps of a pixel in which OpenCV takes places, a power of 2."""


def rain_streaks(size: tuple[int, int], rain: float, rng: np.random.Generator) -> ByteArray:
    """Light to add to a picture of width, height pixels, (H, W, 3) uint8: streaks, longer and brighter near by."""
    import cv2

    width, height = size
    streaks = np.zeros((height, width), dtype=np.uint8)
    count = int(_STREAKS * rain)
    near = rng.random(count) ** 3
    length = height * (0.02 + 0.11 * near)
    start = rng.random((count, 2)) * (width * 1.1, height) - (0, length.mean())
    end = start + np.column_stack([-0.12 * length, length])
    first, last = ((each * _SUBPIXEL).astype(np.int64).tolist() for each in (start, end))
    bright = (18 + 40 * near).astype(np.int64).tolist()
    for one, other, light in zip(first, last, bright, strict=True):
        cv2.line(streaks, one, other, light, 1, cv2.LINE_AA, 4)
    blurred = cv2.GaussianBlur(streaks, (3, 3), 0)
    return np.asarray(cv2.merge([blurred] * 3))
