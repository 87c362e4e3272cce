"""Where a picture is shown: in a notebook, in a paper, or on a slide."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from threading import RLock
from typing import Any, Final, Literal, TypeVar, cast, get_args

from deepaccident_devkit.errors import ChoiceError

Drawing = TypeVar("Drawing", bound=Callable[..., Any])
StyleName = Literal["paper", "slide"]
_ROOM_FOR_WORDS: Final = 0.8
"""Inches of a picture's height that words take, about: they do not shrink with the picture."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Style:
    """Sizes and words of new pictures.

    Attributes:
        dpi: pixels an inch, for what is written.
        panel: inches of the width of a picture with one panel; None for the view's own.
        figure: the same with several panels.
        ratio: width by height; None for the view's own.
        tokens: whether titles have tokens.
        rc: matplotlib's settings.
    """

    dpi: float
    panel: float | None = None
    figure: float | None = None
    ratio: float | None = None
    tokens: bool = True
    rc: Mapping[str, Any]


_TEXT: Final = {"font.size": 9, "axes.titlesize": 9, "figure.titlesize": 10, "pdf.fonttype": 42, "ps.fonttype": 42}
_STYLES: Final[Mapping[str, _Style]] = {
    "paper": _Style(dpi=300, panel=3.5, figure=7.2, tokens=False, rc=_TEXT),
    # letters of 9 points are large on a slide that is 8 inches wide
    "slide": _Style(dpi=240, panel=8.0, figure=8.0, ratio=16 / 9, tokens=False, rc=_TEXT),
}
_NOTEBOOK: Final = _Style(dpi=100, rc={})
_current: ContextVar[_Style] = ContextVar("style", default=_NOTEBOOK)
_applied: ContextVar[_Style | None] = ContextVar("applied", default=None)
_ONE_AT_A_TIME: Final = RLock()  # matplotlib has its settings once for all threads


@contextmanager
def own_settings(style: _Style | None = None) -> Iterator[None]:
    """Matplotlib's own settings and those of a style, in place of the user's; for `with`, or before a function.

    All that renders passes here, so that a picture depends on nothing but its style: a user's font, grid or
    `image.origin` would change what it says.

    Args:
        style: None for the current one.
    """
    from matplotlib import style as styles

    chosen = style or current_style()
    if _applied.get() is chosen:
        yield
        return
    settings: Any = ["default", {**chosen.rc, "savefig.dpi": chosen.dpi}]
    with _ONE_AT_A_TIME, styles.context(settings):
        token = _applied.set(chosen)
        try:
            yield
        finally:
            _applied.reset(token)


def in_own_settings(function: Drawing) -> Drawing:
    """Before a function that renders: it does so with `own_settings`."""
    return own_settings()(function)


@contextmanager
def style(name: StyleName) -> Iterator[None]:
    """In a `with` statement: new pictures have the size and the letters that a paper or a slide needs.

    Args:
        name: `paper`: 3.5 inches wide, or with several panels 7.2 (one and two columns), letters of 9 points or more,
            fonts embedded in PDF, 300 pixels an inch. `slide`: 16 to 9, with large letters, 1920 × 1080 pixels.
            Neither has tokens.

    Raises:
        ChoiceError: no such style.
    """
    from matplotlib import rc_context

    if name not in _STYLES:
        raise ChoiceError(f"style: expected {' or '.join(get_args(StyleName))}, found {name!r}")
    chosen = _STYLES[name]
    token = _current.set(chosen)
    try:
        with rc_context(cast("Any", {**chosen.rc, "savefig.dpi": chosen.dpi})):
            yield
    finally:
        _current.reset(token)


def current_style() -> _Style:
    """The style of pictures that are made now."""
    return _current.get()


def size_in_style(size: tuple[float, float], *, panels: Literal["one", "several"]) -> tuple[float, float]:
    """Inches in the current style of a picture that would have this size in a notebook."""
    chosen = _current.get()
    width = chosen.panel if panels == "one" else chosen.figure
    if width is None:
        return size
    if chosen.ratio is not None:
        return width, width / chosen.ratio
    share = width / size[0]
    return width, share * size[1] + max(0.0, 1 - share) * _ROOM_FOR_WORDS
