"""One wide figure of an accident, as on the first page of a paper."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.render.accident import (
    PAIR_LAYERS,
    CollidingPair,
    agents_in_countdown,
    contact_of,
    cut_words,
    draw_pair_from_above,
    draw_pair_in_camera,
    recorded_moments,
    roles_and_sides,
    write_camera_name,
)
from deepaccident_devkit.render.captions import (
    has_sensor_file,
    moment_words,
    set_scene_title,
    set_title,
)
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
    current_style,
    in_own_settings,
    text_size,
)
from deepaccident_devkit.tables.tokens import sample_token
from deepaccident_devkit.taxonomy import (
    FRAME_PERIOD,
    INFRASTRUCTURE,
    short_name,
)
from deepaccident_devkit.v2x import Agents
from deepaccident_devkit.v2x.cooperation import visible_actors

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TEASER_SECONDS: Final = (2.0, 1.0, 0.0)
_DEFAULT_LAYERS: Layers = ("image", "bev", "boxes", "trajectories")
# Width over height of the panels, as of most cameras.
_PANEL_RATIO = 16 / 9
# Width of the figure in a notebook, height of the title, and of the words above each row, inches.
_WIDTH_IN = 13.0
_TITLE_HEIGHT_IN = 0.85
_ROW_WORDS_HEIGHT_IN = 0.3
# Additional height of the words in a paper's column, over its width.
_COLUMN_WORDS_SHARE = 0.3
# Minimum and maximum number of metres that the map shows above and below the point of contact.
_VIEW_RANGES_M = (26.0, 40.0)
_EDGE_WIDTH_PT = 2.0


@in_own_settings
def render_teaser(
    dataset: Dataset,
    scenario: RowArgument,
    *,
    seconds: Sequence[float] | None = None,
    agents: Agents = None,
    layers: Iterable[Layer] | None = None,
    fig: Figure | None = None,
) -> Figure:
    """Render an accident as one wide figure for the first page of a paper.

    It shows three moments of the camera that shows the pair best, the infrastructure's view, a map
    with the paths of all actors, and since when each agent has seen the pair. Panels without an
    image file are left out, and the remaining panels fill the figure.

    Args:
        dataset: The release.
        scenario: Token or record of a scenario with a collision.
        seconds: Moments of the camera, in seconds before the recording's last frame; moments before
            the first frame are left out. None means `TEASER_SECONDS`.
        agents: Agents whose cameras, places and sight the figure shows. None means all present
            agents.
        layers: Any of `image`, `bev` (the road), `boxes`, `trajectories` (these are the default),
            `points` (in images), `ids`, `velocities` and `grid`.
        fig: Empty figure to render on; a new one if None.

    Returns:
        The figure.

    Raises:
        TokenError: No such scenario.
        NotAvailableError: The scenario has no collision or no meta, or an agent is not in this
            release.
        ChoiceError: No such agent, configuration or layer, or none of the moments was recorded.
    """
    shown_layers = layers_of(layers, _DEFAULT_LAYERS, PAIR_LAYERS)
    contact = contact_of(dataset, scenario, "show a moment of this scenario with render_frame")
    record = dataset.get("scenario", scenario)
    moments = recorded_moments(seconds or TEASER_SECONDS, record["num_frames"])
    frames = [frame for _, frame in moments]
    names = agents_in_countdown(dataset, record, agents)
    pair = CollidingPair.of(dataset, contact)
    images = _images(pair, names, frames)
    row_count = -(-(len(images) + 2) // 3)
    lengths = [len(part) for part in np.array_split(range(len(images) + 2), row_count)]
    if current_style().layout == "column":
        lengths = [2] * (len(images) // 2) + [1] * (len(images) % 2 + 2)
    heights = [_WIDTH_IN / max(length, 1.5) / _PANEL_RATIO for length in lengths]
    height = _TITLE_HEIGHT_IN + _ROW_WORDS_HEIGHT_IN * len(heights) + sum(heights)
    column_ratio = height / _WIDTH_IN + _COLUMN_WORDS_SHARE
    figure = figure_or_new(fig, (_WIDTH_IN, height), column=column_ratio)
    grid = figure.add_gridspec(len(lengths), 1, height_ratios=heights)
    axes: list[Axes] = []
    for row, length in enumerate(lengths):
        axes += grid[row].subgridspec(1, length).subplots(squeeze=False)[0].tolist()
    for camera, ax in zip(images, axes, strict=False):
        _draw_image(pair, camera, shown_layers, ax)
    ratio = _PANEL_RATIO * 1.5 if lengths[-1] == 1 else _PANEL_RATIO
    draw_pair_from_above(
        pair,
        min(frames),
        shown_layers,
        axes[-2],
        ratio=ratio,
        view_ranges=_VIEW_RANGES_M,
        named_agents=names,
    )
    moment = moment_words(dataset, f"{pair.scenario}/{min(frames):03d}")
    set_title(axes[-2], f"paths, {moment}", fontsize="medium")
    axes[-2].set_anchor("N")  # level with the panels beside it
    _draw_sight(pair, names, axes[-1])
    words = roles_and_sides(dataset, contact, with_ids=not current_style().shows_few_panels)
    warning_words = cut_words(contact, record["num_frames"])
    set_scene_title(figure, dataset, record["token"], warning_words, below=words)
    return lay_out_figure(figure)


def _images(pair: CollidingPair, names: Sequence[str], frames: Sequence[int]) -> list[str]:
    """Return the tokens of the best camera's images, and of the infrastructure's last image.

    If no other agent has images, there are several of the infrastructure.
    """
    vehicles = [name for name in names if name != INFRASTRUCTURE]
    poles = [name for name in names if name == INFRASTRUCTURE]
    images: list[str] = []
    for agents in (vehicles, poles):
        qualities = pair.camera_qualities(agents, frames)
        shown_frames = frames[-1:] if images else frames
        if qualities:
            agent, channel = max(qualities, key=qualities.__getitem__)
            samples = [sample_token(pair.scenario, agent, frame) for frame in shown_frames]
            images += [f"{sample}/{channel}" for sample in samples]
    return [image for image in images if has_sensor_file(pair.dataset, image)]


def _draw_image(pair: CollidingPair, camera: str, layers: frozenset[Layer], ax: Axes) -> None:
    """Draw an image (a token) with an edge in the hue of its agent."""
    scenario, agent, frame, channel = camera.rsplit("/", 3)
    words = draw_pair_in_camera(pair, agent, int(frame), layers, ax, channels=[channel])
    write_camera_name(f"{short_name(agent)}, {words}", ax)
    set_title(ax, moment_words(pair.dataset, f"{scenario}/{frame}"), fontsize="medium")
    for spine in ax.spines.values():
        spine.set(visible=True, edgecolor=AGENT_COLORS[agent], linewidth=_EDGE_WIDTH_PT)


def _draw_sight(pair: CollidingPair, names: Sequence[str], ax: Axes) -> None:
    """Draw one bar for each agent, from the top down: when it sees the pair.

    A bar is solid while the agent sees both (if it is one of them, the other one), and pale while
    it sees one of two.
    """
    last = int(pair.contact.frame.rsplit("/", 1)[1])
    spans = [((frame - last - 0.5) * FRAME_PERIOD, FRAME_PERIOD) for frame in range(1, last + 1)]
    for row, agent in enumerate(names):
        actors = pair.at(last, agent).actor_id
        colors = []
        for frame in range(1, last + 1):
            sample = sample_token(pair.scenario, agent, frame)
            visible_ids = visible_actors(pair.dataset, sample, agents=[agent])
            seen_share = float(np.isin(actors, visible_ids).mean())
            colors.append((AGENT_COLORS[agent], seen_share**2))
        ax.broken_barh(spans, (row - 0.35, 0.7), facecolors=colors, linewidth=0)
    labels = [short_name(agent) for agent in names]
    ax.set_yticks(range(len(names)), labels, fontsize=text_size())
    ax.set_ylim(max(len(names), 1) - 0.5, -0.5)
    ax.set_xlabel("time relative to the impact (s)", fontsize=text_size())
    ax.set_title("sees the pair (pale: only one)", fontsize="medium")
    with_light_grid(ax, "x")
