"""The arrays of LiDAR and BEV camera in words (docs/format.md, LiDAR and BEV camera)."""

from pathlib import Path

import numpy as np

from deepaccident_devkit.arrays import AnyArray
from deepaccident_devkit.errors import SensorFileError
from deepaccident_devkit.release.bev_camera import TAGS, read_bev
from deepaccident_devkit.release.lidar import read_lidar
from deepaccident_devkit.release.npz import read_npz
from deepaccident_devkit.taxonomy import BEV_RESOLUTION, BEV_SHAPE
from deepaccident_devkit.text import columns_text, fixed_text

_LIDAR_COLUMNS = (
    ("x", "m", "forward, LiDAR frame"),
    ("y", "m", "right, LiDAR frame (the devkit's y is left: −y)"),
    ("z", "m", "up, LiDAR frame"),
    ("intensity", "", "of the returned light, 0 to 1"),
)
_BEV_CHANNELS = (
    ("0", "high byte of the instance id"),
    ("1", "low byte of the instance id"),
    ("2", "CARLA's semantic tag"),
)


def sensor_text(path: Path) -> str:
    """What an array file holds.

    Raises:
        MissingFileError: there is no such file.
        SensorFileError: it cannot be read, or holds neither points nor the picture of the BEV camera.
    """
    data = read_npz(path, "lidar")
    if data.ndim == 2 and data.shape[1] == len(_LIDAR_COLUMNS):
        return _lidar_text(read_lidar(path, raw=True))
    if data.ndim == 3 and data.dtype == np.uint8:
        return _bev_text(read_bev(path, raw=True), read_bev(path).instance)
    raise SensorFileError(
        f"{path}: an array of shape {data.shape} of {data.dtype} is none of the release's; expected points (N, 4) of "
        f"floats or the BEV camera's {(*BEV_SHAPE, 3)} of uint8; give such a file"
    )


def _lidar_text(data: AnyArray) -> str:
    rows = [["column", "unit", "meaning", "min", "max", "not finite"]]
    for (name, unit, meaning), column in zip(_LIDAR_COLUMNS, data.T, strict=True):
        good = column[np.isfinite(column)]
        ends = [fixed_text(good.min(), 3), fixed_text(good.max(), 3)] if len(good) else ["–", "–"]
        rows.append([name, unit, meaning, *ends, f"{len(column) - len(good):,}"])
    return (
        f"A LiDAR's point cloud: shape {data.shape} of {data.dtype}, {len(data):,} points.\n\n"
        f"{columns_text(rows, left=3)}\n\n"
        "In Python: release.read_lidar(path) gives right-handed points, with raw=True the array of the file."
    )


def _bev_text(data: AnyArray, instance: AnyArray) -> str:
    channels = [["channel", "meaning", "min", "max"]]
    for number, meaning in _BEV_CHANNELS:
        channel = data[..., int(number)]
        channels.append([number, meaning, str(channel.min()), str(channel.max())])
    names = {tag: name for name, tag in TAGS.items()}
    tags, counts = np.unique(data[..., 2], return_counts=True)
    rows = [["tag", "name", "pixels", "share"]]
    rows += [
        [str(tag), names.get(tag, "–"), f"{count:,}", f"{count / instance.size:.1%}"]
        for tag, count in zip(tags.tolist(), counts.tolist(), strict=True)
    ]
    half = BEV_SHAPE[0] * BEV_RESOLUTION / 2
    return (
        f"The BEV camera's picture: shape {data.shape} of {data.dtype}; seen from above, forward is up, left is left,\n"
        f"{BEV_RESOLUTION} m a pixel, ±{half:g} m around the agent.\n\n{columns_text(channels, left=2)}\n\n"
        f"{columns_text(rows, left=2)}\n"
        "(named are the tags that the released code uses)\n\n"
        f"{len(np.unique(instance)):,} instance ids, 256 · channel 0 + channel 1: not the labels' actor ids.\n\n"
        "In Python: release.read_bev(path), with raw=True the array of the file."
    )
