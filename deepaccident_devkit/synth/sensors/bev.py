"""The top-down instance camera: semantic tags and object ids, seen from above the agent."""

import numpy as np
from numpy.typing import NDArray

from deepaccident_devkit.arrays import ByteArray, FloatArray
from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.release import BevImage
from deepaccident_devkit.release.bev_camera import TAGS
from deepaccident_devkit.synth.roads import MAP_EXTENT, MAP_RESOLUTION, TERRAIN, GroundMap, tag_of_code
from deepaccident_devkit.synth.sensors.scene import Scene
from deepaccident_devkit.taxonomy import BEV_RESOLUTION, BEV_SHAPE, CATEGORIES

_MIDDLE = (BEV_SHAPE[0] - 1) / 2
"""Row and column of the agent."""
_TAG_OF_CATEGORY = np.array(
    [TAGS["pedestrian" if category == "pedestrian" else "vehicle"] for category in CATEGORIES], dtype=np.uint8
)


def bev_picture(scene: Scene, top: GroundMap, ground_from_ego: SE3) -> BevImage:
    """The picture around an agent; higher road users cover lower ones."""
    x, y = ground_from_ego.translation[:2].tolist()
    semantic = tag_of_code()[_map_around(top, x, y, ground_from_ego.yaw)]
    instance = np.zeros(BEV_SHAPE, dtype=np.uint16)
    poses = _relative_poses(scene.snapshot.poses, x, y, ground_from_ego.yaw)
    actors = scene.actors
    reach = BEV_RESOLUTION * BEV_SHAPE[0] / 2 + np.hypot(actors.size[:, 0], actors.size[:, 1]) / 2
    near = np.flatnonzero(np.abs(poses[:, :2]).max(axis=1) < reach)
    for row in near[np.argsort(actors.size[near, 2], kind="stable")].tolist():
        window, inside = _footprint(poses[row], actors.size[row])
        semantic[window][inside] = _TAG_OF_CATEGORY[actors.category[row]]
        instance[window][inside] = actors.object_id[row]
    return BevImage(semantic, instance)


def _map_around(top: GroundMap, x: float, y: float, yaw: float) -> ByteArray:
    """Codes of the map resampled to the agent's grid, nearest cell."""
    import cv2

    cos, sin = np.cos(yaw), np.sin(yaw)
    column, row = ((value + MAP_EXTENT) / MAP_RESOLUTION - 0.5 for value in (x, y))
    map_from_picture = np.array(
        [[sin, -cos, column + _MIDDLE * (cos - sin)], [-cos, -sin, row + _MIDDLE * (cos + sin)]]
    )
    flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    return np.asarray(
        cv2.warpAffine(
            top.codes, map_from_picture, BEV_SHAPE, flags=flags, borderMode=cv2.BORDER_CONSTANT, borderValue=(TERRAIN,)
        )
    )


def _relative_poses(poses: FloatArray, x: float, y: float, yaw: float) -> FloatArray:
    """Poses (A, 3) in the ground frame, converted to the frame of an agent."""
    dx, dy = poses[:, 0] - x, poses[:, 1] - y
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.column_stack([cos * dx + sin * dy, cos * dy - sin * dx, poses[:, 2] - yaw])


def _footprint(pose: FloatArray, size: FloatArray) -> tuple[tuple[slice, slice], NDArray[np.bool_]]:
    """The pixels whose middle lies on a box, seen from above: a window of the picture, and a mask of it."""
    x, y, yaw = pose.tolist()
    length, width, _ = size.tolist()
    radius = np.hypot(length, width) / 2 / BEV_RESOLUTION
    rows, columns = (_window(_MIDDLE - value / BEV_RESOLUTION, radius) for value in (x, y))
    ahead = ((_MIDDLE - np.arange(rows.start, rows.stop)) * BEV_RESOLUTION - x)[:, None]
    left = ((_MIDDLE - np.arange(columns.start, columns.stop)) * BEV_RESOLUTION - y)[None, :]
    cos, sin = np.cos(yaw), np.sin(yaw)
    inside = (np.abs(cos * ahead + sin * left) <= length / 2) & (np.abs(cos * left - sin * ahead) <= width / 2)
    return (rows, columns), inside


def _window(middle: float, radius: float) -> slice:
    low, high = int(np.floor(middle - radius)), int(np.ceil(middle + radius)) + 1
    return slice(min(max(low, 0), BEV_SHAPE[0]), max(min(high, BEV_SHAPE[0]), 0))
