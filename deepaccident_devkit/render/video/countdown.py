"""One moment of an accident in one picture of a video: the pair from above, in the agents' cameras, and its speeds."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.render.accident import (
    COUNTDOWN_DEFAULT,
    COUNTDOWN_LAYERS,
    accident_words,
    draw_contact,
    pair_at,
)
from deepaccident_devkit.render.axes import with_light_grid
from deepaccident_devkit.render.best_view import best_camera
from deepaccident_devkit.render.camera import CAMERA_LAYERS, render_sample_data
from deepaccident_devkit.render.colors import AGENT_COLORS, COLLIDER_COLOR
from deepaccident_devkit.render.layers import Layer, layers_of
from deepaccident_devkit.render.roles import short_name
from deepaccident_devkit.tables.tokens import sample_token
from deepaccident_devkit.taxonomy import AGENTS, FRAME_PERIOD
from deepaccident_devkit.v2x import Contact, collision
from deepaccident_devkit.v2x.tracks import ScenarioTracks, scenario_tracks

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MOSAIC: Final[list[Any]] = [[*AGENTS[:3]], ["above", *AGENTS[3:]], ["above", "speeds", "speeds"]]
_NEAR: Final = 28.0
"""Metres around the place of contact that are shown."""
_SHOWS_BEST: Final = 0.5
"""Seconds before the impact at which the cameras are chosen: at the impact the pair may be beside each other."""
_DASHES: Final = ("-", "--")


def draw_countdown(
    dataset: Dataset, frame: str, agents: Sequence[str], layers: Collection[Layer] | None, fig: Figure
) -> None:
    """Draw a moment of an accident: five cameras, the place of contact from above, the speeds of the pair.

    Each agent's camera is the one that shows the pair best shortly before the impact, in all moments.

    Args:
        dataset: the release.
        frame: token.
        agents: whose cameras are shown.
        layers: of `render_accident`; None for its default.
        fig: an empty figure to draw on, about 16 to 9.

    Raises:
        NotAvailableError: nobody collides in the scenario, or it has no meta.
        ChoiceError: no such layer.
        MissingFileError: an image was not downloaded.
    """
    shown = layers_of(layers, COUNTDOWN_DEFAULT, COUNTDOWN_LAYERS)
    record = dataset.get("frame", frame)
    scenario, index = record["scenario_token"], record["index"]
    contact = collision(dataset, scenario)
    if contact is None:
        raise NotAvailableError(
            f"{scenario}: nobody collides in it, so there is nothing to count down to; choose a scenario with a "
            "collision, or the view 'frame'"
        )
    tracks = scenario_tracks(dataset, scenario)
    impact = int(tracks.index.max())
    chosen_at = max(1, impact - round(_SHOWS_BEST / FRAME_PERIOD))
    axes = fig.subplot_mosaic(_MOSAIC, height_ratios=(1, 1, 0.8))
    for agent in AGENTS:
        if agent not in agents:
            axes[agent].set_axis_off()
            continue
        pair = pair_at(tracks, contact, chosen_at)
        channel = best_camera(dataset, sample_token(scenario, agent, chosen_at), pair)
        _draw_camera(dataset, f"{sample_token(scenario, agent, index)}/{channel}", shown, axes[agent])
    draw_contact(dataset, sample_token(scenario, agents[0], index), contact, tracks, shown, axes["above"])
    x, y = contact.point[:2].tolist()
    axes["above"].set(xlim=(x - _NEAR, x + _NEAR), ylim=(y - _NEAR, y + _NEAR), xlabel="", ylabel="")
    axes["above"].set_title("from above, world (m)", fontsize="medium")
    _draw_speeds(dataset, contact, tracks, index, axes["speeds"])
    axes["speeds"].set_title(accident_words(dataset, contact).replace("\n", "; "), fontsize=9)
    left = (impact - index) * FRAME_PERIOD
    words = f"{left:.1f} s to the impact" if index < impact else "the impact"
    fig.suptitle(words, fontsize=15, fontweight="bold", color=COLLIDER_COLOR)


def _draw_camera(dataset: Dataset, camera: str, shown: Collection[Layer], ax: Axes) -> None:
    in_camera: list[Layer] = [layer for layer in CAMERA_LAYERS if layer in shown]
    render_sample_data(dataset, camera, layers=in_camera, ax=ax)
    agent, _, channel = camera.rsplit("/", 3)[1:]
    ax.set_title(f"{short_name(agent)}: {channel}", fontsize="medium", color=AGENT_COLORS[agent])


def _draw_speeds(dataset: Dataset, contact: Contact, tracks: ScenarioTracks, index: int, ax: Axes) -> None:
    """Draw how fast the pair is over the seconds before the impact, up to the present full, then pale."""
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
