"""nuScenes next to DeepAccident: its scenes as a release that can be used like any other.

It needs the extra `nuscenes`:

    from deepaccident_devkit.plugins.nuscenes import open_nuscenes

    road = open_nuscenes("data/nuscenes/v1.0-mini")
    road.render_sample(road.samples("train", "all")[0])
"""

from deepaccident_devkit.plugins.nuscenes.classes import CLASSES, DETECTION_NAMES
from deepaccident_devkit.plugins.nuscenes.source import NuScenesRelease, open_nuscenes, release_of

__all__ = ["CLASSES", "DETECTION_NAMES", "NuScenesRelease", "open_nuscenes", "release_of"]
