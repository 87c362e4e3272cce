"""Boxes from above and in camera images, their trails, and the colours of their actors' roles."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
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
# Metres: radius of the mark of a small actor from above, so that it is about as wide as a car.
_MARK_RADIUS_M: Final = 1.0
# Points: least radius of a mark, so that it is visible in a view of a whole town.
_MIN_MARK_RADIUS_PT: Final = 2.0
# Arrows in data coordinates.
ARROW_STYLE: Final[Mapping[str, Any]] = {
    "angles": "xy",
    "scale_units": "xy",
    "scale": 1,
    "width": 0.004,
    "zorder": 4,
}
# Corners of the marks, by matplotlib's names.
_MARK_CORNERS: Final[Mapping[str, int]] = {"o": 16, "D": 4, "^": 3}
# Metres a second: length of the arrow in a corner that shows the scale of the arrows.
_KEY_SPEED_MPS = 10
# Points: the width of an edge in an image, and by how much its casing is wider.
_EDGE_WIDTH_PT, _CASING_WIDTH_PT = 1.2, 1.2
# Metres in front of the camera at which edges are cut off.
NEAR_PLANE_M = 0.1
# Opacity of the end of a trail.
_MIN_TRAIL_OPACITY: Final = 0.1
# Metres: an actor that moves less has no trail.
_MIN_TRAIL_LENGTH_M: Final = 0.5


@in_own_settings
def draw_box(box: Box, ax: Axes, color: str | None = None) -> Axes:
    """Render one box from above, in its own frame's x and y, metres, with a line to its front.

    Raises:
        GeometryError: `box` is no `Box`, such as the axes.
    """
    if not isinstance(box, Box):
        raise GeometryError(
            f"box: expected a Box, found {type(box).__name__}; "
            "the box is first, then the axes: draw_box(box, ax)"
        )
    colors = [color or category_colors()[box.category]]
    corners = box.bottom_corners().T[None, :, :2]
    _draw_footprints(box.center[None, :2], corners, ax, colors, 0.25, {})
    return ax


def draw_boxes_from_above(
    boxes: Boxes, ax: Axes, colors: Sequence[str], *, fill: float = 0.25, **style: Any
) -> None:
    """Render boxes in x and y of their (level) frame, metres, each with a line to its front.

    `fill` is the opacity of their areas. Pedestrians, cyclists and motorcycles also have their
    class's mark, as large as a car is wide. `style` has matplotlib's options for the outlines, such
    as `linestyle`.
    """
    corners = boxes.bottom_corners()[..., :2]
    _draw_footprints(boxes.center[:, :2], corners, ax, colors, fill, style)
    _draw_small_actors(boxes, ax, colors, filled=fill > 0)


def draw_ids_from_above(boxes: Boxes, ax: Axes, colors: Sequence[str]) -> None:
    """Write the label ids of tracked boxes beside them; the recording agent is `own`."""
    _write_ids(boxes.center[:, :2], boxes.actor_id, ax, colors)


def draw_velocities_from_above(boxes: Boxes, ax: Axes, colors: Sequence[str]) -> None:
    """Render an arrow to the position of each moving box in one second, and a key for their scale.

    Boxes with unknown velocities have no arrow.
    """
    rows = np.flatnonzero(_is_moving(boxes))
    if not len(rows):
        return
    starts, steps = boxes.center[rows, :2].T, boxes.velocity[rows, :2].T
    arrow_colors = [colors[row] for row in rows.tolist()]
    arrows = ax.quiver(*starts, *steps, color=arrow_colors, **ARROW_STYLE)
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
    """Render the requested ones of the layers `boxes`, `velocities` and `ids`."""
    if "boxes" in layers:
        draw_boxes_from_above(boxes, ax, colors)
    if "velocities" in layers:
        draw_velocities_from_above(boxes, ax, colors)
    if "ids" in layers:
        draw_ids_from_above(boxes, ax, colors)


def draw_boxes_in_image(
    boxes: Boxes, camera: PinholeCamera, ax: Axes, colors: Sequence[str], **style: Any
) -> BoolArray:
    """Render the edges of boxes (N) of the camera's optical frame, and fill their fronts.

    Edges have a white casing. Parts that are not in front of the camera are cut off. `style` has
    matplotlib's options for the edges, such as `linestyle`. Returns which boxes (N,) have a part in
    the image.
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
        rgba[:, 3] *= 0.25
        # the ends of the cut edges, going round, are the corners of the cut face
        is_front = edge < 4
        rows, starts = np.unique(row[is_front], return_index=True)
        faces: list[FloatArray] = []
        if len(rows):
            faces = np.split(pixels[is_front].reshape(-1, 2), 2 * starts[1:])
        fronts = PolyCollection(faces, facecolors=rgba[rows], edgecolors="none")
        ax.add_collection(fronts, autolim=False)
    bounds = _bounds(pixels, row, len(boxes), camera)
    return np.asarray((bounds[:, 2:] > bounds[:, :2]).all(axis=1))


def _casing(pixels: FloatArray) -> PathPatch:
    """Return white lines below edges (V, 2, 2), which are dark on asphalt.

    They are one shape, because that takes the least time.
    """
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    codes = np.tile(np.array([Path.MOVETO, Path.LINETO], dtype=Path.code_type), len(pixels))
    path = Path(pixels.reshape(-1, 2), codes)
    width = _EDGE_WIDTH_PT + _CASING_WIDTH_PT
    return PathPatch(path, fill=False, edgecolor=CASING_COLOR, alpha=0.5, linewidth=width)


def bounds_in_image(boxes: Boxes, camera: PinholeCamera) -> FloatArray:
    """Return left, top, right and bottom of each box in the image, shape (N, 4), pixels.

    Boxes without a part in the image have no area.
    """
    pixels, row, _ = _edges_in_image(boxes, camera)
    return _bounds(pixels, row, len(boxes), camera)


def _bounds(pixels: FloatArray, row: IntArray, count: int, camera: PinholeCamera) -> FloatArray:
    """Return `bounds_in_image` of `count` boxes, from their edges."""
    bounds = np.zeros((count, 4))
    if len(row):
        rows, starts = np.unique(row, return_index=True)
        bounds[rows, :2] = np.minimum.reduceat(pixels.min(axis=1), starts)
        bounds[rows, 2:] = np.maximum.reduceat(pixels.max(axis=1), starts)
    return bounds.clip(0, (camera.width, camera.height) * 2)


def _edges_in_image(boxes: Boxes, camera: PinholeCamera) -> tuple[FloatArray, IntArray, IntArray]:
    """Return edges (V, 2, 2) in front of the camera, pixels, with their boxes and numbers.

    Boxes are rows (V,), numbers are positions in `EDGES`.
    """
    edges = boxes.corners()[:, EDGES].reshape(-1, 2, 3)
    pixels, drawn = segments_in_image(edges, camera)
    row, edge = np.divmod(np.flatnonzero(drawn), len(EDGES))
    return pixels, row, edge


def draw_ids_in_image(boxes: Boxes, camera: PinholeCamera, ax: Axes, colors: Sequence[str]) -> None:
    """Write the ids of tracked boxes of the camera's optical frame above them.

    Boxes with their top outside the image have none.
    """
    top_centers = boxes.corners()[:, (0, 1, 4, 5)].mean(axis=1)
    pixels, depth = camera.project(top_centers)
    rows = np.flatnonzero(camera.in_image(pixels, depth, min_depth=NEAR_PLANE_M))
    row_colors = [colors[row] for row in rows.tolist()]
    _write_ids(pixels[rows], boxes.actor_id[rows], ax, row_colors)


def draw_velocities_in_image(
    boxes: Boxes, camera: PinholeCamera, ax: Axes, colors: Sequence[str]
) -> None:
    """Render a line to the position of each moving box's centre in one second.

    Boxes are in the camera's optical frame.
    """
    from matplotlib.collections import LineCollection
    from matplotlib.colors import to_rgba_array

    moving = _is_moving(boxes)
    center = boxes.center[moving]
    segments = np.stack([center, center + boxes.velocity[moving]], axis=1)
    pixels, drawn = segments_in_image(segments, camera)
    rgba = to_rgba_array(list(colors))[moving][drawn]
    lines = LineCollection(list(pixels), colors=rgba, linewidths=2, linestyles=(0, (2, 1)))
    ax.add_collection(lines)


def segments_in_image(segments: FloatArray, camera: PinholeCamera) -> tuple[FloatArray, BoolArray]:
    """Return segments (S, 2, 3) of the optical frame as pixels (V, 2, 2), cut off in front.

    They end at `NEAR_PLANE_M`. The second array, shape (S,), is whether a segment remains.
    """
    depth = segments[..., 2]
    drawn = np.asarray((depth >= NEAR_PLANE_M).any(axis=1))
    ends, depth = segments[drawn].copy(), depth[drawn]
    for end, opposite in ((0, 1), (1, 0)):
        behind = depth[:, end] < NEAR_PLANE_M
        opposite_depth = depth[behind, opposite]
        share = (NEAR_PLANE_M - opposite_depth) / (depth[behind, end] - opposite_depth)
        start = ends[behind, opposite]
        ends[behind, end] = start + share[:, None] * (ends[behind, end] - start)
    pixels, _ = camera.project(ends.reshape(-1, 3))
    return pixels.reshape(-1, 2, 2), drawn


def _draw_footprints(
    centers: FloatArray,
    corners: FloatArray,
    ax: Axes,
    colors: Sequence[str],
    fill: float,
    style: Mapping[str, Any],
) -> None:
    """Draw outlines (N, 4, 2), front corners first, and lines from centres (N, 2) to fronts."""
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
    """Draw the marks of classes that are too small to be found; a mark is as wide as a car."""
    from matplotlib.collections import PolyCollection

    corners_of_rows = {}
    for row, name in enumerate(boxes.category_names):
        corners = _MARK_CORNERS.get(CATEGORY_MARKERS.get(name, ""))
        if corners is not None:
            corners_of_rows[row] = corners
    if not corners_of_rows:
        return
    point = float(np.ptp(ax.get_xlim())) / ax.bbox.width * ax.figure.dpi / 72
    radius = max(_MARK_RADIUS_M, _MIN_MARK_RADIUS_PT * point)
    marks = []
    for row, corners in corners_of_rows.items():
        angle = np.pi / 2 + 2 * np.pi * np.arange(corners) / corners
        circle = np.column_stack([np.cos(angle), np.sin(angle)])
        marks.append(boxes.center[row, :2] + radius * circle)
    mark_colors = [colors[row] for row in corners_of_rows]
    style: dict[str, Any] = {"facecolors": "none", "edgecolors": mark_colors}
    if filled:
        style = {"facecolors": mark_colors, "edgecolors": CASING_COLOR}
    ax.add_collection(PolyCollection(marks, linewidths=0.7, zorder=3.5, **style))


def _is_moving(boxes: Boxes) -> BoolArray:
    speed = np.linalg.norm(boxes.velocity, axis=1)
    return np.asarray(speed > 0)  # False for NaN, an unknown speed


def _write_ids(positions: FloatArray, actor_ids: IntArray, ax: Axes, colors: Sequence[str]) -> None:
    """Write the ids of tracked actors at positions (N, 2).

    The ids of the accident's actors, with hues instead of shades, come first.
    """
    shades = set(category_colors().values())
    tracked = np.flatnonzero(actor_ids != UNTRACKED_ID).tolist()
    rows = sorted(tracked, key=lambda row: colors[row] in shades)
    words = ["own" if actor_ids[row] == OWN_ACTOR_ID else str(actor_ids[row]) for row in rows]
    chips = zip(words, positions[rows], strict=True)
    place_chips(ax, chips, colors=[colors[row] for row in rows])


def write_beside(ax: Axes, words: str, position: tuple[float, float], color: str) -> None:
    """Write a few words near a position in data coordinates, on a chip with a coloured edge.

    Words outside the axes are left out.
    """
    place_chips(ax, [(words, position)], colors=[color])


def draw_trail(path: FloatArray, ax: Axes, color: str, **style: Any) -> LineCollection:
    """Render a path (T, 2), metres, from the present on or back, fading towards its end."""
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
    """Render past (thin) and future (thick) paths of actors, by all agents' labels.

    `sample` is the record of the present, `seconds` are the lengths of both. Boxes without an id
    have no trail.
    """
    tracks = scenario_tracks(dataset, sample["scenario_token"])
    own_actor = dataset.get("agent", sample["agent_token"])["actor_id"]
    present = int(sample["token"].rsplit("/", 1)[1])
    back, ahead = (round(span / FRAME_PERIOD) for span in seconds)
    centers = target_from_world.apply(tracks.boxes.center)[:, :2]
    pasts, futures = [], []
    for actor_id in boxes.actor_id.tolist():
        actor = actor_id
        if actor_id == OWN_ACTOR_ID:
            actor = own_actor
        past_rows = _track_rows(tracks, actor, present - back, present)
        pasts.append(centers[past_rows][::-1])
        futures.append(centers[_track_rows(tracks, actor, present, present + ahead)])
    _draw_trails(pasts, ax, colors, {"linewidths": 0.8})
    _draw_trails(futures, ax, colors, {"linewidths": 2.0})


def _track_rows(tracks: ScenarioTracks, actor: int | None, start: int, end: int) -> IntArray:
    """Return the rows of an actor from frame `start` to `end`, both included, by time."""
    is_within = (tracks.index >= start) & (tracks.index <= end)
    return np.flatnonzero((tracks.actor_id == actor) & is_within)


def _draw_trails(
    paths: Sequence[FloatArray], ax: Axes, colors: Sequence[str], style: dict[str, Any]
) -> LineCollection:
    """Draw paths (T, 2) as one collection of short lines, each fainter than the one before it."""
    from matplotlib.collections import LineCollection
    from matplotlib.colors import to_rgb

    lines, rgba = [np.zeros((0, 2, 2))], [np.zeros((0, 4))]
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
    """Return the label ids, in this sample, of the pair that collides by meta.

    The id is −100 if the sample's agent is one of them.
    """
    record = dataset.get("sample", sample)
    collision = dataset.get("scenario", record["scenario_token"])["collision"]
    if collision is None:
        return set()
    agent_id = dataset.get("agent", record["agent_token"])["actor_id"]
    return {OWN_ACTOR_ID if actor_id == agent_id else actor_id for actor_id in collision["ids"]}


def recorder_ids(dataset: Dataset, sample: RowArgument) -> dict[int, AgentName]:
    """Return label id → agent, for the recording vehicles; −100 is the sample's own agent."""
    record = dataset.get("sample", sample)
    agents = {}
    for actor, agent in recorders_of(dataset, record["scenario_token"]).items():
        label_id = OWN_ACTOR_ID if agent == record["agent"] else actor
        agents[label_id] = agent
    return agents


def recorders_of(dataset: Dataset, scenario: str) -> dict[int, AgentName]:
    """Return actor id → agent, for the recording vehicles of a scenario (a token).

    Vehicles that meta does not name are left out.
    """
    agents = {}
    for agent in agents_of(dataset, scenario):
        actor = dataset.agent.get(f"{scenario}/{agent}")["actor_id"]
        if actor is not None:
            agents[actor] = agent
    return agents


def agent_letters(agent: str) -> str:
    """Return one or two letters for an agent: E, EB, O, OB or I."""
    return "".join(word[0] for word in short_name(agent).split()).upper()


def actor_color(category: str, agent: str | None = None, *, collides: bool = False) -> str:
    """Return the colour of an actor's box.

    It is red for colliders, otherwise the agent's colour, otherwise the category's. Some styles use
    the category's colour for agents too.
    """
    if collides:
        return COLLIDER_COLOR
    if agent is None or current_style().by_class:
        return category_colors()[category]
    return AGENT_COLORS[agent]


def role_colors(dataset: Dataset, sample: RowArgument, boxes: Boxes) -> list[str]:
    """Return the colours of boxes of a sample, or of several agents.

    In a sample's own boxes its agent has the id −100, in others its CARLA id.
    """
    record = dataset.get("sample", sample)
    colliders, recorders = collider_ids(dataset, record), recorder_ids(dataset, record)
    actors = zip(label_ids(dataset, record, boxes), boxes.category_names, strict=True)
    return [
        actor_color(category, recorders.get(actor), collides=actor in colliders)
        for actor, category in actors
    ]


def label_ids(dataset: Dataset, sample: RowArgument, boxes: Boxes) -> list[int]:
    """Return the label ids, in this sample, of boxes that may have CARLA ids.

    The sample's agent itself is −100.
    """
    agent_token = dataset.get("sample", sample)["agent_token"]
    own_actor = dataset.get("agent", agent_token)["actor_id"]
    ids = np.where(boxes.actor_id == own_actor, OWN_ACTOR_ID, boxes.actor_id)
    return list(ids.tolist())


def actor_tags(dataset: Dataset, contact: Contact) -> dict[int, str]:
    """Return short names of the colliding pair: the letters of agents, otherwise the category.

    Letters are for example `E` and `OB`.
    """
    agents = recorders_of(dataset, contact.frame.rsplit("/", 1)[0])
    tags = {}
    for actor, instance in zip(contact.actor_ids, contact.instances, strict=True):
        if actor in agents:
            tags[actor] = agent_letters(agents[actor])
        else:
            tags[actor] = dataset.instance.get(instance)["category"]
    return tags


def camera_name(channel: str) -> str:
    """Return a camera's short name for readers: `front`, `back left`; another sensor's channel."""
    if not channel.startswith("Camera_"):
        return channel
    return re.sub(r"(?<=[a-z])(?=[A-Z])", " ", channel.removeprefix("Camera_")).lower()


def in_drawing_order(agents: Collection[str]) -> list[str]:
    """Return agents in the order of `taxonomy.AGENTS`, as in panels and legends."""
    return sorted(agents, key=AGENTS.index)


def simultaneous_sample(sample: Mapping[str, Any], agent: str) -> str:
    """Return the token of an agent's sample at the moment of another agent's sample (a record)."""
    scenario, _, number = sample["token"].rsplit("/", 2)
    return sample_token(scenario, agent, int(number))
