"""The countdown to an impact: a figure of several moments, and a video picture of one moment."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ChoiceError, NotAvailableError
from deepaccident_devkit.geometry import SE3, Boxes
from deepaccident_devkit.render.bev import draw_agents, draw_road
from deepaccident_devkit.render.boxes import (
    actor_tags,
    bounds_in_image,
    camera_name,
    draw_actors_from_above,
    draw_boxes_in_image,
    draw_trails,
    in_drawing_order,
    recorders_of,
    role_colors,
)
from deepaccident_devkit.render.camera import (
    CAMERA_LAYERS,
    BestView,
    best_view,
    crop_about,
    draw_camera,
)
from deepaccident_devkit.render.captions import has_sensor_file, set_scene_title, set_title
from deepaccident_devkit.render.chips import keep_free, place_chips
from deepaccident_devkit.render.figures import (
    Layer,
    Layers,
    figure_or_new,
    lay_out_figure,
    layers_of,
    with_light_grid,
)
from deepaccident_devkit.render.styles import (
    AGENT_COLORS,
    CASING_COLOR,
    COLLIDER_COLOR,
    GRID_COLOR,
    current_style,
    in_own_settings,
    text_size,
)
from deepaccident_devkit.support.arrays import AnyArray, FloatArray, IntArray
from deepaccident_devkit.tables.tokens import sample_token
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS, FRAME_PERIOD, short_name
from deepaccident_devkit.v2x import Agents, Contact, collision, cooperating_agents
from deepaccident_devkit.v2x.agents import agents_of
from deepaccident_devkit.v2x.collisions import CONTACT_GAP, contact_words
from deepaccident_devkit.v2x.poses import camera_of
from deepaccident_devkit.v2x.tracks import ScenarioTracks, scenario_tracks

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PAIR_LAYERS: Final[Layers] = (*CAMERA_LAYERS, "bev", "trajectories", "grid")
_DEFAULT_LAYERS: Layers = ("image", "bev", "boxes", "trajectories", "grid")
# Frames for which the last camera that saw the pair stays selected.
_CAMERA_MEMORY_FRAMES = 10
# Minimum and maximum number of metres shown around the point of contact.
_VIEW_RANGES_M = (9.0, 24.0)
# Metres shown around the pair.
_PAIR_MARGIN_M = 2.5
# How many seconds of the pair's paths are shown.
_PAST_S = 3.0
# Minimum share of an image's width: the viewer must still recognise the surroundings.
_MIN_CROP_SHARE = 0.4
# Size of the cross at the point of contact, in points.
_CROSS_SIZE_PT = 9.0
# Distance of tags from a panel's edges, as a share of its width and height.
_EDGE_SHARE = 0.01
# Distance of tags from the centres of boxes, away from the point of contact, metres.
_TAG_OFFSET_M = 2.0
# Weight of an actor's area in pixels; the number of visible actors takes precedence.
_AREA_WEIGHT = 1e-9
_HIDDEN_LINE_STYLE = (0, (3, 2))
# The default moments, in seconds before the impact.
COUNTDOWN: Final = (2.0, 1.0, 0.5, 0.0)
_COLUMN_COUNTDOWN = (1.0, 0.0)
_PANEL_WIDTH_IN = 3.3
# Minimum width of a camera's panel in inches; agents are left out until panels are this wide.
_MIN_PANEL_WIDTH_IN = 1.6
# Height of the words above a row in inches, per point of letter size.
_ROW_WORDS_HEIGHT_IN = 0.03
# Minimum share of a small picture that panels should cover, as estimated from their width.
_MIN_COVERED_SHARE = 0.6
# Approximate height of titles, in inches, and of the two lines in a paper's column.
_TITLE_HEIGHT_IN = 1.0
_COLUMN_TITLE_HEIGHT_IN = 0.5
# The panels of a video's picture.
_MOSAIC: list[Any] = [[*AGENTS[:3]], ["above", *AGENTS[3:]], ["above", "speeds", "speeds"]]
_LINE_STYLES = ("-", "--")


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
    """Render the countdown to an accident, in the agents' cameras and from above.

    There is a column for each moment, a row for each agent, and a row for the view from above; in
    a wide figure, rows and columns are swapped. Each agent's panel shows the part of a downloaded
    image that shows the colliding pair best; without downloaded images, the panel is grey. If no
    camera shows the pair, the panel shows the last camera that did, otherwise the front camera.
    The pair's boxes are dashed where, by the agent's label, none of its cameras sees them.
    The view from above shows the point of contact (a cross), the pair's speeds, the pair's paths up
    to the contact, and a scale bar. `E` is the ego vehicle, `O` the other one.

    Args:
        dataset: The release.
        scenario: Token or record of a scenario with a collision.
        seconds: Moments to show, in seconds before the recording's last frame, which is close to
            the impact. Moments before the first frame are left out. None means `COUNTDOWN`; in a
            paper's column, it means the impact and one second before it.
        agents: Agents whose images the figure shows; an empty list shows none. None means all
            present agents. If their images would be narrower than 1.6 inches, as on a slide, it
            means the ego and the agents that see the pair best; the title then states their number.
        layers: Any of `image`, `bev` (the road), `boxes`, `trajectories`, `grid` (these are the
            default), `points` (of the LiDAR, in images), `ids` and `velocities`. Without `image`,
            no image file is read.
        fig: Empty figure to render on; a new one if None.

    Returns:
        The figure. Its title states which actor hits which, how fast and at which angle, and
        whether the recording ends before the pair is close enough to touch. In a paper's column,
        speeds, angle, actor ids and the number of agents are left to the caption.

    Raises:
        TokenError: No such scenario.
        NotAvailableError: The scenario has no collision (the closest approach of a normal scenario
            is no accident) or no meta, or an agent is not in this release.
        ChoiceError: No such agent, configuration or layer, or none of the moments was recorded.
    """
    shown_layers = layers_of(layers, _DEFAULT_LAYERS, PAIR_LAYERS)
    contact = contact_of(dataset, scenario, "show moments of this scenario with render_frame")
    record = dataset.get("scenario", scenario)
    frames = record["num_frames"]
    warning_words = cut_words(contact, frames)
    is_column = current_style().layout == "column"
    default_seconds: Sequence[float] = COUNTDOWN
    if is_column:
        default_seconds = _COLUMN_COUNTDOWN
    moments = recorded_moments(seconds or default_seconds, frames)
    names = agents_in_countdown(dataset, record, agents)
    size = (_PANEL_WIDTH_IN * len(moments) + 0.8, 1.95 * len(names) + _PANEL_WIDTH_IN + 1.1)
    fig = figure_or_new(fig, size, column=1.5)
    pair = CollidingPair.of(dataset, contact)
    selection_words = ""
    if agents is None:
        count = _fitting_agents(fig, len(names), len(moments))
        if count < len(names):
            if not is_column:
                selection_words = f"{count} of {len(names)} agents shown"
            names = _best_agents(pair, names, [frame for _, frame in moments], count)
    axes, is_wide = _panels(fig, len(names), len(moments))
    last_word = "the last frame" if warning_words or contact.touching else "the impact"
    for column, (time_left, frame) in enumerate(moments):
        for agent, ax in zip(names, axes[:, column], strict=False):
            words = draw_pair_in_camera(pair, agent, frame, shown_layers, ax)
            write_camera_name(words, ax)
        draw_pair_from_above(pair, frame, shown_layers, axes[-1, column])
        head = last_word if time_left == 0 else f"{time_left:g} s before"
        _write_head(head, "black", axes[0, column], above=not is_wide)
    for agent, ax in zip(names, axes[:, 0], strict=False):
        _write_head(short_name(agent), AGENT_COLORS[agent], ax, above=is_wide)
    head = "from above,\nspeeds in m/s" if current_style().shows_few_panels else "from above"
    _write_head(head, "black", axes[-1, 0], above=is_wide)
    contact_text = accident_words(dataset, contact)
    if is_column:
        contact_text = roles_and_sides(dataset, contact, with_ids=False)
    words = "\n".join(filter(None, [contact_text, warning_words]))
    set_scene_title(fig, dataset, record["token"], selection_words, below=words)
    return lay_out_figure(fig)


def agents_in_countdown(dataset: Dataset, record: Any, agents: Agents) -> list[str]:
    """Return the chosen agents of a scenario in drawing order; None means all present agents."""
    if agents == []:
        return []
    recorder = agents_of(dataset, record)[0]
    sample = sample_token(record["token"], recorder, record["num_frames"])
    return in_drawing_order(cooperating_agents(dataset, sample, agents))


def draw_countdown(
    dataset: Dataset,
    frame: str,
    *,
    agents: Sequence[str],
    layers: Collection[Layer] | None,
    fig: Figure,
) -> None:
    """Render a moment of an accident: five cameras, the contact from above, the pair's speeds.

    The figure must be empty, with an aspect ratio of about 16:9. Cameras are selected and layers
    named as in `render_accident`.

    Raises:
        NotAvailableError: The scenario has no collision.
    """
    shown_layers = layers_of(layers, _DEFAULT_LAYERS, PAIR_LAYERS)
    record = dataset.get("frame", frame)
    index = record["index"]
    contact = contact_of(dataset, record["scenario_token"], "the view 'frame'")
    pair = CollidingPair.of(dataset, contact)
    axes = fig.subplot_mosaic(_MOSAIC, height_ratios=(1, 1, 0.8))
    for agent in AGENTS:
        ax = axes[agent]
        if agent not in agents:
            ax.set_axis_off()
            continue
        words = draw_pair_in_camera(pair, agent, index, shown_layers, ax).replace("\n", " ")
        title = f"{short_name(agent)}: {words}"
        ax.set_title(title, fontsize="medium", color=AGENT_COLORS[agent])
    above_ax = axes["above"]
    draw_pair_from_above(pair, index, shown_layers, above_ax)
    above_ax.set_title(f"from above, {above_ax.get_title()}", fontsize="medium")
    _draw_speeds(pair, index, axes["speeds"])
    words = accident_words(dataset, contact).replace("\n", "; ")
    set_scene_title(fig, dataset, frame, below=words, fontsize=12)


def accident_words(dataset: Dataset, contact: Contact) -> str:
    """Describe a contact in lines: its actors and the sides that touch, then its speeds and angle.

    If the contact is not at the last frame, a third line gives its time.
    """
    hitting, hit = _hitting_and_hit(contact)
    speeds = f"{number_words(contact.speeds[hitting])} and {number_words(contact.speeds[hit])} m/s"
    closing_speed = f"closing at {number_words(contact.closing_speed)} m/s"
    angle = f"{np.degrees(contact.impact_angle):.0f}° between their headings"
    lines = [roles_and_sides(dataset, contact), f"{speeds}, {closing_speed}, {angle}"]
    if contact.touching != 0:
        lines.append(contact_words(contact.touching, contact.gap))
    return "\n".join(lines)


def _hitting_and_hit(contact: Contact) -> tuple[int, int]:
    """Return the indices of the actor that hits with its front, if only one does, and the other."""
    if contact.sides[1] == "front" and contact.sides[0] != "front":
        return 1, 0
    return 0, 1


def roles_and_sides(dataset: Dataset, contact: Contact, *, with_ids: bool = True) -> str:
    """Describe who hits whom, and the sides that touch; agents may be named without their ids."""
    scenario = contact.frame.rsplit("/", 1)[0]
    agents = recorders_of(dataset, scenario)
    names = []
    for instance, actor in zip(contact.instances, contact.actor_ids, strict=True):
        name = f"{dataset.instance.get(instance)['category']} {actor}"
        if actor in agents:
            role = short_name(agents[actor])
            name = f"{role} ({name})" if with_ids else role
        names.append(name)
    hitting, hit = _hitting_and_hit(contact)
    if contact.apart:
        verb = "and"
    elif contact.sides[hitting] == "front":
        verb = "hits"
    else:
        verb = "touches"
    return f"{names[hitting]} {verb} {names[hit]}, {contact.sides[hitting]} to {contact.sides[hit]}"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CollidingPair:
    """Two actors that collide in a scenario.

    Attributes:
        dataset: The release.
        scenario: Token of the scenario.
        contact: How they collide.
        tracks: Boxes of all actors of the scenario.
        tags: Short name of each of the two, by actor id.
    """

    dataset: Dataset
    scenario: str
    contact: Contact
    tracks: ScenarioTracks
    tags: dict[int, str]

    @classmethod
    def of(cls, dataset: Dataset, contact: Contact) -> CollidingPair:
        """Load the pair that collides in a contact."""
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
        """Return the pair's boxes in a frame (numbered from 1), in the world frame.

        An actor without a box in the frame is left out, and so is the agent named by `seen_by`.
        """
        boxes = self.tracks.at(index)
        own_actor = None
        if seen_by is not None:
            own_actor = self.dataset.agent.get(f"{self.scenario}/{seen_by}")["actor_id"]
        actors = [actor for actor in self.contact.actor_ids if actor != own_actor]
        return boxes.select(np.isin(boxes.actor_id, actors))

    def view(
        self, agent: str, index: int, channels: Sequence[str] = CAMERAS
    ) -> tuple[str, BestView | None, int | None]:
        """Select the camera of an agent that shows the pair best in a frame (numbered from 1).

        If any images are present, only their cameras count. If no image shows the pair, the camera
        that showed it last is selected; without one in the last `_CAMERA_MEMORY_FRAMES` frames, the
        first camera (the front one, if present) is.

        Returns:
            The channel of the camera; its view in this frame, or None if its image does not show
            the pair; and the last frame in which it showed the pair, or None.
        """
        sample = sample_token(self.scenario, agent, index)
        cameras: Sequence[str] = [
            channel for channel in channels if has_sensor_file(self.dataset, f"{sample}/{channel}")
        ]
        cameras = cameras or channels
        for frame in range(index, max(0, index - _CAMERA_MEMORY_FRAMES), -1):
            frame_sample = sample_token(self.scenario, agent, frame)
            boxes = self.at(frame, agent)
            view = best_view(self.dataset, [frame_sample], boxes, cameras)
            if view is not None:
                channel = view.camera.rsplit("/", 1)[1]
                if frame == index:
                    return channel, view, frame
                return channel, None, frame
        return cameras[0], None, None

    def camera_qualities(
        self, agents: Sequence[str], frames: Sequence[int]
    ) -> dict[tuple[str, str], float]:
        """Return how well images show the pair in some frames, by agent and channel.

        The number of actors that an image shows counts, then their area. Actors that an agent's
        cameras do not see do not count.
        """
        qualities: dict[tuple[str, str], float] = {}
        for agent, frame in product(agents, frames):
            boxes = self.at(frame, agent)
            is_visible = np.isin(boxes.actor_id, self.visible_ids(agent, frame))
            sample = sample_token(self.scenario, agent, frame)
            view = best_view(self.dataset, [sample], boxes.select(is_visible))
            if view is not None and has_sensor_file(self.dataset, view.camera):
                key = (agent, view.camera.rsplit("/", 1)[1])
                quality = round(view.total_share) + _AREA_WEIGHT * view.area
                qualities[key] = qualities.get(key, 0.0) + quality
        return qualities

    def visible_ids(self, agent: str, index: int) -> IntArray:
        """Return the label ids that the agent's cameras see in a frame (numbered from 1)."""
        sample = sample_token(self.scenario, agent, index)
        return self.dataset.boxes(sample, visible="camera").actor_id


def draw_pair_in_camera(
    pair: CollidingPair,
    agent: str,
    index: int,
    layers: Collection[Layer],
    ax: Axes,
    *,
    channels: Sequence[str] = CAMERAS,
) -> str:
    """Render the part of an agent's image that shows the pair, with tags.

    Frames are numbered from 1. The camera is one of `channels`. Boxes are dashed if no camera of
    the agent sees them. Returns the camera's short name and, if it does not see the pair in this
    frame, how long ago it did.
    """
    dataset = pair.dataset
    sample = sample_token(pair.scenario, agent, index)
    channel, view, seen_frame = pair.view(agent, index, channels)
    name = camera_name(channel)
    camera = dataset.get("sample_data", f"{sample}/{channel}")
    draw_camera(dataset, camera, {*layers}.intersection(CAMERA_LAYERS), ax)
    ax.set_title("")
    if view is None:
        if seen_frame is None:
            return name
        return f"{name}: last\nseen {(index - seen_frame) * FRAME_PERIOD:.1f} s ago"
    lens = camera_of(dataset, camera)
    left, top, right, bottom = crop_about(
        view.bounds, width=lens.width, height=lens.height, share=_MIN_CROP_SHARE
    )
    ax.set(xlim=(left, right), ylim=(bottom, top))
    if "boxes" not in layers:
        return name
    optical_from_world = dataset.world_from(sample, channel).inverse()
    boxes = pair.at(index, agent).transform(optical_from_world, channel)
    hidden_boxes = boxes.select(~np.isin(boxes.actor_id, pair.visible_ids(agent, index)))
    colors = [COLLIDER_COLOR] * len(hidden_boxes)
    draw_boxes_in_image(hidden_boxes, lens, ax, colors, linestyle=_HIDDEN_LINE_STYLE)
    bounds = bounds_in_image(boxes, lens).clip((left, top) * 2, (right, bottom) * 2)
    box_left, box_top, box_right, box_bottom = bounds.T
    is_shown = (box_right > box_left) & (box_bottom > box_top)
    tops = np.column_stack([(box_left + box_right) / 2, box_top])
    _write_tags(pair, boxes.select(is_shown), tops[is_shown], ax)
    return name


def draw_pair_from_above(
    pair: CollidingPair,
    index: int,
    layers: Collection[Layer],
    ax: Axes,
    *,
    ratio: float = 1.0,
    view_ranges: tuple[float, float] = _VIEW_RANGES_M,
    named_agents: Sequence[str] = (),
) -> None:
    """Render a frame (numbered from 1) around the point of contact, in the world frame.

    The view is as close-up as it can be with both actors and the named agents in it. The layers are
    `bev` (the road), `boxes`, `velocities`, `ids`, `trajectories` (up to the contact) and `grid`.
    The title gives the pair's speeds.

    Args:
        pair: The pair.
        index: Number of the frame.
        layers: Layers to draw.
        ax: Axes to draw on.
        ratio: Width over height of the view.
        view_ranges: Minimum and maximum number of metres shown above and below the point.
        named_agents: Agents to name instead of the pair; then the paths of all actors are drawn.
    """
    dataset = pair.dataset
    point = pair.contact.point[:2]
    first_agent = agents_of(dataset, pair.scenario)[0]
    sample: Any = dataset.get("sample", sample_token(pair.scenario, first_agent, index))
    boxes = pair.tracks.at(index)
    pair_boxes = pair.at(index)
    recorders = recorders_of(dataset, pair.scenario)
    named_actors = [actor for actor, agent in recorders.items() if agent in named_agents]
    shown_boxes = boxes.select(np.isin(boxes.actor_id, [*pair.contact.actor_ids, *named_actors]))
    distances = np.abs(shown_boxes.bottom_corners()[..., :2] - point) / (ratio, 1)
    view_range = float(np.clip(_PAIR_MARGIN_M + distances.max(initial=0.0), *view_ranges))
    low, high = point + np.outer((-view_range, view_range), (ratio, 1))
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    if "bev" in layers:
        draw_road(dataset, sample["frame_token"], [ax], target_from_world=SE3.identity())
    if "trajectories" in layers:
        trail_boxes = boxes if named_agents else pair_boxes
        draw_trails(
            dataset,
            sample,
            trail_boxes,
            role_colors(dataset, sample, trail_boxes),
            target_from_world=SE3.identity(),
            seconds=(_PAST_S, sample["time_to_impact"] or 0.0),
            ax=ax,
        )
    if named_agents:
        draw_agents(dataset, sample, "world", named_agents, ax)
    else:  # before the ids, which use the remaining space
        keep_free(ax, pair_boxes.bottom_corners()[..., :2])
        offsets = pair_boxes.center[:, :2] - point
        lengths = np.linalg.norm(offsets, axis=1, keepdims=True).clip(1e-9)
        ends = point + offsets * (1 + _TAG_OFFSET_M / lengths)
        _write_tags(pair, pair_boxes, ends, ax)
    draw_actors_from_above(boxes, ax, role_colors(dataset, sample, boxes), layers)
    ax.plot(*point, "x", color="black", markersize=_CROSS_SIZE_PT, markeredgewidth=1.8, zorder=5)
    half = _CROSS_SIZE_PT / 2
    keep_free(ax, [[point]], margin=(-half, -half, half, half))
    _draw_scale_bar(view_range, ax, grid="grid" in layers)
    set_title(ax, _speeds_title(pair, pair_boxes), fontsize=text_size(), y=None)


def _speeds_title(pair: CollidingPair, boxes: Boxes) -> str:
    """Return the pair's speeds as a title."""
    speeds = []
    for actor, velocity in zip(boxes.actor_id.tolist(), boxes.velocity, strict=True):
        speed = float(np.linalg.norm(velocity))
        speeds.append(f"{pair.tags[actor]} {number_words(speed)}")
    line = ", ".join(speeds)
    return line if current_style().shows_few_panels else f"{line} m/s"


def number_words(value: float) -> str:
    """Format a number with one decimal, or as `unknown` if it is not finite."""
    if np.isfinite(value):
        return f"{value:.1f}"
    return "unknown"


def _draw_scale_bar(view_range: float, ax: Axes, *, grid: bool) -> None:
    """Render a scale bar of 5 or 10 m, and a grid of that spacing, instead of axis labels."""
    from matplotlib.ticker import MultipleLocator

    metres = 5.0 if view_range < 1.25 * _VIEW_RANGES_M[0] else 10.0
    if grid:
        ax.grid(color=GRID_COLOR, linewidth=0.4)
        ax.set_axisbelow(True)
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_locator(MultipleLocator(metres))
    ax.tick_params(labelbottom=False, labelleft=False, length=0)
    left, low = (edge + 0.1 * view_range for edge in ax.viewLim.min)
    right = left + metres
    ax.plot([left, right], [low, low], color="black", linewidth=2)
    background = {"facecolor": CASING_COLOR, "edgecolor": "none", "alpha": 0.7, "pad": 0.5}
    ax.text(
        left,
        low + 0.06 * view_range,
        f"{metres:.0f} m",
        fontsize=text_size(),
        va="bottom",
        zorder=6,
        bbox=background,
    )
    keep_free(ax, [[(left, low), (right, low)]], margin=(-2, -2, 2, 2 * text_size()))


def _write_tags(pair: CollidingPair, boxes: Boxes, positions: FloatArray, ax: Axes) -> None:
    """Write a tag near the position (N, 2) of each box of the pair, but always within the panel."""
    low = np.array(ax.viewLim.min)
    high = np.array(ax.viewLim.max)
    edge = _EDGE_SHARE * (high - low)
    positions = positions.clip(low + edge, high - edge)
    tags = [pair.tags[actor] for actor in boxes.actor_id.tolist()]
    chips = zip(tags, positions, strict=True)
    place_chips(ax, chips, colors=[COLLIDER_COLOR] * len(tags))


def cut_words(contact: Contact, frames: int) -> str:
    """Return a warning if the recording does not end at the contact, otherwise an empty text."""
    contact_frame = int(contact.frame.rsplit("/", 1)[1])
    if contact_frame == frames and contact.gap <= CONTACT_GAP:
        return ""
    return (
        f"cut short? The pair is {contact.gap:.1f} m apart at frame {contact_frame} of {frames}, "
        "the last frame that shows both"
    )


def contact_of(dataset: Dataset, scenario: RowArgument, alternative: str) -> Contact:
    """Return how the two actors of a scenario collide.

    Raises:
        NotAvailableError: The scenario has no collision; the message suggests the alternative.
    """
    contact = collision(dataset, scenario)
    if contact is None:
        raise NotAvailableError(
            f"{dataset.get('scenario', scenario)['token']}: nobody collides in it, "
            "so there is nothing to count down to; "
            f"choose a scenario with a collision, or {alternative}"
        )
    return contact


def recorded_moments(seconds: Sequence[float], frames: int) -> list[tuple[float, int]]:
    """Return (seconds before the impact, frame number) of each requested moment on record."""
    recorded = []
    for time_left in seconds:
        frame = frames - round(time_left / FRAME_PERIOD)
        if 1 <= frame <= frames:
            recorded.append((time_left, frame))
    if not recorded:
        raise ChoiceError(
            f"seconds: expected values from 0 to {(frames - 1) * FRAME_PERIOD:.1f}, as recorded "
            f"before the impact, found {list(seconds)}"
        )
    return recorded


def _panel_width(fig: Figure, agents: int, moments: int) -> tuple[float, bool]:
    """Estimate a camera panel's width in inches; also return whether agents are the columns.

    Agents are columns instead of rows if that makes their panels wider.
    """
    width = fig.bbox.width / fig.dpi
    title_height = _TITLE_HEIGHT_IN
    if current_style().layout == "column":
        title_height = _COLUMN_TITLE_HEIGHT_IN
    height = fig.bbox.height / fig.dpi - title_height
    width_as_rows = min(width / moments, height / (agents * 9 / 16 + 1))
    row_height = height / moments - _ROW_WORDS_HEIGHT_IN * text_size()
    panel_height = min(row_height, width / (agents * 16 / 9 + 1))
    panel_ratio = 16 / 9 if agents else 1
    width_as_columns = panel_ratio * panel_height
    if width_as_columns > width_as_rows:
        return width_as_columns, True
    return width_as_rows, False


def _panels(fig: Figure, agents: int, moments: int) -> tuple[Any, bool]:
    """Make axes, shape (agents + 1, moments); also return whether agents are the columns."""
    _, is_wide = _panel_width(fig, agents, moments)
    if is_wide:
        ratios = (*[16 / 9] * agents, 1)
        return fig.subplots(moments, agents + 1, squeeze=False, width_ratios=ratios).T, True
    ratios = (*[9 / 16] * agents, 1)
    return fig.subplots(agents + 1, moments, squeeze=False, height_ratios=ratios), False


def _fitting_agents(fig: Figure, agents: int, moments: int) -> int:
    """Return how many agents fit, one at least, with panels that show what happens.

    In a style with few panels, they cover most of the figure.
    """
    min_area = 0.0
    if current_style().shows_few_panels:
        min_area = _MIN_COVERED_SHARE * fig.bbox.width * fig.bbox.height / fig.dpi**2
    for number in range(agents, 1, -1):
        width, is_wide = _panel_width(fig, number, moments)
        above_ratio = 81 / 256 if is_wide else 1
        area = moments * width**2 * (number * 9 / 16 + above_ratio)
        if width >= _MIN_PANEL_WIDTH_IN and area > min_area:
            return number
    return 1


def _best_agents(
    pair: CollidingPair, agents: Sequence[str], frames: Sequence[int], number: int
) -> list[str]:
    """Return the ego and the agents whose images show the pair best, `number` in all."""
    priorities = dict.fromkeys(agents, 0.0)
    for (agent, _), quality in pair.camera_qualities(agents, frames).items():
        priorities[agent] += quality
    ranked = sorted(agents, key=lambda agent: (agent != AGENTS[0], -priorities[agent]))
    return in_drawing_order(ranked[:number])


def _write_head(words: str, color: str, ax: Axes, *, above: bool) -> None:
    """Write the heading of a column above its first panel, or of a row to the left of it."""
    if above:
        lines = [line for line in (words, ax.get_title()) if line]
        ax.set_title("\n".join(lines), color=color, fontsize="medium")
        return
    ax.text(
        -0.02,
        0.5,
        words,
        color=color,
        transform=ax.transAxes,
        rotation=90,
        ha="right",
        va="center",
        fontweight="bold",
    )


def write_camera_name(words: str, ax: Axes) -> None:
    """Write a camera's name in the lower left corner of its panel, on top of the image."""
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
    """Render the pair's speeds over the seconds before the impact."""
    tracks = pair.tracks
    impact = int(tracks.index.max())
    now = (index - impact) * FRAME_PERIOD
    for actor, line_style in zip(pair.contact.actor_ids, _LINE_STYLES, strict=True):
        rows = np.flatnonzero(tracks.actor_id == actor)
        seconds = (tracks.index[rows] - impact) * FRAME_PERIOD
        speed = np.sqrt(np.square(tracks.boxes.velocity[rows]).sum(axis=1))
        style: dict[str, Any] = {"color": COLLIDER_COLOR, "linestyle": line_style}
        draw_until(ax, seconds, speed, now, pair.tags[actor], **style)
    ax.set(ylabel="speed (m/s)", xlim=(-(impact - 1) * FRAME_PERIOD, 0.1), ylim=(0, None))
    finish_time_axis(ax, now, "impact")
    ax.legend(loc="lower left", fontsize=text_size(), ncols=2, framealpha=0.7)


def draw_until(
    ax: Axes, seconds: AnyArray, values: AnyArray, now: float, label: str, **style: Any
) -> None:
    """Draw values over seconds, shape (N,) each, strong up to the present and pale after it."""
    ax.plot(seconds, values, linewidth=1.2, alpha=0.25, **style)
    is_past = seconds < now + FRAME_PERIOD / 2
    ax.plot(seconds[is_past], values[is_past], linewidth=2.0, label=label, **style)


def finish_time_axis(ax: Axes, now: float, event: str) -> None:
    """Mark the present and an event, from which the axis counts the seconds."""
    ax.axvline(now, color="black", linewidth=1.2)
    ax.axvline(0, color=COLLIDER_COLOR, linewidth=1.2, linestyle=":")
    ax.set_xlabel(f"time relative to the {event} (s)", fontsize=text_size())
    with_light_grid(ax, "both")
