"""The nuScenes format, which the nuScenes devkit and mmdet3d read."""

from deepaccident_devkit.export.nuscenes.tables import NuScenes

__all__ = ["NuScenes"]
