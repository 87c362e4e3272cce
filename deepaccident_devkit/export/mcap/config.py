"""`McapConfig`: which parts of a scenario go into an MCAP file."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from typing import Any, Final

from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.evaluation.results import Prediction, Results
from deepaccident_devkit.motion import MotionLabelConfig
from deepaccident_devkit.motion.config import label_config
from deepaccident_devkit.support.arrays import checked_whole
from deepaccident_devkit.support.text import choice, possible_text
from deepaccident_devkit.taxonomy import CAMERAS, LIDAR
from deepaccident_devkit.v2x import Agents

EPOCH: Final = 1_704_067_200
"""Unix seconds of every scenario's first frame: recordings have no date, but viewers need one (2024-01-01 UTC)."""
EXPORTED_CHANNELS: Final = (*CAMERAS, LIDAR)
Predictions = Results | Mapping[str, Prediction]
"""Predictions by sample token."""


@dataclass(frozen=True, slots=True, kw_only=True)
class McapConfig:
    """Which parts of a scenario go into the file; checked when made.

    Attributes:
        agents: agents to export: their names, a configuration as seen from the ego vehicle, or None for all that are
            there (`v2x.Agents`).
        channels: sensors to export: cameras and `lidar01`; None for all of these.
        frames: numbers of frames, from 1; None for all.
        points: n for every n-th point of a cloud; 1 for all.
        motion_labels: configuration of motion labels, or the name of a preset (`motion.PRESETS`); None for none.
    """

    agents: Agents = None
    channels: Iterable[str] | None = None
    frames: Iterable[int] | None = None
    points: int = 1
    motion_labels: MotionLabelConfig | str | None = None

    def __post_init__(self) -> None:
        """Check; raises ChoiceError."""
        object.__setattr__(self, "channels", _channel_names(self.channels))
        object.__setattr__(self, "frames", _frame_numbers(self.frames))
        if checked_whole("points", self.points, "n for every n-th point", ChoiceError) < 1:
            raise ChoiceError(f"points: expected a number from 1, for every n-th point, found {self.points!r}")
        if self.motion_labels is not None:
            object.__setattr__(self, "motion_labels", label_config(self.motion_labels))

    @classmethod
    def of(cls, **choices: Any) -> McapConfig:
        """A configuration with these fields; raises ChoiceError."""
        names = [field.name for field in fields(cls)]
        for name in choices:
            if name not in names:
                raise ChoiceError(f"export_mcap has no {name!r}; there are {possible_text(name, names)}")
        return cls(**choices)

    def frame_numbers(self, last: int) -> tuple[int, ...]:
        """The wanted frames of a scenario with `last` frames, ascending; raises ChoiceError if one is not there."""
        if self.frames is None:
            return tuple(range(1, last + 1))
        chosen = tuple(self.frames)
        for number in chosen:
            if not 1 <= number <= last:
                raise ChoiceError(f"frames: expected numbers from 1 to {last}, found {number}")
        return chosen


def _channel_names(given: object) -> tuple[str, ...]:
    """Names of channels in the order of `EXPORTED_CHANNELS`; raises ChoiceError."""
    if given is None:
        return EXPORTED_CHANNELS
    if isinstance(given, str) or not isinstance(given, Iterable):
        raise ChoiceError(f"channels: expected names of channels, found {given!r}")
    named = {choice("channels", name, EXPORTED_CHANNELS) for name in given}
    return tuple(name for name in EXPORTED_CHANNELS if name in named)


def _frame_numbers(given: object) -> tuple[int, ...] | None:
    """Frame numbers, each once, ascending; None for all; raises ChoiceError."""
    if given is None:
        return None
    if isinstance(given, str) or not isinstance(given, Iterable):
        raise ChoiceError(f"frames: expected frame numbers from 1, such as range(1, 11), found {given!r}")
    meaning = "whole numbers from 1"
    numbers = tuple(sorted({checked_whole("frames", number, meaning, ChoiceError) for number in given}))
    if not numbers:
        raise ChoiceError("frames: expected at least one frame number, found none")
    return numbers
