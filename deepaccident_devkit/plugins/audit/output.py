"""The values of a reader's output, in any form: tables, tensors, objects, files."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import suppress
from itertools import chain
from numbers import Number
from pathlib import Path
from types import ModuleType
from typing import Any, Final

import numpy as np

from deepaccident_devkit.errors import ConfigError, shortened
from deepaccident_devkit.support.json_text import parsed_json
from deepaccident_devkit.support.reading import fault_text, read_bytes

# Smallest size of an array that is a picture or a cloud, not a column of the labels.
_MIN_PICTURE_SIZE: Final = 20_000
# Depth of nested values that are examined.
_MAX_LEVELS: Final = 20
# Indices of a list that have a key of their own.
_COMPONENTS: Final = range(64)


def values_in_folder(folder: Path) -> Iterator[tuple[list[str], Any]]:
    """Yield the values of all JSON files, and the paths of other files; raises ConfigError."""
    for path in sorted(filter(Path.is_file, folder.rglob("*"))):
        if path.suffix != ".json":
            yield [path.relative_to(folder).as_posix()], path
            continue
        try:
            value = parsed_json(read_bytes(path, "results"), constants=True)
        except (OSError, ValueError) as error:
            raise ConfigError(f"{path}: {shortened(fault_text(error))}; write it again") from error
        yield from values_in(value, {}, _keys([""], path.stem))


def values_in(
    value: Any, known: dict[int, object], keys: list[str]
) -> Iterator[tuple[list[str], Any]]:
    """Yield each value that has no parts, or is too deep or large for them, with its keys.

    Args:
        value: A value of any type; exceptions of its iterators are not caught.
        known: Examined values by their id; only lists and arrays are examined twice.
        keys: Keys of the value, as from `_keys`.
    """
    parts = _parts(value)
    if parts is None or keys[0].count("/") > _MAX_LEVELS:
        yield keys, value
        return
    yield [], None  # counts the parts of an endless value
    if isinstance(value, list | tuple | np.ndarray) or id(value) not in known:
        known[id(value)] = value  # a reference, so that its id is not reused
        for name, part in parts:
            yield from values_in(part, known, _keys(keys, name))


def _keys(keys: list[str], name: object) -> list[str]:
    """Return the keys of a part: its own, and in lists its keys as a component and in a row.

    Args:
        keys: Keys of the value that it is a part of.
        name: Its name or index; None for the same value in another form.
    """
    own_key, *other_keys = keys
    if name is None:
        return keys
    if name in _COMPONENTS:
        return [
            f"{own_key}/*",
            f"{own_key}/*[{name}]",
            *(f"{key}/*" for key in other_keys[:1]),
        ]
    return [f"{own_key}/*" if re.search(r"\d{2}|^\d", str(name)) else f"{own_key}/{name}"]


def _parts(value: Any) -> Any:
    """Return the names or indices of a value's parts, and the parts; None if it has no parts.

    A value that has another form has one part: None, and this form.
    """
    if isinstance(value, Number | str | bytes | os.PathLike | type | ModuleType):
        return None
    methods = {*dir(type(value))}
    if {"keys", "items"} <= methods:  # also a table of pandas
        return value.items()
    # Tables of Arrow or Polars, and named tuples.
    for method in {"to_pydict", "to_dict", "_asdict"} & methods:
        return [(None, getattr(value, method)())]
    if {"__array__", "__array_interface__"} & methods:
        return _parts_of_array(value)
    names = [*getattr(value, "__dict__", ())]
    for base in type(value).__mro__:
        slots = getattr(base, "__slots__", ())
        names += [slots] if isinstance(slots, str) else slots
    attributes = {name: getattr(value, name, None) for name in names if name[:2] != "__"}
    if {"__iter__", "__len__"} & methods:
        return chain(attributes.items(), enumerate(value))
    return attributes.items() or None


def _parts_of_array(value: Any) -> Any:
    """Return the parts of an array or a tensor: its fields, or its values as a list."""
    # Libraries raise their own exceptions for tensors on a GPU or with gradients.
    with suppress(Exception):
        array = np.asanyarray(value)
        if array.dtype.names:
            return [(name, array[name]) for name in array.dtype.names]
        if array.size >= _MIN_PICTURE_SIZE:
            return None if array is value else [(None, array)]
        value = array
    with suppress(Exception):
        return [(None, value.tolist())]
    return None
