"""The frames of a recording that formats take: keyframes, two a second counted back from its end; and their files."""

from __future__ import annotations

from typing import Final

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.geometry import PinholeCamera
from deepaccident_devkit.release.images import image_size
from deepaccident_devkit.release.layout import frame_sizes
from deepaccident_devkit.release.store import ReleasePath
from deepaccident_devkit.tables.tokens import sample_token
from deepaccident_devkit.taxonomy import CHANNEL_FORMAT

KEY_STEP: Final = 5
"""Recorded frames from one keyframe to the next."""


def keyframes(last: int) -> range:
    """The numbers of a recording's keyframes; frames are counted from 1 to `last`."""
    return range((last - 1) % KEY_STEP + 1, last + 1, KEY_STEP)


def keyframe_after(number: int, last: int) -> int:
    """The keyframe that a frame leads to: itself, or the next one."""
    return number + (last - number) % KEY_STEP


def sensor_files(
    dataset: Dataset, scenario: str, agent: str, channel: str
) -> dict[int, tuple[ReleasePath, int]]:
    """Frame number → path and bytes of a channel's files that are there; raises TokenError and DatarootError."""
    count = dataset.scenario[dataset.getind("scenario", scenario)]["num_frames"]
    folder = dataset.sensor_path(f"{sample_token(scenario, agent, 1)}/{channel}").parent
    ending = CHANNEL_FORMAT[channel]
    return {
        number: (folder / f"{folder.name}_{number:03d}.{ending}", size)
        for number, size in frame_sizes(folder, ending).items()
        if number <= count
    }


def stored_camera(
    dataset: Dataset, camera: str, file: tuple[ReleasePath, int] | None
) -> PinholeCamera:
    """A camera, by its image's token, with K and size of its file of `sensor_files`; without a file, those of calib.

    Raises TokenError, and SensorFileError if the file is no image.
    """
    lens = dataset.camera(camera)
    return lens if file is None else lens.resized(*image_size(file[0]))
