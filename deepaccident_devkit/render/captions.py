"""Captions of pictures: their moment, the meaning of their colours, and missing sensor files."""

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
from deepaccident_devkit.taxonomy import CATEGORIES, LIDAR, short_name

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.font_manager import FontProperties

# The best positions of line breaks in a title.
_BREAKS: Final = re.compile(r"(?<=/)|(?<=, )|(?<=: )|(?<=; )")
# Share of a figure's width that a title may take.
_TITLE_SHARE: Final = 0.92
# Least factor of the size of letters before a title is broken into lines.
_MIN_FONT_SCALE: Final = 0.85
# Share of a panel's width for its title: text beside the axes moves the title to one side, and in
# few pixels letters become wider.
_PANEL_SHARE: Final = 0.78
# Points of a token's letters. A token is for copying, not for reading.
_TOKEN_SIZE_PT: Final = 7.5
# Marks the token at the foot of a title.
_FOOT_GID: Final = "token"
_CAPITALS: Final = re.compile(r"(?<=[a-z])(?=[A-Z])")
# Style of a legend in axes, so that nothing is beside them.
INSIDE: Final[Mapping[str, Any]] = {"loc": "upper right", "frameon": True, "framealpha": 0.85}
# Inches of a sign and the blanks around it, for letters of one point.
_HANDLE_WIDTH_IN: Final = 0.044
# Share of a panel's width for a legend below it.
_LEGEND_SHARE: Final = 0.86
_LEGEND_SPACING: Final[Mapping[str, Any]] = {"handlelength": 1.2, "columnspacing": 1.0}
# Mark the words of a grey panel, and words for a title, so that `missing_words` finds them.
_MISSING_GID, _LACKS_GID = "missing", "lacks"
_NO_CLOUD_PREFIX: Final = "no LiDAR file of "


def scene_words(record: Mapping[str, Any]) -> str:
    """Return the town and weather of a scenario, as far as meta has them: `Town10HD, wet night`."""
    weather = _CAPITALS.sub(" ", record["weather"] or "").lower()
    separator = " at " if weather.endswith("rain") else " "
    conditions = separator.join(filter(None, [weather, record["time_of_day"]])).lower()
    return _joined([record["town"], conditions])


def scenario_words(record: Mapping[str, Any]) -> str:
    """Return a scenario's name for readers, cars first.

    For example `Town02, wet night: car hits pedestrian`, or `…: no collision`.
    """
    collision: Any = record["collision"]
    if collision is not None:
        order = (*CATEGORIES, *collision["classes"]).index
        end = " hits ".join(sorted(collision["classes"], key=order))
    elif record["weather"] is None:
        end = "end unknown"
    else:
        end = "no collision"
    return _joined([scene_words(record), end], ": ")


def _joined(parts: Iterable[str | None], separator: str = ", ") -> str:
    return separator.join(part for part in parts if part)


def moment_words(dataset: Dataset, token: str) -> str:
    """Return the moment of a frame's token, and the agent of a sample's token.

    For example `1.0 s to the impact, ego behind`.
    """
    kind, name, *agents, number = token.split("/")[:4]
    frame = dataset.get("frame", f"{kind}/{name}/{number}")
    time_left = dataset.samples_of(frame)[0]["time_to_impact"]
    if time_left is None:
        moment = f"{frame['timestamp']:.1f} s"
    elif time_left == 0:
        moment = "the impact"
    else:
        moment = f"{time_left:.1f} s to the impact"
    return ", ".join([moment, *map(short_name, agents)])


def set_scene_title(
    target: Axes | Figure,
    dataset: Dataset,
    token: str,
    words: str = "",
    *,
    below: str = "",
    **style: Any,
) -> None:
    """Title axes or a figure `Town10HD, wet night: 1.0 s to the impact, ego`, and a small token.

    The title of a scenario or an actor begins with `scenario_words`. The token is that of a
    scenario, frame, sample, sensor file, box or actor; it is beneath the title. `words` follow on
    the same line, `below` on another one, and on a last one the words of `write_missing` for these
    axes, or for a figure's axes.
    """
    from matplotlib.axes import Axes

    if not current_style().titled:
        return
    kind, name, *parts = token.split("/")
    record = dataset.get("scenario", f"{kind}/{name}")
    is_whole_scenario = parts[:1] in ([], ["actor"])
    if is_whole_scenario:
        scene = scenario_words(record)
    else:
        scene = _joined([scene_words(record), moment_words(dataset, token)], ": ")
    axes: Any = target.axes
    if isinstance(target, Axes):
        axes = [target]
        style.setdefault("fontsize", "medium")
    missing_texts = [text for ax in axes for text in ax.texts if text.get_gid() == _LACKS_GID]
    lines = [_joined([scene, words]), below, "; ".join(_missing_parts(missing_texts))]
    set_title(target, _joined(lines, "\n"), token=token, **style)


def set_title(
    target: Axes | Figure,
    words: str,
    *,
    token: str = "",
    fontsize: float | str | None = None,
    **style: Any,
) -> None:
    """Give axes or a figure a title that fits the figure's width, and a token beneath it.

    Only some styles have tokens. If a line is a little too long, the letters are smaller. If it is
    far too long, it is broken, best after `/`, `:` or a comma. The title is centred as a block.
    """
    from matplotlib import rcParams
    from matplotlib.axes import Axes
    from matplotlib.font_manager import FontProperties

    is_panel, artist = isinstance(target, Axes), cast("Any", target)
    default_size = rcParams["axes.titlesize" if is_panel else "figure.titlesize"]
    font = FontProperties(size=fontsize or default_size)
    width = 72 * room_of(target)
    text, size = _fitted(words, font, width, text_size())
    shown_token = token if current_style().tokens else ""
    token_font = FontProperties(size=_TOKEN_SIZE_PT)
    token_text, token_size = _fitted(shown_token, token_font, width, _TOKEN_SIZE_PT)
    if token_text:
        # blank lines reserve the space for the token, so that the layout need not know of it
        token_lines = token_text.count("\n") + 1
        text += "\n " * math.ceil(token_size * token_lines / size)
    if is_panel:
        # matplotlib measures all ticks, again and again, to find a title's height
        style.setdefault("y", 1.0)
        title = artist.set_title(text, fontsize=size, **style)
    else:
        title = artist.suptitle(text, fontsize=size, **style)
    _write_token(target, token_text, token_size, title)


def _write_token(target: Any, token: str, size: float, title: Any) -> None:
    """Write a token in the lowest lines of a title's text, instead of an older one."""
    from matplotlib.text import Annotation

    figure = target.figure
    for artist in [*figure.artists]:
        if artist.get_gid() == _FOOT_GID and artist.xycoords is title:
            artist.remove()
    if not token:
        return
    annotation = Annotation(
        token,
        (0.5, 0),
        xycoords=title,
        annotation_clip=False,
        ha="center",
        va="bottom",
        fontsize=size,
        color=MUTED_COLOR,
        gid=_FOOT_GID,
    )
    figure.add_artist(annotation).set_in_layout(False)


def room_of(target: Axes | Figure, panel_share: float = _PANEL_SHARE) -> float:
    """Return the inches that words above or below a figure or a panel may take.

    They are a share of the figure's width, or a share of a panel's width.
    """
    from matplotlib.axes import Axes

    fig: Any = target.figure if isinstance(target, Axes) else target
    share, spec = _TITLE_SHARE, None
    if isinstance(target, Axes):
        share, spec = panel_share, target.get_subplotspec()
    if spec is not None:
        grid: Any = spec.get_gridspec()
        ratios = grid.get_width_ratios() or [1] * grid.ncols
        share *= sum(ratios[spec.colspan.start : spec.colspan.stop]) / sum(ratios)
    return float(share * fig.bbox.width / fig.dpi)


def _fitted(words: str, font: FontProperties, width: float, min_size: float) -> tuple[str, float]:
    """Return words in lines that fit a width (points), and the size of their letters.

    The size is at least `min_size` if possible.
    """
    size = font.get_size_in_points()
    line_width = _max_line_width(words, font)
    min_scale = max(_MIN_FONT_SCALE, min(1.0, min_size / size))
    if line_width > width / min_scale:
        words = "\n".join(_broken(line, width, font) for line in words.split("\n"))
        line_width = _max_line_width(words, font)
    return words, size * min(1.0, width / max(line_width, 1.0))


def _broken(line: str, width: float, font: FontProperties) -> str:
    """Return a line, broken so that each part fits a width (points), if possible."""
    lines = [""]
    for part in _BREAKS.split(line):
        if lines[-1] and text_width(lines[-1] + part.rstrip(), font) > width:
            lines.append("")
        lines[-1] += part
    return "\n".join(broken_line.rstrip() for broken_line in lines)


def _max_line_width(text: str, font: FontProperties) -> float:
    """Return the width of the longest line in points."""
    return max(text_width(line, font) for line in text.split("\n"))


def text_width(text: str, font: FontProperties) -> float:
    """Return the width of a line in points."""
    from matplotlib.font_manager import findfont

    return _width_in(findfont(font), text, font.get_size_in_points())


@lru_cache(maxsize=1024)  # a video writes the same words again and again
def _width_in(file: str, text: str, size: float) -> float:
    """Return the width of a line in a font's file, in points."""
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import text_to_path

    font = FontProperties(fname=file, size=size)
    if text:
        return float(text_to_path.get_text_width_height_descent(text, font, ismath=False)[0])
    return 0.0


def hue_meanings() -> dict[str, str]:
    """Return name → hue, for the colliding pair and the agents."""
    meanings = {"colliding pair": COLLIDER_COLOR}
    for agent, color in AGENT_COLORS.items():
        meanings[short_name(agent)] = color
    return meanings


def box_handles(colors: Collection[str]) -> list[Artist]:
    """Return handles for colours of boxes: a patch, or the mark of a class of small actors."""
    from matplotlib.colors import to_rgba
    from matplotlib.patches import Patch

    handles: list[Artist] = []
    for name, color in {**hue_meanings(), **category_colors()}.items():
        if color not in colors:
            continue
        if name in CATEGORY_MARKERS:
            handles.append(_mark(name, CATEGORY_MARKERS[name], color))
        else:
            handles.append(Patch(label=name, facecolor=to_rgba(color, 0.25), edgecolor=color))
    return handles


def agent_handles(agents: Collection[str]) -> list[Artist]:
    """Return a dot for each agent, in the order of all pictures."""
    names = in_drawing_order(agents)
    return [_mark(short_name(agent), "o", AGENT_COLORS[agent]) for agent in names]


def handles_from_above(colors: Collection[str], clouds: Collection[str]) -> list[Artist]:
    """Return handles for the colours of boxes and of agents' clouds, each once.

    In a small picture the names of agents are at their clouds.
    """
    cloud_colors = {AGENT_COLORS[agent] for agent in clouds}
    handles = box_handles(set(colors) - cloud_colors)
    if not current_style().few:
        handles += agent_handles(clouds)
    return handles


def _mark(label: str, marker: str, color: str) -> Artist:
    from matplotlib.lines import Line2D

    return Line2D([], [], linestyle="none", marker=marker, color=color, label=label)


def draw_legend(
    target: Any, handles: Sequence[Artist], *, columns: int | None = None, **style: Any
) -> None:
    """Render a legend, by default below all panels of a figure; none without handles.

    It has as many columns as fit.
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
    """Return how many columns, each as wide as its widest sign, fit a width (inches)."""
    for columns in range(min(max_columns, len(widths)), 1, -1):
        if sum(max(column) for column in np.array_split(widths, columns)) < width:
            return columns
    return 1


def draw_legend_outside(
    ax: Axes, handles: Sequence[Artist], *, columns: int | None = None, **style: Any
) -> None:
    """Render a legend below axes, or on a slide, which is wide, to their right."""
    anchor: dict[str, Any] = {
        "loc": "upper center",
        "bbox_to_anchor": (0.5, 0),
        "borderaxespad": 4.5,
    }
    if current_style().room == "slide":
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
    """Return whether a sensor's file, by its token, is present."""
    return dataset.sensor_path(sample_data).exists()


def has_cloud(dataset: Dataset, sample: str) -> bool:
    """Return whether the LiDAR file of a sample, by its token, is present."""
    return has_sensor_file(dataset, f"{sample}/{LIDAR}")


def draw_missing_image(dataset: Dataset, sample_data: str, ax: Axes) -> None:
    """Make axes a grey panel with the reason, at its top, why an image (a token) is missing.

    The words are beneath all data.
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
    """Return why a sensor's file, by its token, is missing.

    Its folder has files of other frames, or none at all.
    """
    folder = dataset.sensor_path(sample_data).parent
    if folder.is_dir() and folder_entries(folder):
        return "no file of this frame"
    return "not downloaded"


def write_missing(ax: Axes, words: str) -> None:
    """Add words on missing data to the title of axes or of their figure, which is set later.

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
    """Return words for missing files of a picture, or of the picture of these axes, each once."""
    figure: Any = picture.figure
    gids = (_MISSING_GID, _LACKS_GID)
    return _missing_parts(figure.findobj(lambda artist: artist.get_gid() in gids))


def _missing_parts(texts: Iterable[Any]) -> list[str]:
    """Return the words of texts on missing files, each once; agents without clouds in one part.

    The words are the texts' labels, after a `_`, which hides them from legends.
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
