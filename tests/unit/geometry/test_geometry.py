"""Every default and constant of geometry is the one written out here."""

import numpy as np
from support.default_values import package_values

from deepaccident_devkit.geometry import SE3, BevGrid, Boxes, LidarPointCloud, PinholeCamera

EXPECTED_DEFAULTS = {
    "bev_grid.ORIENTATIONS": "('devkit', 'released', 'fiery')",
    "bev_grid.BevGrid": "x=(-50.0, 50.0, 0.5), y=(-50.0, 50.0, 0.5), orientation='devkit'",
    "bev_grid.to_orientation": "ignore=None",
    "box_arrays.PAIRS_AT_ONCE": "16384",
    "box_arrays.POINTS_AT_ONCE": "8192",
    "boxes.BOTTOM_CORNERS": "(2, 3, 7, 6)",
    "boxes.Boxes": "sample=None, scenario=None, own_actor_id=-1",
    "boxes.Boxes.from_arrays": "frame='world', category=None",
    "boxes.trusted_boxes": "sample=None, scenario=None, own_actor_id=-1",
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
    assert package_values("deepaccident_devkit.geometry") == EXPECTED_DEFAULTS
    no_boxes = Boxes.from_arrays(np.zeros((0, 3)), np.zeros((0, 3)), [], frame="Camera_Front")
    no_points = LidarPointCloud(np.zeros((0, 3)), np.zeros(0))
    pose = SE3.from_yaw(0.1)
    camera = PinholeCamera.from_field_of_view(10, 10, 1.0)
    assert len(no_boxes) == 0
    assert len(no_points.transform(pose, "ego").crop(BevGrid())) == 0
    assert len(camera.boxes_in_image(no_boxes)) == 0
    assert no_boxes[:0].center.size == 0
    assert len(pose.to_six()) == 6
