"""Faults of results files: `ContentError`, before which each caller puts its place."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, TypeVar

from deepaccident_devkit import json_text
from deepaccident_devkit.errors import ResultsError
from deepaccident_devkit.reading import fault_text

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
    """A value of a JSON file as it stands there, cut if it is long: no more of it is written than is shown."""
    text = ""
    for part in json.JSONEncoder(ensure_ascii=False, default=repr).iterencode(value):
        text += part
        if len(text) > _SHOWN:
            return f"{text[:_SHOWN]}…"
    return text


def parsed_json(content: bytes) -> Any:
    """The value of JSON text; raises ContentError that names the place of a fault."""
    try:
        return json_text.parsed_json(content)
    except ValueError as error:
        raise ContentError(str(error)) from error


def decoded(content: bytes | memoryview, kind: type[Kind]) -> Kind:
    """The record that JSON text describes; raises ContentError that names the place of a fault.

    A name that stands twice in an object is not noticed.
    """
    import msgspec

    try:
        return msgspec.json.decode(content, type=kind)
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as error:
        said, _, place = str(error).partition(" - at `$")
        place = place.strip(".`")
        raise ContentError(f"{place}: " * bool(place) + said[:1].lower() + said[1:]) from error
