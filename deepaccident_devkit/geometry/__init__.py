"""Geometry in one right-handed convention: x forward, y left, z up; metres, radians.

Yaw is counter-clockwise.
"""

from deepaccident_devkit.geometry.bev_grid import BevGrid
from deepaccident_devkit.geometry.box_arrays import time_to_collision
from deepaccident_devkit.geometry.boxes import Box, Boxes
from deepaccident_devkit.geometry.camera import BoxVisibility, PinholeCamera
from deepaccident_devkit.geometry.pointcloud import LidarPointCloud
from deepaccident_devkit.geometry.se3 import SE3

__all__ = [
    "SE3",
    "BevGrid",
    "Box",
    "BoxVisibility",
    "Boxes",
    "LidarPointCloud",
    "PinholeCamera",
    "time_to_collision",
]
