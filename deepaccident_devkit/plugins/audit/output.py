"""The values in a reader's output, whatever its type: tables, tensors, objects or files."""

import os
import re
from collections.abc import Iterator
from contextlib import suppress
from itertools import chain
from numbers import Number
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from deepaccident_devkit.errors import ConfigError, shortened
from deepaccident_devkit.support.json_text import parsed_json
from deepaccident_devkit.support.reading import fault_text, read_bytes

# Smallest size of an array that is taken for an image or point cloud, not for a label column.
_MIN_PICTURE_SIZE = 20_000
# Largest nesting depth that is examined.
_MAX_LEVELS = 20
# Indices of a list that get separate keys.
_COMPONENTS = range(64)
# The keys of a value, and the value.
_KeyedValues = Iterator[tuple[list[str], Any]]


def values_in_folder(folder: Path) -> _KeyedValues:
    """Yield the values of all JSON files and the paths of other files; raise ConfigError."""
    files = filter(Path.is_file, folder.rglob("*"))
    for path in sorted(files):
        if path.suffix != ".json":
            yield [path.relative_to(folder).as_posix()], path
            continue
        try:
            value = parsed_json(read_bytes(path, "results"), constants=True)
        except (OSError, ValueError) as error:
            raise ConfigError(f"{path}: {shortened(fault_text(error))}; write it again") from error
        keys = _part_keys([""], path.stem)
        yield from values_in(value, {}, keys)


def values_in(value: Any, examined: dict[int, object], keys: list[str]) -> _KeyedValues:
    """Yield the innermost parts of a value, down to the largest nesting depth, with their keys.

    For each value that has parts, None without keys is yielded first, so that the caller can stop
    even if a value has endless parts that have no innermost ones.

    Args:
        value: A value of any type; exceptions raised by its iterators are not caught.
        examined: Values that have been examined, by their id. They are not examined again, except
            for lists and arrays.
        keys: Keys of the value, as returned by `_part_keys`.
    """
    parts = _find_parts(value)
    if parts is None or keys[0].count("/") > _MAX_LEVELS:
        yield keys, value
        return
    yield [], None
    if isinstance(value, list | tuple | np.ndarray) or id(value) not in examined:
        examined[id(value)] = value  # keep the value alive, so that its id is not reused
        for name, part in parts:
            yield from values_in(part, examined, _part_keys(keys, name))


def _part_keys(keys: list[str], name: object) -> list[str]:
    """Return the keys of a part of a value.

    The first key is the part itself. A part of a list also has a key as a component and as a row.

    Args:
        keys: Keys of the value that the part belongs to.
        name: Name or index of the part; None if the part is the value itself, converted to another
            type.
    """
    own_key, *other_keys = keys
    if name is None:
        return keys
    list_key = f"{own_key}/*"
    if name in _COMPONENTS:
        row_keys = [f"{key}/*" for key in other_keys[:1]]
        return [list_key, f"{list_key}[{name}]", *row_keys]
    is_numbered = re.search(r"\d{2}|^\d", str(name)) is not None
    if is_numbered:
        return [list_key]
    return [f"{own_key}/{name}"]


def _find_parts(value: Any) -> Any:
    """Return the parts of a value with their names or indices; None if it has no parts.

    A value that must be converted first has a single part without a name: the converted value.
    """
    if isinstance(value, Number | str | bytes | os.PathLike | type | ModuleType):
        return None
    methods = {*dir(type(value))}
    if {"keys", "items"} <= methods:  # includes pandas tables
        return value.items()
    # Arrow and Polars tables, and named tuples.
    for method in {"to_pydict", "to_dict", "_asdict"} & methods:
        return [(None, getattr(value, method)())]
    if {"__array__", "__array_interface__"} & methods:
        return _find_array_parts(value)
    names = [*getattr(value, "__dict__", ())]
    for base in type(value).__mro__:
        slots = getattr(base, "__slots__", ())
        if isinstance(slots, str):
            slots = (slots,)
        names += slots
    attributes = {}
    for name in names:
        if not name.startswith("__"):
            attributes[name] = getattr(value, name, None)
    if {"__iter__", "__len__"} & methods:
        return chain(attributes.items(), enumerate(value))
    return attributes.items() or None


def _find_array_parts(value: Any) -> Any:
    """Return the parts of an array or a tensor: its fields, or its values as a list."""
    # Libraries raise their own exceptions for tensors on a GPU or with gradients.
    with suppress(Exception):
        array = np.asanyarray(value)
        if array.dtype.names:
            return [(name, array[name]) for name in array.dtype.names]
        is_picture = array.size >= _MIN_PICTURE_SIZE
        if is_picture and array is value:
            return None
        if is_picture:
            return [(None, array)]
        value = array
    with suppress(Exception):
        return [(None, value.tolist())]
    return None
