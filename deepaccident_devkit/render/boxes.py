"""Rendering boxes: from above, and in camera images."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.arrays import BoolArray, FloatArray, IntArray
from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.geometry import Box, Boxes, PinholeCamera
from deepaccident_devkit.render.colors import CATEGORY_COLORS
from deepaccident_devkit.render.layers import Layer
from deepaccident_devkit.taxonomy import OWN_ACTOR_ID, UNTRACKED_ID

if TYPE_CHECKING:
    from matplotlib.axes import Axes

EDGES = ((0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7))
"""The twelve edges of a box between its corners, in `Box.corners` order; the first four are its front."""
NEAREST_DRAWN = 0.1
"""Metres in front of the camera at which edges are cut off."""
SMALLEST_TEXT: Final = 9
"""In points: text of this size can be read in print."""


def draw_box(box: Box, ax: Axes, color: str | None = None) -> Axes:
    """Render one box from above, in its own frame's x and y, metres, with a line towards its front.

    Raises:
        GeometryError: `box` is no `Box`, such as the axes.
    """
    if not isinstance(box, Box):
        raise GeometryError(
            f"box: expected a Box, found {type(box).__name__}; the box is first, then the axes: draw_box(box, ax)"
        )
    chosen = color or CATEGORY_COLORS[box.category]
    _draw_footprints(box.center[None, :2], box.bottom_corners().T[None, :, :2], ax, [chosen], 0.25, {})
    return ax


def draw_boxes_from_above(boxes: Boxes, ax: Axes, colors: Sequence[str], *, fill: float = 0.25, **how: Any) -> None:
    """Render boxes in their frame's x and y, metres, each with a line towards its front.

    Args:
        boxes: in any frame that stands on the ground.
        ax: axes to render on.
        colors: one colour for each box.
        fill: how opaque the inside is, from 0 to 1.
        how: matplotlib's arguments for the outlines, such as `linestyle` or `linewidths`.
    """
    _draw_footprints(boxes.center[:, :2], boxes.bottom_corners()[..., :2], ax, colors, fill, how)


def draw_ids_from_above(boxes: Boxes, ax: Axes, colors: Sequence[str]) -> None:
    """Write the label ids of tracked boxes beside them; the recording agent is `own`."""
    for center, actor_id, color in zip(boxes.center.tolist(), boxes.actor_id.tolist(), colors, strict=True):
        _write_id(ax, (center[0], center[1]), actor_id, color)


def draw_velocities_from_above(boxes: Boxes, ax: Axes, colors: Sequence[str]) -> None:
    """Render an arrow to where each box with a known velocity would be in a second."""
    moving = _moving(boxes)
    if moving.any():
        center, velocity = boxes.center[moving], boxes.velocity[moving]
        chosen = [color for color, moves in zip(colors, moving.tolist(), strict=True) if moves]
        start, step = center[:, :2].T, velocity[:, :2].T
        ax.quiver(*start, *step, color=chosen, angles="xy", scale_units="xy", scale=1, width=0.004, zorder=4)


def draw_actors_from_above(boxes: Boxes, ax: Axes, colors: Sequence[str], layers: Collection[Layer]) -> None:
    """Render the requested ones of the layers `boxes`, `velocities` and `ids`, as the functions above do."""
    if "boxes" in layers:
        draw_boxes_from_above(boxes, ax, colors)
    if "velocities" in layers:
        draw_velocities_from_above(boxes, ax, colors)
    if "ids" in layers:
        draw_ids_from_above(boxes, ax, colors)


def draw_boxes_in_image(boxes: Boxes, camera: PinholeCamera, ax: Axes, colors: Sequence[str], **how: Any) -> None:
    """Render the edges of boxes given in the camera's optical frame, and fill their fronts.

    What is not in front of the camera is cut off.

    Args:
        boxes: in the optical frame.
        camera: whose image it is.
        ax: axes to render on, in pixels.
        colors: one colour for each box.
        how: matplotlib's arguments for the edges, such as `linestyle` or `linewidths`.
    """
    from matplotlib.collections import LineCollection, PolyCollection
    from matplotlib.colors import to_rgba_array

    pixels, row, edge = _edges_in_image(boxes, camera)
    faces = to_rgba_array(list(colors))
    ax.add_collection(LineCollection(list(pixels), **{"colors": faces[row], "linewidths": 1.2, **how}))
    faces[:, 3] *= 0.25
    front = edge < 4  # going round, the ends of what is left of the edges are the corners of what is left of the face
    rows, starts = np.unique(row[front], return_index=True)
    fronts = np.split(pixels[front].reshape(-1, 2), 2 * starts[1:])
    ax.add_collection(PolyCollection(fronts if len(rows) else [], facecolors=faces[rows], edgecolors="none"))


def boxes_in_image(boxes: Boxes, camera: PinholeCamera) -> BoolArray:
    """Which boxes (N,) of the camera's frame have a part in its image."""
    bounds = bounds_in_image(boxes, camera)
    return np.asarray((bounds[:, 2:] > bounds[:, :2]).all(axis=1))


def bounds_in_image(boxes: Boxes, camera: PinholeCamera) -> FloatArray:
    """Left, top, right and bottom (N, 4) of the part of each box that is in the image; no area if none is."""
    pixels, row, _ = _edges_in_image(boxes, camera)
    bounds = np.zeros((len(boxes), 4))
    if len(row):
        rows, starts = np.unique(row, return_index=True)
        bounds[rows, :2] = np.minimum.reduceat(pixels.min(axis=1), starts)
        bounds[rows, 2:] = np.maximum.reduceat(pixels.max(axis=1), starts)
    return bounds.clip(0, (camera.width, camera.height) * 2)


def _edges_in_image(boxes: Boxes, camera: PinholeCamera) -> tuple[FloatArray, IntArray, IntArray]:
    """Edges (V, 2, 2) in front of the camera, as pixels, the rows (V,) of their boxes, and their numbers in `EDGES`."""
    pixels, drawn = segments_in_image(boxes.corners()[:, EDGES].reshape(-1, 2, 3), camera)
    row, edge = np.divmod(np.flatnonzero(drawn), len(EDGES))
    return pixels, row, edge


def draw_ids_in_image(boxes: Boxes, camera: PinholeCamera, ax: Axes, colors: Sequence[str]) -> None:
    """Write the ids of tracked boxes of the camera's optical frame above them, if their top is in the image."""
    top = boxes.corners()[:, (0, 1, 4, 5)].mean(axis=1)
    pixels, depth = camera.project(top)
    seen = camera.in_image(pixels, depth, min_depth=NEAREST_DRAWN)
    for row in np.flatnonzero(seen).tolist():
        _write_id(ax, (pixels[row, 0], pixels[row, 1]), int(boxes.actor_id[row]), colors[row])


def draw_velocities_in_image(boxes: Boxes, camera: PinholeCamera, ax: Axes, colors: Sequence[str]) -> None:
    """Render a line to where the centre of each moving box of the camera's optical frame would be in a second."""
    from matplotlib.collections import LineCollection
    from matplotlib.colors import to_rgba_array

    moving = _moving(boxes)
    center = boxes.center[moving]
    pixels, drawn = segments_in_image(np.stack([center, center + boxes.velocity[moving]], axis=1), camera)
    chosen = to_rgba_array(list(colors))[moving][drawn]
    ax.add_collection(LineCollection(list(pixels), colors=chosen, linewidths=2, linestyles=(0, (2, 1))))


def segments_in_image(segments: FloatArray, camera: PinholeCamera) -> tuple[FloatArray, BoolArray]:
    """Line segments (S, 2, 3) of the optical frame as pixels (V, 2, 2), and which (S,) of them are in front of it.

    Parts nearer than `NEAREST_DRAWN` are cut off.
    """
    depth = segments[..., 2]
    drawn = np.asarray((depth >= NEAREST_DRAWN).any(axis=1))
    ends, depth = segments[drawn].copy(), depth[drawn]
    for near, far in ((0, 1), (1, 0)):
        behind = depth[:, near] < NEAREST_DRAWN
        share = (NEAREST_DRAWN - depth[behind, far]) / (depth[behind, near] - depth[behind, far])
        start = ends[behind, far]
        ends[behind, near] = start + share[:, None] * (ends[behind, near] - start)
    pixels, _ = camera.project(ends.reshape(-1, 3))
    return pixels.reshape(-1, 2, 2), drawn


def _draw_footprints(
    centers: FloatArray, corners: FloatArray, ax: Axes, colors: Sequence[str], fill: float, how: Mapping[str, Any]
) -> None:
    """Outlines (N, 4, 2), the front corners first, and lines from the centres (N, 2) to the fronts."""
    from matplotlib.collections import LineCollection, PolyCollection
    from matplotlib.colors import to_rgba_array

    faces = to_rgba_array(list(colors))
    faces[:, 3] *= fill
    style = {"linewidths": 1.2, "zorder": 3, **how}
    ax.add_collection(PolyCollection(list(corners), facecolors=faces, edgecolors=list(colors), **style))
    headings = np.stack([centers, corners[:, :2].mean(axis=1)], axis=1)
    ax.add_collection(LineCollection(list(headings), colors=list(colors), **style))


def _moving(boxes: Boxes) -> BoolArray:
    moving: BoolArray = np.linalg.norm(boxes.velocity, axis=1) > 0  # False for NaN, an unknown speed
    return moving


def _write_id(ax: Axes, place: tuple[float, float], actor_id: int, color: str) -> None:
    if actor_id == UNTRACKED_ID:
        return
    words = "own" if actor_id == OWN_ACTOR_ID else str(actor_id)
    write_beside(ax, words, place, color)


def write_beside(ax: Axes, words: str, place: tuple[float, float], color: str) -> None:
    """Write a few words just above a place in data coordinates, readable on any background; not outside the axes."""
    from matplotlib.patheffects import withStroke

    ax.annotate(
        words,
        place,
        xytext=(2, 2),
        textcoords="offset points",
        color=color,
        fontsize=SMALLEST_TEXT,
        annotation_clip=True,
        clip_on=True,
        path_effects=[withStroke(linewidth=2, foreground="white")],
        zorder=6,
    )
