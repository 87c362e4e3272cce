"""Faults of results files: `ContentError`, and strict JSON.

Each caller puts its place before an error. JSON readers silently accept a repeated name in an object, NaN, and half a
character.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from deepaccident_devkit.errors import ResultsError

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
        raise ResultsError(f"{path}: cannot be read ({error}); give a results file that can") from error


def shown(value: object) -> str:
    """A value of a JSON file as it stands there, cut if it is long."""
    text = json.dumps(value, ensure_ascii=False, default=repr)
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}…"


_GZIP: Final = b"\x1f\x8b"
_PICKLE: Final = b"\x80"
_SURROGATE: Final = re.compile("[\ud800-\udfff]")
"""Half of a character: JSON can write it alone, UTF-8 cannot."""
_WRITTEN_SURROGATE: Final = re.compile(r"\\u[dD][89a-fA-F]")


class _Repeated(dict[str, Any]):
    """An object in which `name` stands twice."""

    name: str


class _Constant(float):
    """NaN or an infinity that was written as a word."""


def parsed_json(content: bytes) -> Any:
    """The value of JSON text; raises ContentError that names the place of a fault."""
    faults: list[object] = []

    def made(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        result = dict(pairs)
        return result if len(result) == len(pairs) else noted(_repeated(pairs))

    def noted(fault: Any) -> Any:
        faults.append(fault)
        return fault

    if content.startswith(_GZIP):
        raise ContentError("is compressed with gzip; unpack it")
    if content.startswith(_PICKLE):
        raise ContentError("is a pickle; write JSON")
    try:
        text = content.decode("utf-8")
        value = json.loads(text, object_pairs_hook=made, parse_constant=lambda word: noted(_Constant(word)))
    except RecursionError:
        raise ContentError("is nested too deeply") from None
    except ValueError as error:  # also of other bytes than UTF-8, and of numbers with thousands of digits
        raise ContentError(f"is no JSON ({error})") from error
    fault = next(_faults(value, ""), None) if faults or _WRITTEN_SURROGATE.search(text) else None
    if faults or fault:
        raise ContentError(fault or "holds a name twice in one object")
    return value


def _repeated(pairs: list[tuple[str, Any]]) -> _Repeated:
    result, seen = _Repeated(pairs), set[str]()
    for name, _ in pairs:
        if name in seen:
            result.name = name
        seen.add(name)
    return result


def _faults(value: object, place: str) -> Iterator[str]:
    """What is wrong in a value, in the order of the text; `place` ends in a colon and a blank."""
    if isinstance(value, _Repeated):
        yield f"{place}{value.name}: stands there twice"
    if isinstance(value, _Constant):
        word = "NaN" if math.isnan(value) else "Infinity"
        yield f"{place}expected a finite number, found {word}; write null for an optional value that is not known"
    if isinstance(value, str) and _SURROGATE.search(value):
        yield f"{place}expected characters, found half of one: {value!a}"
    if isinstance(value, dict):
        for name, each in value.items():
            if _SURROGATE.search(name):
                yield f"{place}expected a name of characters, found half of one: {name!a}"
            yield from _faults(each, f"{place}{name}: ")
    if isinstance(value, list):
        for number, each in enumerate(value):
            yield from _faults(each, f"{place}entry {number}: ")
