"""Writing pictures into files."""

from __future__ import annotations

import io
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.render.axes import detached_figure, settled
from deepaccident_devkit.render.styles import current_style
from deepaccident_devkit.support.files import replacing
from deepaccident_devkit.support.text import path_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_UNDATED: Final[Mapping[str, dict[str, Any]]] = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}
PICTURE_SUFFIXES: Final = (".png", ".pdf", ".svg", ".jpg", ".webp")


def check_picture_path(path: str | os.PathLike[str]) -> Path:
    """The path, if it has the suffix of a picture; raises ChoiceError."""
    path = path_of(path)
    if path.suffix.lower() not in PICTURE_SUFFIXES:
        raise ChoiceError(f"path: expected a file that ends in {', '.join(PICTURE_SUFFIXES)}, found {str(path)!r}")
    return path


def figure_of_pixels(width: int, height: int, *, dpi: float) -> Figure:
    """A figure that pyplot does not know, whose picture has exactly this width and height."""
    whole = 1e-3  # a canvas drops fractions of pixels, and inches are rounded
    figure = detached_figure(((width + whole) / dpi, (height + whole) / dpi))
    figure.set_dpi(dpi)
    return figure


def save_picture(drawn: Axes | Figure, path: str | os.PathLike[str], *, dpi: float | None = None) -> Path:
    """Write the result of a `render_…` function atomically into a file, which it replaces, and close it in pyplot.

    Args:
        drawn: a figure, or axes, whose whole figure is written.
        path: the file, by its suffix one of `PICTURE_SUFFIXES`.
        dpi: pixels an inch; None for those of the style, in a notebook's 100.

    Returns:
        The path written.

    Raises:
        ChoiceError: no such kind of file.
    """
    from matplotlib import pyplot as plt

    path = check_picture_path(path)
    figure: Any = drawn.figure
    try:
        return write_figure(figure, path, dpi=dpi or current_style().dpi)
    finally:
        plt.close(figure)


def write_figure(figure: Figure, path: Path, *, dpi: float, words: dict[str, Any] | None = None) -> Path:
    """Write a figure as the path's suffix says, atomically and without a date: the same picture makes the same bytes.

    Args:
        figure: from `detached_figure`; others stay open in pyplot.
        path: a file that is there is replaced.
        dpi: pixels an inch.
        words: the text entries of a PNG file.

    Returns:
        The path.
    """
    kind = path.suffix[1:].lower()
    with replacing(path) as temporary:
        settled(figure, passes=3).savefig(temporary, format=kind, dpi=dpi, metadata=_UNDATED.get(kind, words))
    return path


def figure_png(figure: Figure, *, dpi: float) -> bytes:
    """A figure from `detached_figure` as the bytes of a PNG file."""
    written = io.BytesIO()
    settled(figure, passes=3).savefig(written, format="png", dpi=dpi)
    return written.getvalue()
