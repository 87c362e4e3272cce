"""Who sees whom, computed once and rendered from above or as a table."""

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
    axis_words,
    check_view_range,
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

# The slashes of a frame's token, `<scenario_type>/<name>/<NNN>`; a sample's token has one more, for the agent.
_FRAME_SLASHES: Final = 2
VISIBILITY_LAYERS: Final[tuple[Layer, ...]] = (
    "points",
    "boxes",
    "ids",
    "velocities",
    "visibility",
    "grid",
)
_SHOWN: Final[tuple[Layer, ...]] = ("boxes", "visibility", "grid")
# Metres that are shown around the agents and the colliding pair.
_MARGIN: Final = 10.0
# At least so many metres are shown to each side.
_LEAST: Final = 25.0
# Points from one agent's dot to the next.
_SLOT: Final = 4.6
# Points from an actor's box up to its dots.
_ABOVE: Final = 5.0
# Of the width of the view that a line lies to the right of its way, so that two that look at each other have two.
_ASIDE: Final = 0.006
# Of half the view, between its edge and a box that has made it larger.
_EDGE: Final = 0.05
# Of the table's width, about: where the middle of the picture is, with the names of actors on the left.
_MIDDLE: Final = 0.36
_MOST_ROWS: Final = 24
_ROWS_OF_A_SLIDE: Final = 14
# Relative luminance (as in sRGB) of a colour from which black text on it is easier to read.
_BRIGHT: Final = 0.3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Visibility(FrozenArrays):
    """N tracked actors of a moment and the A agents that may see them; arrays are read-only.

    Attributes:
        sample: token of the sample whose agent is the ego.
        agents: the agents that look, the ego first if it is one of them.
        boxes: the actors in one frame, by ascending id; an agent's own has the agent's actor id.
        place: (A, 2) x and y of the agents in that frame, metres.
        actor: (A,) int64 the agents' own actor ids; −1 for the infrastructure, and if meta does not give it.
        seen: (N, A) bool: whether the agent counts as seeing the actor.
        annotated: (N, A) bool: whether its label has the actor at all.
        points: (N, A) int64: LiDAR points of the agent in the box that its label has.
        pair: actor ids of the two that collide; empty if nobody does.
    """

    sample: str
    agents: tuple[str, ...]
    boxes: Boxes
    place: FloatArray
    actor: IntArray
    seen: BoolArray
    annotated: BoolArray
    points: IntArray
    pair: frozenset[int]

    @property
    def ego(self) -> str:
        """The name of the sample's agent."""
        return self.sample.rsplit("/", 2)[1]

    @property
    def own(self) -> BoolArray:
        """(N, A) whether the actor is the agent itself."""
        return np.asarray(self.boxes.actor_id[:, None] == self.actor)

    @property
    def collides(self) -> BoolArray:
        """(N,) whether the actor is one of the colliding pair."""
        return np.isin(self.boxes.actor_id, [*self.pair])

    @property
    def records(self) -> BoolArray:
        """(N,) whether the actor is one of the agents."""
        return np.isin(self.boxes.actor_id, self.actor[self.actor >= 0])

    def hidden_from(self, agent: str) -> BoolArray:
        """(N,) which actors of the accident (the pair and the agents, without itself) an agent does not see.

        All are False if the agent is not one of those that look, or if nobody collides.
        """
        if agent not in self.agents or not self.pair:
            return np.zeros(len(self.boxes), dtype=bool)
        column = self.agents.index(agent)
        return np.asarray(
            (self.collides | self.records) & ~self.seen[:, column] & ~self.own[:, column]
        )


def visibility_of(
    dataset: Dataset, moment: RowArgument, agents: Agents = None, frame: str = "ego"
) -> Visibility:
    """Which of some agents see which of the actors that any agent annotated, in a coordinate frame of the sample.

    The moment is a sample, or a frame: then its first agent's sample is taken. Agents are as `visible_instances` takes
    them; its errors are raised.
    """
    sample = sample_at(dataset, moment)
    scenario, _, number = sample.rsplit("/", 2)
    looking = cooperating_agents(dataset, sample, agents)
    there = cooperative_boxes(dataset, sample, frame=frame)
    boxes = there.select(there.actor_id != UNTRACKED_ID)
    frame_from_world = dataset.world_from(sample, frame).inverse()
    shape = len(boxes), len(looking)
    seen, annotated = np.zeros(shape, dtype=bool), np.zeros(shape, dtype=bool)
    points, place = np.zeros(shape, dtype=np.int64), np.zeros((len(looking), 2))
    for column, agent in enumerate(looking):
        own = sample_token(scenario, agent, int(number))
        seen[:, column] = np.isin(boxes.actor_id, visible_actors(dataset, own, agents=[agent]))
        label, ids = dataset.boxes(own, "lidar"), dataset.actor_ids(own)
        ids = np.where(label.actor_id == OWN_ACTOR_ID, UNTRACKED_ID, ids)
        _, row, label_row = np.intersect1d(boxes.actor_id, ids, return_indices=True)
        annotated[row, column], points[row, column] = True, label.num_lidar_pts[label_row]
        place[column] = (frame_from_world @ dataset.world_from(own, "ego")).translation[:2]
    collision = dataset.get("scenario", scenario)["collision"]
    actors = (dataset.agent.get(f"{scenario}/{agent}")["actor_id"] for agent in looking)
    return Visibility(
        sample=sample,
        agents=tuple(looking),
        boxes=boxes,
        place=place,
        actor=np.array(
            [UNTRACKED_ID if actor is None else actor for actor in actors], dtype=np.int64
        ),
        seen=seen,
        annotated=annotated,
        points=points,
        pair=frozenset() if collision is None else frozenset(collision["ids"]),
    )


def sample_at(dataset: Dataset, moment: RowArgument) -> str:
    """Token of a sample, or of a frame's first sample; raises TokenError if `moment` is neither."""
    token = str(moment["token"]) if isinstance(moment, Mapping) else moment
    is_frame = token.count("/") == _FRAME_SLASHES
    return str(
        (dataset.samples_of(token)[0] if is_frame else dataset.get("sample", token))["token"]
    )


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
    """Render who sees whom, from above: each actor has a dot for each agent that sees it by the released rule.

    A dot has its agent's colour and its own place in the row, and lines go from the agents (stars) to those of the
    colliding pair that they see. The sample's agent has a circle. The accident's actors that it does not see are
    dashed, and for the colliding pair words say so.

    Args:
        dataset: the release.
        moment: token or record of a sample, or of a frame: then the first agent there is the ego.
        agents: the agents that look: names, a configuration or its name as seen from the ego; None for all that are
            there.
        frame: `ego`, `lidar` or `world`.
        view_range: metres to each side of the ego; None shows all agents, the colliding pair, and who is among them.
        layers: `boxes`, `visibility` (dots, lines, words) and `grid` are the default; also `points` (the LiDAR of the
            agents that look), `ids` and `velocities`.
        ax: axes to render on; new ones if None.

    Returns:
        The axes, in metres of the frame.

    Raises:
        TokenError: no such sample or frame.
        ChoiceError: no such agent, configuration, frame or layer, or `view_range` is not above 0.
        NotAvailableError: an agent is not in this (partial) release.
    """
    shown = layers_of(layers, _SHOWN, VISIBILITY_LAYERS)
    frame = choice("frame", frame, get_args(Frame))
    if view_range is not None:
        check_view_range(view_range)
    known = visibility_of(dataset, moment, agents, frame)
    low, high = _view(known, view_range, widening(ax))
    own_figure, ax = ax is None, axes_or_new(ax, (6, 6.9))
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", anchor="N")
    words = axis_words(frame)
    ax.set(xlabel=words[0], ylabel=words[1])
    ax.locator_params(nbins=6)  # each tick costs time
    if "points" in shown:
        _draw_points(dataset, known, frame, ax)
    set_scene_title(
        ax, dataset, dataset.get("sample", known.sample)["frame_token"], "who sees whom"
    )
    colors = role_colors(dataset, known.sample, known.boxes)
    hidden = known.hidden_from(known.ego)
    if "boxes" in shown:
        draw_boxes_from_above(known.boxes.select(~hidden), ax, _chosen(colors, ~hidden))
        unseen = known.boxes.select(hidden)
        draw_boxes_from_above(
            unseen, ax, _chosen(colors, hidden), fill=0.0, linestyle=(0, (2, 1)), linewidths=2.0
        )
    if "velocities" in shown:
        draw_velocities_from_above(known.boxes, ax, colors)
    if "visibility" in shown:
        _draw_sight_lines(known, ax)
        _draw_dots(known, ax)
        _write_hidden(known, hidden, ax)
    if "ids" in shown:
        draw_ids_from_above(known.boxes, ax, colors)
    _draw_agents(known, ax)
    _draw_legend(known, hidden, shown, ax)
    if "grid" in shown:
        with_light_grid(ax, "both")
    if own_figure:
        settled(cast("Any", ax.figure))
    return ax


@in_own_settings
def render_visibility_matrix(
    dataset: Dataset, moment: RowArgument, *, agents: Agents = None, ax: Axes | None = None
) -> Axes:
    """Render who sees whom as a table: one row for each actor, one column for each agent.

    A filled cell means that the agent sees the actor, an empty one that it does not. The number is the agent's LiDAR
    points in the box; if its label lacks the actor, there is a dash. A key below says so. The colliding pair comes
    first, then the agents, then the actors that most agents see.

    Args:
        dataset: the release.
        moment: token or record of a sample, or of a frame.
        agents: the agents that look, as in `render_visibility`.
        ax: axes to render on; new ones if None.

    Returns:
        The axes, with rows counted from 0 downwards.

    Raises:
        TokenError: no such sample or frame.
        ChoiceError: no such agent or configuration.
        NotAvailableError: an agent is not in this (partial) release.
    """
    known = visibility_of(dataset, moment, agents)
    rows = np.lexsort(
        (known.boxes.actor_id, -known.seen.sum(axis=1), ~known.records, ~known.collides)
    )
    shown = rows[: _ROWS_OF_A_SLIDE if current_style().room == "slide" else _MOST_ROWS]
    columns = in_drawing_order(known.agents)
    ax = axes_or_new(ax, (1.4 + 0.75 * len(columns), 1.2 + 0.29 * max(len(shown), 4)))
    for column, agent in enumerate(columns):
        _draw_column(known, shown, agent, column, ax)
    names = known.boxes.category_names
    words = [f"{names[row]} {known.boxes.actor_id[row]}" for row in shown.tolist()]
    ax.set_yticks(range(len(shown)), words, fontsize=text_size())
    for label, row in zip(ax.get_yticklabels(), shown.tolist(), strict=True):
        label.set_color(COLLIDER_COLOR if known.collides[row] else OWN_COLOR)
    heads = [short_name(agent) for agent in columns]
    ax.set_xticks(
        range(len(columns)),
        heads,
        fontsize=text_size(),
        rotation=0 if current_style().room == "slide" else 90,
    )
    ax.xaxis.tick_top()
    ax.set(xlim=(-0.5, len(columns) - 0.5), ylim=(max(len(shown), 1) - 0.5, -0.5))
    ax.tick_params(length=0)
    ax.spines[:].set_visible(False)
    more = len(rows) - len(shown)
    key = ["filled: seen; number: LiDAR points;", "–: not in the agent's label"]
    ax.set_xlabel(
        "\n".join([*key, *([f"{more} more actors"] if more else [])]), fontsize=text_size()
    )
    above: dict[str, Any] = {"x": _MIDDLE, "y": None}  # above the heads of the columns
    set_scene_title(
        ax,
        dataset,
        dataset.get("sample", known.sample)["frame_token"],
        below="who sees whom",
        **above,
    )
    return ax


def _view(
    known: Visibility, view_range: float | None, wide: float
) -> tuple[FloatArray, FloatArray]:
    """The lower left and the upper right corner, (2,) each, of the square that is shown, or of a wider one."""
    if view_range is not None:
        column = known.agents.index(known.ego) if known.ego in known.agents else 0
        middle, half = known.place[column], view_range
    else:
        corners = known.boxes.bottom_corners()[..., :2]
        middle, half = _square_about(
            np.concatenate([known.place, *corners[known.collides | known.records]]), _MARGIN
        )
        among = (np.abs(corners - middle) < half).all(axis=-1).any(axis=-1)  # none of them is cut
        whole = np.concatenate([[middle - half, middle + half], *corners[among]])
        middle, half = _square_about(whole, _EDGE * half * (np.abs(whole - middle).max() > half))
    sides = half * np.array([wide, 1.0])
    return middle - sides, middle + sides


def _square_about(places: FloatArray, margin: float) -> tuple[FloatArray, float]:
    """The middle (2,) and half the side of a square around places (P, 2)."""
    low, high = places.min(axis=0), places.max(axis=0)
    return (low + high) / 2, max(_LEAST, float((high - low).max()) / 2 + margin)


def _draw_points(dataset: Dataset, known: Visibility, frame: str, ax: Axes) -> None:
    (left, right), (low, high) = ax.get_xlim(), ax.get_ylim()
    middle, half = (
        np.array([left + right, low + high]) / 2,
        np.array([right - left, high - low]) / 2,
    )
    scenario, _, number = known.sample.rsplit("/", 2)
    absent = [
        agent for agent in known.agents if not has_cloud(dataset, f"{scenario}/{agent}/{number}")
    ]
    write_missing(ax, missing_clouds_text(absent))
    for agent in known.agents:
        if agent in absent:
            continue
        cloud = aggregate_point_cloud(dataset, known.sample, agents=[agent], frame=frame)
        draw_points_from_above(cloud.xyz, ax, center=middle, half=half, color=AGENT_COLORS[agent])


def _draw_sight_lines(known: Visibility, ax: Axes) -> None:
    from matplotlib.collections import LineCollection

    row, column = np.nonzero(known.seen & known.collides[:, None])
    lines = np.stack([known.place[column], known.boxes.center[row, :2]], axis=1)
    way = lines[:, 1] - lines[:, 0]
    right = np.column_stack([way[:, 1], -way[:, 0]]) / np.maximum(
        np.linalg.norm(way, axis=1, keepdims=True), 1e-9
    )
    lines += (right * _ASIDE * np.ptp(ax.get_xlim()))[:, None]
    colors = [AGENT_COLORS[known.agents[each]] for each in column.tolist()]
    ax.add_collection(
        LineCollection(list(lines), colors=colors, linewidths=1.2, alpha=0.8, zorder=2)
    )


def _draw_dots(known: Visibility, ax: Axes) -> None:
    from matplotlib.transforms import ScaledTranslation

    order, scale = in_drawing_order(known.agents), text_size() / SMALLEST_TEXT
    inches, slot_width, above = ax.figure.dpi_scale_trans, _SLOT * scale, _ABOVE * scale
    tops = np.column_stack(
        [known.boxes.center[:, 0], known.boxes.bottom_corners()[..., 1].max(axis=1)]
    )
    side = len(order) / 2 * slot_width
    keep_free(ax, tops[known.seen.any(axis=1), None], margin=(-side, 0.0, side, 2 * above))
    for slot, agent in enumerate(order):
        x, y = tops[known.seen[:, known.agents.index(agent)]].T
        beside = ScaledTranslation(
            (slot - (len(order) - 1) / 2) * slot_width / 72, above / 72, inches
        )
        ax.scatter(
            x,
            y,
            s=15 * scale**2,
            c=AGENT_COLORS[agent],
            edgecolors="white",
            linewidths=0.4,
            transform=ax.transData + beside,
            zorder=5,
            label=agent,
        )


def _write_hidden(known: Visibility, hidden: BoolArray, ax: Axes) -> None:
    chips = [
        (f"{short_name(known.ego)} cannot see", known.boxes.center[row, :2].tolist())
        for row in np.flatnonzero(hidden & known.collides).tolist()
    ]
    place_chips(ax, chips, colors=[COLLIDER_COLOR] * len(chips))


def _draw_agents(known: Visibility, ax: Axes) -> None:
    scale = text_size() / SMALLEST_TEXT
    if current_style().few:
        names = [
            (short_name(agent), place)
            for agent, place in zip(known.agents, known.place.tolist(), strict=True)
        ]
        place_chips(ax, names, colors=[AGENT_COLORS[agent] for agent in known.agents])
    for agent, (x, y) in zip(known.agents, known.place.tolist(), strict=True):
        ax.plot(
            x,
            y,
            "*",
            color=AGENT_COLORS[agent],
            markeredgecolor="white",
            markersize=10 * scale,
            zorder=5,
        )
    if known.ego in known.agents:
        x, y = known.place[known.agents.index(known.ego)].tolist()
        ax.plot(
            x,
            y,
            "o",
            markersize=12 * scale,
            fillstyle="none",
            color=AGENT_COLORS[known.ego],
            zorder=5,
        )


def _draw_legend(known: Visibility, hidden: BoolArray, shown: Collection[Layer], ax: Axes) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles, ego = agent_handles(() if current_style().few else known.agents), short_name(known.ego)
    if known.pair:
        handles.append(Patch(facecolor="none", edgecolor=COLLIDER_COLOR, label="colliding pair"))
    mark: dict[str, Any] = {"linestyle": "none", "color": MUTED_COLOR}
    handles.append(Line2D([], [], marker="*", markersize=8, label="an agent", **mark))
    if known.ego in known.agents:
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
    if "visibility" in shown and known.pair:
        handles.append(
            Line2D([], [], color=MUTED_COLOR, linewidth=1.2, label="sees one of the pair")
        )
    if hidden.any():
        handles.append(
            Patch(facecolor="none", edgecolor=OWN_COLOR, linestyle="--", label=f"{ego} cannot see")
        )
    draw_legend_outside(
        ax, handles, columns=4, title="dots above: who sees it", title_fontsize=text_size()
    )


def _draw_column(known: Visibility, rows: IntArray, agent: str, column: int, ax: Axes) -> None:
    from matplotlib.patches import Rectangle

    source = known.agents.index(agent)
    for place, row in enumerate(rows.tolist()):
        seen, own = bool(known.seen[row, source]), bool(known.own[row, source])
        if own or not known.annotated[row, source]:
            ax.text(
                column,
                place,
                "itself" if own else "–",
                ha="center",
                va="center",
                fontsize=text_size(),
                color=MUTED_COLOR,
            )
            continue
        face, edge = (AGENT_COLORS[agent],) * 2 if seen else ("none", GRID_COLOR)
        ax.add_patch(
            Rectangle((column - 0.3, place - 0.4), 0.6, 0.8, facecolor=face, edgecolor=edge)
        )
        ink = _legible_on(AGENT_COLORS[agent]) if seen else MUTED_COLOR
        ax.text(
            column,
            place,
            f"{known.points[row, source]}",
            ha="center",
            va="center",
            fontsize=text_size(),
            color=ink,
        )


def _legible_on(color: str) -> str:
    """Black or white, the one that is easier to read on a colour."""
    from matplotlib.colors import to_rgb

    luminance = np.dot(np.power(to_rgb(color), 2.2), (0.2126, 0.7152, 0.0722))
    return "black" if luminance > _BRIGHT else "white"


def _chosen(colors: list[str], which: BoolArray) -> list[str]:
    return [color for color, take in zip(colors, which.tolist(), strict=True) if take]
