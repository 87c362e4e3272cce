"""Views of the tests' own, importable by workers; and what is in a file of them."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image, ImageSequence

STEP = 30
"""Of grey, from a frame to the next."""
SIZE = (160, 90)


def grey(dataset: Any, frame: Any, fig: Any) -> None:
    """All of the picture in a grey that tells the frame's number."""
    fig.set_facecolor((STEP * frame["index"] / 255,) * 3)


def colors(dataset: Any, frame: Any, fig: Any) -> None:
    """The left half red, the right half blue."""
    fig.set_layout_engine("none")
    fig.set_facecolor("blue")
    fig.add_axes((0, 0, 0.5, 1)).set(facecolor="red", xticks=(), yticks=())


def decoded(path: Path) -> list[Any]:
    """Its pictures (H, W, 3)."""
    if path.suffix == ".mp4":
        av = pytest.importorskip("av")
        with av.open(str(path)) as container:
            return [
                frame.to_ndarray(format="rgb24").astype(float)
                for frame in container.decode(video=0)
            ]
    with Image.open(path) as image:
        return [
            np.asarray(each.convert("RGB"), dtype=float) for each in ImageSequence.Iterator(image)
        ]


def greys(path: Path) -> list[int]:
    """The frame numbers that the pictures of `grey` tell."""
    pictures = decoded(path)
    assert all(np.ptp(picture) < 12 for picture in pictures)
    return [round(float(picture.mean()) / STEP) for picture in pictures]
