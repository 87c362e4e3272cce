"""The choices of a protocol by their names, such as `reading.danger_distance`, and protocols with some changed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from typing import TYPE_CHECKING, Any, Final, TypeVar

from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.support.text import choice, possible_text

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Kind = TypeVar("Kind")
Rules = TypeVar("Rules", bound="DataclassInstance")
_WORDS: Final[Mapping[type | None, str]] = {bool: "true or false", float: "a number", str: "a word", tuple: "a list"}
_LIKE: Final[Mapping[type, tuple[type, ...]]] = {bool: (bool,), float: (float, int), str: (str,), tuple: (tuple,)}
"""A kind of value → the types that are of it; a bool is an int to Python, so that it comes first."""


def switch_names(rules: DataclassInstance) -> list[str]:
    """The names of all choices of a protocol; those of a part of it with the part's name before them."""
    names = []
    for field in fields(rules):
        value = getattr(rules, field.name)
        if is_dataclass(value) and not isinstance(value, type):
            names += [f"{field.name}.{name}" for name in switch_names(value)]
        else:
            names.append(field.name)
    return names


def switched(rules: Rules, switches: Mapping[str, Any]) -> Rules:
    """A protocol with some choices changed.

    Args:
        rules: the protocol, a frozen dataclass; parts of it may be others.
        switches: name of `switch_names` → value; lists stand for tuples, as JSON has them.

    Raises:
        ChoiceError: the protocol has no such choice, or it is of another kind: a number for a word.
        DeepAccidentError: it cannot have that value.
    """
    changes: dict[str, Any] = {}
    parts: dict[str, dict[str, Any]] = {}
    names = switch_names(rules)
    for name, value in switches.items():
        if name not in names:
            there = f"there are {possible_text(name, names)}" if names else "it has none"
            raise ChoiceError(f"{type(rules).__name__} has no switch {name!r}; {there}")
        head, _, rest = name.partition(".")
        if rest:
            parts.setdefault(head, {})[rest] = value
        else:
            changes[head] = _of_kind(name, rules, head, as_tuples(value))
    changes |= {head: switched(getattr(rules, head), those) for head, those in parts.items()}
    return replace(rules, **changes)  # all at once, since some go together alone


def _of_kind(name: str, rules: DataclassInstance, field: str, value: Any) -> Any:
    """A value of the kind of a field's own; raises ChoiceError. A field whose value is None takes any."""
    before = getattr(rules, field)
    kind = next((kind for kind in (bool, float, str, tuple) if isinstance(before, _LIKE[kind])), None)
    fits = kind is None or (isinstance(value, _LIKE[kind]) and (kind is bool or not isinstance(value, bool)))
    takes_none = any("None" in str(each.type) for each in fields(rules) if each.name == field)
    if not (takes_none if value is None else fits):
        raise ChoiceError(f"switch {name}: expected {_WORDS[kind]}, such as {before!r}, found {value!r}")
    return value


def protocol_of(given: object, kind: type[Kind], named: Mapping[str, Kind]) -> Kind:
    """A protocol by its name, or as it is given if it is of a kind; raises ChoiceError."""
    return given if isinstance(given, kind) else named[choice("protocol", given, named)]


def as_tuples(value: Any) -> Any:
    """Lists as tuples, so that protocols can be compared and looked up by."""
    return tuple(as_tuples(each) for each in value) if isinstance(value, list | tuple) else value
