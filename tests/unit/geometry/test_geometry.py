"""Every default and constant of geometry, against what is written out here."""

import numpy as np
from written_out import written_out

from deepaccident_devkit.geometry import SE3, BevGrid, Boxes, LidarPointCloud, PinholeCamera

WRITTEN = {
    "bev_grid.ORIENTATIONS": "('devkit', 'released', 'fiery')",
    "bev_grid.BevGrid": "x=(-50.0, 50.0, 0.5), y=(-50.0, 50.0, 0.5), orientation='devkit'",
    "bev_grid.to_orientation": "ignore=None",
    "box_arrays.PAIRS_AT_ONCE": "16384",
    "box_arrays.POINTS_AT_ONCE": "8192",
    "boxes.BOTTOM_CORNERS": "(2, 3, 7, 6)",
    "boxes.Boxes": "sample=None",
    "boxes.Boxes.from_arrays": "frame='world', category=None",
    "boxes.trusted_boxes": "sample=None",
    "boxes.Box": "token=None, instance_token=None",
    "boxes.Box.from_wlh": "category='car', velocity=(nan, nan, nan)",
    "camera.VISIBLE_DEPTH": "1.0",
    "camera.IN_FRONT_DEPTH": "0.1",
    "camera.PinholeCamera.in_image": "depth=None, min_depth=0.0, margin=0.0",
    "camera.PinholeCamera.boxes_in_image": "level=<BoxVisibility.ANY: 1>",
    "conventions.LAST_ROW": "(0.0, 0.0, 0.0, 1.0)",
    "pointcloud.LidarPointCloud": "frame='lidar', agent=None, time_lag=None",
    "pointcloud.LidarPointCloud.crop": "grid=None, x=None, y=None, z=None",
    "pointcloud.LidarPointCloud.remove_close": "sensor=None",
    "se3.RIGID_TOLERANCE": "0.001",
    "se3.SE3.from_rotation": "translation=(0.0, 0.0, 0.0)",
    "se3.SE3.from_quaternion": "translation=(0.0, 0.0, 0.0)",
    "se3.SE3.from_yaw": "translation=(0.0, 0.0, 0.0)",
    "se3.SE3.apply": "frame=None",
}


def test_every_default_and_constant_written_out() -> None:
    assert written_out("deepaccident_devkit.geometry") == WRITTEN
    nobody, pose = (
        Boxes.from_arrays(np.zeros((0, 3)), np.zeros((0, 3)), [], frame="Camera_Front"),
        SE3.from_yaw(0.1),
    )
    cloud = LidarPointCloud(np.zeros((0, 3)), np.zeros(0)).transform(pose, "ego").crop(BevGrid())
    camera = PinholeCamera.from_field_of_view(10, 10, 1.0)
    assert [
        len(nobody),
        len(cloud),
        len(camera.boxes_in_image(nobody)),
        *nobody[:0].center.flat,
    ] == [0] * 3
    assert len(pose.to_six()) == 6
