"""Figures of a release's statistics, their panels (one for each table), and their files."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from math import radians
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.render.captions import BELOW, draw_legend, set_title
from deepaccident_devkit.render.figures import (
    figure_or_new,
    with_light_grid,
    write_report_figure,
)
from deepaccident_devkit.render.styles import (
    CATEGORY_COLORS,
    CATEGORY_MARKERS,
    COLLIDER_COLOR,
    GRID_COLOR,
    SPLIT_COLORS,
    current_style,
    in_own_settings,
    text_size,
)
from deepaccident_devkit.statistics import (
    GROUPS,
    CollisionPair,
    CountTable,
    DatasetStatistics,
    Histogram,
    QuantileRow,
    QuantileTable,
)
from deepaccident_devkit.support.files import writable_folder
from deepaccident_devkit.support.human_names import human_name
from deepaccident_devkit.support.text import PathType, choice
from deepaccident_devkit.taxonomy import CATEGORIES

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

_DPI = 120
# Shares below this percentage are not written as numbers.
_MIN_SHARE_PERCENT = 0.1
# Width in inches of an A4 page in landscape.
_PAGE_WIDTH_IN = 10.7
# Heights in lines of letters: the words around bars, a bar, other panels, and the legend.
_FRAME_LINES = 5.5
_BAR_LINES = 1.35
_PANEL_LINES = 19
_POLAR_LINES = 16
_POSITIONS_LINES = 21
_LEGEND_LINES = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class _Panel:
    """A panel of a figure.

    Attributes:
        draw: Function that renders the statistics on axes.
        counts: Name of the table of counts whose rows are bars; None for another panel.
        lines: Minimum height without the bars, in lines of letters.
        projection: Projection of the axes; None for plain axes.
    """

    draw: Callable[[DatasetStatistics, Axes], object]
    counts: str | None = None
    lines: float = _PANEL_LINES
    projection: str | None = None

    def count_lines(self, statistics: DatasetStatistics) -> float:
        """Return the minimum height in lines of letters, including the bars."""
        if self.counts is None:
            return self.lines
        return self.lines + _BAR_LINES * len(statistics.counts[self.counts].counts)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Group:
    """A figure of several panels.

    Attributes:
        height: Height of the figure in inches.
        rows: Panels by row.
        widths: Relative widths of the columns.
        title: Title of the figure; empty for none.
    """

    height: float
    rows: tuple[tuple[_Panel, ...], ...]
    widths: tuple[float, ...] = (1, 1)
    title: str = ""


def draw_counts(table: CountTable, ax: Axes) -> Axes:
    """Render a table of counts as horizontal bars, with sums and shares.

    Each bar stacks the counts of the splits.
    """
    values = list(table.counts)
    table_total = table.total()
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
    for row, total in enumerate(starts):
        text = f"{total:,}"
        if table_total:
            text += f" ({100 * total / table_total:.0f} %)"
        ax.annotate(
            text,
            (total, row),
            (4, 0),
            textcoords="offset points",
            va="center",
            fontsize=text_size(),
        )
    ax.set_yticks(range(len(values)), map(human_name, values))
    ax.invert_yaxis()
    max_total = max([1, *starts])
    ax.set(xlabel=table.counted, xlim=(0, 1.3 * max_total))
    set_title(ax, table.title)
    _format_counts(ax.xaxis)
    return with_light_grid(ax, "x")


def draw_histogram(histogram: Histogram, ax: Axes) -> Axes:
    """Render a histogram as bars in which the splits are stacked.

    The title states the share of values outside the histogram.
    """
    edges = histogram.edges
    widths = [high - low for low, high in pairwise(edges)]
    _draw_stacked(histogram, ax, edges[:-1], widths, align="edge")
    label = histogram.field
    if histogram.unit != histogram.field:
        label += f" ({histogram.unit})"
    ax.set(xlabel=label, ylabel=histogram.counted)
    set_title(ax, _title(histogram))
    ax.set_xlim(edges[0], edges[-1])
    tick_step = -(-len(edges) // 12)
    ax.set_xticks(edges[::tick_step])
    _format_counts(ax.yaxis)
    return with_light_grid(ax, "y")


def draw_quantiles(table: QuantileTable, field: str, ax: Axes) -> Axes:
    """Render the quantiles of a field, one box for each category.

    A box extends from the 25th to the 75th percentile, with a line at the median and whiskers at
    the 5th and the 95th.
    """
    rows = [row for row in _known_rows(table) if row.field == field]
    draw_quantile_boxes({row.category: row for row in rows}, ax)
    ax.set(ylabel=f"{field} ({table.unit})", ylim=(0, None))
    set_title(ax, f"{field.capitalize()} by category")
    rotation = 90 if current_style().shows_few_panels else 0  # small panels are too narrow
    ax.tick_params(axis="x", labelsize=text_size(), labelrotation=rotation)
    return ax


def draw_angles(histogram: Histogram, ax: Axes) -> Axes:
    """Render a histogram of angles around a circle: 0° is up, and angles grow counter-clockwise.

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
    ax.set_rlabel_position(edges[low_bar])  # next to the bars
    max_count = max(1, *counts)
    ax.set_ylim(0, max_count)
    ax.set_yticks(sorted({-(-max_count * part // 3) for part in (1, 2, 3)}))
    set_title(ax, _title(histogram), fontsize="medium", y=None)  # above the labels of the angles
    ax.grid(color=GRID_COLOR, linewidth=0.6)
    ax.set_axisbelow("line")
    return ax


def draw_relative_positions(pairs: Sequence[CollisionPair], ax: Axes) -> Axes:
    """Render where the second actor of each colliding pair is when the recording ends, in metres.

    Positions are relative to the first actor, whose forward direction is up.
    """
    from matplotlib.patches import Rectangle

    for category in CATEGORIES:
        category_pairs = [pair for pair in pairs if pair.other_category == category]
        if category_pairs:
            ax.scatter(
                [pair.y for pair in category_pairs],
                [pair.x for pair in category_pairs],
                color=CATEGORY_COLORS[category],
                label=category,
                marker=CATEGORY_MARKERS.get(category, "s"),
                s=30,
                alpha=0.75,
                linewidths=0,
                zorder=3,
            )
    ax.add_patch(
        Rectangle((-0.97, -2.3), 1.94, 4.6, fill=False, edgecolor=COLLIDER_COLOR, linewidth=1.2)
    )
    ax.annotate("", (0, 2.3), (0, 0.4), arrowprops={"arrowstyle": "->", "color": COLLIDER_COLOR})
    distances = [1.1 * max(abs(pair.x), abs(pair.y)) for pair in pairs]
    limit = max([6.0, *distances])
    ax.set(xlim=(limit, -limit), ylim=(-limit, limit), aspect="equal")
    ax.set(xlabel="to the left of the first (m)", ylabel="forward of the first (m)")
    title = "Centre of the other actor\n(red: the first, as a median car)"
    set_title(ax, title, fontsize="medium")
    if pairs:
        handles, _ = ax.get_legend_handles_labels()
        draw_legend(ax, handles, columns=3, **BELOW)
    return with_light_grid(ax, "both")


def draw_quantile_boxes(rows: Mapping[str, QuantileRow], ax: Axes) -> None:
    """Render a box for each row of quantiles (by label), and write its median as a number."""
    boxes = []
    medians = []
    for label, row in rows.items():
        if row.values:
            # in the order of PROBABILITIES
            _, low, low_quartile, median, high_quartile, high, _ = row.values
            boxes.append(
                {
                    "label": label,
                    "whislo": low,
                    "q1": low_quartile,
                    "med": median,
                    "q3": high_quartile,
                    "whishi": high,
                }
            )
            medians.append(median)
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
    """Draw a histogram's bars at positions, with the splits stacked.

    Splits whose counts are all zero have no bars.
    """
    heights = [0] * len(positions)
    options = {"edgecolor": "white", "linewidth": 0.5, **style}
    for group in GROUPS[1:]:
        counts = histogram.counts[group]
        if any(counts):
            color = SPLIT_COLORS[group]
            ax.bar(positions, counts, width, heights, color=color, label=group, **options)
            heights = [height + count for height, count in zip(heights, counts, strict=True)]


def _known_rows(table: QuantileTable) -> list[QuantileRow]:
    """Return the rows of all splits together that have values."""
    return [row for row in table.quantiles if row.group == GROUPS[0] and row.values]


def _title(histogram: Histogram) -> str:
    outside_count = histogram.outside[GROUPS[0]]
    if not outside_count:
        return histogram.title
    share = 100 * outside_count / histogram.total()
    share_words = f"less than {_MIN_SHARE_PERCENT}"
    if share >= _MIN_SHARE_PERCENT:
        share_words = f"{share:.1f}"
    low, *_, high = histogram.edges
    unit = "" if histogram.unit == histogram.field else f" {histogram.unit}"
    return f"{histogram.title}\n({share_words} % outside {low:g}–{high:g}{unit})"


def _format_counts(axis: Axis) -> None:
    """Label an axis with whole numbers, with commas at thousands, in at most six steps."""
    from matplotlib.ticker import MaxNLocator, StrMethodFormatter

    axis.set_major_locator(MaxNLocator(nbins=6, integer=True))
    axis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))


def _counts(name: str, xlabel: str = "") -> _Panel:
    """Describe the panel of a table of counts."""

    def draw(statistics: DatasetStatistics, ax: Axes) -> None:
        draw_counts(statistics.counts[name], ax)
        if xlabel:
            ax.set_xlabel(xlabel)

    return _Panel(draw=draw, counts=name, lines=_FRAME_LINES)


def _histogram(name: str) -> _Panel:
    """Describe the panel of a histogram."""
    return _Panel(draw=lambda statistics, ax: draw_histogram(statistics.histograms[name], ax))


def _quantiles(table: str, field: str) -> _Panel:
    """Describe the panel of a field's quantiles by category."""
    return _Panel(
        draw=lambda statistics, ax: draw_quantiles(statistics.quantiles[table], field, ax)
    )


def _angles(name: str, label: str) -> _Panel:
    """Describe the panel of a histogram of angles."""

    def draw(statistics: DatasetStatistics, ax: Axes) -> None:
        draw_angles(statistics.histograms[name], ax)
        ax.set_xlabel(label, fontsize=text_size())

    return _Panel(draw=draw, lines=_POLAR_LINES, projection="polar")


def _draw_ego_sizes(statistics: DatasetStatistics, ax: Axes) -> None:
    sizes = statistics.quantiles["ego_sizes"]
    draw_quantile_boxes({row.field: row for row in _known_rows(sizes)}, ax)
    ax.set(ylabel=f"size ({sizes.unit})", ylim=(0, None))
    set_title(ax, sizes.title)


_FIGURES: Mapping[str, _Group] = {
    "scenarios": _Group(
        height=10.5,
        rows=(
            (_counts("weathers"), _counts("weather_frames")),
            (_counts("times_of_day"), _counts("time_of_day_frames")),
            (_counts("scenario_types"), _counts("towns")),
            (_counts("road_types"), _counts("collisions")),
        ),
    ),
    "ends": _Group(
        height=5.5,
        widths=(3, 2),
        rows=(
            (
                _counts("ends", "scenarios\n(designs 1–6: at traffic lights,\n7–12: without)"),
                _histogram("lengths"),
            ),
        ),
    ),
    "ego": _Group(
        height=4.5,
        widths=(3, 2),
        rows=((_histogram("ego_speeds"), _Panel(draw=_draw_ego_sizes)),),
    ),
    "actors": _Group(
        height=7.5,
        rows=(
            (_counts("instances"), _counts("parked_instances")),
            (_counts("annotations"), _histogram("actors")),
        ),
    ),
    "boxes": _Group(
        height=7.5,
        rows=(
            (_quantiles("box_sizes", "length"), _quantiles("box_sizes", "width")),
            (_quantiles("box_sizes", "height"),),
        ),
    ),
    "motion": _Group(
        height=8,
        widths=(4, 5),
        rows=(
            (_histogram("distances"), _quantiles("distance_quantiles", "distance")),
            (_histogram("speeds"), _quantiles("speed_quantiles", "speed")),
        ),
    ),
    "collisions": _Group(
        height=5.2,
        title="The colliding pair at the last frame: the other actor, seen from the first",
        widths=(1, 1, 1),
        rows=(
            (
                _angles(
                    "collision_angles",
                    "collisions by the other's heading: 0° the same,\n"
                    "90° to the left, 180° head-on, 270° to the right",
                ),
                _angles(
                    "collision_bearings",
                    "collisions by where the other is:\n0° ahead, 90° left, 270° right",
                ),
                _Panel(
                    draw=lambda statistics, ax: draw_relative_positions(statistics.collisions, ax),
                    lines=_POSITIONS_LINES,
                ),
            ),
        ),
    ),
}
# Width and height in inches of the figure of each group of `render_statistics`.
STATISTICS_FIGURES: Final[Mapping[str, tuple[float, float]]] = {
    name: (_PAGE_WIDTH_IN, group.height) for name, group in _FIGURES.items()
}


@in_own_settings
def render_statistics(
    statistics: DatasetStatistics, group: str, *, fig: Figure | None = None
) -> Figure:
    """Render one group of `STATISTICS_FIGURES`, coloured by split.

    In a paper's column and on a slide, a group with several rows shows the first panel of each row:
    below each other in a column, and in two columns on a slide.

    Raises:
        ChoiceError: No such group.
    """
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    chosen = _FIGURES[choice("group", group, _FIGURES)]
    rows, widths = _rows_in_style(chosen)
    heights = [max(panel.count_lines(statistics) for panel in row) for row in rows]
    size = (_PAGE_WIDTH_IN, chosen.height)
    fig = figure_or_new(fig, size, lines=sum(heights) + _LEGEND_LINES)
    engine = fig.get_layout_engine()
    if isinstance(engine, ConstrainedLayoutEngine):
        engine.set(w_pad=0.12, h_pad=0.12)
    if chosen.title and current_style().titled:
        set_title(fig, chosen.title)
    grid = fig.add_gridspec(len(rows), len(widths), width_ratios=widths, height_ratios=heights)
    for row_number, row in enumerate(rows):
        for column, panel in enumerate(row):
            ax = fig.add_subplot(grid[row_number, column], projection=panel.projection)
            panel.draw(statistics, ax)
    _draw_split_legend(fig)
    return fig


def _rows_in_style(group: _Group) -> tuple[Sequence[Sequence[_Panel]], Sequence[float]]:
    """Return the panels by row, and the columns' relative widths, that fit the current style."""
    layout = current_style().layout
    panels = [row[0] for row in group.rows]
    if len(group.rows) == 1:
        panels = list(group.rows[0])
    if layout == "column":
        return [(panel,) for panel in panels], (1,)
    if layout == "slide" and len(group.rows) > 1:
        return [panels[start : start + 2] for start in range(0, len(panels), 2)], (1, 1)
    return group.rows, group.widths


def _draw_split_legend(fig: Figure) -> None:
    """Explain the colours of the splits below all panels."""
    handle_of_label = {}
    for ax in fig.axes:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            handle_of_label[label] = handle
    handles = [handle_of_label[name] for name in SPLIT_COLORS if name in handle_of_label]
    draw_legend(fig, handles, title="split", title_fontsize=text_size())


def save_statistics(statistics: DatasetStatistics, folder: PathType) -> list[Path]:
    """Render each group into `<group>.png` and `<group>.pdf`, atomically, and return the paths.

    The PDF files have the size of the current style. Older files are replaced. The folder is made
    if it does not exist.

    Raises:
        ConfigError: The folder cannot be written to, or is a file.
    """
    folder = writable_folder(folder)
    paths = []
    for group in _FIGURES:
        draw = partial(render_statistics, statistics, group)
        path = write_report_figure(draw, folder / f"{group}.png", dpi=_DPI, needs_pdf=True)
        paths += [path, path.with_suffix(".pdf")]
    return paths
