"""Results with read-only mappings, which can be copied, pickled and written as JSON."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any, NoReturn, TypeVar

import numpy as np

from deepaccident_devkit.support.arrays import ShortRepr

Key = TypeVar("Key")
Value = TypeVar("Value")


class FrozenDict(dict[Key, Value]):
    """A dict that does not change, and so has a hash where its values have one.

    A dict and not a view of one, since `dataclasses.asdict`, `copy.deepcopy` and `pickle` refuse views.
    """

    def __hash__(self) -> int:  # type: ignore[override]  # dict has none, as it changes
        """Equal ones hash alike."""
        return hash(frozenset(self.items()))

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle would fill an empty one."""
        return type(self), (dict(self),)

    def _refused(self, *_arguments: Any, **_named: Any) -> NoReturn:
        raise TypeError("the mappings of a result cannot be changed; make a dict of it")

    __setitem__ = __delitem__ = __ior__ = _refused
    clear = pop = popitem = setdefault = update = _refused


class FrozenMappings(ShortRepr):
    """Base of frozen dataclasses whose mappings are read-only, from the start and in every copy."""

    __slots__ = ()

    def __post_init__(self) -> None:
        """Freeze the mappings."""
        for name, value in _values(self).items():
            if isinstance(value, Mapping):
                object.__setattr__(self, name, _frozen(value))

    def as_dict(self) -> dict[str, Any]:
        """All of it, as JSON holds it: None for NaN, numbers as keys as text ("5")."""
        return {name: plain(value) for name, value in _values(self).items()}


def plain(value: Any) -> Any:
    """What a result holds, as JSON holds it: None for NaN and infinite numbers."""
    if isinstance(value, FrozenMappings):
        return value.as_dict()
    if is_dataclass(value):
        return {name: plain(each) for name, each in _values(value).items()}
    if isinstance(value, Mapping):
        return {f"{key:g}" if isinstance(key, float) else str(key): plain(each) for key, each in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [plain(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _frozen(value: Any) -> Any:
    if not isinstance(value, Mapping):
        return value
    return FrozenDict({key: _frozen(each) for key, each in value.items()})


def _values(record: Any) -> dict[str, Any]:
    return {field.name: getattr(record, field.name) for field in fields(record)}
