"""Counting: how often the cells of a town's raster were seen as road, road line, sidewalk or something else.

A map is made from some of the pictures of a scenario's BEV cameras, the looks. `hidden_ground` says what lies beneath
the actors that stayed: ground that no picture saw, although pictures saw all around it.
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
"""What the ground of a cell can be; `other` is whatever else CARLA has a tag for: grass, buildings, trees, water."""
HIDING: Final = ("pedestrian", "vehicle")
"""What moves and hides the ground: a picture says nothing of the cells beneath."""
# CARLA's tag of what has none.
_UNLABELLED: Final = 0
# Row and column of the agent.
_MIDDLE: Final = (BEV_SHAPE[0] - 1) / 2
# Metres that a picture shows to each side of its agent.
_REACH: Final = BEV_RESOLUTION * BEV_SHAPE[0] / 2
# Square metres of a hole that parked vehicles can make: two lorries. A larger one may be a yard.
_LARGEST: Final = 60.0
PixelCounts = NDArray[np.uint16]


@dataclass(frozen=True, slots=True, kw_only=True)
class TownMapConfig:
    """A map's cells, and which pictures are read; checked when made, raises ConfigError.

    A picture shows 60 m to each side, so that neighbouring frames show nearly the same. Of each recording the first and
    the last picture are read, and one whenever the agent has gone on by `travel` or `period` has passed: what a vehicle
    hides now, a later picture may show.

    Attributes:
        resolution: side of a cell, metres; at least 0.1, the side of a picture's pixel.
        travel: metres from one picture that is read to the next.
        period: seconds from one to the next, at most.
    """

    resolution: float = 0.25
    travel: float = 10.0
    period: float = 2.0

    def __post_init__(self) -> None:
        """Check the numbers."""
        for name, least in (("resolution", BEV_RESOLUTION), ("travel", 0.0), ("period", 0.0)):
            value = checked_number(name, getattr(self, name), error=ConfigError)
            if not (math.isfinite(value) and value >= least and value > 0):
                above = f"of at least {least:g}" if least else "above 0"
                raise ConfigError(f"{name}: expected a number {above}, found {value:g}")
            object.__setattr__(self, name, value)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Looks(FrozenArrays):
    """The pictures of one recording (an agent in a scenario) that are read; arrays are read-only.

    Attributes:
        sample_rows: (N,) rows of the sample table.
        poses: (N, 4, 4) `world_from_ego`.
    """

    sample_rows: IntArray
    poses: FloatArray

    def files(self, dataset: Dataset) -> Iterator[ReleasePath]:
        """Where the pictures lie; they need not be there."""
        return (
            dataset.sensor_path(f"{dataset.sample[row]['token']}/{BEV_CAMERA}")
            for row in self.sample_rows.tolist()
        )


def looks_of(dataset: Dataset, scenario_row: int, config: TownMapConfig) -> list[Looks]:
    """The looks of each agent of a scenario."""
    samples = dataset.columns("sample")
    rows = np.flatnonzero(samples["scenario_row"] == scenario_row)
    agents = samples["agent_row"][rows]
    looks = []
    for agent in np.unique(agents):
        own = rows[agents == agent]
        poses = stored_transforms(dataset.columns("ego_pose")["matrix"][own])
        chosen = chosen_frames(poses[:, :2, 3], config)
        looks.append(Looks(sample_rows=own[chosen], poses=poses[chosen]))
    return looks


def chosen_frames(xy: FloatArray, config: TownMapConfig) -> IntArray:
    """The frames, from 0, of a recording that are read, by where the agent is at each, 10 a second: (F, 2) metres."""
    steps = np.hypot(*np.diff(xy, axis=0).T)
    travelled = np.concatenate([[0.0], np.cumsum(steps)])
    seconds = np.arange(len(xy)) * FRAME_PERIOD
    stretches = np.column_stack([travelled / config.travel, seconds / config.period + 1e-9]).astype(
        np.int64
    )
    begins = np.flatnonzero((np.diff(stretches, axis=0) > 0).any(axis=1)) + 1
    return np.unique(np.concatenate([[0], begins, [len(xy) - 1]]))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Window(FrozenArrays):
    """What one scenario's pictures say of the cells around it; arrays are read-only.

    Cell (i, j) of the world has its lower corner at x = j · resolution, y = i · resolution.

    Attributes:
        corner: row and column of the window's first cell, among those of the world.
        counts: (4, h, w) uint16, pictures that saw each of `GROUND_CLASSES` at the cell's middle.
        agents: (h, w) uint16, agents that saw the ground there.
        looks: pictures that were read.
        missing: pictures whose files are not there.
        damaged: pictures whose files cannot be read.
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
    low, high = cells_around(np.concatenate([each.poses for each in recordings]), config.resolution)
    rows, columns = (high - low).tolist()
    counts = np.zeros((len(GROUND_CLASSES), rows, columns), dtype=np.uint16)
    agents = np.zeros((rows, columns), dtype=np.uint16)
    tally = {"looks": 0, "missing": 0, "damaged": 0}
    for recording in recordings:
        seen = np.zeros((rows, columns), dtype=np.bool_)
        for told in _add_looks(dataset, recording, config.resolution, low, counts, seen):
            tally[told] += 1
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
    """Add one agent's pictures to `counts`, and the cells that it saw to `seen`; says what became of each picture."""
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
        rows, columns = slice(row, row + codes.shape[0]), slice(column, column + codes.shape[1])
        for code in range(len(GROUND_CLASSES)):
            counts[code, rows, columns] += codes == code + 1
        seen[rows, columns] |= codes > 0
    return outcomes


def codes_in_world(
    tags: ByteArray, world_from_ego: FloatArray, resolution: float
) -> tuple[IntArray, ByteArray]:
    """A picture's ground in the cells of the world: what its pixel nearest to each cell's middle shows.

    The road is taken for a plane through the agent's origin, which tilts as the agent does; `tags` (1200, 1200) are
    CARLA's, forward up. Gives row and column (2,) of the first cell among those of the world, and (h, w) uint8, 0
    for not seen, else 1 + the position in `GROUND_CLASSES`; row = y index, column = x index, both rising.
    """
    low, high = cells_around(world_from_ego[None], resolution)
    y, x = (
        (np.arange(first, last) + 0.5) * resolution
        for first, last in zip(low.tolist(), high.tolist(), strict=True)
    )
    x, y = x - world_from_ego[0, 3], y - world_from_ego[1, 3]
    (a, b), (c, d) = np.linalg.inv(world_from_ego[:2, :2]) / BEV_RESOLUTION
    row = np.rint(_MIDDLE - (a * x[None, :] + b * y[:, None])).astype(np.int32)
    column = np.rint(_MIDDLE - (c * x[None, :] + d * y[:, None])).astype(np.int32)
    inside = (row >= 0) & (row < BEV_SHAPE[0]) & (column >= 0) & (column < BEV_SHAPE[1])
    codes = np.zeros(inside.shape, dtype=np.uint8)
    codes[inside] = _code_of_tag()[tags[row[inside], column[inside]]]
    return low, codes


def cells_around(poses: FloatArray, resolution: float) -> tuple[IntArray, IntArray]:
    """Row and column of the first cell that pictures from poses (N, 4, 4) can show, and of the one past the last."""
    half = _REACH * np.abs(poses[:, :2, :2]).sum(axis=2)
    low = np.floor((poses[:, :2, 3] - half).min(axis=0) / resolution)
    high = np.ceil((poses[:, :2, 3] + half).max(axis=0) / resolution)
    return low[::-1].astype(np.int64), high[::-1].astype(np.int64)


def _code_of_tag() -> ByteArray:
    """Of each of CARLA's tags (256,): 0 for what says nothing of the ground, else 1 + the position in the classes."""
    codes = np.full(256, 1 + GROUND_CLASSES.index("other"), dtype=np.uint8)
    codes[[_UNLABELLED, *(TAGS[name] for name in HIDING)]] = 0
    for code, name in enumerate(GROUND_CLASSES[:-1], 1):
        codes[TAGS[name]] = code
    return codes


def hidden_ground(classes: ByteArray, resolution: float) -> ByteArray:
    """(H, W) uint8, the ground of small holes: what most of the cells around a hole are, road lines taken for road.

    `classes` (H, W) are 0 where nothing was seen, 1 road, 2 road line, then others. The result is 0 where something
    was seen, and in holes that are larger than 60 m² or reach the raster's edge.
    """
    from scipy import ndimage

    labels, count = ndimage.label(classes == 0)
    filled = np.zeros_like(classes)
    closed = np.bincount(labels.ravel(), minlength=count + 1) * resolution**2 <= _LARGEST
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
    """The most frequent class (1 + count,) beside the cells (N,) of each hole, by the hole's number."""
    kinds = int(classes.max(initial=0)) + 1
    votes = np.zeros((count + 1, max(kinds, 3)), dtype=np.int64)
    for down, right in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        np.add.at(votes, (holes, classes[rows + down, columns + right]), 1)
    votes[:, 1] += votes[:, 2]
    votes[:, [0, 2]] = 0
    return np.asarray(votes.argmax(axis=1).astype(np.uint8))
