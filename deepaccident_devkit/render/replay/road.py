"""The road around a scenario as one pale picture, from BEV cameras or a stored town map."""

import base64
from collections.abc import Sequence
from typing import Any

import numpy as np

from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.maps.town_map import TownMap
from deepaccident_devkit.release import BevImage
from deepaccident_devkit.release.images import picture_bytes
from deepaccident_devkit.release.npz import TAGS
from deepaccident_devkit.render.captions import has_sensor_file
from deepaccident_devkit.render.replay.entries import ReplayRecording
from deepaccident_devkit.render.styles import BEV_COLORS
from deepaccident_devkit.render.town_map import ground_at, map_beneath
from deepaccident_devkit.support.arrays import ByteArray, FloatArray
from deepaccident_devkit.taxonomy import BEV_CAMERA, BEV_RESOLUTION, BEV_SHAPE

# Classes that are drawn. Vehicles and pedestrians move, so other moments show the ground below.
_GROUND_CLASSES = ("sidewalk", "road", "road_line")
# Number of moments whose pictures are merged.
_MOMENT_COUNT = 4
# Cell sizes in metres; the first one whose picture is small enough is used.
_CELL_SIDES_M = (0.2, 0.3, 0.5, 0.8)
# Maximum size of the picture in bytes; base64 adds a third.
_MAX_PICTURE_BYTES = 200_000


def road_picture(recording: ReplayRecording) -> dict[str, Any] | None:
    """Return the road as a PNG in base64, with its left, top, width and height (cm, y up).

    Cells without ground, and cells that no camera saw, are transparent. If the release has no BEV
    camera files of these moments (as in the test split), the road comes from the town's map, if one
    is stored. The result is None if there is neither, or if the picture is too large.

    Raises:
        SensorFileError: A file cannot be read.
    """
    dataset = recording.dataset
    samples = _select_samples(recording)
    pictured = [sample for sample in samples if has_sensor_file(dataset, f"{sample}/{BEV_CAMERA}")]
    town = None
    if not pictured:
        town = map_beneath(dataset, recording.scenario["token"], make=False)
        if town is None:
            return None
    poses = [dataset.world_from(sample, "ego") for sample in pictured or samples]
    images = [dataset.load_bev(sample) for sample in pictured]
    reach = BEV_RESOLUTION * BEV_SHAPE[0] / 2
    centers = np.array([pose.translation[:2] for pose in poses])
    low = centers.min(axis=0) - reach
    high = centers.max(axis=0) + reach
    for cell_side in _CELL_SIDES_M:
        if town is None:
            classes = _merged_classes(images, poses, low, high, cell_side)
        else:
            classes = _map_classes(town, low, high, cell_side)
        png = _encode_png(classes)
        if len(png) <= _MAX_PICTURE_BYTES:
            left, top = recording.page_coordinates([low[0], high[1]])
            width, height = np.rint((high - low) * 100).astype(int).tolist()
            return {
                "png": base64.b64encode(png).decode("ascii"),
                "left": left,
                "top": top,
                "width": width,
                "height": height,
            }
    return None


def _select_samples(recording: ReplayRecording) -> list[str]:
    """Return the samples (tokens) of the agents at a few moments, spread over the recording."""
    moments = np.linspace(recording.frames[0], recording.frames[-1], _MOMENT_COUNT)
    frames = np.unique(moments.round().astype(int)).tolist()
    samples = []
    for agent in recording.agents:
        samples += [recording.sample(agent, frame) for frame in frames]
    return samples


def _merged_classes(
    images: Sequence[BevImage],
    poses: Sequence[SE3],
    low: FloatArray,
    high: FloatArray,
    cell_side: float,
) -> ByteArray:
    """Return the ground of each cell, shape (H, W), uint8; the first row has the highest y.

    A value is 1 + the index of the class in `_GROUND_CLASSES`, taken from the first picture that
    shows ground in the cell, or 0 if none does.

    Args:
        images: Pictures of BEV cameras.
        poses: Poses `world_from_ego` of their agents.
        low: Lowest x and y in world, shape (2,), metres.
        high: Highest x and y in world, shape (2,), metres.
        cell_side: Side of a cell, metres.
    """
    x, y = _cell_centers(low, high, cell_side)
    class_of_tag = np.zeros(256, dtype=np.uint8)
    for number, name in enumerate(_GROUND_CLASSES, 1):
        class_of_tag[TAGS[name]] = number
    merged = np.zeros((len(y), len(x)), dtype=np.uint8)
    for image, pose in zip(images, poses, strict=True):
        cosine = np.cos(pose.yaw)
        sine = np.sin(pose.yaw)
        agent_x, agent_y, _ = pose.translation
        side = len(image.semantic)
        # farther than the picture's corners
        reach = image.resolution * side * np.array([-1.0, 1.0])
        columns = slice(*x.searchsorted(agent_x + reach))
        rows = slice(*(-y).searchsorted(reach - agent_y))
        window = merged[rows, columns]
        dx = x[None, columns] - agent_x
        dy = y[rows, None] - agent_y
        forward = (dx * cosine + dy * sine) / image.resolution
        left = (dy * cosine - dx * sine) / image.resolution
        middle = (side - 1) / 2
        row = np.rint(middle - forward).astype(np.int64)
        column = np.rint(middle - left).astype(np.int64)
        in_rows = (row >= 0) & (row < side)
        in_columns = (column >= 0) & (column < side)
        is_free = (window == 0) & in_rows & in_columns
        tags = image.semantic[row[is_free], column[is_free]]
        window[is_free] = class_of_tag[tags]
    return merged


def _map_classes(town: TownMap, low: FloatArray, high: FloatArray, cell_side: float) -> ByteArray:
    """Return the ground of each cell according to a town's map, encoded as by `_merged_classes`."""
    centers_x, centers_y = _cell_centers(low, high, cell_side)
    x, y = np.meshgrid(centers_x, centers_y)
    points = np.column_stack([x.ravel(), y.ravel()])
    classes = ground_at(town, points, _GROUND_CLASSES)
    return classes.reshape(x.shape)


def _cell_centers(
    low: FloatArray, high: FloatArray, cell_side: float
) -> tuple[FloatArray, FloatArray]:
    """Return the x of the columns' centres, and the y of the rows' centres from the top, metres."""
    columns, rows = np.ceil((high - low) / cell_side).astype(int).tolist()
    from_left = (np.arange(columns) + 0.5) * cell_side
    from_top = (np.arange(rows) + 0.5) * cell_side
    return low[0] + from_left, high[1] - from_top


def _encode_png(classes: ByteArray) -> bytes:
    from PIL import Image, ImageColor

    palette = [255, 255, 255]
    for name in _GROUND_CLASSES:
        palette += ImageColor.getrgb(BEV_COLORS[name])
    picture = Image.fromarray(classes)
    picture.putpalette(palette)
    return picture_bytes(picture, "PNG", optimize=True, bits=2, transparency=0)
