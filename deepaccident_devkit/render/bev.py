"""A moment from above: boxes, points, and what the BEV camera saw as the ground."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, get_args

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.geometry import Boxes, LidarPointCloud
from deepaccident_devkit.geometry.boxes import concatenate
from deepaccident_devkit.render.boxes import (
    at_once,
    collider_ids,
    draw_actors_from_above,
    draw_trails,
    label_ids,
    recorder_ids,
    role_colors,
    write_beside,
)
from deepaccident_devkit.render.captions import (
    absence_text,
    draw_legend_outside,
    handles_from_above,
    has_cloud,
    is_there,
    missing_clouds_text,
    set_scene_title,
    write_missing,
)
from deepaccident_devkit.render.chips import keep_free
from deepaccident_devkit.render.figures import (
    Layer,
    axes_or_new,
    axis_words,
    check_view_range,
    layers_of,
    widening,
)
from deepaccident_devkit.render.ground import draw_underlay
from deepaccident_devkit.render.styles import (
    AGENT_COLORS,
    CASING_COLOR,
    COLLIDER_COLOR,
    GRID_COLOR,
    OWN_COLOR,
    POINT_COLOR,
    in_own_settings,
)
from deepaccident_devkit.render.town_map import draw_town_map, map_beneath
from deepaccident_devkit.support.arrays import FloatArray
from deepaccident_devkit.support.text import settle_choices
from deepaccident_devkit.taxonomy import BEV_CAMERA, AgentName, Frame, short_name
from deepaccident_devkit.v2x import (
    Agents,
    Link,
    PoseNoise,
    aggregate_point_cloud,
    cooperating_agents,
    cooperative_boxes,
    transform,
)
from deepaccident_devkit.v2x.messages import messages

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from deepaccident_devkit.tables.records import SampleRecord

BEV_LAYERS: Final[tuple[Layer, ...]] = (
    "map",
    "bev",
    "points",
    "boxes",
    "ids",
    "velocities",
    "trajectories",
    "grid",
)
BEV_DEFAULT: Final[tuple[Layer, ...]] = ("bev", "points", "boxes", "grid")
# What a view from above shows: the colours of its boxes and, of several agents, those whose points it has.
_ViewContent = tuple[frozenset[str], tuple[AgentName, ...]]
_OF_BOXES: Final = frozenset(("boxes", "ids", "velocities", "trajectories"))
# Metres outside the picture up to which a box may still reach into it.
_BEYOND: Final = 5.0
# An arrow head, metres of an agent's ego frame.
_MARK: Final = np.array([[1.8, 0.0], [-1.2, 1.1], [-0.6, 0.0], [-1.2, -1.1]])
# How opaque agents' points are.
_PALE: Final = 0.55


@dataclass(frozen=True, slots=True, kw_only=True)
class BevView:
    """Which part of a moment is rendered from above, and from whose data.

    Attributes:
        view_range: metres shown to each side of the agent.
        frame: of the axes: `ego`, `lidar` or `world`.
        agents: whose points and boxes.
        link: what happens to the partners' data.
        sweeps: frames of points, the present included.
        seconds: how far trajectories reach back and ahead.
        center: of the picture, metres of `frame`; None for the agent's place.
        wide: how much farther it shows to the left and the right of the picture than up and down.
        beside: whether a picture beside it shows the surroundings, so that nobody misses the BEV camera's.
    """

    view_range: float = 50.0
    frame: str = "ego"
    agents: Agents = "single"
    link: Link | None = None
    sweeps: int = 1
    seconds: tuple[float, float] = (1.0, 3.0)
    center: tuple[float, float] | None = None
    wide: float = 1.0
    beside: bool = False

    @property
    def half(self) -> FloatArray:
        """(2,) metres from the centre to the right and the upper edge."""
        return np.array([self.wide * self.view_range, self.view_range])

    def __post_init__(self) -> None:
        """Check the frame and the range; raises ChoiceError."""
        check_view_range(self.view_range)
        settle_choices(self, {"frame": get_args(Frame)})


@in_own_settings
def render_bev(  # noqa: PLR0913 - each is a choice that stands on its own in a notebook
    dataset: Dataset,
    sample: RowArgument,
    *,
    view_range: float = 50.0,
    agents: Agents = "single",
    frame: Frame = "ego",
    layers: Iterable[Layer] | None = None,
    link: Link | None = None,
    sweeps: int = 1,
    seconds: tuple[float, float] = (1.0, 3.0),
    ax: Axes | None = None,
) -> Axes:
    """Render a moment from above: boxes, LiDAR points and more, in one coordinate frame, metres.

    The colliding pair is red, other recording vehicles have their agents' hues, all others a shade for their category.
    Agents have a mark in their hue, the sample's own with a dark edge; several agents have names, and their points have
    their hues. The title says what a link does, and how many sweeps there are.

    Args:
        dataset: the release.
        sample: token or record: its agent is in the middle, its frame is the present.
        view_range: metres shown to each side of the agent.
        agents: whose points and boxes: names of agents, a configuration or its name, or None for all that are there;
            by default only the sample's own agent. If there are several agents, each actor has one box.
        frame: of the axes: `ego` or `lidar` (forward to the right, left up), or `world`.
        layers: some of `map` (the ground of the town as all its recordings saw it, `town_map`; made if none is kept,
            which takes a while), `bev` (the agent's BEV camera, in pale colours, over the map), `points`, `boxes`,
            `ids`, `velocities` (arrows for one second), `trajectories` (past thin, future thick, fading) and `grid`; by
            default bev, points, boxes, grid. Points and the BEV camera are left out if their files are missing; the
            title says so (of the BEV camera only if there are no points). A town map that is kept takes the place of a
            BEV camera's picture that is missing.
        link: what happens to the partners' data; None for nothing.
        sweeps: how many frames of points, the present included.
        seconds: how far trajectories reach back and ahead.
        ax: axes to render on; new ones if None.

    Returns:
        The axes, in metres of `frame`.

    Raises:
        TokenError: no such sample.
        ChoiceError: no such layer, frame, agent or configuration, `sweeps` is no whole number from 1, or `view_range`
            is not above 0.
        NotAvailableError: an agent is not in this (partial) release.
        ConfigError: `link` is no Link, or its latency is longer than the scenario's past.
    """
    chosen = layers_of(layers, BEV_DEFAULT, BEV_LAYERS)
    view = BevView(
        view_range=view_range,
        frame=frame,
        agents=agents,
        link=link,
        sweeps=sweeps,
        seconds=seconds,
        wide=widening(ax),
    )
    names = cooperating_agents(dataset, sample, agents)
    ax = axes_or_new(ax, (6, 6.6))
    colors, clouds = draw_bev(dataset, sample, view, chosen, ax)
    made = [f"{sweeps} sweeps"] if sweeps > 1 else []
    if link is not None and link != Link(seed=link.seed) and len(names) > 1:
        made.insert(0, link_words(link))
    set_scene_title(ax, dataset, dataset.get("sample", sample)["token"], below=", ".join(made))
    draw_legend_outside(ax, handles_from_above(colors, clouds), columns=5)
    return ax


def draw_bev(
    dataset: Dataset, sample: RowArgument, view: BevView, layers: frozenset[Layer], ax: Axes
) -> _ViewContent:
    """Render a panel of `render_bev`, with its arguments and errors; returns what a legend explains."""
    record = dataset.sample[dataset.getind("sample", sample)]
    names = cooperating_agents(dataset, record, view.agents)
    target_from_world = dataset.world_from(record, view.frame).inverse()
    target_from_ego = target_from_world @ dataset.world_from(record, "ego")
    center = target_from_ego.translation[:2] if view.center is None else np.array(view.center)
    (left, low), (right, high) = center - view.half, center + view.half
    ax.set(xlim=(left, right), ylim=(low, high), aspect="equal", anchor="N")
    ground = f"{record['token']}/{BEV_CAMERA}"
    has_ground = "bev" in layers and is_there(dataset, ground)
    town = None
    if "map" in layers or ("bev" in layers and not has_ground):
        town = map_beneath(dataset, record["scenario_token"], make="map" in layers)
    if town is not None:
        draw_town_map(town, ax, target_from_world=target_from_world)
    if has_ground:
        image = dataset.load_bev(record)
        reach = float(view.half.max()) + float(
            np.abs(center - target_from_ego.translation[:2]).max()
        )
        draw_underlay(image, ax, target_from_ego=target_from_ego, view_range=reach)
    clouds = _draw_clouds(dataset, record, view, names, center, ax) if "points" in layers else {}
    absent = [missing_clouds_text([agent for agent, cloud in clouds.items() if cloud is None])]
    colored: frozenset[str] = frozenset()
    if not layers.isdisjoint(_OF_BOXES):
        boxes = _boxes(dataset, record, view, names)
        boxes = boxes.select(
            (np.abs(boxes.center[:, :2] - center) < view.half + _BEYOND).all(axis=1)
        )
        colors = role_colors(dataset, record, boxes)
        if "trajectories" in layers:
            draw_trails(
                dataset,
                record,
                boxes,
                colors,
                target_from_world=target_from_world,
                seconds=view.seconds,
                ax=ax,
            )
        draw_actors_from_above(boxes, ax, colors, layers)
        if "boxes" in layers:
            _name_pair(dataset, record, boxes, ax, named=names if len(names) > 1 else ())
        colored = frozenset(colors)
    shown = tuple(agent for agent, cloud in clouds.items() if cloud is not None and len(cloud))
    seen, other = has_ground or town is not None, view.beside or bool(shown)
    absent += _absent_ground(dataset, ground, layers, seen=seen, other=other)
    _draw_marks(dataset, record, view.frame, names, ax)
    x_words, y_words = axis_words(view.frame)
    ax.set(xlabel=x_words, ylabel=y_words)
    ax.set_axisbelow(True)
    if "grid" in layers:
        ax.grid(color=GRID_COLOR, linewidth=0.4)
    write_missing(ax, "; ".join(filter(None, absent)))
    return colored, shown if len(names) > 1 else ()


def _absent_ground(
    dataset: Dataset, ground: str, layers: frozenset[Layer], *, seen: bool, other: bool
) -> list[str]:
    """What a corner says of the ground: that of the BEV camera only if nothing `other` shows the surroundings."""
    if seen or layers.isdisjoint(("map", "bev")):
        return []
    if "map" in layers:
        return [f"no {BEV_CAMERA} for a map of the town"]
    return [] if other else [f"{BEV_CAMERA}: {absence_text(dataset, ground)}"]


def _boxes(
    dataset: Dataset, record: SampleRecord, view: BevView, names: Sequence[AgentName]
) -> Boxes:
    """The sample's own boxes with their label ids, or several agents' with CARLA's.

    The receiver knows its own place: no message moves its box.
    """
    if list(names) == [record["agent"]]:
        return dataset.boxes(record, view.frame)
    boxes = cooperative_boxes(dataset, record, agents=names, frame=view.frame, link=view.link)
    own = dataset.get("agent", record["agent_token"])["actor_id"]
    if view.link is None or own is None:
        return boxes
    true = cooperative_boxes(dataset, record, agents=names, frame=view.frame)
    return concatenate(
        [true.select(true.actor_id == own), boxes.select(boxes.actor_id != own)], view.frame
    )


def _draw_clouds(
    dataset: Dataset,
    record: SampleRecord,
    view: BevView,
    names: Sequence[AgentName],
    center: FloatArray,
    ax: Axes,
) -> dict[AgentName, LidarPointCloud | None]:
    """The points of each agent, in its colour if there are several agents; returns them, None where no file is."""
    clouds = {agent: _cloud(dataset, record, view, agent) for agent in names}
    for agent, cloud in clouds.items():
        if cloud is None:
            continue
        color = AGENT_COLORS[agent] if len(names) > 1 else POINT_COLOR
        draw_points_from_above(cloud.xyz, ax, center=center, half=view.half, color=color)
    return clouds


def _cloud(
    dataset: Dataset, record: SampleRecord, view: BevView, agent: AgentName
) -> LidarPointCloud | None:
    """What arrives of an agent's points; None if it would arrive, and none of the files is there."""
    sent = [
        message.sample
        for message in messages(dataset, record, [agent], view.link, sweeps=view.sweeps)
    ]
    if sent and not any(has_cloud(dataset, sample) for sample in sent):
        return None
    return aggregate_point_cloud(
        dataset,
        record,
        agents=[agent],
        sweeps=view.sweeps,
        frame=view.frame,
        link=view.link,
        on_missing="skip",
    )


def _draw_marks(
    dataset: Dataset, record: SampleRecord, frame: str, names: Sequence[AgentName], ax: Axes
) -> None:
    """An arrow head at the true pose of each agent; with names if there are several agents."""
    from matplotlib.collections import PolyCollection

    heads, colors = [], []
    for agent in names:
        axes_from_ego = transform(dataset, record, at_once(record, agent), frame, "ego")
        heads.append(axes_from_ego.apply(np.column_stack([_MARK, np.zeros(len(_MARK))]))[:, :2])
        colors.append(AGENT_COLORS[agent])
        if len(names) > 1:
            x, y = axes_from_ego.translation[:2].tolist()
            write_beside(ax, short_name(agent), (x, y), colors[-1])
    edges = [OWN_COLOR if agent == record["agent"] else CASING_COLOR for agent in names]
    ax.add_collection(
        PolyCollection(heads, facecolors=colors, edgecolors=edges, linewidths=0.8, zorder=5)
    )
    keep_free(ax, heads)


def _name_pair(
    dataset: Dataset, record: SampleRecord, boxes: Boxes, ax: Axes, *, named: Collection[AgentName]
) -> None:
    """Write who collides: the agents that are not yet `named`, others by their category."""
    agents, colliders = recorder_ids(dataset, record), collider_ids(dataset, record)
    for row, actor in enumerate(label_ids(dataset, record, boxes)):
        agent = agents.get(actor)
        if actor in colliders and agent not in named:
            x, y = boxes.center[row, :2].tolist()
            write_beside(
                ax,
                boxes.category_names[row] if agent is None else short_name(agent),
                (x, y),
                COLLIDER_COLOR,
            )


def link_words(link: Link) -> str:
    """A link in words: `latency 0.2 s, poses off by 0.3 m (σ 0.02 m), 10 % of messages lost`."""
    words = [f"latency {link.latency:g} s"]
    noise = link.pose_noise
    if isinstance(noise, PoseNoise):
        words.append(f"poses off by {noise.mean:g} m (σ {noise.std:g} m)")
        if noise.heading_std:
            words.append(f"headings by σ {np.degrees(noise.heading_std):.1f}°")
    if link.packet_loss:
        words.append(f"{100 * link.packet_loss:g} % of messages lost")
    words += [] if link.budget is None else [f"at most {link.budget:,} bytes a frame"]
    return ", ".join(words)


def draw_points_from_above(
    xyz: FloatArray, ax: Axes, *, center: FloatArray, half: FloatArray, color: str = POINT_COLOR
) -> None:
    """Render the points (P, 3) within ±`half` (2,) metres of `center` (2,), all in one colour.

    Hues are paler than those of boxes, which lie over them.
    """
    near = (np.abs(xyz[:, :2] - center) < half).all(axis=1)
    ax.scatter(
        xyz[near, 0],
        xyz[near, 1],
        s=0.6,
        c=color,
        alpha=None if color == POINT_COLOR else _PALE,
        linewidths=0,
        rasterized=True,
        zorder=1,
    )
