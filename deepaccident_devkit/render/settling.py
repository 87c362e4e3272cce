"""Room for words around panels of equal scales."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def settled(fig: Figure) -> Figure:
    """The figure, laid out once.

    matplotlib measures the room for titles and legends on panels as they are before it makes their scales equal, so
    that it takes too little of it; laid out again at drawing, it starts from panels that are nearly right.
    """
    engine = fig.get_layout_engine() if fig.figure is fig else None  # a part of a figure is laid out with it
    if engine is not None:
        engine.execute(fig)
    return fig
