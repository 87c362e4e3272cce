"""nuScenes' categories and ours.

Six of ours stand for five of its ten detection classes; all others are ignored. An ignored actor is
no background: it is neither learned nor counted, and in motion labels a vehicle is a vehicle, as in
FIERY's rules.
"""

from __future__ import annotations

from types import MappingProxyType
from typing import Final

from deepaccident_devkit.taxonomy import CATEGORIES

CLASSES: Final = MappingProxyType(
    {
        "vehicle.car": "car",
        "vehicle.truck": "truck",
        "vehicle.bicycle": "cyclist",
        "vehicle.motorcycle": "motorcycle",
        "human.pedestrian.adult": "pedestrian",
        "human.pedestrian.child": "pedestrian",
        "human.pedestrian.construction_worker": "pedestrian",
        "human.pedestrian.police_officer": "pedestrian",
    }
)
"""nuScenes' category → ours; it has no vans."""
DETECTION_NAMES: Final = MappingProxyType(
    {**{name: name for name in CATEGORIES}, "van": "car", "cyclist": "bicycle"}
)
"""Our category → nuScenes' detection class."""


def category_of(category: str) -> int:
    """Return the index of our category for one of nuScenes'; the most similar if ignored."""
    similar = "truck" if category.startswith("vehicle.") else "pedestrian"
    return CATEGORIES.index(CLASSES.get(category, similar))
