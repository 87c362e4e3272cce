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
    zip(AGENTS, ("#d62728", "#ff9896", "#1f77b4", "#9ecae1", "#7f7f7f"), strict=True)
)
SPLIT_COLORS: Mapping[str, str] = dict(
    zip((*SPLITS, "unknown"), ("#2f6fde", "#e08a1e", "#1a9850", "#9a9a9a"), strict=True)
)
COLLIDER_COLOR = "#e60026"
OWN_COLOR = "#1a9850"
"""The recording agent itself."""
GRID_COLOR = "#d0d0d0"
