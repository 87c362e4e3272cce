"""Colours of all pictures and pages, and the sizes of pictures in a paper or on a slide.

Saturated hues are reserved for the five agents. Red is reserved for the colliding pair; no colour
map contains it. Classes are shades of slate, and classes of small actors also have a marker shape.
Verdicts have muted colours that are no agent's hue. Hues also differ in lightness, for
colour-blind readers: `docs/check_colors.py` measures this, and a test asserts it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from threading import RLock
from types import MappingProxyType
from typing import Any, Final, Literal, TypeVar, cast, get_args

from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.support.pages import part
from deepaccident_devkit.support.text import choice
from deepaccident_devkit.support.values import ReadOnlyValues
from deepaccident_devkit.taxonomy import AGENTS, SPLITS, StyleName

# Blue, cyan, orange, dark yellow and purple; too pale for words on white, which are dark.
AGENT_COLORS: Mapping[str, str] = dict(
    zip(AGENTS, ("#2b6fe0", "#2fc0cc", "#fa7b40", "#dfb000", "#563083"), strict=True)
)
# The colliding pair.
COLLIDER_COLOR = "#c4001a"
CATEGORY_COLORS: Mapping[str, str] = {
    "car": "#63717e",
    "truck": "#323f4b",
    "van": "#94a2b0",
    "cyclist": "#4a5864",
    "motorcycle": "#7b8996",
    "pedestrian": "#1d272f",
}
# Hues of the classes, for pictures that are about classes. All readers, including colour-blind
# ones, can tell them from each other and from the pair's red.
CLASS_COLORS: Mapping[str, str] = {
    "car": "#40409f",
    "truck": "#402040",
    "van": "#9f9fdf",
    "cyclist": "#40bf9f",
    "motorcycle": "#ff8000",
    "pedestrian": "#9f00ff",
}
# matplotlib markers of the classes whose boxes are too small to notice from above.
CATEGORY_MARKERS: Mapping[str, str] = {"cyclist": "D", "motorcycle": "^", "pedestrian": "o"}
# Colours that the instances of motion maps take in turn.
INSTANCE_COLORS = ("#63717e", "#b5c3cf", "#4a5864", "#94a2b0", "#323f4b", "#7b8996")
# Mark for the recording agent itself, in addition to the colour of its role in the accident.
OWN_COLOR = "#111111"
# Edges around marks and lines that lie on pictures.
CASING_COLOR = "#ffffff"
# LiDAR points without a value for their colour.
POINT_COLOR = "#9a9a9a"
# LiDAR points in images; the nearest are yellow. No colour is too dark for the night.
DEPTH_COLORMAP = "summer_r"
HEIGHT_COLORMAP = "cividis"
# The same colours for pages, from low to high.
HEIGHT_COLORS = ("#00224e", "#434e6c", "#7d7c78", "#bcae6c", "#fee838")
CENTERNESS_COLORMAP = "Greys"
# Flow forward, to the left, backward and to the right; between them the colours are mixed.
DIRECTION_COLORS = ("#2a78c2", "#2a9d6f", "#c9b23a", "#8a5fb0")
# CARLA's tags in the BEV camera, in pale colours: boxes are rendered over them.
BEV_COLORS: Mapping[str, str] = {
    "road": "#e9e9ec",
    "road_line": "#ffffff",
    "sidewalk": "#f6f2ea",
    "vehicle": "#d3d9e0",
    "pedestrian": "#d3d9e0",
}
# The road alone: actors at one moment would be ghosts in a picture of several moments.
EMPTY_ROAD_COLORS: Mapping[str, str] = {
    **BEV_COLORS,
    "vehicle": BEV_COLORS["road"],
    "pedestrian": BEV_COLORS["road"],
}
# The ground of a town's map in a separate picture.
MAP_COLORS: Mapping[str, str] = {
    "road": "#868f98",
    "road_line": "#ffffff",
    "sidewalk": "#d8c8a0",
    "other": "#dde4e0",
}
GRID_COLOR = "#d0d0d0"
# The panel of a missing image.
MISSING_COLOR = "#dddddd"
# Less important words.
MUTED_COLOR = "#666666"
# The true position of something that is also rendered at another position.
TRUE_PLACE_COLOR = "#8a8a8a"
# Right predictions (green), false predictions (sand), and missed true objects (pale grey).
OUTCOME_COLORS: Mapping[str, str] = {"right": "#23644d", "false": "#a98c52", "missed": "#bcc0c3"}
# Predictions without a verdict: mauve.
PREDICTED_COLOR = "#a8679b"
# Lines or bars of one kind for several values of a setting, the strictest value first.
SERIES_COLORS = ("#1a3344", "#4b667c", "#8399ac", "#b5c3cf")
SPLIT_COLORS: Mapping[str, str] = dict(
    zip((*SPLITS, "unknown"), ("#284052", "#627a8e", "#9badbe", "#d3d8dc"), strict=True)
)
# A number with an interval.
ESTIMATE_COLOR = "#3d627d"
# Important words are dark brown, because red in a warning could suggest the colliding pair.
WARNING_COLOR = "#6b4a10"
# Links and the focus of the keyboard on pages.
LINK_COLOR = "#2f4a63"
# Background of a frame that is not recorded.
BEYOND_COLOR = "#e4e4e4"
# Colours of pages, dark on a system in dark mode.
COLORS: Final = f"""
:root {{ color-scheme: light; --paper: #fff; --ink: #1c1c1c; --soft: #444; --dim: #555; \
--line: #ececec;
  --rule: {GRID_COLOR}; --accent: {LINK_COLOR}; --caution: {WARNING_COLOR};
  --link: var(--accent); --warning: var(--caution); --block: #f3f3f3; --edge: #999; }}
@media screen and (prefers-color-scheme: dark) {{
  :root {{ color-scheme: dark; --paper: #181818; --ink: #e8e8e8; --soft: #c9c9c9; --dim: #a8a8a8; \
--line: #333;
    --rule: #535353; --link: color-mix(in srgb, var(--accent) 40%, #fff);
    --warning: color-mix(in srgb, var(--caution) 40%, #fff); --block: #292929; --edge: #777; }}
}}
"""
Renderer = TypeVar("Renderer", bound=Callable[..., Any])
# Approximate height of the words in a picture, in inches: they shrink less than the picture.
_WORDS_HEIGHT_IN = 0.5
# Height of a line of words with the space to the next line, over the size of its letters.
_LINE_HEIGHT = 1.45
# Type 42 keeps the letters of a PDF file as text, as publishers require.
_FONTS = {"pdf.fonttype": 42, "ps.fonttype": 42}
_applied_style: ContextVar[_Style | None] = ContextVar("applied", default=None)
_SETTINGS_LOCK = RLock()  # all threads share matplotlib's settings


def page_style() -> str:
    """Return the style rules of all pages except replays."""
    return COLORS + part("pages.css")


@dataclass(frozen=True, slots=True, kw_only=True)
class _Style:
    """Sizes and words of new pictures.

    Attributes:
        dpi: Resolution of files, pixels per inch.
        panel: Width of a picture with one panel, inches; None for the view's default.
        figure: Width of a picture with several panels, inches; None for the view's default.
        ratio: Width over height; None for the view's default.
        letters: Size of the smallest letters, points.
        layout: How a picture with several panels is laid out: in full, as wide as a page, in a
            column, or on a slide.
        tokens: Whether titles show tokens.
        titled: Whether pictures have a title.
        by_class: Whether boxes have the hues of their classes (the pair's boxes never do).
        rc: matplotlib settings.
    """

    dpi: float
    panel: float | None = None
    figure: float | None = None
    ratio: float | None = None
    letters: float = 9
    layout: Literal["all", "page", "column", "slide"] = "all"
    tokens: bool = True
    titled: bool = True
    by_class: bool = False
    rc: ReadOnlyValues

    @property
    def is_wide(self) -> bool:
        """Whether a map is wider than high, because it would be too high otherwise."""
        is_over_columns = self.layout == "page" and (self.panel or 0) > _MAX_COLUMN_WIDTH_IN
        return self.layout == "slide" or is_over_columns

    @property
    def shows_few_panels(self) -> bool:
        """Whether views with many panels show few of them."""
        return self.layout != "all"


def _small(letters: float, **options: Any) -> _Style:
    """Make a style for small pictures; `letters` is the font size in points."""
    rc = {
        **_FONTS,
        "font.size": letters,
        "axes.titlesize": letters,
        "figure.titlesize": letters + 1,
        "axes.linewidth": 0.6,
        "xtick.major.size": 2.5,
        "xtick.major.pad": 2.0,
        "ytick.major.size": 2.5,
        "ytick.major.pad": 2.0,
        "axes.labelpad": 2.0,
    }
    return _Style(letters=letters, tokens=False, rc=rc, **options)


def _printed(panel: float, figure: float) -> _Style:
    """Make a style for papers; `panel` and `figure` are widths in inches.

    DejaVu Sans at 7 points is as tall as Times at 9 points.
    """
    layout = "page"
    if figure < _MAX_COLUMN_WIDTH_IN:
        layout = "column"
    return _small(7, dpi=300, panel=panel, figure=figure, layout=layout)


# Width in inches below which a picture of a paper is one column wide.
_MAX_COLUMN_WIDTH_IN = 4.0
_STYLES: Mapping[str, _Style] = {
    "paper": _printed(3.5, 7.16),
    "cvpr-column": _printed(3.25, 3.25),
    "cvpr-page": _printed(6.875, 6.875),
    "ieee-column": _printed(3.5, 3.5),
    "ieee-page": _printed(7.16, 7.16),
    # letters of 8 points are large on a slide that is 8 inches wide
    "slide": _small(8, dpi=240, panel=8.0, figure=8.0, ratio=16 / 9, layout="slide"),
}


_NOTEBOOK_STYLE = _Style(dpi=100, rc=_FONTS)
_selected_style: ContextVar[_Style] = ContextVar("style", default=_NOTEBOOK_STYLE)


@contextmanager
def own_settings(style: _Style | None = None) -> Iterator[None]:
    """Replace the user's matplotlib settings by the defaults and a style's, in a `with` statement.

    None means the current style. All rendering uses this, so that a picture depends only on its
    style: a user's font, grid or `image.origin` could change the picture's meaning.
    """
    from matplotlib import style as styles

    applied = style or current_style()
    if _applied_style.get() is applied:
        yield
        return
    settings: Any = ["default", {**applied.rc, "savefig.dpi": applied.dpi}]
    with _SETTINGS_LOCK, styles.context(settings):
        token = _applied_style.set(applied)
        try:
            yield
        finally:
            _applied_style.reset(token)


def in_own_settings(function: Renderer) -> Renderer:
    """Decorate a function so that it renders within `own_settings`."""
    return own_settings()(function)


@contextmanager
def style(
    name: StyleName | None = None,
    *,
    title: bool = True,
    color_by: Literal["role", "class"] = "role",
) -> Iterator[None]:
    """Give new pictures the size, panels and letters of a paper or a slide, in a `with` statement.

    Args:
        name: `cvpr-column` (3.25 inches wide), `cvpr-page` (6.875), `ieee-column` (3.5) and
            `ieee-page` (7.16), for papers: letters of 7 points or more, 300 pixels per inch.
            `paper`: an IEEE column, or an IEEE page for several panels. `slide`: 16:9, with large
            letters, 1920 × 1080 pixels, or more for a figure with many rows. None: as in a
            notebook. In papers and on slides, views with many panels show fewer of them, and titles
            have no tokens. A single map is wider than high on a slide, `cvpr-page` and
            `ieee-page`.
        title: Whether pictures have a title; in a paper, the caption may replace it.
        color_by: What the colours of boxes mean: the `role` in the accident, or the `class`, with
            one hue per class. The pair is red in both.

    Raises:
        ChoiceError: `name` or `color_by` is unknown.
    """
    if name is not None and name not in _STYLES:
        raise ChoiceError(
            f"style: expected one of {', '.join(get_args(StyleName))}, found {name!r}"
        )
    by_class = choice("color_by", color_by, ("role", "class")) == "class"
    base = _NOTEBOOK_STYLE if name is None else _STYLES[name]
    selected = replace(base, titled=title, by_class=by_class)
    with using_style(selected):
        yield


@contextmanager
def using_style(selected: _Style) -> Iterator[None]:
    """Make new pictures in a style that `current_style` returned, in a `with` statement."""
    from matplotlib import rc_context

    token = _selected_style.set(selected)
    try:
        with rc_context(cast("Any", {**selected.rc, "savefig.dpi": selected.dpi})):
            yield
    finally:
        _selected_style.reset(token)


def current_style() -> _Style:
    """Return the style of new pictures."""
    return _selected_style.get()


def category_colors() -> Mapping[str, str]:
    """Return the colours of classes in new pictures."""
    if current_style().by_class:
        return CLASS_COLORS
    return CATEGORY_COLORS


def text_size() -> float:
    """Return the size of the smallest letters in new pictures, points; it is legible in print."""
    return current_style().letters


def lines_height(lines: float) -> float:
    """Return the height in inches of lines of the smallest letters in new pictures."""
    return lines * _LINE_HEIGHT * text_size() / 72


def size_in_style(
    size: tuple[float, float],
    *,
    panels: Literal["one", "several"],
    heights: Mapping[str, float] = MappingProxyType({}),
    lines: float = 0,
) -> tuple[float, float]:
    """Convert a picture's size in a notebook to its size in the current style, both in inches.

    `heights` are height-to-width ratios in `page` and `column`, for views that show different
    panels there. The picture is at least as high as `lines` lines of its smallest letters.
    """
    selected = current_style()
    width = selected.figure
    if panels == "one":
        width = selected.panel
    if width is None:
        width, height = size
    elif selected.ratio is not None:
        height = width / selected.ratio
    elif selected.layout in heights:
        height = width * heights[selected.layout]
    else:
        share = width / size[0]
        height = share * size[1] + max(0.0, 1 - share) * _WORDS_HEIGHT_IN
    needed_height = max(height, lines_height(lines))
    if selected.ratio is not None:
        width = max(width, needed_height * selected.ratio)
    return width, needed_height
