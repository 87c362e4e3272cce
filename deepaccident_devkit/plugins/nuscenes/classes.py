"""nuScenes' categories and ours: six of ours stand for five of its ten detection classes; all others are ignored.

An ignored actor is there, and no background: it is neither learned nor counted, and in motion labels a vehicle is a
vehicle, as by FIERY's rules.
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
    """The index of our category for one of nuScenes'; of an ignored one, what it is most like."""
    return CATEGORIES.index(
        CLASSES.get(category, "truck" if category.startswith("vehicle.") else "pedestrian")
    )
