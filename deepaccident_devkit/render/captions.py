"""Captions of pictures: the moment, the meaning of the colours, and missing sensor files."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final, cast

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.release.store import folder_entries
from deepaccident_devkit.render.boxes import in_drawing_order
from deepaccident_devkit.render.figures import label_axes, with_light_grid
from deepaccident_devkit.render.styles import (
    AGENT_COLORS,
    CATEGORY_MARKERS,
    COLLIDER_COLOR,
    MISSING_COLOR,
    MUTED_COLOR,
    category_colors,
    current_style,
    text_size,
)
from deepaccident_devkit.support.values import ReadOnlyValues
from deepaccident_devkit.taxonomy import CATEGORIES, LIDAR, short_name

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.font_manager import FontProperties

# Where a title is best broken into lines, but not in `m/s`.
_BREAKS = re.compile(r"(?<=/)(?!s\b)|(?<=, )|(?<=: )|(?<=; )|(?<=· )")
# Where a title is broken if that is not enough.
_SPACES = re.compile(r"(?<= )")
# Share of a figure's width that its title may take.
_TITLE_SHARE = 0.92
# Smallest factor by which letters shrink before a title is broken into lines instead.
_MIN_FONT_SCALE = 0.85
# Share of a panel's width that its title may take: text next to the axes shifts the title, and
# letters become wider at low resolution.
_PANEL_SHARE = 0.78
# Size of a token's letters in points. A token is for copying, not for reading.
_TOKEN_SIZE_PT = 7.5
# Marks the token at the foot of a title.
_FOOT_GID = "token"
# Separates a scene, a moment, an agent and an actor in a title.
_SEPARATOR = " · "
_CAPITALS = re.compile(r"(?<=[a-z])(?=[A-Z])")
# Style of a legend inside the axes, where it takes no space around them, and of one below the
# label of their x axis.
INSIDE: Final[ReadOnlyValues] = {"loc": "upper right", "frameon": True, "framealpha": 0.85}
BELOW: Final[ReadOnlyValues] = {
    "loc": "upper center",
    "bbox_to_anchor": (0.5, 0),
    "borderaxespad": 4.5,
}
# Width in inches of a legend symbol and the space around it, per point of letter size.
_HANDLE_WIDTH_IN = 0.044
# Share of a panel's width that a legend below it may take.
_LEGEND_SHARE = 0.86
_LEGEND_SPACING: ReadOnlyValues = {"handlelength": 1.2, "columnspacing": 1.0}
# Labels of the words in a grey panel, and of words for a title; `missing_words` looks for them.
_MISSING_GID = "missing"
_LACKS_GID = "lacks"
_NO_CLOUD_PREFIX = "no LiDAR file of "


def scene_words(record: ReadOnlyValues) -> str:
    """Name a scenario's town and weather, if meta states them: `Town10HD, wet night`."""
    weather = _CAPITALS.sub(" ", record["weather"] or "").lower()
    separator = " at " if weather.endswith("rain") else " "
    conditions = _join_parts([weather, record["time_of_day"]], separator)
    return _join_parts([record["town"], conditions.lower()])


def scenario_words(record: ReadOnlyValues) -> str:
    """Describe a scenario to readers by its town, its weather and how it ends.

    For example `Town02, wet night: car hits pedestrian` (cars come first), or `…: no collision`.
    """
    collision: Any = record["collision"]
    if collision is not None:
        order = (*CATEGORIES, *collision["classes"])
        categories = sorted(collision["classes"], key=order.index)
        end = " hits ".join(categories)
    elif record["weather"] is None:
        end = "end unknown"
    else:
        end = "no collision"
    return _join_parts([scene_words(record), end], ": ")


def _join_parts(parts: Iterable[str | None], separator: str = ", ") -> str:
    """Join the parts that are neither None nor empty."""
    return separator.join(filter(None, parts))


def moment_words(dataset: Dataset, token: str) -> str:
    """Describe a moment: the time of a frame (a token), for a sample also its agent.

    For example `1.0 s before the impact · ego behind`.
    """
    kind, name, *agents, number = token.split("/")[:4]
    frame = dataset.get("frame", f"{kind}/{name}/{number}")
    time_left = dataset.samples_of(frame)[0]["time_to_impact"]
    if time_left is None:
        moment = f"t = {frame['timestamp']:.1f} s"
    elif time_left == 0:
        moment = "at the impact"
    else:
        moment = f"{time_left:.1f} s before the impact"
    return _SEPARATOR.join([moment, *map(short_name, agents)])


def set_scene_title(
    target: Axes | Figure,
    dataset: Dataset,
    token: str,
    words: str = "",
    *,
    below: str = "",
    **style: Any,
) -> None:
    """Title axes or a figure `Town10HD, wet night · 1.0 s before the impact · ego`.

    Axes in a figure of the caller get no title: it is the caller's. The token may be of a scenario,
    frame, sample, sensor file, box or actor; it is written beneath the title. The title of a
    scenario or an actor begins with `scenario_words`. `words` follow on the same line, `below` on
    the next. The last line has the words of `write_missing` for these axes, or for all axes of the
    figure.
    """
    from matplotlib.axes import Axes

    if not current_style().titled or (isinstance(target, Axes) and is_callers(target)):
        return
    kind, name, *parts = token.split("/")
    record = dataset.get("scenario", f"{kind}/{name}")
    is_whole_scenario = parts[:1] in ([], ["actor"])
    if is_whole_scenario:
        scene = scenario_words(record)
    else:
        scene = _join_parts([scene_words(record), moment_words(dataset, token)], _SEPARATOR)
    axes: Any = target.axes
    if isinstance(target, Axes):
        axes = [target]
        style.setdefault("fontsize", "medium")
    missing_texts = [text for ax in axes for text in ax.texts if text.get_gid() == _LACKS_GID]
    lines = [
        _join_parts([scene, words], _SEPARATOR),
        below,
        "; ".join(_missing_parts(missing_texts)),
    ]
    set_title(target, _join_parts(lines, "\n"), token=token, **style)


def set_title(
    target: Axes | Figure,
    words: str,
    *,
    token: str = "",
    fontsize: float | str | None = None,
    **style: Any,
) -> None:
    """Give axes or a figure a title that fits the figure's width, and a token beneath it.

    Only some styles show tokens. If a line is a little too long, the letters shrink. If it is far
    too long, it is broken, preferably after `/`, `:` or a comma. The title is centred as a block.
    """
    from matplotlib import rcParams
    from matplotlib.axes import Axes
    from matplotlib.font_manager import FontProperties

    is_panel = isinstance(target, Axes)
    artist = cast("Any", target)
    default_size = rcParams["axes.titlesize" if is_panel else "figure.titlesize"]
    font = FontProperties(size=fontsize or default_size)
    width = 72 * room_of(target)
    text, size = _fit_words(words, font, width, text_size())
    shown_token = token if current_style().tokens else ""
    token_font = FontProperties(size=_TOKEN_SIZE_PT)
    token_text, token_size = _fit_words(shown_token, token_font, width, _TOKEN_SIZE_PT)
    if token_text:
        # blank lines reserve the space for the token, so that the layout need not know about it
        token_lines = token_text.count("\n") + 1
        text += "\n " * math.ceil(token_size * token_lines / size)
    if is_panel:
        # matplotlib measures all ticks over and over to find a title's height
        style.setdefault("y", 1.0)
        title = artist.set_title(text, fontsize=size, **style)
    else:
        title = artist.suptitle(text, fontsize=size, **style)
    _write_token(target, token_text, token_size, title)


def set_note(fig: Figure, words: str, **style: Any) -> None:
    """Write a note below all panels of a figure, in lines that fit the figure's width."""
    from matplotlib.font_manager import FontProperties

    font = FontProperties(size=text_size())
    text, size = _fit_words(words, font, 72 * room_of(fig), text_size())
    fig.supxlabel(text, fontsize=size, **{"color": MUTED_COLOR, **style})


def titled_from_above(ax: Axes, title: str, *, grid: bool) -> Axes:
    """Finish a view from above, in metres, with a small title that fits; return its axes."""
    ax.set_aspect("equal")
    label_axes(ax, "ego")
    if not is_callers(ax):
        set_title(ax, title, fontsize=text_size(), y=None)
    if grid:
        with_light_grid(ax, "both")
    return ax


def _write_token(target: Any, token: str, size: float, title: Any) -> None:
    """Write a token over the lowest lines of a title's text, and remove the previous token."""
    from deepaccident_devkit.render.own_figure import TitleToken

    figure = target.figure
    for artist in [*figure.artists]:
        if artist.get_gid() == _FOOT_GID and artist.xycoords is title:
            artist.remove()
    if token:
        artist = TitleToken(token, title, fontsize=size, color=MUTED_COLOR, gid=_FOOT_GID)
        figure.add_artist(artist).set_in_layout(False)


def is_callers(ax: Axes) -> bool:
    """Return whether axes are in a figure of the caller, not in one that this package made."""
    from deepaccident_devkit.render.own_figure import OwnFigure

    return not isinstance(ax.figure.figure, OwnFigure)


def room_of(target: Axes | Figure, panel_share: float = _PANEL_SHARE) -> float:
    """Return how wide words above or below a figure or a panel may be, in inches.

    It is a fixed share of a figure's width, or `panel_share` of a panel's width.
    """
    from matplotlib.axes import Axes

    fig: Any = target
    share = _TITLE_SHARE
    if isinstance(target, Axes):
        fig = target.figure
        share = panel_share
        spec = target.get_subplotspec()
        if spec is not None:
            grid: Any = spec.get_gridspec()
            ratios = grid.get_width_ratios() or [1] * grid.ncols
            panel_ratios = ratios[spec.colspan.start : spec.colspan.stop]
            share *= sum(panel_ratios) / sum(ratios)
    return float(share * fig.bbox.width / fig.dpi)


def _fit_words(
    words: str, font: FontProperties, width: float, min_size: float
) -> tuple[str, float]:
    """Break words into lines that fit a width in points; also return the font size.

    The size only falls below `min_size` if the lines do not fit otherwise.
    """
    size = font.get_size_in_points()
    lines = words.split("\n")
    longest = _longest_width(lines, font)
    min_scale = max(_MIN_FONT_SCALE, min(1.0, min_size / size))
    for breaks in (_BREAKS, _SPACES):
        if longest <= width / min_scale:
            break
        broken_lines: list[str] = []
        for line in lines:
            broken_lines += _break_line(line, width, font, breaks)
        lines = broken_lines
        longest = _longest_width(lines, font)
    scale = min(1.0, width / max(longest, 1.0))
    return "\n".join(lines), size * scale


def _break_line(
    line: str, width: float, font: FontProperties, breaks: re.Pattern[str]
) -> list[str]:
    """Break a line into as few parts as fit a width in points, of about equal widths."""
    best_parts = parts = _fill_lines(line, width, font, breaks)
    while len(parts) == len(best_parts) > 1:
        best_parts = parts
        longest = _longest_width(parts, font)
        parts = _fill_lines(line, longest - 1.0, font, breaks)
        if _longest_width(parts, font) >= longest:
            break
    return best_parts


def _fill_lines(
    line: str, width: float, font: FontProperties, breaks: re.Pattern[str]
) -> list[str]:
    """Break a line where the next phrase would exceed a width in points."""
    parts = [""]
    for phrase in breaks.split(line):
        if parts[-1] and text_width(parts[-1] + phrase.rstrip(), font) > width:
            parts.append("")
        parts[-1] += phrase
    return [part.strip().removesuffix(" ·") for part in parts]


def _longest_width(lines: Iterable[str], font: FontProperties) -> float:
    """Return the width of the longest line in points."""
    return max(text_width(line, font) for line in lines)


def text_width(text: str, font: FontProperties) -> float:
    """Return the width of a line in points."""
    from matplotlib.font_manager import findfont

    return _width_in(findfont(font), text, font.get_size_in_points())


@lru_cache(maxsize=1024)  # a video writes the same words again and again
def _width_in(file: str, text: str, size: float) -> float:
    """Return the width of a line in points, in the font of a file."""
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import text_to_path

    font = FontProperties(fname=file, size=size)
    if text:
        return float(text_to_path.get_text_width_height_descent(text, font, ismath=False)[0])
    return 0.0


def hue_meanings() -> dict[str, str]:
    """Map the colliding pair and each agent, by name, to their hues."""
    meanings = {"colliding pair": COLLIDER_COLOR}
    for agent, color in AGENT_COLORS.items():
        meanings[short_name(agent)] = color
    return meanings


def box_handles(
    colors_from_above: Collection[str], colors_in_images: Collection[str] = ()
) -> list[Artist]:
    """Make legend handles for the colours of boxes: patches or, for small actors in maps, marks."""
    from matplotlib.colors import to_rgba
    from matplotlib.patches import Patch

    shown_colors = {*colors_from_above, *colors_in_images}
    handles: list[Artist] = []
    for name, color in {**hue_meanings(), **category_colors()}.items():
        if color not in shown_colors:
            continue
        if name in CATEGORY_MARKERS and color in colors_from_above:
            handles.append(_mark(name, CATEGORY_MARKERS[name], color))
        else:
            handles.append(Patch(label=name, facecolor=to_rgba(color, 0.25), edgecolor=color))
    return handles


def agent_handles(agents: Collection[str]) -> list[Artist]:
    """Make a legend handle, a dot, for each agent, in the order that all pictures use."""
    names = in_drawing_order(agents)
    return [_mark(short_name(agent), "o", AGENT_COLORS[agent]) for agent in names]


def handles_of_scene(
    colors_from_above: Collection[str],
    clouds: Collection[str],
    colors_in_images: frozenset[str] = frozenset(),
    *,
    is_short: bool = False,
) -> list[Artist]:
    """Make one legend handle for each colour of boxes and of agents' clouds.

    In a short legend, such as a small picture's, clouds have no handles: agents are named next to
    them.
    """
    cloud_colors = {AGENT_COLORS[agent] for agent in clouds}
    handles = box_handles(set(colors_from_above) - cloud_colors, colors_in_images - cloud_colors)
    if not (is_short or current_style().shows_few_panels):
        handles += agent_handles(clouds)
    return handles


def _mark(label: str, marker: str, color: str) -> Artist:
    from matplotlib.lines import Line2D

    return Line2D([], [], linestyle="none", marker=marker, color=color, label=label)


def draw_legend(
    target: Any, handles: Sequence[Artist], *, columns: int | None = None, **style: Any
) -> None:
    """Render a legend, by default below all panels of a figure, with as many columns as fit.

    Without handles there is no legend.
    """
    from matplotlib.font_manager import FontProperties

    if not handles:
        return
    font = FontProperties(size=text_size())
    widths = []
    for handle in handles:
        label_width = text_width(str(handle.get_label()), font) / 72
        widths.append(label_width + _HANDLE_WIDTH_IN * text_size())
    width = room_of(target, _LEGEND_SHARE)
    options = {
        "loc": "outside lower center",
        "fontsize": text_size(),
        "frameon": False,
        **_LEGEND_SPACING,
        **style,
    }
    column_count = _fitting_columns(widths, columns or len(handles), width)
    target.legend(handles=list(handles), ncols=column_count, **options)


def _fitting_columns(widths: Sequence[float], max_columns: int, width: float) -> int:
    """Return how many columns fit a width in inches; each is as wide as its widest handle."""
    for columns in range(min(max_columns, len(widths)), 1, -1):
        widths_by_column = np.array_split(widths, columns)
        column_widths = [max(column) for column in widths_by_column]
        if sum(column_widths) < width:
            return columns
    return 1


def draw_legend_outside(
    ax: Axes, handles: Sequence[Artist], *, columns: int | None = None, **style: Any
) -> None:
    """Render a legend below the axes or, if the style is wide, to the right of a map.

    In a figure of the caller without a layout engine, which could cut it off, it is in the axes.
    """
    has_scale = ax.xaxis.get_visible()  # a map's, not an image's
    figure: Any = ax.figure.figure
    anchor = BELOW
    if is_callers(ax) and figure.get_layout_engine() is None:
        columns = 1
        anchor = INSIDE
    elif not has_scale:
        anchor = {**BELOW, "borderaxespad": 0.5}
    elif current_style().is_wide:
        columns = 1
        anchor = {"loc": "upper left", "bbox_to_anchor": (1, 1), "borderaxespad": 0.5}
    draw_legend(ax, handles, columns=columns, **{**anchor, **style})


def draw_legend_of_fills(ax: Axes, colors: Mapping[str, str]) -> None:
    """Render a legend of filled shapes in the axes."""
    from matplotlib.patches import Patch

    handles = []
    for name, color in colors.items():
        handles.append(Patch(label=name, facecolor=(color, 0.4), edgecolor=color))
    draw_legend(ax, handles, columns=1, **INSIDE)


def has_sensor_file(dataset: Dataset, sample_data: str) -> bool:
    """Return whether the file of a sensor (a token) is present."""
    return dataset.sensor_path(sample_data).exists()


def has_cloud(dataset: Dataset, sample: str) -> bool:
    """Return whether the LiDAR file of a sample (a token) is present."""
    return has_sensor_file(dataset, f"{sample}/{LIDAR}")


def draw_missing_image(dataset: Dataset, sample_data: str, ax: Axes) -> None:
    """Turn axes into a grey panel that states at its top why an image (a token) is missing.

    The words are drawn beneath all data.
    """
    agent, _, channel = sample_data.rsplit("/", 3)[1:]
    ax.set_facecolor(MISSING_COLOR)
    words = absence_text(dataset, sample_data)
    ax.text(
        0.5,
        0.97,
        words,
        label=f"_{agent} {channel}: {words}",
        fontsize=text_size(),
        transform=ax.transAxes,
        zorder=0,
        ha="center",
        va="top",
        clip_on=True,
        in_layout=False,
        gid=_MISSING_GID,
    )


def absence_text(dataset: Dataset, sample_data: str) -> str:
    """State why the file of a sensor (a token) is missing.

    Either only this frame's file is missing, or none of the sensor's files was downloaded.
    """
    folder = dataset.sensor_path(sample_data).parent
    if folder.is_dir() and folder_entries(folder):
        return "no file of this frame"
    return "not downloaded"


def write_missing(ax: Axes, words: str) -> None:
    """Add words about missing data to the title of axes or of their figure, which is set later.

    Empty words add nothing.
    """
    if words:
        ax.text(0, 0, "", label=f"_{words}", gid=_LACKS_GID, visible=False)


def missing_clouds_text(agents: Collection[str]) -> str:
    """Return `no LiDAR file of ego_vehicle, infrastructure`; empty without agents."""
    if agents:
        return f"{_NO_CLOUD_PREFIX}{', '.join(in_drawing_order(agents))}"
    return ""


def missing_words(picture: Axes | Figure) -> list[str]:
    """Collect the words about missing files in a figure, or in the figure of axes, each once."""
    figure: Any = picture.figure
    gids = (_MISSING_GID, _LACKS_GID)
    return _missing_parts(figure.findobj(lambda artist: artist.get_gid() in gids))


def _missing_parts(texts: Iterable[Any]) -> list[str]:
    """Collect the words of the texts that report missing files, each once.

    Agents without clouds are listed together. The words are in the texts' labels, after a `_`,
    which hides them from legends.
    """
    parts: dict[str, None] = {}
    for text in texts:
        for part in text.get_label()[1:].split("; "):
            if part:
                parts[part] = None
    agents: set[str] = set()
    other_parts = []
    for part in parts:
        if part.startswith(_NO_CLOUD_PREFIX):
            agents.update(part.removeprefix(_NO_CLOUD_PREFIX).split(", "))
        else:
            other_parts.append(part)
    clouds_text = missing_clouds_text(agents - {""})
    if clouds_text:
        other_parts.append(clouds_text)
    return other_parts
