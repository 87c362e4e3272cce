"""Figures of a release's statistics, their panels (one for each table), and their files."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from math import radians
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.render.captions import draw_legend
from deepaccident_devkit.render.figures import (
    detached_figure,
    figure_or_new,
    with_light_grid,
    write_figure,
)
from deepaccident_devkit.render.styles import (
    CATEGORY_COLORS,
    CATEGORY_MARKERS,
    COLLIDER_COLOR,
    GRID_COLOR,
    SPLIT_COLORS,
    in_own_settings,
    text_size,
)
from deepaccident_devkit.statistics import (
    GROUPS,
    PROBABILITIES,
    CollisionPair,
    CountTable,
    DatasetStatistics,
    Histogram,
    QuantileRow,
    QuantileTable,
)
from deepaccident_devkit.support.files import writable_folder
from deepaccident_devkit.support.text import choice
from deepaccident_devkit.taxonomy import CATEGORIES

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

_DPI = 120
# Percents: a smaller share has no number.
_LEAST_SHARE: Final = 0.1
_Draw = Callable[[DatasetStatistics, "Figure"], None]
# Inches of a page of A4 in landscape.
_WIDTH: Final = 10.7


def draw_counts(table: CountTable, ax: Axes) -> Axes:
    """Render a table of counts as horizontal bars, the splits one after the other, each with its sum and share."""
    values, whole = list(table.counts), table.total()
    starts = [0] * len(values)
    for group in GROUPS[1:]:
        widths = [table.counts[value][group] for value in values]
        if any(widths):
            ax.barh(
                range(len(values)),
                widths,
                left=starts,
                color=SPLIT_COLORS[group],
                label=group,
                height=0.72,
            )
        starts = [start + width for start, width in zip(starts, widths, strict=True)]
    for position, total in enumerate(starts):
        share = f" ({100 * total / whole:.0f} %)" if whole else ""
        how: Any = {"textcoords": "offset points", "va": "center", "fontsize": text_size()}
        ax.annotate(f"{total:,}{share}", (total, position), (4, 0), **how)
    ax.set_yticks(range(len(values)), values)
    ax.invert_yaxis()
    ax.set(xlabel=table.counted, title=table.title, xlim=(0, 1.3 * max([1, *starts])))
    _counting(ax.xaxis)
    return with_light_grid(ax, "x")


def draw_histogram(histogram: Histogram, ax: Axes) -> Axes:
    """Render a histogram as bars, the splits on top of each other; the title says how many values lie outside."""
    widths = [high - low for low, high in pairwise(histogram.edges)]
    _draw_stacked(histogram, ax, histogram.edges[:-1], widths, align="edge")
    unit = "" if histogram.unit == histogram.field else f" ({histogram.unit})"
    ax.set(xlabel=f"{histogram.field}{unit}", ylabel=histogram.counted, title=_title(histogram))
    ax.set_xlim(histogram.edges[0], histogram.edges[-1])
    ax.set_xticks(histogram.edges[:: -(-len(histogram.edges) // 12)])
    _counting(ax.yaxis)
    return with_light_grid(ax, "y")


def draw_quantiles(table: QuantileTable, field: str, ax: Axes) -> Axes:
    """Render a field's quantiles by category: box from 25 to 75 %, line at the median, whiskers at 5 and 95 %."""
    rows = [
        row
        for row in table.quantiles
        if row.field == field and row.group == GROUPS[0] and row.values
    ]
    draw_quantile_boxes({row.category: row for row in rows}, ax)
    ax.set(
        ylabel=f"{field} ({table.unit})", title=f"{field.capitalize()} by category", ylim=(0, None)
    )
    ax.tick_params(axis="x", labelsize=text_size())
    return ax


def draw_angles(histogram: Histogram, ax: Axes) -> Axes:
    """Render a histogram of degrees around a circle: 0° up, counter-clockwise. Raises ChoiceError: not polar."""
    from matplotlib.projections.polar import PolarAxes

    if not isinstance(ax, PolarAxes):
        raise ChoiceError(
            f"ax: expected polar axes (projection='polar'), found {type(ax).__name__}"
        )
    ax.set_theta_zero_location("N")
    edges = histogram.edges
    middles = [radians((low + high) / 2) for low, high in pairwise(edges)]
    _draw_stacked(histogram, ax, middles, radians(edges[1] - edges[0]))
    ax.set_xticks([radians(angle) for angle in range(0, 360, 30)])
    ax.tick_params(labelsize=text_size())
    counts = histogram.counts[GROUPS[0]]
    lowest = min(range(len(counts)), key=lambda bar: counts[bar - 1] + counts[bar])
    ax.set_rlabel_position(edges[lowest])  # beside the bars
    highest = max(1, *counts)
    ax.set_ylim(0, highest)
    ax.set_yticks(sorted({-(-highest * part // 3) for part in (1, 2, 3)}))
    ax.set_title(_title(histogram), fontsize=10)
    ax.grid(color=GRID_COLOR, linewidth=0.6)
    ax.set_axisbelow("line")
    return ax


def draw_relative_positions(pairs: Sequence[CollisionPair], ax: Axes) -> Axes:
    """Render where the other actor of each colliding pair was at the end, seen from the first, forward up (m)."""
    from matplotlib.patches import Rectangle

    for category in CATEGORIES:
        others = [pair for pair in pairs if pair.other_category == category]
        if others:
            positions = ([pair.y for pair in others], [pair.x for pair in others])
            color, marker = CATEGORY_COLORS[category], CATEGORY_MARKERS.get(category, "s")
            how: Any = {"s": 30, "marker": marker, "alpha": 0.75, "linewidths": 0}
            ax.scatter(*positions, color=color, label=category, zorder=3, **how)
    ax.add_patch(
        Rectangle((-0.97, -2.3), 1.94, 4.6, fill=False, edgecolor=COLLIDER_COLOR, linewidth=1.2)
    )
    ax.annotate("", (0, 2.3), (0, 0.4), arrowprops={"arrowstyle": "->", "color": COLLIDER_COLOR})
    reach = max([6.0, *(1.1 * max(abs(pair.x), abs(pair.y)) for pair in pairs)])
    ax.set(xlim=(reach, -reach), ylim=(-reach, reach), aspect="equal")
    ax.set(xlabel="to the left of the first (m)", ylabel="forward of the first (m)")
    ax.set_title("Centre of the other actor\n(red: the first, as a median car)", fontsize=10)
    if pairs:
        handles, _ = ax.get_legend_handles_labels()
        draw_legend(
            ax, handles, columns=3, loc="upper center", bbox_to_anchor=(0.5, -0.22)
        )  # below the axis' label
    return with_light_grid(ax, "both")


def draw_quantile_boxes(rows: Mapping[str, QuantileRow], ax: Axes) -> None:
    """A box for each labelled row of quantiles, with its median in figures."""
    boxes = [
        {"label": label, "whislo": q[1], "q1": q[2], "med": q[3], "q3": q[4], "whishi": q[5]}
        for label, row in rows.items()
        if (q := row.values)
    ]
    if boxes:
        parts = ax.bxp(
            boxes, showfliers=False, patch_artist=True, widths=0.45, medianprops={"color": "black"}
        )
        for patch, row in zip(parts["boxes"], rows.values(), strict=True):
            patch.set(
                facecolor=CATEGORY_COLORS.get(row.category, SPLIT_COLORS["unknown"]), alpha=0.75
            )
        medians = [row.values[PROBABILITIES.index(0.5)] for row in rows.values() if row.values]
        for position, median in enumerate(medians, 1):
            text = f"{median:.{1 if median >= 10 else 2}f}"
            ax.annotate(text, (position + 0.25, median), va="center", fontsize=text_size())
        ax.set_xlim(0.6, len(boxes) + 0.75)
    ax.set_xlabel("line: median; box: 25–75 %; whiskers: 5–95 %", fontsize=text_size())
    with_light_grid(ax, "y")


def _draw_stacked(
    histogram: Histogram,
    ax: Axes,
    places: Sequence[float],
    width: float | Sequence[float],
    **how: Any,
) -> None:
    """Bars at some places, the splits on top of each other; splits with only zeros have no bars."""
    base, style = [0] * len(places), {"edgecolor": "white", "linewidth": 0.5, **how}
    for group in GROUPS[1:]:
        counts = histogram.counts[group]
        if any(counts):
            ax.bar(places, counts, width, base, color=SPLIT_COLORS[group], label=group, **style)
            base = [below + count for below, count in zip(base, counts, strict=True)]


def _title(histogram: Histogram) -> str:
    outside = histogram.outside[GROUPS[0]]
    if not outside:
        return histogram.title
    share = 100 * outside / histogram.total()
    words = f"{share:.1f}" if share >= _LEAST_SHARE else f"less than {_LEAST_SHARE}"
    return (
        f"{histogram.title}\n({words} % outside of {histogram.edges[0]:g}–{histogram.edges[-1]:g})"
    )


def _counting(axis: Axis) -> None:
    """Whole numbers with a comma at thousands, in at most six steps."""
    from matplotlib.ticker import MaxNLocator, StrMethodFormatter

    axis.set_major_locator(MaxNLocator(nbins=6, integer=True))
    axis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))


def _scenarios(statistics: DatasetStatistics, fig: Figure) -> None:
    rows = [
        ("weathers", "weather_frames"),
        ("times_of_day", "time_of_day_frames"),
        ("scenario_types", "towns"),
        ("road_types", "collisions"),
    ]
    heights = [2 + max(len(statistics.counts[name].counts) for name in row) for row in rows]
    for name, ax in fig.subplot_mosaic([list(row) for row in rows], height_ratios=heights).items():
        draw_counts(statistics.counts[name], ax=ax)


def _ends(statistics: DatasetStatistics, fig: Figure) -> None:
    axes = fig.subplots(1, 2, width_ratios=(3, 2))
    draw_counts(statistics.counts["ends"], ax=axes[0])
    axes[0].set_xlabel("scenarios (designs 1–6: at traffic lights, 7–12: without)")
    draw_histogram(statistics.histograms["lengths"], ax=axes[1])


def _ego(statistics: DatasetStatistics, fig: Figure) -> None:
    axes = fig.subplots(1, 2, width_ratios=(3, 2))
    draw_histogram(statistics.histograms["ego_speeds"], ax=axes[0])
    sizes = statistics.quantiles["ego_sizes"]
    rows = [row for row in sizes.quantiles if row.group == GROUPS[0] and row.values]
    draw_quantile_boxes({row.field: row for row in rows}, axes[1])
    axes[1].set(ylabel=f"size ({sizes.unit})", title=sizes.title, ylim=(0, None))


def _actors(statistics: DatasetStatistics, fig: Figure) -> None:
    axes = fig.subplots(2, 2)
    for name, ax in zip(("instances", "parked_instances", "annotations"), axes.flat, strict=False):
        draw_counts(statistics.counts[name], ax=ax)
    draw_histogram(statistics.histograms["actors"], ax=axes[1, 1])


def _boxes(statistics: DatasetStatistics, fig: Figure) -> None:
    for field, ax in fig.subplot_mosaic([["length", "width"], ["height", "."]]).items():
        draw_quantiles(statistics.quantiles["box_sizes"], field, ax=ax)


def _motion(statistics: DatasetStatistics, fig: Figure) -> None:
    axes = fig.subplots(2, 2, width_ratios=(4, 5))
    for row, (name, field) in enumerate((("distances", "distance"), ("speeds", "speed"))):
        draw_histogram(statistics.histograms[name], ax=axes[row, 0])
        draw_quantiles(statistics.quantiles[f"{field}_quantiles"], field, ax=axes[row, 1])


def _collisions(statistics: DatasetStatistics, fig: Figure) -> None:
    fig.suptitle("The colliding pair at the last frame: the other actor, seen from the first")
    angles = fig.add_subplot(1, 3, 1, projection="polar")
    bearings = fig.add_subplot(1, 3, 2, projection="polar")
    draw_angles(statistics.histograms["collision_angles"], ax=angles)
    draw_angles(statistics.histograms["collision_bearings"], ax=bearings)
    headings = "collisions by the other's heading: 0° the same,\n90° to the left, 180° head-on, 270° to the right"
    angles.set_xlabel(headings, fontsize=text_size())
    bearings.set_xlabel(
        "collisions by where the other is:\n0° ahead, 90° left, 270° right", fontsize=text_size()
    )
    draw_relative_positions(statistics.collisions, ax=fig.add_subplot(1, 3, 3))


_FIGURES: Mapping[str, tuple[tuple[float, float], _Draw]] = {
    "scenarios": ((_WIDTH, 10.5), _scenarios),
    "ends": ((_WIDTH, 5.5), _ends),
    "ego": ((_WIDTH, 4.5), _ego),
    "actors": ((_WIDTH, 7.5), _actors),
    "boxes": ((_WIDTH, 7.5), _boxes),
    "motion": ((_WIDTH, 8), _motion),
    "collisions": ((_WIDTH, 5.2), _collisions),
}
# The groups that `render_statistics` renders → width and height of their figures in inches.
STATISTICS_FIGURES: Final[Mapping[str, tuple[float, float]]] = {
    group: size for group, (size, _) in _FIGURES.items()
}


@in_own_settings
def render_statistics(
    statistics: DatasetStatistics, group: str, *, fig: Figure | None = None
) -> Figure:
    """Render one group of `STATISTICS_FIGURES`, coloured by split. Raises ChoiceError: no such group."""
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    size, draw = _FIGURES[choice("group", group, _FIGURES)]
    fig = figure_or_new(fig, size)
    engine = fig.get_layout_engine()
    if isinstance(engine, ConstrainedLayoutEngine):
        engine.set(w_pad=0.12, h_pad=0.12)
    draw(statistics, fig)
    handles = {}
    for ax in fig.axes:
        handles.update(
            {label: handle for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)}
        )
    shown = [name for name in SPLIT_COLORS if name in handles]
    if shown:
        chosen = [handles[name] for name in shown]
        fig.legend(
            chosen,
            shown,
            loc="outside lower center",
            ncols=len(shown),
            title="split",
            fontsize=text_size(),
        )
    return fig


def save_statistics(statistics: DatasetStatistics, folder: str | os.PathLike[str]) -> list[Path]:
    """Render each group into `<group>.png` and `<group>.pdf`, atomically; returns the paths; older files are replaced.

    The folder is made if it is not there. Raises ConfigError: it cannot be written to, or is a file.
    """
    folder, paths = writable_folder(folder), []
    for group, (size, _) in _FIGURES.items():
        figure = render_statistics(statistics, group, fig=detached_figure(size))
        paths += [
            write_figure(figure, folder / f"{group}.{kind}", dpi=_DPI) for kind in ("png", "pdf")
        ]
    return paths
