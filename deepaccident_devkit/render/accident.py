"""The countdown to an impact: a figure of several moments, and a video's picture of one moment."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ChoiceError, NotAvailableError
from deepaccident_devkit.render.axes import Layer, figure_or_new, layers_of, settled, with_light_grid
from deepaccident_devkit.render.chips import SMALLEST_TEXT
from deepaccident_devkit.render.colors import AGENT_COLORS, CASING_COLOR, COLLIDER_COLOR, GRID_COLOR
from deepaccident_devkit.render.pair import PAIR_LAYERS, Pair, draw_pair_from_above, draw_pair_in_camera, number_words
from deepaccident_devkit.render.roles import in_drawing_order
from deepaccident_devkit.render.styles import in_own_settings
from deepaccident_devkit.render.titles import set_scene_title
from deepaccident_devkit.tables.tokens import sample_token
from deepaccident_devkit.taxonomy import AGENTS, FRAME_PERIOD, short_name
from deepaccident_devkit.v2x import Agents, Contact, collision, cooperating_agents
from deepaccident_devkit.v2x.agents import agents_of
from deepaccident_devkit.v2x.collisions import CONTACT_GAP

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COUNTDOWN: Final = (2.0, 1.0, 0.5, 0.0)
"""Seconds before the impact."""
_SHOWN: Final[tuple[Layer, ...]] = ("image", "bev", "boxes", "trajectories", "grid")
_WIDTH: Final = 3.3
"""Width of a panel in inches."""
_LEAST_WIDTH: Final = 1.6
"""Inches of a camera's panel below which agents are left out."""
_TITLE: Final = 1.0
"""Inches of the height that titles take, about."""
_MOSAIC: Final[list[Any]] = [[*AGENTS[:3]], ["above", *AGENTS[3:]], ["above", "speeds", "speeds"]]
"""The panels of a video's picture."""
_DASHES: Final = ("-", "--")


@in_own_settings
def render_accident(
    dataset: Dataset,
    scenario: RowArgument,
    *,
    seconds: Sequence[float] = COUNTDOWN,
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
        seconds: before the impact, which is the recording's last frame; moments before the first are left out.
        agents: whose images are shown; an empty list for none. None is for all that are there or, where their images
            would be narrower than 1.6 inches, as on a slide, for those that see the pair best; the title says so.
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
    moments = _moments(seconds, record["num_frames"])
    there = agents_of(dataset, scenario)
    first = sample_token(record["token"], there[0], record["num_frames"])
    names = in_drawing_order([] if agents == [] else cooperating_agents(dataset, first, agents))
    fig = figure_or_new(fig, (_WIDTH * len(moments) + 0.8, 1.95 * len(names) + _WIDTH + 1.1))
    pair, best = Pair.of(dataset, contact), ""
    room = _agents_with_room(fig, len(names), len(moments)) if agents is None else len(names)
    if room < len(names):
        best = f"the {room} of {len(names)} agents that see the pair best"
        names = _best_agents(pair, names, [index for _, index in moments], room)
    axes, across = _panels(fig, len(names), len(moments))
    for column, (left, index) in enumerate(moments):
        for agent, ax in zip(names, axes[:, column], strict=False):
            channel = draw_pair_in_camera(pair, agent, index, shown, ax)
            _write_name(channel, ax)
        draw_pair_from_above(pair, index, shown, axes[-1, column])
        end = "the last frame" if cut else "the impact"
        _write_head(end if left == 0 else f"{left:g} s before", "black", axes[0, column], above=not across)
    for agent, ax in zip(names, axes[:, 0], strict=False):
        _write_head(short_name(agent), AGENT_COLORS[agent], ax, above=across)
    _write_head("from above", "black", axes[-1, 0], above=across)
    words = "\n".join(filter(None, [accident_words(dataset, contact), cut]))
    set_scene_title(fig, dataset, record["token"], best, below=words, fontsize=11)
    return settled(fig)


def draw_countdown(
    dataset: Dataset, frame: str, *, agents: Sequence[str], layers: Collection[Layer] | None, fig: Figure
) -> None:
    """Render a moment of an accident: five cameras, the place of contact from above, the speeds of the pair.

    Each agent's camera is chosen as in `render_accident`.

    Args:
        dataset: the release.
        frame: token.
        agents: whose cameras are shown.
        layers: as in `render_accident`; None for its default.
        fig: an empty figure to render on, about 16 to 9.

    Raises:
        NotAvailableError: nobody collides in the scenario, or it has no meta.
        ChoiceError: no such layer.
    """
    shown = layers_of(layers, _SHOWN, PAIR_LAYERS)
    record = dataset.get("frame", frame)
    index = record["index"]
    contact = _contact(dataset, record["scenario_token"], "the view 'frame'")
    pair = Pair.of(dataset, contact)
    axes = fig.subplot_mosaic(_MOSAIC, height_ratios=(1, 1, 0.8))
    for agent in AGENTS:
        if agent not in agents:
            axes[agent].set_axis_off()
            continue
        channel = draw_pair_in_camera(pair, agent, index, shown, axes[agent])
        words = channel.replace("\n", " ")
        axes[agent].set_title(f"{short_name(agent)}: {words}", fontsize="medium", color=AGENT_COLORS[agent])
    draw_pair_from_above(pair, index, shown, axes["above"])
    axes["above"].set_title(f"from above, {axes['above'].get_title()}", fontsize="medium")
    _draw_speeds(pair, index, axes["speeds"])
    set_scene_title(fig, dataset, frame, below=accident_words(dataset, contact).replace("\n", "; "), fontsize=12)


def accident_words(dataset: Dataset, contact: Contact) -> str:
    """Two lines: who hits whom, with which sides, how fast and at which angle."""
    scenario = contact.frame.rsplit("/", 1)[0]
    owners = {
        dataset.agent.get(f"{scenario}/{agent}")["actor_id"]: short_name(agent)
        for agent in agents_of(dataset, scenario)
    }
    names = []
    for instance, actor in zip(contact.instances, contact.actor_ids, strict=True):
        category = dataset.instance.get(instance)["category"]
        names.append(f"{owners[actor]} ({category} {actor})" if actor in owners else f"{category} {actor}")
    order = (1, 0) if contact.sides[1] == "front" and contact.sides[0] != "front" else (0, 1)
    hitting, hit = (names[each] for each in order)
    verb = "hits" if contact.sides[order[0]] == "front" else "touches"
    sides = " to ".join(contact.sides[each] for each in order)
    speeds = " and ".join(number_words(contact.speeds[each]) for each in order)
    return (
        f"{hitting} {verb} {hit}, {sides}\n{speeds} m/s, closing at {number_words(contact.closing_speed)} m/s, "
        f"{np.degrees(contact.impact_angle):.0f}° between their headings"
    )


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
    across = (16 / 9 if agents else 1) * min(height / moments, width / (agents * 16 / 9 + 1))
    return max(down, across), across > down


def _panels(fig: Figure, agents: int, moments: int) -> tuple[Any, bool]:
    """Axes (agents + 1, moments), and whether rows are columns."""
    if _width(fig, agents, moments)[1]:
        return fig.subplots(moments, agents + 1, squeeze=False, width_ratios=(*[16 / 9] * agents, 1)).T, True
    return fig.subplots(agents + 1, moments, squeeze=False, height_ratios=(*[9 / 16] * agents, 1)), False


def _agents_with_room(fig: Figure, agents: int, moments: int) -> int:
    """How many of the agents can be shown so large that one can see what happens, or as large as they can be."""
    widths = {number: _width(fig, number, moments)[0] for number in range(1, agents + 1)}
    return max(number for number, width in widths.items() if width >= min(_LEAST_WIDTH, 0.9 * max(widths.values())))


def _best_agents(pair: Pair, agents: Sequence[str], frames: Sequence[int], number: int) -> list[str]:
    """So many of the agents: those in whose images most of the pair is, and of equal ones where it is largest."""
    views = {agent: [pair.view(agent, index)[1] for index in frames] for agent in agents}
    seen = {agent: [(view.shown, view.area) for view in views[agent] if view is not None] for agent in agents}
    ranked = sorted(agents, key=lambda agent: np.sum([(0, 0), *seen[agent]], axis=0).tolist(), reverse=True)
    return in_drawing_order(ranked[:number])


def _write_head(words: str, color: str, ax: Axes, *, above: bool) -> None:
    """Write the head of a column above its first panel, or that of a row beside it."""
    if above:
        ax.set_title("\n".join(filter(None, [words, ax.get_title()])), color=color, fontsize="medium")
        return
    style: dict[str, Any] = {"rotation": 90, "ha": "right", "va": "center", "fontweight": "bold"}
    ax.text(-0.02, 0.5, words, color=color, transform=ax.transAxes, **style)


def _write_name(words: str, ax: Axes) -> None:
    """Write a camera's name into the lower left corner of its panel, whatever is there."""
    paper = {"facecolor": CASING_COLOR, "edgecolor": GRID_COLOR, "linewidth": 0.7, "pad": 1.5}
    ax.annotate(
        words,
        (0, 0),
        (3, 3),
        xycoords="axes fraction",
        textcoords="offset points",
        fontsize=SMALLEST_TEXT,
        bbox=paper,
        zorder=5,
        in_layout=False,
    )


def _draw_speeds(pair: Pair, index: int, ax: Axes) -> None:
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
        xlabel="time to the impact (s)", ylabel="speed (m/s)", xlim=(-(impact - 1) * FRAME_PERIOD, 0.1), ylim=(0, None)
    )
    ax.legend(loc="lower left", fontsize=SMALLEST_TEXT, ncols=2, framealpha=0.7)
    with_light_grid(ax, "both")
