"""Which moment and which agent are shown by default, the same for all pictures of a scenario."""

from __future__ import annotations

from collections.abc import Collection, Iterable

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.support.arrays import IntArray
from deepaccident_devkit.taxonomy import CHANNELS, FRAME_PERIOD
from deepaccident_devkit.v2x.agents import agents_of

# Motion labels have all their future frames up to this time before the end.
_TIME_BEFORE_END_S = 2.0


def default_frame(dataset: Dataset, scenario: str) -> int:
    """Return the number of the frame that is shown by default for a scenario (a token).

    It is the frame two seconds before the end, or the first frame of a shorter scenario. In a
    partial download it is the frame with the most sensor files up to then, the latest of several.
    """
    files = count_files(dataset, scenario, CHANNELS)
    frames_before_end = round(_TIME_BEFORE_END_S / FRAME_PERIOD)
    frame_count = max(1, files.shape[2] - frames_before_end)
    counts = files[..., :frame_count].sum(axis=(0, 1))
    return int(np.flatnonzero(counts == counts.max())[-1]) + 1


def default_agent(
    dataset: Dataset, scenario: str, frames: Iterable[int], channels: Collection[str]
) -> str:
    """Return the agent of a scenario (a token) that is shown by default in some frames.

    It is the agent with the most files of these channels, the first of several.
    """
    files = count_files(dataset, scenario, channels)
    frame_positions = np.array([*frames]) - 1
    counts = files[..., frame_positions].sum(axis=(1, 2))
    return agents_of(dataset, scenario)[int(counts.argmax())]


def count_files(dataset: Dataset, scenario: str, channels: Collection[str]) -> IntArray:
    """Count the existing sensor files: shape (agents of the scenario, channels, frames)."""
    agents = agents_of(dataset, scenario)
    names = list(channels)
    num_frames = dataset.get("scenario", scenario)["num_frames"]
    files = np.zeros((len(agents), len(names), num_frames), dtype=np.int64)
    for (agent, channel), frames in dataset.sensor_frames(scenario).items():
        if channel in names:
            frame_positions = np.array(frames, dtype=int) - 1
            files[agents.index(agent), names.index(channel), frame_positions] = 1
    return files
