"""How near instances of one frame are to each other, as the released code measures it: between simplified outlines."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from deepaccident_devkit.arrays import AnyArray, FloatArray, IntArray
from deepaccident_devkit.evaluation.accident.outlines import LEVEL, Place, first_outline, simplified

NO_OUTLINE: Final = 1e11
"""Cells: the released code's distance to an instance that is not in the picture, or too small there for an outline."""


def pair_gaps(
    image: AnyArray, ids: IntArray, *, level: float = LEVEL, below: float = np.inf
) -> tuple[IntArray, FloatArray]:
    """The distances between the outlines of pairs of instances.

    Args:
        image: (H, W) ids, 0 elsewhere.
        ids: (N,) int64, ascending, whose.
        level: see `outlines.LEVEL`.
        below: cells; pairs that cannot be nearer are left out.

    Returns:
        (P, 2) pairs in the order of `ids`: 0 1, 0 2, … 1 2, …; and (P,) cells: 0 where outlines overlap, `NO_OUTLINE`
        where one has none.
    """
    places = _places(image, ids)
    first, second = np.triu_indices(len(ids), 1)
    near = _box_gaps(places)[first, second] < below
    first, second = first[near], second[near]
    shapes = _shapes(image, ids, places, np.unique([first, second]), level)
    return np.stack([ids[first], ids[second]], axis=1), _distances(shapes[first], shapes[second])


def _places(image: AnyArray, ids: IntArray) -> list[Place | None]:
    """Where instances are; None for those that are not in the picture. Renumbered, since ids may be of any size."""
    from scipy.ndimage import find_objects

    cells = np.flatnonzero(image > 0)
    names = image.reshape(-1)[cells]
    rank = np.searchsorted(ids, names)
    known = np.append(ids, -1)[rank] == names
    ranks = np.zeros(image.shape, dtype=np.int32)
    ranks.reshape(-1)[cells[known]] = rank[known] + 1
    found: list[Any] = find_objects(ranks, len(ids)) if len(ids) else []
    return found


def _box_gaps(places: Sequence[Place | None]) -> FloatArray:
    """(N, N) cells that the outlines of instances are apart at least: their boxes, each a cell wider all around."""
    lowest, highest = np.full((2, len(places), 2), np.nan)
    for index, place in enumerate(places):
        if place is not None:
            lowest[index] = [along.start - 1 for along in place]
            highest[index] = [along.stop for along in place]
    apart = np.maximum(lowest[:, None] - highest, lowest - highest[:, None])
    gaps: FloatArray = np.sqrt((np.maximum(apart, 0) ** 2).sum(axis=-1))
    return np.where(np.isnan(gaps), NO_OUTLINE, gaps)


def _shapes(image: AnyArray, ids: IntArray, places: Sequence[Place | None], wanted: IntArray, level: float) -> AnyArray:
    """(N,) shapely's polygons of the instances number `wanted`; None for the others and those without an outline."""
    import shapely

    there = [index for index in wanted.tolist() if places[index] is not None]
    outlines = simplified([first_outline(image, ids.item(index), places[index], level) for index in there])
    broad = [(index, points) for index, points in zip(there, outlines, strict=True) if _corners(points) >= 3]
    shapes = np.full(len(ids), None)
    if broad:
        owner = np.repeat(np.arange(len(broad)), [len(points) for _, points in broad])
        rings = shapely.linearrings(np.concatenate([points for _, points in broad]), indices=owner)
        shapes[[index for index, _ in broad]] = shapely.polygons(rings)
    return shapes


def _corners(outline: FloatArray) -> int:
    """How many corners an outline has, whether or not its first is also its last point."""
    return len(outline) - int(len(outline) > 1 and bool((outline[0] == outline[-1]).all()))


def _distances(first: AnyArray, second: AnyArray) -> FloatArray:
    import shapely

    distances = shapely.distance(first, second)
    return np.where(np.isnan(distances), NO_OUTLINE, distances)
