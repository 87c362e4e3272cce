"""Figures of a release's statistics: one for each group of panels, and their files."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal, get_args

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.files import path_of
from deepaccident_devkit.render.axes import detached_figure, figure_or_new
from deepaccident_devkit.render.chips import SMALLEST_TEXT
from deepaccident_devkit.render.colors import SPLIT_COLORS
from deepaccident_devkit.render.pictures import write_figure
from deepaccident_devkit.render.statistics_panels import (
    draw_quantile_boxes,
    render_angles,
    render_counts,
    render_histogram,
    render_quantiles,
    render_relative_positions,
)
from deepaccident_devkit.render.styles import in_own_settings
from deepaccident_devkit.statistics import GROUPS, DatasetStatistics
from deepaccident_devkit.text import choice

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PictureFormat = Literal["png", "pdf"]

_DPI = 120


def _scenarios(statistics: DatasetStatistics, fig: Figure) -> None:
    rows = [
        ("weathers", "weather_frames"),
        ("times_of_day", "time_of_day_frames"),
        ("scenario_types", "towns"),
        ("road_types", "collisions"),
    ]
    heights = [2 + max(len(statistics.counts[name].counts) for name in row) for row in rows]
    axes = fig.subplot_mosaic([list(row) for row in rows], height_ratios=heights)
    for name, ax in axes.items():
        render_counts(statistics.counts[name], ax=ax)


def _ends(statistics: DatasetStatistics, fig: Figure) -> None:
    axes = fig.subplots(1, 2, width_ratios=(3, 2))
    render_counts(statistics.counts["ends"], ax=axes[0])
    axes[0].set_xlabel("scenarios (designs 1–6: at traffic lights, 7–12: without)")
    render_histogram(statistics.histograms["lengths"], ax=axes[1])


def _ego(statistics: DatasetStatistics, fig: Figure) -> None:
    axes = fig.subplots(1, 2, width_ratios=(3, 2))
    render_histogram(statistics.histograms["ego_speeds"], ax=axes[0])
    sizes = statistics.quantiles["ego_sizes"]
    rows = [row for row in sizes.quantiles if row.group == GROUPS[0] and row.values]
    draw_quantile_boxes({row.field: row for row in rows}, axes[1])
    axes[1].set(ylabel=f"size ({sizes.unit})", title=sizes.title, ylim=(0, None))


def _actors(statistics: DatasetStatistics, fig: Figure) -> None:
    axes = fig.subplots(2, 2)
    for name, ax in zip(("instances", "parked_instances", "annotations"), axes.flat, strict=False):
        render_counts(statistics.counts[name], ax=ax)
    render_histogram(statistics.histograms["actors"], ax=axes[1, 1])


def _boxes(statistics: DatasetStatistics, fig: Figure) -> None:
    axes = fig.subplot_mosaic([["length", "width"], ["height", "."]])
    for field, ax in axes.items():
        render_quantiles(statistics.quantiles["box_sizes"], field, ax=ax)


def _motion(statistics: DatasetStatistics, fig: Figure) -> None:
    axes = fig.subplots(2, 2, width_ratios=(4, 5))
    for row, (name, field) in enumerate((("distances", "distance"), ("speeds", "speed"))):
        render_histogram(statistics.histograms[name], ax=axes[row, 0])
        render_quantiles(statistics.quantiles[f"{field}_quantiles"], field, ax=axes[row, 1])


def _collisions(statistics: DatasetStatistics, fig: Figure) -> None:
    fig.suptitle("The colliding pair at the last frame: the other actor, seen from the first")
    angles = fig.add_subplot(1, 3, 1, projection="polar")
    bearings = fig.add_subplot(1, 3, 2, projection="polar")
    render_angles(statistics.histograms["collision_angles"], ax=angles)
    render_angles(statistics.histograms["collision_bearings"], ax=bearings)
    headings = "collisions by the other's heading: 0° the same,\n90° to the left, 180° head-on, 270° to the right"
    angles.set_xlabel(headings, fontsize=SMALLEST_TEXT)
    bearings.set_xlabel("collisions by where the other is:\n0° ahead, 90° left, 270° right", fontsize=SMALLEST_TEXT)
    render_relative_positions(statistics.collisions, ax=fig.add_subplot(1, 3, 3))


_Draw = Callable[[DatasetStatistics, "Figure"], None]
_WIDTH: Final = 10.7
"""Inches of a page of A4 in landscape."""
_FIGURES: Mapping[str, tuple[tuple[float, float], _Draw]] = {
    "scenarios": ((_WIDTH, 10.5), _scenarios),
    "ends": ((_WIDTH, 5.5), _ends),
    "ego": ((_WIDTH, 4.5), _ego),
    "actors": ((_WIDTH, 7.5), _actors),
    "boxes": ((_WIDTH, 7.5), _boxes),
    "motion": ((_WIDTH, 8), _motion),
    "collisions": ((_WIDTH, 5.2), _collisions),
}
STATISTICS_FIGURES: Final[Mapping[str, tuple[float, float]]] = {group: size for group, (size, _) in _FIGURES.items()}
"""The groups that `render_statistics` renders → width and height of their figures in inches."""


@in_own_settings
def render_statistics(statistics: DatasetStatistics, group: str, *, fig: Figure | None = None) -> Figure:
    """Render one group of statistics, coloured by split.

    Args:
        statistics: of `dataset_statistics`.
        group: one of `STATISTICS_FIGURES`.
        fig: an empty figure to render on; a new one if None.

    Returns:
        The figure.

    Raises:
        ChoiceError: no such group.
    """
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    size, draw = _FIGURES[choice("group", group, _FIGURES)]
    fig = figure_or_new(fig, size)
    engine = fig.get_layout_engine()
    if isinstance(engine, ConstrainedLayoutEngine):
        engine.set(w_pad=0.12, h_pad=0.12)
    draw(statistics, fig)
    handles = {}
    for ax in fig.axes:
        handles.update({label: handle for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)})
    shown = [name for name in SPLIT_COLORS if name in handles]
    if shown:
        chosen = [handles[name] for name in shown]
        fig.legend(chosen, shown, loc="outside lower center", ncols=len(shown), title="split", fontsize=SMALLEST_TEXT)
    return fig


def save_statistics(
    statistics: DatasetStatistics,
    folder: str | os.PathLike[str],
    formats: Sequence[PictureFormat] = ("png", "pdf"),
) -> list[Path]:
    """Render all groups of statistics into files `<group>.<format>`, each atomically; earlier ones are replaced.

    Args:
        statistics: of `dataset_statistics`.
        folder: where; it is made if it is not there.
        formats: of the files, one or more of `png` and `pdf`.

    Returns:
        The files' paths.

    Raises:
        ChoiceError: no such format.
        ConfigError: `folder` is a file.
    """
    folder, formats = path_of(folder), [choice("formats", name, get_args(PictureFormat)) for name in formats]
    if folder.exists() and not folder.is_dir():
        raise ConfigError(f"{folder}: is a file; give a folder")
    paths = []
    for group, (size, _) in _FIGURES.items():
        figure = render_statistics(statistics, group, fig=detached_figure(size))
        for name in [name for name in get_args(PictureFormat) if name in formats]:  # one order: the same bytes
            paths += [write_figure(figure, folder / f"{group}.{name}", dpi=_DPI)]
    return paths
