"""Point clouds as OpenCOOD reads them through Open3D: `.pcd` in which red is the intensity."""

from typing import Final

import numpy as np

from deepaccident_devkit.arrays import AnyArray

_POINT: Final = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<u4")])
POINT_BYTES: Final = _POINT.itemsize


def pcd_bytes(points: AnyArray) -> bytes:
    """A binary `.pcd` of points (N, 4): x, y, z, intensity in [0, 1], which gets the 8 bits of red.

    A field `intensity` would not do: Open3D ignores it, and OpenCOOD reads the red channel.
    """
    cloud = np.zeros(len(points), dtype=_POINT)
    cloud["x"], cloud["y"], cloud["z"] = points[:, :3].T
    cloud["rgb"] = np.round(255 * np.clip(points[:, 3], 0, 1)).astype(np.uint32) << 16
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F U\n"
        f"COUNT 1 1 1 1\nWIDTH {len(cloud)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(cloud)}\nDATA binary\n"
    )
    return header.encode() + cloud.tobytes()
