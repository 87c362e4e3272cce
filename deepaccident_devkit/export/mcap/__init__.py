"""A scenario as one MCAP file, which Foxglove and rerun open as an interactive 3D scene.

It needs the extra `mcap`.

    from deepaccident_devkit import DeepAccident
    from deepaccident_devkit.export.mcap import export_mcap

    da = DeepAccident(dataroot="data/DeepAccident")
    export_mcap(da, da.scenario[0], "accident.mcap")

docs/pictures.md describes how to view the file. Only this package imports mcap, and only when
`export_mcap` is called.

Messages have Foxglove's protobuf schemas, and chunks are compressed with zstd. The topics, each
with its message:

- `/tf` (FrameTransforms): world → agent → its sensors.
- `/<agent>/pose` (PoseInFrame): the agent's ego frame in world.
- `/<agent>/<camera>/image` (CompressedImage): the unchanged bytes of the JPEG file.
- `/<agent>/<camera>/calibration` (CameraCalibration): K for the size of that image, without
  distortion.
- `/<agent>/lidar01/points` (PointCloud): x, y, z and intensity in the LiDAR frame.
- `/actors` (SceneUpdate): each annotated actor once, in world.
- `/actors/points` (PointCloud): the same actors as outlines, fronts and trails.
- `/<agent>/annotations` (SceneUpdate): the agent's own boxes, in its colour.
- `/<agent>/motion_labels/points` (PointCloud): one point per cell and frame, only with
  `motion_labels`.
- `/<agent>/prediction/…`: `paths`, `boxes` and `marks` (SceneUpdate), `motion/points`
  (PointCloud), and `alarm` (DoubleValue: the score of the alarm); only with a prediction. True
  paths are white, and the more probable a path is, the more opaque it is.
- `/road/points` (PointCloud): the ground in world, from the agents' BEV cameras; sent once.
- `/<agent>/speed` (DoubleValue): the speed in m/s, for plots.
- `/time_to_impact` (DoubleValue): seconds, only if meta names a collision.
- `/log` (Log): facts about the scenario, the countdown and the impact.

rerun (0.41) cannot show SceneUpdate messages, so actors and predictions also exist as point clouds,
on topics that end in `/points`. In Foxglove, show only one of the two.

The coordinate frames are `world`, `<agent>` (its ego frame), `<agent>/lidar01` and
`<agent>/<camera>`. Recordings have no date, so frame 1 is set to 2024-01-01 00:00:00 UTC; frames
follow at 10 Hz. Motion labels, true or predicted, are in the agent's ego frame at that moment, with
each future frame 0.2 m above the one before, and paler.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Final

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ChoiceError, MissingExtraError
from deepaccident_devkit.evaluation.results import Prediction, Results
from deepaccident_devkit.motion import MotionLabelConfig
from deepaccident_devkit.motion.config import resolved_label_config
from deepaccident_devkit.support.arrays import checked_whole
from deepaccident_devkit.support.text import PathType, choices, path_of, possible_text
from deepaccident_devkit.taxonomy import CAMERAS, LIDAR
from deepaccident_devkit.v2x import Agents

__all__ = ["EPOCH", "McapConfig", "Predictions", "export_mcap"]

EPOCH: Final = 1_704_067_200
"""Unix seconds of each scenario's first frame (2024-01-01 UTC), since viewers need a date."""
EXPORTED_CHANNELS: Final = (*CAMERAS, LIDAR)
# Modules of the extra `mcap`.
_EXTRA_MODULES = ("mcap", "mcap_protobuf", "foxglove_schemas_protobuf", "google")
Predictions = Results | Mapping[str, Prediction]
"""Predictions by sample token."""


def export_mcap(
    dataset: Dataset,
    scenario: RowArgument,
    path: PathType,
    *,
    prediction: Predictions | None = None,
    progress: bool = False,
    **choices: Any,
) -> Path:
    """Write a scenario into an MCAP file, with all agents on one timeline.

    The file contains poses, images, point clouds, boxes and labels, as Foxglove's protobuf
    messages. Image files are copied byte for byte. LiDAR coordinates are rounded to 1/32 m and
    intensities to 1/32, so that they compress well. With the same library versions, the same
    release and choices give the same bytes. The file is written completely or not at all. Two more
    files are then written next to it: a layout for Foxglove (`.foxglove.json`), and a script that
    opens the file in rerun with a blueprint (`.rerun.py`).

    Args:
        dataset: The release.
        scenario: Token or record of the scenario.
        path: Path of the file; an existing file is replaced.
        prediction: Results, or a mapping from sample token to prediction, which are rendered in
            addition to the labels.
        progress: Whether to show a progress bar.
        **choices: Fields of `McapConfig`: `agents`, `channels`, `frames`, `points`,
            `motion_labels`, `task`.

    Returns:
        The path.

    Raises:
        MissingExtraError: If the extra `mcap` is not installed.
        TokenError: If there is no such scenario.
        ChoiceError: If there is no such choice, agent, channel, frame or task, or the path is a
            folder.
        NotAvailableError: If an agent is not in this (partial) release, or no sample in the file
            has a prediction.
        SensorFileError: If a sensor file cannot be read.
    """
    config = McapConfig.of(**choices)
    target = path_of(path)
    if target.is_dir():
        raise ChoiceError(
            f"{target}: is a folder; name a file in it, such as {target / 'accident.mcap'}"
        )
    try:
        from deepaccident_devkit.export.mcap.scenario import write_scenario
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package not in _EXTRA_MODULES:
            raise
        raise MissingExtraError(
            f"the MCAP export needs {error.name}; run pip install '.[mcap]' in a checkout"
        ) from error
    return write_scenario(
        dataset, scenario, target, config, prediction=prediction, progress=progress
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class McapConfig:
    """Selection of what an MCAP file contains; checked on creation.

    Attributes:
        agents: Agents to export: their names, a configuration as seen from the ego vehicle, or None
            for all agents of the scenario (`v2x.Agents`).
        channels: Sensors to export: cameras and `lidar01`; None for all of them.
        frames: Numbers of frames, from 1; None for all.
        points: n for every n-th point of a cloud; 1 for all.
        motion_labels: Configuration of motion labels, or the name of a preset (`motion.PRESETS`);
            None to leave them out.
        task: Task that draws predictions, also of a plug-in; None for the one that they are for.
    """

    agents: Agents = None
    channels: Iterable[str] | None = None
    frames: Iterable[int] | None = None
    points: int = 1
    motion_labels: MotionLabelConfig | str | None = None
    task: str | None = None

    def __post_init__(self) -> None:
        """Check the fields; raise ChoiceError if one is impossible."""
        object.__setattr__(self, "channels", _check_channels(self.channels))
        object.__setattr__(self, "frames", _check_frames(self.frames))
        if checked_whole("points", self.points, "n for every n-th point", ChoiceError) < 1:
            raise ChoiceError(
                "points: expected a number n from 1, to keep every n-th point, found "
                f"{self.points!r}"
            )
        if self.motion_labels is not None:
            object.__setattr__(self, "motion_labels", resolved_label_config(self.motion_labels))

    @classmethod
    def of(cls, **choices: Any) -> McapConfig:
        """Make a configuration with these fields; raise ChoiceError if one is impossible."""
        names = [field.name for field in fields(cls)]
        for name in choices:
            if name not in names:
                raise ChoiceError(
                    f"export_mcap has no {name!r}; there are {possible_text(name, names)}"
                )
        return cls(**choices)

    def frame_numbers(self, last: int) -> tuple[int, ...]:
        """Return the selected frames of a scenario with `last` frames, in ascending order.

        Raises ChoiceError if a selected frame does not exist.
        """
        if self.frames is None:
            return tuple(range(1, last + 1))
        numbers = tuple(self.frames)
        for number in numbers:
            if not 1 <= number <= last:
                raise ChoiceError(f"frames: expected numbers from 1 to {last}, found {number}")
        return numbers


def _check_channels(channels: object) -> tuple[str, ...]:
    """Return the names of channels in the order of `EXPORTED_CHANNELS`.

    Raises ChoiceError if one is unknown.
    """
    if channels is None:
        return EXPORTED_CHANNELS
    names = choices("channels", channels, EXPORTED_CHANNELS, empty=True)
    return tuple(name for name in EXPORTED_CHANNELS if name in names)


def _check_frames(frames: object) -> tuple[int, ...] | None:
    """Return frame numbers, each once, in ascending order; None for all.

    Raises ChoiceError if they are not whole numbers from 1, or there are none.
    """
    if frames is None:
        return None
    if isinstance(frames, str) or not isinstance(frames, Iterable):
        raise ChoiceError(
            f"frames: expected frame numbers from 1, such as range(1, 11), found {frames!r}"
        )
    meaning = "whole numbers from 1"
    numbers = {checked_whole("frames", number, meaning, ChoiceError) for number in frames}
    if not numbers:
        raise ChoiceError("frames: expected at least one frame number, found none")
    return tuple(sorted(numbers))
