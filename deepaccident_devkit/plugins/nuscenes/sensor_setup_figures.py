"""The picture of rigs: what the cameras of a source see from above, and which classes its boxes have."""

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
    """A panel for each source, x forward and up, and one with the classes of all."""
    count = len(report.sources)
    fig = report_figure((3.4 * count + 3.2, 3.6))
    *views, classes = fig.subplots(1, count + 1)
    for ax, source in zip(views, report.sources, strict=True):
        _draw_cameras(ax, source)
    names = list(report.sources[0].shares)
    for number, source in enumerate(report.sources):
        place = np.arange(len(names)) + (number - (count - 1) / 2) * 0.8 / count
        color = SERIES_COLORS[number]
        classes.barh(
            place,
            [source.shares[name] * 100 for name in names],
            0.8 / count,
            color=color,
            label=source.name,
        )
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

    for number, each in enumerate(source.cameras):
        middle, half = 90 + each.looks, each.field_of_view / 2
        color = SERIES_COLORS[number % len(SERIES_COLORS)]
        ax.add_patch(
            Wedge(
                (0, 0), 1, middle - half, middle + half, facecolor=color, alpha=0.3, edgecolor=color
            )
        )
        angle = np.radians(middle)
        words = (
            f"{each.camera.removeprefix('Camera_')}\n{each.field_of_view:.0f}°, {each.above:.1f} m"
        )
        ax.text(
            0.72 * np.cos(angle),
            0.72 * np.sin(angle),
            words,
            ha="center",
            va="center",
            fontsize=text_size(),
        )
    ax.set(xlim=(-1.15, 1.15), ylim=(-1.15, 1.15), xticks=[], yticks=[], aspect="equal")
    lidar = f"LiDAR {source.lidar_above:.1f} m" + (
        f", {source.lanes} lanes" if source.lanes else ""
    )
    ax.set_title(source.name)
    ax.set_xlabel(f"{lidar}\n{source.labels_a_second:g} labels a second", color=MUTED_COLOR)
    for edge in ax.spines.values():
        edge.set_visible(False)
