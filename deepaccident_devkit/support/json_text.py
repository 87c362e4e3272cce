"""JSON of strangers, read strictly and within bounds: `parsed_json` as plain values, `parsed_record` as a record.

Python's reader silently accepts a name that stands twice in an object, NaN, and half a character; and a value nested
1,000 levels deep, which no function that calls itself can walk through afterwards. msgspec accepts the first one, so
records are made of what `parsed_json` gives. It is imported when the first record is asked for.
"""

import json
import re
from collections import Counter
from collections.abc import Iterator
from typing import Any, Final, TypeVar

import numpy as np

from deepaccident_devkit.errors import shortened

Record = TypeVar("Record")

# The largest depth of nested objects and lists; the devkit's files have some ten.
MOST_LEVELS: Final = 64
_BLOCK: Final = 1 << 20
_QUOTE: Final = ord('"')
_OTHERS: Final = bytes(set(range(256)) - set(b'[]{}"'))
_STEPS: Final = np.zeros(256, dtype=np.int64)
_STEPS[list(b"[{")], _STEPS[list(b"]}")] = 1, -1
_GZIP: Final = b"\x1f\x8b"
_PICKLE: Final = b"\x80"
_ZIP: Final = b"PK\x03\x04"
# Half of a character: JSON can write it alone, UTF-8 cannot.
_SURROGATE: Final = re.compile("[\ud800-\udfff]")
_WRITTEN_SURROGATE: Final = re.compile(r"\\u[dD][89a-fA-F]")


class _Fault(str):
    """What is wrong, in the place of the value."""

    __slots__ = ()


def parsed_json(content: bytes, *, constants: bool = False, levels: int = MOST_LEVELS) -> Any:
    """The value of JSON text, not nested deeper than `levels`; too large numbers are infinite, so callers check them.

    `constants` lets NaN and Infinity stand there, which are no JSON, and which Python writes. Raises ValueError: half a
    sentence, which names the place of the fault.
    """
    faults: list[_Fault] = []

    def noted(what: str) -> _Fault:
        faults.append(_Fault(what))
        return faults[-1]

    def made(pairs: list[tuple[str, Any]]) -> object:
        result = dict(pairs)
        if len(result) == len(pairs):
            return result
        ((name, _),) = Counter(name for name, _ in pairs).most_common(1)
        return noted(f"{shortened(name)}: stands there twice")

    def refused(word: str) -> object:
        found = (
            f"found {word.removeprefix('-')}; write null for an optional value that is not known"
        )
        return noted(f"expected a finite number, {found}")

    if content.startswith(_GZIP):
        raise ValueError("is compressed with gzip; unpack it")
    if content.startswith(_ZIP):
        raise ValueError("is a zip or npz archive; write JSON")
    if content.startswith(_PICKLE):
        raise ValueError("is a pickle; write JSON")
    _check_levels(content, levels)
    try:
        text = content.decode("utf-8")
        value = json.loads(
            text, object_pairs_hook=made, parse_constant=None if constants else refused
        )
    except ValueError as error:  # the words of Python's own errors change with its version
        where = (
            f"line {error.lineno}, column {error.colno}"
            if isinstance(error, json.JSONDecodeError)
            else "not in UTF-8, or a number of thousands of digits"
        )
        raise ValueError(f"is no JSON ({where})") from error
    fault = next(_faults(value, ""), None) if faults or _WRITTEN_SURROGATE.search(text) else None
    if fault:
        raise ValueError(fault)
    return value


def parsed_record(content: bytes, kind: type[Record]) -> Record:
    """The record that JSON text describes; raises ValueError as `parsed_json` and `as_record` do."""
    return as_record(parsed_json(content), kind)


def as_record(value: object, kind: type[Record]) -> Record:
    """The record that a value of `parsed_json` describes: a `msgspec.Struct` or a dataclass.

    Raises ValueError: half a sentence, such as ``expected `float`, got `str` - at `$.results[0].size```.
    """
    import msgspec

    try:
        return msgspec.convert(value, kind)
    except msgspec.ValidationError as error:
        said = str(error)
        raise ValueError(shortened(said[:1].lower() + said[1:])) from error
    except OverflowError as error:  # msgspec 0.19 says it so
        raise ValueError("number out of range") from error


def _check_levels(content: bytes, most: int) -> None:
    """Raise ValueError if brackets outside texts are nested too deeply."""
    if b"\\" in content:  # of an escaped quote nothing must be left
        content = content.replace(b"\\\\", b"").replace(b'\\"', b"")
    level, inside = 0, False
    for first in range(0, len(content), _BLOCK):
        marks = np.frombuffer(
            content[first : first + _BLOCK].translate(None, _OTHERS), dtype=np.uint8
        )
        in_text = np.logical_xor.accumulate(np.concatenate([[inside], marks == _QUOTE]))
        levels = level + np.cumsum(_STEPS[marks] * ~in_text[1:])
        if levels.max(initial=0) > most:
            raise ValueError(f"is nested more than {most} levels deep")
        level, inside = levels[-1] if len(levels) else level, in_text[-1]


def _faults(value: object, place: str) -> Iterator[str]:
    """What is wrong in a value, in the order of the text; `place` ends in a colon and a blank."""
    if isinstance(value, _Fault):
        yield f"{place}{value}"
    elif isinstance(value, str) and _SURROGATE.search(value):
        yield f"{place}expected characters, found half of one: {shortened(value)!a}"
    elif isinstance(value, dict):
        for name, each in value.items():
            if _SURROGATE.search(name):
                yield f"{place}expected a name of characters, found half of one: {shortened(name)!a}"
            yield from _faults(each, f"{place}{shortened(name)}: ")
    elif isinstance(value, list):
        for number, each in enumerate(value):
            yield from _faults(each, f"{place}entry {number}: ")
