"""Drawings of tasks (`evaluation.drawing`) from above and in camera images."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.evaluation.drawing import Drawing, DrawnAlarm, DrawnBoxes, DrawnPath, Role
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.render.bev import BevView, draw_bev
from deepaccident_devkit.render.boxes import (
    draw_boxes_from_above,
    draw_boxes_in_image,
    write_beside,
)
from deepaccident_devkit.render.captions import titled_from_above
from deepaccident_devkit.render.chips import keep_line_free
from deepaccident_devkit.render.figures import Layer, Layers, square_around
from deepaccident_devkit.render.outcomes.above import DASHED
from deepaccident_devkit.render.outcomes.camera_view import CameraView, view_of
from deepaccident_devkit.render.styles import (
    COLLIDER_COLOR,
    OUTCOME_COLORS,
    PREDICTED_COLOR,
    text_size,
)
from deepaccident_devkit.support.arrays import BoolArray, FloatArray
from deepaccident_devkit.taxonomy import CAMERAS, OWN_ACTOR_ID
from deepaccident_devkit.v2x.poses import camera_of

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

DRAWING_LAYERS: Final[Layers] = ("image", "bev", "boxes", "trajectories", "ids", "grid")
ROLE_COLORS: Final[Mapping[Role, str]] = {
    "truth": "black",
    "past": "#63717e",
    "predicted": PREDICTED_COLOR,
    "right": OUTCOME_COLORS["right"],
    "false": OUTCOME_COLORS["false"],
    "missed": OUTCOME_COLORS["missed"],
    "collision": COLLIDER_COLOR,
}
_LINE_WIDTHS_PT: Mapping[Role, float] = {"past": 0.8, "truth": 1.0}
_PREDICTED_WIDTH_PT = 2.4
# Roles of paths in the order in which they are drawn.
_ROLE_ORDER = ("past", "predicted", "false", "missed", "right", "collision", "truth")
_RIBBON_OPACITY = 0.4
_BOX_OPACITY = 0.25
_FILLS: Mapping[Role, float] = {"truth": 0.0}
# Opacity of the least probable path, and of what labelled boxes hide.
_MIN_OPACITY = 0.2
_HIDDEN_OPACITY = 0.25
# Paths in images are divided into pieces of at most this length, metres, to find hidden ones.
_MAX_PIECE_M = 0.5
# A point on the far side of a box is hidden; a point within this share of the way to it is not.
_SHARE_BEFORE_POINT = 0.98
_MIN_VIEW_RANGE_M = 15.0
_MAX_VIEW_RANGE_M = 60.0
_VIEW_MARGIN_M = 8.0
# Positions nearer than this count as much as at this depth.
_MIN_DEPTH_M = 5.0
_MARK_MARGIN_PT = (-6.0, -6.0, 6.0, 6.0)
# Left, lower edge, width and height of the bar of an alarm's score, as shares of the panel.
_BAR = (0.02, 0.03, 0.3, 0.05)
_BORDER_WIDTH_PT = 4.0


def draw_drawing_from_above(
    dataset: Dataset,
    sample: str,
    drawing: Drawing,
    layers: frozenset[Layer],
    ax: Axes,
    *,
    shown: Drawing | None = None,
) -> list[Artist]:
    """Render a drawing on the road with the actors around it, and return handles for a legend.

    Args:
        dataset: The release.
        sample: Token of the sample.
        drawing: What is drawn.
        layers: Any of `DRAWING_LAYERS` without `image`.
        ax: Axes, in metres in the current ego frame.
        shown: Drawing whose positions the axes contain; None for the drawing itself.
    """
    center, half = square_around(_shown_positions(shown or drawing), _VIEW_MARGIN_M)
    x, y = center.tolist()
    view_range = float(np.clip(half, _MIN_VIEW_RANGE_M, _MAX_VIEW_RANGE_M))
    view = BevView(agents=None, view_range=view_range, center=(x, y), surroundings_shown=True)
    shown_layers = layers - {"trajectories", "image"}
    if any(boxes.role != "collision" for boxes in drawing.boxes):
        shown_layers -= {"boxes"}  # the drawing has boxes of its own
    draw_bev(dataset, sample, view, shown_layers, ax)
    if "trajectories" in layers:
        for path in _in_drawing_order(drawing):
            _draw_path_from_above(path, ax)
    if "boxes" in layers:
        for drawn in drawing.boxes:
            boxes = _in_ego_frame(dataset, sample, drawn)
            style: dict[str, Any] = {"linestyle": DASHED} if drawn.role == "missed" else {}
            fill = _FILLS.get(drawn.role, _BOX_OPACITY)
            colors = [ROLE_COLORS[drawn.role]] * len(boxes)
            draw_boxes_from_above(boxes, ax, colors, fill=fill, **style)
    for place in drawing.places:
        color = ROLE_COLORS[place.role]
        marker: dict[str, Any] = _marker_of(place.role)
        ax.plot(*place.xy.T, color=color, linestyle="none", zorder=6, **marker)
        keep_line_free(ax, place.xy, margin=_MARK_MARGIN_PT)
        if place.note:
            x, y = place.xy.mean(axis=0).tolist()
            write_beside(ax, place.note, (x, y), color)
    if drawing.alarm is not None:
        _draw_alarm(drawing.alarm, ax)
    titled_from_above(ax, "", grid="grid" in layers)
    return drawing_handles(drawing)


def draw_drawing_in_camera(
    dataset: Dataset, sample: str, drawing: Drawing, camera: str, ax: Axes, *, image: bool = True
) -> Axes:
    """Render a drawing over an image of a camera (a token); the ground is assumed to be flat.

    What labelled boxes hide from the camera is faint.
    """
    view = view_of(dataset, sample, camera, ax, image=image)
    obstacles = _obstacles(dataset, view)
    for path in _in_drawing_order(drawing):
        _draw_path_in_camera(path, obstacles, view)
    optical_from_ego = view.optical_from_ego
    channel = camera.rsplit("/", 1)[1]
    for drawn in drawing.boxes:
        boxes = _in_ego_frame(dataset, sample, drawn).transform(optical_from_ego, channel)
        is_other = boxes.actor_id != OWN_ACTOR_ID
        order = np.argsort(-boxes.center[:, 2], kind="stable")
        rows = order[is_other[order]]
        colors = [ROLE_COLORS[drawn.role]] * len(rows)
        style: dict[str, Any] = {"linestyle": DASHED} if drawn.role == "missed" else {}
        draw_boxes_in_image(boxes.select(rows), view.lens, ax, colors, **style)
    for place in drawing.places:
        color = ROLE_COLORS[place.role]
        posts = list(view.posts(place.xy))
        view.draw_lines(posts, color, width=2.0)
        if place.note:
            view.write(place.note, place.xy, color)
    if drawing.alarm is not None:
        _draw_alarm(drawing.alarm, ax)
    return ax


def best_camera_of_drawing(dataset: Dataset, sample: str, drawing: Drawing) -> str:
    """Return the token of the agent's image that shows most of a drawing's positions.

    Near positions count more. If no image shows any, it is the front camera's.
    """
    positions = _shown_positions(drawing)
    points = np.column_stack([positions, np.zeros(len(positions))])
    weights = {}
    for channel in sorted(CAMERAS, key=lambda name: name != "Camera_Front"):
        camera = f"{sample}/{channel}"
        optical_from_world = dataset.world_from(sample, channel).inverse()
        optical_from_ego = optical_from_world @ dataset.world_from(sample, "ego")
        lens = camera_of(dataset, camera)
        pixels, depth = lens.project(optical_from_ego.apply(points))
        depths = depth[lens.in_image(pixels, depth)]
        weights[camera] = float((1 / depths.clip(_MIN_DEPTH_M)).sum())  # near ones are large
    return max(weights, key=lambda camera: weights[camera])


def drawing_handles(drawing: Drawing) -> list[Artist]:
    """Return a legend's handles, one for each label."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles: dict[str, Artist] = {}
    for path in drawing.paths:
        color = ROLE_COLORS[path.role]
        if path.width:
            handle: Artist = Patch(facecolor=(color, _RIBBON_OPACITY), edgecolor=color)
        else:
            width = _LINE_WIDTHS_PT.get(path.role, _PREDICTED_WIDTH_PT)
            handle = Line2D([], [], color=color, linewidth=width)
        handles[path.label] = handle
    for boxes in drawing.boxes:
        color = ROLE_COLORS[boxes.role]
        fill = _FILLS.get(boxes.role, _BOX_OPACITY)
        handles[boxes.label] = Patch(facecolor=(color, fill), edgecolor=color)
    for place in drawing.places:
        color = ROLE_COLORS[place.role]
        marker: dict[str, Any] = _marker_of(place.role)
        handles[place.label] = Line2D([], [], linestyle="none", color=color, **marker)
    handles.pop("", None)
    for label, handle in handles.items():
        handle.set_label(label)
    return [*handles.values()]


def ribbon(path: FloatArray, width: float) -> FloatArray:
    """Return the closed outline, shape (2 T + 1, 2), of a band around a path (T, 2), metres."""
    steps = np.gradient(path, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    is_moving = lengths > 0
    headings = np.arctan2(steps[:, 1], steps[:, 0])
    if is_moving.any():
        rows = np.arange(len(path))
        headings = headings[is_moving][
            np.searchsorted(rows[is_moving], rows).clip(0, is_moving.sum() - 1)
        ]
    to_left = np.column_stack([-np.sin(headings), np.cos(headings)]) * (width / 2)
    return np.concatenate([path + to_left, (path - to_left)[::-1], path[:1] + to_left[:1]])


def path_opacity(path: DrawnPath) -> float:
    """Return the opacity of a path by its probability."""
    return _MIN_OPACITY + (1 - _MIN_OPACITY) * min(path.probability, 1.0)


def is_covered(points: FloatArray, boxes: Boxes) -> BoolArray:
    """Find the points that boxes hide from the origin, shape (N,).

    Args:
        points: (N, 3) points in the frame of the boxes, such as an optical frame.
        boxes: Boxes that hide what is behind them.
    """
    covered = np.zeros(len(points), dtype=bool)
    for box in boxes:
        box_from_frame = box.rotation_matrix.T
        start = box_from_frame @ -box.center
        directions = points @ box_from_frame.T
        with np.errstate(divide="ignore", invalid="ignore"):
            shares = (np.array([[-0.5], [0.5]]) * box.size - start)[:, None] / directions
        entry = np.fmax.reduce(shares.min(axis=0), axis=1)
        leave = np.fmin.reduce(shares.max(axis=0), axis=1)
        covered |= (entry < leave) & (entry > 0) & (entry < _SHARE_BEFORE_POINT)
    return covered


def _shown_positions(drawing: Drawing) -> FloatArray:
    """Return the positions (N, 2) that a picture should contain, and the agent's.

    Positions that are too far away from the agent are left out.
    """
    positions = [np.zeros((1, 2))]
    positions += [path.xy for path in drawing.paths]
    positions += [place.xy for place in drawing.places]
    positions += [drawn.boxes.center[:, :2] for drawn in drawing.boxes if drawn.role != "collision"]
    all_positions = np.concatenate(positions)
    is_near = np.abs(all_positions).max(axis=1) <= _MAX_VIEW_RANGE_M - _VIEW_MARGIN_M
    near_positions: FloatArray = all_positions[is_near]
    return near_positions


def _in_drawing_order(drawing: Drawing) -> list[DrawnPath]:
    """Return the paths so that the important ones are drawn over the others."""
    return sorted(drawing.paths, key=lambda path: (_ROLE_ORDER.index(path.role), path.probability))


def _in_ego_frame(dataset: Dataset, sample: str, drawn: DrawnBoxes) -> Boxes:
    if drawn.boxes.frame == "ego":
        return drawn.boxes
    ego_from_world = dataset.world_from(sample, "ego").inverse()
    ego_from_boxes = ego_from_world @ dataset.world_from(sample, drawn.boxes.frame)
    return drawn.boxes.transform(ego_from_boxes, "ego")


def _obstacles(dataset: Dataset, view: CameraView) -> Boxes:
    """Return the labelled boxes of a camera's sample, except the agent's own, in optical axes."""
    sample, channel = view.camera.rsplit("/", 1)
    boxes = dataset.boxes(sample, channel)
    return boxes.select(boxes.actor_id != OWN_ACTOR_ID)


def _draw_path_from_above(path: DrawnPath, ax: Axes) -> None:
    color = ROLE_COLORS[path.role]
    opacity = path_opacity(path)
    if path.width and len(path.xy) > 1:
        outline = ribbon(path.xy, path.width)
        ax.fill(*outline.T, color=color, alpha=_RIBBON_OPACITY * opacity, linewidth=0, zorder=3)
    width = _LINE_WIDTHS_PT.get(path.role, _PREDICTED_WIDTH_PT)
    ax.plot(*path.xy.T, color=color, alpha=opacity, linewidth=width, zorder=4)


def _draw_path_in_camera(path: DrawnPath, obstacles: Boxes, view: CameraView) -> None:
    from matplotlib.collections import PolyCollection

    color = ROLE_COLORS[path.role]
    width = _LINE_WIDTHS_PT.get(path.role, _PREDICTED_WIDTH_PT)
    for piece, is_hidden in _pieces(path.xy, obstacles, view):
        opacity = path_opacity(path)
        if is_hidden:
            opacity *= _HIDDEN_OPACITY
        if path.width:
            areas = view.on_ground([ribbon(piece, path.width)])
            polygons = PolyCollection(
                areas, facecolors=color, alpha=_RIBBON_OPACITY * opacity, edgecolors="none"
            )
            view.ax.add_collection(polygons, autolim=False)
        view.draw_lines(view.on_ground([piece]), color, width=width, opacity=opacity)


def _pieces(
    path: FloatArray, obstacles: Boxes, view: CameraView
) -> Iterator[tuple[FloatArray, bool]]:
    """Divide a path (T, 2) where it begins or ceases to be hidden; all its positions remain.

    Yield each part, and whether it is hidden.
    """
    dense_parts = [path[:1]]
    for start, end in pairwise(path):
        count = max(int(np.ceil(np.linalg.norm(end - start) / _MAX_PIECE_M)), 1)
        dense_parts.append(np.linspace(start, end, count + 1)[1:])
    dense_path = np.concatenate(dense_parts)
    if len(dense_path) < 2:
        return
    middles = (dense_path[:-1] + dense_path[1:]) / 2
    hidden = is_covered(view.optical(middles), obstacles)
    changes = np.flatnonzero(np.diff(hidden)) + 1
    bounds = [0, *changes.tolist(), len(hidden)]
    for start, end in pairwise(bounds):
        yield dense_path[start : end + 1], bool(hidden[start])


def _marker_of(role: Role) -> dict[str, Any]:
    """Return the marker of positions: rings for true collisions, crosses for predicted ones."""
    if role == "collision":
        return {"marker": "o", "markersize": 11, "fillstyle": "none", "markeredgewidth": 1.8}
    return {"marker": "x", "markersize": 9, "markeredgewidth": 2.0}


def _draw_alarm(alarm: DrawnAlarm, ax: Axes) -> None:
    """Draw a bar of an alarm's score in the corner and, if it fires, a border of the panel."""
    from matplotlib.patches import Rectangle

    left, low, width, height = _BAR
    color = COLLIDER_COLOR if alarm.fires else "black"
    options: dict[str, Any] = {"transform": ax.transAxes, "zorder": 7}
    bar = Rectangle((left, low), width, height, facecolor="white", edgecolor="black", **options)
    ax.add_patch(bar)
    score_width = width * float(np.clip(alarm.score, 0.0, 1.0))
    ax.add_patch(Rectangle((left, low), score_width, height, facecolor=color, **options))
    ax.text(
        left,
        low + height * 1.2,
        f"alarm {alarm.score:.2f}",
        fontsize=text_size(),
        transform=ax.transAxes,
        zorder=8,
        bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.0, "alpha": 0.8},
    )
    if alarm.fires:
        border = Rectangle(
            (0, 0),
            1,
            1,
            fill=False,
            edgecolor=COLLIDER_COLOR,
            linewidth=_BORDER_WIDTH_PT,
            **options,
        )
        ax.add_patch(border)
