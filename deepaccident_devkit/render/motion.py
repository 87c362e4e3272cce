"""Motion labels as pictures."""

from __future__ import annotations

from collections.abc import Collection
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.arrays import AnyArray
from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.motion import OWN_BOX_ID, MotionLabelConfig, MotionLabels, motion_labels
from deepaccident_devkit.motion.orientations import to_orientation
from deepaccident_devkit.render.axes import figure_or_new
from deepaccident_devkit.render.bev import collider_ids
from deepaccident_devkit.render.colors import COLLIDER_COLOR, OWN_COLOR
from deepaccident_devkit.taxonomy import OWN_ACTOR_ID

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MAPS: Final = ("instances", "centerness", "offset", "flow")
_PALETTE: Final = "tab20"


def render_motion_labels(
    dataset: Dataset,
    sample: RowArgument,
    config: MotionLabelConfig | None = None,
    *,
    at_present: bool = True,
    fig: Figure | None = None,
) -> Figure:
    """Draw a sample's motion labels: a column a frame; instances, centres, offsets and flow below each other.

    The colliding pair is red, the ego's own box green. Forward is to the right in all orientations.

    Args:
        dataset: the release.
        sample: token or record.
        config: what labels show; None for the released ones.
        at_present: warp all frames to the present ego frame; else each is in its own.
        fig: figure to draw on; a new one if None.

    Raises:
        TokenError: no such sample.
        NotAvailableError: the sample has no label.
    """
    labels = motion_labels(dataset, sample, config)
    if at_present:
        labels = labels.to_present()
    return draw_motion_labels(labels, marked=collider_ids(dataset, sample), fig=fig)


def draw_motion_labels(labels: MotionLabels, *, marked: Collection[int] = (), fig: Figure | None = None) -> Figure:
    """Draw labels as `render_motion_labels` does; `marked` actors are red."""
    frames = labels.config.label_frames
    fig = figure_or_new(fig, (2.6 * frames + 0.8, 2.6 * len(_MAPS) + 0.6))
    panels = fig.subplots(len(_MAPS), frames, sharex=True, sharey=True, squeeze=False)
    seconds = labels.config.step / 10
    colors = _instance_colors(labels, marked)
    for number in range(frames):
        maps = _as_devkit(labels, number)
        _draw_instances(maps, colors, labels, panels[0, number])
        _draw_centerness(maps, labels, panels[1, number])
        for row, name in ((2, "offset"), (3, "flow")):
            _draw_vectors(maps, name, labels, panels[row, number])
        there = "" if labels.label_valid[number] else ", not recorded"
        panels[0, number].set_title(f"+{number * seconds:.1f} s{there}", fontsize=9)
    for row, name in enumerate(_MAPS):
        panels[row, 0].set_ylabel(f"{name}\ny left (m)", fontsize=8)
    for ax in panels[-1]:
        ax.set_xlabel("x forward (m)", fontsize=8)
    return fig


def _draw_instances(maps: dict[str, AnyArray], colors: AnyArray, labels: MotionLabels, ax: Axes) -> None:
    """Draw one frame's instances, each in its colour (ids, 3)."""
    instance = maps["instance"]
    known = np.where(instance < len(colors), instance, 0)
    _draw(ax, colors[known], labels)


def _draw_centerness(maps: dict[str, AnyArray], labels: MotionLabels, ax: Axes) -> None:
    _draw(ax, maps["centerness"], labels, cmap="magma", vmin=0, vmax=1)


def _draw_vectors(maps: dict[str, AnyArray], name: str, labels: MotionLabels, ax: Axes) -> None:
    """Colours for direction, paler for shorter; white where there is no vector."""
    from matplotlib.colors import hsv_to_rgb

    down, along = maps[name]
    there = (down != labels.config.ignore_index) & (maps["instance"] != 0)
    length = np.hypot(down, along)
    longest = max(float(length[there].max(initial=0)), 1.0)
    hue = (np.arctan2(down, along) / (2 * np.pi)) % 1
    shade = np.stack([hue, np.minimum(length / longest, 1), np.full_like(hue, 0.9)], axis=-1)
    _draw(ax, np.where(there[..., None], hsv_to_rgb(shade), 1.0), labels)


def _draw(ax: Axes, picture: AnyArray, labels: MotionLabels, **how: Any) -> None:
    x, y = labels.config.grid.x, labels.config.grid.y
    ax.imshow(picture, origin="lower", extent=(x[0], x[1], y[0], y[1]), interpolation="nearest", **how)
    ax.tick_params(labelsize=7)


def _as_devkit(labels: MotionLabels, number: int) -> dict[str, AnyArray]:
    """One frame's maps with rows along y (left) and columns along x (forward); vectors likewise."""
    source, ignore = labels.config.grid.orientation, labels.config.ignore_index
    maps = {"instance": labels.instance[number], "centerness": labels.centerness[number, 0]}
    turned = {
        name: to_orientation(array, vectors=False, source=source, target="devkit") for name, array in maps.items()
    }
    for name in ("offset", "flow"):
        vectors = getattr(labels, name)[number]
        turned[name] = to_orientation(vectors, vectors=True, source=source, target="devkit", ignore=ignore)
    return turned


def _instance_colors(labels: MotionLabels, marked: Collection[int]) -> AnyArray:
    """(1 + ids, 3) white for the background, a colour of the palette for each id, red and green for some actors."""
    from matplotlib import colormaps
    from matplotlib.colors import to_rgb

    highest = max([int(labels.instance.max()), *labels.id_map.values()])
    colors = np.array([colormaps[_PALETTE](number % 20)[:3] for number in range(1 + highest)])
    colors[0] = 1.0
    for actor, identity in labels.id_map.items():
        own = actor == OWN_BOX_ID
        if (OWN_ACTOR_ID if own else actor) in marked:
            colors[identity] = to_rgb(COLLIDER_COLOR)
        elif own:
            colors[identity] = to_rgb(OWN_COLOR)
    return colors
