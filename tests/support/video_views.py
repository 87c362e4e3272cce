"""Video views for tests, importable by worker processes, and readers of the video files."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image, ImageSequence

GREY_STEP = 30
"""Difference in grey level between consecutive frames, of 255."""
IMAGE_SIZE = (160, 90)
"""Width and height, pixels."""


def draw_grey(dataset: Any, frame: Any, fig: Any) -> None:
    """Fill the picture with a grey that encodes the frame's number."""
    level = GREY_STEP * frame["index"] / 255
    fig.set_facecolor((level, level, level))


def draw_colors(dataset: Any, frame: Any, fig: Any) -> None:
    """Fill the left half with red and the right half with blue."""
    fig.set_layout_engine("none")
    fig.set_facecolor("blue")
    fig.add_axes((0, 0, 0.5, 1)).set(facecolor="red", xticks=(), yticks=())


def decode_video(path: Path) -> list[Any]:
    """Decode the pictures (H, W, 3) of a video or an animation."""
    if path.suffix == ".mp4":
        av = pytest.importorskip("av")
        with av.open(str(path)) as container:
            return [
                frame.to_ndarray(format="rgb24").astype(float)
                for frame in container.decode(video=0)
            ]
    with Image.open(path) as animation:
        return [
            np.asarray(frame.convert("RGB"), dtype=float)
            for frame in ImageSequence.Iterator(animation)
        ]


def grey_frame_numbers(path: Path) -> list[int]:
    """Read the frame numbers back from the pictures that `draw_grey` filled."""
    pictures = decode_video(path)
    assert all(np.ptp(picture) < 12 for picture in pictures)
    return [round(float(picture.mean()) / GREY_STEP) for picture in pictures]
