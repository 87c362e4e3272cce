"""A moment from above: boxes, points, and the ground as the BEV camera saw it."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, get_args

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.geometry import SE3, Boxes, LidarPointCloud
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
    handles_of_scene,
    has_cloud,
    has_sensor_file,
    is_callers,
    missing_clouds_text,
    set_scene_title,
    write_missing,
)
from deepaccident_devkit.render.chips import keep_free
from deepaccident_devkit.render.figures import (
    Layer,
    Layers,
    axes_or_new,
    check_view_range,
    label_axes,
    layers_of,
    width_to_height,
)
from deepaccident_devkit.render.ground import draw_underlay
from deepaccident_devkit.render.styles import (
    AGENT_COLORS,
    BEV_COLORS,
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
from deepaccident_devkit.tables.tokens import sample_token
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
from deepaccident_devkit.v2x.agents import agents_of
from deepaccident_devkit.v2x.messages import messages

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from deepaccident_devkit.tables.records import SampleRecord

BEV_LAYERS: Final[Layers] = (
    "map",
    "bev",
    "points",
    "boxes",
    "ids",
    "velocities",
    "trajectories",
    "grid",
)
BEV_DEFAULT: Final[Layers] = ("bev", "points", "boxes", "grid")
# What the legend of a view from above explains: the colours of its boxes and, if there are several
# agents, the agents whose points it shows.
_ViewContent = tuple[frozenset[str], tuple[AgentName, ...]]
_BOX_LAYERS = frozenset(("boxes", "ids", "velocities", "trajectories"))
# A box whose centre is at most this many metres outside the picture may still reach into it.
_BOX_MARGIN_M = 5.0
# Corners of an arrow head, metres in an agent's ego frame.
_ARROW_HEAD_M = np.array([[1.8, 0.0], [-1.2, 1.1], [-0.6, 0.0], [-1.2, -1.1]])
# Opacity of agents' points.
_POINT_OPACITY = 0.55


@dataclass(frozen=True, slots=True, kw_only=True)
class BevView:
    """Which part of a moment to render from above, and from which data.

    Attributes:
        view_range: Metres shown to each side of the agent.
        frame: Coordinate frame of the axes: `ego`, `lidar` or `world`.
        agents: Agents whose points and boxes the view shows.
        link: Effects on the partners' data; None for none.
        sweeps: Number of frames whose points are shown, including the current one.
        seconds: Length of past and of future trajectories, seconds.
        center: Centre of the picture, metres in `frame`; None for the agent's position.
        wide: Width over height of the shown part.
        surroundings_shown: Whether another panel shows the surroundings, so that a missing picture
            of the BEV camera need not be reported.
    """

    view_range: float = 50.0
    frame: str = "ego"
    agents: Agents = "single"
    link: Link | None = None
    sweeps: int = 1
    seconds: tuple[float, float] = (1.0, 3.0)
    center: tuple[float, float] | None = None
    wide: float = 1.0
    surroundings_shown: bool = False

    @property
    def half(self) -> FloatArray:
        """Metres from the centre to the right and the upper edge, shape (2,)."""
        half_width = self.wide * self.view_range
        return np.array([half_width, self.view_range])

    def __post_init__(self) -> None:
        """Raise ChoiceError unless the frame is known and the range is above 0."""
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
    actors have a shade for their category. Each agent is marked in its hue; the mark of the
    sample's agent has a dark edge. If there are several agents, they are named, and their points
    have their hues. The title names the effects of a link, and the number of sweeps.

    Args:
        dataset: The release.
        sample: Token or record; its agent is in the middle, its frame is the current one (t = 0).
        view_range: Metres shown to each side of the agent.
        agents: Agents whose points and boxes are shown: names, a configuration or its name, or None
            for all present agents; by default only the sample's agent. If there are several agents,
            each actor still has one box.
        frame: Coordinate frame of the axes: `ego` or `lidar` (forward to the right, left up), or
            `world`.
        layers: Any of `map` (the town's ground, combined from all recordings there, see
            `town_map`; if none is stored it is made, which takes a while), `bev` (the agent's BEV
            camera, in pale colours, over the map), `points`, `boxes`, `ids`, `velocities` (arrows
            to the positions in one second), `trajectories` (past thin, future thick, fading) and
            `grid`; by default bev, points, boxes, grid. Points and the BEV picture are left out if
            their files are missing; the title reports missing points, or the missing BEV picture
            if there are no points either. A stored town map replaces a missing BEV picture.
        link: Effects on the partners' data; None for none.
        sweeps: Number of frames whose points are shown, including the current one.
        seconds: Length of past and of future trajectories, seconds.
        ax: Axes to render on, new ones if None. In a figure of your own, the title is yours.

    Returns:
        The axes, in metres of `frame`.

    Raises:
        TokenError: No such sample.
        ChoiceError: No such layer, frame, agent or configuration, `sweeps` is not a positive whole
            number, or `view_range` is not above 0.
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
        wide=width_to_height(ax),
    )
    names = cooperating_agents(dataset, sample, agents)
    ax = axes_or_new(ax, (6, 6.6), is_map=True)
    colors, cloud_agents = draw_bev(dataset, sample, view, shown_layers, ax)
    remarks = []
    if link is not None and link != Link(seed=link.seed) and len(names) > 1:
        remarks.append(link_words(link))
    if sweeps > 1:
        remarks.append(f"{sweeps} sweeps")
    token = dataset.get("sample", sample)["token"]
    set_scene_title(ax, dataset, token, below=", ".join(remarks))
    handles = handles_of_scene(colors, cloud_agents, is_short=is_callers(ax))
    draw_legend_outside(ax, handles, columns=5)
    return ax


def draw_bev(
    dataset: Dataset, sample: RowArgument, view: BevView, layers: frozenset[Layer], ax: Axes
) -> _ViewContent:
    """Render a panel of `render_bev`, and return what its legend has to explain.

    Raises the errors of `render_bev`.
    """
    record = dataset.sample[dataset.getind("sample", sample)]
    names = cooperating_agents(dataset, record, view.agents)
    target_from_world = dataset.world_from(record, view.frame).inverse()
    target_from_ego = target_from_world @ dataset.world_from(record, "ego")
    center = target_from_ego.translation[:2]
    if view.center is not None:
        center = np.array(view.center)
    left, low = center - view.half
    right, high = center + view.half
    ax.set(xlim=(left, right), ylim=(low, high), aspect="equal", anchor="N")
    has_ground = _draw_ground(dataset, record, target_from_world, layers, ax)
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
        has_surroundings = view.surroundings_shown or bool(cloud_agents)
        absent_words.append(
            _missing_ground_text(dataset, record, layers, has_surroundings=has_surroundings)
        )
    draw_agents(dataset, record, view.frame, names, ax)
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
    target_from_world: SE3,
    layers: frozenset[Layer],
    ax: Axes,
) -> bool:
    """Draw the ground from a town map and the BEV camera; return whether any was drawn."""
    has_picture = "bev" in layers and has_sensor_file(dataset, f"{record['token']}/{BEV_CAMERA}")
    town = None
    if "map" in layers or ("bev" in layers and not has_picture):
        town = map_beneath(dataset, record["scenario_token"], make="map" in layers)
    if town is not None:
        draw_town_map(town, ax, target_from_world=target_from_world)
    if has_picture:
        target_from_ego = target_from_world @ dataset.world_from(record, "ego")
        draw_underlay(dataset.load_bev(record), ax, target_from_ego=target_from_ego)
    return has_picture or town is not None


def draw_road(
    dataset: Dataset,
    moment: str,
    axes: Sequence[Axes],
    *,
    target_from_world: SE3,
    colors: Mapping[str, str] = BEV_COLORS,
) -> None:
    """Draw the road beneath what axes show, as the BEV camera nearest to their middle saw it.

    If no agent's picture is present, the road is from the town map, or nothing is drawn if none is
    stored.

    Args:
        dataset: The release.
        moment: Token of a frame.
        axes: Axes to render on; the first one's middle counts. Their limits stay as they are.
        target_from_world: Pose of the world in the frame of the axes.
        colors: Colour by name of a tag.
    """
    scenario, number = moment.rsplit("/", 1)
    middle = np.mean(axes[0].viewLim.get_points(), axis=0)
    poses = {}
    distances = {}
    for agent in agents_of(dataset, scenario):
        sample = sample_token(scenario, agent, int(number))
        if has_sensor_file(dataset, f"{sample}/{BEV_CAMERA}"):
            poses[sample] = target_from_world @ dataset.world_from(sample, "ego")
            offset = poses[sample].translation[:2] - middle
            distances[sample] = float(np.abs(offset).max())
    if not distances:
        town = map_beneath(dataset, scenario, make=False)
        if town is not None:
            for ax in axes:
                draw_town_map(town, ax, target_from_world=target_from_world)
        return
    nearest_sample = min(distances, key=distances.__getitem__)
    image = dataset.load_bev(nearest_sample)
    pose = poses[nearest_sample]
    for ax in axes:
        draw_underlay(image, ax, target_from_ego=pose, colors=colors)


def _missing_ground_text(
    dataset: Dataset, record: SampleRecord, layers: frozenset[Layer], *, has_surroundings: bool
) -> str:
    """Return words that explain why no ground is drawn.

    They are empty if no ground was requested, or if other data show the surroundings.
    """
    if "map" in layers:
        return f"no {BEV_CAMERA} for a map of the town"
    if "bev" not in layers or has_surroundings:
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
    """Draw the boxes within the picture, and return the colours of the visible ones."""
    boxes = _load_boxes(dataset, record, view, names)
    offsets = np.abs(boxes.center[:, :2] - center)
    is_shown = (offsets < view.half + _BOX_MARGIN_M).all(axis=1)
    boxes = boxes.select(is_shown)
    colors = role_colors(dataset, record, boxes)
    if "trajectories" in layers:
        world_from_target = dataset.world_from(record, view.frame)
        draw_trails(
            dataset,
            record,
            boxes,
            colors,
            target_from_world=world_from_target.inverse(),
            seconds=view.seconds,
            ax=ax,
        )
    draw_actors_from_above(boxes, ax, colors, layers)
    if "boxes" in layers:
        named_agents = names if len(names) > 1 else ()
        _name_pair(dataset, record, boxes, ax, named_agents=named_agents)
    corners = boxes.bottom_corners()[..., :2] - center
    is_visible = (corners.max(axis=1) > -view.half) & (corners.min(axis=1) < view.half)
    visible_rows = np.flatnonzero(is_visible.all(axis=1))
    return frozenset(colors[row] for row in visible_rows.tolist())


def _load_boxes(
    dataset: Dataset, record: SampleRecord, view: BevView, names: Sequence[AgentName]
) -> Boxes:
    """Load the sample's own boxes with label ids or, for several agents, boxes with CARLA ids.

    The receiver knows its own position, so no message moves its box.
    """
    if list(names) == [record["agent"]]:
        return dataset.boxes(record, view.frame)
    boxes = cooperative_boxes(dataset, record, agents=names, frame=view.frame, link=view.link)
    own_actor = dataset.get("agent", record["agent_token"])["actor_id"]
    if view.link is None or own_actor is None:
        return boxes
    other_boxes = boxes.select(boxes.actor_id != own_actor)
    true_boxes = cooperative_boxes(dataset, record, agents=names, frame=view.frame)
    own_box = true_boxes.select(true_boxes.actor_id == own_actor)
    return concatenate([own_box, other_boxes], view.frame)


def _draw_clouds(
    dataset: Dataset,
    record: SampleRecord,
    view: BevView,
    names: Sequence[AgentName],
    center: FloatArray,
    ax: Axes,
) -> dict[AgentName, LidarPointCloud | None]:
    """Draw the points of each agent, and return them by agent (None if their files are missing).

    If there are several agents, each agent's points have its colour.
    """
    clouds = {agent: _load_cloud(dataset, record, view, agent) for agent in names}
    for agent, cloud in clouds.items():
        if cloud is None:
            continue
        color = POINT_COLOR
        if len(names) > 1:
            color = AGENT_COLORS[agent]
        draw_points_from_above(cloud.xyz, ax, center=center, half=view.half, color=color)
    return clouds


def _load_cloud(
    dataset: Dataset, record: SampleRecord, view: BevView, agent: AgentName
) -> LidarPointCloud | None:
    """Load the points received from an agent; None if all their files are missing."""
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


def draw_agents(
    dataset: Dataset, record: SampleRecord, frame: str, names: Sequence[str], ax: Axes
) -> None:
    """Draw an arrow head at the true pose of each agent, with names if there are several agents."""
    from matplotlib.collections import PolyCollection

    heads = []
    edges = []
    arrow_head = np.column_stack([_ARROW_HEAD_M, np.zeros(len(_ARROW_HEAD_M))])
    for agent in names:
        sample = simultaneous_sample(record, agent)
        target_from_ego = transform(dataset, record, sample, frame, "ego")
        heads.append(target_from_ego.apply(arrow_head)[:, :2])
        edges.append(OWN_COLOR if agent == record["agent"] else CASING_COLOR)
        if len(names) > 1:
            x, y = target_from_ego.translation[:2].tolist()
            write_beside(ax, short_name(agent), (x, y), AGENT_COLORS[agent])
    colors = [AGENT_COLORS[agent] for agent in names]
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
    """Write the names of the colliding pair, except agents that are already named.

    An actor that is not an agent is named by its category.
    """
    agents = recorder_ids(dataset, record)
    colliders = collider_ids(dataset, record)
    for row, actor in enumerate(label_ids(dataset, record, boxes)):
        agent = agents.get(actor)
        if actor not in colliders or agent in named_agents:
            continue
        name = boxes.category_names[row]
        if agent is not None:
            name = short_name(agent)
        x, y = boxes.center[row, :2].tolist()
        write_beside(ax, name, (x, y), COLLIDER_COLOR)


def link_words(link: Link) -> str:
    """Describe the effects of a link in words.

    For example `latency 0.2 s, pose noise 0.3 m ± 0.02 m, 10 % of messages lost`.
    """
    words = [f"latency {link.latency:g} s"]
    noise = link.pose_noise
    if isinstance(noise, PoseNoise):
        words.append(f"pose noise {noise.mean:g} m ± {noise.std:g} m")
        if noise.heading_std:
            words.append(f"heading noise ± {np.degrees(noise.heading_std):.1f}°")
    if link.packet_loss:
        words.append(f"{100 * link.packet_loss:g} % of messages lost")
    if link.budget is not None:
        words.append(f"at most {link.budget:,} bytes per frame")
    return ", ".join(words)


def draw_points_from_above(
    xyz: FloatArray, ax: Axes, *, center: FloatArray, half: FloatArray, color: str = POINT_COLOR
) -> None:
    """Render the points (P, 3) within ±`half` (2,) metres of `center` (2,), in one colour.

    Points are paler than the boxes drawn over them in the same hue.
    """
    is_shown = (np.abs(xyz[:, :2] - center) < half).all(axis=1)
    x, y, _ = xyz[is_shown].T
    ax.scatter(
        x,
        y,
        s=0.6,
        c=color,
        alpha=None if color == POINT_COLOR else _POINT_OPACITY,
        linewidths=0,
        rasterized=True,
        zorder=1,
    )
