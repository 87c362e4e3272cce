"""The countdown to an impact: a figure of several moments, and a video's picture of one moment."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ChoiceError, NotAvailableError
from deepaccident_devkit.geometry import SE3, Boxes
from deepaccident_devkit.render.axes import axis_words, figure_or_new, set_title, settled, with_light_grid
from deepaccident_devkit.render.best_view import best_camera
from deepaccident_devkit.render.boxes import draw_actors_from_above, write_beside
from deepaccident_devkit.render.camera import CAMERA_LAYERS, draw_camera
from deepaccident_devkit.render.chips import SMALLEST_TEXT
from deepaccident_devkit.render.colors import AGENT_COLORS, COLLIDER_COLOR, GRID_COLOR
from deepaccident_devkit.render.layers import Layer, layers_of
from deepaccident_devkit.render.roles import in_drawing_order, role_colors, short_name
from deepaccident_devkit.render.trails import draw_trails
from deepaccident_devkit.tables.tokens import sample_token
from deepaccident_devkit.taxonomy import AGENTS, FRAME_PERIOD
from deepaccident_devkit.v2x import Agents, Contact, collision, cooperating_agents
from deepaccident_devkit.v2x.collisions import CONTACT_GAP
from deepaccident_devkit.v2x.configurations import agents_of
from deepaccident_devkit.v2x.tracks import ScenarioTracks, scenario_tracks

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COUNTDOWN: Final = (2.0, 1.0, 0.5, 0.0)
"""Seconds before the impact."""
COUNTDOWN_LAYERS: Final[tuple[Layer, ...]] = (*CAMERA_LAYERS, "trajectories", "grid")
_SHOWN: Final[tuple[Layer, ...]] = ("image", "boxes", "trajectories", "grid")
_NEAR: Final = 18.0
_NEAR_IN_VIDEO: Final = 28.0
"""How many metres around the place of contact are shown."""
_WIDTH: Final = 3.3
"""Width of a panel in inches."""
_MOSAIC: Final[list[Any]] = [[*AGENTS[:3]], ["above", *AGENTS[3:]], ["above", "speeds", "speeds"]]
"""The panels of a video's picture."""
_SHOWS_BEST: Final = 0.5
"""Seconds before the impact at which the cameras are chosen: at the impact the pair may be beside each other."""
_DASHES: Final = ("-", "--")


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

    Each agent has the image of the camera that sees the colliding pair best (the front one if no camera does), of those
    that were downloaded; if none was, a grey panel. The view
    from above has the place of contact (a cross), the pair's speeds, and the pair's paths up to the contact.

    Args:
        dataset: the release.
        scenario: token or record of one with a collision.
        seconds: before the impact, which is the recording's last frame; moments before the first are left out.
        agents: whose images are shown; None for all that are there, and an empty list for none.
        layers: `image`, `boxes`, `trajectories` and `grid` are the default; also `points` (of the LiDAR, in images),
            `ids` and `velocities`. Without `image` no image file is read.
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
    shown = layers_of(layers, _SHOWN, COUNTDOWN_LAYERS)
    contact = _contact(dataset, scenario, "look at moments of this one with render_frame")
    record = dataset.get("scenario", scenario)
    cut = _cut_words(contact, record["num_frames"])
    moments = _moments(seconds, record["num_frames"])
    there = agents_of(dataset, scenario)
    first = sample_token(record["token"], there[0], record["num_frames"])
    names = in_drawing_order([] if agents == [] else cooperating_agents(dataset, first, agents))
    rows = len(names) + 1
    fig = figure_or_new(fig, (_WIDTH * len(moments) + 0.8, 1.95 * len(names) + _WIDTH + 1.1))
    axes = fig.subplots(rows, len(moments), squeeze=False, height_ratios=(*[9 / 16] * len(names), 1))
    tracks = scenario_tracks(dataset, record["token"])
    for column, (left, index) in enumerate(moments):
        for row, agent in enumerate(names):
            sample = sample_token(record["token"], agent, index)
            _draw_image(dataset, sample, _pair_at(tracks, contact, index), shown, axes[row, column])
        moment = sample_token(record["token"], there[0], index)
        _draw_contact(dataset, moment, contact, tracks, shown, axes[-1, column])
        end = "the last frame" if cut else "the impact"
        axes[0, column].set_title(end if left == 0 else f"{left:g} s before")
    for row, agent in enumerate(names):
        _write_row(short_name(agent), AGENT_COLORS[agent], axes[row, 0])
    for ax in axes[-1, 1:]:
        ax.set_ylabel("")
    set_title(fig, "\n".join(filter(None, [accident_words(dataset, contact), cut])), fontsize=11)
    return settled(fig)


def draw_countdown(
    dataset: Dataset, frame: str, agents: Sequence[str], layers: Collection[Layer] | None, fig: Figure
) -> None:
    """Render a moment of an accident: five cameras, the place of contact from above, the speeds of the pair.

    Each agent's camera is the one that shows the pair best shortly before the impact, in all moments.

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
    shown = layers_of(layers, _SHOWN, COUNTDOWN_LAYERS)
    record = dataset.get("frame", frame)
    scenario, index = record["scenario_token"], record["index"]
    contact = _contact(dataset, scenario, "the view 'frame'")
    tracks = scenario_tracks(dataset, scenario)
    impact = int(tracks.index.max())
    chosen_at = max(1, impact - round(_SHOWS_BEST / FRAME_PERIOD))
    axes = fig.subplot_mosaic(_MOSAIC, height_ratios=(1, 1, 0.8))
    for agent in AGENTS:
        if agent not in agents:
            axes[agent].set_axis_off()
            continue
        pair = _pair_at(tracks, contact, chosen_at)
        channel = best_camera(dataset, sample_token(scenario, agent, chosen_at), pair)
        _draw_camera(dataset, f"{sample_token(scenario, agent, index)}/{channel}", shown, axes[agent])
    moment = sample_token(scenario, agents[0], index)
    _draw_contact(dataset, moment, contact, tracks, shown, axes["above"], near=_NEAR_IN_VIDEO)
    axes["above"].set(xlabel="", ylabel="")
    axes["above"].set_title("from above, world (m)", fontsize="medium")
    _draw_speeds(dataset, contact, tracks, index, axes["speeds"])
    axes["speeds"].set_title(accident_words(dataset, contact).replace("\n", "; "), fontsize=9)
    left = (impact - index) * FRAME_PERIOD
    words = f"{left:.1f} s to the impact" if index < impact else "the impact"
    fig.suptitle(words, fontsize=15, fontweight="bold", color=COLLIDER_COLOR)


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
    speeds = " and ".join(_number(contact.speeds[each], "m/s") for each in order)
    return (
        f"{hitting} {verb} {hit}, {sides}\n{speeds}, closing at {_number(contact.closing_speed, 'm/s')}, "
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


def _pair_at(tracks: ScenarioTracks, contact: Contact, index: int) -> Boxes:
    """The boxes, in world, of the colliding actors that exist in a frame (number from 1)."""
    there = tracks.at(index)
    return there.select(np.isin(there.actor_id, contact.actor_ids))


def _draw_image(dataset: Dataset, sample: str, pair: Boxes, shown: frozenset[Layer], ax: Axes) -> None:
    channel = best_camera(dataset, sample, pair)
    draw_camera(dataset, dataset.get("sample_data", f"{sample}/{channel}"), shown.intersection(CAMERA_LAYERS), ax)
    ax.set_title("")
    write_beside(ax, channel, (ax.get_xlim()[0], ax.get_ylim()[0]), "black")


def _draw_contact(
    dataset: Dataset,
    sample: str,
    contact: Contact,
    tracks: ScenarioTracks,
    shown: frozenset[Layer],
    ax: Axes,
    *,
    near: float = _NEAR,
) -> None:
    """Render a sample (a token) around the place of contact, in world; of the layers `shown`, those that it has."""
    record, index = dataset.get("sample", sample), int(sample.rsplit("/", 1)[1])
    x, y = contact.point[:2].tolist()
    ax.set(xlim=(x - near, x + near), ylim=(y - near, y + near), aspect="equal")
    boxes = tracks.at(index)
    colors = role_colors(dataset, record, boxes)
    pair = np.isin(boxes.actor_id, contact.actor_ids)
    if "trajectories" in shown:
        seconds = (3.0, record["time_to_impact"] or 0.0)
        both, red = boxes.select(pair), [COLLIDER_COLOR] * int(pair.sum())
        draw_trails(dataset, record, both, red, target_from_world=SE3.identity(), seconds=seconds, ax=ax)
    draw_actors_from_above(boxes, ax, colors, shown)
    ax.plot(x, y, "x", color="black", markersize=9, markeredgewidth=1.8, zorder=5)
    for row in np.flatnonzero(pair).tolist():
        speed = float(np.linalg.norm(boxes.velocity[row]))
        corner = boxes.center[row, :2] + (1.0, 1.0)
        write_beside(ax, _number(speed, "m/s"), (float(corner[0]), float(corner[1])), COLLIDER_COLOR)
    if "grid" in shown:
        ax.grid(color=GRID_COLOR, linewidth=0.4)
        ax.set_axisbelow(True)
    words = axis_words("world")
    ax.set(xlabel=words[0], ylabel=words[1])
    ax.tick_params(labelsize=SMALLEST_TEXT)


def _write_row(words: str, color: str, ax: Axes) -> None:
    ax.text(
        -0.02, 0.5, words, rotation=90, ha="right", va="center", color=color, fontweight="bold", transform=ax.transAxes
    )


def _number(value: float, unit: str) -> str:
    return f"{value:.1f} {unit}" if np.isfinite(value) else f"unknown {unit}"


def _draw_camera(dataset: Dataset, camera: str, shown: Collection[Layer], ax: Axes) -> None:
    draw_camera(dataset, dataset.get("sample_data", camera), shown, ax)
    agent, _, channel = camera.rsplit("/", 3)[1:]
    ax.set_title(f"{short_name(agent)}: {channel}", fontsize="medium", color=AGENT_COLORS[agent])


def _draw_speeds(dataset: Dataset, contact: Contact, tracks: ScenarioTracks, index: int, ax: Axes) -> None:
    """Render the pair's speeds over the seconds before the impact: strong up to the present, pale after it."""
    impact, fastest = int(tracks.index.max()), 1.0
    for actor, instance, dashes in zip(contact.actor_ids, contact.instances, _DASHES, strict=True):
        rows = np.flatnonzero(tracks.actor_id == actor)
        before = (tracks.index[rows] - impact) * FRAME_PERIOD
        speed = np.linalg.norm(tracks.boxes.velocity[rows], axis=1)
        fastest = max(fastest, float(np.nan_to_num(speed).max()))
        past = tracks.index[rows] <= index
        words = f"{dataset.instance.get(instance)['category']} {actor}"
        ax.plot(before, speed, color=COLLIDER_COLOR, linestyle=dashes, linewidth=1.2, alpha=0.25)
        ax.plot(before[past], speed[past], color=COLLIDER_COLOR, linestyle=dashes, linewidth=2.0, label=words)
    ax.axvline((index - impact) * FRAME_PERIOD, color="black", linewidth=1.2)
    ax.axvline(0, color=COLLIDER_COLOR, linewidth=1.2, linestyle=":")
    ax.set(
        xlabel="time to the impact (s)", ylabel="speed (m/s)", xlim=(-(impact - 1) * FRAME_PERIOD, 0.1), ylim=(0, None)
    )
    ax.legend(loc="lower left", fontsize=8, ncols=2, framealpha=0.7)
    with_light_grid(ax, "both")
