"""The one colour table of all pictures."""

from collections.abc import Mapping

from deepaccident_devkit.taxonomy import AGENTS, SPLITS

CATEGORY_COLORS: Mapping[str, str] = {
    "car": "#2f6fde",
    "truck": "#6a4fc4",
    "van": "#1793a5",
    "cyclist": "#e08a1e",
    "motorcycle": "#b5651d",
    "pedestrian": "#c2379a",
}
AGENT_COLORS: Mapping[str, str] = dict(
    zip(AGENTS, ("#1f6fe0", "#1fb5d6", "#f07f09", "#c9a800", "#9b4de0"), strict=True)
)
"""Easy to see on white and in camera images; without red and green, which mark the accident's actors."""
SPLIT_COLORS: Mapping[str, str] = dict(
    zip((*SPLITS, "unknown"), ("#2f6fde", "#e08a1e", "#1a9850", "#9a9a9a"), strict=True)
)
COLLIDER_COLOR = "#e60026"
COMPANION_COLOR = "#1a9850"
"""The agents behind the colliding pair, as in the paper."""
OWN_COLOR = "#111111"
"""A mark for the recording agent itself, in addition to the colour of its part in the accident."""
POINT_COLOR = "#9a9a9a"
"""LiDAR points that are not coloured by a value."""
DEPTH_COLORMAP = "turbo_r"
"""LiDAR points in images; the nearest are red."""
HEIGHT_COLORMAP = "viridis"
BEV_COLORS: Mapping[str, str] = {
    "road": "#e9e9ec",
    "road_line": "#ffffff",
    "sidewalk": "#f6efe4",
    "vehicle": "#cdd6e6",
    "pedestrian": "#ecd2e4",
}
"""CARLA's tags in the BEV camera, in pale colours: boxes are rendered over them."""
GRID_COLOR = "#d0d0d0"
MISSING_COLOR = "#dddddd"
"""The place of an image that is not there."""
MUTED_COLOR = "#666666"
"""Less important words."""
TRUE_PLACE_COLOR = "#8a8a8a"
"""The true place of something that is also rendered at another place."""
OUTCOME_COLORS: Mapping[str, str] = {"right": "#1a9850", "false": "#e08a1e", "missed": "#9a9a9a"}
"""Predictions that are right, predictions that are false, and truths that are missed."""
SERIES_COLORS = ("#08306b", "#2f6fde", "#7fb2e5", "#9a9a9a")
"""Lines or bars of the same kind for several values of one number, the strictest value first."""
ESTIMATE_COLOR = "#2f6fde"
"""A number with an interval."""
WARNING_COLOR = "#b00020"
"""Important words; dark enough for text on white."""
BEYOND_COLOR = "#e4e4e4"
"""Background of a frame that is not recorded."""
