"""Check the texts of any figure: they must be readable, inside the figure and apart."""

from itertools import combinations
from typing import Any, get_args

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.text import Text

from deepaccident_devkit.render.figures import laid_out
from deepaccident_devkit.render.styles import text_size
from deepaccident_devkit.taxonomy import StyleName

STYLES: tuple[StyleName | None, ...] = (None, *get_args(StyleName))
"""Every style of figures; None is a notebook's."""
MAX_TOUCHING_POINTS = 1.0
"""Overlap at each edge that is tolerated, as letters do not fill the boxes of their texts."""


def find_text_faults(figure: Any) -> list[str]:
    """List the texts of a figure that are outside of it, over another one or too small.

    A token may be small, and it may be on its own title, which leaves room for it.
    """
    with laid_out(figure, figure.dpi):
        FigureCanvasAgg(figure).draw()  # as it is saved
    tolerance = MAX_TOUCHING_POINTS * figure.dpi / 72
    page = figure.bbox.padded(tolerance)
    boxes = [
        (text, text.get_window_extent().padded(-tolerance))
        for text in _rendered_texts(figure)
        if text.get_visible() and text.get_text().strip()
    ]

    faults = [
        f"{text.get_text()!r}: outside"
        for text, box in boxes
        if not (page.fully_contains(box.x0, box.y0) and page.fully_contains(box.x1, box.y1))
    ]
    faults += [
        f"{text.get_text()!r}: {text.get_fontsize():.1f} points"
        for text, _ in boxes
        if text.get_fontsize() < text_size() - 1e-6 and not _is_token(text)
    ]
    faults += [
        f"{first.get_text()!r} over {second.get_text()!r}"
        for (first, first_box), (second, second_box) in combinations(boxes, 2)
        if first_box.fully_overlaps(second_box) and not _is_token_of(first, second)
    ]
    return faults


def _is_token(text: Any) -> bool:
    return bool(text.get_gid() == "token")


def _is_token_of(first: Any, second: Any) -> bool:
    """Return whether one of two texts is the token of the other, which is a title."""
    return any(
        _is_token(token) and token.xycoords is title
        for token, title in ((first, second), (second, first))
    )


def panel_area_ratio(figure: Any) -> float:
    """Return the panels' share of the canvas; axes that are switched off hold only words."""
    panels = [ax.get_window_extent() for ax in figure.axes if ax.axison]
    panel_area = sum(panel.width * panel.height for panel in panels)
    return float(panel_area / (figure.bbox.width * figure.bbox.height))


def _rendered_texts(figure: Any) -> list[Any]:
    """Return the texts that are rendered: none that are clipped, out of range or on hidden axes."""
    hidden: set[Text] = set()
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            visible = {axis.label, axis.offsetText}
            for tick in axis._update_ticks():
                visible.update((tick.label1, tick.label2))
            texts = axis.findobj(Text)
            is_shown = axes.axison and axis.get_visible()
            hidden.update(text for text in texts if not is_shown or text not in visible)
        clipped = [text for text in axes.texts if text.get_clip_on()]
        hidden.update(text for text in clipped if not axes.bbox.overlaps(text.get_window_extent()))
    return [text for text in figure.findobj(Text) if text not in hidden]
