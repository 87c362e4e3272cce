"""The files of a release on disk: a reader and a writer for each kind.

Readers convert CARLA's left-handed values to the devkit's right-handed ones, unless you pass
`raw=True`.
"""

from deepaccident_devkit.release.calib import (
    Calib,
    Calibs,
    read_calib,
    read_calibs,
    write_calib,
    write_raw_calib,
)
from deepaccident_devkit.release.images import read_image, write_image
from deepaccident_devkit.release.labels import (
    Labels,
    label_from_world_velocity,
    read_label,
    read_labels,
    world_from_label_velocity,
    write_label,
)
from deepaccident_devkit.release.layout import (
    ReleaseLayout,
    ScenarioFolder,
    find_release,
    read_split_file,
    write_split_file,
)
from deepaccident_devkit.release.meta import Collision, Meta, read_meta, write_meta
from deepaccident_devkit.release.npz import BevImage, read_bev, read_lidar, write_bev, write_lidar

__all__ = [
    "BevImage",
    "Calib",
    "Calibs",
    "Collision",
    "Labels",
    "Meta",
    "ReleaseLayout",
    "ScenarioFolder",
    "find_release",
    "label_from_world_velocity",
    "read_bev",
    "read_calib",
    "read_calibs",
    "read_image",
    "read_label",
    "read_labels",
    "read_lidar",
    "read_meta",
    "read_split_file",
    "world_from_label_velocity",
    "write_bev",
    "write_calib",
    "write_image",
    "write_label",
    "write_lidar",
    "write_meta",
    "write_raw_calib",
    "write_split_file",
]
