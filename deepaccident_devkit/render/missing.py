"""What a picture says of sensor files that are not there: a grey panel, or words in a corner."""

from __future__ import annotations

import textwrap
from collections.abc import Collection
from typing import TYPE_CHECKING, Any, Final

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.release.store import listed
from deepaccident_devkit.render.chips import SMALLEST_TEXT
from deepaccident_devkit.render.colors import MISSING_COLOR
from deepaccident_devkit.render.roles import in_drawing_order
from deepaccident_devkit.taxonomy import LIDAR

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_GID: Final = "missing"
"""Marks the words in a figure, so that `missing_words` finds them."""
_LETTERS: Final = 50
"""In a line of a corner."""


def is_there(dataset: Dataset, sample_data: str) -> bool:
    """Whether a sensor's file, by its token, is there."""
    return dataset.sensor_path(sample_data).exists()


def has_cloud(dataset: Dataset, sample: str) -> bool:
    """Whether the LiDAR file of a sample, by its token, is there."""
    return is_there(dataset, f"{sample}/{LIDAR}")


def draw_missing_image(dataset: Dataset, sample_data: str, ax: Axes) -> None:
    """Make axes a grey panel that names the agent and the camera of an image (a token) that is not there."""
    agent, _, channel = sample_data.rsplit("/", 3)[1:]
    ax.set_facecolor(MISSING_COLOR)
    words = f"{agent}\n{channel}:\n{absence_text(dataset, sample_data)}"
    ax.text(0.5, 0.95, words, ha="center", va="top", fontsize=SMALLEST_TEXT, transform=ax.transAxes, gid=_GID)


def absence_text(dataset: Dataset, sample_data: str) -> str:
    """Why a sensor's file, by its token, is not there: the folder has files of other frames, or none at all."""
    folder = dataset.sensor_path(sample_data).parent
    return "no file of this frame" if folder.is_dir() and listed(folder) else "not downloaded"


def write_missing(ax: Axes, words: str) -> None:
    """Write into the lower left corner of axes what is not in the picture; nothing if there are no words."""
    if words:
        paper = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.5}
        text = textwrap.fill(words, _LETTERS)
        style: dict[str, Any] = {"fontsize": SMALLEST_TEXT, "bbox": paper, "zorder": 8, "gid": _GID}
        ax.annotate(text, (0, 0), (4, 4), xycoords="axes fraction", textcoords="offset points", **style)


def missing_clouds_text(agents: Collection[str]) -> str:
    """`no LiDAR file of ego_vehicle, infrastructure`; empty if it is nobody."""
    return f"no LiDAR file of {', '.join(in_drawing_order(agents))}" if agents else ""


def missing_words(drawn: Axes | Figure) -> list[str]:
    """What a picture, or the picture of these axes, says of files that are not there, each once."""
    figure: Any = drawn.figure
    texts = figure.findobj(lambda artist: artist.get_gid() == _GID)
    words = (" ".join(text.get_text().split()) for text in texts)
    return list(dict.fromkeys(part for text in words for part in text.split("; ")))
