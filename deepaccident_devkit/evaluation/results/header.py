"""The header of results files: format, version, task, meta, the form of motion maps; and sample tokens."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar, Final, Literal, get_args

from deepaccident_devkit.arrays import checked_number, checked_whole
from deepaccident_devkit.errors import DeepAccidentError, ResultsError
from deepaccident_devkit.evaluation.results.faults import ContentError, at, parsed_json, shown
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion import LABEL_PROTOCOLS
from deepaccident_devkit.reading import shortened
from deepaccident_devkit.taxonomy import FRAME_PERIOD

ResultsTask = Literal["motion", "accident", "detection"]
RESULTS_NAMES: Final[Mapping[ResultsTask, str]] = MappingProxyType(
    {"motion": "motion", "accident": "accident.json", "detection": "detection.json"}
)
"""Task → the name of its file, of motion a folder, where results of all tasks are written into one folder."""
Stored = Literal["instances", "heads"]
FORMAT: Final = "DeepAccident results"
FORMAT_VERSION: Final = 1
"""Counted up with what files hold."""
RESULTS_FILE: Final = "results.json"
"""The manifest of motion results, in their folder; results of the other tasks in a folder are called so too."""
_MOST_VALUES: Final = 2**26
"""Cells over all frames and predictions of a sample, twenty times as many as ten released predictions have. A small
archive can hold more, but memory cannot.
"""


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


HEADER_FIELDS: Final = ("format", "version", "task", "meta")
BODY_FIELDS: Final[Mapping[str, tuple[str, ...]]] = {
    "motion": ("form", "shards"),
    "accident": ("results",),
    "detection": ("results",),
}
"""Task → the fields after the header's."""
_MOST_LEVELS: Final = 30
"""The largest depth of nested objects and lists in `meta`, which people and reports read."""
_LONGEST_TOKEN: Final = 1000
"""Characters."""
WORDS: Final = r"^[^/\\]+(/[^/\\]+)*$"
"""A regular expression of tokens: words with `/` between."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Header:
    """The header of a results file.

    Attributes:
        task: what its predictions are of.
        meta: notes of its author: the method, its training, who made it.
    """

    task: ResultsTask
    meta: Mapping[str, Any]

    def as_dict(self) -> dict[str, Any]:
        """The header as it stands in the file."""
        return {"format": FORMAT, "version": FORMAT_VERSION, "task": self.task, "meta": self.meta}


def read_header(document: object, path: Path) -> Header:
    """The header of a results file; all fields of the document are there, and no others.

    Raises:
        ContentError: it is not the header of a results file.
        ResultsError: it is of another version.
    """
    if not isinstance(document, dict):
        raise ContentError(f"expected a JSON object, found {shown(document)}")
    if "format" not in document and "results" in document:
        raise ContentError(
            f'has no "format" (a nuScenes results file?); put "format": "{FORMAT}", "version": {FORMAT_VERSION} and '
            '"task": "detection" before its "meta" and "results"'
        )
    check_required(document, ("format", "version", "task"))
    if document["format"] != FORMAT:
        raise ContentError(f'format: expected "{FORMAT}", found {shown(document["format"])}')
    _check_version(document["version"], path)
    task = document["task"]
    if task not in get_args(ResultsTask):
        raise ContentError(f"task: expected one of {', '.join(get_args(ResultsTask))}, found {shown(task)}")
    check_fields(document, (*HEADER_FIELDS, *BODY_FIELDS[task]))
    if not isinstance(document["meta"], dict):
        raise ContentError(f"meta: expected an object, {{}} to say nothing, found {shown(document['meta'])}")
    return Header(task=task, meta=json_meta(document["meta"]))


def json_meta(meta: object) -> dict[str, Any]:
    """A copy of `meta` as JSON holds it; raises ContentError."""
    if not isinstance(meta, Mapping):
        raise ContentError(f"meta: expected a mapping of names to what JSON holds, found {type(meta).__name__}")
    try:
        text = json.dumps(dict(meta), allow_nan=False)
    except (TypeError, ValueError, RecursionError) as error:
        raise ContentError(f"meta: cannot be written as JSON ({error})") from error
    with at("meta"):
        copied: dict[str, Any] = parsed_json(text.encode())
        _check_levels(copied, _MOST_LEVELS)
    return copied


def check_fields(entry: Mapping[str, object], required: Sequence[str], optional: Sequence[str] = ()) -> None:
    """Check that an object has the required fields, and else only optional ones; raises ContentError that names one."""
    check_required(entry, required)
    known = (*required, *optional)
    unknown = [name for name in entry if name not in known]
    if unknown:
        raise ContentError(f"{unknown[0]}: is no field of the format (expected {', '.join(known)}); remove it")


def check_required(entry: Mapping[str, object], required: Sequence[str]) -> None:
    """Check that an object has the required fields; raises ContentError that names the first missing one."""
    missing = [name for name in required if name not in entry]
    if missing:
        raise ContentError(f"{missing[0]}: is missing (expected {', '.join(required)})")


def check_token(token: object) -> str:
    """A sample's token, if it could be one: words with `/` between; raises ContentError."""
    if not isinstance(token, str):
        raise ContentError(f"expected a sample's token, a text, found {shown(token)}")
    good = len(token) <= _LONGEST_TOKEN and token.isprintable() and re.fullmatch(WORDS, token)
    if not good or {".", ".."} & set(token.split("/")):
        raise ContentError(
            f"expected a sample's token, <scenario_type>/<name>/<agent>/<NNN>, found {shortened(token)!r}"
        )
    return token


def _check_levels(value: object, most: int) -> None:
    if not isinstance(value, dict | list):
        return
    if most == 0:
        raise ContentError(f"is nested more than {_MOST_LEVELS} levels deep")
    for each in value.values() if isinstance(value, dict) else value:
        _check_levels(each, most - 1)


def _check_version(version: object, path: Path) -> None:
    if type(version) is not int:
        raise ContentError(f"version: expected {FORMAT_VERSION}, found {shown(version)}")
    if version != FORMAT_VERSION:
        kind, remedy = ("a newer", "update the devkit") if version > FORMAT_VERSION else ("an older", "write it again")
        raise ResultsError(
            f"{path}: version: {kind} results format ({shown(version)}, this devkit's is {FORMAT_VERSION}); {remedy}"
        )
