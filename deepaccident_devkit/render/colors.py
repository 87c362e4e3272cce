"""The one colour table: every picture, page and export takes its colours from here.

- Saturated hues are the five agents': an agent's name, points, sight lines and box have its hue.
- Red is the colliding pair, and nothing else.
- Classes are shades of slate; pedestrians, cyclists and motorcycles also have a shape of their own.
- Verdicts are muted, and no agent's hue. Charts are shades. No colour map has red.

Hues differ in lightness too, for colour-blind readers: `docs/check_colors.py` measures it, and a test asserts it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from deepaccident_devkit.support.pages import part
from deepaccident_devkit.taxonomy import AGENTS, SPLITS

AGENT_COLORS: Mapping[str, str] = dict(
    zip(AGENTS, ("#2b6fe0", "#2fc0cc", "#fa7b40", "#dfb000", "#563083"), strict=True)
)
"""Blue, cyan, orange, dark yellow and purple; too pale for words on white, which are dark."""
COLLIDER_COLOR = "#c4001a"
"""The colliding pair."""
CATEGORY_COLORS: Mapping[str, str] = {
    "car": "#63717e",
    "truck": "#323f4b",
    "van": "#94a2b0",
    "cyclist": "#4a5864",
    "motorcycle": "#7b8996",
    "pedestrian": "#1d272f",
}
CATEGORY_MARKERS: Mapping[str, str] = {"cyclist": "D", "motorcycle": "^", "pedestrian": "o"}
"""matplotlib's markers of the classes whose boxes are too small to be found from above."""
INSTANCE_COLORS = ("#63717e", "#b5c3cf", "#4a5864", "#94a2b0", "#323f4b", "#7b8996")
"""Instances of motion maps, by turns."""
OWN_COLOR = "#111111"
"""A mark for the recording agent itself, in addition to the colour of its part in the accident."""
CASING_COLOR = "#ffffff"
"""Edges around marks and lines that lie on pictures."""
POINT_COLOR = "#9a9a9a"
"""LiDAR points that are not coloured by a value."""
DEPTH_COLORMAP = "viridis_r"
"""LiDAR points in images; the nearest are yellow."""
HEIGHT_COLORMAP = "cividis"
CENTERNESS_COLORMAP = "Greys"
DIRECTION_COLORS = ("#2a78c2", "#2a9d6f", "#c9b23a", "#8a5fb0")
"""Flow forward, to the left, backward and to the right; between them the colours are mixed."""
BEV_COLORS: Mapping[str, str] = {
    "road": "#e9e9ec",
    "road_line": "#ffffff",
    "sidewalk": "#f6f2ea",
    "vehicle": "#d3d9e0",
    "pedestrian": "#d3d9e0",
}
"""CARLA's tags in the BEV camera, in pale colours: boxes are rendered over them."""
GRID_COLOR = "#d0d0d0"
MISSING_COLOR = "#dddddd"
"""The place of an image that is not there."""
MUTED_COLOR = "#666666"
"""Less important words."""
TRUE_PLACE_COLOR = "#8a8a8a"
"""The true place of something that is also rendered at another place."""
OUTCOME_COLORS: Mapping[str, str] = {"right": "#23644d", "false": "#a98c52", "missed": "#bcc0c3"}
"""Predictions that are right, predictions that are false, and truths that are missed: green, sand and pale grey."""
PREDICTED_COLOR = "#a8679b"
"""Predictions without a verdict: mauve."""
SERIES_COLORS = ("#1a3344", "#4b667c", "#8399ac", "#b5c3cf")
"""Lines or bars of the same kind for several values of one number, the strictest value first."""
SPLIT_COLORS: Mapping[str, str] = dict(
    zip((*SPLITS, "unknown"), ("#284052", "#627a8e", "#9badbe", "#d3d8dc"), strict=True)
)
ESTIMATE_COLOR = "#3d627d"
"""A number with an interval."""
WARNING_COLOR = "#6b4a10"
"""Important words, dark brown: the words of a warning are not the colliding pair."""
LINK_COLOR = "#2f4a63"
"""Links and the focus of the keyboard on pages."""
BEYOND_COLOR = "#e4e4e4"
"""Background of a frame that is not recorded."""


COLORS: Final = f"""
:root {{ color-scheme: light; --paper: #fff; --ink: #1c1c1c; --soft: #444; --dim: #555; --line: #ececec;
  --rule: {GRID_COLOR}; --accent: {LINK_COLOR}; --caution: {WARNING_COLOR};
  --link: var(--accent); --warning: var(--caution); --block: #f3f3f3; --edge: #999; }}
@media screen and (prefers-color-scheme: dark) {{
  :root {{ color-scheme: dark; --paper: #181818; --ink: #e8e8e8; --soft: #c9c9c9; --dim: #a8a8a8; --line: #333;
    --rule: #535353; --link: color-mix(in srgb, var(--accent) 40%, #fff);
    --warning: color-mix(in srgb, var(--caution) 40%, #fff); --block: #292929; --edge: #777; }}
}}
"""
"""Dark for readers whose system is."""


def page_style() -> str:
    """The rules of all pages but replays."""
    return COLORS + part("pages.css")
