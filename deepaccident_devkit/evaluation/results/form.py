"""What results files say of themselves: format, version, task, and the form of motion maps."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Final, Literal, get_args

from deepaccident_devkit.arrays import checked_number, checked_whole
from deepaccident_devkit.errors import DeepAccidentError, ResultsError
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion import LABEL_PROTOCOLS
from deepaccident_devkit.taxonomy import FRAME_PERIOD

ResultsTask = Literal["motion", "accident", "detection"]
Stored = Literal["instances", "heads"]
FORMAT: Final = "DeepAccident results"
FORMAT_VERSION: Final = 1
"""Counted up with what files hold."""
RESULTS_FILE: Final = "results.json"
"""The manifest of motion results, in their folder; results of the other tasks in a folder are called so too."""
_MOST_VALUES: Final = 2**30
"""Cells over all frames and predictions of a sample: more would not fit into memory."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionForm:
    """How motion results are stored: the same for all samples of a file.

    Attributes:
        stored: `instances`: maps of ids, and paths; `heads`: the model's own maps.
        grid: the cells; its orientation is how the maps lie.
        predictions: how many a sample has at most, K; of several, the last one is the mean.
        frames: T, the present one first.
        step: seconds from one frame to the next, a whole number of recorded frames (0.1 s).
        labels: name of the label protocol (`motion.LABEL_PROTOCOLS`) that the model learned from; None if not known.
    """

    FIELDS: ClassVar[tuple[str, ...]] = ("stored", "x", "y", "orientation", "predictions", "frames", "step", "labels")
    stored: Stored
    grid: BevGrid
    predictions: int
    frames: int
    step: float = 0.5
    labels: str | None = None

    def __post_init__(self) -> None:
        """Check the values; raises ResultsError that begins with the field's name."""
        if self.stored not in get_args(Stored):
            raise ResultsError(f"stored: expected one of {', '.join(get_args(Stored))}, found {self.stored!r}")
        if not isinstance(self.grid, BevGrid):
            raise ResultsError(f"grid: expected a BevGrid, found {type(self.grid).__name__}")
        for name in ("predictions", "frames"):
            object.__setattr__(self, name, _count(name, getattr(self, name)))
        object.__setattr__(self, "step", _step(self.step))
        if self.labels not in (None, *LABEL_PROTOCOLS):
            raise ResultsError(f"labels: expected one of {', '.join(LABEL_PROTOCOLS)}, or null, found {self.labels!r}")
        if self.predictions * self.frames * self.grid.cells > _MOST_VALUES:
            raise ResultsError(
                f"form: {self.predictions} predictions of {self.frames} frames of {self.grid.cells} cells are more "
                "than memory holds; store fewer"
            )

    def as_dict(self) -> dict[str, Any]:
        """The form as JSON holds it."""
        return {
            "stored": self.stored,
            "x": list(self.grid.x),
            "y": list(self.grid.y),
            "orientation": self.grid.orientation,
            "predictions": self.predictions,
            "frames": self.frames,
            "step": self.step,
            "labels": self.labels,
        }

    @classmethod
    def from_dict(cls, told: Mapping[str, Any]) -> MotionForm:
        """The form that JSON holds, with all of its fields; raises ResultsError that begins with the field's name."""
        axes = {name: _axis(name, told[name]) for name in ("x", "y")}
        try:
            grid = BevGrid(axes["x"], axes["y"], told["orientation"])
        except (DeepAccidentError, TypeError) as error:
            raise ResultsError(str(error)) from error
        others = {name: told[name] for name in ("stored", "predictions", "frames", "step", "labels")}
        return cls(grid=grid, **others)


def _axis(name: str, value: object) -> tuple[float, float, float]:
    if not isinstance(value, list) or len(value) != 3:
        raise ResultsError(f"{name}: expected start, end and cell size in metres, found {value!r}")
    low, high, size = (_number(name, each) for each in value)
    return low, high, size


def _number(name: str, value: object) -> float:
    if isinstance(value, bool):
        raise ResultsError(f"{name}: expected a number, found {value!r}")
    return checked_number(name, value, error=ResultsError)


def _count(name: str, value: object) -> int:
    if isinstance(value, bool):
        raise ResultsError(f"{name}: expected a whole number from 1, found {value!r}")
    number = checked_whole(name, value, "a whole number from 1", ResultsError)
    if number < 1:
        raise ResultsError(f"{name}: expected a whole number from 1, found {number}")
    return number


def _step(value: object) -> float:
    step = _number("step", value)
    frames = step / FRAME_PERIOD
    if not (math.isfinite(frames) and frames > 0.5 and abs(frames - round(frames)) < 1e-6):
        raise ResultsError(f"step: expected seconds, a whole number of recorded frames of 0.1 s, found {value!r}")
    return step
