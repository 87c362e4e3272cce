"""The countdown to an impact: a figure of several moments, and a video's picture of one moment."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ChoiceError, NotAvailableError
from deepaccident_devkit.geometry import SE3, Boxes
from deepaccident_devkit.render.boxes import (
    actor_tags,
    bounds_in_image,
    camera_name,
    draw_actors_from_above,
    draw_boxes_in_image,
    draw_trails,
    in_drawing_order,
    role_colors,
)
from deepaccident_devkit.render.camera import (
    CAMERA_LAYERS,
    BestView,
    best_view,
    crop_about,
    draw_camera,
)
from deepaccident_devkit.render.captions import is_there, set_scene_title
from deepaccident_devkit.render.chips import keep_free, place_chips
from deepaccident_devkit.render.figures import (
    Layer,
    figure_or_new,
    layers_of,
    settled,
    with_light_grid,
)
from deepaccident_devkit.render.ground import draw_underlay
from deepaccident_devkit.render.styles import (
    AGENT_COLORS,
    CASING_COLOR,
    COLLIDER_COLOR,
    GRID_COLOR,
    current_style,
    in_own_settings,
    text_size,
)
from deepaccident_devkit.support.arrays import FloatArray
from deepaccident_devkit.tables.tokens import sample_token
from deepaccident_devkit.taxonomy import AGENTS, BEV_CAMERA, CAMERAS, FRAME_PERIOD, short_name
from deepaccident_devkit.v2x import Agents, Contact, collision, cooperating_agents
from deepaccident_devkit.v2x.agents import agents_of
from deepaccident_devkit.v2x.collisions import CONTACT_GAP, contact_words
from deepaccident_devkit.v2x.poses import camera_of
from deepaccident_devkit.v2x.tracks import ScenarioTracks, scenario_tracks

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PAIR_LAYERS: Final[tuple[Layer, ...]] = (*CAMERA_LAYERS, "bev", "trajectories", "grid")
# Frames for which the last camera that saw the pair is kept.
_REMEMBERED: Final = 10
# Metres around the place of contact that are shown, at least and at most.
_LEAST, _MOST = 9.0, 24.0
# Metres around the pair.
_MARGIN: Final = 2.5
# Seconds of the paths that led to the contact.
_PAST: Final = 3.0
# Share of an image's width that is shown at least: who looks must still see where it is.
_LEAST_CROP: Final = 0.4
# Points: the size of the cross at the place of contact.
_CROSS: Final = 9.0
# Share of a panel's width and height that the places of tags keep to its edges.
_EDGE: Final = 0.01
# Points, about, at the top of an image in which tags may cover a car: it may fill the image.
_FREE: Final = 22.0
_HIDDEN: Final = (0, (3, 2))
# Seconds before the impact.
COUNTDOWN: Final = (2.0, 1.0, 0.5, 0.0)
_IN_A_COLUMN: Final = (1.0, 0.0)
_SHOWN: Final[tuple[Layer, ...]] = ("image", "bev", "boxes", "trajectories", "grid")
# Width of a panel in inches.
_WIDTH: Final = 3.3
# Inches of a camera's panel below which agents are left out.
_LEAST_WIDTH: Final = 1.6
# Letters that a line above a panel of a small picture has room for.
_SHORT: Final = 16
# Inches of words above a row, for letters of one point.
_ROW_WORDS: Final = 0.03
# Of a small picture that panels should cover, by the estimate of `_width`.
_ENOUGH: Final = 0.6
# Inches of the height that titles take, about.
_TITLE: Final = 1.0
# The panels of a video's picture.
_MOSAIC: Final[list[Any]] = [[*AGENTS[:3]], ["above", *AGENTS[3:]], ["above", "speeds", "speeds"]]
_DASHES: Final = ("-", "--")


@in_own_settings
def render_accident(
    dataset: Dataset,
    scenario: RowArgument,
    *,
    seconds: Sequence[float] | None = None,
    agents: Agents = None,
    layers: Iterable[Layer] | None = None,
    fig: Figure | None = None,
) -> Figure:
    """Render the countdown to an accident: a column for each moment, a row for each agent, and one from above.

    In a wide figure rows are columns. Each agent has a part of the image that shows the colliding pair best, of those
    that were downloaded; if none was, a grey panel. If no camera shows the pair, it is the last one that did, or the
    front one. The pair's boxes are dashed where the agent's label says that no camera sees them. The view from above
    has the place of contact (a cross), the pair's speeds, and the pair's paths up to the contact; its scale is that of
    its bar. `E` is the ego vehicle, `O` the other one.

    Args:
        dataset: the release.
        scenario: token or record of one with a collision.
        seconds: before the recording's last frame, which the impact is near; moments before the first are left out.
            None is for `COUNTDOWN`, or in a paper's column for one second before the impact and the impact.
        agents: whose images are shown; an empty list for none. None is for all that are there or, where their images
            would be narrower than 1.6 inches, as on a slide, for the ego and those that see the pair best; the title
            says so.
        layers: `image`, `bev` (the road), `boxes`, `trajectories` and `grid` are the default; also
            `points` (of the LiDAR, in images), `ids` and `velocities`. Without `image` no image file is read.
        fig: an empty figure to render on; a new one if None.

    Returns:
        The figure; its title says who hits whom, how fast and at which angle, and whether the recording ends before
        the pair are near enough to touch.

    Raises:
        TokenError: no such scenario.
        NotAvailableError: nobody collides in it (the nearest approach of a normal scenario is no accident), it has no
            meta, or an agent is not in this release.
        ChoiceError: no such agent, configuration or layer, or none of the moments was recorded.
    """
    shown = layers_of(layers, _SHOWN, PAIR_LAYERS)
    contact = _contact(dataset, scenario, "look at moments of this one with render_frame")
    record = dataset.get("scenario", scenario)
    cut = _cut_words(contact, record["num_frames"])
    usual = _IN_A_COLUMN if current_style().room == "column" else COUNTDOWN
    moments = _moments(seconds or usual, record["num_frames"])
    first = sample_token(record["token"], agents_of(dataset, scenario)[0], record["num_frames"])
    names = in_drawing_order([] if agents == [] else cooperating_agents(dataset, first, agents))
    fig = figure_or_new(
        fig, (_WIDTH * len(moments) + 0.8, 1.95 * len(names) + _WIDTH + 1.1), column=1.45
    )
    pair, best = CollidingPair.of(dataset, contact), ""
    room = _agents_with_room(fig, len(names), len(moments)) if agents is None else len(names)
    if room < len(names):
        best = f"{room} of {len(names)} agents"
        names = _best_agents(pair, names, [index for _, index in moments], room)
    axes, across = _panels(fig, len(names), len(moments))
    for column, (left, index) in enumerate(moments):
        for agent, ax in zip(names, axes[:, column], strict=False):
            _write_name(draw_pair_in_camera(pair, agent, index, shown, ax), ax)
        draw_pair_from_above(pair, index, shown, axes[-1, column])
        end = "the last frame" if cut or contact.touching else "the impact"
        _write_head(
            end if left == 0 else f"{left:g} s before", "black", axes[0, column], above=not across
        )
    for agent, ax in zip(names, axes[:, 0], strict=False):
        _write_head(short_name(agent), AGENT_COLORS[agent], ax, above=across)
    _write_head(
        "from above,\nspeeds in m/s" if current_style().few else "from above",
        "black",
        axes[-1, 0],
        above=across,
    )
    words = "\n".join(filter(None, [accident_words(dataset, contact), cut]))
    set_scene_title(fig, dataset, record["token"], best, below=words)
    return settled(fig)


def draw_countdown(
    dataset: Dataset,
    frame: str,
    *,
    agents: Sequence[str],
    layers: Collection[Layer] | None,
    fig: Figure,
) -> None:
    """Render a moment of an accident on an empty figure of about 16 to 9: five cameras, the contact, the pair's speeds.

    Cameras are chosen and layers named as in `render_accident`. Raises NotAvailableError if nobody collides.
    """
    shown = layers_of(layers, _SHOWN, PAIR_LAYERS)
    record = dataset.get("frame", frame)
    index = record["index"]
    contact = _contact(dataset, record["scenario_token"], "the view 'frame'")
    pair = CollidingPair.of(dataset, contact)
    axes = fig.subplot_mosaic(_MOSAIC, height_ratios=(1, 1, 0.8))
    for agent in AGENTS:
        if agent not in agents:
            axes[agent].set_axis_off()
            continue
        words = draw_pair_in_camera(pair, agent, index, shown, axes[agent]).replace("\n", " ")
        axes[agent].set_title(
            f"{short_name(agent)}: {words}", fontsize="medium", color=AGENT_COLORS[agent]
        )
    draw_pair_from_above(pair, index, shown, axes["above"])
    axes["above"].set_title(f"from above, {axes['above'].get_title()}", fontsize="medium")
    _draw_speeds(pair, index, axes["speeds"])
    set_scene_title(
        fig, dataset, frame, below=accident_words(dataset, contact).replace("\n", "; "), fontsize=12
    )


def accident_words(dataset: Dataset, contact: Contact) -> str:
    """Two lines: who hits whom, with which sides, how fast and at which angle; and when, if not at the last frame."""
    scenario = contact.frame.rsplit("/", 1)[0]
    owners = {
        dataset.agent.get(f"{scenario}/{agent}")["actor_id"]: short_name(agent)
        for agent in agents_of(dataset, scenario)
    }
    names = []
    for instance, actor in zip(contact.instances, contact.actor_ids, strict=True):
        category = dataset.instance.get(instance)["category"]
        names.append(
            f"{owners[actor]} ({category} {actor})" if actor in owners else f"{category} {actor}"
        )
    order = (1, 0) if contact.sides[1] == "front" and contact.sides[0] != "front" else (0, 1)
    hitting, hit = (names[each] for each in order)
    verb = "and" if contact.apart else "hits" if contact.sides[order[0]] == "front" else "touches"
    sides = " to ".join(contact.sides[each] for each in order)
    speeds = " and ".join(number_words(contact.speeds[each]) for each in order)
    when = "" if contact.touching == 0 else f"\n{contact_words(contact.touching, contact.gap)}"
    return (
        f"{hitting} {verb} {hit}, {sides}\n{speeds} m/s, closing at {number_words(contact.closing_speed)} m/s, "
        f"{np.degrees(contact.impact_angle):.0f}° between their headings{when}"
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CollidingPair:
    """Two actors that collide in a scenario (a token), where all actors are, and the short names of the two by id."""

    dataset: Dataset
    scenario: str
    contact: Contact
    tracks: ScenarioTracks
    tags: dict[int, str]

    @classmethod
    def of(cls, dataset: Dataset, contact: Contact) -> CollidingPair:
        """The pair of a contact."""
        scenario = contact.frame.rsplit("/", 1)[0]
        tracks = scenario_tracks(dataset, scenario)
        return cls(
            dataset=dataset,
            scenario=scenario,
            contact=contact,
            tracks=tracks,
            tags=actor_tags(dataset, contact),
        )

    def at(self, index: int, seen_by: str | None = None) -> Boxes:
        """Their boxes in world in a frame (number from 1), as far as they exist; without the agent that sees them."""
        there = self.tracks.at(index)
        own = (
            None
            if seen_by is None
            else self.dataset.agent.get(f"{self.scenario}/{seen_by}")["actor_id"]
        )
        return there.select(
            np.isin(there.actor_id, [actor for actor in self.contact.actor_ids if actor != own])
        )

    def view(self, agent: str, index: int) -> tuple[str, BestView | None, int | None]:
        """The camera of an agent that shows the pair best in a frame, its view, and when it last had the pair.

        Cameras whose images are there come first. If none has the pair in its image, it is the last one that had, and
        without such a one the front camera; then there is no view.
        """
        sample = sample_token(self.scenario, agent, index)
        there = [
            channel for channel in CAMERAS if is_there(self.dataset, f"{sample}/{channel}")
        ] or CAMERAS
        for earlier in range(index, max(0, index - _REMEMBERED), -1):
            then = sample_token(self.scenario, agent, earlier)
            view = best_view(self.dataset, [then], self.at(earlier, agent), there)
            if view is not None:
                return view.camera.rsplit("/", 1)[1], view if earlier == index else None, earlier
        return there[0], None, None


def draw_pair_in_camera(
    pair: CollidingPair, agent: str, index: int, layers: Collection[Layer], ax: Axes
) -> str:
    """Render the part of an agent's image that has the pair, with tags; dashed if no camera of the agent sees them.

    The frame is a number from 1. Returns the camera's short name, and how long ago it saw the pair if it does not now.
    """
    dataset, sample = pair.dataset, sample_token(pair.scenario, agent, index)
    channel, view, last = pair.view(agent, index)
    name = camera_name(channel)
    camera = dataset.get("sample_data", f"{sample}/{channel}")
    draw_camera(dataset, camera, {*layers}.intersection(CAMERA_LAYERS), ax)
    ax.set_title("")
    if view is None:
        return name if last is None else f"{name}:\nseen {(index - last) * FRAME_PERIOD:.1f} s ago"
    lens = camera_of(dataset, camera)
    left, top, right, bottom = crop_about(
        view.bounds, width=lens.width, height=lens.height, share=_LEAST_CROP
    )
    ax.set(xlim=(left, right), ylim=(bottom, top))
    if "boxes" not in layers:
        return name
    both = pair.at(index, agent).transform(dataset.world_from(sample, channel).inverse(), channel)
    hidden = both.select(~np.isin(both.actor_id, dataset.boxes(sample, visible="camera").actor_id))
    draw_boxes_in_image(hidden, lens, ax, [COLLIDER_COLOR] * len(hidden), linestyle=_HIDDEN)
    _write_tags_in_image(pair, both.actor_id.tolist(), bounds_in_image(both, lens), ax)
    return name


def draw_pair_from_above(
    pair: CollidingPair, index: int, layers: Collection[Layer], ax: Axes
) -> None:
    """Render a frame (number from 1) around the place of contact, in world, as near as the pair allows.

    The layers are `bev` (the road), `boxes`, `velocities`, `ids`, `trajectories` (of the pair, up to the contact) and
    `grid`; the title is the pair's speeds.
    """
    dataset, contact = pair.dataset, pair.contact
    sample = dataset.get(
        "sample", sample_token(pair.scenario, agents_of(dataset, pair.scenario)[0], index)
    )
    boxes, both = pair.tracks.at(index), pair.at(index)
    place = contact.point[:2]
    reach = _MARGIN + float(np.abs(both.bottom_corners()[..., :2] - place).max(initial=0.0))
    reach = min(max(reach, _LEAST), _MOST)
    x, y = place.tolist()
    ax.set(xlim=(x - reach, x + reach), ylim=(y - reach, y + reach), aspect="equal")
    if "bev" in layers:
        _draw_road(pair, index, reach, ax)
    if "trajectories" in layers:
        seconds, red = (_PAST, sample["time_to_impact"] or 0.0), [COLLIDER_COLOR] * len(both)
        draw_trails(
            dataset, sample, both, red, target_from_world=SE3.identity(), seconds=seconds, ax=ax
        )
    _write_tags_from_above(pair, both, ax)  # before the ids, which have what room is left
    draw_actors_from_above(boxes, ax, role_colors(dataset, sample, boxes), layers)
    ax.plot(x, y, "x", color="black", markersize=_CROSS, markeredgewidth=1.8, zorder=5)
    keep_free(ax, [[place]], margin=(-_CROSS / 2, -_CROSS / 2, _CROSS / 2, _CROSS / 2))
    _draw_scale(reach, ax, grid="grid" in layers)
    speeds = [
        f"{pair.tags[actor]} {number_words(float(np.linalg.norm(velocity)))}"
        for actor, velocity in zip(both.actor_id.tolist(), both.velocity, strict=True)
    ]
    words = ", ".join(speeds) + ("" if current_style().few else " m/s")
    ax.set_title(
        "\n".join(speeds) if current_style().few and len(words) > _SHORT else words,
        fontsize=text_size(),
    )


def number_words(value: float) -> str:
    """A number with one digit, or `unknown`."""
    return f"{value:.1f}" if np.isfinite(value) else "unknown"


def _draw_road(pair: CollidingPair, index: int, reach: float, ax: Axes) -> None:
    """Render the ground from the BEV camera that is nearest to the contact; nothing if there is no file."""
    dataset, place = pair.dataset, pair.contact.point[:2]
    samples = [
        sample_token(pair.scenario, agent, index) for agent in agents_of(dataset, pair.scenario)
    ]
    there = [sample for sample in samples if is_there(dataset, f"{sample}/{BEV_CAMERA}")]
    poses = [dataset.world_from(sample, "ego") for sample in there]
    away = [float(np.abs(pose.translation[:2] - place).max()) for pose in poses]
    if there:
        best = int(np.argmin(away))
        image = dataset.load_bev(there[best])
        draw_underlay(image, ax, target_from_ego=poses[best], view_range=reach + away[best])


def _draw_scale(reach: float, ax: Axes, *, grid: bool) -> None:
    """Render a bar of 5 or 10 m, and cells of that size, in place of numbers at the axes."""
    from matplotlib.ticker import MultipleLocator

    metres = 5.0 if reach < 1.25 * _LEAST else 10.0
    if grid:
        ax.grid(color=GRID_COLOR, linewidth=0.4)
        ax.set_axisbelow(True)
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_locator(MultipleLocator(metres))
    ax.tick_params(labelbottom=False, labelleft=False, length=0)
    left, low = (each + 0.1 * reach for each in ax.viewLim.min)
    ax.plot([left, left + metres], [low, low], color="black", linewidth=2)
    paper = {"facecolor": CASING_COLOR, "edgecolor": "none", "alpha": 0.7, "pad": 0.5}
    ax.text(
        left,
        low + 0.06 * reach,
        f"{metres:.0f} m",
        fontsize=text_size(),
        va="bottom",
        zorder=6,
        bbox=paper,
    )
    keep_free(ax, [[(left, low), (left + metres, low)]], margin=(-2, -2, 2, 2 * text_size()))


def _write_tags_in_image(
    pair: CollidingPair, actors: list[int], bounds: FloatArray, ax: Axes
) -> None:
    """Write tags above what the panel shows of boxes with bounds (N, 4), pixels; of two, at their outer sides."""
    (left, right), (bottom, top) = ax.get_xlim(), ax.get_ylim()
    cars = bounds.reshape(-1, 2, 2).clip((left, top), (right, bottom))
    shown = np.flatnonzero((cars[:, 1] > cars[:, 0]).all(axis=1))
    shown = shown[np.argsort(cars[shown, :, 0].mean(axis=1))]
    cars = cars[shown]
    places = np.column_stack([cars[..., 0].mean(axis=1), cars[:, 0, 1]])
    if len(cars) > 1:
        places[:, 0] = cars[0, 0, 0], cars[1, 1, 0]
    free = top + (bottom - top) * min(0.5, _FREE * ax.figure.dpi / 72 / ax.bbox.height)
    places[places[:, 1] < free, 1] = top
    cars[..., 1] = cars[..., 1].clip(free)
    _write_tags([pair.tags[actors[row]] for row in shown.tolist()], places, ax)
    keep_free(ax, cars)


def _write_tags_from_above(pair: CollidingPair, both: Boxes, ax: Axes) -> None:
    """Write tags beside boxes of the pair, each at the end that is away from the other."""
    middle = both.center[:, :2].mean(axis=0) if len(both) > 1 else pair.contact.point[:2]
    away = both.center[:, :2] - middle
    away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)
    ends = both.bottom_corners()[..., :2] - both.center[:, None, :2]
    places = both.center[:, :2] + away * (ends @ away[..., None]).max(axis=1)
    _write_tags([pair.tags[actor] for actor in both.actor_id.tolist()], places, ax)


def _write_tags(tags: list[str], places: FloatArray, ax: Axes) -> None:
    """Write tags near places (N, 2) or, if these are not in the panel, at its edge."""
    low, high = np.array(ax.viewLim.min), np.array(ax.viewLim.max)
    edge = _EDGE * (high - low)
    places = places.clip(low + edge, high - edge)
    place_chips(ax, zip(tags, places, strict=True), colors=[COLLIDER_COLOR] * len(tags))


def _cut_words(contact: Contact, frames: int) -> str:
    """Says that a recording of so many frames does not end with its accident; empty if it does."""
    last = int(contact.frame.rsplit("/", 1)[1])
    if last == frames and contact.gap <= CONTACT_GAP:
        return ""
    return f"cut short? the pair are {contact.gap:.1f} m apart at frame {last} of {frames}, the last that shows both"


def _contact(dataset: Dataset, scenario: RowArgument, instead: str) -> Contact:
    """How the accident of a scenario happened; raises NotAvailableError, with a remedy, if there is none."""
    contact = collision(dataset, scenario)
    if contact is None:
        raise NotAvailableError(
            f"{dataset.get('scenario', scenario)['token']}: nobody collides in it, so there is nothing to count down "
            f"to; choose a scenario with a collision, or {instead}"
        )
    return contact


def _moments(seconds: Sequence[float], last: int) -> list[tuple[float, int]]:
    """Seconds before the impact and frame numbers of those that were recorded."""
    moments = [(left, last - round(left / FRAME_PERIOD)) for left in seconds]
    recorded = [(left, index) for left, index in moments if 1 <= index <= last]
    if not recorded:
        raise ChoiceError(
            f"seconds: expected some from 0 to {(last - 1) * FRAME_PERIOD:.1f}, as recorded before the impact, "
            f"found {list(seconds)}"
        )
    return recorded


def _width(fig: Figure, agents: int, moments: int) -> tuple[float, bool]:
    """Inches of a panel of the first row or column, about, and whether rows are columns because it is then wider."""
    width, height = fig.bbox.width / fig.dpi, fig.bbox.height / fig.dpi - _TITLE
    down = min(width / moments, height / (agents * 9 / 16 + 1))
    row = height / moments - _ROW_WORDS * text_size()
    across = (16 / 9 if agents else 1) * min(row, width / (agents * 16 / 9 + 1))
    return max(down, across), across > down


def _panels(fig: Figure, agents: int, moments: int) -> tuple[Any, bool]:
    """Axes (agents + 1, moments), and whether rows are columns."""
    if _width(fig, agents, moments)[1]:
        return fig.subplots(
            moments, agents + 1, squeeze=False, width_ratios=(*[16 / 9] * agents, 1)
        ).T, True
    return fig.subplots(
        agents + 1, moments, squeeze=False, height_ratios=(*[9 / 16] * agents, 1)
    ), False


def _agents_with_room(fig: Figure, agents: int, moments: int) -> int:
    """How many of the agents can be shown so large that one can see what happens, or as large as they can be."""
    panels = {number: _width(fig, number, moments) for number in range(1, agents + 1)}
    least = min(_LEAST_WIDTH, 0.9 * max(width for width, _ in panels.values()))
    areas = {
        number: moments * width**2 * (number * 9 / 16 + (81 / 256 if across else 1))
        for number, (width, across) in panels.items()
        if width >= least
    }
    enough = _ENOUGH * fig.bbox.width * fig.bbox.height / fig.dpi**2 if current_style().few else 0.0
    return max(
        (number for number, area in areas.items() if area > enough),
        default=max(areas, key=areas.__getitem__),
    )


def _best_agents(
    pair: CollidingPair, agents: Sequence[str], frames: Sequence[int], number: int
) -> list[str]:
    """So many of the agents: the ego, and those in whose images most, and of equals the largest, of the pair is."""
    views = {agent: [pair.view(agent, index)[1] for index in frames] for agent in agents}
    seen = {
        agent: [(view.shown, view.area) for view in views[agent] if view is not None]
        for agent in agents
    }
    best = {agent: np.sum([(0, 0), *seen[agent]], axis=0).tolist() for agent in agents}
    ranked = sorted(agents, key=lambda agent: (agent == AGENTS[0], best[agent]), reverse=True)
    return in_drawing_order(ranked[:number])


def _write_head(words: str, color: str, ax: Axes, *, above: bool) -> None:
    """Write the head of a column above its first panel, or that of a row beside it."""
    if above:
        ax.set_title(
            "\n".join(filter(None, [words, ax.get_title()])), color=color, fontsize="medium"
        )
        return
    style: dict[str, Any] = {"rotation": 90, "ha": "right", "va": "center", "fontweight": "bold"}
    ax.text(-0.02, 0.5, words, color=color, transform=ax.transAxes, **style)


def _write_name(words: str, ax: Axes) -> None:
    """Write a camera's name into the lower left corner of its panel, whatever is there."""
    ax.annotate(
        words,
        (0, 0),
        (3, 3),
        xycoords="axes fraction",
        textcoords="offset points",
        fontsize=text_size(),
        bbox={"facecolor": CASING_COLOR, "edgecolor": GRID_COLOR, "linewidth": 0.7, "pad": 1.5},
        zorder=5,
        in_layout=False,
    )


def _draw_speeds(pair: CollidingPair, index: int, ax: Axes) -> None:
    """Render the pair's speeds over the seconds before the impact: strong up to the present, pale after it."""
    tracks = pair.tracks
    impact = int(tracks.index.max())
    for actor, dashes in zip(pair.contact.actor_ids, _DASHES, strict=True):
        rows = np.flatnonzero(tracks.actor_id == actor)
        before = (tracks.index[rows] - impact) * FRAME_PERIOD
        speed = np.linalg.norm(tracks.boxes.velocity[rows], axis=1)
        past = tracks.index[rows] <= index
        style: dict[str, Any] = {"color": COLLIDER_COLOR, "linestyle": dashes}
        ax.plot(before, speed, linewidth=1.2, alpha=0.25, **style)
        ax.plot(before[past], speed[past], linewidth=2.0, label=pair.tags[actor], **style)
    ax.axvline((index - impact) * FRAME_PERIOD, color="black", linewidth=1.2)
    ax.axvline(0, color=COLLIDER_COLOR, linewidth=1.2, linestyle=":")
    ax.set(
        xlabel="time to the impact (s)",
        ylabel="speed (m/s)",
        xlim=(-(impact - 1) * FRAME_PERIOD, 0.1),
        ylim=(0, None),
    )
    ax.legend(loc="lower left", fontsize=text_size(), ncols=2, framealpha=0.7)
    with_light_grid(ax, "both")
