"""Views of the tests' own, importable by workers."""

from typing import Any

STEP = 30
"""Of grey, from a frame to the next."""


def grey(dataset: Any, frame: Any, fig: Any) -> None:
    """All of the picture in a grey that tells the frame's number."""
    fig.set_facecolor((STEP * frame["index"] / 255,) * 3)


def colors(dataset: Any, frame: Any, fig: Any) -> None:
    """The left half red, the right half blue."""
    fig.set_layout_engine("none")
    fig.set_facecolor("blue")
    fig.add_axes((0, 0, 0.5, 1)).set(facecolor="red", xticks=(), yticks=())
