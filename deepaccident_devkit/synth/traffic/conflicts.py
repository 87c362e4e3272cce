"""Where the ways of road users cross or join, and who has to wait there."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from deepaccident_devkit.arrays import BoolArray, FloatArray
from deepaccident_devkit.synth.roads.paths import Path

_SPACING = 0.5
_MARGIN = 0.5
"""Metres between two bodies that pass each other in a zone."""


@dataclass(frozen=True, slots=True, eq=False)
class Zones:
    """For each ordered pair of road users, the stretch of the first one's path on which it meets the second's.

    Attributes:
        enter: (A, A) metres along the path of the row's, where its front comes too near to the column's way; infinite
            where the two never meet.
        leave: (A, A) where its rear is clear of it.
    """

    enter: FloatArray
    leave: FloatArray


def find_zones(
    paths: Sequence[Path],
    spans: Sequence[tuple[float, float]],
    widths: FloatArray,
    together: BoolArray,
) -> Zones:
    """The zones of all pairs.

    Args:
        paths: of the road users.
        spans: from, to: the stretch of each path on which it can meet others, metres.
        widths: (A,) of their bodies, metres.
        together: (A, A) bool, pairs that follow each other, or never mind each other, and so have no zone.
    """
    count = len(paths)
    enter, leave = np.full((count, count), np.inf), np.full((count, count), np.inf)
    known: dict[tuple[int, int, float], tuple[tuple[float, float], tuple[float, float]] | None] = {}
    points = [_points(path, span) for path, span in zip(paths, spans, strict=True)]
    for i in range(count):
        for j in range(i + 1, count):
            if together[i, j]:
                continue
            reach = round(float(widths[i] + widths[j]) / 2 + _MARGIN, 1)
            key = (id(paths[i]), id(paths[j]), reach)
            if key not in known:
                known[key] = _meeting(points[i], points[j], reach)
            zone = known[key]
            if zone is not None:
                (enter[i, j], leave[i, j]), (enter[j, i], leave[j, i]) = zone
    return Zones(enter, leave)


def _points(path: Path, span: tuple[float, float]) -> FloatArray:
    """(K, 3) x, y and how far along, metres."""
    along = np.arange(max(span[0], 0.0), min(span[1], path.length), _SPACING)
    x, y, _, _ = path.at(along)
    return np.stack([x, y, along], axis=-1)


def _meeting(
    first: FloatArray, second: FloatArray, reach: float
) -> tuple[tuple[float, float], tuple[float, float]] | None:
    """From, to on each of two lines of points (K, 3) where they are within reach of each other; None if nowhere."""
    if not len(first) or not len(second):
        return None
    square = (first[:, None, 0] - second[None, :, 0]) ** 2 + (first[:, None, 1] - second[None, :, 1]) ** 2
    near = square < reach**2
    rows, columns = near.any(axis=1), near.any(axis=0)
    if not rows.any():
        return None
    on_first, on_second = first[rows, 2], second[columns, 2]
    return (float(on_first[0]), float(on_first[-1])), (float(on_second[0]), float(on_second[-1]))
