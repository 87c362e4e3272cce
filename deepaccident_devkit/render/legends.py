"""What a picture says of itself: what its colours mean, and which sensor files are not there."""

from __future__ import annotations

import textwrap
from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.release.store import listed
from deepaccident_devkit.render.chips import SMALLEST_TEXT
from deepaccident_devkit.render.colors import (
    AGENT_COLORS,
    CATEGORY_COLORS,
    CATEGORY_MARKERS,
    COLLIDER_COLOR,
    MISSING_COLOR,
)
from deepaccident_devkit.render.roles import in_drawing_order
from deepaccident_devkit.render.titles import room_of, text_width
from deepaccident_devkit.taxonomy import LIDAR, short_name

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INSIDE: Final[Mapping[str, Any]] = {"loc": "upper right", "frameon": True, "framealpha": 0.85}
"""A place in axes, so that nothing stands beside them."""
_HANDLE: Final = 0.4
"""Inches of a sign and the blanks around it."""
_SPACING: Final[Mapping[str, Any]] = {"handlelength": 1.2, "columnspacing": 1.0}
_GID: Final = "missing"
"""Marks the words in a figure, so that `missing_words` finds them."""
_LETTERS: Final = 50
"""In a line of a corner."""


def box_handles(colors: Collection[str]) -> list[Artist]:
    """What these colours of boxes mean: a patch for each, or the mark of a class of small actors."""
    from matplotlib.colors import to_rgba
    from matplotlib.patches import Patch

    agents = {short_name(agent): color for agent, color in AGENT_COLORS.items()}
    meanings = {"colliding pair": COLLIDER_COLOR, **agents, **CATEGORY_COLORS}
    return [
        _mark(name, CATEGORY_MARKERS[name], color)
        if name in CATEGORY_MARKERS
        else Patch(label=name, facecolor=to_rgba(color, 0.25), edgecolor=color)
        for name, color in meanings.items()
        if color in colors
    ]


def agent_handles(agents: Collection[str]) -> list[Artist]:
    """A dot for each agent, in the order of all pictures."""
    return [_mark(short_name(agent), "o", AGENT_COLORS[agent]) for agent in in_drawing_order(agents)]


def handles_from_above(colors: Collection[str], clouds: Collection[str]) -> list[Artist]:
    """What the colours of boxes and of agents' clouds mean; an agent with a cloud is named once."""
    known = {AGENT_COLORS[agent] for agent in clouds}
    return [*box_handles(set(colors) - known), *agent_handles(clouds)]


def _mark(label: str, marker: str, color: str) -> Artist:
    from matplotlib.lines import Line2D

    return Line2D([], [], linestyle="none", marker=marker, color=color, label=label)


def draw_legend(where: Any, handles: Sequence[Artist], *, columns: int | None = None, **how: Any) -> None:
    """Render a legend, by default below all panels of a figure, with as many columns as have room; none if empty."""
    from matplotlib.font_manager import FontProperties

    if handles:
        font = FontProperties(size=SMALLEST_TEXT)
        widest = max(text_width(str(handle.get_label()), font) for handle in handles) / 72 + _HANDLE
        columns = max(1, min(columns or len(handles), int(room_of(where) / widest)))
        style = {"loc": "outside lower center", "fontsize": SMALLEST_TEXT, "frameon": False, **_SPACING, **how}
        where.legend(handles=list(handles), ncols=columns, **style)


def draw_legend_of_fills(ax: Axes, colors: Mapping[str, str]) -> None:
    """Put a legend of filled shapes into the axes."""
    from matplotlib.patches import Patch

    handles = [Patch(label=name, facecolor=(color, 0.4), edgecolor=color) for name, color in colors.items()]
    draw_legend(ax, handles, columns=1, **INSIDE)


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
