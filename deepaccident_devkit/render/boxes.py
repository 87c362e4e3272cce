"""Drawing boxes: from above, and in camera images."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from deepaccident_devkit.arrays import FloatArray
from deepaccident_devkit.geometry import Box, Boxes, PinholeCamera
from deepaccident_devkit.render.colors import CATEGORY_COLORS, COLLIDER_COLOR, OWN_COLOR
from deepaccident_devkit.taxonomy import OWN_ACTOR_ID

if TYPE_CHECKING:
    from collections.abc import Collection

    from matplotlib.axes import Axes
    from matplotlib.collections import LineCollection, PolyCollection

EDGES = ((0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7))
"""The twelve edges of a box between its corners, in `Box.corners` order; the first four are its front."""
NEAREST_DRAWN = 0.1
"""Metres before the camera at which edges are cut off."""


def box_colors(boxes: Boxes, colliders: Collection[int] = ()) -> list[str]:
    """A colour a box: the colliding pair, the agent itself, else by category."""
    colors = []
    for actor_id, name in zip(boxes.actor_id.tolist(), boxes.category_names, strict=True):
        own = OWN_COLOR if actor_id == OWN_ACTOR_ID else CATEGORY_COLORS[name]
        colors.append(COLLIDER_COLOR if actor_id in colliders else own)
    return colors


def draw_box(box: Box, ax: Axes, color: str | None = None) -> Axes:
    """Draw one box from above, in its own frame's x and y, metres, with a line towards its front."""
    corners = box.bottom_corners()
    chosen = color or CATEGORY_COLORS[box.category]
    ax.add_collection(_outlines(corners.T[None, :, :2], [chosen]))
    ax.add_collection(_headings(box.center[None, :2], corners.T[None, :, :2], [chosen]))
    return ax


def draw_boxes_from_above(boxes: Boxes, ax: Axes, colors: list[str]) -> None:
    """Draw boxes in their frame's x and y, metres, each with a line towards its front."""
    corners = boxes.bottom_corners()[..., :2]
    ax.add_collection(_outlines(corners, colors))
    ax.add_collection(_headings(boxes.center[:, :2], corners, colors))


def draw_boxes_in_image(boxes: Boxes, camera: PinholeCamera, ax: Axes, colors: list[str]) -> None:
    """Draw the edges of boxes given in the camera's optical frame, as far as they lie before the camera."""
    from matplotlib.collections import LineCollection

    lines, line_colors = [], []
    for corners, color in zip(boxes.corners(), colors, strict=True):
        for edge in EDGES:
            segment = _before_camera(corners[list(edge)])
            if segment is not None:
                pixels, _ = camera.project(segment)
                lines.append(pixels)
                line_colors.append(color)
    ax.add_collection(LineCollection(lines, colors=line_colors, linewidths=1.2))


def _before_camera(segment: FloatArray) -> FloatArray | None:
    """The part (2, 3) of a line segment with z ≥ NEAREST_DRAWN; None if there is none."""
    depth = segment[:, 2]
    if (depth < NEAREST_DRAWN).all():
        return None
    if (depth >= NEAREST_DRAWN).all():
        return segment
    share = (NEAREST_DRAWN - depth[0]) / (depth[1] - depth[0])
    cut = segment[0] + share * (segment[1] - segment[0])
    return np.array([cut, segment[1]] if depth[0] < NEAREST_DRAWN else [segment[0], cut])


def _outlines(corners: FloatArray, colors: list[str]) -> PolyCollection:
    from matplotlib.collections import PolyCollection
    from matplotlib.colors import to_rgba

    faces = [to_rgba(color, 0.25) for color in colors]
    return PolyCollection(list(corners), facecolors=faces, edgecolors=colors, linewidths=1.2, zorder=3)


def _headings(centers: FloatArray, corners: FloatArray, colors: list[str]) -> LineCollection:
    from matplotlib.collections import LineCollection

    fronts = corners[:, :2].mean(axis=1)
    return LineCollection(list(np.stack([centers, fronts], axis=1)), colors=colors, linewidths=1.2, zorder=3)
