"""The figure of sensor setups: what cameras see from above, and the classes of the boxes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from deepaccident_devkit.plugins.nuscenes.sensor_setups import SensorSetupFacts, SensorSetupReport
from deepaccident_devkit.render.boxes import camera_name
from deepaccident_devkit.render.captions import BELOW, draw_legend, set_title
from deepaccident_devkit.render.figures import figure_or_new, with_light_grid
from deepaccident_devkit.render.styles import (
    MUTED_COLOR,
    SERIES_COLORS,
    current_style,
    in_own_settings,
    text_size,
)
from deepaccident_devkit.support.human_names import human_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Width of a panel in a notebook, inches.
_PANEL_WIDTH_IN = 3.6
# Minimum heights of the views and of the classes, with their words, in lines of letters.
_VIEW_LINES = 19
_CLASS_LINES = 17


@in_own_settings
def sensor_setups_figure(report: SensorSetupReport) -> Figure:
    """Draw what the cameras of each source see, x forward and up, and the classes of all boxes."""
    count = len(report.sources)
    size = (_PANEL_WIDTH_IN * (count + 1), _PANEL_WIDTH_IN)
    views: list[Any] = list(range(count))
    if current_style().layout == "column":
        fig = figure_or_new(None, size, lines=_VIEW_LINES + _CLASS_LINES)
        ratios = (_VIEW_LINES, _CLASS_LINES)
        axes = fig.subplot_mosaic([views, [count] * count], height_ratios=ratios)
    else:
        fig = figure_or_new(None, size, lines=_VIEW_LINES)
        axes = fig.subplot_mosaic([[*views, count]])
    for view, source in enumerate(report.sources):
        _draw_cameras(axes[view], source)
    _draw_classes(axes[count], report)
    return fig


def _draw_classes(classes: Axes, report: SensorSetupReport) -> None:
    """Draw the share of each class of boxes in each source as a bar."""
    count = len(report.sources)
    names = [name for name in report.sources[0].shares if _is_in_any(report, name)]
    height = 0.8 / count
    for number, source in enumerate(report.sources):
        offset = (number - (count - 1) / 2) * 0.8 / count
        percents = [source.shares[name] * 100 for name in names]
        classes.barh(
            np.arange(len(names)) + offset,
            percents,
            height,
            color=SERIES_COLORS[number],
            label=source.name,
        )
    classes.set_yticks(range(len(names)), map(human_name, names), fontsize=text_size())
    classes.invert_yaxis()
    classes.set_xlabel("share of the boxes (%)")
    set_title(classes, "Classes of the boxes")
    with_light_grid(classes, "x")
    if count > 1:
        handles, _ = classes.get_legend_handles_labels()
        draw_legend(classes, handles, **BELOW)


def _is_in_any(report: SensorSetupReport, name: str) -> bool:
    """Return whether any source has boxes of a class."""
    return any(source.shares[name] for source in report.sources)


def _draw_cameras(ax: Axes, source: SensorSetupFacts) -> None:
    """Draw each camera's field of view from above, and write the sensors' heights below."""
    from matplotlib.patches import Wedge

    for number, camera in enumerate(source.cameras):
        middle = 90 + camera.looks
        start = middle - camera.field_of_view / 2
        end = middle + camera.field_of_view / 2
        color = SERIES_COLORS[number % len(SERIES_COLORS)]
        wedge = Wedge((0, 0), 1, start, end, facecolor=color, alpha=0.3, edgecolor=color)
        ax.add_patch(wedge)
        angle = np.radians(middle)
        x = 0.72 * np.cos(angle)
        y = 0.72 * np.sin(angle)
        name = camera_name(camera.camera).replace(" ", "\n")
        text = f"{name}\n{camera.field_of_view:.0f}°"
        ax.text(x, y, text, ha="center", va="center", fontsize=text_size())
    ax.set(xlim=(-1.15, 1.15), ylim=(-1.15, 1.15), xticks=[], yticks=[], aspect="equal")
    heights = [camera.above for camera in source.cameras]
    ends = dict.fromkeys(f"{height:.1f}" for height in (min(heights), max(heights)))
    lines = [
        f"cameras at {' to '.join(ends)} m",
        f"LiDAR at {source.lidar_above:.1f} m",
        f"labels at {source.labels_a_second:g} Hz",
    ]
    if source.lanes:
        lines.insert(2, f"LiDAR with {source.lanes} channels")
    set_title(ax, source.name)
    ax.set_xlabel("\n".join(lines), color=MUTED_COLOR, fontsize=text_size())
    for spine in ax.spines.values():
        spine.set_visible(False)
