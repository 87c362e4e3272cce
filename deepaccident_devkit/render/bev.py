"""A moment from above: boxes, points, and the ground by the BEV camera."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, get_args

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.geometry import Boxes, LidarPointCloud
from deepaccident_devkit.geometry.boxes import concatenate
from deepaccident_devkit.render.boxes import (
    collider_ids,
    draw_actors_from_above,
    draw_trails,
    label_ids,
    recorder_ids,
    role_colors,
    simultaneous_sample,
    write_beside,
)
from deepaccident_devkit.render.captions import (
    absence_text,
    draw_legend_outside,
    handles_from_above,
    has_cloud,
    has_sensor_file,
    missing_clouds_text,
    set_scene_title,
    write_missing,
)
from deepaccident_devkit.render.chips import keep_free
from deepaccident_devkit.render.figures import (
    Layer,
    axes_or_new,
    check_view_range,
    label_axes,
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
# Content of a view from above: the colours of its boxes and, if there are several agents, the
# agents with points in it.
_ViewContent = tuple[frozenset[str], tuple[AgentName, ...]]
_BOX_LAYERS: Final = frozenset(("boxes", "ids", "velocities", "trajectories"))
# Metres outside the picture up to which a box may still reach into it.
_BOX_MARGIN_M: Final = 5.0
# An arrow head, metres of an agent's ego frame.
_ARROW_HEAD_M: Final = np.array([[1.8, 0.0], [-1.2, 1.1], [-0.6, 0.0], [-1.2, -1.1]])
# Opacity of agents' points.
_POINT_OPACITY: Final = 0.55


@dataclass(frozen=True, slots=True, kw_only=True)
class BevView:
    """The rendered part of a moment from above, and the source of its data.

    Attributes:
        view_range: Metres shown to each side of the agent.
        frame: Coordinate frame of the axes: `ego`, `lidar` or `world`.
        agents: Agents with points and boxes in the view.
        link: Effects on the partners' data.
        sweeps: Number of frames of points, the present included.
        seconds: Seconds of trajectories, back and ahead.
        center: Centre of the picture, metres of `frame`; None for the agent's position.
        wide: Ratio of the distances shown to the sides and up or down.
        beside: Whether a picture beside it shows the surroundings, so that the BEV camera's picture
            is not missed.
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
        """Metres from the centre to the right and the upper edge, shape (2,)."""
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

    The colliding pair is red, other recording vehicles have their agents' hues, and the remaining
    actors a shade for their category. Agents have a mark in their hue, the sample's own with a dark
    edge; several agents have names, and their points have their hues. The title names the effects
    of a link, and the number of sweeps.

    Args:
        dataset: The release.
        sample: Token or record: its agent is in the middle, its frame is the present.
        view_range: Metres shown to each side of the agent.
        agents: Agents with points and boxes: names, a configuration or its name, or None for all
            present agents; by default only the sample's own agent. If there are several agents,
            each actor has one box.
        frame: Coordinate frame of the axes: `ego` or `lidar` (forward to the right, left up), or
            `world`.
        layers: Some of `map` (the ground of the town in all its recordings, `town_map`; made if
            none is stored, which takes a while), `bev` (the agent's BEV camera, in pale colours,
            over the map), `points`, `boxes`, `ids`, `velocities` (arrows for one second),
            `trajectories` (past thin, future thick, fading) and `grid`; by default bev, points,
            boxes, grid. Points and the BEV camera are left out if their files are missing; the
            title reports it (for the BEV camera only if there are no points). A stored town map
            replaces a missing picture of a BEV camera.
        link: Effects on the partners' data; None for none.
        sweeps: Number of frames of points, the present included.
        seconds: Seconds of trajectories, back and ahead.
        ax: Axes to render on; new ones if None.

    Returns:
        The axes, in metres of `frame`.

    Raises:
        TokenError: No such sample.
        ChoiceError: No such layer, frame, agent or configuration, `sweeps` is no whole number from
            1, or `view_range` is not above 0.
        NotAvailableError: An agent is not in this (partial) release.
        ConfigError: `link` is no Link, or its latency is longer than the scenario's past.
    """
    shown_layers = layers_of(layers, BEV_DEFAULT, BEV_LAYERS)
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
    colors, cloud_agents = draw_bev(dataset, sample, view, shown_layers, ax)
    remarks = []
    if link is not None and link != Link(seed=link.seed) and len(names) > 1:
        remarks.append(link_words(link))
    if sweeps > 1:
        remarks.append(f"{sweeps} sweeps")
    token = dataset.get("sample", sample)["token"]
    set_scene_title(ax, dataset, token, below=", ".join(remarks))
    draw_legend_outside(ax, handles_from_above(colors, cloud_agents), columns=5)
    return ax


def draw_bev(
    dataset: Dataset, sample: RowArgument, view: BevView, layers: frozenset[Layer], ax: Axes
) -> _ViewContent:
    """Render a panel of `render_bev`, with its arguments and errors, and return its content.

    A legend explains the content.
    """
    record = dataset.sample[dataset.getind("sample", sample)]
    names = cooperating_agents(dataset, record, view.agents)
    target_from_world = dataset.world_from(record, view.frame).inverse()
    target_from_ego = target_from_world @ dataset.world_from(record, "ego")
    center = target_from_ego.translation[:2]
    if view.center is not None:
        center = np.array(view.center)
    (left, low), (right, high) = center - view.half, center + view.half
    ax.set(xlim=(left, right), ylim=(low, high), aspect="equal", anchor="N")
    has_ground = _draw_ground(dataset, record, view, center, layers, ax)
    clouds: dict[AgentName, LidarPointCloud | None] = {}
    if "points" in layers:
        clouds = _draw_clouds(dataset, record, view, names, center, ax)
    missing_agents = [agent for agent, cloud in clouds.items() if cloud is None]
    colors: frozenset[str] = frozenset()
    if not layers.isdisjoint(_BOX_LAYERS):
        colors = _draw_boxes(dataset, record, view, names, center, layers, ax)
    cloud_agents = tuple(
        agent for agent, cloud in clouds.items() if cloud is not None and len(cloud)
    )
    absent_words = [missing_clouds_text(missing_agents)]
    if not has_ground:
        has_surroundings = view.beside or bool(cloud_agents)
        absent_words.append(_missing_ground_text(dataset, record, layers, beside=has_surroundings))
    _draw_marks(dataset, record, view.frame, names, ax)
    label_axes(ax, view.frame)
    ax.set_axisbelow(True)
    if "grid" in layers:
        ax.grid(color=GRID_COLOR, linewidth=0.4)
    write_missing(ax, "; ".join(words for words in absent_words if words))
    if len(names) > 1:
        return colors, cloud_agents
    return colors, ()


def _draw_ground(
    dataset: Dataset,
    record: SampleRecord,
    view: BevView,
    center: FloatArray,
    layers: frozenset[Layer],
    ax: Axes,
) -> bool:
    """Draw the ground by a town map and the BEV camera, and return whether there is any."""
    target_from_world = dataset.world_from(record, view.frame).inverse()
    target_from_ego = target_from_world @ dataset.world_from(record, "ego")
    has_picture = "bev" in layers and has_sensor_file(dataset, f"{record['token']}/{BEV_CAMERA}")
    town = None
    if "map" in layers or ("bev" in layers and not has_picture):
        town = map_beneath(dataset, record["scenario_token"], make="map" in layers)
    if town is not None:
        draw_town_map(town, ax, target_from_world=target_from_world)
    if has_picture:
        distance = float(np.abs(center - target_from_ego.translation[:2]).max())
        draw_underlay(
            dataset.load_bev(record),
            ax,
            target_from_ego=target_from_ego,
            view_range=float(view.half.max()) + distance,
        )
    return has_picture or town is not None


def _missing_ground_text(
    dataset: Dataset, record: SampleRecord, layers: frozenset[Layer], *, beside: bool
) -> str:
    """Return the words for missing ground.

    If other data show the surroundings (`beside`), the BEV camera's picture is not missed.
    """
    if "map" in layers:
        return f"no {BEV_CAMERA} for a map of the town"
    if "bev" not in layers or beside:
        return ""
    sensor_file = f"{record['token']}/{BEV_CAMERA}"
    return f"{BEV_CAMERA}: {absence_text(dataset, sensor_file)}"


def _draw_boxes(
    dataset: Dataset,
    record: SampleRecord,
    view: BevView,
    names: Sequence[AgentName],
    center: FloatArray,
    layers: frozenset[Layer],
    ax: Axes,
) -> frozenset[str]:
    """Draw the boxes in the picture, and return their colours."""
    boxes = _boxes(dataset, record, view, names)
    offsets = np.abs(boxes.center[:, :2] - center)
    boxes = boxes.select((offsets < view.half + _BOX_MARGIN_M).all(axis=1))
    colors = role_colors(dataset, record, boxes)
    if "trajectories" in layers:
        draw_trails(
            dataset,
            record,
            boxes,
            colors,
            target_from_world=dataset.world_from(record, view.frame).inverse(),
            seconds=view.seconds,
            ax=ax,
        )
    draw_actors_from_above(boxes, ax, colors, layers)
    if "boxes" in layers:
        named_agents = names if len(names) > 1 else ()
        _name_pair(dataset, record, boxes, ax, named_agents=named_agents)
    return frozenset(colors)


def _boxes(
    dataset: Dataset, record: SampleRecord, view: BevView, names: Sequence[AgentName]
) -> Boxes:
    """Return the sample's own boxes with their label ids, or several agents' with CARLA ids.

    The receiver knows its own position: no message moves its box.
    """
    if list(names) == [record["agent"]]:
        return dataset.boxes(record, view.frame)
    boxes = cooperative_boxes(dataset, record, agents=names, frame=view.frame, link=view.link)
    own_actor = dataset.get("agent", record["agent_token"])["actor_id"]
    if view.link is None or own_actor is None:
        return boxes
    true = cooperative_boxes(dataset, record, agents=names, frame=view.frame)
    own_box = true.select(true.actor_id == own_actor)
    return concatenate([own_box, boxes.select(boxes.actor_id != own_actor)], view.frame)


def _draw_clouds(
    dataset: Dataset,
    record: SampleRecord,
    view: BevView,
    names: Sequence[AgentName],
    center: FloatArray,
    ax: Axes,
) -> dict[AgentName, LidarPointCloud | None]:
    """Draw the points of each agent and return them, None for a missing file.

    If there are several agents, points have their colours.
    """
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
    """Return the received points of an agent; None if all files for them are missing."""
    sent = messages(dataset, record, [agent], view.link, sweeps=view.sweeps)
    samples = [message.sample for message in sent]
    if samples and not any(has_cloud(dataset, sample) for sample in samples):
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
    """Draw an arrow head at the true pose of each agent, with names if there are several agents."""
    from matplotlib.collections import PolyCollection

    heads, colors, edges = [], [], []
    arrow_head = np.column_stack([_ARROW_HEAD_M, np.zeros(len(_ARROW_HEAD_M))])
    for agent in names:
        sample = simultaneous_sample(record, agent)
        target_from_ego = transform(dataset, record, sample, frame, "ego")
        heads.append(target_from_ego.apply(arrow_head)[:, :2])
        colors.append(AGENT_COLORS[agent])
        edges.append(OWN_COLOR if agent == record["agent"] else CASING_COLOR)
        if len(names) > 1:
            x, y = target_from_ego.translation[:2].tolist()
            write_beside(ax, short_name(agent), (x, y), AGENT_COLORS[agent])
    marks = PolyCollection(heads, facecolors=colors, edgecolors=edges, linewidths=0.8, zorder=5)
    ax.add_collection(marks)
    keep_free(ax, heads)


def _name_pair(
    dataset: Dataset,
    record: SampleRecord,
    boxes: Boxes,
    ax: Axes,
    *,
    named_agents: Collection[AgentName],
) -> None:
    """Write the names of the colliding pair, without agents that already have their names.

    Other actors are named by their category.
    """
    agents, colliders = recorder_ids(dataset, record), collider_ids(dataset, record)
    for row, actor in enumerate(label_ids(dataset, record, boxes)):
        agent = agents.get(actor)
        if actor in colliders and agent not in named_agents:
            name = boxes.category_names[row] if agent is None else short_name(agent)
            x, y = boxes.center[row, :2].tolist()
            write_beside(ax, name, (x, y), COLLIDER_COLOR)


def link_words(link: Link) -> str:
    """Return the words for a link.

    For example `latency 0.2 s, poses off by 0.3 m (σ 0.02 m), 10 % of messages lost`.
    """
    words = [f"latency {link.latency:g} s"]
    noise = link.pose_noise
    if isinstance(noise, PoseNoise):
        words.append(f"poses off by {noise.mean:g} m (σ {noise.std:g} m)")
        if noise.heading_std:
            words.append(f"headings by σ {np.degrees(noise.heading_std):.1f}°")
    if link.packet_loss:
        words.append(f"{100 * link.packet_loss:g} % of messages lost")
    if link.budget is not None:
        words.append(f"at most {link.budget:,} bytes a frame")
    return ", ".join(words)


def draw_points_from_above(
    xyz: FloatArray, ax: Axes, *, center: FloatArray, half: FloatArray, color: str = POINT_COLOR
) -> None:
    """Render the points (P, 3) within ±`half` (2,) metres of `center` (2,), in one colour.

    Hues are paler than the hues of boxes, which lie over them.
    """
    within = (np.abs(xyz[:, :2] - center) < half).all(axis=1)
    ax.scatter(
        xyz[within, 0],
        xyz[within, 1],
        s=0.6,
        c=color,
        alpha=None if color == POINT_COLOR else _POINT_OPACITY,
        linewidths=0,
        rasterized=True,
        zorder=1,
    )
