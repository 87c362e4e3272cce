"""What tests of all views ask of their texts: that they can be read, are in the picture, and do not
overlap.
"""

from itertools import combinations
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.text import Text

from deepaccident_devkit.render.figures import laid_out
from deepaccident_devkit.render.styles import text_size

TOUCHING = 1.5
"""Pixels that count as nothing: letters do not fill the boxes of their texts."""


def text_faults(figure: Any) -> list[str]:
    """What is wrong with the texts of a figure: outside of it, over another one, or too small;
    empty if nothing is.

    A token may be small, and is in the room that its title has for it.
    """
    with laid_out(figure, figure.dpi):
        FigureCanvasAgg(figure).draw()  # as it is saved
    texts = [text for text in _drawn(figure) if text.get_visible() and text.get_text().strip()]
    page = figure.bbox.padded(TOUCHING)
    boxes = [
        (text, text.get_window_extent().padded(-TOUCHING))
        for text in texts
        if text.get_gid() != "token"
    ]
    faults = [
        f"{text.get_text()!r}: outside"
        for text, box in boxes
        if not (page.fully_contains(box.x0, box.y0) and page.fully_contains(box.x1, box.y1))
    ]
    faults += [
        f"{text.get_text()!r}: {text.get_fontsize():.1f} points"
        for text, _ in boxes
        if text.get_fontsize() < text_size() - 1e-6
    ]
    pairs = combinations(boxes, 2)
    faults += [
        f"{a.get_text()!r} over {b.get_text()!r}"
        for (a, one), (b, other) in pairs
        if one.fully_overlaps(other)
    ]
    return faults


def panels_share(figure: Any) -> float:
    """Which share of a figure's canvas its panels are: axes that are switched off only hold
    words.
    """
    areas = [ax.get_window_extent() for ax in figure.axes if ax.axison]
    return float(
        sum(area.width * area.height for area in areas) / (figure.bbox.width * figure.bbox.height)
    )


def _drawn(figure: Any) -> list[Any]:
    """The texts of a figure that are rendered: not those of ticks out of range, of axes that are
    off, or clipped.
    """
    hidden: set[Text] = set()
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            ticks = axis._update_ticks()
            shown = {
                axis.label,
                axis.offsetText,
                *(each for tick in ticks for each in (tick.label1, tick.label2)),
            }
            off = not (axes.axison and axis.get_visible())
            hidden.update(each for each in axis.findobj(Text) if off or each not in shown)
        clipped = [text for text in axes.texts if text.get_clip_on()]
        hidden.update(text for text in clipped if not axes.bbox.overlaps(text.get_window_extent()))
    return [text for text in figure.findobj(Text) if text not in hidden]
