"""JSON from other people, read strictly and within bounds.

`parsed_json` reads it as plain values, `parsed_record` as a record. Python's reader silently
accepts a name that stands twice in an object, NaN, and half a character; and a value nested 1,000
levels deep, which no recursive function can walk through afterwards. msgspec accepts duplicate
names, so records are made from the values of `parsed_json`. It is imported for the first record.
"""

import json
import re
from collections import Counter
from collections.abc import Iterator
from typing import Any, Final, TypeVar

import numpy as np

from deepaccident_devkit.errors import shortened

Record = TypeVar("Record")

# Largest depth of nested objects and lists; the devkit's files have about ten.
MAX_LEVELS: Final = 64
_BLOCK_SIZE: Final = 1 << 20
_QUOTE: Final = ord('"')
_OTHER_BYTES: Final = bytes(set(range(256)) - set(b'[]{}"'))
# Byte → change of the level.
_LEVEL_STEPS: Final = np.zeros(256, dtype=np.int64)
_LEVEL_STEPS[list(b"[{")], _LEVEL_STEPS[list(b"]}")] = 1, -1
_GZIP: Final = b"\x1f\x8b"
_PICKLE: Final = b"\x80"
_ZIP: Final = b"PK\x03\x04"
# Half of a character: JSON can write it without the other half, UTF-8 cannot.
_SURROGATE: Final = re.compile("[\ud800-\udfff]")
_WRITTEN_SURROGATE: Final = re.compile(r"\\u[dD][89a-fA-F]")


class _Fault(str):
    """A fault, which stands where the value was."""

    __slots__ = ()


def parsed_json(content: bytes, *, constants: bool = False, levels: int = MAX_LEVELS) -> Any:
    """Return the value of JSON text; too large numbers are infinite, so callers check them.

    Args:
        content: Bytes of the text.
        constants: Whether NaN and Infinity are allowed, which are no JSON, and which Python writes.
        levels: Largest depth of nested objects and lists.

    Raises:
        ValueError: Half a sentence, which names the position of the fault.
    """
    faults: list[_Fault] = []

    def add_fault(text: str) -> _Fault:
        faults.append(_Fault(text))
        return faults[-1]

    def make_object(pairs: list[tuple[str, Any]]) -> object:
        result = dict(pairs)
        if len(result) == len(pairs):
            return result
        ((name, _),) = Counter(name for name, _ in pairs).most_common(1)
        return add_fault(f"{shortened(name)}: stands there twice")

    def refuse_constant(word: str) -> object:
        constant = word.removeprefix("-")
        return add_fault(
            f"expected a finite number, found {constant}; write null for an optional value that is "
            "not known"
        )

    _check_signature(content)
    _check_levels(content, levels)
    try:
        text = content.decode("utf-8")
        parse_constant = None if constants else refuse_constant
        value = json.loads(text, object_pairs_hook=make_object, parse_constant=parse_constant)
    except ValueError as error:  # the words of Python's own errors change with its version
        where = "not in UTF-8, or a number of thousands of digits"
        if isinstance(error, json.JSONDecodeError):
            where = f"line {error.lineno}, column {error.colno}"
        raise ValueError(f"is no JSON ({where})") from error
    if faults or _WRITTEN_SURROGATE.search(text):
        fault = next(_faults(value, ""), None)
        if fault:
            raise ValueError(fault)
    return value


def parsed_record(content: bytes, kind: type[Record]) -> Record:
    """Return the record that JSON text describes; raise as `parsed_json` and `as_record` do."""
    return as_record(parsed_json(content), kind)


def as_record(value: object, kind: type[Record]) -> Record:
    """Return the record that a value describes: a `msgspec.Struct` or a dataclass.

    The value is one of `parsed_json`. Raises ValueError: half a sentence, such as
    ``expected `float`, got `str` - at `$.results[0].size```.
    """
    import msgspec

    try:
        return msgspec.convert(value, kind)
    except msgspec.ValidationError as error:
        message = str(error)
        raise ValueError(shortened(message[:1].lower() + message[1:])) from error
    except OverflowError as error:  # raised by msgspec 0.19
        raise ValueError("number out of range") from error


def _check_signature(content: bytes) -> None:
    """Raise ValueError for files of other formats."""
    if content.startswith(_GZIP):
        raise ValueError("is compressed with gzip; unpack it")
    if content.startswith(_ZIP):
        raise ValueError("is a zip or npz archive; write JSON")
    if content.startswith(_PICKLE):
        raise ValueError("is a pickle; write JSON")


def _check_levels(content: bytes, max_levels: int) -> None:
    """Raise ValueError if brackets outside texts are nested too deeply."""
    if b"\\" in content:  # an escaped quote must not count as a quote
        content = content.replace(b"\\\\", b"").replace(b'\\"', b"")
    level, is_in_text = 0, False
    for begin in range(0, len(content), _BLOCK_SIZE):
        block = content[begin : begin + _BLOCK_SIZE]
        marks = np.frombuffer(block.translate(None, _OTHER_BYTES), dtype=np.uint8)
        toggles = np.concatenate([[is_in_text], marks == _QUOTE])
        in_text = np.logical_xor.accumulate(toggles)
        levels = level + np.cumsum(_LEVEL_STEPS[marks] * ~in_text[1:])
        if levels.max(initial=0) > max_levels:
            raise ValueError(f"is nested more than {max_levels} levels deep")
        level, is_in_text = levels[-1] if len(levels) else level, in_text[-1]


def _faults(value: object, prefix: str) -> Iterator[str]:
    """Yield the faults in a value, in the order of the text; `prefix` ends with a blank."""
    if isinstance(value, _Fault):
        yield f"{prefix}{value}"
    elif isinstance(value, str) and _SURROGATE.search(value):
        yield f"{prefix}expected characters, found half of one: {shortened(value)!a}"
    elif isinstance(value, dict):
        for name, member in value.items():
            if _SURROGATE.search(name):
                yield (
                    f"{prefix}expected a name of characters, found half of one: {shortened(name)!a}"
                )
            yield from _faults(member, f"{prefix}{shortened(name)}: ")
    elif isinstance(value, list):
        for number, entry in enumerate(value):
            yield from _faults(entry, f"{prefix}entry {number}: ")
