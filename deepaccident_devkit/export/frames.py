"""Keyframes of a recording, two a second counted back from its end, and its sensor files."""

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
"""Number of recorded frames between keyframes."""


def keyframes(frame_count: int) -> range:
    """Return the numbers of a recording's keyframes, from 1 to its number of frames."""
    return range((frame_count - 1) % KEY_STEP + 1, frame_count + 1, KEY_STEP)


def keyframe_after(number: int, frame_count: int) -> int:
    """Return the keyframe that a frame leads to: itself, or the next one."""
    return number + (frame_count - number) % KEY_STEP


def sensor_files(
    dataset: Dataset, scenario: str, agent: str, channel: str
) -> dict[int, tuple[ReleasePath, int]]:
    """Return frame number → path and bytes of a channel's existing files.

    Raises TokenError and DatarootError.
    """
    frame_count = dataset.scenario[dataset.getind("scenario", scenario)]["num_frames"]
    first_path = dataset.sensor_path(f"{sample_token(scenario, agent, 1)}/{channel}")
    folder = first_path.parent
    suffix = CHANNEL_FORMAT[channel]
    files = {}
    for number, size in frame_sizes(folder, suffix).items():
        if number <= frame_count:
            files[number] = (folder / f"{folder.name}_{number:03d}.{suffix}", size)
    return files


def stored_camera(
    dataset: Dataset, camera: str, file: tuple[ReleasePath, int] | None
) -> PinholeCamera:
    """Return a camera with K and size of its file of `sensor_files`, or of calib without a file.

    Args:
        dataset: The release.
        camera: Token of the camera's image.
        file: Path and bytes of the image; None for no file.

    Raises:
        TokenError: no such image.
        SensorFileError: the file is no image.
    """
    pinhole = dataset.camera(camera)
    if file is None:
        return pinhole
    path, _ = file
    return pinhole.resized(*image_size(path))
