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
# Percent: a smaller share has no number.
_MIN_SHARE_PERCENT: Final = 0.1
_Draw = Callable[[DatasetStatistics, "Figure"], None]
# Inches of a page of A4 in landscape.
_PAGE_WIDTH_IN: Final = 10.7


def draw_counts(table: CountTable, ax: Axes) -> Axes:
    """Render a table of counts as horizontal bars, with sums and shares.

    The bars of the splits follow each other.
    """
    values, table_total = list(table.counts), table.total()
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
    style: Any = {"textcoords": "offset points", "va": "center", "fontsize": text_size()}
    for row, total in enumerate(starts):
        text = f"{total:,}"
        if table_total:
            text += f" ({100 * total / table_total:.0f} %)"
        ax.annotate(text, (total, row), (4, 0), **style)
    ax.set_yticks(range(len(values)), values)
    ax.invert_yaxis()
    ax.set(xlabel=table.counted, title=table.title, xlim=(0, 1.3 * max([1, *starts])))
    _format_counts(ax.xaxis)
    return with_light_grid(ax, "x")


def draw_histogram(histogram: Histogram, ax: Axes) -> Axes:
    """Render a histogram as bars, the splits on top of each other.

    The title has the share of values outside.
    """
    edges = histogram.edges
    widths = [high - low for low, high in pairwise(edges)]
    _draw_stacked(histogram, ax, edges[:-1], widths, align="edge")
    label = histogram.field
    if histogram.unit != histogram.field:
        label += f" ({histogram.unit})"
    ax.set(xlabel=label, ylabel=histogram.counted, title=_title(histogram))
    ax.set_xlim(edges[0], edges[-1])
    ax.set_xticks(edges[:: -(-len(edges) // 12)])
    _format_counts(ax.yaxis)
    return with_light_grid(ax, "y")


def draw_quantiles(table: QuantileTable, field: str, ax: Axes) -> Axes:
    """Render a field's quantiles by category.

    A box is from 25 to 75 %, a line at the median, whiskers at 5 and 95 %.
    """
    rows = {}
    for row in table.quantiles:
        if row.field == field and row.group == GROUPS[0] and row.values:
            rows[row.category] = row
    draw_quantile_boxes(rows, ax)
    title = f"{field.capitalize()} by category"
    ax.set(ylabel=f"{field} ({table.unit})", title=title, ylim=(0, None))
    ax.tick_params(axis="x", labelsize=text_size())
    return ax


def draw_angles(histogram: Histogram, ax: Axes) -> Axes:
    """Render a histogram of degrees around a circle: 0° up, counter-clockwise.

    Raises:
        ChoiceError: The axes are not polar.
    """
    from matplotlib.projections.polar import PolarAxes

    if not isinstance(ax, PolarAxes):
        raise ChoiceError(
            f"ax: expected polar axes (projection='polar'), found {type(ax).__name__}"
        )
    ax.set_theta_zero_location("N")
    edges = histogram.edges
    centers = [radians((low + high) / 2) for low, high in pairwise(edges)]
    _draw_stacked(histogram, ax, centers, radians(edges[1] - edges[0]))
    ax.set_xticks([radians(angle) for angle in range(0, 360, 30)])
    ax.tick_params(labelsize=text_size())
    counts = histogram.counts[GROUPS[0]]
    low_bar = min(range(len(counts)), key=lambda bar: counts[bar - 1] + counts[bar])
    ax.set_rlabel_position(edges[low_bar])  # beside the bars
    max_count = max(1, *counts)
    ax.set_ylim(0, max_count)
    ax.set_yticks(sorted({-(-max_count * part // 3) for part in (1, 2, 3)}))
    ax.set_title(_title(histogram), fontsize=10)
    ax.grid(color=GRID_COLOR, linewidth=0.6)
    ax.set_axisbelow("line")
    return ax


def draw_relative_positions(pairs: Sequence[CollisionPair], ax: Axes) -> Axes:
    """Render the final position of the other actor of each colliding pair, metres.

    Positions are relative to the first actor, forward up.
    """
    from matplotlib.patches import Rectangle

    style: Any = {"s": 30, "alpha": 0.75, "linewidths": 0, "zorder": 3}
    for category in CATEGORIES:
        category_pairs = [pair for pair in pairs if pair.other_category == category]
        if category_pairs:
            ax.scatter(
                [pair.y for pair in category_pairs],
                [pair.x for pair in category_pairs],
                color=CATEGORY_COLORS[category],
                label=category,
                marker=CATEGORY_MARKERS.get(category, "s"),
                **style,
            )
    ax.add_patch(
        Rectangle((-0.97, -2.3), 1.94, 4.6, fill=False, edgecolor=COLLIDER_COLOR, linewidth=1.2)
    )
    ax.annotate("", (0, 2.3), (0, 0.4), arrowprops={"arrowstyle": "->", "color": COLLIDER_COLOR})
    distances = [1.1 * max(abs(pair.x), abs(pair.y)) for pair in pairs]
    limit = max([6.0, *distances])
    ax.set(xlim=(limit, -limit), ylim=(-limit, limit), aspect="equal")
    ax.set(xlabel="to the left of the first (m)", ylabel="forward of the first (m)")
    ax.set_title("Centre of the other actor\n(red: the first, as a median car)", fontsize=10)
    if pairs:
        handles, _ = ax.get_legend_handles_labels()
        # below the axis' label
        anchor: Any = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.22)}
        draw_legend(ax, handles, columns=3, **anchor)
    return with_light_grid(ax, "both")


def draw_quantile_boxes(rows: Mapping[str, QuantileRow], ax: Axes) -> None:
    """Render a box for each labelled row of quantiles, with its median in figures."""
    boxes, medians = [], []
    for label, row in rows.items():
        values = row.values
        if values:
            boxes.append(
                {
                    "label": label,
                    "whislo": values[1],
                    "q1": values[2],
                    "med": values[3],
                    "q3": values[4],
                    "whishi": values[5],
                }
            )
            medians.append(values[PROBABILITIES.index(0.5)])
    if boxes:
        parts = ax.bxp(
            boxes, showfliers=False, patch_artist=True, widths=0.45, medianprops={"color": "black"}
        )
        for patch, row in zip(parts["boxes"], rows.values(), strict=True):
            color = CATEGORY_COLORS.get(row.category, SPLIT_COLORS["unknown"])
            patch.set(facecolor=color, alpha=0.75)
        for position, median in enumerate(medians, 1):
            text = f"{median:.1f}" if median >= 10 else f"{median:.2f}"
            ax.annotate(text, (position + 0.25, median), va="center", fontsize=text_size())
        ax.set_xlim(0.6, len(boxes) + 0.75)
    ax.set_xlabel("line: median; box: 25–75 %; whiskers: 5–95 %", fontsize=text_size())
    with_light_grid(ax, "y")


def _draw_stacked(
    histogram: Histogram,
    ax: Axes,
    positions: Sequence[float],
    width: float | Sequence[float],
    **style: Any,
) -> None:
    """Draw bars at some positions, the splits on top of each other.

    Splits with only zeros have no bars.
    """
    heights = [0] * len(positions)
    options = {"edgecolor": "white", "linewidth": 0.5, **style}
    for group in GROUPS[1:]:
        counts = histogram.counts[group]
        if any(counts):
            color = SPLIT_COLORS[group]
            ax.bar(positions, counts, width, heights, color=color, label=group, **options)
            heights = [height + count for height, count in zip(heights, counts, strict=True)]


def _title(histogram: Histogram) -> str:
    outside_count = histogram.outside[GROUPS[0]]
    if not outside_count:
        return histogram.title
    share = 100 * outside_count / histogram.total()
    share_words = f"less than {_MIN_SHARE_PERCENT}"
    if share >= _MIN_SHARE_PERCENT:
        share_words = f"{share:.1f}"
    low, high = histogram.edges[0], histogram.edges[-1]
    return f"{histogram.title}\n({share_words} % outside of {low:g}–{high:g})"


def _format_counts(axis: Axis) -> None:
    """Give an axis whole numbers with a comma at thousands, in at most six steps."""
    from matplotlib.ticker import MaxNLocator, StrMethodFormatter

    axis.set_major_locator(MaxNLocator(nbins=6, integer=True))
    axis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))


def _scenarios(statistics: DatasetStatistics, fig: Figure) -> None:
    rows: list[Any] = [
        ["weathers", "weather_frames"],
        ["times_of_day", "time_of_day_frames"],
        ["scenario_types", "towns"],
        ["road_types", "collisions"],
    ]
    heights = [2 + max(len(statistics.counts[name].counts) for name in row) for row in rows]
    axes = fig.subplot_mosaic(rows, height_ratios=heights)
    for name, ax in axes.items():
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
    rows = {}
    for row in sizes.quantiles:
        if row.group == GROUPS[0] and row.values:
            rows[row.field] = row
    draw_quantile_boxes(rows, axes[1])
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
    headings_label = (
        "collisions by the other's heading: 0° the same,\n"
        "90° to the left, 180° head-on, 270° to the right"
    )
    bearings_label = "collisions by where the other is:\n0° ahead, 90° left, 270° right"
    angles.set_xlabel(headings_label, fontsize=text_size())
    bearings.set_xlabel(bearings_label, fontsize=text_size())
    draw_relative_positions(statistics.collisions, ax=fig.add_subplot(1, 3, 3))


_FIGURES: Mapping[str, tuple[tuple[float, float], _Draw]] = {
    "scenarios": ((_PAGE_WIDTH_IN, 10.5), _scenarios),
    "ends": ((_PAGE_WIDTH_IN, 5.5), _ends),
    "ego": ((_PAGE_WIDTH_IN, 4.5), _ego),
    "actors": ((_PAGE_WIDTH_IN, 7.5), _actors),
    "boxes": ((_PAGE_WIDTH_IN, 7.5), _boxes),
    "motion": ((_PAGE_WIDTH_IN, 8), _motion),
    "collisions": ((_PAGE_WIDTH_IN, 5.2), _collisions),
}
# Group of `render_statistics` → width and height of its figure in inches.
STATISTICS_FIGURES: Final[Mapping[str, tuple[float, float]]] = {
    group: size for group, (size, _) in _FIGURES.items()
}


@in_own_settings
def render_statistics(
    statistics: DatasetStatistics, group: str, *, fig: Figure | None = None
) -> Figure:
    """Render one group of `STATISTICS_FIGURES`, coloured by split.

    Raises:
        ChoiceError: No such group.
    """
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    size, draw = _FIGURES[choice("group", group, _FIGURES)]
    fig = figure_or_new(fig, size)
    engine = fig.get_layout_engine()
    if isinstance(engine, ConstrainedLayoutEngine):
        engine.set(w_pad=0.12, h_pad=0.12)
    draw(statistics, fig)
    handle_of_label = {}
    for ax in fig.axes:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            handle_of_label[label] = handle
    labels = [name for name in SPLIT_COLORS if name in handle_of_label]
    if labels:
        fig.legend(
            [handle_of_label[label] for label in labels],
            labels,
            loc="outside lower center",
            ncols=len(labels),
            title="split",
            fontsize=text_size(),
        )
    return fig


def save_statistics(statistics: DatasetStatistics, folder: str | os.PathLike[str]) -> list[Path]:
    """Render each group into `<group>.png` and `<group>.pdf`, atomically, and return the paths.

    Older files are replaced. The folder is made if it does not exist.

    Raises:
        ConfigError: The folder cannot be written to, or is a file.
    """
    folder, paths = writable_folder(folder), []
    for group, (size, _) in _FIGURES.items():
        figure = render_statistics(statistics, group, fig=detached_figure(size))
        for suffix in ("png", "pdf"):
            paths.append(write_figure(figure, folder / f"{group}.{suffix}", dpi=_DPI))
    return paths
