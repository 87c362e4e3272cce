"""A scenario as one MCAP file, which Foxglove and rerun open as an interactive 3D scene.

It needs the extra `mcap`.

    from deepaccident_devkit import DeepAccident
    from deepaccident_devkit.export.mcap import export_mcap

    da = DeepAccident(dataroot="data/DeepAccident")
    export_mcap(da, da.scenario[0], "accident.mcap")

docs/pictures.md lists the topics and describes how to view them. Only this package imports mcap,
and only when `export_mcap` is called.
"""

from __future__ import annotations

import os
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
from deepaccident_devkit.support.text import choices, path_of, possible_text
from deepaccident_devkit.taxonomy import CAMERAS, LIDAR
from deepaccident_devkit.v2x import Agents

__all__ = ["EPOCH", "McapConfig", "Predictions", "export_mcap"]

EPOCH: Final = 1_704_067_200
"""Unix seconds of each scenario's first frame (2024-01-01 UTC), since viewers need a date."""
EXPORTED_CHANNELS: Final = (*CAMERAS, LIDAR)
# Modules of the extra `mcap`.
_EXTRA_MODULES: Final = ("mcap", "mcap_protobuf", "foxglove_schemas_protobuf", "google")
Predictions = Results | Mapping[str, Prediction]
"""Predictions by sample token."""


def export_mcap(
    dataset: Dataset,
    scenario: RowArgument,
    path: str | os.PathLike[str],
    *,
    prediction: Predictions | None = None,
    progress: bool = False,
    **choices: Any,
) -> Path:
    """Write a scenario into an MCAP file, with all agents on one timeline.

    The file has poses, images, point clouds, boxes and labels. Messages are Foxglove's, as
    protobuf. Images have the bytes of their files; LiDAR coordinates are rounded to 1/32 m and
    intensities to 1/32, so that they compress. The same release and choices give the same bytes,
    with the same versions of the libraries. The file is written completely or not at all, and after
    it, beside it, a layout for Foxglove (`.foxglove.json`) and a script that opens it in rerun with
    a blueprint (`.rerun.py`).

    Args:
        dataset: The release.
        scenario: Token or record.
        path: Path of the file; an existing file is replaced.
        prediction: Results, or a mapping from sample token to prediction; rendered in addition to
            the labels.
        progress: Whether to show a progress bar.
        **choices: The fields of `McapConfig`: `agents`, `channels`, `frames`, `points`,
            `motion_labels`.

    Returns:
        The path.

    Raises:
        MissingExtraError: the extra `mcap` is not installed.
        TokenError: no such scenario.
        ChoiceError: no such choice, agent, channel or frame, or the path is a folder.
        NotAvailableError: an agent is not in this (partial) release, or no sample in the file has a
            prediction.
        SensorFileError: a sensor file cannot be read.
    """
    config = McapConfig.of(**choices)
    target = path_of(path)
    if target.is_dir():
        raise ChoiceError(
            f"path: expected a file, such as {target / 'accident.mcap'}, found the folder {target}"
        )
    try:
        from deepaccident_devkit.export.mcap.scenario import write_scenario
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package not in _EXTRA_MODULES:
            raise
        raise MissingExtraError(
            f"the MCAP export needs {error.name}: in a checkout, pip install '.[mcap]'"
        ) from error
    return write_scenario(
        dataset, scenario, target, config, prediction=prediction, progress=progress
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class McapConfig:
    """Parts of a scenario in the file; checked on creation.

    Attributes:
        agents: Agents to export: their names, a configuration as seen from the ego vehicle, or None
            for all agents of the scenario (`v2x.Agents`).
        channels: Sensors to export: cameras and `lidar01`; None for all of them.
        frames: Numbers of frames, from 1; None for all.
        points: n for every n-th point of a cloud; 1 for all.
        motion_labels: Configuration of motion labels, or the name of a preset (`motion.PRESETS`);
            None for none.
    """

    agents: Agents = None
    channels: Iterable[str] | None = None
    frames: Iterable[int] | None = None
    points: int = 1
    motion_labels: MotionLabelConfig | str | None = None

    def __post_init__(self) -> None:
        """Check the fields; raises ChoiceError."""
        object.__setattr__(self, "channels", _channel_names(self.channels))
        object.__setattr__(self, "frames", _frame_numbers(self.frames))
        if checked_whole("points", self.points, "n for every n-th point", ChoiceError) < 1:
            raise ChoiceError(
                f"points: expected a number from 1, for every n-th point, found {self.points!r}"
            )
        if self.motion_labels is not None:
            object.__setattr__(self, "motion_labels", resolved_label_config(self.motion_labels))

    @classmethod
    def of(cls, **choices: Any) -> McapConfig:
        """Return a configuration with these fields; raises ChoiceError."""
        names = [field.name for field in fields(cls)]
        for name in choices:
            if name not in names:
                raise ChoiceError(
                    f"export_mcap has no {name!r}; there are {possible_text(name, names)}"
                )
        return cls(**choices)

    def frame_numbers(self, last: int) -> tuple[int, ...]:
        """Return the selected frames of a scenario with `last` frames, ascending.

        Raises ChoiceError if a frame does not exist.
        """
        if self.frames is None:
            return tuple(range(1, last + 1))
        numbers = tuple(self.frames)
        for number in numbers:
            if not 1 <= number <= last:
                raise ChoiceError(f"frames: expected numbers from 1 to {last}, found {number}")
        return numbers


def _channel_names(channels: object) -> tuple[str, ...]:
    """Return names of channels in the order of `EXPORTED_CHANNELS`; raises ChoiceError."""
    if channels is None:
        return EXPORTED_CHANNELS
    names = choices("channels", channels, EXPORTED_CHANNELS, empty=True)
    return tuple(name for name in EXPORTED_CHANNELS if name in names)


def _frame_numbers(frames: object) -> tuple[int, ...] | None:
    """Return frame numbers, each once, ascending; None for all; raises ChoiceError."""
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
