"""Motion labels and predictions as pictures: maps of each frame, or all frames as a trail."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from functools import partial
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
from deepaccident_devkit.render.bev import draw_road
from deepaccident_devkit.render.boxes import collider_ids, recorder_ids
from deepaccident_devkit.render.captions import draw_legend, set_scene_title
from deepaccident_devkit.render.figures import (
    Layer,
    Layers,
    axes_or_new,
    figure_or_new,
    lay_out_figure,
    layers_of,
)
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
    trail_handles,
)
from deepaccident_devkit.render.styles import EMPTY_ROAD_COLORS, current_style, in_own_settings
from deepaccident_devkit.support.text import choice

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# `maps`: one panel for each map and frame; `trail`: one panel, in which the current frame is opaque
# and later frames are paler.
MotionStyle = Literal["maps", "trail"]
_MAP_LAYERS: Layers = ("labels", "velocities", "ids", "grid")
TRAIL_LAYERS: Final[Layers] = ("labels", "trajectories", "ids", "grid")
_DEFAULT_LAYERS: dict[MotionStyle, Layers] = {
    "maps": ("labels", "velocities"),
    "trail": ("labels", "trajectories"),
}
_LAYERS_OF_STYLE: dict[MotionStyle, Layers] = {
    "maps": _MAP_LAYERS,
    "trail": TRAIL_LAYERS,
}
_RoadDrawer = Callable[[Sequence["Axes"]], None]
# Maps that a small picture shows.
_MAIN_MAPS = ("instance", "flow")
# Number of frames in a small picture, for each `room` of a style.
_FRAME_COUNTS = {"column": 1, "page": 3, "slide": 3}
# Width of the column that explains the colours, over the width of a panel.
_KEY_WIDTH_RATIO = 0.5


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

    There is one column for each frame. A paper or slide only shows the instances and the flow, in
    at most three of the frames that have a flow.

    Args:
        dataset: The release.
        sample: Token or record.
        config: Configuration of the labels; None for the released ones.
        at_present: Whether to warp all frames to the ego frame at t = 0; if False, each is in the
            ego frame of its own time.
        style: `maps`, or `trail` for one panel with all frames, later ones paler, and the actors'
            paths. None means `trail` in a paper or on a slide, otherwise `maps`.
        layers: Any of `bev` (the road beneath instances at t = 0, if a BEV camera's picture or a
            town map is present), `labels` (the cells), `velocities` (the arrows of the flow),
            `ids` and `grid`; a trail has `trajectories` instead of `velocities`. Default: the first
            three.
        fig: Empty figure to render on; a new one if None.

    Returns:
        The figure; `draw_motion_map` and `draw_motion_trail` explain it.

    Raises:
        TokenError: No such sample.
        NotAvailableError: The sample has no label.
        ChoiceError: No such style or layer, or a trail of frames that are not warped to t = 0.
    """
    if not style:
        style = "trail" if current_style().shows_few_panels and at_present else "maps"
    labels = motion_labels(dataset, sample, config)
    if at_present:
        labels = labels.to_present()
    pair = collider_ids(dataset, sample)
    agents = recorder_ids(dataset, sample)
    record = dataset.get("sample", sample)
    draw_road_beneath = partial(
        draw_road,
        dataset,
        record["frame_token"],
        target_from_world=dataset.world_from(record, "ego").inverse(),
        colors=EMPTY_ROAD_COLORS,
    )
    maps = maps_of_labels(labels, pair, agents)
    fig = _draw(maps, style, layers, fig, draw_road_beneath)
    set_scene_title(fig, dataset, record["token"], "motion labels")
    if style == "trail":
        return lay_out_figure(fig)
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
    """Render labels as `render_motion_labels` does, with some actors in red.

    Args:
        labels: Labels, warped to t = 0 or not; they are rendered as they are.
        marked: Label ids of the actors to draw in red; the ego itself is −100.
        agents: Agent by label id, for recording vehicles, which get their agents' hues.
        style: `maps` or `trail`.
        layers: Layers, as in `render_motion_labels`.
        fig: Empty figure to render on; a new one if None.

    Returns:
        The figure.

    Raises:
        ChoiceError: No such style or layer, or a trail of frames that are not warped to t = 0.
    """
    maps = maps_of_labels(labels, marked, agents)
    return _draw(maps, style, layers, fig)


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

    Outputs stored as instance maps show only the instance layer.

    Args:
        output: Output in the ego frame at t = 0, in any orientation.
        number: Index of the prediction, 0..K−1; negative counts from the end.
        step: Seconds from frame to frame.
        post_processing: How instances are extracted from the heads: a name in `POST_PROCESSING`, or
            your own.
        marked: Ids of the instances to draw in red.
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
    edge, and is dark if it is not marked. For offset and flow, the hue shows a vector's direction,
    and shorter vectors are paler; each map has its own scale. Each instance has an arrow along its
    flow, or a dot if it stands still. A frame outside the recording is grey.

    Args:
        labels: Labels, warped to t = 0 or not; or an output, of which the last prediction is
            rendered.
        name: Name of the map.
        frame: Index of the frame; 0 is the current one.
        marked: Label ids of actors (the ego itself is −100); for an output, ids of instances.
        layers: Any of `labels`, `velocities`, `ids`, `grid`; default: the first two.
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
    """Render all frames on top of each other, later ones paler, and the actors' paths.

    The current frame is opaque and on top.

    Args:
        labels: Labels, warped to t = 0; or an output (its last prediction is rendered).
        marked: Ids, as in `draw_motion_map`.
        layers: Any of `labels` (cells), `trajectories` (centre to centre), `ids`, `grid`; default:
            the first two.
        ax: Axes to render on; new ones if None.

    Returns:
        The axes, in metres, in the ego frame at t = 0.

    Raises:
        ChoiceError: No such layer, or the frames are not warped to t = 0.
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
    maps: MotionMaps,
    style: MotionStyle,
    layers: Iterable[Layer] | None,
    fig: Figure | None,
    draw_road_beneath: _RoadDrawer | None = None,
) -> Figure:
    style = choice("style", style, get_args(MotionStyle))
    road_layers: Layers = () if draw_road_beneath is None else ("bev",)
    default_layers = (*road_layers, *_DEFAULT_LAYERS[style])
    possible_layers = (*road_layers, *_LAYERS_OF_STYLE[style])
    shown_layers = layers_of(layers, default_layers, possible_layers)
    if "bev" not in shown_layers or not maps.at_present:
        draw_road_beneath = None
    if style == "maps":
        return _draw_maps(maps, shown_layers, fig, draw_road_beneath)
    trail = _at_present(maps)
    # a narrow map is as wide as its column, above a legend of three rows
    page_height = 0.6 if current_style().is_wide else 1.2
    fig = figure_or_new(fig, (6.4, 6.8), panels="one", page=page_height, column=1.2)
    ax = draw_trail_of(trail, shown_layers, fig.subplots())
    if draw_road_beneath is not None:
        draw_road_beneath([ax])
    draw_legend(fig, [*instance_handles(trail), *trail_handles(trail, shown_layers)])
    return fig


def _draw_maps(
    maps: MotionMaps,
    layers: frozenset[Layer],
    fig: Figure | None,
    draw_road_beneath: _RoadDrawer | None,
) -> Figure:
    names = maps.names
    frames = list(range(len(maps.valid)))
    if current_style().shows_few_panels:
        names = tuple(name for name in names if name in _MAIN_MAPS)
        frames = _main_frames(maps)
    columns = len(frames)
    rows = len(names)
    width = 2.8 * (columns + _KEY_WIDTH_RATIO) + 0.6
    height = 2.8 * rows + 1.3
    fig = figure_or_new(
        fig,
        (width, height),
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
    if draw_road_beneath is not None:
        # offset and flow have white ground, because their pale shades have a meaning
        recorded = maps.valid[frames]
        draw_road_beneath(panels[0, recorded].tolist())
    for ax, frame in zip(panels[0], frames, strict=True):
        ax.set_title(f"+{frame * maps.step:.1f} s" if frame else "present")
    for ax in panels.flat:
        if ax is not panels[0, 0]:
            ax.sharex(panels[0, 0])
            ax.sharey(panels[0, 0])
        ax.label_outer()
    ego_frame = "each frame's own ego frame"
    if maps.at_present:
        ego_frame = "the present ego frame"
    fig.supxlabel(f"x forward (m), in {ego_frame}", fontsize="medium")
    return fig


def _main_frames(maps: MotionMaps) -> list[int]:
    """Select the frames for a small picture, spread evenly over the frames that have a flow."""
    recorded = np.flatnonzero(maps.valid)
    flow_frames = recorded[:-1]  # the last frame has no flow
    if len(recorded) == 1:
        flow_frames = recorded
    count = _FRAME_COUNTS[current_style().layout]
    indices = np.linspace(0, len(flow_frames) - 1, count).round().astype(int)
    frames: list[int] = np.unique(flow_frames[indices]).tolist()
    return frames
