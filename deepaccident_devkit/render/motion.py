"""Motion labels and predictions as pictures: maps by frame, or all frames as a fading trail."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import TYPE_CHECKING, Final, Literal, get_args

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.evaluation.predictions import MotionOutput
from deepaccident_devkit.motion import (
    MotionLabelConfig,
    MotionLabels,
    PostProcessing,
    motion_labels,
)
from deepaccident_devkit.render.boxes import collider_ids, recorder_ids
from deepaccident_devkit.render.captions import draw_legend, set_scene_title
from deepaccident_devkit.render.figures import Layer, axes_or_new, figure_or_new, layers_of, settled
from deepaccident_devkit.render.motion_maps import (
    DRAWN_MAPS,
    DrawnMap,
    MotionMaps,
    draw_key,
    draw_map_of,
    draw_trail_of,
    instance_handles,
    maps_of_labels,
    maps_of_output,
)
from deepaccident_devkit.render.styles import current_style, in_own_settings
from deepaccident_devkit.support.text import choice

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# `maps`: one panel for each map and frame; `trail`: one panel, the present opaque and later frames
# paler.
MotionStyle = Literal["maps", "trail"]
_MAP_LAYERS: Final[tuple[Layer, ...]] = ("labels", "velocities", "ids", "grid")
TRAIL_LAYERS: Final[tuple[Layer, ...]] = ("labels", "trajectories", "ids", "grid")
_DEFAULT_LAYERS: Final[dict[MotionStyle, tuple[Layer, ...]]] = {
    "maps": ("labels", "velocities"),
    "trail": ("labels", "trajectories"),
}
_LAYERS_OF_STYLE: Final[dict[MotionStyle, tuple[Layer, ...]]] = {
    "maps": _MAP_LAYERS,
    "trail": TRAIL_LAYERS,
}
# Maps of a small picture.
_MAIN_MAPS: Final = ("instance", "flow")
# Number of frames of maps in a small picture.
_FRAME_COUNTS: Final = {"column": 1, "page": 3, "slide": 3}
# Width of the column that explains the colours, in widths of a panel.
_KEY_WIDTH_RATIO: Final = 0.5


@in_own_settings
def render_motion_labels(
    dataset: Dataset,
    sample: RowArgument,
    config: MotionLabelConfig | None = None,
    *,
    at_present: bool = True,
    style: MotionStyle | None = None,
    layers: Iterable[Layer] | None = None,
    fig: Figure | None = None,
) -> Figure:
    """Render a sample's motion labels: instances, centerness, offset and flow of each frame.

    There is one column for each frame. In a paper or on a slide, maps are the instances and the
    flow of at most three of the frames that have a flow.

    Args:
        dataset: The release.
        sample: Token or record.
        config: Configuration of the labels; None for the released ones.
        at_present: Whether to warp all frames to the present ego frame; if False, each is in its
            own.
        style: `maps`, or `trail` for one panel with all frames, later ones paler, and the actors'
            paths; None is for maps, or in a paper or on a slide for a trail.
        layers: For maps `labels` (the cells) and `velocities` (the arrows of the flow),
            which are the default, `ids` and `grid`; for a trail `trajectories` instead of
            `velocities`.
        fig: Empty figure to render on; a new one if None.

    Returns:
        The figure; `draw_motion_map` and `draw_motion_trail` explain it.

    Raises:
        TokenError: No such sample.
        NotAvailableError: The sample has no label.
        ChoiceError: No such style or layer, or a trail of frames that are not at the present.
    """
    if not style:
        style = "trail" if current_style().few and at_present else "maps"
    labels = motion_labels(dataset, sample, config)
    if at_present:
        labels = labels.to_present()
    pair, agents = collider_ids(dataset, sample), recorder_ids(dataset, sample)
    fig = draw_motion_labels(
        labels, marked=pair, agents=agents, style=style, layers=layers, fig=fig
    )
    set_scene_title(fig, dataset, dataset.get("sample", sample)["token"], "motion labels")
    if style == "trail":
        return settled(fig)
    return fig


@in_own_settings
def draw_motion_labels(
    labels: MotionLabels,
    *,
    marked: Collection[int] = (),
    agents: Mapping[int, str] | None = None,
    style: MotionStyle = "maps",
    layers: Iterable[Layer] | None = None,
    fig: Figure | None = None,
) -> Figure:
    """Render labels as `render_motion_labels` does, with red for some actors.

    Args:
        labels: Labels, warped to the present or not; they are rendered as they are.
        marked: Label ids of the red actors; the ego itself is −100.
        agents: Label id → agent, for recording vehicles; they have their agents' hues.
        style: `maps` or `trail`.
        layers: Layers, as in `render_motion_labels`.
        fig: Empty figure to render on; a new one if None.

    Returns:
        The figure.

    Raises:
        ChoiceError: No such style or layer, or a trail of frames that are not at the present.
    """
    return _draw(maps_of_labels(labels, marked, agents), style, layers, fig)


@in_own_settings
def draw_motion_output(
    output: MotionOutput,
    *,
    number: int = -1,
    step: float = 0.5,
    post_processing: PostProcessing | str = "motion",
    marked: Collection[int] = (),
    style: MotionStyle = "maps",
    layers: Iterable[Layer] | None = None,
    fig: Figure | None = None,
) -> Figure:
    """Render a prediction as `draw_motion_labels` renders labels.

    Instance maps have only the instances.

    Args:
        output: Output in the present ego frame, in any orientation.
        number: Number of one of its K predictions, from 0 or from the end.
        step: Seconds from frame to frame.
        post_processing: Search for instances in heads: a name in `POST_PROCESSING`, or your own.
        marked: Ids of red instances.
        style: `maps` or `trail`.
        layers: Layers, as in `render_motion_labels`.
        fig: Empty figure to render on; a new one if None.

    Returns:
        The figure.

    Raises:
        ChoiceError: No such prediction, post-processing, style or layer.
    """
    maps = maps_of_output(
        output, number=number, step=step, marked=marked, post_processing=post_processing
    )
    return _draw(maps, style, layers, fig)


@in_own_settings
def draw_motion_map(
    labels: MotionLabels | MotionOutput,
    name: DrawnMap,
    frame: int,
    *,
    marked: Collection[int] = (),
    layers: Iterable[Layer] | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Render one map of one label frame, in metres of its ego frame: forward to the right, left up.

    Each instance has one colour in all frames; `marked` ones are red. The ego's own box has a dark
    edge, and is dark if it is not marked. Colours of offset and flow are directions, paler for
    shorter vectors; each map has its own scale. Each instance has an arrow along its flow, or a dot
    if it stays. A frame beyond the recording is grey.

    Args:
        labels: Labels, warped to the present or not; or an output, with its last prediction
            rendered.
        name: Name of the map.
        frame: Number of the frame, 0 for the present.
        marked: Label ids of actors, the ego's own is −100; for a prediction, ids of instances.
        layers: `labels` and `velocities`, which are the default, `ids` and `grid`.
        ax: Axes to render on; new ones if None.

    Returns:
        The axes.

    Raises:
        ChoiceError: No such map, frame or layer.
    """
    name = choice("map", name, DRAWN_MAPS)
    maps = _maps(labels, marked)
    shown_layers = layers_of(layers, _DEFAULT_LAYERS["maps"], _MAP_LAYERS)
    if frame not in range(len(maps.valid)):
        raise ChoiceError(f"frame: expected 0 to {len(maps.valid) - 1}, found {frame!r}")
    return draw_map_of(maps, name, frame, shown_layers, axes_or_new(ax))


@in_own_settings
def draw_motion_trail(
    labels: MotionLabels | MotionOutput,
    *,
    marked: Collection[int] = (),
    layers: Iterable[Layer] | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Render all frames over each other, later ones paler, and the actors' paths.

    The present is opaque and on top.

    Args:
        labels: Labels, warped to the present; or an output, with its last prediction rendered.
        marked: Ids, as in `draw_motion_map`.
        layers: `labels` (the cells) and `trajectories` (from centre to centre), which are the
            default, `ids`, `grid`.
        ax: Axes to render on; new ones if None.

    Returns:
        The axes, in metres of the present ego frame.

    Raises:
        ChoiceError: No such layer, or the frames are not at the present.
    """
    maps = _maps(labels, marked)
    shown_layers = layers_of(layers, _DEFAULT_LAYERS["trail"], TRAIL_LAYERS)
    return draw_trail_of(_at_present(maps), shown_layers, axes_or_new(ax))


def _maps(motion: MotionLabels | MotionOutput, marked: Collection[int]) -> MotionMaps:
    if isinstance(motion, MotionOutput):
        return maps_of_output(motion, marked=marked)
    return maps_of_labels(motion, marked)


def _at_present(maps: MotionMaps) -> MotionMaps:
    if not maps.at_present:
        raise ChoiceError(
            "trail: each frame is in its own ego frame; warp the labels with to_present() first"
        )
    return maps


def _draw(
    maps: MotionMaps, style: MotionStyle, layers: Iterable[Layer] | None, fig: Figure | None
) -> Figure:
    style = choice("style", style, get_args(MotionStyle))
    shown_layers = layers_of(layers, _DEFAULT_LAYERS[style], _LAYERS_OF_STYLE[style])
    if style == "maps":
        return _draw_maps(maps, shown_layers, fig)
    trail = _at_present(maps)
    fig = figure_or_new(fig, (6.4, 6.8), panels="one", page=1.12, column=1.12)
    draw_trail_of(trail, shown_layers, fig.subplots())
    draw_legend(fig, instance_handles(trail))
    return fig


def _draw_maps(maps: MotionMaps, layers: frozenset[Layer], fig: Figure | None) -> Figure:
    names, frames = maps.names, list(range(len(maps.valid)))
    if current_style().few:
        names = tuple(name for name in names if name in _MAIN_MAPS)
        frames = _main_frames(maps)
    columns, rows = len(frames), len(names)
    fig = figure_or_new(
        fig,
        (2.8 * (columns + _KEY_WIDTH_RATIO) + 0.6, 2.8 * rows + 1.3),
        page=0.3 * rows + 0.06,
        column=0.57 * rows + 0.1,
    )
    width_ratios = (*[1.0] * columns, _KEY_WIDTH_RATIO)
    axes = fig.subplots(rows, columns + 1, squeeze=False, width_ratios=width_ratios)
    panels = axes[:, :columns]
    for row, name in enumerate(names):
        for ax, frame in zip(panels[row], frames, strict=True):
            draw_map_of(maps, name, frame, layers, ax)
        panels[row, 0].set_ylabel(f"{name}\ny left (m)")
        draw_key(maps, name, axes[row, columns])
    for ax, frame in zip(panels[0], frames, strict=True):
        ax.set_title(f"+{frame * maps.step:.1f} s" if frame else "present")
    for ax in panels.flat:
        if ax is not panels[0, 0]:
            ax.sharex(panels[0, 0])
            ax.sharey(panels[0, 0])
        ax.label_outer()
    ego_frame = "the present ego frame" if maps.at_present else "each frame's own ego frame"
    fig.supxlabel(f"x forward (m), in {ego_frame}", fontsize="medium")
    return fig


def _main_frames(maps: MotionMaps) -> list[int]:
    """Return the frames of a small picture, spread evenly over the frames that have a flow."""
    present = np.flatnonzero(maps.valid)
    with_flow = present[: max(1, len(present) - 1)]  # the last frame has no flow
    count = _FRAME_COUNTS[current_style().room]
    rows = np.linspace(0, len(with_flow) - 1, count).round().astype(int)
    frames: list[int] = np.unique(with_flow[rows]).tolist()
    return frames
