"""Rendering boxes, from above and in camera images, their trails, and the colours of their actors' roles."""

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

# The twelve edges of a box between its corners, in `Box.corners` order; the first four are its front.
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
# Metres from the middle of the mark of a small actor, from above, to its rim: about a car's width in all.
_MARK_RADIUS: Final = 1.0
# Points: it is at least as large, so that it is found in a view of a whole town.
_LEAST_RADIUS: Final = 2.0
# Corners of the marks, by matplotlib's names.
_CORNERS: Final[Mapping[str, int]] = {"o": 16, "D": 4, "^": 3}
# Metres a second of the arrow in a corner that gives the scale of the others.
_KEY_SPEED = 10
# Points: the width of an edge in an image, and by how much its casing is wider.
_EDGE, _CASING = 1.2, 1.2
# Metres in front of the camera at which edges are cut off.
NEAREST_DRAWN = 0.1
# How opaque the far end of a trail is.
_FAINTEST: Final = 0.1
# Metres: an actor that moves less has no trail.
_STANDING: Final = 0.5


@in_own_settings
def draw_box(box: Box, ax: Axes, color: str | None = None) -> Axes:
    """Render one box from above, in its own frame's x and y, metres, with a line towards its front.

    Raises:
        GeometryError: `box` is no `Box`, such as the axes.
    """
    if not isinstance(box, Box):
        raise GeometryError(
            f"box: expected a Box, found {type(box).__name__}; the box is first, then the axes: draw_box(box, ax)"
        )
    chosen = color or category_colors()[box.category]
    _draw_footprints(
        box.center[None, :2], box.bottom_corners().T[None, :, :2], ax, [chosen], 0.25, {}
    )
    return ax


def draw_boxes_from_above(
    boxes: Boxes, ax: Axes, colors: Sequence[str], *, fill: float = 0.25, **how: Any
) -> None:
    """Render boxes in x and y of their (level) frame, metres, each with a line towards its front, as opaque as `fill`.

    Pedestrians, cyclists and motorcycles also have their class's mark, as large as a car is wide. `how` is
    matplotlib's for the outlines, such as `linestyle`.
    """
    _draw_footprints(boxes.center[:, :2], boxes.bottom_corners()[..., :2], ax, colors, fill, how)
    _draw_small(boxes, ax, colors, filled=fill > 0)


def draw_ids_from_above(boxes: Boxes, ax: Axes, colors: Sequence[str]) -> None:
    """Write the label ids of tracked boxes beside them; the recording agent is `own`."""
    _write_ids(boxes.center[:, :2], boxes.actor_id, ax, colors)


def draw_velocities_from_above(boxes: Boxes, ax: Axes, colors: Sequence[str]) -> None:
    """Render an arrow to where each box with a known velocity would be in a second, and a key for their scale."""
    moving = _moving(boxes)
    if moving.any():
        center, velocity = boxes.center[moving], boxes.velocity[moving]
        chosen = [color for color, moves in zip(colors, moving.tolist(), strict=True) if moves]
        start, step = center[:, :2].T, velocity[:, :2].T
        how: Any = {"angles": "xy", "scale_units": "xy", "scale": 1, "width": 0.004, "zorder": 4}
        arrows = ax.quiver(*start, *step, color=chosen, **how)
        words = f"{_KEY_SPEED} m/s"
        key = ax.quiverkey(
            arrows,
            0.85,
            0.03,
            _KEY_SPEED,
            words,
            color=OWN_COLOR,
            fontproperties={"size": text_size()},
        )
        key.text.set_bbox({"facecolor": CASING_COLOR, "edgecolor": "none", "pad": 1.5})


def draw_actors_from_above(
    boxes: Boxes, ax: Axes, colors: Sequence[str], layers: Collection[Layer]
) -> None:
    """Render the requested ones of the layers `boxes`, `velocities` and `ids`, as the functions above do."""
    if "boxes" in layers:
        draw_boxes_from_above(boxes, ax, colors)
    if "velocities" in layers:
        draw_velocities_from_above(boxes, ax, colors)
    if "ids" in layers:
        draw_ids_from_above(boxes, ax, colors)


def draw_boxes_in_image(
    boxes: Boxes, camera: PinholeCamera, ax: Axes, colors: Sequence[str], **how: Any
) -> BoolArray:
    """Render the edges of boxes (N) of the camera's optical frame, with a white casing, and fill their fronts.

    What is not in front of the camera is cut off. `how` is matplotlib's for the edges, such as `linestyle`. Returns
    which boxes (N,) have a part in the image.
    """
    from matplotlib.collections import LineCollection, PolyCollection
    from matplotlib.colors import to_rgba_array

    pixels, row, edge = _edges_in_image(boxes, camera)
    faces = to_rgba_array(list(colors))
    if len(row):
        ax.add_artist(_casing(pixels))
        lines = LineCollection(list(pixels), **{"colors": faces[row], "linewidths": _EDGE, **how})
        ax.add_collection(lines, autolim=False)  # the image has set the limits
        faces[:, 3] *= 0.25
        # going round, the ends of what is left of the edges are the corners of what is left of the face
        front = edge < 4
        rows, starts = np.unique(row[front], return_index=True)
        fronts = np.split(pixels[front].reshape(-1, 2), 2 * starts[1:])
        filled = PolyCollection(
            fronts if len(rows) else [], facecolors=faces[rows], edgecolors="none"
        )
        ax.add_collection(filled, autolim=False)
    bounds = _bounds(pixels, row, len(boxes), camera)
    return np.asarray((bounds[:, 2:] > bounds[:, :2]).all(axis=1))


def _casing(pixels: FloatArray) -> PathPatch:
    """White below edges (V, 2, 2), which are dark on asphalt; one shape, as this takes least time."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    codes = np.tile(np.array([Path.MOVETO, Path.LINETO], dtype=Path.code_type), len(pixels))
    path = Path(pixels.reshape(-1, 2), codes)
    return PathPatch(path, fill=False, edgecolor=CASING_COLOR, alpha=0.5, linewidth=_EDGE + _CASING)


def bounds_in_image(boxes: Boxes, camera: PinholeCamera) -> FloatArray:
    """Left, top, right and bottom (N, 4) of the part of each box that is in the image; no area if none is."""
    pixels, row, _ = _edges_in_image(boxes, camera)
    return _bounds(pixels, row, len(boxes), camera)


def _bounds(pixels: FloatArray, row: IntArray, count: int, camera: PinholeCamera) -> FloatArray:
    """`bounds_in_image` of so many boxes, from their edges."""
    bounds = np.zeros((count, 4))
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
    pixels, depth = camera.project(boxes.corners()[:, (0, 1, 4, 5)].mean(axis=1))
    seen = camera.in_image(pixels, depth, min_depth=NEAREST_DRAWN)
    _write_ids(
        pixels[seen],
        boxes.actor_id[seen],
        ax,
        [colors[row] for row in np.flatnonzero(seen).tolist()],
    )


def draw_velocities_in_image(
    boxes: Boxes, camera: PinholeCamera, ax: Axes, colors: Sequence[str]
) -> None:
    """Render a line to where the centre of each moving box of the camera's optical frame would be in a second."""
    from matplotlib.collections import LineCollection
    from matplotlib.colors import to_rgba_array

    moving = _moving(boxes)
    center = boxes.center[moving]
    pixels, drawn = segments_in_image(
        np.stack([center, center + boxes.velocity[moving]], axis=1), camera
    )
    chosen = to_rgba_array(list(colors))[moving][drawn]
    ax.add_collection(
        LineCollection(list(pixels), colors=chosen, linewidths=2, linestyles=(0, (2, 1)))
    )


def segments_in_image(segments: FloatArray, camera: PinholeCamera) -> tuple[FloatArray, BoolArray]:
    """Segments (S, 2, 3) of the optical frame as pixels (V, 2, 2), cut off at `NEAREST_DRAWN`; which (S,) are left."""
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
    centers: FloatArray,
    corners: FloatArray,
    ax: Axes,
    colors: Sequence[str],
    fill: float,
    how: Mapping[str, Any],
) -> None:
    """Outlines (N, 4, 2), the front corners first, and lines from the centres (N, 2) to the fronts."""
    from matplotlib.collections import LineCollection, PolyCollection
    from matplotlib.colors import to_rgba_array

    faces = to_rgba_array(list(colors))
    faces[:, 3] *= fill
    style = {"linewidths": 1.2, "zorder": 3, **how}
    ax.add_collection(
        PolyCollection(list(corners), facecolors=faces, edgecolors=list(colors), **style)
    )
    keep_free(ax, corners)
    headings = np.stack([centers, corners[:, :2].mean(axis=1)], axis=1)
    ax.add_collection(LineCollection(list(headings), colors=list(colors), **style))


def _draw_small(boxes: Boxes, ax: Axes, colors: Sequence[str], *, filled: bool) -> None:
    """The marks of classes that are too small to be found, in metres: none is larger than a car."""
    from matplotlib.collections import PolyCollection

    corners = [_CORNERS.get(CATEGORY_MARKERS.get(name, "")) for name in boxes.category_names]
    small = [(row, number) for row, number in enumerate(corners) if number is not None]
    if not small:
        return
    turns = [np.pi / 2 + 2 * np.pi * np.arange(number) / number for _, number in small]
    point = float(np.ptp(ax.get_xlim())) / ax.bbox.width * ax.figure.dpi / 72
    radius = max(_MARK_RADIUS, _LEAST_RADIUS * point)
    marks = [
        boxes.center[row, :2] + radius * np.column_stack([np.cos(turn), np.sin(turn)])
        for (row, _), turn in zip(small, turns, strict=True)
    ]
    own = [colors[row] for row, _ in small]
    inside, edges = (own, CASING_COLOR) if filled else ("none", own)
    ax.add_collection(
        PolyCollection(marks, facecolors=inside, edgecolors=edges, linewidths=0.7, zorder=3.5)
    )


def _moving(boxes: Boxes) -> BoolArray:
    return np.asarray(np.linalg.norm(boxes.velocity, axis=1) > 0)  # False for NaN, an unknown speed


def _write_ids(places: FloatArray, actor_ids: IntArray, ax: Axes, colors: Sequence[str]) -> None:
    """Write the ids of tracked actors at places (N, 2): first those of hues, which are the accident's actors."""
    shades = set(category_colors().values())
    order = sorted(
        np.flatnonzero(actor_ids != UNTRACKED_ID).tolist(), key=lambda row: colors[row] in shades
    )
    words = ["own" if actor_ids[row] == OWN_ACTOR_ID else str(actor_ids[row]) for row in order]
    place_chips(ax, zip(words, places[order], strict=True), colors=[colors[row] for row in order])


def write_beside(ax: Axes, words: str, place: tuple[float, float], color: str) -> None:
    """Write a few words near a place in data coordinates, on a chip whose edge has the colour; not outside the axes."""
    place_chips(ax, [(words, place)], colors=[color])


def draw_trail(path: FloatArray, ax: Axes, color: str, **how: Any) -> LineCollection:
    """Render a path (T, 2), metres, from the present on or back, opaque at first and fading towards its last point."""
    return _draw_trails([path], ax, [color], how)


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
    """Render where actors were (thin) and will be (thick) for seconds back and ahead, by all agents' labels.

    `sample` is the record of the present. Boxes without an id have no trail.
    """
    tracks = scenario_tracks(dataset, sample["scenario_token"])
    own = dataset.get("agent", sample["agent_token"])["actor_id"]
    present = int(sample["token"].rsplit("/", 1)[1])
    back, ahead = (round(span / FRAME_PERIOD) for span in seconds)
    centers = target_from_world.apply(tracks.boxes.center)[:, :2]
    pasts, futures, chosen = [], [], []
    for actor_id, color in zip(boxes.actor_id.tolist(), colors, strict=True):
        actor = own if actor_id == OWN_ACTOR_ID else actor_id
        pasts.append(centers[_rows(tracks, actor, present - back, present)][::-1])
        futures.append(centers[_rows(tracks, actor, present, present + ahead)])
        chosen.append(color)
    _draw_trails(pasts, ax, chosen, {"linewidths": 0.8})
    _draw_trails(futures, ax, chosen, {"linewidths": 2.0})


def _rows(tracks: ScenarioTracks, actor: int | None, first: int, last: int) -> IntArray:
    """The rows of an actor from frame `first` to `last`, both included, in the order of time."""
    return np.flatnonzero(
        (tracks.actor_id == actor) & (tracks.index >= first) & (tracks.index <= last)
    )


def _draw_trails(
    paths: Sequence[FloatArray], ax: Axes, colors: Sequence[str], how: dict[str, Any]
) -> LineCollection:
    """Paths (T, 2) as one collection of short lines, each fainter than the one before it."""
    from matplotlib.collections import LineCollection
    from matplotlib.colors import to_rgb

    lines, shades = [np.zeros((0, 2, 2))], [np.zeros((0, 4))]
    for path, color in zip(paths, colors, strict=True):
        if len(path) > 1 and np.ptp(path, axis=0).max() > _STANDING:
            opacity = np.linspace(1, _FAINTEST, len(path) - 1)
            lines.append(np.stack([path[:-1], path[1:]], axis=1))
            shades.append(np.column_stack([np.tile(to_rgb(color), (len(opacity), 1)), opacity]))
    style = {"zorder": 2, "capstyle": "butt", **how}
    drawn = LineCollection(list(np.concatenate(lines)), colors=np.concatenate(shades), **style)
    ax.add_collection(drawn)
    return drawn


def collider_ids(dataset: Dataset, sample: RowArgument) -> set[int]:
    """The label ids, in this sample, of the pair that meta says collided: −100 where the agent is one of them."""
    record = dataset.get("sample", sample)
    collision = dataset.get("scenario", record["scenario_token"])["collision"]
    if collision is None:
        return set()
    agent_id = dataset.get("agent", record["agent_token"])["actor_id"]
    return {OWN_ACTOR_ID if actor_id == agent_id else actor_id for actor_id in collision["ids"]}


def recorder_ids(dataset: Dataset, sample: RowArgument) -> dict[int, AgentName]:
    """The label ids, in this sample, of the recording vehicles → their agents: −100 is the sample's own."""
    record = dataset.get("sample", sample)
    recorders = recorders_of(dataset, record["scenario_token"])
    return {
        OWN_ACTOR_ID if agent == record["agent"] else actor: agent
        for actor, agent in recorders.items()
    }


def recorders_of(dataset: Dataset, scenario: str) -> dict[int, AgentName]:
    """The actor ids of a scenario's (a token's) recording vehicles, as far as meta names them → their agents."""
    actors = {
        agent: dataset.agent.get(f"{scenario}/{agent}")["actor_id"]
        for agent in agents_of(dataset, scenario)
    }
    return {actor: agent for agent, actor in actors.items() if actor is not None}


def agent_letters(agent: str) -> str:
    """An agent in one or two letters: E, EB, O, OB or I."""
    return "".join(word[0] for word in short_name(agent).split()).upper()


def actor_color(category: str, agent: str | None = None, *, collides: bool = False) -> str:
    """The colour of an actor's box: red if it collides, else the hue of the agent that it is, else its category's.

    If the style says so, it is the category's for agents too.
    """
    if collides:
        return COLLIDER_COLOR
    return (
        category_colors()[category]
        if agent is None or current_style().by_class
        else AGENT_COLORS[agent]
    )


def role_colors(dataset: Dataset, sample: RowArgument, boxes: Boxes) -> list[str]:
    """The colours of boxes that are a sample's own (its agent has −100) or several agents' (it has CARLA's id)."""
    record = dataset.get("sample", sample)
    colliders, recorders = collider_ids(dataset, record), recorder_ids(dataset, record)
    return [
        actor_color(category, recorders.get(actor), collides=actor in colliders)
        for actor, category in zip(
            label_ids(dataset, record, boxes), boxes.category_names, strict=True
        )
    ]


def label_ids(dataset: Dataset, sample: RowArgument, boxes: Boxes) -> list[int]:
    """The label ids, in this sample, of boxes that may have CARLA's: the agent itself is −100."""
    own = dataset.get("agent", dataset.get("sample", sample)["agent_token"])["actor_id"]
    return list(np.where(boxes.actor_id == own, OWN_ACTOR_ID, boxes.actor_id).tolist())


def actor_tags(dataset: Dataset, contact: Contact) -> dict[int, str]:
    """Short names of the two that collide: the initials of agents, such as `E` and `OB`, else the category."""
    agents = recorders_of(dataset, contact.frame.rsplit("/", 1)[0])
    return {
        actor: agent_letters(agents[actor])
        if actor in agents
        else dataset.instance.get(instance)["category"]
        for actor, instance in zip(contact.actor_ids, contact.instances, strict=True)
    }


def camera_name(channel: str) -> str:
    """A camera's short name for readers: `front`, `back left`; of another sensor its channel."""
    if not channel.startswith("Camera_"):
        return channel
    return re.sub(r"(?<=[a-z])(?=[A-Z])", " ", channel.removeprefix("Camera_")).lower()


def in_drawing_order(agents: Collection[str]) -> list[str]:
    """Agents in the order of `taxonomy.AGENTS`, as in panels and legends."""
    return sorted(agents, key=AGENTS.index)


def at_once(sample: Mapping[str, Any], agent: str) -> str:
    """The token of an agent's sample at the moment of another agent's sample, given by its record."""
    scenario, _, number = sample["token"].rsplit("/", 2)
    return sample_token(scenario, agent, int(number))
