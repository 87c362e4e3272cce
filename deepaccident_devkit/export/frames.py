"""Keyframes of a recording (two a second, counted back from its end), and its sensor files."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final, TypeAlias

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.geometry import PinholeCamera
from deepaccident_devkit.release.images import image_size
from deepaccident_devkit.release.layout import frame_sizes
from deepaccident_devkit.release.store import ReleasePath
from deepaccident_devkit.tables.tokens import sample_token
from deepaccident_devkit.taxonomy import CHANNEL_FORMAT

KEY_STEP: Final = 5
"""Number of recorded frames from one keyframe to the next one."""
SensorFile: TypeAlias = "tuple[ReleasePath, int]"
"""Path of a sensor file, and its size in bytes."""
FrameFiles: TypeAlias = "dict[int, SensorFile]"
"""Sensor files by frame number."""


def keyframes(frame_count: int, step: int = KEY_STEP) -> range:
    """Return the frame numbers, from 1 to `frame_count`, of a recording's keyframes.

    They are `step` frames apart.
    """
    first_keyframe = (frame_count - 1) % step + 1
    return range(first_keyframe, frame_count + 1, step)


def next_keyframe(number: int, frame_count: int) -> int:
    """Return the number of the first keyframe at or after a frame."""
    return number + (frame_count - number) % KEY_STEP


def sensor_files(dataset: Dataset, scenario: str, agent: str, channel: str) -> FrameFiles:
    """Find the existing files of a channel.

    Raises:
        TokenError: If there is no such scenario, agent or channel.
        DatarootError: If the folder cannot be listed.
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


def select_files(files: FrameFiles, numbers: Iterable[int]) -> FrameFiles:
    """Return the existing files of these frames."""
    return {number: files[number] for number in numbers if number in files}


def load_camera(dataset: Dataset, camera: str, file: SensorFile | None) -> PinholeCamera:
    """Return a camera with the K and size of its stored image, or of calib without a file.

    Args:
        dataset: The release.
        camera: Token of the camera's image.
        file: File of the image; None for no file.

    Raises:
        TokenError: If there is no such image.
        SensorFileError: If the file is not an image.
    """
    pinhole = dataset.camera(camera)
    if file is None:
        return pinhole
    path, _ = file
    return pinhole.resized(*image_size(path))
