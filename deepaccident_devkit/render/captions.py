"""What a picture says of itself: its moment in words, what its colours mean, and which sensor files are not there."""

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

# Where a title is best broken.
_BREAKS: Final = re.compile(r"(?<=/)|(?<=, )|(?<=: )|(?<=; )")
# Of a figure's width that a title may take.
_TITLE_SHARE: Final = 0.92
# How small letters may become, by size, before a title is broken into lines.
_LEAST_SHRINKING: Final = 0.85
# Of a panel's width: what is beside the axes moves their title to one side, and few pixels make letters wider.
_PANEL_SHARE: Final = 0.78
# Points of a token's letters: it is there to be copied, not to be read.
_TOKEN_TEXT: Final = 7.5
# Marks the token in a figure.
_BENEATH: Final = "token"
_CAPITALS: Final = re.compile(r"(?<=[a-z])(?=[A-Z])")
# A place in axes, so that nothing stands beside them.
INSIDE: Final[Mapping[str, Any]] = {"loc": "upper right", "frameon": True, "framealpha": 0.85}
# Inches of a sign and the blanks around it, for letters of one point.
_HANDLE: Final = 0.044
# Of a panel's width, for a legend below it.
_LEGEND_SHARE: Final = 0.86
_SPACING: Final[Mapping[str, Any]] = {"handlelength": 1.2, "columnspacing": 1.0}
# Mark the words of a grey panel, and those for a title, so that `missing_words` finds them.
_MISSING, _LACKS = "missing", "lacks"
_NO_CLOUD: Final = "no LiDAR file of "


def scene_words(record: Mapping[str, Any]) -> str:
    """Where and when a scenario takes place, as far as meta says it: `Town10HD, wet night`."""
    weather = _CAPITALS.sub(" ", record["weather"] or "").lower()
    when = (" at " if weather.endswith("rain") else " ").join(
        filter(None, [weather, record["time_of_day"]])
    )
    return ", ".join(filter(None, [record["town"], when.lower()]))


def scenario_words(record: Mapping[str, Any]) -> str:
    """A scenario's name for readers: `Town02, wet night: car hits pedestrian`, cars first; or `…: no collision`."""
    told: Any = record["collision"]
    if told is None:
        end = "end unknown" if record["weather"] is None else "no collision"
    else:
        end = " hits ".join(sorted(told["classes"], key=(*CATEGORIES, *told["classes"]).index))
    return ": ".join(filter(None, [scene_words(record), end]))


def moment_words(dataset: Dataset, token: str) -> str:
    """The moment of a frame's token, or the moment and the agent of a sample's: `1.0 s to the impact, ego behind`."""
    kind, name, *names, number = token.split("/")[:4]
    frame = dataset.get("frame", f"{kind}/{name}/{number}")
    left = dataset.samples_of(frame)[0]["time_to_impact"]
    time = f"{frame['timestamp']:.1f} s" if left is None else f"{left:.1f} s to the impact"
    return ", ".join(["the impact" if left == 0 else time, *map(short_name, names)])


def set_scene_title(
    where: Axes | Figure,
    dataset: Dataset,
    token: str,
    words: str = "",
    *,
    below: str = "",
    **style: Any,
) -> None:
    """Title axes or a figure `Town10HD, wet night: 1.0 s to the impact, ego`, and a token small beneath.

    Of a scenario or an actor it begins with `scenario_words`. The token is that of a scenario, frame, sample, sensor
    file, box or actor; `words` follow on the same line, `below` on another one, and on a last one what `write_missing`
    was given of these axes, or of a figure's.
    """
    from matplotlib.axes import Axes

    if not current_style().titled:
        return
    kind, name, *rest = token.split("/")
    record = dataset.get("scenario", f"{kind}/{name}")
    whole = rest[:1] in ([], ["actor"])
    scene = (
        scenario_words(record)
        if whole
        else ": ".join(filter(None, [scene_words(record), moment_words(dataset, token)]))
    )
    if isinstance(where, Axes):
        style.setdefault("fontsize", "medium")
    first = ", ".join(filter(None, [scene, words]))
    axes: Any = [where] if isinstance(where, Axes) else where.axes
    absent = "; ".join(_parts(text for ax in axes for text in ax.texts if text.get_gid() == _LACKS))
    set_title(where, "\n".join(filter(None, [first, below, absent])), token=token, **style)


def set_title(
    where: Axes | Figure,
    words: str,
    *,
    token: str = "",
    fontsize: float | str | None = None,
    **style: Any,
) -> None:
    """Give axes or a figure a title that its figure's width does not cut off, and a token beneath if its style has any.

    If a line is a little too long, the letters are smaller. If it is far too long, it is broken, best after `/`, `:`
    or a comma. The whole of it, and not only a line, is centred.
    """
    from matplotlib import rcParams
    from matplotlib.axes import Axes
    from matplotlib.font_manager import FontProperties

    panel, drawn = isinstance(where, Axes), cast("Any", where)
    font = FontProperties(
        size=fontsize or rcParams["axes.titlesize" if panel else "figure.titlesize"]
    )
    room = 72 * room_of(where)
    text, size = _fitted(words, font, room, text_size())
    small, small_size = _fitted(
        token if current_style().tokens else "", FontProperties(size=_TOKEN_TEXT), room, _TOKEN_TEXT
    )
    # blank lines keep the room for the token, so that the layout need not know of it
    blank = math.ceil(small_size * (small.count("\n") + 1) / size) if small else 0
    text += "\n " * blank
    if panel:
        style.setdefault(
            "y", 1.0
        )  # matplotlib measures all ticks, again and again, to find a title's height
    title = (
        drawn.set_title(text, fontsize=size, **style)
        if panel
        else drawn.suptitle(text, fontsize=size, **style)
    )
    _write_token(where, small, small_size, title)


def _write_token(where: Any, token: str, size: float, title: Any) -> None:
    """Write a token in the lowest lines of a title's text, in place of an older one."""
    from matplotlib.text import Annotation

    figure = where.figure
    for older in [
        each for each in figure.artists if each.get_gid() == _BENEATH and each.xycoords is title
    ]:
        older.remove()
    if token:
        how: dict[str, Any] = {
            "ha": "center",
            "va": "bottom",
            "fontsize": size,
            "color": MUTED_COLOR,
            "gid": _BENEATH,
        }
        figure.add_artist(
            Annotation(token, (0.5, 0), xycoords=title, annotation_clip=False, **how)
        ).set_in_layout(False)


def room_of(where: Axes | Figure, panel_share: float = _PANEL_SHARE) -> float:
    """Inches of a figure's width, or of a panel's share of it, that words above or below may take."""
    from matplotlib.axes import Axes

    fig: Any = where.figure if isinstance(where, Axes) else where
    share, spec = _TITLE_SHARE, None
    if isinstance(where, Axes):
        share, spec = panel_share, where.get_subplotspec()
    if spec is not None:
        ratios: Any = spec.get_gridspec().get_width_ratios() or [1] * spec.get_gridspec().ncols
        share *= sum(ratios[spec.colspan.start : spec.colspan.stop]) / sum(ratios)
    return float(share * fig.bbox.width / fig.dpi)


def _fitted(words: str, font: FontProperties, room: float, least: float) -> tuple[str, float]:
    """The words in lines that have room (points), and the size of their letters, if possible at least `least`."""
    size = font.get_size_in_points()
    longest = _longest(words, font)
    if longest > room / max(_LEAST_SHRINKING, min(1.0, least / size)):
        words = "\n".join(_broken(line, room, font) for line in words.split("\n"))
        longest = _longest(words, font)
    return words, size * min(1.0, room / max(longest, 1.0))


def _broken(line: str, room: float, font: FontProperties) -> str:
    """A line, broken where it may be so that each part has room (points), if possible."""
    lines = [""]
    for part in _BREAKS.split(line):
        if lines[-1] and text_width(lines[-1] + part.rstrip(), font) > room:
            lines.append("")
        lines[-1] += part
    return "\n".join(each.rstrip() for each in lines)


def _longest(text: str, font: FontProperties) -> float:
    """Points of the longest line."""
    return max(text_width(line, font) for line in text.split("\n"))


def text_width(text: str, font: FontProperties) -> float:
    """Points of a line."""
    from matplotlib.font_manager import findfont

    return _width_in(findfont(font), text, font.get_size_in_points())


@lru_cache(maxsize=1024)  # a video writes the same words again and again
def _width_in(file: str, text: str, size: float) -> float:
    """Points of a line in a font's file."""
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import text_to_path

    font = FontProperties(fname=file, size=size)
    return (
        float(text_to_path.get_text_width_height_descent(text, font, ismath=False)[0])
        if text
        else 0.0
    )


def box_handles(colors: Collection[str]) -> list[Artist]:
    """What these colours of boxes mean: a patch for each, or the mark of a class of small actors."""
    from matplotlib.colors import to_rgba
    from matplotlib.patches import Patch

    agents = {short_name(agent): color for agent, color in AGENT_COLORS.items()}
    meanings = {"colliding pair": COLLIDER_COLOR, **agents, **category_colors()}
    return [
        _mark(name, CATEGORY_MARKERS[name], color)
        if name in CATEGORY_MARKERS
        else Patch(label=name, facecolor=to_rgba(color, 0.25), edgecolor=color)
        for name, color in meanings.items()
        if color in colors
    ]


def agent_handles(agents: Collection[str]) -> list[Artist]:
    """A dot for each agent, in the order of all pictures."""
    return [
        _mark(short_name(agent), "o", AGENT_COLORS[agent]) for agent in in_drawing_order(agents)
    ]


def handles_from_above(colors: Collection[str], clouds: Collection[str]) -> list[Artist]:
    """What the colours of boxes and of agents' clouds mean, each once; in a small picture names stand at the clouds."""
    known = {AGENT_COLORS[agent] for agent in clouds}
    return [
        *box_handles(set(colors) - known),
        *agent_handles(() if current_style().few else clouds),
    ]


def _mark(label: str, marker: str, color: str) -> Artist:
    from matplotlib.lines import Line2D

    return Line2D([], [], linestyle="none", marker=marker, color=color, label=label)


def draw_legend(
    where: Any, handles: Sequence[Artist], *, columns: int | None = None, **how: Any
) -> None:
    """Render a legend, by default below all panels of a figure, with as many columns as have room; none if empty."""
    from matplotlib.font_manager import FontProperties

    if handles:
        font = FontProperties(size=text_size())
        widths = [
            text_width(str(handle.get_label()), font) / 72 + _HANDLE * text_size()
            for handle in handles
        ]
        columns = _columns_with_room(widths, columns or len(handles), room_of(where, _LEGEND_SHARE))
        style = {
            "loc": "outside lower center",
            "fontsize": text_size(),
            "frameon": False,
            **_SPACING,
            **how,
        }
        where.legend(handles=list(handles), ncols=columns, **style)


def _columns_with_room(widths: Sequence[float], most: int, room: float) -> int:
    """How many columns at most, each as wide as its widest sign, have room (inches)."""
    for columns in range(min(most, len(widths)), 1, -1):
        if sum(max(column) for column in np.array_split(widths, columns)) < room:
            return columns
    return 1


def draw_legend_outside(
    ax: Axes, handles: Sequence[Artist], *, columns: int | None = None, **how: Any
) -> None:
    """Render a legend below axes, or on a slide, which is wide, to their right."""
    place: dict[str, Any] = {
        "loc": "upper center",
        "bbox_to_anchor": (0.5, 0),
        "borderaxespad": 4.5,
    }
    if current_style().room == "slide":
        columns, place = 1, {"loc": "upper left", "bbox_to_anchor": (1, 1), "borderaxespad": 0.5}
    draw_legend(ax, handles, columns=columns, **{**place, **how})


def draw_legend_of_fills(ax: Axes, colors: Mapping[str, str]) -> None:
    """Put a legend of filled shapes into the axes."""
    from matplotlib.patches import Patch

    handles = [
        Patch(label=name, facecolor=(color, 0.4), edgecolor=color) for name, color in colors.items()
    ]
    draw_legend(ax, handles, columns=1, **INSIDE)


def is_there(dataset: Dataset, sample_data: str) -> bool:
    """Whether a sensor's file, by its token, is there."""
    return dataset.sensor_path(sample_data).exists()


def has_cloud(dataset: Dataset, sample: str) -> bool:
    """Whether the LiDAR file of a sample, by its token, is there."""
    return is_there(dataset, f"{sample}/{LIDAR}")


def draw_missing_image(dataset: Dataset, sample_data: str, ax: Axes) -> None:
    """Make axes a grey panel that says, at its top and beneath all data, why an image (a token) is not there."""
    agent, _, channel = sample_data.rsplit("/", 3)[1:]
    ax.set_facecolor(MISSING_COLOR)
    words = absence_text(dataset, sample_data)
    how: dict[str, Any] = {
        "ha": "center",
        "va": "top",
        "clip_on": True,
        "in_layout": False,
        "gid": _MISSING,
    }
    told = f"_{agent} {channel}: {words}"
    ax.text(
        0.5, 0.97, words, label=told, fontsize=text_size(), transform=ax.transAxes, zorder=0, **how
    )


def absence_text(dataset: Dataset, sample_data: str) -> str:
    """Why a sensor's file, by its token, is not there: the folder has files of other frames, or none at all."""
    folder = dataset.sensor_path(sample_data).parent
    return (
        "no file of this frame" if folder.is_dir() and folder_entries(folder) else "not downloaded"
    )


def write_missing(ax: Axes, words: str) -> None:
    """Have the title of axes or of their figure, which is set later, say what is not in the picture; or nothing."""
    if words:
        ax.text(0, 0, "", label=f"_{words}", gid=_LACKS, visible=False)


def missing_clouds_text(agents: Collection[str]) -> str:
    """`no LiDAR file of ego_vehicle, infrastructure`; empty if it is nobody."""
    return f"{_NO_CLOUD}{', '.join(in_drawing_order(agents))}" if agents else ""


def missing_words(drawn: Axes | Figure) -> list[str]:
    """What a picture, or the picture of these axes, lacks because files are not there, each once."""
    figure: Any = drawn.figure
    return _parts(figure.findobj(lambda artist: artist.get_gid() in (_MISSING, _LACKS)))


def _parts(texts: Iterable[Any]) -> list[str]:
    """What texts say of files that are not there, each once; whose clouds in one part.

    Their labels say it, after a `_`, with which no legend has them.
    """
    parts = list(
        dict.fromkeys(part for text in texts for part in text.get_label()[1:].split("; ") if part)
    )
    clouds = [part.removeprefix(_NO_CLOUD) for part in parts if part.startswith(_NO_CLOUD)]
    others = [part for part in parts if not part.startswith(_NO_CLOUD)]
    return [
        *others,
        *filter(None, [missing_clouds_text({*filter(None, ", ".join(clouds).split(", "))})]),
    ]
