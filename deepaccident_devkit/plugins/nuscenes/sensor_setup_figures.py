"""The figure of sensor setups: what cameras see from above, and the classes of the boxes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from deepaccident_devkit.plugins.nuscenes.sensor_setups import SensorSetupFacts, SensorSetupReport
from deepaccident_devkit.render.figures import report_figure, with_light_grid
from deepaccident_devkit.render.styles import MUTED_COLOR, SERIES_COLORS, in_own_settings, text_size

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@in_own_settings
def sensor_setups_figure(report: SensorSetupReport) -> Figure:
    """Draw a panel for each source, x forward and up, and one with the classes of all."""
    count = len(report.sources)
    fig = report_figure((3.4 * count + 3.2, 3.6))
    *views, classes = fig.subplots(1, count + 1)
    for ax, source in zip(views, report.sources, strict=True):
        _draw_cameras(ax, source)
    names = list(report.sources[0].shares)
    height = 0.8 / count
    for number, source in enumerate(report.sources):
        position = np.arange(len(names)) + (number - (count - 1) / 2) * 0.8 / count
        percents = [source.shares[name] * 100 for name in names]
        color = SERIES_COLORS[number]
        classes.barh(position, percents, height, color=color, label=source.name)
    classes.set_yticks(range(len(names)), names)
    classes.invert_yaxis()
    classes.set_xlabel("share of the boxes (%)")
    classes.set_title("classes")
    with_light_grid(classes, "x")
    if count > 1:
        classes.legend(fontsize=text_size())
    return fig


def _draw_cameras(ax: Axes, source: SensorSetupFacts) -> None:
    from matplotlib.patches import Wedge

    for number, camera in enumerate(source.cameras):
        middle, half = 90 + camera.looks, camera.field_of_view / 2
        color = SERIES_COLORS[number % len(SERIES_COLORS)]
        wedge = Wedge(
            (0, 0), 1, middle - half, middle + half, facecolor=color, alpha=0.3, edgecolor=color
        )
        ax.add_patch(wedge)
        angle = np.radians(middle)
        x, y = 0.72 * np.cos(angle), 0.72 * np.sin(angle)
        name = camera.camera.removeprefix("Camera_")
        text = f"{name}\n{camera.field_of_view:.0f}°, {camera.above:.1f} m"
        ax.text(x, y, text, ha="center", va="center", fontsize=text_size())
    ax.set(xlim=(-1.15, 1.15), ylim=(-1.15, 1.15), xticks=[], yticks=[], aspect="equal")
    lidar = f"LiDAR {source.lidar_above:.1f} m"
    if source.lanes:
        lidar += f", {source.lanes} lanes"
    ax.set_title(source.name)
    ax.set_xlabel(f"{lidar}\n{source.labels_a_second:g} labels a second", color=MUTED_COLOR)
    for spine in ax.spines.values():
        spine.set_visible(False)
