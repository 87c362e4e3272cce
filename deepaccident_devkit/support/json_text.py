"""Untrusted JSON, read strictly and within limits.

`parsed_json` reads it as plain values, `parsed_record` as a record. Python's reader silently
accepts a name that occurs twice in an object, NaN, and lone surrogates. It also accepts values
nested 1,000 levels deep, which recursive functions cannot walk through. msgspec accepts duplicate
names too, so records are made from the values of `parsed_json`. msgspec is only imported for the
first record.
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
_BLOCK_SIZE = 1 << 20
_QUOTE = ord('"')
_OTHER_BYTES = bytes(set(range(256)) - set(b'[]{}"'))
# Byte → change of the level.
_LEVEL_STEPS = np.zeros(256, dtype=np.int64)
_LEVEL_STEPS[list(b"[{")] = 1
_LEVEL_STEPS[list(b"]}")] = -1
_GZIP = b"\x1f\x8b"
_PICKLE = b"\x80"
_ZIP = b"PK\x03\x04"
# Half of a character: JSON can write it without the other half, UTF-8 cannot.
_SURROGATE = re.compile("[\ud800-\udfff]")
_WRITTEN_SURROGATE = re.compile(r"\\u[dD][89a-fA-F]")


class _Fault(str):
    """A description of a fault, instead of the faulty value."""

    __slots__ = ()


def parsed_json(content: bytes, *, constants: bool = False, levels: int = MAX_LEVELS) -> Any:
    """Parse JSON text; numbers that are too large become infinite, which callers check.

    Args:
        content: Bytes of the text.
        constants: Whether NaN and Infinity are allowed, which Python writes although JSON has none.
        levels: Largest depth of nested objects and lists.

    Raises:
        ValueError: If the text has a fault; the message is a clause that names its position.
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
        return add_fault(f"{shortened(name)}: appears twice")

    def refuse_constant(word: str) -> object:
        constant = word.removeprefix("-")
        return add_fault(
            f"expected a finite number, found {constant}; write null for an unknown optional value"
        )

    _check_signature(content)
    _check_levels(content, levels)
    try:
        text = content.decode("utf-8")
        parse_constant = None if constants else refuse_constant
        value = json.loads(text, object_pairs_hook=make_object, parse_constant=parse_constant)
    except ValueError as error:  # the words of Python's own errors change with its version
        where = "not UTF-8, or a number with thousands of digits"
        if isinstance(error, json.JSONDecodeError):
            where = f"line {error.lineno}, column {error.colno}"
        raise ValueError(f"is not JSON ({where})") from error
    if faults or _WRITTEN_SURROGATE.search(text):
        fault = next(_find_faults(value, ""), None)
        if fault:
            raise ValueError(fault)
    return value


def parsed_record(content: bytes, kind: type[Record]) -> Record:
    """Return the record that JSON text describes.

    The ValueErrors are as in `parsed_json` and `as_record`.
    """
    return as_record(parsed_json(content), kind)


def as_record(value: object, kind: type[Record]) -> Record:
    """Return the record that a value of `parsed_json` describes: a Struct or a dataclass.

    Raises ValueError with a clause such as ``expected `float`, got `str` - at
    `$.results[0].size```.
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
    """Raise ValueError if the content is a file of another format."""
    if content.startswith(_GZIP):
        raise ValueError("is compressed with gzip; unpack it")
    if content.startswith(_ZIP):
        raise ValueError("is a zip or npz archive; write JSON instead")
    if content.startswith(_PICKLE):
        raise ValueError("is a pickle; write JSON instead")


def _check_levels(content: bytes, max_levels: int) -> None:
    """Raise ValueError if brackets outside texts are nested too deeply."""
    if b"\\" in content:  # an escaped quote must not count as a quote
        content = content.replace(b"\\\\", b"").replace(b'\\"', b"")
    level = 0
    is_in_text = False
    for start in range(0, len(content), _BLOCK_SIZE):
        block = content[start : start + _BLOCK_SIZE]
        marks = np.frombuffer(block.translate(None, _OTHER_BYTES), dtype=np.uint8)
        toggles = np.concatenate([[is_in_text], marks == _QUOTE])
        in_text = np.logical_xor.accumulate(toggles)
        levels = level + np.cumsum(_LEVEL_STEPS[marks] * ~in_text[1:])
        if levels.max(initial=0) > max_levels:
            raise ValueError(f"is nested more than {max_levels} levels deep")
        if len(levels):
            level = levels[-1]
        is_in_text = in_text[-1]


def _find_faults(value: object, prefix: str) -> Iterator[str]:
    """Yield the faults in a value, in the order of the text.

    `prefix` is the position of the value; it is empty, or ends with a blank.
    """
    if isinstance(value, _Fault):
        yield f"{prefix}{value}"
    elif isinstance(value, str) and _SURROGATE.search(value):
        yield (
            f"{prefix}expected whole characters, found half of a surrogate pair: "
            f"{shortened(value)!a}"
        )
    elif isinstance(value, dict):
        for name, member in value.items():
            if _SURROGATE.search(name):
                yield (
                    f"{prefix}expected a name of whole characters, found half of a "
                    f"surrogate pair: {shortened(name)!a}"
                )
            yield from _find_faults(member, f"{prefix}{shortened(name)}: ")
    elif isinstance(value, list):
        for number, entry in enumerate(value):
            yield from _find_faults(entry, f"{prefix}entry {number}: ")
