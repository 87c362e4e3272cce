"""Which agents see which actors, computed once and rendered from above or as a table."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, cast, get_args

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.render.bev import draw_points_from_above, draw_road
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
    Layers,
    axes_or_new,
    check_view_range,
    label_axes,
    lay_out_figure,
    layers_of,
    square_around,
    width_to_height,
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
from deepaccident_devkit.support.values import NamedValues
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

# Number of slashes in a frame's token, `<scenario_type>/<name>/<NNN>`; a sample's token has one
# more, for the agent.
_FRAME_TOKEN_SLASHES = 2
VISIBILITY_LAYERS: Final[Layers] = (
    "bev",
    "points",
    "boxes",
    "ids",
    "velocities",
    "visibility",
    "grid",
)
_DEFAULT_LAYERS: Layers = ("bev", "boxes", "visibility", "grid")
# Metres shown around the agents and the colliding pair.
_VIEW_MARGIN_M = 10.0
# Minimum number of metres shown to each side.
_MIN_VIEW_RANGE_M = 25.0
# Points from one agent's dot to the next.
_DOT_DISTANCE_PT = 4.6
# Points from an actor's box up to its dots.
_DOT_HEIGHT_PT = 5.0
# Share of the view's width by which a line is shifted to the right, so that two agents that see
# each other have two separate lines.
_LINE_SHIFT_SHARE = 0.006
# Share of half the view that stays free at its edges if it was enlarged to fit boxes.
_EDGE_SHARE = 0.05
# Approximate share of the table's width at which the middle of the picture is; the names of actors
# are on the left.
_TABLE_CENTER_SHARE = 0.36
_MAX_ROWS = 24
_MAX_SLIDE_ROWS = 14
# Relative luminance (as in sRGB) of a colour above which black text on it is easier to read.
_MIN_BRIGHT_LUMINANCE = 0.3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Visibility(FrozenArrays):
    """Which of A agents see which of N tracked actors at a moment; arrays are read-only.

    Attributes:
        sample: Token of the sample; its agent is the ego.
        agents: Observing agents, the ego first if it is one of them.
        boxes: Actors in one frame, by ascending id; an agent's own box has the agent's actor id.
        position: Agents' x and y in the frame of `boxes`, shape (A, 2), metres.
        actor: The agents' own actor ids, (A,) int64; −1 for the infrastructure, or if meta lacks
            the id.
        seen: Whether each agent counts as seeing each actor, (N, A) bool.
        annotated: Whether each agent's label contains each actor, (N, A) bool.
        points: Number of the agent's LiDAR points in the actor's box, as in the agent's label,
            (N, A) int64.
        pair: Actor ids of the colliding pair; empty without a collision.
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
        """Whether each actor is the agent itself, shape (N, A)."""
        actor_ids = self.boxes.actor_id[:, None]
        return np.asarray(actor_ids == self.actor)

    @property
    def collides(self) -> BoolArray:
        """Whether each actor is one of the colliding pair, shape (N,)."""
        pair = list(self.pair)
        return np.isin(self.boxes.actor_id, pair)

    @property
    def records(self) -> BoolArray:
        """Whether each actor is one of the agents, shape (N,)."""
        is_known = self.actor >= 0
        return np.isin(self.boxes.actor_id, self.actor[is_known])

    def hidden_from(self, agent: str) -> BoolArray:
        """Return which of the accident's actors an agent does not see, shape (N,).

        The accident's actors are the colliding pair and the agents, except this agent. All values
        are False if `agent` is not an observing agent, or if there is no collision.
        """
        if agent not in self.agents or not self.pair:
            return np.zeros(len(self.boxes), dtype=bool)
        column = self.agents.index(agent)
        is_known = self.seen[:, column] | self.own[:, column]
        is_involved = self.collides | self.records
        return np.asarray(is_involved & ~is_known)


def visibility_of(
    dataset: Dataset, moment: RowArgument, agents: Agents = None, frame: str = "ego"
) -> Visibility:
    """Return which agents see which annotated actors, in a coordinate frame of the sample.

    Args:
        dataset: The release.
        moment: Token or record of a sample, or of a frame, whose first sample is then used.
        agents: Observing agents, as for `visible_instances`, whose errors are raised.
        frame: Coordinate frame: `ego`, `lidar` or `world`.
    """
    sample = sample_at(dataset, moment)
    scenario, _, number = sample.rsplit("/", 2)
    names = cooperating_agents(dataset, sample, agents)
    boxes = cooperative_boxes(dataset, sample, frame=frame)
    boxes = boxes.select(boxes.actor_id != UNTRACKED_ID)
    frame_from_world = dataset.world_from(sample, frame).inverse()
    shape = (len(boxes), len(names))
    seen = np.zeros(shape, dtype=bool)
    annotated = np.zeros(shape, dtype=bool)
    points = np.zeros(shape, dtype=np.int64)
    position = np.zeros((len(names), 2))
    actor = np.full(len(names), UNTRACKED_ID, dtype=np.int64)
    for column, agent in enumerate(names):
        own_sample = sample_token(scenario, agent, int(number))
        visible = visible_actors(dataset, own_sample, agents=[agent])
        seen[:, column] = np.isin(boxes.actor_id, visible)
        label = dataset.boxes(own_sample, "lidar")
        ids = dataset.actor_ids(own_sample)
        is_own = label.actor_id == OWN_ACTOR_ID
        ids = np.where(is_own, UNTRACKED_ID, ids)
        _, row, label_row = np.intersect1d(boxes.actor_id, ids, return_indices=True)
        annotated[row, column] = True
        points[row, column] = label.num_lidar_pts[label_row]
        frame_from_ego = frame_from_world @ dataset.world_from(own_sample, "ego")
        position[column] = frame_from_ego.translation[:2]
        own_actor = dataset.agent.get(f"{scenario}/{agent}")["actor_id"]
        if own_actor is not None:
            actor[column] = own_actor
    collision = dataset.get("scenario", scenario)["collision"]
    pair: frozenset[int] = frozenset()
    if collision is not None:
        pair = frozenset(collision["ids"])
    return Visibility(
        sample=sample,
        agents=tuple(names),
        boxes=boxes,
        position=position,
        actor=actor,
        seen=seen,
        annotated=annotated,
        points=points,
        pair=pair,
    )


def sample_at(dataset: Dataset, moment: RowArgument) -> str:
    """Return the token of a sample, or of a frame's first sample.

    Raises:
        TokenError: The moment is neither a sample nor a frame.
    """
    token = str(moment["token"]) if isinstance(moment, Mapping) else moment
    if token.count("/") == _FRAME_TOKEN_SLASHES:
        first_sample = dataset.samples_of(token)[0]
        return first_sample["token"]
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

    Above each actor there is a row of dots, one for each agent that sees it; each agent has its own
    colour and its own place in the row. Lines lead from the agents (stars) to the actors of the
    colliding pair that they see. The sample's agent is circled. The accident's actors that this
    agent does not see are dashed; for the colliding pair, words say so too.

    Args:
        dataset: The release.
        moment: Token or record of a sample; or of a frame, whose first present agent is the ego.
        agents: Observing agents: names, a configuration or its name from the view of the ego; None
            for all present agents.
        frame: Coordinate frame: `ego`, `lidar` or `world`.
        view_range: Metres to each side of the ego; None shows all agents, the colliding pair, and
            the actors between them.
        layers: Any of `bev` (the road, if a BEV camera's picture or a town map is present),
            `boxes`, `visibility` (dots, lines, words), `grid` (these are the default), `points`
            (the observing agents' LiDAR), `ids` and `velocities`.
        ax: Axes to render on, new ones if None. In a figure of your own, the title is yours.

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
    low, high = _corners(visibility, view_range, width_to_height(ax))
    is_new = ax is None
    ax = axes_or_new(ax, (6, 6.9), is_map=True)
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", anchor="N")
    label_axes(ax, frame)
    ax.locator_params(nbins=6)  # each tick costs time
    token = dataset.get("sample", visibility.sample)["frame_token"]
    if "bev" in shown_layers:
        target_from_world = dataset.world_from(visibility.sample, frame).inverse()
        draw_road(dataset, token, [ax], target_from_world=target_from_world)
    if "points" in shown_layers:
        _draw_points(dataset, visibility, frame, ax)
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
        lay_out_figure(cast("Any", ax.figure))
    return ax


def _draw_boxes(visibility: Visibility, hidden: BoolArray, colors: list[str], ax: Axes) -> None:
    """Draw the boxes of all actors; the boxes of hidden actors are dashed."""
    hidden_style: NamedValues = {"fill": 0.0, "linestyle": (0, (2, 1)), "linewidths": 2.0}
    visible_style: NamedValues = {}
    for is_drawn, style in ((~hidden, visible_style), (hidden, hidden_style)):
        boxes = visibility.boxes.select(is_drawn)
        box_colors = [colors[row] for row in np.flatnonzero(is_drawn).tolist()]
        draw_boxes_from_above(boxes, ax, box_colors, **style)


@in_own_settings
def render_visibility_matrix(
    dataset: Dataset, moment: RowArgument, *, agents: Agents = None, ax: Axes | None = None
) -> Axes:
    """Render which agents see which actors as a table: a row per actor, a column per agent.

    A filled cell means that the agent sees the actor, an empty one that it does not. The number in
    a cell counts the agent's LiDAR points in the actor's box; a dash means that the agent's label
    lacks the actor. A key below explains this. The colliding pair comes first, then the agents,
    then the other actors, the ones that most agents see first.

    Args:
        dataset: The release.
        moment: Token or record of a sample, or of a frame.
        agents: Observing agents, as in `render_visibility`.
        ax: Axes to render on, new ones if None. In a figure of your own, the title is yours.

    Returns:
        The axes; rows are numbered from 0 at the top.

    Raises:
        TokenError: No such sample or frame.
        ChoiceError: No such agent or configuration.
        NotAvailableError: An agent is not in this (partial) release.
    """
    visibility = visibility_of(dataset, moment, agents)
    is_slide = current_style().layout == "slide"
    observer_counts = visibility.seen.sum(axis=1)
    actor_ids = visibility.boxes.actor_id
    keys = (actor_ids, -observer_counts, ~visibility.records, ~visibility.collides)
    all_rows = np.lexsort(keys)
    max_rows = _MAX_SLIDE_ROWS if is_slide else _MAX_ROWS
    rows = all_rows[:max_rows]
    columns = in_drawing_order(visibility.agents)
    ax = axes_or_new(ax, (1.4 + 0.75 * len(columns), 1.2 + 0.29 * max(len(rows), 4)))
    for column, agent in enumerate(columns):
        _draw_column(visibility, rows, agent, column, ax)
    categories = visibility.boxes.category_names
    row_names = [f"{categories[row]} {actor_ids[row]}" for row in rows.tolist()]
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
    # y is None, so that the title is above the names of the columns
    set_scene_title(ax, dataset, token, below="who sees whom", x=_TABLE_CENTER_SHARE, y=None)
    return ax


def _corners(
    visibility: Visibility, view_range: float | None, width_ratio: float
) -> tuple[FloatArray, FloatArray]:
    """Return the lower left and the upper right corner of the view, shape (2,) each.

    The view is `width_ratio` times as wide as high.
    """
    if view_range is not None:
        column = 0
        if visibility.ego in visibility.agents:
            column = visibility.agents.index(visibility.ego)
        middle = visibility.position[column]
        half_height = view_range
    else:
        middle, half_height = _square_of(visibility)
    half_size = half_height * np.array([width_ratio, 1.0])
    return middle - half_size, middle + half_size


def _square_of(visibility: Visibility) -> tuple[FloatArray, float]:
    """Return the centre (2,), and half the side, of a square that shows the agents and the pair.

    It is large enough to show whole all boxes that are partly in it.
    """
    corners = visibility.boxes.bottom_corners()[..., :2]
    is_involved = visibility.collides | visibility.records
    points = np.concatenate([visibility.position, *corners[is_involved]])
    middle, half = _square_about(points, _VIEW_MARGIN_M)
    is_inside = (np.abs(corners - middle) < half).all(axis=-1)
    is_shown = is_inside.any(axis=-1)
    shown_points = np.concatenate([[middle - half, middle + half], *corners[is_shown]])
    is_larger = np.abs(shown_points - middle).max() > half
    return _square_about(shown_points, _EDGE_SHARE * half * is_larger)


def _square_about(points: FloatArray, margin: float) -> tuple[FloatArray, float]:
    """Return the centre (2,), and half the side, of a square around points (P, 2).

    The square extends at least `_MIN_VIEW_RANGE_M` to each side.
    """
    middle, half = square_around(points, margin)
    return middle, max(_MIN_VIEW_RANGE_M, half)


def _draw_points(dataset: Dataset, visibility: Visibility, frame: str, ax: Axes) -> None:
    low, high = np.array([ax.get_xlim(), ax.get_ylim()]).T
    center = (low + high) / 2
    half = (high - low) / 2
    scenario, _, number = visibility.sample.rsplit("/", 2)
    absent_agents = []
    for agent in visibility.agents:
        if not has_cloud(dataset, f"{scenario}/{agent}/{number}"):
            absent_agents.append(agent)
            continue
        cloud = aggregate_point_cloud(dataset, visibility.sample, agents=[agent], frame=frame)
        draw_points_from_above(cloud.xyz, ax, center=center, half=half, color=AGENT_COLORS[agent])
    write_missing(ax, missing_clouds_text(absent_agents))


def _draw_sight_lines(visibility: Visibility, ax: Axes) -> None:
    from matplotlib.collections import LineCollection

    row, column = np.nonzero(visibility.seen & visibility.collides[:, None])
    starts = visibility.position[column]
    ends = visibility.boxes.center[row, :2]
    x, y = (ends - starts).T
    to_right = np.column_stack([y, -x])
    length = np.linalg.norm(to_right, axis=1, keepdims=True)
    unit_to_right = to_right / np.maximum(length, 1e-9)
    shift = unit_to_right * _LINE_SHIFT_SHARE * np.ptp(ax.get_xlim())
    lines = np.stack([starts + shift, ends + shift], axis=1)
    agents = [visibility.agents[number] for number in column.tolist()]
    colors = [AGENT_COLORS[agent] for agent in agents]
    collection = LineCollection(list(lines), colors=colors, linewidths=1.2, alpha=0.8, zorder=2)
    ax.add_collection(collection)


def _draw_dots(visibility: Visibility, ax: Axes) -> None:
    from matplotlib.transforms import ScaledTranslation

    order = in_drawing_order(visibility.agents)
    scale = text_size() / SMALLEST_TEXT
    inches = ax.figure.dpi_scale_trans
    distance = _DOT_DISTANCE_PT * scale
    height = _DOT_HEIGHT_PT * scale
    box_tops = visibility.boxes.bottom_corners()[..., 1].max(axis=1)
    tops = np.column_stack([visibility.boxes.center[:, 0], box_tops])
    side = len(order) / 2 * distance
    is_seen = visibility.seen.any(axis=1)
    keep_free(ax, tops[is_seen, None], margin=(-side, 0.0, side, 2 * height))
    for slot, agent in enumerate(order):
        column = visibility.agents.index(agent)
        x, y = tops[visibility.seen[:, column]].T
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
    """Write next to each colliding actor that the sample's agent does not see that it is hidden."""
    words = f"{short_name(visibility.ego)} cannot see"
    centers = visibility.boxes.center[hidden & visibility.collides, :2]
    chips = [(words, center) for center in centers.tolist()]
    place_chips(ax, chips, colors=[COLLIDER_COLOR] * len(chips))


def _draw_agents(visibility: Visibility, ax: Axes) -> None:
    scale = text_size() / SMALLEST_TEXT
    positions = dict(zip(visibility.agents, visibility.position.tolist(), strict=True))
    if current_style().shows_few_panels:
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
    handles = agent_handles(() if current_style().shows_few_panels else visibility.agents)
    if visibility.pair:
        handles.append(Patch(facecolor="none", edgecolor=COLLIDER_COLOR, label="colliding pair"))
    mark: NamedValues = {"linestyle": "none", "color": MUTED_COLOR}
    handles.append(Line2D([], [], marker="*", markersize=8, label="recording agent", **mark))
    if visibility.ego in visibility.agents:
        handles.append(
            Line2D(
                [],
                [],
                marker="o",
                markersize=9,
                fillstyle="none",
                label=f"reference agent: {ego}",
                **mark,
            )
        )
    if "visibility" in layers and visibility.pair:
        handles.append(
            Line2D([], [], color=MUTED_COLOR, linewidth=1.2, label="line of sight to the pair")
        )
    if hidden.any():
        handles.append(
            Patch(facecolor="none", edgecolor=OWN_COLOR, linestyle="--", label=f"hidden from {ego}")
        )
    draw_legend_outside(
        ax, handles, columns=4, title="Dots: agents that see the actor", title_fontsize=text_size()
    )


def _draw_column(visibility: Visibility, rows: IntArray, agent: str, column: int, ax: Axes) -> None:
    from matplotlib.patches import Rectangle

    agent_index = visibility.agents.index(agent)
    for y, row in enumerate(rows.tolist()):
        is_own = bool(visibility.own[row, agent_index])
        text = f"{visibility.points[row, agent_index]}"
        color = MUTED_COLOR
        if is_own:
            text = "itself"
        elif not visibility.annotated[row, agent_index]:
            text = "–"
        else:
            face = "none"
            edge = GRID_COLOR
            if visibility.seen[row, agent_index]:
                face = AGENT_COLORS[agent]
                edge = face
                color = _text_color_on(face)
            ax.add_patch(
                Rectangle((column - 0.3, y - 0.4), 0.6, 0.8, facecolor=face, edgecolor=edge)
            )
        ax.text(column, y, text, ha="center", va="center", fontsize=text_size(), color=color)


def _text_color_on(color: str) -> str:
    """Return black or white, whichever is easier to read on the colour."""
    from matplotlib.colors import to_rgb

    linear_rgb = np.power(to_rgb(color), 2.2)
    luminance = np.dot(linear_rgb, (0.2126, 0.7152, 0.0722))
    if luminance > _MIN_BRIGHT_LUMINANCE:
        return "black"
    return "white"
