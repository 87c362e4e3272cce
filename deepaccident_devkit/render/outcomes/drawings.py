"""Drawings of tasks (`evaluation.drawing`) from above and in camera images."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.evaluation.drawing import (
    Drawing,
    DrawnAlarm,
    DrawnBoxes,
    DrawnCells,
    DrawnPath,
    Role,
)
from deepaccident_devkit.geometry import BevGrid, Boxes, quaternions
from deepaccident_devkit.geometry.cell_outlines import outlines
from deepaccident_devkit.render.bev import BevView, draw_bev
from deepaccident_devkit.render.boxes import (
    bounds_in_image,
    draw_boxes_from_above,
    draw_boxes_in_image,
    write_beside,
)
from deepaccident_devkit.render.camera import best_view
from deepaccident_devkit.render.captions import box_handles, titled_from_above
from deepaccident_devkit.render.chips import keep_free, keep_line_free, place_chips
from deepaccident_devkit.render.figures import Layer, Layers, square_around
from deepaccident_devkit.render.motion_maps import draw_cells, trail_picture
from deepaccident_devkit.render.outcomes.camera_view import (
    DASHED,
    POST_HEIGHT_M,
    CameraView,
    ground_height,
    view_of,
)
from deepaccident_devkit.render.styles import (
    COLLIDER_COLOR,
    INSTANCE_COLORS,
    MUTED_COLOR,
    OUTCOME_COLORS,
    PREDICTED_COLOR,
    text_size,
)
from deepaccident_devkit.support.arrays import AnyArray, BoolArray, FloatArray
from deepaccident_devkit.taxonomy import CAMERAS, OWN_ACTOR_ID
from deepaccident_devkit.v2x import Agents
from deepaccident_devkit.v2x.poses import camera_of

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

DRAWING_LAYERS: Final[Layers] = (
    "image",
    "bev",
    "boxes",
    "trajectories",
    "labels",
    "ids",
    "grid",
)
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
# Scale of the lines on cells, whose outcome they would hide.
_SCALE_ON_CELLS = 0.5
# Roles of paths in the order in which they are drawn.
_ROLE_ORDER = ("past", "predicted", "false", "missed", "right", "collision", "truth")
_RIBBON_OPACITY = 0.4
_BOX_OPACITY = 0.25
_FILLS: Mapping[Role, float] = {"truth": 0.0}
# Colour of true cells; black areas would hide the paths on them.
_TRUE_CELL_COLOR = INSTANCE_COLORS[0]
# Opacity of cells in camera images and in legends.
_CELL_OPACITY = 0.3
_OUTLINE_WIDTH_PT = 1.6
# Width of the colliding pair's rim around boxes of an outcome, in points.
_RIM_WIDTH_PT = 3.0
# Drawing order of the rim; other boxes are drawn at 3.
_RIM_ORDER = 2.9
# Corners of a box's top, in `Boxes.corners` order.
_TOP_CORNERS = (0, 1, 4, 5)
# Largest number of scores that are written at boxes of one kind.
_MAX_SCORES = 5
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
# Farthest place that the largest view contains together with the agent.
_MAX_PLACE_M = 2 * (_MAX_VIEW_RANGE_M - _VIEW_MARGIN_M)
# Positions nearer than this count as much as at this depth.
_MIN_DEPTH_M = 5.0
_MARK_MARGIN_PT = (-6.0, -6.0, 6.0, 6.0)
# Left, lower edge, width and height of the bar of an alarm's score, as shares of the panel.
_BAR = (0.02, 0.03, 0.3, 0.05)
# Height of the bar and the words above it, in heights of the bar.
_ALARM_LINES = 2.5
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
    shown_layers = layers - {"trajectories", "image", "labels"}
    agents: Agents = None
    has_outcomes = any(boxes.role != "collision" for boxes in drawing.boxes)
    if drawing.cells or has_outcomes:
        shown_layers -= {"boxes"}  # the drawing has shapes of its own
        agents = "single"
    view = BevView(agents=agents, view_range=view_range, center=(x, y), surroundings_shown=True)
    colors_of_actors, _ = draw_bev(dataset, sample, view, shown_layers, ax)
    if "labels" in layers:
        _draw_cells_from_above(drawing.cells, ax)
    if "trajectories" in layers:
        scale = _SCALE_ON_CELLS if drawing.cells else 1.0
        _draw_paths_from_above(_in_drawing_order(drawing), ax, scale)
    if "boxes" in layers:
        for drawn in drawing.boxes:
            boxes = _in_ego_frame(dataset, sample, drawn)
            fill = _fill_opacity(drawn)
            colors = [_edge_color(drawn.role)] * len(boxes)
            style = _line_style(drawn.role, is_rim=has_outcomes)
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
    handles = box_handles(colors_of_actors & {COLLIDER_COLOR})
    handles += drawing_handles(drawing)
    return [*{handle.get_label(): handle for handle in handles}.values()]


def draw_drawing_in_camera(
    dataset: Dataset,
    sample: str,
    drawing: Drawing,
    camera: str,
    ax: Axes,
    *,
    image: bool = True,
    frame: int = 0,
) -> Axes:
    """Render a drawing over an image of a camera (a token); the ground is assumed to be flat.

    Paths and places that labelled boxes hide from the camera are faint. The own box of the camera's
    agent is left out, because the camera is inside it. `frame` is the index of the cells' frame.
    """
    view = view_of(dataset, sample, camera, ax, image=image)
    obstacles = _obstacles(dataset, view)
    for cells in _without_found(drawing.cells):
        _draw_cells_in_camera(cells, frame, view)
    _draw_paths_in_camera(_in_drawing_order(drawing), obstacles, view)
    own_ids = _own_ids(dataset, sample, camera)
    for drawn in drawing.boxes:
        boxes = _in_ego_frame(dataset, sample, drawn)
        _draw_boxes_in_camera(replace(drawn, boxes=boxes), own_ids, view)
    for place in drawing.places:
        color = ROLE_COLORS[place.role]
        tops = view.optical(place.xy, POST_HEIGHT_M)
        for position, is_hidden in zip(place.xy, is_covered(tops, obstacles), strict=True):
            opacity = _HIDDEN_OPACITY if is_hidden else 1.0
            view.draw_lines(list(view.posts(position[None])), color, width=2.0, opacity=opacity)
        if place.note:
            view.write(place.note, place.xy, color)
    if drawing.alarm is not None:
        _draw_alarm(drawing.alarm, ax)
    return ax


def best_camera_of_drawing(dataset: Dataset, sample: str, drawing: Drawing) -> str:
    """Return the token of the image that shows a drawing best.

    For an alarm it is the image, of any agent, that shows the colliding pair best. Otherwise it is
    the one of the sample's agent that shows most of the drawing's positions; near positions count
    more. If no image shows any, it is the front camera's.
    """
    pairs = [drawn for drawn in drawing.boxes if drawn.role == "collision"]
    if drawing.alarm is not None and pairs:
        world_from_ego = dataset.world_from(sample, "ego")
        pair = _in_ego_frame(dataset, sample, pairs[0]).transform(world_from_ego, "world")
        frame_token = dataset.get("sample", sample)["frame_token"]
        samples = [record["token"] for record in dataset.samples_of(frame_token)]
        view = best_view(dataset, samples, pair)
        if view is not None:
            return view.camera
    positions = _shown_positions(drawing)
    heights = np.full(len(positions), ground_height(dataset, sample))
    points = np.column_stack([positions, heights])
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
    """Return a legend's handles, one for each label of something that is drawn."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles: dict[str, Artist] = {}
    for path in drawing.paths:
        color = ROLE_COLORS[path.role]
        if path.width:
            handle: Artist = Patch(facecolor=(color, _RIBBON_OPACITY), edgecolor=color)
        else:
            handle = Line2D([], [], color=color, linewidth=_line_width(path.role))
        handles[path.label] = handle
    for boxes in drawing.boxes:
        if not len(boxes.boxes):
            continue
        color = _edge_color(boxes.role)
        fill = _fill_opacity(boxes)
        handles[boxes.label] = Patch(
            facecolor=(color, fill), edgecolor=color, **_line_style(boxes.role)
        )
    for cells in _without_found(drawing.cells):
        if not cells.instance.any():
            continue
        color = _cell_color(cells.role)
        handle = Patch(facecolor=(color, _CELL_OPACITY), edgecolor=color)
        if cells.role == "missed":
            handle.set(edgecolor=MUTED_COLOR, linestyle=DASHED)
        handles[cells.label] = handle
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
    frame_from_box = quaternions.to_matrix(boxes.rotation)
    start = -(boxes.center[:, None] @ frame_from_box)  # the origin, seen from each box
    directions = points @ frame_from_box
    sides = np.stack([-boxes.size / 2, boxes.size / 2])[:, :, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = (sides - start) / directions
    entry = np.fmax.reduce(shares.min(axis=0), axis=-1)
    leave = np.fmin.reduce(shares.max(axis=0), axis=-1)
    covers = (entry < leave) & (entry > 0) & (entry < _SHARE_BEFORE_POINT)
    return np.asarray(covers.any(axis=0))


def _shown_positions(drawing: Drawing) -> FloatArray:
    """Return the positions (N, 2) that a picture should contain, and the agent's.

    Positions that are too far away from the agent are left out, but marked places are not.
    """
    positions = [np.zeros((1, 2))]
    positions += [path.xy for path in drawing.paths]
    positions += [drawn.boxes.center[:, :2] for drawn in drawing.boxes if drawn.role != "collision"]
    for cells in drawing.cells:
        is_occupied = cells.instance.any(axis=0)
        positions.append(cells.grid.centers()[is_occupied])
    all_positions = np.concatenate(positions)
    is_near = np.abs(all_positions).max(axis=1) <= _MAX_VIEW_RANGE_M - _VIEW_MARGIN_M
    places = [place.xy.clip(-_MAX_PLACE_M, _MAX_PLACE_M) for place in drawing.places]
    near_positions: FloatArray = np.concatenate([all_positions[is_near], *places])
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


def _own_ids(dataset: Dataset, sample: str, camera: str) -> list[int]:
    """Return the ids, in boxes of a sample, of the agent that a camera is on."""
    camera_sample = camera.rsplit("/", 1)[0]
    agent_token = dataset.get("sample", camera_sample)["agent_token"]
    own_ids = [OWN_ACTOR_ID] if camera_sample == sample else []
    actor_id = dataset.get("agent", agent_token)["actor_id"]
    if actor_id is not None:
        own_ids.append(actor_id)
    return own_ids


def _fill_opacity(drawn: DrawnBoxes) -> float:
    """Return the opacity of boxes from above; future boxes are outlines."""
    if drawn.time:
        return 0.0
    return _FILLS.get(drawn.role, _BOX_OPACITY)


def _line_style(role: Role, *, is_rim: bool = False) -> dict[str, Any]:
    """Return the options for the outlines of boxes and cells; missed ones are dashed.

    With `is_rim`, the colliding pair's are wide and below other boxes, which stay visible.
    """
    if role == "missed":
        return {"linestyle": DASHED}
    if is_rim and role == "collision":
        return {"linewidths": _RIM_WIDTH_PT, "zorder": _RIM_ORDER}
    return {}


def _edge_color(role: Role) -> str:
    """Return the colour of outlines from above; missed ones would be too pale on a road."""
    if role == "missed":
        return MUTED_COLOR
    return ROLE_COLORS[role]


def _cell_color(role: Role) -> str:
    if role == "truth":
        return _TRUE_CELL_COLOR
    return ROLE_COLORS[role]


def _draw_cells_from_above(kinds: Sequence[DrawnCells], ax: Axes) -> None:
    """Draw a trail of all kinds of cells; where predictions are drawn, found true cells are not."""
    from matplotlib.collections import LineCollection
    from matplotlib.colors import to_rgb

    shown_kinds = _without_found(kinds)
    if not shown_kinds:
        return
    kind_maps = np.zeros(shown_kinds[0].instance.shape, dtype=np.int64)
    colors = ["white"]
    for number, cells in enumerate(shown_kinds, 1):
        kind_maps[cells.instance > 0] = number
        colors.append(_cell_color(cells.role))
    palette = np.array([to_rgb(color) for color in colors])
    grid = shown_kinds[0].grid
    picture = np.dstack([trail_picture(kind_maps, palette), kind_maps.any(axis=0)])
    draw_cells(ax, picture, grid)
    for cells in shown_kinds:
        if cells.role == "missed":
            lines = instance_outlines(cells.instance.max(axis=0), grid)
            style = {"colors": _edge_color(cells.role), "linestyles": DASHED}
            ax.add_collection(LineCollection(lines, linewidths=1.0, zorder=3, **style))


def _without_found(kinds: Sequence[DrawnCells]) -> list[DrawnCells]:
    """Return the cells without the found true ones, where predicted cells lie on them."""
    has_predictions = any(cells.role not in ("truth", "missed") for cells in kinds)
    return [cells for cells in kinds if cells.role != "truth" or not has_predictions]


def _draw_cells_in_camera(cells: DrawnCells, frame: int, view: CameraView) -> None:
    """Draw the cells of a frame on the ground; missed ones are only outlined."""
    color = _cell_color(cells.role)
    is_missed = cells.role == "missed"
    areas = view.on_ground(instance_outlines(cells.instance[frame], cells.grid))
    if not is_missed:
        view.fill(areas, color, opacity=_CELL_OPACITY)
    view.draw_lines(areas, color, width=_OUTLINE_WIDTH_PT, dashed=is_missed)


def instance_outlines(instance: AnyArray, grid: BevGrid) -> list[FloatArray]:
    """Return closed lines (P, 2), metres in the ego frame, around instances in a map (H, W).

    Holes are not outlined.
    """
    low, _, cell_size = np.array([grid.x, grid.y]).T
    lines = []
    for instance_id in np.unique(instance[instance > 0]).tolist():
        rows, columns = np.nonzero(instance == instance_id)
        first_row, first_column = rows.min(), columns.min()
        part = instance[first_row : rows.max() + 1, first_column : columns.max() + 1]
        first_cell = np.array([first_column, first_row], dtype=np.float64)
        for polygon in outlines(part == instance_id, first_cell, 1.0).geoms:
            corners = np.asarray(polygon.exterior.coords)
            lines.append(low + corners * cell_size)
    return lines


def _draw_boxes_in_camera(drawn: DrawnBoxes, own_ids: Sequence[int], view: CameraView) -> None:
    """Draw boxes in the ego frame, the nearest on top, with the highest scores.

    Words do not cover the colliding pair.
    """
    channel = view.camera.rsplit("/", 1)[1]
    boxes = drawn.boxes.transform(view.optical_from_ego, channel)
    is_other = ~np.isin(boxes.actor_id, own_ids)
    order = np.argsort(-boxes.center[:, 2], kind="stable")
    rows = order[is_other[order]]
    color = ROLE_COLORS[drawn.role]
    colors = [color] * len(rows)
    shown_boxes = boxes.select(rows)
    in_image = draw_boxes_in_image(
        shown_boxes, view.lens, view.ax, colors, **_line_style(drawn.role)
    )
    if drawn.role == "collision" and not drawn.time:
        bounds = bounds_in_image(shown_boxes.select(in_image), view.lens)
        keep_free(view.ax, bounds.reshape(-1, 2, 2))
    if drawn.scores is None or (drawn.scores == 1).all():
        return
    rows = rows[in_image]
    surest_rows = rows[np.argsort(-drawn.scores[rows], kind="stable")][:_MAX_SCORES]
    tops = boxes.select(surest_rows).corners()[:, _TOP_CORNERS].mean(axis=1)
    pixels, depth = view.lens.project(tops)
    is_shown = view.lens.in_image(pixels, depth)
    shown_scores = drawn.scores[surest_rows[is_shown]].tolist()
    chips = [
        (f"{score:.2f}", pixel) for score, pixel in zip(shown_scores, pixels[is_shown], strict=True)
    ]
    place_chips(view.ax, chips, colors=[color] * len(chips))


def _draw_paths_from_above(paths: Sequence[DrawnPath], ax: Axes, scale: float) -> None:
    """Draw paths; `scale` multiplies the widths of their lines."""
    from matplotlib.collections import LineCollection
    from matplotlib.colors import to_rgba

    colors = []
    widths = []
    for path in paths:
        color = ROLE_COLORS[path.role]
        opacity = path_opacity(path)
        if path.width and len(path.xy) > 1:
            outline = ribbon(path.xy, path.width)
            ax.fill(*outline.T, color=color, alpha=_RIBBON_OPACITY * opacity, linewidth=0, zorder=3)
        colors.append(to_rgba(color, opacity))
        widths.append(scale * _line_width(path.role))
    lines = LineCollection([path.xy for path in paths], colors=colors, linewidths=widths, zorder=4)
    ax.add_collection(lines, autolim=False)


def _draw_paths_in_camera(paths: Sequence[DrawnPath], obstacles: Boxes, view: CameraView) -> None:
    """Draw paths; pieces of the same look are drawn together, since each drawing takes time."""
    pieces_by_look: dict[tuple[Role, float], list[FloatArray]] = {}
    for path in paths:
        for piece, is_hidden in _pieces(path.xy, obstacles, view):
            opacity = path_opacity(path)
            if is_hidden:
                opacity *= _HIDDEN_OPACITY
            if path.width:
                areas = view.on_ground([ribbon(piece, path.width)])
                view.fill(areas, ROLE_COLORS[path.role], opacity=_RIBBON_OPACITY * opacity)
            pieces_by_look.setdefault((path.role, opacity), []).append(piece)
    for (role, opacity), pieces in pieces_by_look.items():
        lines = view.on_ground(pieces)
        view.draw_lines(lines, ROLE_COLORS[role], width=_line_width(role), opacity=opacity)


def _line_width(role: Role) -> float:
    """Return the width of a path's line, in points."""
    return _LINE_WIDTHS_PT.get(role, _PREDICTED_WIDTH_PT)


def _pieces(
    path: FloatArray, obstacles: Boxes, view: CameraView
) -> Iterator[tuple[FloatArray, bool]]:
    """Divide a path (T, 2) where it begins or ceases to be hidden; all its positions remain.

    Yield each part, and whether it is hidden. A path behind the camera has no parts.
    """
    lengths = np.linalg.norm(np.diff(path, axis=0), axis=1)
    counts = np.maximum(np.ceil(lengths / _MAX_PIECE_M), 1).astype(np.int64)
    corners = np.concatenate([[0], np.cumsum(counts)])
    rows = np.arange(corners[-1] + 1)
    dense_path = np.column_stack([np.interp(rows, corners, column) for column in path.T])
    middles = view.optical((dense_path[:-1] + dense_path[1:]) / 2)
    if not (middles[:, 2] > 0).any():
        return
    hidden = is_covered(middles, obstacles)
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
    corners = np.array([(0.0, 0.0), (left + width, low + _ALARM_LINES * height)])
    keep_free(ax, [ax.transData.inverted().transform(ax.transAxes.transform(corners))])
    color = COLLIDER_COLOR if alarm.fires else "black"
    options: dict[str, Any] = {"transform": ax.transAxes, "zorder": 7}
    bar = Rectangle((left, low), width, height, facecolor="white", edgecolor="black", **options)
    ax.add_patch(bar)
    score_width = width * float(np.clip(alarm.score, 0.0, 1.0))
    ax.add_patch(Rectangle((left, low), score_width, height, facecolor=color, **options))
    ax.text(
        left,
        low + height * 1.4,
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
