"""The road around a scenario as one pale picture: what the agents' BEV cameras saw, else what a kept town map has."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.release import BevImage
from deepaccident_devkit.release.images import picture_bytes
from deepaccident_devkit.release.npz import TAGS
from deepaccident_devkit.render.captions import is_there
from deepaccident_devkit.render.replay.entries import ReplayRecording
from deepaccident_devkit.render.styles import BEV_COLORS
from deepaccident_devkit.render.town_map import ground_at, map_beneath
from deepaccident_devkit.support.arrays import ByteArray, FloatArray
from deepaccident_devkit.taxonomy import BEV_CAMERA, BEV_RESOLUTION, BEV_SHAPE

# What is drawn. Vehicles and pedestrians move: another moment shows what is beneath them.
_GROUND: Final = ("sidewalk", "road", "road_line")
# The number of moments whose pictures are merged.
_MOMENTS: Final = 4
# Metres: side of a pixel. The first is taken whose picture is small enough.
_CELLS: Final = (0.2, 0.3, 0.5, 0.8)
# Bytes of the picture; in base64 it has a third more.
_MOST: Final = 200_000


def road_picture(recording: ReplayRecording) -> dict[str, Any] | None:
    """The road as the page has it: a PNG in base64, and its left, top, width and height (cm, y up).

    Transparent is nothing, or not seen. If the release has no BEV camera file of these moments, as of the test split,
    it is the town's map, where one is kept; None if there is neither, or if they give no small picture.

    Raises:
        SensorFileError: a file cannot be read.
    """
    samples = _samples(recording)
    seen = _seen(recording, samples)
    town = None if seen else map_beneath(recording.dataset, recording.scenario["token"], make=False)
    if not seen and town is None:
        return None
    reach = BEV_RESOLUTION * BEV_SHAPE[0] / 2
    poses = [pose for _, pose in seen] or [
        recording.dataset.world_from(sample, "ego") for sample in samples
    ]
    middles = np.array([pose.translation[:2] for pose in poses])
    low, high = middles.min(axis=0) - reach, middles.max(axis=0) + reach
    grounds = (
        _merged(seen, low, high, cell) if town is None else _mapped(town, low, high, cell)
        for cell in _CELLS
    )
    png = next((each for each in map(_png, grounds) if len(each) <= _MOST), None)
    if png is None:
        return None
    left, top = recording.places([low[0], high[1]])
    width, height = np.rint((high - low) * 100).astype(int).tolist()
    return {
        "png": base64.b64encode(png).decode("ascii"),
        "left": left,
        "top": top,
        "width": width,
        "height": height,
    }


def _samples(recording: ReplayRecording) -> list[str]:
    """The samples (tokens) of the agents at a few moments."""
    frames = np.linspace(recording.frames[0], recording.frames[-1], _MOMENTS).round().astype(int)
    return [
        recording.sample(agent, frame)
        for agent in recording.agents
        for frame in np.unique(frames).tolist()
    ]


def _seen(recording: ReplayRecording, samples: Sequence[str]) -> list[tuple[BevImage, SE3]]:
    """The pictures of samples whose files are there, and where the agents are in world."""
    dataset = recording.dataset
    there = [sample for sample in samples if is_there(dataset, f"{sample}/{BEV_CAMERA}")]
    return [(dataset.load_bev(sample), dataset.world_from(sample, "ego")) for sample in there]


def _merged(
    seen: Sequence[tuple[BevImage, SE3]], low: FloatArray, high: FloatArray, cell: float
) -> ByteArray:
    """(H, W) uint8: in each cell the ground, from 1, of the first picture that has any there; the top is high y.

    Args:
        seen: pictures and the agents' poses.
        low: (2,) least x and y, world, metres.
        high: (2,) largest x and y.
        cell: side of a cell, metres.
    """
    x, y = _middles(low, high, cell)
    kinds = np.zeros(256, dtype=np.uint8)
    for number, name in enumerate(_GROUND, 1):
        kinds[TAGS[name]] = number
    merged = np.zeros((len(y), len(x)), dtype=np.uint8)
    for image, pose in seen:
        yaw = np.arctan2(pose.rotation[1, 0], pose.rotation[0, 0])
        reach = (
            image.resolution * len(image.semantic) * np.array([-1.0, 1.0])
        )  # farther than its corners
        columns = slice(*x.searchsorted(pose.translation[0] + reach))
        rows = slice(*(-y).searchsorted(reach - pose.translation[1]))
        own = merged[rows, columns]
        right, up = x[None, columns] - pose.translation[0], y[rows, None] - pose.translation[1]
        middle = (len(image.semantic) - 1) / 2
        row = np.rint(middle - (right * np.cos(yaw) + up * np.sin(yaw)) / image.resolution).astype(
            np.int64
        )
        column = np.rint(
            middle - (up * np.cos(yaw) - right * np.sin(yaw)) / image.resolution
        ).astype(np.int64)
        free = (
            (own == 0) & (row >= 0) & (row <= 2 * middle) & (column >= 0) & (column <= 2 * middle)
        )
        own[free] = kinds[image.semantic[row[free], column[free]]]
    return merged


def _mapped(town: Any, low: FloatArray, high: FloatArray, cell: float) -> ByteArray:
    """(H, W) uint8: the ground by a town's map, as `_merged` gives it."""
    across, down = np.meshgrid(*_middles(low, high, cell))
    return ground_at(town, np.column_stack([across.ravel(), down.ravel()]), _GROUND).reshape(
        across.shape
    )


def _middles(low: FloatArray, high: FloatArray, cell: float) -> tuple[FloatArray, FloatArray]:
    """The x of the picture's columns, and the y of its rows from the top."""
    columns, rows = np.ceil((high - low) / cell).astype(int).tolist()
    return low[0] + (np.arange(columns) + 0.5) * cell, high[1] - (np.arange(rows) + 0.5) * cell


def _png(cells: ByteArray) -> bytes:
    from PIL import Image, ImageColor

    picture = Image.fromarray(cells)
    picture.putpalette(
        [255, 255, 255, *(part for name in _GROUND for part in ImageColor.getrgb(BEV_COLORS[name]))]
    )
    return picture_bytes(picture, "PNG", optimize=True, bits=2, transparency=0)
