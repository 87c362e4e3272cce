"""The road around a scenario as one pale picture, from BEV cameras or a stored town map."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.release import BevImage
from deepaccident_devkit.release.images import picture_bytes
from deepaccident_devkit.release.npz import TAGS
from deepaccident_devkit.render.captions import has_sensor_file
from deepaccident_devkit.render.replay.entries import ReplayRecording
from deepaccident_devkit.render.styles import BEV_COLORS
from deepaccident_devkit.render.town_map import ground_at, map_beneath
from deepaccident_devkit.support.arrays import ByteArray, FloatArray
from deepaccident_devkit.taxonomy import BEV_CAMERA, BEV_RESOLUTION, BEV_SHAPE

# The drawn classes. Vehicles and pedestrians move: another moment shows the ground beneath them.
_GROUND_CLASSES: Final = ("sidewalk", "road", "road_line")
# The number of moments with pictures that are merged.
_MOMENT_COUNT: Final = 4
# Metres: side of a cell. The first with a picture that is small enough is used.
_CELL_SIDES_M: Final = (0.2, 0.3, 0.5, 0.8)
# Bytes of the picture; in base64 it has a third more.
_MAX_PICTURE_BYTES: Final = 200_000


def road_picture(recording: ReplayRecording) -> dict[str, Any] | None:
    """Return the road as a PNG in base64, with its left, top, width and height (cm, y up).

    Cells without ground, or that no camera saw, are transparent. If the release has no BEV camera
    file of these moments, as in the test split, the road is that of the town's map, where one is
    stored. It is None if neither exists, or if their pictures are too large.

    Raises:
        SensorFileError: A file cannot be read.
    """
    samples = _samples(recording)
    views = _views(recording, samples)
    town = None
    if not views:
        town = map_beneath(recording.dataset, recording.scenario["token"], make=False)
        if town is None:
            return None
    poses = [pose for _, pose in views]
    if not poses:
        poses = [recording.dataset.world_from(sample, "ego") for sample in samples]
    reach = BEV_RESOLUTION * BEV_SHAPE[0] / 2
    centers = np.array([pose.translation[:2] for pose in poses])
    low, high = centers.min(axis=0) - reach, centers.max(axis=0) + reach
    for cell_side in _CELL_SIDES_M:
        if town is None:
            classes = _merged_classes(views, low, high, cell_side)
        else:
            classes = _map_classes(town, low, high, cell_side)
        png = _png(classes)
        if len(png) <= _MAX_PICTURE_BYTES:
            return _entry(recording, png, low, high)
    return None


def _entry(
    recording: ReplayRecording, png: bytes, low: FloatArray, high: FloatArray
) -> dict[str, Any]:
    left, top = recording.page_coordinates([low[0], high[1]])
    width, height = np.rint((high - low) * 100).astype(int).tolist()
    return {
        "png": base64.b64encode(png).decode("ascii"),
        "left": left,
        "top": top,
        "width": width,
        "height": height,
    }


def _samples(recording: ReplayRecording) -> list[str]:
    """Return the samples (tokens) of the agents at a few moments."""
    moments = np.linspace(recording.frames[0], recording.frames[-1], _MOMENT_COUNT)
    frames = np.unique(moments.round().astype(int)).tolist()
    samples = []
    for agent in recording.agents:
        samples += [recording.sample(agent, frame) for frame in frames]
    return samples


def _views(recording: ReplayRecording, samples: Sequence[str]) -> list[tuple[BevImage, SE3]]:
    """Return the BEV pictures of samples with present files, and the agents' poses in world."""
    dataset, views = recording.dataset, []
    present = [sample for sample in samples if has_sensor_file(dataset, f"{sample}/{BEV_CAMERA}")]
    for sample in present:
        views.append((dataset.load_bev(sample), dataset.world_from(sample, "ego")))
    return views


def _merged_classes(
    views: Sequence[tuple[BevImage, SE3]], low: FloatArray, high: FloatArray, cell_side: float
) -> ByteArray:
    """Return the ground class of each cell, (H, W) uint8 from 1; the top is high y.

    It is that of the first picture with ground in the cell, or 0.

    Args:
        views: Pictures and the agents' poses.
        low: Least x and y in world, shape (2,), metres.
        high: Largest x and y in world, shape (2,), metres.
        cell_side: Side of a cell, metres.
    """
    x, y = _cell_centers(low, high, cell_side)
    class_of_tag = np.zeros(256, dtype=np.uint8)
    for number, name in enumerate(_GROUND_CLASSES, 1):
        class_of_tag[TAGS[name]] = number
    merged = np.zeros((len(y), len(x)), dtype=np.uint8)
    for image, pose in views:
        yaw = np.arctan2(pose.rotation[1, 0], pose.rotation[0, 0])
        # farther than the picture's corners
        reach = image.resolution * len(image.semantic) * np.array([-1.0, 1.0])
        columns = slice(*x.searchsorted(pose.translation[0] + reach))
        rows = slice(*(-y).searchsorted(reach - pose.translation[1]))
        part = merged[rows, columns]
        dx = x[None, columns] - pose.translation[0]
        dy = y[rows, None] - pose.translation[1]
        forward = (dx * np.cos(yaw) + dy * np.sin(yaw)) / image.resolution
        left = (dy * np.cos(yaw) - dx * np.sin(yaw)) / image.resolution
        middle = (len(image.semantic) - 1) / 2
        row = np.rint(middle - forward).astype(np.int64)
        column = np.rint(middle - left).astype(np.int64)
        in_rows = (row >= 0) & (row <= 2 * middle)
        in_columns = (column >= 0) & (column <= 2 * middle)
        free = (part == 0) & in_rows & in_columns
        part[free] = class_of_tag[image.semantic[row[free], column[free]]]
    return merged


def _map_classes(town: Any, low: FloatArray, high: FloatArray, cell_side: float) -> ByteArray:
    """Return the ground by a town's map, (H, W) uint8, in the form of `_merged_classes`."""
    x, y = np.meshgrid(*_cell_centers(low, high, cell_side))
    points = np.column_stack([x.ravel(), y.ravel()])
    return ground_at(town, points, _GROUND_CLASSES).reshape(x.shape)


def _cell_centers(
    low: FloatArray, high: FloatArray, cell_side: float
) -> tuple[FloatArray, FloatArray]:
    """Return the x of the picture's columns, and the y of its rows from the top."""
    columns, rows = np.ceil((high - low) / cell_side).astype(int).tolist()
    x = low[0] + (np.arange(columns) + 0.5) * cell_side
    y = high[1] - (np.arange(rows) + 0.5) * cell_side
    return x, y


def _png(classes: ByteArray) -> bytes:
    from PIL import Image, ImageColor

    palette = [255, 255, 255]
    for name in _GROUND_CLASSES:
        palette += ImageColor.getrgb(BEV_COLORS[name])
    picture = Image.fromarray(classes)
    picture.putpalette(palette)
    return picture_bytes(picture, "PNG", optimize=True, bits=2, transparency=0)
