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
from deepaccident_devkit.render.captions import has_sensor_file, set_scene_title
from deepaccident_devkit.render.chips import keep_free, place_chips
from deepaccident_devkit.render.figures import (
    Layer,
    figure_or_new,
    layers_of,
    settled,
    show_square,
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
_DEFAULT_LAYERS: Final[tuple[Layer, ...]] = ("image", "bev", "boxes", "trajectories", "grid")
# Frames for which the last camera that saw the pair stays selected.
_CAMERA_MEMORY_FRAMES: Final = 10
# Metres shown around the point of contact.
_MIN_VIEW_RANGE_M, _MAX_VIEW_RANGE_M = 9.0, 24.0
# Metres around the pair.
_PAIR_MARGIN_M: Final = 2.5
# Seconds of the paths that led to the contact.
_PAST_S: Final = 3.0
# Least share of an image's width: the viewer must still recognise the surroundings.
_MIN_CROP_SHARE: Final = 0.4
# Points: size of the cross at the point of contact.
_CROSS_SIZE_PT: Final = 9.0
# Share of a panel's width and height between the positions of tags and its edges.
_EDGE_SHARE: Final = 0.01
# Points at the top of an image, about, in which tags may cover a car: it may fill the image.
_TAG_HEIGHT_PT: Final = 22.0
_HIDDEN_LINE_STYLE: Final = (0, (3, 2))
# Seconds before the impact.
COUNTDOWN: Final = (2.0, 1.0, 0.5, 0.0)
_COLUMN_COUNTDOWN: Final = (1.0, 0.0)
_PANEL_WIDTH_IN: Final = 3.3
# Inches of a camera's panel below which agents are left out.
_MIN_PANEL_WIDTH_IN: Final = 1.6
# Letters of a line that fits above a panel of a small picture.
_MAX_TITLE_LETTERS: Final = 16
# Inches of words above a row, for letters of one point.
_ROW_WORDS_HEIGHT_IN: Final = 0.03
# Share of a small picture that panels should cover, by the estimate of `_panel_width`.
_MIN_COVERED_SHARE: Final = 0.6
# Inches of the height that titles take, about.
_TITLE_HEIGHT_IN: Final = 1.0
# The panels of a video's picture.
_MOSAIC: Final[list[Any]] = [[*AGENTS[:3]], ["above", *AGENTS[3:]], ["above", "speeds", "speeds"]]
_LINE_STYLES: Final = ("-", "--")


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

    There is a column for each moment, a row for each agent, and one from above; in a wide figure
    rows are columns. Each agent has the part of an image that shows the colliding pair best, of its
    downloaded images; without any, a grey panel. If no camera shows the pair, it is the last one
    that did, or the front one. The pair's boxes are dashed where the agent's label states that no
    camera sees them. The view from above has the point of contact (a cross), the pair's speeds, and
    the pair's paths up to the contact; its bar shows the scale. `E` is the ego vehicle, `O` the
    other one.

    Args:
        dataset: The release.
        scenario: Token or record of a scenario with a collision.
        seconds: Seconds before the recording's last frame, which the impact is near; moments before
            the first frame are left out. None stands for `COUNTDOWN`, or in a paper's column for
            one second before the impact and the impact.
        agents: Agents with images in the figure; an empty list for none. None stands for all
            present agents or, where their images would be narrower than 1.6 inches, as on a slide,
            for the ego and the agents that see the pair best; the title then states their number.
        layers: `image`, `bev` (the road), `boxes`, `trajectories` and `grid` are the default; also
            `points` (of the LiDAR, in images), `ids` and `velocities`. Without `image` no image
            file is read.
        fig: Empty figure to render on; a new one if None.

    Returns:
        The figure; its title states which actor hits which, how fast and at which angle, and
        whether the recording ends before the pair are near enough to touch.

    Raises:
        TokenError: No such scenario.
        NotAvailableError: Nobody collides in it (the nearest approach of a normal scenario is no
            accident), it has no meta, or an agent is not in this release.
        ChoiceError: No such agent, configuration or layer, or none of the moments was recorded.
    """
    shown_layers = layers_of(layers, _DEFAULT_LAYERS, PAIR_LAYERS)
    contact = _contact(dataset, scenario, "look at moments of this one with render_frame")
    record = dataset.get("scenario", scenario)
    frames = record["num_frames"]
    cut_words = _cut_words(contact, frames)
    default_seconds: Sequence[float] = COUNTDOWN
    if current_style().room == "column":
        default_seconds = _COLUMN_COUNTDOWN
    moments = _moments(seconds or default_seconds, frames)
    names = _agent_names(dataset, record, agents)
    size = (_PANEL_WIDTH_IN * len(moments) + 0.8, 1.95 * len(names) + _PANEL_WIDTH_IN + 1.1)
    fig = figure_or_new(fig, size, column=1.45)
    pair, selection_words = CollidingPair.of(dataset, contact), ""
    if agents is None:
        count = _fitting_agents(fig, len(names), len(moments))
        if count < len(names):
            selection_words = f"{count} of {len(names)} agents"
            names = _best_agents(pair, names, [frame for _, frame in moments], count)
    axes, is_wide = _panels(fig, len(names), len(moments))
    last_word = "the last frame" if cut_words or contact.touching else "the impact"
    for column, (time_left, frame) in enumerate(moments):
        for agent, ax in zip(names, axes[:, column], strict=False):
            words = draw_pair_in_camera(pair, agent, frame, shown_layers, ax)
            _write_name(words, ax)
        draw_pair_from_above(pair, frame, shown_layers, axes[-1, column])
        head = last_word if time_left == 0 else f"{time_left:g} s before"
        _write_head(head, "black", axes[0, column], above=not is_wide)
    for agent, ax in zip(names, axes[:, 0], strict=False):
        _write_head(short_name(agent), AGENT_COLORS[agent], ax, above=is_wide)
    head = "from above,\nspeeds in m/s" if current_style().few else "from above"
    _write_head(head, "black", axes[-1, 0], above=is_wide)
    lines = [accident_words(dataset, contact), cut_words]
    words = "\n".join(line for line in lines if line)
    set_scene_title(fig, dataset, record["token"], selection_words, below=words)
    return settled(fig)


def _agent_names(dataset: Dataset, record: Any, agents: Agents) -> list[str]:
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

    The figure is an empty one of about 16 to 9. Cameras are selected and layers named as in
    `render_accident`.

    Raises:
        NotAvailableError: Nobody collides.
    """
    shown_layers = layers_of(layers, _DEFAULT_LAYERS, PAIR_LAYERS)
    record = dataset.get("frame", frame)
    index = record["index"]
    contact = _contact(dataset, record["scenario_token"], "the view 'frame'")
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
    """Return two lines on a contact: its actors and sides, and its speeds and angle.

    The time follows if the contact is not at the last frame.
    """
    scenario = contact.frame.rsplit("/", 1)[0]
    agent_names = {}
    for agent in agents_of(dataset, scenario):
        actor = dataset.agent.get(f"{scenario}/{agent}")["actor_id"]
        agent_names[actor] = short_name(agent)
    names = []
    for instance, actor in zip(contact.instances, contact.actor_ids, strict=True):
        name = f"{dataset.instance.get(instance)['category']} {actor}"
        if actor in agent_names:
            name = f"{agent_names[actor]} ({name})"
        names.append(name)
    hitting, hit = 0, 1
    if contact.sides[1] == "front" and contact.sides[0] != "front":
        hitting, hit = 1, 0
    if contact.apart:
        verb = "and"
    elif contact.sides[hitting] == "front":
        verb = "hits"
    else:
        verb = "touches"
    speeds = f"{number_words(contact.speeds[hitting])} and {number_words(contact.speeds[hit])} m/s"
    closing_speed = f"closing at {number_words(contact.closing_speed)} m/s"
    angle = f"{np.degrees(contact.impact_angle):.0f}° between their headings"
    lines = [
        f"{names[hitting]} {verb} {names[hit]}, {contact.sides[hitting]} to {contact.sides[hit]}",
        f"{speeds}, {closing_speed}, {angle}",
    ]
    if contact.touching != 0:
        lines.append(contact_words(contact.touching, contact.gap))
    return "\n".join(lines)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CollidingPair:
    """Two actors that collide in a scenario.

    Attributes:
        dataset: The release.
        scenario: Token.
        contact: How they collide.
        tracks: Boxes of all actors of the scenario.
        tags: Actor id → short name of the two.
    """

    dataset: Dataset
    scenario: str
    contact: Contact
    tracks: ScenarioTracks
    tags: dict[int, str]

    @classmethod
    def of(cls, dataset: Dataset, contact: Contact) -> CollidingPair:
        """Return the pair of a contact."""
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
        """Return the pair's existing boxes in world in a frame (number from 1).

        The agent that sees them is left out.
        """
        boxes = self.tracks.at(index)
        own_actor = None
        if seen_by is not None:
            own_actor = self.dataset.agent.get(f"{self.scenario}/{seen_by}")["actor_id"]
        actors = [actor for actor in self.contact.actor_ids if actor != own_actor]
        return boxes.select(np.isin(boxes.actor_id, actors))

    def view(self, agent: str, index: int) -> tuple[str, BestView | None, int | None]:
        """Return the camera of an agent that shows the pair best in a frame, and its view.

        The third value is the last frame in which it had the pair. Cameras with present images come
        first. If none has the pair in its image, it is the last one that had, and otherwise the
        front camera; then there is no view.
        """
        sample = sample_token(self.scenario, agent, index)
        cameras: Sequence[str] = [
            channel for channel in CAMERAS if has_sensor_file(self.dataset, f"{sample}/{channel}")
        ]
        cameras = cameras or CAMERAS
        for frame in range(index, max(0, index - _CAMERA_MEMORY_FRAMES), -1):
            frame_sample = sample_token(self.scenario, agent, frame)
            view = best_view(self.dataset, [frame_sample], self.at(frame, agent), cameras)
            if view is not None:
                channel = view.camera.rsplit("/", 1)[1]
                return channel, view if frame == index else None, frame
        return cameras[0], None, None


def draw_pair_in_camera(
    pair: CollidingPair, agent: str, index: int, layers: Collection[Layer], ax: Axes
) -> str:
    """Render the part of an agent's image with the pair, and tags, in a frame (number from 1).

    Boxes are dashed if no camera of the agent sees them. Returns the camera's short name, and how
    long ago it saw the pair if it does not see it now.
    """
    dataset, sample = pair.dataset, sample_token(pair.scenario, agent, index)
    channel, view, seen_frame = pair.view(agent, index)
    name = camera_name(channel)
    camera = dataset.get("sample_data", f"{sample}/{channel}")
    draw_camera(dataset, camera, {*layers}.intersection(CAMERA_LAYERS), ax)
    ax.set_title("")
    if view is None:
        if seen_frame is None:
            return name
        return f"{name}:\nseen {(index - seen_frame) * FRAME_PERIOD:.1f} s ago"
    lens = camera_of(dataset, camera)
    left, top, right, bottom = crop_about(
        view.bounds, width=lens.width, height=lens.height, share=_MIN_CROP_SHARE
    )
    ax.set(xlim=(left, right), ylim=(bottom, top))
    if "boxes" not in layers:
        return name
    optical_from_world = dataset.world_from(sample, channel).inverse()
    boxes = pair.at(index, agent).transform(optical_from_world, channel)
    visible_ids = dataset.boxes(sample, visible="camera").actor_id
    hidden = boxes.select(~np.isin(boxes.actor_id, visible_ids))
    colors = [COLLIDER_COLOR] * len(hidden)
    draw_boxes_in_image(hidden, lens, ax, colors, linestyle=_HIDDEN_LINE_STYLE)
    _write_tags_in_image(pair, boxes.actor_id.tolist(), bounds_in_image(boxes, lens), ax)
    return name


def draw_pair_from_above(
    pair: CollidingPair, index: int, layers: Collection[Layer], ax: Axes
) -> None:
    """Render a frame (number from 1) around the point of contact, in world.

    The view is as close as the pair allows. The layers are `bev` (the road), `boxes`, `velocities`,
    `ids`, `trajectories` (of the pair, up to the contact) and `grid`; the title is the pair's
    speeds.
    """
    dataset, point = pair.dataset, pair.contact.point[:2]
    token = sample_token(pair.scenario, agents_of(dataset, pair.scenario)[0], index)
    sample = dataset.get("sample", token)
    boxes, pair_boxes = pair.tracks.at(index), pair.at(index)
    distances = np.abs(pair_boxes.bottom_corners()[..., :2] - point)
    view_range = _PAIR_MARGIN_M + float(distances.max(initial=0.0))
    view_range = min(max(view_range, _MIN_VIEW_RANGE_M), _MAX_VIEW_RANGE_M)
    x, y = point.tolist()
    show_square(ax, (x, y), view_range)
    if "bev" in layers:
        _draw_road(pair, index, view_range, ax)
    if "trajectories" in layers:
        draw_trails(
            dataset,
            sample,
            pair_boxes,
            [COLLIDER_COLOR] * len(pair_boxes),
            target_from_world=SE3.identity(),
            seconds=(_PAST_S, sample["time_to_impact"] or 0.0),
            ax=ax,
        )
    _write_tags_from_above(pair, pair_boxes, ax)  # before the ids, which use the remaining space
    draw_actors_from_above(boxes, ax, role_colors(dataset, sample, boxes), layers)
    ax.plot(x, y, "x", color="black", markersize=_CROSS_SIZE_PT, markeredgewidth=1.8, zorder=5)
    half = _CROSS_SIZE_PT / 2
    keep_free(ax, [[point]], margin=(-half, -half, half, half))
    _draw_scale(view_range, ax, grid="grid" in layers)
    ax.set_title(_speeds_title(pair, pair_boxes), fontsize=text_size())


def _speeds_title(pair: CollidingPair, boxes: Boxes) -> str:
    speeds = []
    for actor, velocity in zip(boxes.actor_id.tolist(), boxes.velocity, strict=True):
        speed = float(np.linalg.norm(velocity))
        speeds.append(f"{pair.tags[actor]} {number_words(speed)}")
    line = ", ".join(speeds)
    if not current_style().few:
        return f"{line} m/s"
    if len(line) > _MAX_TITLE_LETTERS:
        return "\n".join(speeds)
    return line


def number_words(value: float) -> str:
    """Return a number with one digit, or `unknown`."""
    if np.isfinite(value):
        return f"{value:.1f}"
    return "unknown"


def _draw_road(pair: CollidingPair, index: int, view_range: float, ax: Axes) -> None:
    """Render the ground from the BEV camera nearest to the contact, if a file is present."""
    dataset, point = pair.dataset, pair.contact.point[:2]
    samples, poses, distances = [], [], []
    for agent in agents_of(dataset, pair.scenario):
        sample = sample_token(pair.scenario, agent, index)
        if has_sensor_file(dataset, f"{sample}/{BEV_CAMERA}"):
            pose = dataset.world_from(sample, "ego")
            samples.append(sample)
            poses.append(pose)
            distances.append(float(np.abs(pose.translation[:2] - point).max()))
    if samples:
        nearest = int(np.argmin(distances))
        draw_underlay(
            dataset.load_bev(samples[nearest]),
            ax,
            target_from_ego=poses[nearest],
            view_range=view_range + distances[nearest],
        )


def _draw_scale(view_range: float, ax: Axes, *, grid: bool) -> None:
    """Render a bar of 5 or 10 m, and cells of that size, instead of numbers at the axes."""
    from matplotlib.ticker import MultipleLocator

    metres = 10.0
    if view_range < 1.25 * _MIN_VIEW_RANGE_M:
        metres = 5.0
    if grid:
        ax.grid(color=GRID_COLOR, linewidth=0.4)
        ax.set_axisbelow(True)
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_locator(MultipleLocator(metres))
    ax.tick_params(labelbottom=False, labelleft=False, length=0)
    start, low = (edge + 0.1 * view_range for edge in ax.viewLim.min)
    ax.plot([start, start + metres], [low, low], color="black", linewidth=2)
    background = {"facecolor": CASING_COLOR, "edgecolor": "none", "alpha": 0.7, "pad": 0.5}
    ax.text(
        start,
        low + 0.06 * view_range,
        f"{metres:.0f} m",
        fontsize=text_size(),
        va="bottom",
        zorder=6,
        bbox=background,
    )
    keep_free(ax, [[(start, low), (start + metres, low)]], margin=(-2, -2, 2, 2 * text_size()))


def _write_tags_in_image(
    pair: CollidingPair, actors: list[int], bounds: FloatArray, ax: Axes
) -> None:
    """Write tags above the visible parts of boxes with bounds (N, 4), pixels.

    The tags of two boxes are at their outer sides.
    """
    (left, right), (bottom, top) = ax.get_xlim(), ax.get_ylim()
    cars = bounds.reshape(-1, 2, 2).clip((left, top), (right, bottom))
    visible = np.flatnonzero((cars[:, 1] > cars[:, 0]).all(axis=1))
    from_left = np.argsort(cars[visible, :, 0].mean(axis=1))
    rows = visible[from_left]
    cars = cars[rows]
    positions = np.column_stack([cars[..., 0].mean(axis=1), cars[:, 0, 1]])
    if len(cars) > 1:
        positions[:, 0] = cars[0, 0, 0], cars[1, 1, 0]
    tag_share = min(0.5, _TAG_HEIGHT_PT * ax.figure.dpi / 72 / ax.bbox.height)
    tag_bottom = top + (bottom - top) * tag_share
    positions[positions[:, 1] < tag_bottom, 1] = top
    cars[..., 1] = cars[..., 1].clip(tag_bottom)
    _write_tags([pair.tags[actors[row]] for row in rows.tolist()], positions, ax)
    keep_free(ax, cars)


def _write_tags_from_above(pair: CollidingPair, boxes: Boxes, ax: Axes) -> None:
    """Write tags beside boxes of the pair, each at the end farther from the other actor."""
    centers = boxes.center[:, :2]
    middle = pair.contact.point[:2]
    if len(boxes) > 1:
        middle = centers.mean(axis=0)
    directions = centers - middle
    directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-9)
    ends = boxes.bottom_corners()[..., :2] - boxes.center[:, None, :2]
    lengths = (ends @ directions[..., None]).max(axis=1)
    positions = centers + directions * lengths
    _write_tags([pair.tags[actor] for actor in boxes.actor_id.tolist()], positions, ax)


def _write_tags(tags: list[str], positions: FloatArray, ax: Axes) -> None:
    """Write tags near positions (N, 2) or, if these are not in the panel, at its edge."""
    low, high = np.array(ax.viewLim.min), np.array(ax.viewLim.max)
    edge = _EDGE_SHARE * (high - low)
    positions = positions.clip(low + edge, high - edge)
    place_chips(ax, zip(tags, positions, strict=True), colors=[COLLIDER_COLOR] * len(tags))


def _cut_words(contact: Contact, frames: int) -> str:
    """Return a warning if a recording does not end with its accident; empty if it does."""
    contact_frame = int(contact.frame.rsplit("/", 1)[1])
    if contact_frame == frames and contact.gap <= CONTACT_GAP:
        return ""
    return (
        f"cut short? the pair are {contact.gap:.1f} m apart at frame {contact_frame} of {frames}, "
        "the last that shows both"
    )


def _contact(dataset: Dataset, scenario: RowArgument, alternative: str) -> Contact:
    """Return how the accident of a scenario happened.

    Raises:
        NotAvailableError: Nobody collides; the message has the alternative as a remedy.
    """
    contact = collision(dataset, scenario)
    if contact is None:
        raise NotAvailableError(
            f"{dataset.get('scenario', scenario)['token']}: nobody collides in it, "
            "so there is nothing to count down to; "
            f"choose a scenario with a collision, or {alternative}"
        )
    return contact


def _moments(seconds: Sequence[float], frames: int) -> list[tuple[float, int]]:
    """Return the recorded moments as seconds before the impact and frame numbers."""
    recorded = []
    for time_left in seconds:
        frame = frames - round(time_left / FRAME_PERIOD)
        if 1 <= frame <= frames:
            recorded.append((time_left, frame))
    if not recorded:
        raise ChoiceError(
            f"seconds: expected some from 0 to {(frames - 1) * FRAME_PERIOD:.1f}, "
            f"as recorded before the impact, found {list(seconds)}"
        )
    return recorded


def _panel_width(fig: Figure, agents: int, moments: int) -> tuple[float, bool]:
    """Return the width of a panel of the first row or column, about, in inches.

    The second value is whether rows are columns because it is then wider.
    """
    width = fig.bbox.width / fig.dpi
    height = fig.bbox.height / fig.dpi - _TITLE_HEIGHT_IN
    row_height = height / moments - _ROW_WORDS_HEIGHT_IN * text_size()
    width_as_rows = min(width / moments, height / (agents * 9 / 16 + 1))
    panel_ratio = 16 / 9 if agents else 1
    width_as_columns = panel_ratio * min(row_height, width / (agents * 16 / 9 + 1))
    return max(width_as_rows, width_as_columns), width_as_columns > width_as_rows


def _panels(fig: Figure, agents: int, moments: int) -> tuple[Any, bool]:
    """Return axes (agents + 1, moments), and whether rows are columns."""
    _, is_wide = _panel_width(fig, agents, moments)
    if is_wide:
        ratios = (*[16 / 9] * agents, 1)
        return fig.subplots(moments, agents + 1, squeeze=False, width_ratios=ratios).T, True
    ratios = (*[9 / 16] * agents, 1)
    return fig.subplots(agents + 1, moments, squeeze=False, height_ratios=ratios), False


def _fitting_agents(fig: Figure, agents: int, moments: int) -> int:
    """Return how many agents can have panels large enough to recognise what happens.

    If no number can, it is the one with the largest panels.
    """
    panels = {number: _panel_width(fig, number, moments) for number in range(1, agents + 1)}
    widest = max(width for width, _ in panels.values())
    min_width = min(_MIN_PANEL_WIDTH_IN, 0.9 * widest)
    areas = {}
    for number, (width, is_wide) in panels.items():
        if width >= min_width:
            above_ratio = 81 / 256 if is_wide else 1
            areas[number] = moments * width**2 * (number * 9 / 16 + above_ratio)
    min_area = 0.0
    if current_style().few:
        min_area = _MIN_COVERED_SHARE * fig.bbox.width * fig.bbox.height / fig.dpi**2
    sufficient = [number for number, area in areas.items() if area > min_area]
    return max(sufficient, default=max(areas, key=areas.__getitem__))


def _best_agents(
    pair: CollidingPair, agents: Sequence[str], frames: Sequence[int], number: int
) -> list[str]:
    """Return the ego and the agents that see most of the pair in their images.

    Of equal agents the one with the largest part of the pair in its images comes first.
    """
    priorities = {}
    for agent in agents:
        views = [pair.view(agent, frame)[1] for frame in frames]
        shares = [(view.total_share, view.area) for view in views if view is not None]
        total = np.sum([(0, 0), *shares], axis=0).tolist()
        priorities[agent] = (agent == AGENTS[0], total)
    ranked = sorted(agents, key=priorities.__getitem__, reverse=True)
    return in_drawing_order(ranked[:number])


def _write_head(words: str, color: str, ax: Axes, *, above: bool) -> None:
    """Write the head of a column above its first panel, or the head of a row beside it."""
    if above:
        lines = [line for line in (words, ax.get_title()) if line]
        ax.set_title("\n".join(lines), color=color, fontsize="medium")
        return
    style: dict[str, Any] = {"rotation": 90, "ha": "right", "va": "center", "fontweight": "bold"}
    ax.text(-0.02, 0.5, words, color=color, transform=ax.transAxes, **style)


def _write_name(words: str, ax: Axes) -> None:
    """Write a camera's name into the lower left corner of its panel, over any content."""
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
    """Render the pair's speeds over the seconds before the impact.

    Lines are strong up to the present and pale after it.
    """
    tracks = pair.tracks
    impact = int(tracks.index.max())
    for actor, line_style in zip(pair.contact.actor_ids, _LINE_STYLES, strict=True):
        rows = np.flatnonzero(tracks.actor_id == actor)
        seconds = (tracks.index[rows] - impact) * FRAME_PERIOD
        speed = np.linalg.norm(tracks.boxes.velocity[rows], axis=1)
        past = tracks.index[rows] <= index
        style: dict[str, Any] = {"color": COLLIDER_COLOR, "linestyle": line_style}
        ax.plot(seconds, speed, linewidth=1.2, alpha=0.25, **style)
        ax.plot(seconds[past], speed[past], linewidth=2.0, label=pair.tags[actor], **style)
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
