"""Results that hold mappings: nobody can change them, and they still survive the way out of a worker process."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from types import MappingProxyType
from typing import Any


class FrozenMappings:
    """Base of frozen dataclasses whose mappings are read-only, from the start and in every copy."""

    __slots__ = ()

    def __post_init__(self) -> None:
        """Freeze the mappings."""
        for name, value in _values(self).items():
            if isinstance(value, Mapping):
                object.__setattr__(self, name, MappingProxyType(dict(value)))

    def __reduce__(self) -> tuple[Any, ...]:
        """A view of a dict cannot be pickled; the dict can."""
        return _remade, (
            type(self),
            {name: dict(value) if isinstance(value, Mapping) else value for name, value in _values(self).items()},
        )


def _values(record: Any) -> dict[str, Any]:
    return {field.name: getattr(record, field.name) for field in fields(record)}


def _remade(kind: type[Any], values: dict[str, Any]) -> Any:
    return kind(**values)
