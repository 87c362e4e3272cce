"""What all results files share: faults, format, version, the author's notes, sample tokens, the form of motion maps."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, TypeVar, get_args

import msgspec
from msgspec import inspect

from deepaccident_devkit.errors import MOST_TOLD, DeepAccidentError, ResultsError, shortened
from deepaccident_devkit.evaluation.results.records import WORDS, FormRecord, ResultsTask, Stored
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion import LABEL_PROTOCOLS
from deepaccident_devkit.support import json_text
from deepaccident_devkit.support.arrays import checked_number
from deepaccident_devkit.support.reading import fault_text
from deepaccident_devkit.support.text import settle_choices
from deepaccident_devkit.taxonomy import FRAME_PERIOD

Kind = TypeVar("Kind")

_SHOWN: Final = 80
"""Characters of a wrong value that an error shows."""


class ContentError(ValueError):
    """What is wrong, as half a sentence; `told_of` makes a ResultsError of it."""


@contextmanager
def at(place: str) -> Iterator[None]:
    """Put the place before the message of an error."""
    try:
        yield
    except ContentError as error:
        raise ContentError(f"{place}: {error}") from error


@contextmanager
def told_of(path: Path) -> Iterator[None]:
    """Raise ResultsError with the file's name and the remedy for what is found wrong in it, or if it cannot be read."""
    try:
        yield
    except ContentError as error:
        raise ResultsError(f"{path}: {error}; the format is described in schema/results/README.md") from error
    except OSError as error:
        raise ResultsError(f"{path}: {fault_text(error)}; give a results file that can be read") from error


def shown(value: object) -> str:
    """A value of a JSON file as it stands there, cut if it is long."""
    text = json.dumps(value, ensure_ascii=False, default=repr)
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}…"


def parsed_json(content: bytes, levels: int = json_text.MOST_LEVELS) -> Any:
    """The value of JSON text; raises ContentError that names the place of a fault."""
    try:
        return json_text.parsed_json(content, levels=levels)
    except ValueError as error:
        raise ContentError(str(error)) from error


def decoded(content: bytes, kind: type[Kind]) -> Kind:
    """The record that JSON text describes; raises ContentError that names the place of a fault, and what it found.

    A name that stands twice in an object is not noticed.
    """
    try:
        return msgspec.json.decode(content, type=kind)
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as error:
        value = parsed_json(content)  # it says of NaN where it stands
        said, _, place = str(error).partition(" - at `$")
        place = place.strip(".`")
        told = _told(shortened(said[:1].lower() + said[1:], MOST_TOLD), value, inspect.type_info(kind), place)
        raise ContentError(f"{place}: {told}" if place else told) from error


def _told(said: str, value: Any, kind: inspect.Type, place: str) -> str:
    """What msgspec says of a value, with what it found at the place, and what it expected or means there."""
    kinds, meaning = _single(kind), ""
    if isinstance(value, dict):
        kinds = [each for each in kinds if getattr(each, "tag", None) == value.get("task")] or kinds
    for part in re.findall(r"\w+|\.\.\.", place):
        if part == "...":  # a name, which msgspec does not tell
            return said
        value = value[int(part) if isinstance(value, list) else part]
        inner = [each for outer in kinds for each in _inner(outer, part)]
        kinds = [each for whole in inner for each in _single(whole)]
        notes = [each.extra_json_schema or {} for each in inner if isinstance(each, inspect.Metadata)]
        meaning = next((f" ({note['description']})" for note in notes if "description" in note), meaning)
    if said.startswith("object "):  # lacks a field, or has one too many
        names = [field.encode_name for each in kinds if isinstance(each, inspect.StructType) for field in each.fields]
        return f"{said} (expected {', '.join(names)})" if "unknown" in said and names else said
    choices = [str(word) for each in kinds if isinstance(each, inspect.LiteralType) for word in each.values]
    if choices:
        return f"expected {'one of ' * (len(choices) > 1)}{', '.join(choices)}, found {shown(value)}"
    return f"{said.partition(', got ')[0]}, found {shown(value)}{meaning}"


def _inner(kind: inspect.Type, part: str) -> Sequence[inspect.Type]:
    """The kinds that a field or an entry of a value of a kind may have."""
    if isinstance(kind, inspect.StructType):
        return [each.type for each in kind.fields if each.encode_name == part] or [inspect.LiteralType((kind.tag,))]
    if isinstance(kind, inspect.TupleType):
        return [kind.item_types[int(part)]]
    return [kind.item_type] if isinstance(kind, inspect.ListType | inspect.VarTupleType) else []


def _single(kind: inspect.Type) -> list[inspect.Type]:
    """The kinds that a kind joins, without notes on them."""
    if isinstance(kind, inspect.Metadata):
        return _single(kind.type)
    return [part for each in kind.types for part in _single(each)] if isinstance(kind, inspect.UnionType) else [kind]


RESULTS_NAMES: Final[Mapping[ResultsTask, str]] = MappingProxyType(
    {"motion": "motion", "accident": "accident.json", "detection": "detection.json"}
)
"""Task → the name of its file, of motion a folder, where results of all tasks are written into one folder."""
RESULTS_FILE: Final = "results.json"
"""The manifest of motion results, in their folder; results of the other tasks in a folder are called so too."""
_MOST_VALUES: Final = 2**26
"""Cells over all frames and predictions of a sample, twenty times as many as ten released predictions have. A small
archive can hold more, but memory cannot.
"""
_MOST_LEVELS: Final = 30
"""The largest depth of nested objects and lists in `meta`, which people and reports read."""
_LONGEST_TOKEN: Final = 1000
"""Characters."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionForm:
    """How motion results are stored: the same for all samples of a file.

    Attributes:
        stored: `instances`: maps of ids; `heads`: the model's own maps.
        grid: the cells; its orientation is how the maps lie.
        predictions: how many a sample has at most, K; of several, the last one is the mean.
        frames: T, the present one first.
        step: seconds from one frame to the next, a whole number of recorded frames (0.1 s).
        labels: name of the label protocol (`motion.LABEL_PROTOCOLS`) that the model learned from; None if not known.
    """

    stored: Stored
    grid: BevGrid
    predictions: int
    frames: int
    step: float = 0.5
    labels: str | None = None

    def __post_init__(self) -> None:
        """Check the values; raises ResultsError that names the field."""
        if not isinstance(self.grid, BevGrid):
            raise ResultsError(f"grid: expected a BevGrid, found {type(self.grid).__name__}")
        settle_choices(self, {"stored": get_args(Stored), "labels": (*LABEL_PROTOCOLS, None)}, error=ResultsError)
        for name in ("predictions", "frames"):
            if type(value := getattr(self, name)) is not int or value < 1:
                raise ResultsError(f"{name}: expected a whole number from 1, found {value!r}")
        object.__setattr__(self, "step", checked_number("step", self.step, error=ResultsError))
        steps = self.step / FRAME_PERIOD
        if not (math.isfinite(steps) and steps > 0.5 and abs(steps - round(steps)) < 1e-6):
            raise ResultsError(
                f"step: expected seconds, a whole number of recorded frames of 0.1 s, found {self.step!r}"
            )
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
    def from_record(cls, told: FormRecord) -> MotionForm:
        """The form that JSON holds; raises ContentError that names the field."""
        try:
            grid = BevGrid(told.x, told.y, told.orientation)
            others = {name: getattr(told, name) for name in ("stored", "predictions", "frames", "step", "labels")}
            return cls(grid=grid, **others)
        except DeepAccidentError as error:
            raise ContentError(str(error)) from error


def json_meta(meta: object) -> dict[str, Any]:
    """A copy of `meta` as JSON holds it; raises ContentError."""
    if not isinstance(meta, Mapping):
        raise ContentError(f"meta: expected a mapping of names to what JSON holds, found {type(meta).__name__}")
    try:
        text = json.dumps(dict(meta), allow_nan=False)
    except (TypeError, ValueError, RecursionError) as error:
        raise ContentError(f"meta: cannot be written as JSON ({error})") from error
    with at("meta"):
        copied: dict[str, Any] = parsed_json(text.encode(), _MOST_LEVELS)
    return copied


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
