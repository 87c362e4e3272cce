"""Sensor files of a small release: tiny pictures, few points and a view from above; all show the labels' boxes."""

import numpy as np
from numpy.typing import NDArray

from deepaccident_devkit.arrays import ByteArray, FloatArray, as_floats
from deepaccident_devkit.geometry import Boxes, PinholeCamera
from deepaccident_devkit.release.bev_camera import TAGS
from deepaccident_devkit.taxonomy import BEV_RESOLUTION, BEV_SHAPE, CATEGORIES

_MOST_POINTS, _POINT_METRES = 20, 120.0
"""The most points on a box, and the number of points on a box 1 m away; it becomes smaller with the distance."""
_GROUND_RADII, _GROUND_POINTS = (6.0, 12.0, 24.0), 12
_LIDAR_RANGE = 65.0
_LEAST_DEPTH = 0.5
_COLORS = np.array([(200, 40, 40), (40, 80, 200), (40, 160, 60), (220, 180, 40), (160, 60, 180), (240, 120, 40)])
"""RGB of each of `taxonomy.CATEGORIES`."""
_MIDDLE = (BEV_SHAPE[0] - 1) / 2


def cloud_of(boxes: Boxes, lidar_height: float) -> FloatArray:
    """Points (N, 3) in the LiDAR frame, metres, in the boxes and on the ground, rounded to the file's float32.

    Args:
        boxes: boxes in the LiDAR frame.
        lidar_height: height of the LiDAR above the ground, metres.
    """
    parts = [_ground(lidar_height)]
    distance = np.linalg.norm(boxes.center[:, :2], axis=1)
    counts = np.clip(_POINT_METRES / np.maximum(distance, 1.0), 1, _MOST_POINTS).astype(int) * (distance < _LIDAR_RANGE)
    for center, size, yaw, count in zip(boxes.center, boxes.size, boxes.yaw, counts.tolist(), strict=True):
        inside = _spread(count) * size
        turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
        parts.append(center + inside @ turn.T)
    return np.concatenate(parts).astype(np.float32).astype(np.float64)


def picture_of(
    boxes: Boxes, camera: PinholeCamera, *, sky: tuple[int, int, int], road: tuple[int, int, int]
) -> ByteArray:
    """A picture (H, W, 3), RGB: sky, road, and each box's outline filled with its class's colour, far ones first.

    Args:
        boxes: boxes in the camera's optical frame.
        camera: its optics.
        sky: RGB; sky and road should differ between all pictures, so that no two files are equal.
        road: RGB.
    """
    import cv2

    picture = np.empty((camera.height, camera.width, 3), dtype=np.uint8)
    horizon = camera.height // 2
    picture[:horizon], picture[horizon:] = sky, road
    corners = boxes.corners()
    for row in np.argsort(-boxes.center[:, 2]).tolist():
        pixels, depth = camera.project(corners[row])
        if (depth > _LEAST_DEPTH).all():
            outline = cv2.convexHull(np.rint(np.clip(pixels, -1e4, 1e4)).astype(np.int32))
            cv2.fillConvexPoly(picture, outline, _COLORS[boxes.category[row]].tolist())
    return picture


def top_view_of(boxes: Boxes, object_ids: NDArray[np.uint16]) -> tuple[ByteArray, NDArray[np.uint16]]:
    """Tags (1200, 1200) uint8 and object ids (1200, 1200) uint16 around an agent: up is forward, left is left.

    Args:
        boxes: boxes in the ego or LiDAR frame.
        object_ids: (N,) the simulator's ids of the boxes.
    """
    import cv2

    semantic = np.full(BEV_SHAPE, TAGS["road"], dtype=np.uint8)
    instance = np.zeros(BEV_SHAPE, dtype=np.uint16)
    rows = zip(boxes.bottom_corners(), boxes.category.tolist(), object_ids.tolist(), strict=True)
    for corners, code, number in rows:
        places = corners[:, :2]
        if np.abs(places).max() * 2 < BEV_RESOLUTION * BEV_SHAPE[0]:
            outline = np.rint(_MIDDLE - places[:, ::-1] / BEV_RESOLUTION).astype(np.int32)  # OpenCV: column, row
            tag = TAGS["pedestrian" if CATEGORIES[code] == "pedestrian" else "vehicle"]
            cv2.fillConvexPoly(semantic, outline, tag)
            cv2.fillConvexPoly(instance, outline, number)
    return semantic, instance


def _spread(count: int) -> FloatArray:
    """(count, 3) places in a box with edges of 1 around 0, evenly distributed, a little away from its faces."""
    steps = np.arange(1, count + 1)[:, None] * (0.8191725, 0.6710436, 0.5497005)  # the R3 sequence
    return as_floats((steps % 1.0 - 0.5) * 0.9)


def _ground(lidar_height: float) -> FloatArray:
    angle = np.linspace(0.0, 2 * np.pi, _GROUND_POINTS, endpoint=False)
    rings = [np.column_stack([radius * np.cos(angle), radius * np.sin(angle)]) for radius in _GROUND_RADII]
    places = np.concatenate(rings)
    return np.column_stack([places, np.full(len(places), -lidar_height)])
