"""Which agents see which actors, computed once and rendered from above or as a table."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, cast, get_args

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.render.bev import draw_points_from_above
from deepaccident_devkit.render.boxes import (
    draw_boxes_from_above,
    draw_ids_from_above,
    draw_velocities_from_above,
    in_drawing_order,
    role_colors,
)
from deepaccident_devkit.render.captions import (
    agent_handles,
    draw_legend_outside,
    has_cloud,
    missing_clouds_text,
    set_scene_title,
    write_missing,
)
from deepaccident_devkit.render.chips import SMALLEST_TEXT, keep_free, place_chips
from deepaccident_devkit.render.figures import (
    Layer,
    axes_or_new,
    check_view_range,
    label_axes,
    layers_of,
    settled,
    widening,
    with_light_grid,
)
from deepaccident_devkit.render.styles import (
    AGENT_COLORS,
    COLLIDER_COLOR,
    GRID_COLOR,
    MUTED_COLOR,
    OWN_COLOR,
    current_style,
    in_own_settings,
    text_size,
)
from deepaccident_devkit.support.arrays import BoolArray, FloatArray, FrozenArrays, IntArray
from deepaccident_devkit.support.text import choice
from deepaccident_devkit.tables.tokens import sample_token
from deepaccident_devkit.taxonomy import OWN_ACTOR_ID, UNTRACKED_ID, Frame, short_name
from deepaccident_devkit.v2x import (
    Agents,
    aggregate_point_cloud,
    cooperating_agents,
    cooperative_boxes,
)
from deepaccident_devkit.v2x.cooperation import visible_actors

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# The slashes of a frame's token, `<scenario_type>/<name>/<NNN>`; a sample's token has one more, for
# the agent.
_FRAME_TOKEN_SLASHES: Final = 2
VISIBILITY_LAYERS: Final[tuple[Layer, ...]] = (
    "points",
    "boxes",
    "ids",
    "velocities",
    "visibility",
    "grid",
)
_DEFAULT_LAYERS: Final[tuple[Layer, ...]] = ("boxes", "visibility", "grid")
# Metres shown around the agents and the colliding pair.
_VIEW_MARGIN_M: Final = 10.0
# Metres shown to each side, at least.
_MIN_VIEW_RANGE_M: Final = 25.0
# Points from one agent's dot to the next.
_DOT_DISTANCE_PT: Final = 4.6
# Points from an actor's box up to its dots.
_DOT_HEIGHT_PT: Final = 5.0
# Share of the width of the view by which a line is shifted to the right, so that two agents that
# see each other have two lines.
_LINE_SHIFT_SHARE: Final = 0.006
# Share of half the view between its edge and a box that has made it larger.
_EDGE_SHARE: Final = 0.05
# Share of the table's width, about, at the middle of the picture; the names of actors are on the
# left.
_TABLE_CENTER_SHARE: Final = 0.36
_MAX_ROWS: Final = 24
_MAX_SLIDE_ROWS: Final = 14
# Relative luminance (as in sRGB) of a colour above which black text on it is easier to read.
_MIN_BRIGHT_LUMINANCE: Final = 0.3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Visibility(FrozenArrays):
    """N tracked actors of a moment and the A agents that may see them; arrays are read-only.

    Attributes:
        sample: Token of the sample; its agent is the ego.
        agents: Observing agents, the ego first if it is one of them.
        boxes: Actors in one frame, by ascending id; an agent's own box has the agent's actor id.
        position: Agents' x and y in that frame, shape (A, 2), metres.
        actor: Agents' own actor ids, (A,) int64; −1 for the infrastructure, or if meta lacks it.
        seen: Whether the agent counts as seeing the actor, (N, A) bool.
        annotated: Whether the agent's label has the actor, (N, A) bool.
        points: LiDAR points of the agent in the box of its label, (N, A) int64.
        pair: Actor ids of the colliding pair; empty if nobody collides.
    """

    sample: str
    agents: tuple[str, ...]
    boxes: Boxes
    position: FloatArray
    actor: IntArray
    seen: BoolArray
    annotated: BoolArray
    points: IntArray
    pair: frozenset[int]

    @property
    def ego(self) -> str:
        """Name of the sample's agent."""
        return self.sample.rsplit("/", 2)[1]

    @property
    def own(self) -> BoolArray:
        """Whether the actor is the agent itself, shape (N, A)."""
        return np.asarray(self.boxes.actor_id[:, None] == self.actor)

    @property
    def collides(self) -> BoolArray:
        """Whether the actor is one of the colliding pair, shape (N,)."""
        return np.isin(self.boxes.actor_id, [*self.pair])

    @property
    def records(self) -> BoolArray:
        """Whether the actor is one of the agents, shape (N,)."""
        return np.isin(self.boxes.actor_id, self.actor[self.actor >= 0])

    def hidden_from(self, agent: str) -> BoolArray:
        """Return which actors of the accident an agent does not see, shape (N,).

        These are the pair and the agents, without the agent itself. All are False if it is not an
        observing agent, or if nobody collides.
        """
        if agent not in self.agents or not self.pair:
            return np.zeros(len(self.boxes), dtype=bool)
        column = self.agents.index(agent)
        is_involved = self.collides | self.records
        return np.asarray(is_involved & ~self.seen[:, column] & ~self.own[:, column])


def visibility_of(
    dataset: Dataset, moment: RowArgument, agents: Agents = None, frame: str = "ego"
) -> Visibility:
    """Return which agents see which annotated actors, in a coordinate frame of the sample.

    The moment is a sample, or a frame, which stands for its first agent's sample. Agents are as for
    `visible_instances`; its errors are raised.
    """
    sample = sample_at(dataset, moment)
    scenario, _, number = sample.rsplit("/", 2)
    names = cooperating_agents(dataset, sample, agents)
    boxes = cooperative_boxes(dataset, sample, frame=frame)
    boxes = boxes.select(boxes.actor_id != UNTRACKED_ID)
    frame_from_world = dataset.world_from(sample, frame).inverse()
    shape = len(boxes), len(names)
    seen, annotated = np.zeros(shape, dtype=bool), np.zeros(shape, dtype=bool)
    points, position = np.zeros(shape, dtype=np.int64), np.zeros((len(names), 2))
    actor = np.full(len(names), UNTRACKED_ID, dtype=np.int64)
    for column, agent in enumerate(names):
        own_sample = sample_token(scenario, agent, int(number))
        visible = visible_actors(dataset, own_sample, agents=[agent])
        seen[:, column] = np.isin(boxes.actor_id, visible)
        label, ids = dataset.boxes(own_sample, "lidar"), dataset.actor_ids(own_sample)
        ids = np.where(label.actor_id == OWN_ACTOR_ID, UNTRACKED_ID, ids)
        _, row, label_row = np.intersect1d(boxes.actor_id, ids, return_indices=True)
        annotated[row, column], points[row, column] = True, label.num_lidar_pts[label_row]
        frame_from_ego = frame_from_world @ dataset.world_from(own_sample, "ego")
        position[column] = frame_from_ego.translation[:2]
        own_actor = dataset.agent.get(f"{scenario}/{agent}")["actor_id"]
        if own_actor is not None:
            actor[column] = own_actor
    collision = dataset.get("scenario", scenario)["collision"]
    return Visibility(
        sample=sample,
        agents=tuple(names),
        boxes=boxes,
        position=position,
        actor=actor,
        seen=seen,
        annotated=annotated,
        points=points,
        pair=frozenset() if collision is None else frozenset(collision["ids"]),
    )


def sample_at(dataset: Dataset, moment: RowArgument) -> str:
    """Return the token of a sample, or of a frame's first sample.

    Raises:
        TokenError: The moment is neither.
    """
    token = str(moment["token"]) if isinstance(moment, Mapping) else moment
    if token.count("/") == _FRAME_TOKEN_SLASHES:
        return str(dataset.samples_of(token)[0]["token"])
    return str(dataset.get("sample", token)["token"])


@in_own_settings
def render_visibility(
    dataset: Dataset,
    moment: RowArgument,
    *,
    agents: Agents = None,
    frame: Frame = "ego",
    view_range: float | None = None,
    layers: Iterable[Layer] | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Render which agents see which actors, from above, by the released rule.

    Each actor has a dot for each agent that sees it. A dot has its agent's colour and its own
    position in the row, and lines go from the agents (stars) to the actors of the colliding pair
    that they see. The sample's agent has a circle. The accident's actors that it does not see are
    dashed, and for the colliding pair there are words.

    Args:
        dataset: The release.
        moment: Token or record of a sample, or of a frame: then its first present agent is the ego.
        agents: Observing agents: names, a configuration or its name from the view of the ego; None
            for all present agents.
        frame: Coordinate frame: `ego`, `lidar` or `world`.
        view_range: Metres to each side of the ego; None shows all agents, the colliding pair, and
            the actors among them.
        layers: `boxes`, `visibility` (dots, lines, words) and `grid` are the default; also `points`
            (the LiDAR of the observing agents), `ids` and `velocities`.
        ax: Axes to render on; new ones if None.

    Returns:
        The axes, in metres of the frame.

    Raises:
        TokenError: No such sample or frame.
        ChoiceError: No such agent, configuration, frame or layer, or `view_range` is not above 0.
        NotAvailableError: An agent is not in this (partial) release.
    """
    shown_layers = layers_of(layers, _DEFAULT_LAYERS, VISIBILITY_LAYERS)
    frame = choice("frame", frame, get_args(Frame))
    if view_range is not None:
        check_view_range(view_range)
    visibility = visibility_of(dataset, moment, agents, frame)
    low, high = _corners(visibility, view_range, widening(ax))
    is_new, ax = ax is None, axes_or_new(ax, (6, 6.9))
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", anchor="N")
    label_axes(ax, frame)
    ax.locator_params(nbins=6)  # each tick costs time
    if "points" in shown_layers:
        _draw_points(dataset, visibility, frame, ax)
    token = dataset.get("sample", visibility.sample)["frame_token"]
    set_scene_title(ax, dataset, token, "who sees whom")
    hidden = visibility.hidden_from(visibility.ego)
    colors = role_colors(dataset, visibility.sample, visibility.boxes)
    if "boxes" in shown_layers:
        _draw_boxes(visibility, hidden, colors, ax)
    if "velocities" in shown_layers:
        draw_velocities_from_above(visibility.boxes, ax, colors)
    if "visibility" in shown_layers:
        _draw_sight_lines(visibility, ax)
        _draw_dots(visibility, ax)
        _write_hidden(visibility, hidden, ax)
    if "ids" in shown_layers:
        draw_ids_from_above(visibility.boxes, ax, colors)
    _draw_agents(visibility, ax)
    _draw_legend(visibility, hidden, shown_layers, ax)
    if "grid" in shown_layers:
        with_light_grid(ax, "both")
    if is_new:
        settled(cast("Any", ax.figure))
    return ax


def _draw_boxes(visibility: Visibility, hidden: BoolArray, colors: list[str], ax: Axes) -> None:
    """Draw the boxes of all actors; the boxes of hidden actors are dashed."""
    visible_boxes = visibility.boxes.select(~hidden)
    draw_boxes_from_above(visible_boxes, ax, _selected(colors, ~hidden))
    draw_boxes_from_above(
        visibility.boxes.select(hidden),
        ax,
        _selected(colors, hidden),
        fill=0.0,
        linestyle=(0, (2, 1)),
        linewidths=2.0,
    )


@in_own_settings
def render_visibility_matrix(
    dataset: Dataset, moment: RowArgument, *, agents: Agents = None, ax: Axes | None = None
) -> Axes:
    """Render which agents see which actors as a table: a row per actor, a column per agent.

    A filled cell means that the agent sees the actor, an empty one that it does not. The number is
    the agent's LiDAR points in the box; if its label lacks the actor, there is a dash. A key below
    explains this. The colliding pair comes first, then the agents, then the actors that most agents
    see.

    Args:
        dataset: The release.
        moment: Token or record of a sample, or of a frame.
        agents: Observing agents, as in `render_visibility`.
        ax: Axes to render on; new ones if None.

    Returns:
        The axes, with rows counted from 0 downwards.

    Raises:
        TokenError: No such sample or frame.
        ChoiceError: No such agent or configuration.
        NotAvailableError: An agent is not in this (partial) release.
    """
    visibility = visibility_of(dataset, moment, agents)
    is_slide = current_style().room == "slide"
    observers = visibility.seen.sum(axis=1)
    keys = (visibility.boxes.actor_id, -observers, ~visibility.records, ~visibility.collides)
    all_rows = np.lexsort(keys)
    rows = all_rows[: _MAX_SLIDE_ROWS if is_slide else _MAX_ROWS]
    columns = in_drawing_order(visibility.agents)
    ax = axes_or_new(ax, (1.4 + 0.75 * len(columns), 1.2 + 0.29 * max(len(rows), 4)))
    for column, agent in enumerate(columns):
        _draw_column(visibility, rows, agent, column, ax)
    categories, ids = visibility.boxes.category_names, visibility.boxes.actor_id
    row_names = [f"{categories[row]} {ids[row]}" for row in rows.tolist()]
    ax.set_yticks(range(len(rows)), row_names, fontsize=text_size())
    for label, row in zip(ax.get_yticklabels(), rows.tolist(), strict=True):
        label.set_color(COLLIDER_COLOR if visibility.collides[row] else OWN_COLOR)
    column_names = [short_name(agent) for agent in columns]
    rotation = 0 if is_slide else 90
    ax.set_xticks(range(len(columns)), column_names, fontsize=text_size(), rotation=rotation)
    ax.xaxis.tick_top()
    ax.set(xlim=(-0.5, len(columns) - 0.5), ylim=(max(len(rows), 1) - 0.5, -0.5))
    ax.tick_params(length=0)
    ax.spines[:].set_visible(False)
    key_lines = ["filled: seen; number: LiDAR points;", "–: not in the agent's label"]
    if len(all_rows) > len(rows):
        key_lines.append(f"{len(all_rows) - len(rows)} more actors")
    ax.set_xlabel("\n".join(key_lines), fontsize=text_size())
    token = dataset.get("sample", visibility.sample)["frame_token"]
    # above the names of the columns
    style: dict[str, Any] = {"x": _TABLE_CENTER_SHARE, "y": None}
    set_scene_title(ax, dataset, token, below="who sees whom", **style)
    return ax


def _corners(
    visibility: Visibility, view_range: float | None, width_ratio: float
) -> tuple[FloatArray, FloatArray]:
    """Return the lower left and the upper right corner of the view, shape (2,) each.

    It is a square, or wider by the ratio.
    """
    if view_range is not None:
        column = 0
        if visibility.ego in visibility.agents:
            column = visibility.agents.index(visibility.ego)
        middle, half = visibility.position[column], view_range
    else:
        middle, half = _square_of(visibility)
    sides = half * np.array([width_ratio, 1.0])
    return middle - sides, middle + sides


def _square_of(visibility: Visibility) -> tuple[FloatArray, float]:
    """Return the middle and half the side of a square that shows the agents and the pair.

    All boxes in it are shown as a whole.
    """
    corners = visibility.boxes.bottom_corners()[..., :2]
    is_involved = visibility.collides | visibility.records
    points = np.concatenate([visibility.position, *corners[is_involved]])
    middle, half = _square_about(points, _VIEW_MARGIN_M)
    among = (np.abs(corners - middle) < half).all(axis=-1).any(axis=-1)
    shown_points = np.concatenate([[middle - half, middle + half], *corners[among]])
    is_larger = np.abs(shown_points - middle).max() > half
    return _square_about(shown_points, _EDGE_SHARE * half * is_larger)


def _square_about(points: FloatArray, margin: float) -> tuple[FloatArray, float]:
    """Return the middle (2,) and half the side of a square around points (P, 2)."""
    low, high = points.min(axis=0), points.max(axis=0)
    half = float((high - low).max()) / 2 + margin
    return (low + high) / 2, max(_MIN_VIEW_RANGE_M, half)


def _draw_points(dataset: Dataset, visibility: Visibility, frame: str, ax: Axes) -> None:
    (left, right), (low, high) = ax.get_xlim(), ax.get_ylim()
    center = np.array([left + right, low + high]) / 2
    half = np.array([right - left, high - low]) / 2
    scenario, _, number = visibility.sample.rsplit("/", 2)
    absent = []
    for agent in visibility.agents:
        if not has_cloud(dataset, f"{scenario}/{agent}/{number}"):
            absent.append(agent)
    write_missing(ax, missing_clouds_text(absent))
    for agent in visibility.agents:
        if agent in absent:
            continue
        cloud = aggregate_point_cloud(dataset, visibility.sample, agents=[agent], frame=frame)
        draw_points_from_above(cloud.xyz, ax, center=center, half=half, color=AGENT_COLORS[agent])


def _draw_sight_lines(visibility: Visibility, ax: Axes) -> None:
    from matplotlib.collections import LineCollection

    row, column = np.nonzero(visibility.seen & visibility.collides[:, None])
    starts, ends = visibility.position[column], visibility.boxes.center[row, :2]
    lines = np.stack([starts, ends], axis=1)
    direction = lines[:, 1] - lines[:, 0]
    to_right = np.column_stack([direction[:, 1], -direction[:, 0]])
    length = np.linalg.norm(direction, axis=1, keepdims=True)
    unit = to_right / np.maximum(length, 1e-9)
    lines += (unit * _LINE_SHIFT_SHARE * np.ptp(ax.get_xlim()))[:, None]
    colors = [AGENT_COLORS[visibility.agents[number]] for number in column.tolist()]
    collection = LineCollection(list(lines), colors=colors, linewidths=1.2, alpha=0.8, zorder=2)
    ax.add_collection(collection)


def _draw_dots(visibility: Visibility, ax: Axes) -> None:
    from matplotlib.transforms import ScaledTranslation

    order, scale = in_drawing_order(visibility.agents), text_size() / SMALLEST_TEXT
    inches = ax.figure.dpi_scale_trans
    distance, height = _DOT_DISTANCE_PT * scale, _DOT_HEIGHT_PT * scale
    box_tops = visibility.boxes.bottom_corners()[..., 1].max(axis=1)
    tops = np.column_stack([visibility.boxes.center[:, 0], box_tops])
    side = len(order) / 2 * distance
    is_seen = visibility.seen.any(axis=1)
    keep_free(ax, tops[is_seen, None], margin=(-side, 0.0, side, 2 * height))
    for slot, agent in enumerate(order):
        x, y = tops[visibility.seen[:, visibility.agents.index(agent)]].T
        shift = (slot - (len(order) - 1) / 2) * distance
        ax.scatter(
            x,
            y,
            s=15 * scale**2,
            c=AGENT_COLORS[agent],
            edgecolors="white",
            linewidths=0.4,
            transform=ax.transData + ScaledTranslation(shift / 72, height / 72, inches),
            zorder=5,
            label=agent,
        )


def _write_hidden(visibility: Visibility, hidden: BoolArray, ax: Axes) -> None:
    words, chips = f"{short_name(visibility.ego)} cannot see", []
    for row in np.flatnonzero(hidden & visibility.collides).tolist():
        chips.append((words, visibility.boxes.center[row, :2].tolist()))
    place_chips(ax, chips, colors=[COLLIDER_COLOR] * len(chips))


def _draw_agents(visibility: Visibility, ax: Axes) -> None:
    scale = text_size() / SMALLEST_TEXT
    positions = dict(zip(visibility.agents, visibility.position.tolist(), strict=True))
    if current_style().few:
        chips = [(short_name(agent), position) for agent, position in positions.items()]
        place_chips(ax, chips, colors=[AGENT_COLORS[agent] for agent in positions])
    for agent, (x, y) in positions.items():
        ax.plot(
            x,
            y,
            "*",
            color=AGENT_COLORS[agent],
            markeredgecolor="white",
            markersize=10 * scale,
            zorder=5,
        )
    if visibility.ego in positions:
        x, y = positions[visibility.ego]
        ax.plot(
            x,
            y,
            "o",
            markersize=12 * scale,
            fillstyle="none",
            color=AGENT_COLORS[visibility.ego],
            zorder=5,
        )


def _draw_legend(
    visibility: Visibility, hidden: BoolArray, layers: Collection[Layer], ax: Axes
) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    ego = short_name(visibility.ego)
    handles = agent_handles(() if current_style().few else visibility.agents)
    if visibility.pair:
        handles.append(Patch(facecolor="none", edgecolor=COLLIDER_COLOR, label="colliding pair"))
    mark: dict[str, Any] = {"linestyle": "none", "color": MUTED_COLOR}
    handles.append(Line2D([], [], marker="*", markersize=8, label="an agent", **mark))
    if visibility.ego in visibility.agents:
        handles.append(
            Line2D(
                [],
                [],
                marker="o",
                markersize=9,
                fillstyle="none",
                label=f"whose view: {ego}",
                **mark,
            )
        )
    if "visibility" in layers and visibility.pair:
        handles.append(
            Line2D([], [], color=MUTED_COLOR, linewidth=1.2, label="sees one of the pair")
        )
    if hidden.any():
        handles.append(
            Patch(facecolor="none", edgecolor=OWN_COLOR, linestyle="--", label=f"{ego} cannot see")
        )
    title: dict[str, Any] = {
        "title": "dots above: who sees it",
        "title_fontsize": text_size(),
    }
    draw_legend_outside(ax, handles, columns=4, **title)


def _draw_column(visibility: Visibility, rows: IntArray, agent: str, column: int, ax: Axes) -> None:
    from matplotlib.patches import Rectangle

    agent_index = visibility.agents.index(agent)
    for y, row in enumerate(rows.tolist()):
        is_own = bool(visibility.own[row, agent_index])
        text, color = f"{visibility.points[row, agent_index]}", MUTED_COLOR
        if is_own:
            text = "itself"
        elif not visibility.annotated[row, agent_index]:
            text = "–"
        else:
            face, edge = "none", GRID_COLOR
            if visibility.seen[row, agent_index]:
                face = edge = AGENT_COLORS[agent]
                color = _legible_on(face)
            ax.add_patch(
                Rectangle((column - 0.3, y - 0.4), 0.6, 0.8, facecolor=face, edgecolor=edge)
            )
        ax.text(column, y, text, ha="center", va="center", fontsize=text_size(), color=color)


def _legible_on(color: str) -> str:
    """Return black or white, whichever is easier to read on a colour."""
    from matplotlib.colors import to_rgb

    luminance = np.dot(np.power(to_rgb(color), 2.2), (0.2126, 0.7152, 0.0722))
    if luminance > _MIN_BRIGHT_LUMINANCE:
        return "black"
    return "white"


def _selected(colors: list[str], selection: BoolArray) -> list[str]:
    return [colors[row] for row in np.flatnonzero(selection).tolist()]
