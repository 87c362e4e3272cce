"""The titles of pictures: a moment in words, and its token small beneath; nothing is cut off."""

from __future__ import annotations

import math
import re
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final, cast

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.render.chips import SMALLEST_TEXT
from deepaccident_devkit.render.colors import MUTED_COLOR
from deepaccident_devkit.render.styles import current_style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.font_manager import FontProperties

_BREAKS: Final = re.compile(r"(?<=/)|(?<=, )|(?<=: )|(?<=; )")
"""Where a title is best broken."""
_TITLE_SHARE: Final = 0.92
"""Of a figure's width that a title may take."""
_LEAST_SHRINKING: Final = 0.85
"""How small letters may become, by size, before a title is broken into lines."""
_PANEL_SHARE: Final = 0.78
"""Of a panel's width: what is beside the axes moves their title to one side, and few pixels make letters wider."""
_TOKEN_TEXT: Final = 7.5
"""Points of a token's letters: it is there to be copied, not to be read."""
_GID: Final = "token"
"""Marks the token in a figure."""
_CAPITALS: Final = re.compile(r"(?<=[a-z])(?=[A-Z])")


def scene_words(dataset: Dataset, scenario: str) -> str:
    """When and where a scenario (a token) takes place, as far as meta says it: `Night, hard rain, Town10HD`."""
    record = dataset.get("scenario", scenario)
    weather = _CAPITALS.sub(" ", record["weather"] or "").lower()
    words = ", ".join(filter(None, [record["time_of_day"], weather]))
    return ", ".join(filter(None, [words[:1].upper() + words[1:], record["town"]]))


def moment_words(dataset: Dataset, token: str) -> str:
    """The moment of a frame's token, or the moment and the agent of a sample's: `1.0 s to the impact, ego vehicle`."""
    kind, name, *names, number = token.split("/")[:4]
    frame = dataset.get("frame", f"{kind}/{name}/{number}")
    left = dataset.samples_of(frame)[0]["time_to_impact"]
    time = f"{frame['timestamp']:.1f} s" if left is None else f"{left:.1f} s to the impact"
    return ", ".join(["the impact" if left == 0 else time, *(agent.replace("_", " ") for agent in names)])


def set_scene_title(
    where: Axes | Figure, dataset: Dataset, token: str, words: str = "", *, below: str = "", **style: Any
) -> None:
    """Give axes or a figure a title: `Night, hard rain, Town10HD: 1.0 s to the impact, ego vehicle`, and the token.

    Args:
        where: axes or a figure.
        dataset: the release.
        token: what is shown: a scenario, frame, sample, sensor file, box or actor.
        words: more about it, on the same line.
        below: another line.
        style: as `set_title` takes it.
    """
    from matplotlib.axes import Axes

    kind, name, *rest = token.split("/")
    moment = "" if rest[:1] in ([], ["actor"]) else moment_words(dataset, token)
    said = ", ".join(filter(None, [moment, words]))
    if isinstance(where, Axes):
        style.setdefault("fontsize", "medium")
    first = ": ".join(filter(None, [scene_words(dataset, f"{kind}/{name}"), said]))
    set_title(where, "\n".join(filter(None, [first, below])), token=token, **style)


def set_title(
    where: Axes | Figure, words: str, *, token: str = "", fontsize: float | str | None = None, **style: Any
) -> None:
    """Give axes or a figure a title that its figure's width does not cut off.

    If a line is a little too long, the letters are smaller. If it is far too long, it is broken, best after `/`, `:`
    or a comma.

    Args:
        where: axes or a figure.
        words: the title; the whole of it, and not only a line, is centred.
        token: written small beneath, unless the style has no tokens.
        fontsize: of the title; None for matplotlib's.
        style: matplotlib's arguments for the title.
    """
    from matplotlib import rcParams
    from matplotlib.axes import Axes
    from matplotlib.font_manager import FontProperties

    panel, drawn = isinstance(where, Axes), cast("Any", where)
    font = FontProperties(size=fontsize or rcParams["axes.titlesize" if panel else "figure.titlesize"])
    room = 72 * room_of(where)
    text, size = _fitted(words, font, room, SMALLEST_TEXT)
    small, small_size = _fitted(
        token if current_style().tokens else "", FontProperties(size=_TOKEN_TEXT), room, _TOKEN_TEXT
    )
    # blank lines keep the room for the token, so that the layout need not know of it
    blank = math.ceil(small_size * (small.count("\n") + 1) / size) if small else 0
    text += "\n " * blank
    if panel:
        style.setdefault("y", 1.0)  # matplotlib measures all ticks, again and again, to find a title's height
    title = drawn.set_title(text, fontsize=size, **style) if panel else drawn.suptitle(text, fontsize=size, **style)
    _write_token(where, small, small_size, title)


def _write_token(where: Any, token: str, size: float, title: Any) -> None:
    """Write a token in the lowest lines of a title's text, in place of an older one."""
    from matplotlib.text import Annotation

    figure = where.figure
    for older in [each for each in figure.artists if each.get_gid() == _GID and each.xycoords is title]:
        older.remove()
    if token:
        how: dict[str, Any] = {"ha": "center", "va": "bottom", "fontsize": size, "color": MUTED_COLOR, "gid": _GID}
        figure.add_artist(Annotation(token, (0.5, 0), xycoords=title, annotation_clip=False, **how)).set_in_layout(
            False
        )


def room_of(where: Axes | Figure) -> float:
    """Inches of a figure's width, or of a panel's share of it, that words above or below may take."""
    from matplotlib.axes import Axes

    fig: Any = where.figure if isinstance(where, Axes) else where
    share, spec = _TITLE_SHARE, None
    if isinstance(where, Axes):
        share, spec = _PANEL_SHARE, where.get_subplotspec()
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
    return float(text_to_path.get_text_width_height_descent(text, font, ismath=False)[0]) if text else 0.0
