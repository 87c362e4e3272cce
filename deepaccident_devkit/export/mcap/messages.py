"""Foxglove's messages from the devkit's own types: poses, colours, point clouds. `frame_id` names their frames."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.Point3_pb2 import Point3
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3

from deepaccident_devkit.arrays import AnyArray, ByteArray, FloatArray
from deepaccident_devkit.export.mcap.recording import frame_timestamp
from deepaccident_devkit.geometry import SE3, quaternions
from deepaccident_devkit.taxonomy import LIDAR

COLORED_POINT: Final = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1"), ("alpha", "u1")]
)
"""A point of a rendering; viewers take the colour from the last four fields."""
_NUMERIC_TYPES: Final = {
    np.dtype("u1"): PackedElementField.UINT8,
    np.dtype("<i4"): PackedElementField.INT32,
    np.dtype("<f4"): PackedElementField.FLOAT32,
}


def frame_id(agent: str, frame: str) -> str:
    """The name of a sample's coordinate frame: `world`; for `ego` the agent's name; for a sensor `agent/channel`."""
    if frame == "world":
        return frame
    return agent if frame == "ego" else f"{agent}/{LIDAR if frame == 'lidar' else frame}"


def transform_message(parent: str, child: str, parent_from_child: SE3, index: int) -> Any:
    """A FrameTransform: the pose of one coordinate frame in another."""
    return FrameTransform(
        timestamp=frame_timestamp(index),
        parent_frame_id=parent,
        child_frame_id=child,
        translation=vector(parent_from_child.translation),
        rotation=quaternion(np.array(quaternions.single_from_matrix(parent_from_child.rotation))),
    )


def pose(center: FloatArray, rotation: FloatArray) -> Any:
    """A Pose of a centre (3,), metres, and a unit quaternion (4,) w, x, y, z."""
    return Pose(position=vector(center), orientation=quaternion(rotation))


def vector(values: FloatArray) -> Any:
    """A Vector3 of (3,)."""
    x, y, z = values.tolist()
    return Vector3(x=x, y=y, z=z)


def quaternion(rotation: FloatArray) -> Any:
    """A Quaternion of (4,) w, x, y, z."""
    w, x, y, z = rotation.tolist()
    return Quaternion(x=x, y=y, z=z, w=w)


def points3(points: FloatArray) -> list[Any]:
    """Point3s of (N, 3)."""
    return [Point3(x=x, y=y, z=z) for x, y, z in points.tolist()]


def rgb(color: str) -> ByteArray:
    """(3,) uint8 of a colour of `render.colors`, such as `#9a9a9a`."""
    return np.frombuffer(bytes.fromhex(color[1:]), dtype=np.uint8)


def color_message(color: str, alpha: float = 1.0) -> Any:
    """A `Color` of a colour of `render.colors`."""
    red, green, blue = (rgb(color) / 255).tolist()
    return Color(r=red, g=green, b=blue, a=alpha)


def cloud_message(points: AnyArray, frame: str, index: int) -> Any:
    """A PointCloud of a structured array (N,), with a message field for each of its fields (x, y, z and others)."""
    columns: Mapping[str, Any] = points.dtype.fields or {}
    return PointCloud(
        timestamp=frame_timestamp(index),
        frame_id=frame,
        pose=pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])),
        point_stride=points.dtype.itemsize,
        fields=[
            PackedElementField(name=name, offset=columns[name][1], type=_NUMERIC_TYPES[columns[name][0]])
            for name in points.dtype.names or ()
        ],
        data=points.tobytes(),
    )
