"""Where actors come from and where they go, as lines that fade with time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.arrays import FloatArray, IntArray
from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.geometry import SE3, Boxes
from deepaccident_devkit.taxonomy import FRAME_PERIOD, OWN_ACTOR_ID
from deepaccident_devkit.v2x.tracks import ScenarioTracks, scenario_tracks

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import LineCollection

_FAINTEST: Final = 0.1
"""How opaque the far end of a trail is."""
_STANDING: Final = 0.5
"""Metres: an actor that moves less has no trail."""


def draw_trail(path: FloatArray, ax: Axes, color: str, **how: Any) -> LineCollection:
    """Render a path (T, 2), metres, opaque at its first point and fading towards its last.

    Args:
        path: from the present on, or back.
        ax: axes to render on.
        color: of the line.
        how: matplotlib's arguments for the line, such as `linewidths` or `linestyles`.
    """
    return _draw_trails([path], ax, [color], how)


def draw_trails(
    dataset: Dataset,
    sample: Any,
    boxes: Boxes,
    colors: Sequence[str],
    *,
    target_from_world: SE3,
    seconds: tuple[float, float],
    ax: Axes,
) -> None:
    """Render where the actors of boxes were (thin) and will be (thick), by all agents' labels.

    Args:
        dataset: the release.
        sample: record of the present.
        boxes: the actors; those without an id have no trail.
        colors: one colour for each box.
        target_from_world: transform into the frame of the axes.
        seconds: how far back and how far ahead.
        ax: axes to render on.
    """
    tracks = scenario_tracks(dataset, sample["scenario_token"])
    own = dataset.get("agent", sample["agent_token"])["actor_id"]
    present = int(sample["token"].rsplit("/", 1)[1])
    back, ahead = (round(span / FRAME_PERIOD) for span in seconds)
    centers = target_from_world.apply(tracks.boxes.center)[:, :2]
    pasts, futures, chosen = [], [], []
    for actor_id, color in zip(boxes.actor_id.tolist(), colors, strict=True):
        actor = own if actor_id == OWN_ACTOR_ID else actor_id
        pasts.append(centers[_rows(tracks, actor, present - back, present)][::-1])
        futures.append(centers[_rows(tracks, actor, present, present + ahead)])
        chosen.append(color)
    _draw_trails(pasts, ax, chosen, {"linewidths": 0.8})
    _draw_trails(futures, ax, chosen, {"linewidths": 2.0})


def _rows(tracks: ScenarioTracks, actor: int | None, first: int, last: int) -> IntArray:
    """The rows of an actor from frame `first` to `last`, both included, in the order of time."""
    return np.flatnonzero((tracks.actor_id == actor) & (tracks.index >= first) & (tracks.index <= last))


def _draw_trails(paths: Sequence[FloatArray], ax: Axes, colors: Sequence[str], how: dict[str, Any]) -> LineCollection:
    """Paths (T, 2) as one collection of short lines, each fainter than the one before it."""
    from matplotlib.collections import LineCollection
    from matplotlib.colors import to_rgb

    lines, shades = [np.zeros((0, 2, 2))], [np.zeros((0, 4))]
    for path, color in zip(paths, colors, strict=True):
        if len(path) > 1 and np.ptp(path, axis=0).max() > _STANDING:
            opacity = np.linspace(1, _FAINTEST, len(path) - 1)
            lines.append(np.stack([path[:-1], path[1:]], axis=1))
            shades.append(np.column_stack([np.tile(to_rgb(color), (len(opacity), 1)), opacity]))
    style = {"zorder": 2, "capstyle": "butt", **how}
    drawn = LineCollection(list(np.concatenate(lines)), colors=np.concatenate(shades), **style)
    ax.add_collection(drawn)
    return drawn
