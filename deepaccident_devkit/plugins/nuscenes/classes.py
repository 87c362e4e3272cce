"""nuScenes' categories and ours.

Our six categories map to five of nuScenes' ten detection classes; all its other classes are
ignored. An ignored actor is not background: it is neither learned nor counted. In motion labels, a
vehicle of any class counts as a vehicle, as in FIERY's rules.
"""

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
"""Our category for each of nuScenes'; nuScenes has no vans."""
DETECTION_NAMES: Final = MappingProxyType(
    {**{name: name for name in CATEGORIES}, "van": "car", "cyclist": "bicycle"}
)
"""nuScenes' detection class for each of our categories."""


def find_category(category: str) -> int:
    """Return the index of our category that equals, or is most similar to, one of nuScenes'."""
    if category.startswith("vehicle."):
        similar = "truck"
    else:
        similar = "pedestrian"
    return CATEGORIES.index(CLASSES.get(category, similar))
