"""Counts how often each cell of a town's raster was seen as road, road line, sidewalk or other.

A map is made from selected pictures (looks) of the BEV cameras in a town's scenarios.
`hidden_ground` fills in the ground under actors that never moved, which no picture shows although
pictures show the ground around it.
"""

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
"""Classes of ground; `other` covers all other CARLA tags: grass, buildings, trees, water."""
HIDING_TAGS: Final = ("pedestrian", "vehicle")
"""Tags of moving actors, which hide the ground: a picture shows nothing of the cells under them."""
# CARLA's tag for unlabelled objects.
_UNLABELLED_TAG = 0
# Row and column of the agent in a picture.
_AGENT_PIXEL = (BEV_SHAPE[0] - 1) / 2
# Metres that a picture shows to each side of its agent.
_PICTURE_RANGE_M = BEV_RESOLUTION * BEV_SHAPE[0] / 2
# Area of a hole that parked vehicles can make: two lorries. A larger one may be a yard.
_MAX_HOLE_AREA_M2 = 60.0
PixelCounts = NDArray[np.uint16]


@dataclass(frozen=True, slots=True, kw_only=True)
class TownMapConfig:
    """The cells of a map and the selection of its pictures; raises ConfigError for wrong numbers.

    A picture shows 60 m to each side, so successive frames show nearly the same. From each
    recording, the first and the last picture are read, and one whenever the agent has travelled
    `travel` or `period` has passed, because a later picture may show what a vehicle hides now.

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
            is_valid = math.isfinite(value) and value >= minimum and value > 0
            if not is_valid:
                bound = f"of at least {minimum:g}" if minimum else "above 0"
                raise ConfigError(f"{name}: expected a number {bound}, found {value:g}")
            object.__setattr__(self, name, value)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AgentPictures(FrozenArrays):
    """The pictures to read from one recording (an agent in a scenario); arrays are read-only.

    Attributes:
        sample_rows: Rows of the sample table, shape (N,).
        poses: Poses `world_from_ego`, shape (N, 4, 4).
    """

    sample_rows: IntArray
    poses: FloatArray

    def files(self, dataset: Dataset) -> Iterator[ReleasePath]:
        """Yield the paths of the pictures, which need not exist."""
        for row in self.sample_rows.tolist():
            sample = dataset.sample[row]["token"]
            yield dataset.sensor_path(f"{sample}/{BEV_CAMERA}")


def agent_pictures(
    dataset: Dataset, scenario_row: int, config: TownMapConfig
) -> list[AgentPictures]:
    """Select the pictures to read from each agent in a scenario."""
    samples = dataset.columns("sample")
    rows = np.flatnonzero(samples["scenario_row"] == scenario_row)
    agents = samples["agent_row"][rows]
    looks = []
    for agent in np.unique(agents):
        agent_rows = rows[agents == agent]
        poses = stored_transforms(dataset.columns("ego_pose")["matrix"][agent_rows])
        frames = select_frames(poses[:, :2, 3], config)
        looks.append(AgentPictures(sample_rows=agent_rows[frames], poses=poses[frames]))
    return looks


def select_frames(xy: FloatArray, config: TownMapConfig) -> IntArray:
    """Select the frames of a recording, numbered from 0, at which pictures are read.

    Args:
        xy: Position of the agent at each frame, shape (F, 2), metres; 10 frames a second.
        config: Distance and time between the frames.
    """
    frame_count = len(xy)
    steps = np.hypot(*np.diff(xy, axis=0).T)
    travelled = np.concatenate([[0.0], np.cumsum(steps)])
    seconds = np.arange(frame_count) * FRAME_PERIOD
    progress = np.column_stack([travelled / config.travel, seconds / config.period + 1e-9])
    stretches = progress.astype(np.int64)
    is_new_stretch = (np.diff(stretches, axis=0) > 0).any(axis=1)
    stretch_starts = np.flatnonzero(is_new_stretch) + 1
    return np.unique([0, *stretch_starts, frame_count - 1])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Window(FrozenArrays):
    """Cells around one scenario as its pictures show them; arrays are read-only.

    Cell (i, j) of the world has its lower corner at x = j · resolution, y = i · resolution.

    Attributes:
        corner: Row and column of the window's lowest cell, among the cells of the world.
        counts: Number of pictures that show each of `GROUND_CLASSES` at the cell's centre, shape
            (4, h, w), uint16.
        agents: Number of agents that saw the ground of the cell, shape (h, w), uint16.
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
    recordings = agent_pictures(dataset, scenario_row, config)
    poses = np.concatenate([recording.poses for recording in recordings])
    low, high = cells_around(poses, config.resolution)
    shape = tuple((high - low).tolist())
    counts = np.zeros((len(GROUND_CLASSES), *shape), dtype=np.uint16)
    agents = np.zeros(shape, dtype=np.uint16)
    tally = {"looks": 0, "missing": 0, "damaged": 0}
    for recording in recordings:
        seen = np.zeros(shape, dtype=np.bool_)
        for outcome in _add_looks(dataset, recording, config.resolution, low, counts, seen):
            tally[outcome] += 1
        agents += seen
    row, column = low.tolist()
    return Window(corner=(row, column), counts=counts, agents=agents, **tally)


def _add_looks(
    dataset: Dataset,
    recording: AgentPictures,
    resolution: float,
    low: IntArray,
    counts: PixelCounts,
    seen: BoolArray,
) -> list[str]:
    """Add one agent's pictures to `counts`, and mark the cells that it saw in `seen`.

    Returns the outcome of each picture as the name of the `Window` attribute that counts it.
    """
    outcomes = []
    for path, pose in zip(recording.files(dataset), recording.poses, strict=True):
        try:
            tags = read_bev(path, raw=True)[..., 2]
        except MissingFileError:
            outcomes.append("missing")
            continue
        except SensorFileError as error:
            logger.warning("excluded from the map: %s", error)
            outcomes.append("damaged")
            continue
        outcomes.append("looks")
        corner, codes = codes_in_world(tags, pose, resolution)
        row, column = (corner - low).tolist()
        rows = slice(row, row + codes.shape[0])
        columns = slice(column, column + codes.shape[1])
        for index in range(len(GROUND_CLASSES)):
            counts[index, rows, columns] += codes == index + 1
        seen[rows, columns] |= codes > 0
    return outcomes


def codes_in_world(
    tags: ByteArray, world_from_ego: FloatArray, resolution: float
) -> tuple[IntArray, ByteArray]:
    """Resample a picture's ground to the cells of the world, by the pixel nearest to each cell.

    The road is assumed to be a plane through the agent's origin, which tilts as the agent does.

    Args:
        tags: CARLA's tags, shape (1200, 1200), forward up.
        world_from_ego: Pose of the agent, shape (4, 4).
        resolution: Side of a cell, metres.

    Returns:
        Row and column of the lowest cell among the cells of the world, shape (2,), and codes of
        cells, shape (h, w), uint8: 0 if not seen, otherwise 1 + the index in `GROUND_CLASSES`.
        Rows run along y and columns along x, both ascending.
    """
    low, high = cells_around(world_from_ego[None], resolution)
    agent_x, agent_y = world_from_ego[:2, 3]
    cell_x = (np.arange(low[1], high[1]) + 0.5) * resolution
    cell_y = (np.arange(low[0], high[0]) + 0.5) * resolution
    x = (cell_x - agent_x)[None, :]
    y = (cell_y - agent_y)[:, None]
    # Forward is up in a picture, and left is left.
    forward, left = np.linalg.inv(world_from_ego[:2, :2]) / BEV_RESOLUTION
    row = np.rint(_AGENT_PIXEL - (forward[0] * x + forward[1] * y)).astype(np.int32)
    column = np.rint(_AGENT_PIXEL - (left[0] * x + left[1] * y)).astype(np.int32)
    in_rows = (row >= 0) & (row < BEV_SHAPE[0])
    in_columns = (column >= 0) & (column < BEV_SHAPE[1])
    in_picture = in_rows & in_columns
    codes = np.zeros(in_picture.shape, dtype=np.uint8)
    picture_tags = tags[row[in_picture], column[in_picture]]
    codes[in_picture] = _codes_of_tags()[picture_tags]
    return low, codes


def cells_around(poses: FloatArray, resolution: float) -> tuple[IntArray, IntArray]:
    """Return the bounds of the cells that pictures from poses (N, 4, 4) can show.

    Returns:
        Row and column of the lowest cell, and of the cell past the highest one, shape (2,) each.
    """
    xy = poses[:, :2, 3]
    rotations = poses[:, :2, :2]
    half_sides = _PICTURE_RANGE_M * np.abs(rotations).sum(axis=2)
    low = (xy - half_sides).min(axis=0) / resolution
    high = (xy + half_sides).max(axis=0) / resolution
    first_cell = np.floor(low).astype(np.int64)
    end_cell = np.ceil(high).astype(np.int64)
    return first_cell[::-1], end_cell[::-1]


def _codes_of_tags() -> ByteArray:
    """Return the code of each of CARLA's tags, shape (256,).

    A code is 0 if the tag hides the ground, otherwise 1 + the index in `GROUND_CLASSES`.
    """
    codes = np.full(256, 1 + GROUND_CLASSES.index("other"), dtype=np.uint8)
    codes[_UNLABELLED_TAG] = 0
    for name in HIDING_TAGS:
        codes[TAGS[name]] = 0
    for code, name in enumerate(GROUND_CLASSES[:-1], 1):
        codes[TAGS[name]] = code
    return codes


def hidden_ground(classes: ByteArray, resolution: float) -> ByteArray:
    """Return the ground in small holes, shape (H, W), uint8: the most frequent class around them.

    Road lines count as road. The result is 0 where the ground was seen, and in holes that are
    larger than 60 m² or reach the raster's edge.

    Args:
        classes: Codes of cells, shape (H, W): 0 not seen, 1 road, 2 road line, then the others.
        resolution: Side of a cell, metres.
    """
    from scipy import ndimage

    hole_numbers, hole_count = ndimage.label(classes == 0)
    cell_counts = np.bincount(hole_numbers.ravel(), minlength=hole_count + 1)
    is_small = cell_counts * resolution**2 <= _MAX_HOLE_AREA_M2
    is_small[0] = False
    edges = (hole_numbers[0], hole_numbers[-1], hole_numbers[:, 0], hole_numbers[:, -1])
    for edge in edges:
        is_small[edge] = False
    rows, columns = np.nonzero(is_small[hole_numbers])
    holes = hole_numbers[rows, columns]
    class_count = max(3, int(classes.max(initial=0)) + 1)
    votes = np.zeros((hole_count + 1, class_count), dtype=np.int64)
    for down, right in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        neighbours = classes[rows + down, columns + right]
        np.add.at(votes, (holes, neighbours), 1)
    not_seen, road, road_line = range(3)
    votes[:, road] += votes[:, road_line]
    votes[:, [not_seen, road_line]] = 0
    filled = np.zeros_like(classes)
    filled[rows, columns] = votes.argmax(axis=1)[holes]
    return filled
