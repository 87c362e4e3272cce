"""Motion labels as pictures."""

from __future__ import annotations

from collections.abc import Collection
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.arrays import AnyArray, FloatArray
from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.motion import OWN_BOX_ID, MotionLabelConfig, MotionLabels, motion_labels
from deepaccident_devkit.motion.orientations import to_orientation
from deepaccident_devkit.render.axes import figure_or_new
from deepaccident_devkit.render.bev import collider_ids
from deepaccident_devkit.render.colors import COLLIDER_COLOR, GRID_COLOR, OWN_COLOR
from deepaccident_devkit.taxonomy import OWN_ACTOR_ID

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.gridspec import GridSpec
    from matplotlib.image import AxesImage

_MAPS: Final = ("instance", "centerness", "offset", "flow")
_PALETTE: Final = (0, 1, 2, 3, 8, 9, 10, 11, 12, 13, 16, 17, 18, 19)
"""Of matplotlib's tab20: without its reds, greens and greys, which mean something here."""
_BEYOND: Final = "#e4e4e4"
_LEGEND_WIDTH: Final = 0.55
"""Of a panel's."""


def render_motion_labels(
    dataset: Dataset,
    sample: RowArgument,
    config: MotionLabelConfig | None = None,
    *,
    at_present: bool = True,
    fig: Figure | None = None,
) -> Figure:
    """Draw a sample's motion labels: a column a frame; instances, centerness, offset and flow below each other.

    Forward is to the right in all orientations. The colliding pair is red; the ego's own box has a green edge, and is
    green if it does not collide. Colours of offset and flow are directions, as the wheels show; an arrow leads from an
    instance to where the flow takes it. Frames beyond the recording are grey.

    Args:
        dataset: the release.
        sample: token or record.
        config: what labels show; None for the released ones.
        at_present: warp all frames to the present ego frame; else each is in its own.
        fig: an empty figure to draw on; a new one if None.

    Returns:
        The figure drawn on.

    Raises:
        TokenError: no such sample.
        NotAvailableError: the sample has no label.
    """
    labels = motion_labels(dataset, sample, config)
    if at_present:
        labels = labels.to_present()
    fig = draw_motion_labels(labels, marked=collider_ids(dataset, sample), fig=fig)
    frame = "the present ego frame" if at_present else "each frame's own ego frame"
    fig.suptitle(f"{dataset.get('sample', sample)['token']}, in {frame}")
    return fig


def draw_motion_labels(labels: MotionLabels, *, marked: Collection[int] = (), fig: Figure | None = None) -> Figure:
    """Draw labels as `render_motion_labels` does; the actors whose ids are `marked` are red (the ego's own is −100)."""
    frames = labels.config.label_frames
    fig = figure_or_new(fig, (2.8 * (frames + _LEGEND_WIDTH) + 0.6, 2.8 * len(_MAPS) + 0.8))
    grid = fig.add_gridspec(len(_MAPS), frames + 1, width_ratios=(*[1.0] * frames, _LEGEND_WIDTH))
    panels = _panels(labels, grid, fig)
    maps = {number: _as_devkit(labels, number) for number in range(frames) if labels.label_valid[number]}
    colors, peaks = _instance_colors(labels, marked), None
    for number, found in maps.items():
        draw_instances(found["instance"], colors, labels, panels[0, number])
        peaks = _draw(panels[1, number], found["centerness"], labels, cmap="magma", vmin=0, vmax=1)
    if peaks is not None:
        fig.colorbar(peaks, cax=_legend(fig, grid, 1).inset_axes((0.02, 0.1, 0.12, 0.8)))
    for row, name in ((2, "offset"), (3, "flow")):
        longest = max([1.0, *(float(_lengths(found, name).max(initial=0)) for found in maps.values())])
        for number, found in maps.items():
            _draw(panels[row, number], _direction_colors(found[name], _known(found, name), longest), labels)
        _draw_wheel(_legend(fig, grid, row), longest)
    for number, found in maps.items():
        draw_flow_arrows(found, labels, panels[3, number])
    return fig


def draw_instances(instance: AnyArray, colors: FloatArray, labels: MotionLabels, ax: Axes) -> None:
    """Draw one frame's instances (H, W), the devkit's way up, in their colours (1 + ids, 3)."""
    _draw(ax, colors[np.where(instance < len(colors), instance, 0)], labels)
    own = instance == labels.id_map.get(OWN_BOX_ID, -1)
    if own.any():
        x, y = _cell_centers(labels)
        ax.contour(x, y, own, levels=(0.5,), colors=OWN_COLOR, linewidths=1.2)


def draw_flow_arrows(maps: dict[str, AnyArray], labels: MotionLabels, ax: Axes) -> None:
    """An arrow from the middle of each instance's cells to where its flow takes it; a dot where it stays."""
    known = _known(maps, "flow")
    row, column = np.nonzero(known)
    ids, first, member, cells = np.unique(
        maps["instance"][known], return_index=True, return_inverse=True, return_counts=True
    )
    if not len(ids):
        return
    x, y = (centers[index] for centers, index in zip(_cell_centers(labels), (column, row), strict=True))
    start = [np.bincount(member.ravel(), weights=values) / cells for values in (x, y)]
    down, along = maps["flow"][:, known][:, first]  # the same on all cells of an instance
    size_x, size_y = labels.config.grid.x[2], labels.config.grid.y[2]
    ax.quiver(*start, along * size_x, down * size_y, angles="xy", scale_units="xy", scale=1, width=0.008)


def instance_colors(labels: MotionLabels, marked: Collection[int]) -> FloatArray:
    """(1 + ids, 3) white for the background, a colour of the palette for each id, red and green for some actors."""
    from matplotlib import colormaps
    from matplotlib.colors import to_rgb

    highest = max([int(labels.instance[labels.label_valid].max(initial=0)), *labels.id_map.values()])
    palette = colormaps["tab20"]
    colors = np.array([palette(_PALETTE[number % len(_PALETTE)])[:3] for number in range(1 + highest)])
    colors[0] = 1.0
    for actor, identity in labels.id_map.items():
        own = actor == OWN_BOX_ID
        if (OWN_ACTOR_ID if own else actor) in marked:
            colors[identity] = to_rgb(COLLIDER_COLOR)
        elif own:
            colors[identity] = to_rgb(OWN_COLOR)
    return colors
