"""Counts how often each cell of a town's raster was seen as road, road line, sidewalk or other.

A map is made from a selection of the pictures of a scenario's BEV cameras, the looks.
`hidden_ground` fills in the ground under actors that never moved: no picture saw it, although
pictures saw all around it.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import ConfigError, MissingFileError, SensorFileError
from deepaccident_devkit.geometry.conventions import stored_transforms
from deepaccident_devkit.release import read_bev
from deepaccident_devkit.release.npz import TAGS
from deepaccident_devkit.release.store import ReleasePath
from deepaccident_devkit.support.arrays import (
    BoolArray,
    ByteArray,
    FloatArray,
    FrozenArrays,
    IntArray,
    checked_number,
)
from deepaccident_devkit.taxonomy import BEV_CAMERA, BEV_RESOLUTION, BEV_SHAPE, FRAME_PERIOD

logger = logging.getLogger(__name__)
GROUND_CLASSES: Final = ("road", "road_line", "sidewalk", "other")
"""Classes of ground; `other` has all other tags of CARLA: grass, buildings, trees, water."""
HIDING_TAGS: Final = ("pedestrian", "vehicle")
"""Tags that move and hide the ground: a picture shows nothing of the cells under them."""
# CARLA's tag of objects without a tag.
_UNLABELLED_TAG: Final = 0
# Row and column of the agent in a picture.
_AGENT_PIXEL: Final = (BEV_SHAPE[0] - 1) / 2
# Range of a picture to each side of its agent.
_PICTURE_RANGE_M: Final = BEV_RESOLUTION * BEV_SHAPE[0] / 2
# Area of a hole that parked vehicles can make: two lorries. A larger one may be a yard.
_MAX_HOLE_AREA_M2: Final = 60.0
PixelCounts = NDArray[np.uint16]


@dataclass(frozen=True, slots=True, kw_only=True)
class TownMapConfig:
    """A map's cells and the selection of its pictures; raises ConfigError for wrong numbers.

    A picture shows 60 m to each side, so that neighbouring frames show nearly the same. Of each
    recording the first and the last picture are read, and one whenever the agent has travelled
    `travel` or `period` has passed: a later picture may show what a vehicle hides now.

    Attributes:
        resolution: Side of a cell, metres; at least 0.1, the side of a picture's pixel.
        travel: Distance between pictures that are read, metres.
        period: Longest time between pictures that are read, seconds.
    """

    resolution: float = 0.25
    travel: float = 10.0
    period: float = 2.0

    def __post_init__(self) -> None:
        """Check the numbers."""
        minimums = {"resolution": BEV_RESOLUTION, "travel": 0.0, "period": 0.0}
        for name, minimum in minimums.items():
            value = checked_number(name, getattr(self, name), error=ConfigError)
            if not (math.isfinite(value) and value >= minimum and value > 0):
                bound = f"of at least {minimum:g}" if minimum else "above 0"
                raise ConfigError(f"{name}: expected a number {bound}, found {value:g}")
            object.__setattr__(self, name, value)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Looks(FrozenArrays):
    """Pictures of one recording (an agent in a scenario) that are read; arrays are read-only.

    Attributes:
        sample_rows: Rows of the sample table, shape (N,).
        poses: Poses `world_from_ego`, shape (N, 4, 4).
    """

    sample_rows: IntArray
    poses: FloatArray

    def files(self, dataset: Dataset) -> Iterator[ReleasePath]:
        """Yield the paths of the pictures, which need not exist."""
        for row in self.sample_rows.tolist():
            yield dataset.sensor_path(f"{dataset.sample[row]['token']}/{BEV_CAMERA}")


def looks_of(dataset: Dataset, scenario_row: int, config: TownMapConfig) -> list[Looks]:
    """Return the looks of each agent of a scenario."""
    samples = dataset.columns("sample")
    rows = np.flatnonzero(samples["scenario_row"] == scenario_row)
    agents = samples["agent_row"][rows]
    looks = []
    for agent in np.unique(agents):
        agent_rows = rows[agents == agent]
        poses = stored_transforms(dataset.columns("ego_pose")["matrix"][agent_rows])
        frames = select_frames(poses[:, :2, 3], config)
        looks.append(Looks(sample_rows=agent_rows[frames], poses=poses[frames]))
    return looks


def select_frames(xy: FloatArray, config: TownMapConfig) -> IntArray:
    """Return the frames of a recording that are read, from 0.

    Args:
        xy: Positions of the agent at each frame, shape (F, 2), metres, 10 a second.
        config: Distance and time between the frames.
    """
    steps = np.hypot(*np.diff(xy, axis=0).T)
    travelled = np.concatenate([[0.0], np.cumsum(steps)])
    seconds = np.arange(len(xy)) * FRAME_PERIOD
    progress = np.column_stack([travelled / config.travel, seconds / config.period + 1e-9])
    stretches = progress.astype(np.int64)
    starts = np.flatnonzero((np.diff(stretches, axis=0) > 0).any(axis=1)) + 1
    return np.unique(np.concatenate([[0], starts, [len(xy) - 1]]))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Window(FrozenArrays):
    """Cells around one scenario as its pictures show them; arrays are read-only.

    Cell (i, j) of the world has its lower corner at x = j · resolution, y = i · resolution.

    Attributes:
        corner: Row and column of the window's lowest cell, among the cells of the world.
        counts: Pictures that saw each of `GROUND_CLASSES` at the cell's middle, shape (4, h, w),
            uint16.
        agents: Agents that saw the ground of the cell, shape (h, w), uint16.
        looks: Number of pictures that were read.
        missing: Number of pictures without a file.
        damaged: Number of pictures with an unreadable file.
    """

    corner: tuple[int, int]
    counts: PixelCounts
    agents: PixelCounts
    looks: int
    missing: int
    damaged: int


def count_scenario(dataset: Dataset, config: TownMapConfig, scenario_row: int) -> Window:
    """Count what the BEV cameras of one scenario saw, in the cells of the world."""
    recordings = looks_of(dataset, scenario_row, config)
    poses = np.concatenate([recording.poses for recording in recordings])
    low, high = cells_around(poses, config.resolution)
    rows, columns = (high - low).tolist()
    counts = np.zeros((len(GROUND_CLASSES), rows, columns), dtype=np.uint16)
    agents = np.zeros((rows, columns), dtype=np.uint16)
    tally = {"looks": 0, "missing": 0, "damaged": 0}
    for recording in recordings:
        seen = np.zeros((rows, columns), dtype=np.bool_)
        for outcome in _add_looks(dataset, recording, config.resolution, low, counts, seen):
            tally[outcome] += 1
        agents += seen
    return Window(corner=(int(low[0]), int(low[1])), counts=counts, agents=agents, **tally)


def _add_looks(
    dataset: Dataset,
    recording: Looks,
    resolution: float,
    low: IntArray,
    counts: PixelCounts,
    seen: BoolArray,
) -> list[str]:
    """Add one agent's pictures to `counts`, and its cells to `seen`; return each outcome."""
    outcomes = []
    for path, pose in zip(recording.files(dataset), recording.poses, strict=True):
        try:
            tags = read_bev(path, raw=True)[..., 2]
        except MissingFileError:
            outcomes.append("missing")
            continue
        except SensorFileError as error:
            logger.warning("left out of the map: %s", error)
            outcomes.append("damaged")
            continue
        outcomes.append("looks")
        corner, codes = codes_in_world(tags, pose, resolution)
        row, column = (corner - low).tolist()
        rows = slice(row, row + codes.shape[0])
        columns = slice(column, column + codes.shape[1])
        for code in range(len(GROUND_CLASSES)):
            counts[code, rows, columns] += codes == code + 1
        seen[rows, columns] |= codes > 0
    return outcomes


def codes_in_world(
    tags: ByteArray, world_from_ego: FloatArray, resolution: float
) -> tuple[IntArray, ByteArray]:
    """Return a picture's ground in the cells of the world, from the pixel nearest to each cell.

    The road is taken for a plane through the agent's origin, which tilts as the agent does.

    Args:
        tags: CARLA's tags, shape (1200, 1200), forward up.
        world_from_ego: Pose of the agent, shape (4, 4).
        resolution: Side of a cell, metres.

    Returns:
        Row and column of the lowest cell among the cells of the world, shape (2,), and codes of
        cells, shape (h, w), uint8: 0 for not seen, otherwise 1 + the position in `GROUND_CLASSES`;
        row = y index, column = x index, both rising.
    """
    low, high = cells_around(world_from_ego[None], resolution)
    y, x = (
        (np.arange(start, stop) + 0.5) * resolution
        for start, stop in zip(low.tolist(), high.tolist(), strict=True)
    )
    x = x - world_from_ego[0, 3]
    y = y - world_from_ego[1, 3]
    (a, b), (c, d) = np.linalg.inv(world_from_ego[:2, :2]) / BEV_RESOLUTION
    row = np.rint(_AGENT_PIXEL - (a * x[None, :] + b * y[:, None])).astype(np.int32)
    column = np.rint(_AGENT_PIXEL - (c * x[None, :] + d * y[:, None])).astype(np.int32)
    in_row = (row >= 0) & (row < BEV_SHAPE[0])
    in_picture = in_row & (column >= 0) & (column < BEV_SHAPE[1])
    codes = np.zeros(in_picture.shape, dtype=np.uint8)
    codes[in_picture] = _code_of_tag()[tags[row[in_picture], column[in_picture]]]
    return low, codes


def cells_around(poses: FloatArray, resolution: float) -> tuple[IntArray, IntArray]:
    """Return the cells that pictures from poses (N, 4, 4) can show.

    They are row and column of the lowest cell, and of the cell past the highest.
    """
    xy = poses[:, :2, 3]
    half = _PICTURE_RANGE_M * np.abs(poses[:, :2, :2]).sum(axis=2)
    low = np.floor((xy - half).min(axis=0) / resolution).astype(np.int64)
    high = np.ceil((xy + half).max(axis=0) / resolution).astype(np.int64)
    return low[::-1], high[::-1]


def _code_of_tag() -> ByteArray:
    """Return the code of each of CARLA's tags, shape (256,).

    It is 0 if the tag hides the ground, otherwise 1 + the position in `GROUND_CLASSES`.
    """
    codes = np.full(256, 1 + GROUND_CLASSES.index("other"), dtype=np.uint8)
    codes[[_UNLABELLED_TAG, *(TAGS[name] for name in HIDING_TAGS)]] = 0
    for code, name in enumerate(GROUND_CLASSES[:-1], 1):
        codes[TAGS[name]] = code
    return codes


def hidden_ground(classes: ByteArray, resolution: float) -> ByteArray:
    """Return the ground of small holes, shape (H, W), uint8: the most frequent class around them.

    Road lines count as road. The result is 0 where something was seen, and in holes that are larger
    than 60 m² or reach the raster's edge.

    Args:
        classes: Codes of cells, shape (H, W): 0 not seen, 1 road, 2 road line, then others.
        resolution: Side of a cell, metres.
    """
    from scipy import ndimage

    labels, count = ndimage.label(classes == 0)
    filled = np.zeros_like(classes)
    areas = np.bincount(labels.ravel(), minlength=count + 1) * resolution**2
    closed = areas <= _MAX_HOLE_AREA_M2
    closed[0] = False
    for edge in (labels[0], labels[-1], labels[:, 0], labels[:, -1]):
        closed[edge] = False
    rows, columns = np.nonzero(closed[labels])
    holes = labels[rows, columns].astype(np.int64)
    filled[rows, columns] = _classes_around(classes, rows, columns, holes, count)[holes]
    return filled


def _classes_around(
    classes: ByteArray, rows: IntArray, columns: IntArray, holes: IntArray, count: int
) -> ByteArray:
    """Return the most frequent class beside the cells (N,) of each hole, shape (1 + count,)."""
    kinds = int(classes.max(initial=0)) + 1
    votes = np.zeros((count + 1, max(kinds, 3)), dtype=np.int64)
    for down, right in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        np.add.at(votes, (holes, classes[rows + down, columns + right]), 1)
    votes[:, 1] += votes[:, 2]
    votes[:, [0, 2]] = 0
    return np.asarray(votes.argmax(axis=1).astype(np.uint8))
