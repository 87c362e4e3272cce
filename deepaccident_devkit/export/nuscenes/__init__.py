"""The nuScenes format, which the nuScenes devkit and mmdet3d read."""
