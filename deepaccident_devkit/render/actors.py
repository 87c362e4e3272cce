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
    axis_words,
    figure_or_new,
    layers_of,
    with_light_grid,
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

_POSSIBLE: Final = tuple(layer for layer in LAYERS if layer in {"image", *BEV_LAYERS})
# In an inch, if they are one point high.
_LETTERS: Final = 104
_DEFAULT: Final[tuple[Layer, ...]] = ("image", "bev", "points", "boxes", "grid")
_LAYERS: Final[tuple[Layer, ...]] = ("image", "bev", "boxes", "trajectories", "grid")
_CROPS: Final = ("first", "second", "third", "fourth")
_BESIDE: Final[list[Any]] = [["path", "first", "second"], ["path", "speed", "seen"]]
# The panels of an actor over time, by what there is room for.
_MOSAICS: Final[Mapping[str, dict[str, Any]]] = {
    "all": {
        "mosaic": [
            ["path", "first", "second"],
            ["path", "third", "fourth"],
            ["speed", "points", "seen"],
        ],
        "height_ratios": (1, 1, 1.1),
    },
    "page": {"mosaic": _BESIDE, "width_ratios": (1.6, 1, 1)},
    "slide": {"mosaic": _BESIDE, "width_ratios": (1.9, 1, 1)},
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
_FRAMES_A_SECOND: Final = round(1 / FRAME_PERIOD)
# At least so many metres are rendered around the path, on each side.
_AROUND: Final = 10.0


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

    Of the cameras, those whose images were downloaded come first; if there is none, the image's place is grey.

    Args:
        dataset: the release.
        annotation: token or record.
        margin: metres shown from above to each side of the box's centre.
        layers: `image`, `boxes` (this box in the camera, all boxes from above) and, from above, the other layers of
            `render_bev`; by default image, bev, points, boxes and grid. Without `boxes` only the box itself is
            rendered.
        fig: an empty figure to render on; a new one if None.

    Returns:
        The figure: the part of the camera's image around the box, the box from above in the agent's ego frame, words
        (not in papers).

    Raises:
        TokenError: no such annotation.
        ChoiceError: no such layer.
    """
    chosen = layers_of(layers, _DEFAULT, _POSSIBLE)
    record = dataset.get("annotation", annotation)
    sample = record["sample_token"]
    row = int(record["token"].rsplit("/", 1)[1])
    box = dataset.boxes(sample, "world").select([row])
    color = role_colors(dataset, sample, box)
    fig = figure_or_new(fig, (10, 4.9), page=0.43, column=1.6)
    axes = fig.subplot_mosaic(**_BOX_MOSAICS.get(current_style().room, _BOX_MOSAICS["all"]))
    _draw_in_camera(
        dataset,
        best_view(dataset, [sample], box),
        box,
        color,
        axes["camera"],
        image="image" in chosen,
    )

    own = box.transform(dataset.world_from(sample, "ego").inverse(), "ego")
    x, y = own.center[0, :2].tolist()
    draw_bev(
        dataset,
        sample,
        BevView(view_range=margin, center=(x, y)),
        chosen - {"image"},
        axes["above"],
    )
    draw_boxes_from_above(own, axes["above"], color, fill=0.5, linewidths=2.5)
    axes["above"].set_title("ego frame of the agent", fontsize="medium")

    if "words" in axes:
        _write_facts(dataset, record, own, axes["words"])
    set_scene_title(fig, dataset, record["token"], record["category"])
    return fig


def _write_facts(dataset: Dataset, record: dict[str, Any], own: Boxes, ax: Axes) -> None:
    """Write the facts about a box, which is in the ego frame, in columns."""
    ax.set_axis_off()
    columns, fig = _facts(dataset, record, own), cast("Figure", ax.figure)
    letters = int(_LETTERS / text_size() * fig.bbox.width / fig.dpi / len(columns))
    for column, facts in enumerate(columns):
        lines = [textwrap.fill(fact, letters, subsequent_indent="  ") for fact in facts]
        place = column / len(columns)
        ax.text(place, 1, "\n".join(lines), va="top", fontsize=text_size(), transform=ax.transAxes)


def _draw_in_camera(
    dataset: Dataset, view: BestView | None, box: Boxes, color: list[str], ax: Axes, *, image: bool
) -> None:
    if view is None:
        ax.set_axis_off()
        ax.text(
            0.5,
            0.5,
            "in no image of its agent's cameras",
            ha="center",
            va="center",
            transform=ax.transAxes,
        )
        return
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
    """Render the part of a best view's image around boxes, in world, and their edges; the title is the camera."""
    camera = dataset.get("sample_data", view.camera)
    lens = camera_of(dataset, camera)
    draw_image(dataset, camera, ax, image=image)
    optical_from_world = dataset.world_from(camera["sample_token"], camera["channel"]).inverse()
    draw_boxes_in_image(boxes.transform(optical_from_world, camera["channel"]), lens, ax, colors)
    left, top, right, bottom = crop_about(view.bounds, width=lens.width, height=lens.height)
    ax.set(xlim=(left, right), ylim=(bottom, top))


def _facts(dataset: Dataset, record: dict[str, Any], own: Boxes) -> list[list[str]]:
    """The facts about a box, in columns of lines; `own` has only this box, in the ego frame."""
    length, width, height = record["size"]
    speed = float(np.linalg.norm(record["velocity"]))
    countdown = (
        "none" if record["time_to_impact"] is None else f"in {record['time_to_impact']:.1f} s"
    )
    agents = []
    if record["instance_token"] is not None:
        scenario, _, number, _ = record["token"].rsplit("/", 3)
        actor = record["instance_token"].rsplit("/", 1)[1]
        agents = dataset.track.get(f"{scenario}/{number}/actor/{actor}")["agents"]
    return [
        [
            f"category: {record['category']}",
            f"label id: {record['actor_id']}",
            f"size: {length:.2f} × {width:.2f} × {height:.2f} m",
        ],
        [
            f"speed: {'unknown' if np.isnan(speed) else f'{speed:.1f} m/s'}",
            f"distance: {np.linalg.norm(own.center[0, :2]):.1f} m from the agent",
            f"LiDAR points: {record['num_lidar_pts']}",
        ],
        [
            f"visible to the agent's cameras: {'yes' if record['camera_visible'] else 'no'}",
            f"annotated by: {', '.join(map(short_name, agents)) or 'this agent'}",
            f"impact: {countdown}{', with this actor' if record['is_collider'] else ''}",
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
    """Render an actor over time: its path, how it looks, how fast it is, and who sees it.

    Args:
        dataset: the release.
        instance: token or record.
        agents: whose views are shown, or None for all that are there; a configuration is as seen from the first agent.
        layers: for the path `bev` (a BEV camera's picture, in pale colours), `trajectories` (the path), `boxes` (one
            a second) and `grid`; for the camera images `image` and `boxes`. By default all.
        fig: an empty figure to render on; a new one if None.

    Returns:
        The figure: the actor's path in world from above with its seconds and the impact; the largest images of it at
        four moments; below them its speed, LiDAR points in its box and who sees it (by the released rule; pale if an
        agent only annotated it), over the time of the recording. In papers and on slides there are two images and no
        LiDAR points, in a paper's column no speed either.

    Raises:
        TokenError: no such instance.
        ChoiceError: no such layer, agent or configuration.
        NotAvailableError: an agent is not in this (partial) release.
    """
    chosen = layers_of(layers, _LAYERS, _LAYERS)
    actor = _actor(dataset, instance)
    names = in_drawing_order(
        cooperating_agents(dataset, sample_token(actor.scenario, actor.recorder, 1), agents)
    )
    known = [sightings(dataset, actor.scenario, agent, actor.actor_id) for agent in names]
    fig = figure_or_new(fig, (14, 8.5), page=0.42, column=1.65)
    axes = fig.subplot_mosaic(**_MOSAICS[current_style().room])
    _draw_path(dataset, actor, chosen, axes["path"])
    _draw_crops(dataset, actor, known, chosen, [axes[name] for name in _CROPS if name in axes])
    over_time = {
        "speed": partial(_draw_speed, actor),
        "points": partial(_draw_points, known),
        "seen": partial(_draw_seen, actor, known),
    }
    for name in over_time.keys() & axes.keys():
        over_time[name](axes[name])
        _finish_time(actor, axes[name])
    who = "" if actor.own_agent is None else f" ({short_name(actor.own_agent)})"
    words = f"{actor.boxes.category_names[0]} {actor.actor_id}{who}"
    set_scene_title(fig, dataset, instance_token(actor.scenario, actor.actor_id), words)
    return fig


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Actor:
    """What the panels show of an actor.

    Attributes:
        scenario: token.
        actor_id: CARLA id.
        recorder: the first agent of the scenario.
        own_agent: the agent that the actor itself is.
        boxes: T boxes in world.
        index: (T,) their frame numbers from 1.
        duration: of the scenario, seconds.
        impact: seconds from the first frame to the recorded impact.
        color: that of its part in the accident, or of its category.
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
    first = dataset.samples_of(scenario["first_frame_token"])[0]
    return _Actor(
        scenario=scenario["token"],
        actor_id=record["actor_id"],
        recorder=first["agent"],
        own_agent=recorders_of(dataset, scenario["token"]).get(record["actor_id"]),
        boxes=boxes,
        index=tracks.index[rows],
        duration=frame_timestamp(scenario["num_frames"]),
        impact=first["time_to_impact"],
        color=role_colors(dataset, first, boxes)[0],
    )


def _draw_path(dataset: Dataset, actor: _Actor, layers: frozenset[Layer], ax: Axes) -> None:
    """The path from above, in world: the start pale, each second marked, and the impact if the actor collides."""
    path = actor.boxes.center[:, :2]
    center = (path.min(axis=0) + path.max(axis=0)) / 2
    reach = float(np.ptp(path, axis=0).max()) / 2 + _AROUND
    ax.set(
        xlim=(center[0] - reach, center[0] + reach),
        ylim=(center[1] - reach, center[1] + reach),
        aspect="equal",
    )
    middle = sample_token(actor.scenario, actor.recorder, int(actor.index[len(actor.index) // 2]))
    if "bev" in layers and dataset.sensor_path(f"{middle}/{BEV_CAMERA}").is_file():
        world_from_ego = dataset.world_from(middle, "ego")
        away = float(np.abs(center - world_from_ego.translation[:2]).max())
        draw_underlay(
            dataset.load_bev(middle), ax, target_from_ego=world_from_ego, view_range=reach + away
        )
    if "trajectories" in layers:
        draw_trail(path[::-1], ax, actor.color, linewidths=2.5)
    seconds = np.flatnonzero((actor.index - 1) % _FRAMES_A_SECOND == 0)
    if "boxes" in layers:
        draw_boxes_from_above(
            actor.boxes.select(seconds), ax, [actor.color] * len(seconds), fill=0.1
        )
    last = -np.inf
    for row in seconds.tolist():
        travelled = float(np.linalg.norm(path[row] - path[0]))
        if travelled - last > reach / 8:
            words = f"{frame_timestamp(int(actor.index[row])):.0f} s"
            write_beside(ax, words, (float(path[row, 0]), float(path[row, 1])), "black")
            last = travelled
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
        write_beside(ax, "impact", (float(path[-1, 0]), float(path[-1, 1])), actor.color)
    ax.locator_params(nbins=5)
    x_words, y_words = axis_words("world")
    ax.set(xlabel=x_words, ylabel=y_words)
    if "grid" in layers:
        ax.grid(color=GRID_COLOR, linewidth=0.4)


def _draw_crops(
    dataset: Dataset,
    actor: _Actor,
    known: Sequence[Sightings],
    layers: frozenset[Layer],
    axes: Sequence[Axes],
) -> None:
    """The largest views at several of the moments at which some camera sees the actor, preferably with its image."""
    seen, files = [one.index[one.camera] for one in known], dataset.sensor_frames(actor.scenario)
    images = [[frame for camera in CAMERAS for frame in files[one.agent, camera]] for one in known]
    shown = [index[np.isin(index, there)] for index, there in zip(seen, images, strict=True)]
    moments = np.unique(np.concatenate(shown if any(map(len, shown)) else seen))
    picked = (
        moments[np.unique(np.linspace(0, len(moments) - 1, len(axes)).round().astype(int))]
        if len(moments)
        else []
    )
    for ax in axes[len(picked) :]:
        ax.set_axis_off()
    if not len(picked):
        axes[0].text(
            0.5, 0.5, "no camera sees it", ha="center", va="center", transform=axes[0].transAxes
        )
    for index, ax in zip(picked, axes, strict=False):
        box = actor.boxes.select(actor.index == index)
        there = [one.agent for one in known if index in one.index[one.camera]]
        view = best_view(
            dataset, [sample_token(actor.scenario, agent, int(index)) for agent in there], box
        )
        if view is None:
            ax.set_axis_off()
            continue
        colors = [actor.color] if "boxes" in layers else []
        draw_view(
            dataset, view, box.select(np.arange(len(colors))), colors, ax, image="image" in layers
        )
        agent, _, channel = view.camera.rsplit("/", 3)[1:]
        words = f"{frame_timestamp(int(index)):.1f} s, {short_name(agent)}, {camera_name(channel)}"
        set_title(ax, words, fontsize=text_size())


def _draw_speed(actor: _Actor, ax: Axes) -> None:
    speed = np.linalg.norm(actor.boxes.velocity, axis=1)
    ax.plot((actor.index - 1) * FRAME_PERIOD, speed, color=actor.color, linewidth=1.8)
    ax.set_ylim(0, max(1.0, 1.1 * float(np.nan_to_num(speed).max(initial=0))))
    ax.set_title("speed (m/s)", fontsize="medium")


def _draw_points(known: Sequence[Sightings], ax: Axes) -> None:
    for one in known:
        ax.plot(
            one.timestamp,
            one.points,
            color=AGENT_COLORS[one.agent],
            linewidth=1.3,
            label=short_name(one.agent),
        )
    ax.set_yscale("symlog", linthresh=10)
    ax.set_ylim(bottom=0)
    ax.set_title("LiDAR points in its box", fontsize="medium")


def _draw_seen(actor: _Actor, known: Sequence[Sightings], ax: Axes) -> None:
    """One bar for each agent, from the top: full where it sees the actor, pale where it only annotated it."""
    for row, one in enumerate(known):
        for which, opacity in ((one.seen, 1.0), (~one.seen, 0.25)):
            spans = [
                (time - FRAME_PERIOD / 2, FRAME_PERIOD) for time in one.timestamp[which].tolist()
            ]
            ax.broken_barh(
                spans,
                (row - 0.35, 0.7),
                facecolors=AGENT_COLORS[one.agent],
                alpha=opacity,
                linewidth=0,
            )
        if one.agent == actor.own_agent:
            ax.text(
                actor.duration / 2,
                row,
                "is the actor itself",
                ha="center",
                va="center",
                fontsize=text_size(),
            )
    ax.set_yticks(range(len(known)), [short_name(one.agent) for one in known])
    ax.set_ylim(len(known) - 0.5, -0.5)
    set_title(ax, "who sees it, pale: only annotated", fontsize="medium")


def _finish_time(actor: _Actor, ax: Axes) -> None:
    with_light_grid(ax, "both")
    ax.locator_params(axis="x", nbins=4)
    ax.set(xlim=(-FRAME_PERIOD / 2, actor.duration + FRAME_PERIOD / 2), xlabel="time (s)")
    if actor.impact is not None:
        ax.axvline(actor.impact, color=COLLIDER_COLOR, linewidth=1, linestyle="--")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sightings(FrozenArrays):
    """The moments at which an agent annotated an actor from outside; arrays are read-only.

    Attributes:
        agent: name of the agent.
        index: (T,) int64, frame numbers from 1, ascending.
        points: (T,) int64, points of the agent's LiDAR in the box.
        camera: (T,) bool, whether a camera of the agent sees it.
        seen: (T,) bool, whether the agent counts as seeing it by the released rule (docs/released_code.md, Visibility
            and attributes).
    """

    agent: str
    index: IntArray
    points: IntArray
    camera: BoolArray
    seen: BoolArray

    @property
    def timestamp(self) -> FloatArray:
        """(T,) seconds since the scenario's first frame."""
        return as_floats((self.index - 1) * FRAME_PERIOD)


def sightings(dataset: Dataset, scenario: str, agent: str, actor_id: int) -> Sightings:
    """The moments at which an agent of a scenario (tokens) annotated an actor; its row of itself does not count."""
    rows: list[tuple[int, int, bool, bool]] = []
    for index in range(1, dataset.get("scenario", scenario)["num_frames"] + 1):
        sample = sample_token(scenario, agent, index)
        boxes = dataset.boxes(sample, "lidar")
        found = np.flatnonzero(
            (dataset.actor_ids(sample) == actor_id) & (boxes.actor_id != OWN_ACTOR_ID)
        )
        if len(found):
            row = int(found[0])
            seen = actor_id in visible_actors(dataset, sample, agents=[agent])
            rows.append(
                (index, int(boxes.num_lidar_pts[row]), bool(boxes.camera_visible[row]), seen)
            )
    table = np.array(rows, dtype=np.int64).reshape(-1, 4)
    return Sightings(
        agent=agent,
        index=table[:, 0],
        points=table[:, 1],
        camera=table[:, 2].astype(bool),
        seen=table[:, 3].astype(bool),
    )
