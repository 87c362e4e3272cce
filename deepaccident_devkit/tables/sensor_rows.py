"""Rows of the tables that say where sensors are: `sample_data`, `calibrated_sensor`, `ego_pose`, `sensor`."""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from deepaccident_devkit.geometry import quaternions
from deepaccident_devkit.release import Calibs
from deepaccident_devkit.support.arrays import AnyArray, FloatArray, IntArray
from deepaccident_devkit.tables.columns import NULL_INTEGER
from deepaccident_devkit.taxonomy import (
    BEV_CAMERA,
    BEV_SHAPE,
    CAMERAS,
    CHANNEL_FORMAT,
    CHANNEL_MODALITY,
    CHANNELS,
    FILE_FORMATS,
    LIDAR,
    MODALITIES,
    frame_timestamp,
)

TRANSLATION_TOLERANCE: Final = 1e-3
"""Metres by which a sensor's place on its agent jitters, since the release computes it in single precision; measured:
2e-4 a few hundred metres from the world's origin."""
ROTATION_TOLERANCE: Final = 1e-5
"""The same for the entries of its rotation; measured: 4e-7."""
_INTRINSIC_TOLERANCE = 1e-6

Rows = Mapping[str, Any]
"""Stored column name → array (or list, for words) of one table."""


def sensor_tables(calibs: Calibs, *, agents: int, frames: int) -> dict[str, Rows]:
    """The rows of one scenario's sensor tables; `calibs` holds its samples agent by agent."""
    values = _sensor_values(calibs)
    calibrated_sensors, calibrated_sensor_of = _calibrated_sensor_rows(values, agents, frames)
    return {
        "sample_data": {
            **_sample_data_rows(calibs, calibrated_sensor_of, agents, frames),
            "matrix": values[..., :12].reshape(-1, 12),
        },
        "calibrated_sensor": calibrated_sensors,
        "ego_pose": _ego_pose_rows(calibs, agents, frames),
    }


def sensor_rows() -> Rows:
    """The rows of table `sensor`, the same for all scenarios."""
    return {"channel": np.arange(len(CHANNELS)), "modality": _channel_modalities()}


def neighbour_rows(frames: int, agents: int) -> tuple[IntArray, IntArray]:
    """Rows before and after each of `agents` runs of `frames` rows; −1 at a run's ends."""
    row = np.arange(agents * frames)
    previous = np.where(row % frames == 0, NULL_INTEGER, row - 1)
    return previous, np.where(row % frames == frames - 1, NULL_INTEGER, row + 1)


def timestamps(frames: int) -> FloatArray:
    """(F,) seconds since the first of `frames` frames."""
    return np.array([frame_timestamp(index) for index in range(1, frames + 1)])


def _sample_data_rows(calibs: Calibs, calibrated_sensor_of: IntArray, agents: int, frames: int) -> Rows:
    """Rows in the order sample, channel."""
    samples, channels = len(calibs), len(CHANNELS)
    previous, following = (
        np.where(neighbour[:, None] < 0, NULL_INTEGER, neighbour[:, None] * channels + np.arange(channels))
        for neighbour in neighbour_rows(frames, agents)
    )
    size = np.full((samples, channels, 2), NULL_INTEGER, dtype=np.int64)
    size[:, : len(CAMERAS)] = np.rint(2 * calibs.intrinsic[..., :2, 2])
    size[:, CHANNELS.index(BEV_CAMERA)] = BEV_SHAPE[::-1]
    return {
        "sample_row": np.repeat(np.arange(samples), channels),
        "sensor_row": np.tile(np.arange(channels), samples),
        "calibrated_sensor_row": calibrated_sensor_of.reshape(-1),
        "ego_pose_row": np.repeat(np.arange(samples), channels),
        "channel": np.tile(np.arange(channels), samples),
        "modality": np.tile(_channel_modalities(), samples),
        "fileformat": np.tile([FILE_FORMATS.index(CHANNEL_FORMAT[channel]) for channel in CHANNELS], samples),
        "width": size[..., 0].reshape(-1),
        "height": size[..., 1].reshape(-1),
        "prev_row": previous.reshape(-1),
        "next_row": following.reshape(-1),
    }


def _calibrated_sensor_rows(values: FloatArray, agents: int, frames: int) -> tuple[Rows, IntArray]:
    """The distinct values of every agent's sensors, by agent, channel, first occurrence; and each file's row.

    Args:
        values: as of `_sensor_values`.
        agents: how many.
        frames: of each.

    Returns:
        The columns; (samples, channels) rows of them.
    """
    row_of = np.zeros(values.shape[:2], dtype=np.int64)
    chosen: list[FloatArray] = []
    keys: list[tuple[int, int, int]] = []
    for agent in range(agents):
        samples = slice(agent * frames, (agent + 1) * frames)
        for channel in range(len(CHANNELS)):
            distinct, which = _distinct(values[samples, channel])
            row_of[samples, channel] = len(keys) + which
            chosen.append(distinct)
            keys += [(agent, channel, number + 1) for number in range(len(distinct))]
    table, key_table = np.concatenate(chosen), np.array(keys)
    poses = table[:, :16].reshape(-1, 4, 4)
    return {
        "sensor_row": key_table[:, 1],
        "agent_row": key_table[:, 0],
        "number": key_table[:, 2],
        "translation": poses[:, :3, 3],
        "rotation": quaternions.from_matrix(poses[:, :3, :3]),
        "camera_intrinsic": table[:, 16:],
        "matrix": table[:, :16],
    }, row_of


def _sensor_values(calibs: Calibs) -> FloatArray:
    """(samples, channels, 25): `ego_from_sensor` and K (NaN where there is none) of every file."""
    samples, channels = len(calibs), len(CHANNELS)
    matrix = np.tile(np.eye(4), (samples, channels, 1, 1))
    matrix[:, : len(CAMERAS)] = calibs.ego_from_lidar[:, None] @ np.linalg.inv(calibs.camera_from_lidar)
    matrix[:, CHANNELS.index(LIDAR)] = calibs.ego_from_lidar
    intrinsic = np.full((samples, channels, 3, 3), np.nan)
    intrinsic[:, : len(CAMERAS)] = calibs.intrinsic
    return np.concatenate([matrix.reshape(samples, channels, 16), intrinsic.reshape(samples, channels, 9)], axis=-1)


def _ego_pose_rows(calibs: Calibs, agents: int, frames: int) -> Rows:
    pose = calibs.world_from_ego
    return {
        "translation": pose[:, :3, 3],
        "rotation": quaternions.from_matrix(pose[:, :3, :3]),
        "timestamp": np.tile(timestamps(frames), agents),
        "matrix": pose.reshape(-1, 16),
    }


def _distinct(rows: FloatArray) -> tuple[FloatArray, IntArray]:
    """The rows (F, 25) that differ by more than rounding, in order of occurrence, and which of them each row is."""
    tolerance = np.full(25, _INTRINSIC_TOLERANCE)
    tolerance[:16] = ROTATION_TOLERANCE
    tolerance[[3, 7, 11]] = TRANSLATION_TOLERANCE
    which = np.full(len(rows), NULL_INTEGER)
    first: list[int] = []
    while (left := np.flatnonzero(which < 0)).size:
        change = np.abs(rows[left] - rows[left[0]])
        alike = (~(change > tolerance)).all(axis=1)  # NaN, where there is no K, is alike
        which[left[alike]] = len(first)
        first.append(int(left[0]))
    return rows[first], which


def _channel_modalities() -> AnyArray:
    return np.array([MODALITIES.index(CHANNEL_MODALITY[channel]) for channel in CHANNELS])
