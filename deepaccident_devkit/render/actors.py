"""Single actors: one box with its picture, place and facts; and an actor over time."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, cast

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
    Layers,
    figure_or_new,
    hide_axes,
    label_axes,
    layers_of,
    show_square,
    square_around,
    with_light_grid,
    write_in_middle,
)
from deepaccident_devkit.render.ground import draw_underlay
from deepaccident_devkit.render.styles import (
    AGENT_COLORS,
    COLLIDER_COLOR,
    EMPTY_ROAD_COLORS,
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
from deepaccident_devkit.support.text import fixed_text
from deepaccident_devkit.support.values import NamedValues
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

_BOX_LAYERS = tuple(layer for layer in LAYERS if layer in {"image", *BEV_LAYERS})
_DEFAULT_BOX_LAYERS: Layers = ("image", "bev", "points", "boxes", "grid")
_ACTOR_LAYERS: Layers = ("image", "bev", "boxes", "trajectories", "grid")
# Number of letters per inch of a line, for letters of one point.
_LETTERS_PER_INCH = 104
_CROP_PANELS = ("first", "second", "third", "fourth")
_WIDE_MOSAIC: list[Any] = [["path", "first", "second"], ["path", "speed", "seen"]]
# The panels of an actor over time, for each `room` of a style.
_ACTOR_MOSAICS: Mapping[str, NamedValues] = {
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
# The panels of one box, for each `room` of a style.
_BOX_MOSAICS: Mapping[str, NamedValues] = {
    "all": {
        "mosaic": [["camera", "above"], ["words", "words"]],
        "width_ratios": (16, 10),
        "height_ratios": (4, 0.8),
    },
    "page": {"mosaic": [["camera", "above"]], "width_ratios": (16, 10)},
    "column": {"mosaic": [["camera"], ["above"]], "height_ratios": (9, 16)},
}
# Minimum number of metres shown on each side of the path.
_PATH_MARGIN_M = 10.0


@in_own_settings
def render_annotation(
    dataset: Dataset,
    annotation: RowArgument,
    *,
    margin: float = 15.0,
    layers: Iterable[Layer] | None = None,
    fig: Figure | None = None,
) -> Figure:
    """Render a box in a camera image and from above, with the facts about it in words.

    The image comes from the agent's camera in which the box is largest. Cameras with downloaded
    images come first; if there is none, the image's panel is grey.

    Args:
        dataset: The release.
        annotation: Token or record.
        margin: Metres to each side of the box's centre that the view from above shows.
        layers: Any of `image`, `boxes` (this box in the camera, all boxes from above) and, from
            above, the other layers of `render_bev`; by default image, bev, points, boxes and grid.
            Without `boxes`, only the box itself is rendered.
        fig: Empty figure to render on; a new one if None.

    Returns:
        The figure. It shows the part of the camera's image around the box; the box from above, in
        the agent's ego frame; and, except in papers, the facts about the box.

    Raises:
        TokenError: No such annotation.
        ChoiceError: No such layer.
    """
    shown_layers = layers_of(layers, _DEFAULT_BOX_LAYERS, _BOX_LAYERS)
    record = dataset.get("annotation", annotation)
    sample = record["sample_token"]
    agent = sample.rsplit("/", 2)[1]
    row = int(record["token"].rsplit("/", 1)[1])
    box = dataset.boxes(sample, "world").select([row])
    color = role_colors(dataset, sample, box)
    fig = figure_or_new(fig, (10, 4.9), page=0.43, column=1.6)
    mosaic = _BOX_MOSAICS.get(current_style().layout, _BOX_MOSAICS["all"])
    axes = fig.subplot_mosaic(**mosaic)
    camera_view = best_view(dataset, [sample], box)
    if camera_view is None:
        axes["camera"].set_axis_off()
        write_in_middle(axes["camera"], "outside of all images\nof the agent")
    else:
        has_image = "image" in shown_layers
        draw_view(dataset, camera_view, box, color, axes["camera"], image=has_image)
        axes["camera"].set_anchor("NW")  # the facts below begin there

    ego_box = box.transform(dataset.world_from(sample, "ego").inverse(), "ego")
    x, y = ego_box.center[0, :2].tolist()
    bev_view = BevView(view_range=margin, center=(x, y))
    draw_bev(dataset, sample, bev_view, shown_layers - {"image"}, axes["above"])
    draw_boxes_from_above(ego_box, axes["above"], color, fill=0.5, linewidths=2.5)
    axes["above"].set_title(f"top view ({short_name(agent)}'s frame)", fontsize="medium")

    if "words" in axes:
        _write_facts(dataset, record, ego_box, axes["words"])
    set_scene_title(fig, dataset, record["token"], record["category"])
    return fig


def _write_facts(dataset: Dataset, record: NamedValues, ego_box: Boxes, ax: Axes) -> None:
    """Write the facts about a box in columns; `ego_box` is the box in the ego frame."""
    ax.set_axis_off()
    columns = _facts(dataset, record, ego_box)
    fig = cast("Figure", ax.figure)
    line_letters = _LETTERS_PER_INCH / text_size() * fig.bbox.width / fig.dpi / len(columns)
    for column, facts in enumerate(columns):
        lines = [textwrap.fill(fact, int(line_letters), subsequent_indent="  ") for fact in facts]
        x = column / len(columns)
        text = "\n".join(lines)
        ax.text(x, 1, text, va="top", fontsize=text_size(), transform=ax.transAxes)


def draw_view(
    dataset: Dataset,
    view: BestView,
    boxes: Boxes,
    colors: list[str],
    ax: Axes,
    *,
    image: bool = True,
) -> None:
    """Render the part of a view's image around some boxes (in the world frame), with their edges.

    The title is the camera's name.
    """
    camera = dataset.get("sample_data", view.camera)
    channel = camera["channel"]
    lens = camera_of(dataset, camera)
    draw_image(dataset, camera, ax, image=image)
    optical_from_world = dataset.world_from(camera["sample_token"], channel).inverse()
    optical_boxes = boxes.transform(optical_from_world, channel)
    draw_boxes_in_image(optical_boxes, lens, ax, colors)
    left, top, right, bottom = crop_about(view.bounds, width=lens.width, height=lens.height)
    ax.set(xlim=(left, right), ylim=(bottom, top))


def _facts(dataset: Dataset, record: NamedValues, ego_box: Boxes) -> list[list[str]]:
    """Return the facts about a box as columns of lines; `ego_box` is the box in the ego frame."""
    length, width, height = record["size"]
    speed = float(np.linalg.norm(record["velocity"]))
    speed_words = "unknown" if np.isnan(speed) else f"{speed:.1f} m/s"
    distance = np.linalg.norm(ego_box.center[0, :2])
    impact = "no collision"
    if record["time_to_impact"] is not None:
        actor = "this actor" if record["is_collider"] else "another actor"
        impact = f"{actor} collides in {record['time_to_impact']:.1f} s"
    scenario, agent, number, _ = record["token"].rsplit("/", 3)
    agents = short_name(agent)
    if record["instance_token"] is not None:
        actor = record["instance_token"].rsplit("/", 1)[1]
        track = dataset.track.get(f"{scenario}/{number}/actor/{actor}")
        names = map(short_name, track["agents"])
        agents = ", ".join(names) or agents
    return [
        [
            f"category: {record['category']}",
            f"label id: {record['actor_id']}",
            f"size: {length:.2f} × {width:.2f} × {height:.2f} m",
        ],
        [
            f"speed: {speed_words}",
            f"distance from the agent: {distance:.1f} m",
            f"LiDAR points: {record['num_lidar_pts']}",
        ],
        [
            f"visible to the agent's cameras: {'yes' if record['camera_visible'] else 'no'}",
            f"annotated by: {agents}",
            impact,
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
        agents: Agents whose views the figure shows, or None for all present ones; the first agent
            is the ego of a configuration.
        layers: For the path, any of `bev` (a BEV camera's picture, in pale colours), `trajectories`
            (the path), `boxes` (one a second) and `grid`; for the camera images, any of `image` and
            `boxes`. By default all.
        fig: Empty figure to render on; a new one if None.

    Returns:
        The figure. It shows the actor's path from above, in the world frame, with a mark at each
        second and at the impact; the images in which the actor is largest, at four moments; and,
        over the time to the impact (without one, from the start), the actor's speed, the LiDAR
        points in its box, and the agents that see it by the released rule (pale: an agent only
        annotated it). In papers and on slides there are two images and no LiDAR points; in a
        paper's column, no speed either.

    Raises:
        TokenError: No such instance.
        ChoiceError: No such layer, agent or configuration.
        NotAvailableError: An agent is not in this (partial) release.
    """
    shown_layers = layers_of(layers, _ACTOR_LAYERS, _ACTOR_LAYERS)
    actor = _load_actor(dataset, instance)
    sample = sample_token(actor.scenario, actor.recorder, 1)
    names = in_drawing_order(cooperating_agents(dataset, sample, agents))
    sightings_of_agents = []
    for agent in names:
        sightings_of_agents.append(sightings(dataset, actor.scenario, agent, actor.actor_id))
    fig = figure_or_new(fig, (14, 8.5), page=0.42, column=1.75)
    axes = fig.subplot_mosaic(**_ACTOR_MOSAICS[current_style().layout])
    crop_axes = [axes[name] for name in _CROP_PANELS if name in axes]
    _draw_path(dataset, actor, shown_layers, axes["path"])
    _draw_crops(dataset, actor, sightings_of_agents, shown_layers, crop_axes)
    time_panels = {
        "speed": partial(_draw_speed, actor),
        "points": partial(_draw_points, actor, sightings_of_agents),
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
    """What the panels show of an actor.

    Attributes:
        scenario: Token of the scenario.
        actor_id: CARLA id.
        recorder: First agent of the scenario.
        own_agent: The agent that this actor is; None if it does not record.
        boxes: The actor's T boxes, in the world frame.
        index: Frame numbers of the boxes, shape (T,), from 1.
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

    @property
    def start(self) -> float:
        """Time of the first frame, as in `seconds`."""
        return -(self.impact or 0.0)

    def seconds(self, index: IntArray) -> FloatArray:
        """Return the seconds from the impact, or without one from the start, to numbered frames.

        Frames before the impact have negative times.
        """
        return as_floats(self.start + (index - 1) * FRAME_PERIOD)

    def time_words(self, frame: int, decimals: int) -> str:
        """Return the time of a frame in words, such as `−1.5 s`."""
        return f"{fixed_text(self.start + frame_timestamp(frame), decimals)} s"


def _load_actor(dataset: Dataset, instance: RowArgument) -> _Actor:
    """Load an actor from its track in its scenario."""
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
    """Draw the path from above, in the world frame, with a mark at each second.

    The impact is also marked if the actor collides. The path is pale at its start.
    """
    path = actor.boxes.center[:, :2]
    center, view_range = square_around(path, _PATH_MARGIN_M)
    show_square(ax, center, view_range)
    ax.set_anchor("N")
    if "bev" in layers:
        _draw_road(dataset, actor, ax)
    if "trajectories" in layers:
        draw_trail(path[::-1], ax, actor.color, linewidths=2.5)
    seconds = actor.seconds(actor.index)
    second_rows = np.flatnonzero(np.isclose(seconds, seconds.round()))
    if "boxes" in layers:
        boxes = actor.boxes.select(second_rows)
        draw_boxes_from_above(boxes, ax, [actor.color] * len(boxes), fill=0.1)
    label_distance = -np.inf
    for row in second_rows.tolist():
        x, y = path[row].tolist()
        distance = float(np.linalg.norm(path[row] - path[0]))
        if distance - label_distance > view_range / 8:
            write_beside(ax, actor.time_words(int(actor.index[row]), 0), (x, y), "black")
            label_distance = distance
    if actor.impact is not None and actor.color == COLLIDER_COLOR:
        x, y = path[-1].tolist()
        ax.scatter(x, y, s=130, c=actor.color, marker="*", edgecolors="white", zorder=7)
        write_beside(ax, "impact", (x, y), actor.color)
    ax.locator_params(nbins=5)
    label_axes(ax, "world")
    if "grid" in layers:
        ax.grid(color=GRID_COLOR, linewidth=0.4)


def _draw_road(dataset: Dataset, actor: _Actor, ax: Axes) -> None:
    """Draw the recorder's BEV camera picture from half-way along the path, if it is present."""
    middle = len(actor.index) // 2
    frame = int(actor.index[middle])
    sample = sample_token(actor.scenario, actor.recorder, frame)
    if not dataset.sensor_path(f"{sample}/{BEV_CAMERA}").is_file():
        return
    world_from_ego = dataset.world_from(sample, "ego")
    draw_underlay(
        dataset.load_bev(sample),
        ax,
        target_from_ego=world_from_ego,
        colors=EMPTY_ROAD_COLORS,
    )


def _draw_crops(
    dataset: Dataset,
    actor: _Actor,
    sightings_of_agents: Sequence[Sightings],
    layers: frozenset[Layer],
    axes: Sequence[Axes],
) -> None:
    """Draw the image in which the actor is largest, at several moments when a camera sees it.

    Moments with a downloaded image come first.
    """
    moments = _crop_moments(dataset, actor, sightings_of_agents, len(axes))
    hide_axes(axes[len(moments) :])
    if not moments:
        write_in_middle(axes[0], "no camera sees it")
    for frame, ax in zip(moments, axes, strict=False):
        box = actor.boxes.select(actor.index == frame)
        samples = []
        for sighting in sightings_of_agents:
            seen_frames = sighting.index[sighting.camera]
            if frame in seen_frames:
                samples.append(sample_token(actor.scenario, sighting.agent, frame))
        view = best_view(dataset, samples, box)
        if view is None:
            ax.set_axis_off()
            continue
        boxes = box if "boxes" in layers else box[:0]
        colors = [actor.color] * len(boxes)
        draw_view(dataset, view, boxes, colors, ax, image="image" in layers)
        agent, _, channel = view.camera.rsplit("/", 3)[1:]
        time_words = actor.time_words(frame, 1)
        separator = ",\n" if current_style().layout == "column" else ", "
        words = f"{time_words}{separator}{short_name(agent)}, {camera_name(channel)}"
        set_title(ax, words, fontsize=text_size())


def _crop_moments(
    dataset: Dataset, actor: _Actor, sightings_of_agents: Sequence[Sightings], count: int
) -> list[int]:
    """Return at most `count` evenly spread frames in which some camera sees the actor."""
    image_frames = dataset.sensor_frames(actor.scenario)
    seen_frames: set[int] = set()
    pictured_frames: set[int] = set()
    for sighting in sightings_of_agents:
        frames = sighting.index[sighting.camera].tolist()
        seen_frames.update(frames)
        for camera in CAMERAS:
            images = image_frames[sighting.agent, camera]
            pictured_frames.update(seen_frames.intersection(frames, images))
    moments = sorted(pictured_frames or seen_frames)
    if not moments:
        return []
    rows = np.linspace(0, len(moments) - 1, count).round().astype(int)
    return [moments[row] for row in np.unique(rows).tolist()]


def _draw_speed(actor: _Actor, ax: Axes) -> None:
    seconds = actor.seconds(actor.index)
    speed = np.linalg.norm(actor.boxes.velocity, axis=1)
    ax.plot(seconds, speed, color=actor.color, linewidth=1.8)
    max_speed = float(np.nan_to_num(speed).max(initial=0))
    ax.set_ylim(0, max(1.0, 1.1 * max_speed))
    ax.set_title("Speed (m/s)", fontsize="medium")


def _draw_points(actor: _Actor, sightings_of_agents: Sequence[Sightings], ax: Axes) -> None:
    for sighting in sightings_of_agents:
        ax.plot(
            actor.seconds(sighting.index),
            sighting.points,
            color=AGENT_COLORS[sighting.agent],
            linewidth=1.3,
            label=short_name(sighting.agent),
        )
    ax.set_yscale("symlog", linthresh=10)
    ax.set_ylim(bottom=0)
    ax.set_title("LiDAR points in the box", fontsize="medium")


def _draw_seen(actor: _Actor, sightings_of_agents: Sequence[Sightings], ax: Axes) -> None:
    """Draw one bar for each agent, from the top down.

    A bar is solid while the agent sees the actor, and pale while it only annotated the actor.
    """
    for row, sighting in enumerate(sightings_of_agents):
        for selection, opacity in ((sighting.seen, 1.0), (~sighting.seen, 0.25)):
            starts = actor.seconds(sighting.index[selection]) - FRAME_PERIOD / 2
            spans = [(start, FRAME_PERIOD) for start in starts.tolist()]
            ax.broken_barh(
                spans,
                (row - 0.35, 0.7),
                facecolors=AGENT_COLORS[sighting.agent],
                alpha=opacity,
                linewidth=0,
            )
        if sighting.agent == actor.own_agent:
            ax.text(
                actor.start + actor.duration / 2,
                row,
                "the actor itself",
                ha="center",
                va="center",
                fontsize=text_size(),
            )
    names = [short_name(sighting.agent) for sighting in sightings_of_agents]
    ax.set_yticks(range(len(names)), names)
    ax.set_ylim(len(names) - 0.5, -0.5)
    set_title(ax, "Seen by\n(pale: labelled, not visible)", fontsize="medium")


def _finish_time_axis(actor: _Actor, ax: Axes) -> None:
    with_light_grid(ax, "both")
    ax.locator_params(axis="x", nbins=4)
    margin = FRAME_PERIOD / 2
    label = "time (s)" if actor.impact is None else "time relative to the impact (s)"
    ax.set(xlim=(actor.start - margin, actor.start + actor.duration + margin), xlabel=label)
    if actor.impact is not None:
        ax.axvline(0.0, color=COLLIDER_COLOR, linewidth=1, linestyle="--")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sightings(FrozenArrays):
    """The moments at which an agent annotated an actor from outside; arrays are read-only.

    Attributes:
        agent: Name of the agent.
        index: Frame numbers from 1, ascending, (T,) int64.
        points: Points of the agent's LiDAR in the box, (T,) int64.
        camera: Whether a camera of the agent sees the actor, (T,) bool.
        seen: Whether the agent counts as seeing the actor by the released rule, (T,) bool
            (docs/released_code.md, Visibility and attributes).
    """

    agent: str
    index: IntArray
    points: IntArray
    camera: BoolArray
    seen: BoolArray


def sightings(dataset: Dataset, scenario: str, agent: str, actor_id: int) -> Sightings:
    """Return the moments at which an agent of a scenario (tokens) annotated an actor.

    Rows in which an agent annotated itself are left out.
    """
    rows = []
    frame_count = dataset.get("scenario", scenario)["num_frames"]
    for frame in range(1, frame_count + 1):
        sample = sample_token(scenario, agent, frame)
        boxes = dataset.boxes(sample, "lidar")
        is_actor = dataset.actor_ids(sample) == actor_id
        is_own = boxes.actor_id == OWN_ACTOR_ID
        box = boxes.select(np.flatnonzero(is_actor & ~is_own)[:1])
        if len(box):
            is_seen = actor_id in visible_actors(dataset, sample, agents=[agent])
            rows.append((frame, box.num_lidar_pts[0], box.camera_visible[0], is_seen))
    columns = np.array(rows, dtype=np.int64).reshape(-1, 4).T
    index, points, camera, seen = columns
    return Sightings(
        agent=agent,
        index=index,
        points=points,
        camera=camera.astype(bool),
        seen=seen.astype(bool),
    )
