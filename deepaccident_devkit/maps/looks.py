"""Looks: which pictures of a scenario's BEV cameras a map is made from, and where their agents stood."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from deepaccident_devkit.arrays import FloatArray, FrozenArrays, IntArray, checked_number
from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.geometry.se3 import stored_transforms
from deepaccident_devkit.release.store import ReleasePath
from deepaccident_devkit.taxonomy import BEV_CAMERA, BEV_RESOLUTION, FRAME_PERIOD


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
        for row in self.sample_rows.tolist():
            yield dataset.sensor_path(f"{dataset.sample[row]['token']}/{BEV_CAMERA}")


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
    """The frames, from 0, of a recording that are read.

    Args:
        xy: (F, 2) where the agent is at each frame, 10 a second, metres.
        config: how far apart they are.
    """
    steps = np.hypot(*np.diff(xy, axis=0).T)
    travelled = np.concatenate([[0.0], np.cumsum(steps)])
    seconds = np.arange(len(xy)) * FRAME_PERIOD
    stretches = np.column_stack([travelled / config.travel, seconds / config.period + 1e-9]).astype(np.int64)
    begins = np.flatnonzero((np.diff(stretches, axis=0) > 0).any(axis=1)) + 1
    return np.unique(np.concatenate([[0], begins, [len(xy) - 1]]))
