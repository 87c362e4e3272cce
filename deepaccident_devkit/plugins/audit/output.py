"""What somebody's reader returned or wrote, value by value, whatever its form: tables, tensors, objects, files."""

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

# Number of values from which on an array is a picture or a cloud, and no column of the labels.
_LARGE: Final = 20_000
# Depth of nested values that are looked at.
_MOST_LEVELS: Final = 20
# Places in a list that have a key of their own.
_COMPONENTS: Final = range(64)


def values_in_folder(folder: Path) -> Iterator[tuple[list[str], Any]]:
    """Yield what is in all files of JSON, and the paths of others; raise ConfigError."""
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
    """Yield the keys of each value without parts, or too deep or large to have them, and the value.

    Args:
        value: of any type; what its iterators raise is raised as it is.
        known: what was looked at, by its id; only lists and arrays are looked at twice.
        keys: those of the value, as `_keys` gives them.
    """
    parts = _parts(value)
    if parts is None or keys[0].count("/") > _MOST_LEVELS:
        yield keys, value
        return
    yield [], None  # so that what has no end is counted
    if isinstance(value, list | tuple | np.ndarray) or id(value) not in known:
        known[id(value)] = value  # which keeps its id
        for name, part in parts:
            yield from values_in(part, known, _keys(keys, name))


def _keys(keys: list[str], name: object) -> list[str]:
    """Return the keys of a part: its own, `size/*`, and in lists those as a component and as a part of a row.

    Args:
        keys: of what it is a part of.
        name: or place; None for the same value in another form.
    """
    whole, *others = keys
    if name is None:
        return keys
    if name in _COMPONENTS:
        return [f"{whole}/*", f"{whole}/*[{name}]", *(f"{key}/*" for key in others[:1])]
    return [f"{whole}/*" if re.search(r"\d{2}|^\d", str(name)) else f"{whole}/{name}"]


def _parts(value: Any) -> Any:
    """Return names or places of a value's parts, and the parts, or None and another form of it; None if it has none."""
    if isinstance(value, Number | str | bytes | os.PathLike | type | ModuleType):
        return None
    abilities = {*dir(type(value))}
    if {"keys", "items"} <= abilities:  # also a table of pandas
        return value.items()
    for method in {
        "to_pydict",
        "to_dict",
        "_asdict",
    } & abilities:  # a table of Arrow or Polars, a named tuple
        return [(None, getattr(value, method)())]
    if {"__array__", "__array_interface__"} & abilities:
        return _parts_of_array(value)
    names = [*getattr(value, "__dict__", ())]
    for base in type(value).__mro__:
        slots = getattr(base, "__slots__", ())
        names += [slots] if isinstance(slots, str) else slots
    attributes = {name: getattr(value, name, None) for name in names if name[:2] != "__"}
    if {"__iter__", "__len__"} & abilities:
        return chain(attributes.items(), enumerate(value))
    return attributes.items() or None


def _parts_of_array(value: Any) -> Any:
    with suppress(Exception):  # each library has its own, for tensors on a GPU or with gradients
        array = np.asanyarray(value)
        if array.dtype.names:
            return [(name, array[name]) for name in array.dtype.names]
        if array.size >= _LARGE:
            return None if array is value else [(None, array)]
        value = array
    with suppress(Exception):
        return [(None, value.tolist())]
    return None
