"""Single actors: one box with its picture, place and facts; and an actor over time."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Final, cast

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.render.bev import BEV_LAYERS, BevView, draw_bev
from deepaccident_devkit.render.boxes import (
    camera_name,
    draw_boxes_from_above,
    draw_boxes_in_image,
    draw_trail,
    in_drawing_order,
    recorders_of,
    role_colors,
    write_beside,
)
from deepaccident_devkit.render.camera import BestView, best_view, crop_about, draw_image
from deepaccident_devkit.render.captions import set_scene_title, set_title
from deepaccident_devkit.render.figures import (
    LAYERS,
    Layer,
    figure_or_new,
    hide_axes,
    label_axes,
    layers_of,
    show_square,
    with_light_grid,
    write_in_middle,
)
from deepaccident_devkit.render.ground import draw_underlay
from deepaccident_devkit.render.styles import (
    AGENT_COLORS,
    COLLIDER_COLOR,
    GRID_COLOR,
    current_style,
    in_own_settings,
    text_size,
)
from deepaccident_devkit.support.arrays import (
    BoolArray,
    FloatArray,
    FrozenArrays,
    IntArray,
    as_floats,
)
from deepaccident_devkit.tables.tokens import instance_token, sample_token
from deepaccident_devkit.taxonomy import (
    BEV_CAMERA,
    CAMERAS,
    FRAME_PERIOD,
    OWN_ACTOR_ID,
    frame_timestamp,
    short_name,
)
from deepaccident_devkit.v2x import Agents, cooperating_agents
from deepaccident_devkit.v2x.cooperation import visible_actors
from deepaccident_devkit.v2x.poses import camera_of
from deepaccident_devkit.v2x.tracks import scenario_tracks

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_BOX_LAYERS: Final = tuple(layer for layer in LAYERS if layer in {"image", *BEV_LAYERS})
_DEFAULT_BOX_LAYERS: Final[tuple[Layer, ...]] = ("image", "bev", "points", "boxes", "grid")
_ACTOR_LAYERS: Final[tuple[Layer, ...]] = ("image", "bev", "boxes", "trajectories", "grid")
# Letters in an inch, if they are one point high.
_LETTERS_PER_INCH: Final = 104
_CROP_PANELS: Final = ("first", "second", "third", "fourth")
_WIDE_MOSAIC: Final[list[Any]] = [["path", "first", "second"], ["path", "speed", "seen"]]
# The panels of an actor over time, by `room` of the style.
_ACTOR_MOSAICS: Final[Mapping[str, dict[str, Any]]] = {
    "all": {
        "mosaic": [
            ["path", "first", "second"],
            ["path", "third", "fourth"],
            ["speed", "points", "seen"],
        ],
        "height_ratios": (1, 1, 1.1),
    },
    "page": {"mosaic": _WIDE_MOSAIC, "width_ratios": (1.6, 1, 1)},
    "slide": {"mosaic": _WIDE_MOSAIC, "width_ratios": (1.9, 1, 1)},
    "column": {
        "mosaic": [["path"] * 2, ["first", "second"], ["seen"] * 2],
        "height_ratios": (2.0, 0.6, 0.8),
    },
}
# The panels of one box.
_BOX_MOSAICS: Final[Mapping[str, dict[str, Any]]] = {
    "all": {
        "mosaic": [["camera", "above"], ["words", "words"]],
        "width_ratios": (16, 10),
        "height_ratios": (4, 0.8),
    },
    "page": {"mosaic": [["camera", "above"]], "width_ratios": (16, 10)},
    "column": {"mosaic": [["camera"], ["above"]], "height_ratios": (9, 16)},
}
_FRAMES_PER_SECOND: Final = round(1 / FRAME_PERIOD)
# Metres around the path, on each side, at least.
_PATH_MARGIN_M: Final = 10.0


@in_own_settings
def render_annotation(
    dataset: Dataset,
    annotation: RowArgument,
    *,
    margin: float = 15.0,
    layers: Iterable[Layer] | None = None,
    fig: Figure | None = None,
) -> Figure:
    """Render a box in the camera of its agent that shows it largest, from above, and in words.

    Cameras with downloaded images come first; if there is none, the image's panel is grey.

    Args:
        dataset: The release.
        annotation: Token or record.
        margin: Metres shown from above to each side of the box's centre.
        layers: `image`, `boxes` (this box in the camera, all boxes from above) and, from above, the
            other layers of `render_bev`; by default image, bev, points, boxes and grid. Without
            `boxes` only the box itself is rendered.
        fig: Empty figure to render on; a new one if None.

    Returns:
        The figure: the part of the camera's image around the box, the box from above in the agent's
        ego frame, words (not in papers).

    Raises:
        TokenError: No such annotation.
        ChoiceError: No such layer.
    """
    shown_layers = layers_of(layers, _DEFAULT_BOX_LAYERS, _BOX_LAYERS)
    record = dataset.get("annotation", annotation)
    sample = record["sample_token"]
    row = int(record["token"].rsplit("/", 1)[1])
    box = dataset.boxes(sample, "world").select([row])
    color = role_colors(dataset, sample, box)
    fig = figure_or_new(fig, (10, 4.9), page=0.43, column=1.6)
    axes = fig.subplot_mosaic(**_BOX_MOSAICS.get(current_style().room, _BOX_MOSAICS["all"]))
    camera_view = best_view(dataset, [sample], box)
    has_image = "image" in shown_layers
    _draw_in_camera(dataset, camera_view, box, color, axes["camera"], image=has_image)

    ego_box = box.transform(dataset.world_from(sample, "ego").inverse(), "ego")
    x, y = ego_box.center[0, :2].tolist()
    bev_view = BevView(view_range=margin, center=(x, y))
    draw_bev(dataset, sample, bev_view, shown_layers - {"image"}, axes["above"])
    draw_boxes_from_above(ego_box, axes["above"], color, fill=0.5, linewidths=2.5)
    axes["above"].set_title("ego frame of the agent", fontsize="medium")

    if "words" in axes:
        _write_facts(dataset, record, ego_box, axes["words"])
    set_scene_title(fig, dataset, record["token"], record["category"])
    return fig


def _write_facts(dataset: Dataset, record: dict[str, Any], ego_box: Boxes, ax: Axes) -> None:
    """Write the facts about a box, which is in the ego frame, in columns."""
    ax.set_axis_off()
    columns, fig = _facts(dataset, record, ego_box), cast("Figure", ax.figure)
    line_letters = _LETTERS_PER_INCH / text_size() * fig.bbox.width / fig.dpi / len(columns)
    for column, facts in enumerate(columns):
        lines = [textwrap.fill(fact, int(line_letters), subsequent_indent="  ") for fact in facts]
        x, text = column / len(columns), "\n".join(lines)
        ax.text(x, 1, text, va="top", fontsize=text_size(), transform=ax.transAxes)


def _draw_in_camera(
    dataset: Dataset, view: BestView | None, box: Boxes, color: list[str], ax: Axes, *, image: bool
) -> None:
    if view is None:
        ax.set_axis_off()
        write_in_middle(ax, "in no image of its agent's cameras")
    else:
        draw_view(dataset, view, box, color, ax, image=image)


def draw_view(
    dataset: Dataset,
    view: BestView,
    boxes: Boxes,
    colors: list[str],
    ax: Axes,
    *,
    image: bool = True,
) -> None:
    """Render the part of a best view's image around boxes, in world, and their edges.

    The title is the camera.
    """
    camera = dataset.get("sample_data", view.camera)
    lens = camera_of(dataset, camera)
    draw_image(dataset, camera, ax, image=image)
    optical_from_world = dataset.world_from(camera["sample_token"], camera["channel"]).inverse()
    draw_boxes_in_image(boxes.transform(optical_from_world, camera["channel"]), lens, ax, colors)
    left, top, right, bottom = crop_about(view.bounds, width=lens.width, height=lens.height)
    ax.set(xlim=(left, right), ylim=(bottom, top))


def _facts(dataset: Dataset, record: dict[str, Any], ego_box: Boxes) -> list[list[str]]:
    """Return the facts about a box, in columns of lines; `ego_box` is the box in the ego frame."""
    length, width, height = record["size"]
    speed = float(np.linalg.norm(record["velocity"]))
    speed_words = "unknown" if np.isnan(speed) else f"{speed:.1f} m/s"
    distance = np.linalg.norm(ego_box.center[0, :2])
    impact = "none"
    if record["time_to_impact"] is not None:
        impact = f"in {record['time_to_impact']:.1f} s"
    if record["is_collider"]:
        impact += ", with this actor"
    agents = "this agent"
    if record["instance_token"] is not None:
        scenario, _, number, _ = record["token"].rsplit("/", 3)
        actor = record["instance_token"].rsplit("/", 1)[1]
        track = dataset.track.get(f"{scenario}/{number}/actor/{actor}")
        agents = ", ".join(map(short_name, track["agents"])) or agents
    return [
        [
            f"category: {record['category']}",
            f"label id: {record['actor_id']}",
            f"size: {length:.2f} × {width:.2f} × {height:.2f} m",
        ],
        [
            f"speed: {speed_words}",
            f"distance: {distance:.1f} m from the agent",
            f"LiDAR points: {record['num_lidar_pts']}",
        ],
        [
            f"visible to the agent's cameras: {'yes' if record['camera_visible'] else 'no'}",
            f"annotated by: {agents}",
            f"impact: {impact}",
        ],
    ]


@in_own_settings
def render_instance(
    dataset: Dataset,
    instance: RowArgument,
    *,
    agents: Agents = None,
    layers: Iterable[Layer] | None = None,
    fig: Figure | None = None,
) -> Figure:
    """Render an actor over time: its path, images, speed, and the agents that see it.

    Args:
        dataset: The release.
        instance: Token or record.
        agents: Agents with views in the figure, or None for all present ones; a configuration is
            from the view of the first agent.
        layers: For the path `bev` (a BEV camera's picture, in pale colours), `trajectories`
            (the path), `boxes` (one a second) and `grid`; for the camera images `image` and
            `boxes`. By default all.
        fig: Empty figure to render on; a new one if None.

    Returns:
        The figure: the actor's path in world from above with its seconds and the impact; the
        largest images of it at four moments; below them its speed, the LiDAR points in its box and
        the agents that see it (by the released rule; pale if an agent only annotated it), over the
        time of the recording. In papers and on slides there are two images and no LiDAR points, in
        a paper's column no speed either.

    Raises:
        TokenError: No such instance.
        ChoiceError: No such layer, agent or configuration.
        NotAvailableError: An agent is not in this (partial) release.
    """
    shown_layers = layers_of(layers, _ACTOR_LAYERS, _ACTOR_LAYERS)
    actor = _actor(dataset, instance)
    sample = sample_token(actor.scenario, actor.recorder, 1)
    names = in_drawing_order(cooperating_agents(dataset, sample, agents))
    sightings_of_agents = []
    for agent in names:
        sightings_of_agents.append(sightings(dataset, actor.scenario, agent, actor.actor_id))
    fig = figure_or_new(fig, (14, 8.5), page=0.42, column=1.65)
    axes = fig.subplot_mosaic(**_ACTOR_MOSAICS[current_style().room])
    crop_axes = [axes[name] for name in _CROP_PANELS if name in axes]
    _draw_path(dataset, actor, shown_layers, axes["path"])
    _draw_crops(dataset, actor, sightings_of_agents, shown_layers, crop_axes)
    time_panels = {
        "speed": partial(_draw_speed, actor),
        "points": partial(_draw_points, sightings_of_agents),
        "seen": partial(_draw_seen, actor, sightings_of_agents),
    }
    for name in time_panels.keys() & axes.keys():
        time_panels[name](axes[name])
        _finish_time_axis(actor, axes[name])
    words = f"{actor.boxes.category_names[0]} {actor.actor_id}"
    if actor.own_agent is not None:
        words += f" ({short_name(actor.own_agent)})"
    set_scene_title(fig, dataset, instance_token(actor.scenario, actor.actor_id), words)
    return fig


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Actor:
    """The data of an actor for the panels.

    Attributes:
        scenario: Token.
        actor_id: CARLA id.
        recorder: First agent of the scenario.
        own_agent: Agent that the actor itself is.
        boxes: T boxes in world.
        index: Their frame numbers, shape (T,), from 1.
        duration: Duration of the scenario, seconds.
        impact: Seconds from the first frame to the recorded impact.
        color: Colour of its role in the accident, or of its category.
    """

    scenario: str
    actor_id: int
    recorder: str
    own_agent: str | None
    boxes: Boxes
    index: IntArray
    duration: float
    impact: float | None
    color: str


def _actor(dataset: Dataset, instance: RowArgument) -> _Actor:
    record = dataset.get("instance", instance)
    scenario = dataset.scenario[dataset.getind("scenario", record["scenario_token"])]
    tracks = scenario_tracks(dataset, scenario["token"])
    rows = np.flatnonzero(tracks.actor_id == record["actor_id"])
    boxes = tracks.boxes.select(rows)
    first_sample = dataset.samples_of(scenario["first_frame_token"])[0]
    return _Actor(
        scenario=scenario["token"],
        actor_id=record["actor_id"],
        recorder=first_sample["agent"],
        own_agent=recorders_of(dataset, scenario["token"]).get(record["actor_id"]),
        boxes=boxes,
        index=tracks.index[rows],
        duration=frame_timestamp(scenario["num_frames"]),
        impact=first_sample["time_to_impact"],
        color=role_colors(dataset, first_sample, boxes)[0],
    )


def _draw_path(dataset: Dataset, actor: _Actor, layers: frozenset[Layer], ax: Axes) -> None:
    """Draw the path from above, in world, with each second and the impact if the actor collides.

    The path is pale at its start.
    """
    path = actor.boxes.center[:, :2]
    center = (path.min(axis=0) + path.max(axis=0)) / 2
    view_range = float(np.ptp(path, axis=0).max()) / 2 + _PATH_MARGIN_M
    show_square(ax, center, view_range)
    if "bev" in layers:
        _draw_road(dataset, actor, center, view_range, ax)
    if "trajectories" in layers:
        draw_trail(path[::-1], ax, actor.color, linewidths=2.5)
    seconds = np.flatnonzero((actor.index - 1) % _FRAMES_PER_SECOND == 0)
    if "boxes" in layers:
        boxes, colors = actor.boxes.select(seconds), [actor.color] * len(seconds)
        draw_boxes_from_above(boxes, ax, colors, fill=0.1)
    written_distance = -np.inf
    for row in seconds.tolist():
        x, y = path[row].tolist()
        travelled = float(np.linalg.norm(path[row] - path[0]))
        if travelled - written_distance > view_range / 8:
            words = f"{frame_timestamp(int(actor.index[row])):.0f} s"
            write_beside(ax, words, (x, y), "black")
            written_distance = travelled
    if actor.impact is not None and actor.color == COLLIDER_COLOR:
        ax.scatter(
            path[-1:, 0],
            path[-1:, 1],
            s=130,
            c=actor.color,
            marker="*",
            edgecolors="white",
            zorder=7,
        )
        x, y = path[-1].tolist()
        write_beside(ax, "impact", (x, y), actor.color)
    ax.locator_params(nbins=5)
    label_axes(ax, "world")
    if "grid" in layers:
        ax.grid(color=GRID_COLOR, linewidth=0.4)


def _draw_road(
    dataset: Dataset, actor: _Actor, center: FloatArray, view_range: float, ax: Axes
) -> None:
    """Draw the picture of the recorder's BEV camera in the middle of the path, if it is present."""
    frame = int(actor.index[len(actor.index) // 2])
    sample = sample_token(actor.scenario, actor.recorder, frame)
    if not dataset.sensor_path(f"{sample}/{BEV_CAMERA}").is_file():
        return
    world_from_ego = dataset.world_from(sample, "ego")
    distance = float(np.abs(center - world_from_ego.translation[:2]).max())
    draw_underlay(
        dataset.load_bev(sample),
        ax,
        target_from_ego=world_from_ego,
        view_range=view_range + distance,
    )


def _draw_crops(
    dataset: Dataset,
    actor: _Actor,
    sightings_of_agents: Sequence[Sightings],
    layers: frozenset[Layer],
    axes: Sequence[Axes],
) -> None:
    """Draw the largest views at several moments at which some camera sees the actor.

    Moments with an image come first.
    """
    moments = _crop_moments(dataset, actor, sightings_of_agents, len(axes))
    hide_axes(axes[len(moments) :])
    if not moments:
        write_in_middle(axes[0], "no camera sees it")
    for frame, ax in zip(moments, axes, strict=False):
        box = actor.boxes.select(actor.index == frame)
        samples = []
        for sighting in sightings_of_agents:
            if frame in sighting.index[sighting.camera]:
                samples.append(sample_token(actor.scenario, sighting.agent, frame))
        view = best_view(dataset, samples, box)
        if view is None:
            ax.set_axis_off()
            continue
        colors = [actor.color] if "boxes" in layers else []
        boxes = box.select(np.arange(len(colors)))
        draw_view(dataset, view, boxes, colors, ax, image="image" in layers)
        agent, _, channel = view.camera.rsplit("/", 3)[1:]
        words = f"{frame_timestamp(frame):.1f} s, {short_name(agent)}, {camera_name(channel)}"
        set_title(ax, words, fontsize=text_size())


def _crop_moments(
    dataset: Dataset, actor: _Actor, sightings_of_agents: Sequence[Sightings], count: int
) -> list[int]:
    """Return at most `count` frames, evenly spread, at which some camera sees the actor."""
    files = dataset.sensor_frames(actor.scenario)
    seen_frames, pictured_frames = [], []
    for sighting in sightings_of_agents:
        frames = sighting.index[sighting.camera]
        images = [frame for camera in CAMERAS for frame in files[sighting.agent, camera]]
        seen_frames.append(frames)
        pictured_frames.append(frames[np.isin(frames, images)])
    if not any(map(len, pictured_frames)):
        pictured_frames = seen_frames
    moments = np.unique(np.concatenate(pictured_frames))
    if not len(moments):
        return []
    rows = np.unique(np.linspace(0, len(moments) - 1, count).round().astype(int))
    return [int(frame) for frame in moments[rows]]


def _draw_speed(actor: _Actor, ax: Axes) -> None:
    speed = np.linalg.norm(actor.boxes.velocity, axis=1)
    ax.plot((actor.index - 1) * FRAME_PERIOD, speed, color=actor.color, linewidth=1.8)
    ax.set_ylim(0, max(1.0, 1.1 * float(np.nan_to_num(speed).max(initial=0))))
    ax.set_title("speed (m/s)", fontsize="medium")


def _draw_points(sightings_of_agents: Sequence[Sightings], ax: Axes) -> None:
    for sighting in sightings_of_agents:
        ax.plot(
            sighting.timestamp,
            sighting.points,
            color=AGENT_COLORS[sighting.agent],
            linewidth=1.3,
            label=short_name(sighting.agent),
        )
    ax.set_yscale("symlog", linthresh=10)
    ax.set_ylim(bottom=0)
    ax.set_title("LiDAR points in its box", fontsize="medium")


def _draw_seen(actor: _Actor, sightings_of_agents: Sequence[Sightings], ax: Axes) -> None:
    """Draw one bar for each agent, from the top down.

    It is full where the agent sees the actor, pale where it only annotated it.
    """
    for row, sighting in enumerate(sightings_of_agents):
        for selection, opacity in ((sighting.seen, 1.0), (~sighting.seen, 0.25)):
            spans = []
            for time in sighting.timestamp[selection].tolist():
                spans.append((time - FRAME_PERIOD / 2, FRAME_PERIOD))
            ax.broken_barh(
                spans,
                (row - 0.35, 0.7),
                facecolors=AGENT_COLORS[sighting.agent],
                alpha=opacity,
                linewidth=0,
            )
        if sighting.agent == actor.own_agent:
            ax.text(
                actor.duration / 2,
                row,
                "is the actor itself",
                ha="center",
                va="center",
                fontsize=text_size(),
            )
    names = [short_name(sighting.agent) for sighting in sightings_of_agents]
    ax.set_yticks(range(len(names)), names)
    ax.set_ylim(len(names) - 0.5, -0.5)
    set_title(ax, "who sees it, pale: only annotated", fontsize="medium")


def _finish_time_axis(actor: _Actor, ax: Axes) -> None:
    with_light_grid(ax, "both")
    ax.locator_params(axis="x", nbins=4)
    margin = FRAME_PERIOD / 2
    ax.set(xlim=(-margin, actor.duration + margin), xlabel="time (s)")
    if actor.impact is not None:
        ax.axvline(actor.impact, color=COLLIDER_COLOR, linewidth=1, linestyle="--")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sightings(FrozenArrays):
    """The moments at which an agent annotated an actor from outside; arrays are read-only.

    Attributes:
        agent: Name of the agent.
        index: Frame numbers from 1, ascending, (T,) int64.
        points: Points of the agent's LiDAR in the box, (T,) int64.
        camera: Whether a camera of the agent sees it, (T,) bool.
        seen: Whether the agent counts as seeing it by the released rule, (T,) bool
            (docs/released_code.md, Visibility and attributes).
    """

    agent: str
    index: IntArray
    points: IntArray
    camera: BoolArray
    seen: BoolArray

    @property
    def timestamp(self) -> FloatArray:
        """Seconds since the scenario's first frame, shape (T,)."""
        return as_floats((self.index - 1) * FRAME_PERIOD)


def sightings(dataset: Dataset, scenario: str, agent: str, actor_id: int) -> Sightings:
    """Return the moments at which an agent of a scenario (tokens) annotated an actor.

    An agent's row of itself does not count.
    """
    rows: list[tuple[int, int, bool, bool]] = []
    for index in range(1, dataset.get("scenario", scenario)["num_frames"] + 1):
        sample = sample_token(scenario, agent, index)
        boxes = dataset.boxes(sample, "lidar")
        is_actor = dataset.actor_ids(sample) == actor_id
        matches = np.flatnonzero(is_actor & (boxes.actor_id != OWN_ACTOR_ID))
        if len(matches):
            row = int(matches[0])
            points, camera = int(boxes.num_lidar_pts[row]), bool(boxes.camera_visible[row])
            seen = actor_id in visible_actors(dataset, sample, agents=[agent])
            rows.append((index, points, camera, seen))
    table = np.array(rows, dtype=np.int64).reshape(-1, 4)
    return Sightings(
        agent=agent,
        index=table[:, 0],
        points=table[:, 1],
        camera=table[:, 2].astype(bool),
        seen=table[:, 3].astype(bool),
    )
