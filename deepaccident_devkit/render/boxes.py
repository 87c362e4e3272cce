"""Boxes from above and in camera images, their trails, and the colours of their actors' roles."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.geometry import SE3, Box, Boxes, PinholeCamera
from deepaccident_devkit.render.chips import keep_free, place_chips
from deepaccident_devkit.render.figures import Layer
from deepaccident_devkit.render.styles import (
    AGENT_COLORS,
    CASING_COLOR,
    CATEGORY_MARKERS,
    COLLIDER_COLOR,
    OWN_COLOR,
    category_colors,
    current_style,
    in_own_settings,
    text_size,
)
from deepaccident_devkit.support.arrays import BoolArray, FloatArray, IntArray
from deepaccident_devkit.support.values import NamedValues, ReadOnlyValues
from deepaccident_devkit.tables.tokens import sample_token
from deepaccident_devkit.taxonomy import (
    AGENTS,
    FRAME_PERIOD,
    OWN_ACTOR_ID,
    UNTRACKED_ID,
    AgentName,
    short_name,
)
from deepaccident_devkit.v2x import Contact
from deepaccident_devkit.v2x.agents import agents_of
from deepaccident_devkit.v2x.tracks import ScenarioTracks, scenario_tracks

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import LineCollection
    from matplotlib.patches import PathPatch

# The twelve edges of a box between its corners, in `Box.corners` order; the first four are the
# front.
EDGES = (
    (0, 1),
    (1, 2),
    (2, 3),
    (3, 0),
    (4, 5),
    (5, 6),
    (6, 7),
    (7, 4),
    (0, 4),
    (1, 5),
    (2, 6),
    (3, 7),
)
# Radius of the mark for a small actor, seen from above, metres; it is about as wide as a car.
_MARK_RADIUS_M = 1.0
# Minimum radius of a mark, points, so that it is visible in a view of a whole town.
_MIN_MARK_RADIUS_PT = 2.0
# Arrows in data coordinates.
ARROW_STYLE: Final[ReadOnlyValues] = {
    "angles": "xy",
    "scale_units": "xy",
    "scale": 1,
    "width": 0.004,
    "zorder": 4,
}
# Number of corners of each mark, by matplotlib marker name.
_MARK_CORNERS = {"o": 16, "D": 4, "^": 3}
# Length of the arrow in a corner that shows the scale of the arrows, in metres per second.
_KEY_SPEED_MPS = 10
# Width of an edge in an image, and how much wider its casing is, in points.
_EDGE_WIDTH_PT = 1.2
_CASING_WIDTH_PT = 1.2
# Metres in front of the camera at which edges are cut off.
NEAR_PLANE_M = 0.1
# Opacity of the end of a trail.
_MIN_TRAIL_OPACITY = 0.1
# Minimum number of metres that an actor must move to have a trail.
_MIN_TRAIL_LENGTH_M = 0.5


@in_own_settings
def draw_box(box: Box, ax: Axes, color: str | None = None) -> Axes:
    """Render one box from above, in its own frame's x and y, metres, with a line to its front.

    Raises:
        GeometryError: `box` is not a `Box`; for example, the axes were passed first.
    """
    if not isinstance(box, Box):
        raise GeometryError(
            f"box: expected a Box, found {type(box).__name__}; pass the box first, then the "
            "axes: draw_box(box, ax)"
        )
    colors = [color or category_colors()[box.category]]
    center = box.center[None, :2]
    corners = box.bottom_corners().T[None, :, :2]
    _draw_footprints(center, corners, ax, colors, 0.25, {})
    return ax


def draw_boxes_from_above(
    boxes: Boxes, ax: Axes, colors: Sequence[str], *, fill: float = 0.25, **style: Any
) -> None:
    """Render boxes in x and y of their (level) frame, metres, each with a line to its front.

    `colors` has one colour for each box, and `fill` is the opacity of the filled areas.
    Pedestrians, cyclists and motorcycles also have their class's mark, which is about as wide as a
    car. `style` holds matplotlib options for the outlines, such as `linestyle`.
    """
    centers = boxes.center[:, :2]
    corners = boxes.bottom_corners()[..., :2]
    _draw_footprints(centers, corners, ax, colors, fill, style)
    _draw_small_actors(boxes, ax, colors, filled=fill > 0)


def draw_ids_from_above(boxes: Boxes, ax: Axes, colors: Sequence[str]) -> None:
    """Write the label ids of tracked boxes next to them; the recording agent's is `own`."""
    centers = boxes.center[:, :2]
    _write_ids(centers, boxes.actor_id, ax, colors)


def draw_velocities_from_above(boxes: Boxes, ax: Axes, colors: Sequence[str]) -> None:
    """Render an arrow from each moving box to where it will be in 1 s, and a key for the scale.

    Boxes with unknown velocities have no arrow.
    """
    rows = np.flatnonzero(_is_moving(boxes))
    if not len(rows):
        return
    x, y = boxes.center[rows, :2].T
    velocity_x, velocity_y = boxes.velocity[rows, :2].T
    arrow_colors = [colors[row] for row in rows.tolist()]
    arrows = ax.quiver(x, y, velocity_x, velocity_y, color=arrow_colors, **ARROW_STYLE)
    key = ax.quiverkey(
        arrows,
        0.85,
        0.03,
        _KEY_SPEED_MPS,
        f"{_KEY_SPEED_MPS} m/s",
        color=OWN_COLOR,
        fontproperties={"size": text_size()},
    )
    key.text.set_bbox({"facecolor": CASING_COLOR, "edgecolor": "none", "pad": 1.5})


def draw_actors_from_above(
    boxes: Boxes, ax: Axes, colors: Sequence[str], layers: Collection[Layer]
) -> None:
    """Render the layers among `boxes`, `velocities` and `ids` that are requested."""
    if "boxes" in layers:
        draw_boxes_from_above(boxes, ax, colors)
    if "velocities" in layers:
        draw_velocities_from_above(boxes, ax, colors)
    if "ids" in layers:
        draw_ids_from_above(boxes, ax, colors)


def draw_boxes_in_image(
    boxes: Boxes, camera: PinholeCamera, ax: Axes, colors: Sequence[str], **style: Any
) -> BoolArray:
    """Render the edges of N boxes (in the camera's optical frame), and fill large ones' fronts.

    Edges have a white casing. Parts that are not in front of the camera are cut off. `style` holds
    matplotlib options for the edges, such as `linestyle`. Returns whether any part of each box is
    in the image, shape (N,).
    """
    from matplotlib.collections import LineCollection, PolyCollection
    from matplotlib.colors import to_rgba_array

    pixels, row, edge = _edges_in_image(boxes, camera)
    rgba = to_rgba_array(list(colors))
    if len(row):
        ax.add_artist(_casing(pixels))
        line_style = {"colors": rgba[row], "linewidths": _EDGE_WIDTH_PT, **style}
        lines = LineCollection(list(pixels), **line_style)
        ax.add_collection(lines, autolim=False)  # the image has set the limits
        # a filled front would hide a small actor
        rgba[:, 3] = [0 if name in CATEGORY_MARKERS else 0.25 for name in boxes.category_names]
        is_front = edge < 4
        rows, first_edges = np.unique(row[is_front], return_index=True)
        faces: list[FloatArray] = []
        if len(rows):
            # the ends of the cut edges, in order around the face, are the corners of the cut face
            corners = pixels[is_front].reshape(-1, 2)
            faces = np.split(corners, 2 * first_edges[1:])
        fronts = PolyCollection(faces, facecolors=rgba[rows], edgecolors="none")
        ax.add_collection(fronts, autolim=False)
    bounds = _bounds(pixels, row, len(boxes), camera)
    return np.asarray((bounds[:, 2:] > bounds[:, :2]).all(axis=1))


def _casing(pixels: FloatArray) -> PathPatch:
    """Return a white casing for edges (V, 2, 2), pixels, which are hard to see on dark asphalt.

    All lines are one shape, because that is fastest to render.
    """
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    codes = np.tile(np.array([Path.MOVETO, Path.LINETO], dtype=Path.code_type), len(pixels))
    vertices = pixels.reshape(-1, 2)
    path = Path(vertices, codes)
    width = _EDGE_WIDTH_PT + _CASING_WIDTH_PT
    return PathPatch(path, fill=False, edgecolor=CASING_COLOR, alpha=0.5, linewidth=width)


def bounds_in_image(boxes: Boxes, camera: PinholeCamera) -> FloatArray:
    """Return left, top, right and bottom of each box in the image, shape (N, 4), pixels.

    Boxes without a part in the image have no area.
    """
    pixels, row, _ = _edges_in_image(boxes, camera)
    return _bounds(pixels, row, len(boxes), camera)


def _bounds(pixels: FloatArray, row: IntArray, count: int, camera: PinholeCamera) -> FloatArray:
    """Return the bounds (count, 4) of boxes from edges (V, 2, 2), pixels, of the boxes `row` (V,).

    Boxes without an edge in the image have no area.
    """
    bounds = np.zeros((count, 4))
    if len(row):
        rows, first_edges = np.unique(row, return_index=True)
        left_top = pixels.min(axis=1)
        right_bottom = pixels.max(axis=1)
        bounds[rows, :2] = np.minimum.reduceat(left_top, first_edges)
        bounds[rows, 2:] = np.maximum.reduceat(right_bottom, first_edges)
    size = (camera.width, camera.height)
    return bounds.clip(0, size * 2)


def _edges_in_image(boxes: Boxes, camera: PinholeCamera) -> tuple[FloatArray, IntArray, IntArray]:
    """Return the V edges of boxes that are in front of the camera, shape (V, 2, 2), pixels.

    Also return the row of the box that each edge belongs to, shape (V,), and the edge's index in
    `EDGES`, shape (V,).
    """
    edges = boxes.corners()[:, EDGES].reshape(-1, 2, 3)
    pixels, is_drawn = segments_in_image(edges, camera)
    edge_numbers = np.flatnonzero(is_drawn)
    row, edge = np.divmod(edge_numbers, len(EDGES))
    return pixels, row, edge


def draw_ids_in_image(boxes: Boxes, camera: PinholeCamera, ax: Axes, colors: Sequence[str]) -> None:
    """Write the ids of tracked boxes (in the camera's optical frame) above them.

    A box whose top is outside the image has no id.
    """
    top_corners = boxes.corners()[:, (0, 1, 4, 5)]
    pixels, depth = camera.project(top_corners.mean(axis=1))
    in_image = camera.in_image(pixels, depth, min_depth=NEAR_PLANE_M)
    rows = np.flatnonzero(in_image)
    row_colors = [colors[row] for row in rows.tolist()]
    _write_ids(pixels[rows], boxes.actor_id[rows], ax, row_colors)


def draw_velocities_in_image(
    boxes: Boxes, camera: PinholeCamera, ax: Axes, colors: Sequence[str]
) -> None:
    """Draw a line from each moving box's centre to where it will be in 1 s.

    Boxes are in the camera's optical frame. `colors` has one colour per box, including boxes that
    stand still.
    """
    from matplotlib.collections import LineCollection
    from matplotlib.colors import to_rgba_array

    moving = _is_moving(boxes)
    starts = boxes.center[moving]
    ends = starts + boxes.velocity[moving]
    pixels, is_drawn = segments_in_image(np.stack([starts, ends], axis=1), camera)
    rgba = to_rgba_array(list(colors))[moving][is_drawn]
    lines = LineCollection(list(pixels), colors=rgba, linewidths=2, linestyles=(0, (2, 1)))
    ax.add_collection(lines)


def segments_in_image(segments: FloatArray, camera: PinholeCamera) -> tuple[FloatArray, BoolArray]:
    """Project segments (S, 2, 3) in the optical frame to pixels (V, 2, 2).

    Parts nearer than `NEAR_PLANE_M`, or behind the camera, are cut off. The second array, shape
    (S,), marks for each segment whether any part of it remains.
    """
    is_drawn = np.asarray((segments[..., 2] >= NEAR_PLANE_M).any(axis=1))
    ends = segments[is_drawn]
    depth = ends[..., 2].copy()
    for end, opposite in ((0, 1), (1, 0)):
        is_cut = depth[:, end] < NEAR_PLANE_M
        opposite_depth = depth[is_cut, opposite]
        share = (NEAR_PLANE_M - opposite_depth) / (depth[is_cut, end] - opposite_depth)
        opposite_end = ends[is_cut, opposite]
        offset = ends[is_cut, end] - opposite_end
        ends[is_cut, end] = opposite_end + share[:, None] * offset
    pixels, _ = camera.project(ends.reshape(-1, 3))
    return pixels.reshape(-1, 2, 2), is_drawn


def _draw_footprints(
    centers: FloatArray,
    corners: FloatArray,
    ax: Axes,
    colors: Sequence[str],
    fill: float,
    style: ReadOnlyValues,
) -> None:
    """Draw outlines of boxes, and lines from their centres to their fronts.

    Args:
        centers: Centres, shape (N, 2), metres.
        corners: Corners, shape (N, 4, 2), metres, front corners first.
        ax: Axes to draw on.
        colors: One colour for each box.
        fill: Opacity of the filled areas.
        style: Options for the outlines, as for a matplotlib collection.
    """
    from matplotlib.collections import LineCollection, PolyCollection
    from matplotlib.colors import to_rgba_array

    edge_colors = list(colors)
    rgba = to_rgba_array(edge_colors)
    rgba[:, 3] *= fill
    options = {"linewidths": 1.2, "zorder": 3, **style}
    outlines = PolyCollection(list(corners), facecolors=rgba, edgecolors=edge_colors, **options)
    ax.add_collection(outlines)
    keep_free(ax, corners)
    fronts = corners[:, :2].mean(axis=1)
    headings = np.stack([centers, fronts], axis=1)
    ax.add_collection(LineCollection(list(headings), colors=edge_colors, **options))


def _draw_small_actors(boxes: Boxes, ax: Axes, colors: Sequence[str], *, filled: bool) -> None:
    """Draw marks, about as wide as a car, for actors whose boxes are too small to notice."""
    from matplotlib.collections import PolyCollection

    metres_per_point = float(np.ptp(ax.get_xlim())) / ax.bbox.width * ax.figure.dpi / 72
    radius = max(_MARK_RADIUS_M, _MIN_MARK_RADIUS_PT * metres_per_point)
    marks = []
    mark_colors = []
    for row, name in enumerate(boxes.category_names):
        if name not in CATEGORY_MARKERS:
            continue
        corner_count = _MARK_CORNERS[CATEGORY_MARKERS[name]]
        angle = np.pi / 2 + 2 * np.pi * np.arange(corner_count) / corner_count
        circle = np.column_stack([np.cos(angle), np.sin(angle)])
        marks.append(boxes.center[row, :2] + radius * circle)
        mark_colors.append(colors[row])
    if not marks:
        return
    style: NamedValues = {"facecolors": "none", "edgecolors": mark_colors}
    if filled:
        style = {"facecolors": mark_colors, "edgecolors": CASING_COLOR}
    ax.add_collection(PolyCollection(marks, linewidths=0.7, zorder=3.5, **style))


def _is_moving(boxes: Boxes) -> BoolArray:
    speed = np.linalg.norm(boxes.velocity, axis=1)
    return np.asarray(speed > 0)  # False for NaN, an unknown speed


def _write_ids(positions: FloatArray, actor_ids: IntArray, ax: Axes, colors: Sequence[str]) -> None:
    """Write the ids of tracked actors at positions (N, 2).

    If space is short, the ids of the accident's actors, which have hues, take precedence.
    """
    shades = set(category_colors().values())
    tracked_rows = np.flatnonzero(actor_ids != UNTRACKED_ID).tolist()
    rows = sorted(tracked_rows, key=lambda row: colors[row] in shades)
    chips = []
    for row in rows:
        is_own = actor_ids[row] == OWN_ACTOR_ID
        words = "own" if is_own else str(actor_ids[row])
        chips.append((words, positions[row]))
    chip_colors = [colors[row] for row in rows]
    place_chips(ax, chips, colors=chip_colors)


def write_beside(ax: Axes, words: str, position: tuple[float, float], color: str) -> None:
    """Write a few words near a position in data coordinates, on a chip with a coloured edge.

    Words outside the axes are left out.
    """
    chip = (words, position)
    place_chips(ax, [chip], colors=[color])


def draw_trail(path: FloatArray, ax: Axes, color: str, **style: Any) -> LineCollection:
    """Render a path (T, 2), metres, that starts in the current frame and fades towards its end."""
    return _draw_trails([path], ax, [color], style)


def draw_trails(
    dataset: Dataset,
    sample: Any,
    boxes: Boxes,
    colors: Sequence[str],
    *,
    target_from_world: SE3,
    seconds: tuple[float, float],
    ax: Axes,
) -> None:
    """Render past (thin) and future (thick) paths of actors, from the labels of all agents.

    Args:
        dataset: The release.
        sample: Record of the current sample.
        boxes: Actors; the ones without an id have no trail.
        colors: One colour for each actor.
        target_from_world: Pose of the world in the frame of the axes.
        seconds: Length of the past and of the future paths, seconds.
        ax: Axes to render on.
    """
    tracks = scenario_tracks(dataset, sample["scenario_token"])
    own_actor = dataset.get("agent", sample["agent_token"])["actor_id"]
    present = int(sample["token"].rsplit("/", 1)[1])
    past_count, future_count = (round(duration / FRAME_PERIOD) for duration in seconds)
    centers = target_from_world.apply(tracks.boxes.center)[:, :2]
    past_paths = []
    future_paths = []
    for label_id in boxes.actor_id.tolist():
        actor = own_actor if label_id == OWN_ACTOR_ID else label_id
        past_rows = _track_rows(tracks, actor, present - past_count, present)
        future_rows = _track_rows(tracks, actor, present, present + future_count)
        past_paths.append(centers[past_rows][::-1])
        future_paths.append(centers[future_rows])
    _draw_trails(past_paths, ax, colors, {"linewidths": 0.8})
    _draw_trails(future_paths, ax, colors, {"linewidths": 2.0})


def _track_rows(tracks: ScenarioTracks, actor: int | None, start: int, end: int) -> IntArray:
    """Return an actor's row numbers from frame `start` to `end` inclusive, in order of time."""
    is_actor = tracks.actor_id == actor
    is_within = (tracks.index >= start) & (tracks.index <= end)
    return np.flatnonzero(is_actor & is_within)


def _draw_trails(
    paths: Sequence[FloatArray], ax: Axes, colors: Sequence[str], style: NamedValues
) -> LineCollection:
    """Draw paths (T, 2) as one collection of short lines, each fainter than the one before it."""
    from matplotlib.collections import LineCollection
    from matplotlib.colors import to_rgb

    lines = [np.zeros((0, 2, 2))]
    rgba = [np.zeros((0, 4))]
    for path, color in zip(paths, colors, strict=True):
        if len(path) > 1 and np.ptp(path, axis=0).max() > _MIN_TRAIL_LENGTH_M:
            opacity = np.linspace(1, _MIN_TRAIL_OPACITY, len(path) - 1)
            rgb = np.tile(to_rgb(color), (len(opacity), 1))
            lines.append(np.stack([path[:-1], path[1:]], axis=1))
            rgba.append(np.column_stack([rgb, opacity]))
    options = {"zorder": 2, "capstyle": "butt", **style}
    segments = list(np.concatenate(lines))
    trails = LineCollection(segments, colors=np.concatenate(rgba), **options)
    ax.add_collection(trails)
    return trails


def collider_ids(dataset: Dataset, sample: RowArgument) -> set[int]:
    """Return the label ids, in this sample, of the colliding pair that meta names.

    The label id of the sample's agent itself is −100.
    """
    record = dataset.get("sample", sample)
    collision = dataset.get("scenario", record["scenario_token"])["collision"]
    if collision is None:
        return set()
    agent_id = dataset.get("agent", record["agent_token"])["actor_id"]
    label_ids = set()
    for actor_id in collision["ids"]:
        if actor_id == agent_id:
            label_ids.add(OWN_ACTOR_ID)
        else:
            label_ids.add(actor_id)
    return label_ids


def recorder_ids(dataset: Dataset, sample: RowArgument) -> dict[int, AgentName]:
    """Map the label ids of recording vehicles to agents; the sample's agent has −100."""
    record = dataset.get("sample", sample)
    agents = {}
    for actor, agent in recorders_of(dataset, record["scenario_token"]).items():
        label_id = OWN_ACTOR_ID if agent == record["agent"] else actor
        agents[label_id] = agent
    return agents


def recorders_of(dataset: Dataset, scenario: str) -> dict[int, AgentName]:
    """Map the actor ids of a scenario's recording vehicles to agents; `scenario` is a token.

    Vehicles that meta does not name are left out.
    """
    agents = {}
    for agent in agents_of(dataset, scenario):
        actor = dataset.agent.get(f"{scenario}/{agent}")["actor_id"]
        if actor is not None:
            agents[actor] = agent
    return agents


def agent_letters(agent: str) -> str:
    """Abbreviate an agent's name to one or two letters: E, EB, O, OB or I."""
    words = short_name(agent).upper().split()
    return "".join(word[0] for word in words)


def actor_color(category: str, agent: str | None = None, *, collides: bool = False) -> str:
    """Return the colour of an actor's box.

    Actors that collide are red. Other agents have their agent's colour, or in some styles their
    category's; all other actors have their category's colour.
    """
    if collides:
        return COLLIDER_COLOR
    if agent is None or current_style().by_class:
        return category_colors()[category]
    return AGENT_COLORS[agent]


def role_colors(dataset: Dataset, sample: RowArgument, boxes: Boxes) -> list[str]:
    """Return the colour of each box by the role of its actor.

    The boxes come from the sample's label, where its agent has the id −100, or from several
    agents, where it has its CARLA id.
    """
    record = dataset.get("sample", sample)
    colliders = collider_ids(dataset, record)
    recorders = recorder_ids(dataset, record)
    actors = zip(label_ids(dataset, record, boxes), boxes.category_names, strict=True)
    return [
        actor_color(category, recorders.get(actor), collides=actor in colliders)
        for actor, category in actors
    ]


def label_ids(dataset: Dataset, sample: RowArgument, boxes: Boxes) -> list[int]:
    """Convert the ids of boxes, which may be CARLA ids, to label ids in this sample.

    The sample's agent itself is −100.
    """
    agent_token = dataset.get("sample", sample)["agent_token"]
    own_actor = dataset.get("agent", agent_token)["actor_id"]
    ids = np.where(boxes.actor_id == own_actor, OWN_ACTOR_ID, boxes.actor_id)
    return list(ids.tolist())


def actor_tags(dataset: Dataset, contact: Contact) -> dict[int, str]:
    """Map the actor ids of the colliding pair to short names.

    An agent is named by its letters, such as `E` or `OB`, and any other actor by its category.
    """
    scenario, _ = contact.frame.rsplit("/", 1)
    agents = recorders_of(dataset, scenario)
    tags = {}
    for actor, instance_token in zip(contact.actor_ids, contact.instances, strict=True):
        if actor in agents:
            tags[actor] = agent_letters(agents[actor])
        else:
            tags[actor] = dataset.instance.get(instance_token)["category"]
    return tags


def camera_name(channel: str) -> str:
    """Return a camera's short name, such as `back left`; other channels are returned unchanged."""
    if not channel.startswith("Camera_"):
        return channel
    name = channel.removeprefix("Camera_")
    return re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name).lower()


def in_drawing_order(agents: Collection[str]) -> list[str]:
    """Sort agents in the order of `taxonomy.AGENTS`, which panels and legends use."""
    return sorted(agents, key=AGENTS.index)


def simultaneous_sample(sample: ReadOnlyValues, agent: str) -> str:
    """Return the token of an agent's sample in the same frame as another agent's sample record."""
    scenario, _, number = sample["token"].rsplit("/", 2)
    return sample_token(scenario, agent, int(number))
