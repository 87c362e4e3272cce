"""The smallest rectangle around each of many convex hulls, to the last bit as OpenCV 4.5.5 to 4.7 finds it.

`cv2.minAreaRect` changed its angles with OpenCV 4.13, and new angles cannot be converted to old ones without moving a
few of the rasterised cells. Source: OpenCV 4.7.0, imgproc, rotcalipers.cpp: which side is tried next is decided in
whole numbers, lengths and areas are float32.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from deepaccident_devkit.arrays import AnyArray, IntArray
from deepaccident_devkit.motion.postprocessing.contours import Point

_QUARTER_TURNS = np.array([[[1, 0], [0, 1]], [[0, 1], [-1, 0]], [[-1, 0], [0, -1]], [[0, -1], [1, 0]]])
"""The turns that make edges at the lowest, rightmost, highest and leftmost corner lie like one at the lowest."""


def min_area_rects(hulls: Sequence[Sequence[Point]]) -> tuple[AnyArray, AnyArray]:
    """Widths and heights, and angles, of the smallest rectangles around convex hulls.

    Args:
        hulls: corners (x, y) of each, as `contours.convex_hull` lists them.

    Returns:
        (N, 2) float32 widths and heights, and (N,) float32 angles of the widths, degrees from x towards y.
    """
    size, side = np.zeros((len(hulls), 2), dtype=np.float32), np.zeros((len(hulls), 2))
    corners = np.array([len(hull) for hull in hulls], dtype=np.int64)
    for index in np.flatnonzero(corners == 2).tolist():
        side[index] = np.subtract(hulls[index][1], hulls[index][0])
        size[index, 0] = np.sqrt((side[index] ** 2).sum())
    broad = np.flatnonzero(corners > 2).tolist()
    if broad:
        most = corners[broad].max()
        points = np.array([[*hulls[index], *[hulls[index][0]] * (most - corners[index])] for index in broad])
        width, height = _rectangles(points, corners[broad])
        side[broad] = width
        size[broad] = np.sqrt((np.stack([width, height], axis=1).astype(np.float64) ** 2).sum(axis=-1))
    angle = np.arctan2(side[:, 1], side[:, 0]).astype(np.float32)
    return size, ((angle * np.float32(180)).astype(np.float64) / np.pi).astype(np.float32)


def _rectangles(points: IntArray, corners: IntArray) -> tuple[AnyArray, AnyArray]:
    """Both sides (N, 2) float32 of the smallest rectangles around hulls (N, C, 2); their first `corners` (N,) count."""
    which = np.arange(len(points))
    following = (np.arange(points.shape[1]) + 1) % corners[:, None]
    edges = points[which[:, None], following] - points
    touching, leading, turned = _rotate(points, edges, corners)
    lengths = np.sqrt((edges.astype(np.float64) ** 2).sum(axis=-1))
    edge = edges[which, leading].astype(np.float32)
    unit = edge * (1 / lengths[which, leading]).astype(np.float32)[..., None]
    base = np.choose(turned[..., None], [unit, _swapped(unit, 1, -1), -unit, _swapped(unit, -1, 1)])
    a, b = base[..., 0], base[..., 1]
    x, y = np.moveaxis(points[which[:, None], touching].astype(np.float32), -1, 0)
    width = (x[..., 1] - x[..., 3]) * a + (y[..., 1] - y[..., 3]) * b
    height = -(x[..., 2] - x[..., 0]) * b + (y[..., 2] - y[..., 0]) * a
    area = np.where(np.arange(len(a))[:, None] < corners, width * height, np.inf)
    best = len(area) - 1 - area[::-1].argmin(axis=0)  # the last of equal ones
    a, b, width, height = (values[best, which] for values in (a, b, width, height))
    return np.stack([a * width, b * width], axis=1), np.stack([-b * height, a * height], axis=1)


def _rotate(points: IntArray, edges: IntArray, corners: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """Turn four lines around all hulls at once, from edge to edge.

    Returns:
        For each step the corners (C, N, 4) that the lines touch after it, the edge (C, N) that one of them came to lie
        on, and which of them (C, N) that was: 0 at the lowest corner, then 1 right, 2 highest, 3 left.
    """
    which = np.arange(len(points))
    x, y = points[..., 0], points[..., 1]
    touching = np.stack([y.argmin(axis=1), x.argmax(axis=1), y.argmax(axis=1), x.argmin(axis=1)], axis=1)
    turned_edges = np.einsum("lij,ncj->lnci", _QUARTER_TURNS, edges)
    steps, leading, turned = [], [], []
    for _ in range(points.shape[1]):
        x, y = np.moveaxis(turned_edges[np.arange(4), which[:, None], touching], -1, 0)
        line = np.zeros(len(points), dtype=np.int64)
        for other in range(1, 4):
            line[y[:, other] * x[which, line] < x[:, other] * y[which, line]] = other
        leading.append(touching[which, line])
        turned.append(line)
        touching = touching.copy()
        touching[which, line] = (leading[-1] + 1) % corners
        steps.append(touching)
    return np.stack(steps), np.stack(leading), np.stack(turned)


def _swapped(vectors: AnyArray, first: int, second: int) -> AnyArray:
    """(…, 2) vectors with both components exchanged and signed."""
    return vectors[..., ::-1] * np.array([first, second], dtype=np.float32)
