"""Rules with one choice made otherwise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Rules = TypeVar("Rules", bound="DataclassInstance")


def with_others(rules: Rules, others: Mapping[str, Sequence[Any]]) -> dict[str, Rules]:
    """A dataclass with one field changed at a time, by `name=value`.

    Args:
        rules: the dataclass.
        others: values by field; the one that the rules have is left out.
    """
    return {
        f"{name}={value}": replace(rules, **{name: value})
        for name, values in others.items()
        for value in values
        if value != getattr(rules, name)
    }


def with_parts(rules: Rules, name: str, parts: Mapping[str, Any]) -> dict[str, Rules]:
    """A dataclass with a part changed to each of some others, by the part's name and theirs: `reading.outline=cells`.

    So `switches.switched` calls these choices, too.
    """
    return {f"{name}.{key}": replace(rules, **{name: part}) for key, part in parts.items()}
