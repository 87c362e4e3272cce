"""What tasks share, in addition to `Evaluator`: protocols with switches, and results with rows."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, Final, Literal, NoReturn, TypeVar, cast

import numpy as np

from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.support.arrays import ShortRepr, json_numbers
from deepaccident_devkit.support.human_names import metric_name
from deepaccident_devkit.support.reports import table_html
from deepaccident_devkit.support.text import choice, counted, meant_text, possible_text
from deepaccident_devkit.support.values import NamedValues, ReadOnlyValues

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

_Kind = TypeVar("_Kind")
Rules = TypeVar("Rules", bound="DataclassInstance")
# Type of a switch → its name in messages; None for a switch that takes any value.
_TYPE_NAMES: Mapping[type | None, str] = {
    bool: "true or false",
    float: "a number",
    str: "a word",
    tuple: "a list",
}
# Type of a switch → types of its possible values; bool comes first, since a bool is also an int.
_ALLOWED_TYPES: Mapping[type, tuple[type, ...]] = {
    bool: (bool,),
    float: (float, int),
    str: (str,),
    tuple: (tuple,),
}
# The repr of a result shows at most this many headlines.
_MAX_REPR_HEADLINES = 4
_HIGHER_IS_BETTER = {"higher": True, "lower": False, "neither": None}


def switch_names(rules: DataclassInstance) -> list[str]:
    """Return the names of all fields of a protocol; nested ones have dots, as in `part.choice`."""
    names = []
    for field in fields(rules):
        value = getattr(rules, field.name)
        if is_dataclass(value) and not isinstance(value, type):
            names += [f"{field.name}.{name}" for name in switch_names(value)]
        else:
            names.append(field.name)
    return names


def switched(rules: Rules, switches: ReadOnlyValues) -> Rules:
    """Return a copy of a protocol with some fields changed.

    Args:
        rules: Protocol, a frozen dataclass; its fields may be frozen dataclasses, too.
        switches: Name from `switch_names` → value; lists are converted to tuples, which JSON does
            not have.

    Raises:
        ChoiceError: If the protocol does not have a field, or a value has the wrong type, such as a
            number instead of a word.
        DeepAccidentError: If a field cannot have the value.
    """
    if not switches:
        return rules
    changes: NamedValues = {}
    nested_switches: dict[str, NamedValues] = {}
    names = switch_names(rules)
    for name, value in switches.items():
        if name not in names:
            options = f"there are {possible_text(name, names)}" if names else "it has none"
            raise ChoiceError(
                f"these rules have no switch {name!r}{meant_text(name, names)}; {options}"
            )
        field_name, _, nested_name = name.partition(".")
        if nested_name:
            nested_switches.setdefault(field_name, {})[nested_name] = value
        else:
            changes[field_name] = _check_type(name, rules, field_name, as_tuples(value))
    for field_name, part_switches in nested_switches.items():
        part = getattr(rules, field_name)
        changes[field_name] = switched(part, part_switches)
    return replace(rules, **changes)  # all at once, since some values are only valid together


def _check_type(name: str, rules: DataclassInstance, field_name: str, value: Any) -> Any:
    """Return the new value of a field; raise ChoiceError if its type differs from the old one's.

    A field whose value is None accepts any value.
    """
    old_value = getattr(rules, field_name)
    switch_type: type | None = None
    for candidate, types in _ALLOWED_TYPES.items():
        if isinstance(old_value, types):
            switch_type = candidate
            break
    if value is None:
        annotations = {field.name: str(field.type) for field in fields(rules)}
        is_allowed = "None" in annotations[field_name]
    elif switch_type is None:
        is_allowed = True
    elif isinstance(value, bool):  # would pass as a number
        is_allowed = switch_type is bool
    else:
        is_allowed = isinstance(value, _ALLOWED_TYPES[switch_type])
    if not is_allowed:
        raise ChoiceError(
            f"switch {name}: expected {_TYPE_NAMES[switch_type]}, such as {old_value!r}, found "
            f"{value!r}"
        )
    return value


def protocol_of(protocol: object, protocols: Mapping[str, _Kind]) -> _Kind:
    """Return the protocol with a name, or the argument itself if it is a protocol.

    Raises:
        ChoiceError: If no protocol has this name, or the argument has another class.
    """
    classes = tuple(map(type, protocols.values()))
    if isinstance(protocol, classes):
        return cast("_Kind", protocol)
    return protocols[choice("protocol", protocol, protocols)]


def as_tuples(value: Any) -> Any:
    """Convert lists to tuples, so that protocols can be compared and used as keys."""
    if isinstance(value, list | tuple):
        return tuple(as_tuples(item) for item in value)
    return value


_Key = TypeVar("_Key")
_Value = TypeVar("_Value")


class FrozenDict(dict[_Key, _Value]):
    """A dict that cannot be changed, and therefore has a hash if its values have one.

    It is a dict instead of a view of one, since `dataclasses.asdict`, `copy.deepcopy` and `pickle`
    do not accept views.
    """

    def __hash__(self) -> int:  # type: ignore[override]  # dict has none, as it changes
        """Return a hash; equal dicts have equal hashes."""
        return hash(frozenset(self.items()))

    def __reduce__(self) -> tuple[Any, ...]:
        """Tell pickle how to create a copy; by default it would fill an empty dict."""
        return type(self), (dict(self),)

    def _refuse_change(self, *_arguments: Any, **_named: Any) -> NoReturn:
        """Raise TypeError."""
        raise TypeError("the mappings in a result cannot be changed; copy the mapping into a dict")

    __setitem__ = __delitem__ = __ior__ = _refuse_change
    clear = pop = popitem = setdefault = update = _refuse_change


class FrozenMappings(ShortRepr):
    """Base of frozen dataclasses whose mappings are read-only, even in copies."""

    __slots__ = ()

    def __post_init__(self) -> None:
        """Freeze the mappings."""
        for field in fields(self):  # type: ignore[arg-type]  # its subclasses are dataclasses
            value = getattr(self, field.name)
            if isinstance(value, Mapping):
                object.__setattr__(self, field.name, _freeze_mappings(value))

    def as_dict(self) -> dict[str, Any]:
        """Convert all fields to JSON values: NaN becomes None, and numeric keys become text."""
        names = [field.name for field in fields(self)]  # type: ignore[arg-type]
        return {name: plain(getattr(self, name)) for name in names}


def plain(value: Any) -> Any:
    """Convert a result to JSON values; NaN and infinite numbers become None."""
    if isinstance(value, FrozenMappings):
        return value.as_dict()
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if is_dataclass(value):
        names = [field.name for field in fields(value)]
        value = {name: getattr(value, name) for name in names}
    if isinstance(value, Mapping):
        return {_key_text(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _key_text(key: object) -> str:
    """Convert a key to text; the float 5.0 becomes `5`."""
    if isinstance(key, float):
        return f"{key:g}"
    return str(key)


def _freeze_mappings(value: Any) -> Any:
    """Freeze all mappings in a value."""
    if not isinstance(value, Mapping):
        return value
    return FrozenDict({key: _freeze_mappings(item) for key, item in value.items()})


Unit = Literal["%", "share", "m", "s", "rad", "m/s", "1 - overlap", "1/min", "count"]
# Unit → its largest possible number; other units have no limit.
LIMITS: Final[Mapping[Unit, float]] = MappingProxyType(
    {"%": 100.0, "share": 1.0, "1 - overlap": 1.0}
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Headline:
    """One number of a result.

    Attributes:
        name: Short name, as tables print it: `iou 30x30`, `accuracy@10`, `mAP`.
        value: The number; None if there is nothing to count, or the result has no such number.
        unit: `%` for percent, `share` for a share in [0, 1], or a unit of measurement.
        higher_is_better: Whether higher numbers are better; None if neither higher nor lower are.
        path: Path of the number in the result, as in `breakdowns.numbers_of`: `ranges/30x30/iou`.
    """

    name: str
    value: float | None
    unit: Unit
    higher_is_better: bool | None
    path: str

    def text(self) -> str:
        """Format the value with its unit; see `value_text`."""
        return value_text(self.value, self.unit)


@dataclass(frozen=True, slots=True)
class Row:
    """Description of one number of a result, or of all numbers whose paths match a pattern.

    Attributes:
        path: Path of the number in the result; `*` matches any key.
        unit: Unit of the number.
        better: Whether higher or lower numbers are better, or neither.
        name: Short name for tables, in which `*` is replaced by the key; if it is empty, the name
            is the last part of the path.
        is_signed: Whether the number can be negative.
        is_headline: Whether the number is a headline; `*` in the path of a headline matches exactly
            one key.
    """

    path: str
    unit: Unit
    better: Literal["higher", "lower", "neither"] = "lower"
    name: str = ""
    is_signed: bool = False
    is_headline: bool = True


class TaskResult(FrozenMappings):
    """Base of the results of evaluators; `repr` and notebooks show the headlines.

    Attributes:
        rows: Descriptions of the result's numbers, except for totals and settings. Headlines are
            shown in this order.
        samples: Number of samples.
    """

    __slots__ = ()

    rows: ClassVar[tuple[Row, ...]] = ()
    samples: int

    def __repr__(self) -> str:
        """Return the number of samples and the first headlines."""
        numbers = headlines(self)
        texts = [f"{number.name} {number.text()}" for number in numbers[:_MAX_REPR_HEADLINES]]
        if len(numbers) > _MAX_REPR_HEADLINES:
            texts.append("…")
        samples = counted(self.samples, "sample")
        return f"{type(self).__name__}({samples}: {', '.join(texts)})"

    def _repr_html_(self) -> str:
        """Format the headlines as an HTML table for notebooks."""
        rows = [(metric_name(number.name), number.text()) for number in headlines(self)]
        caption = f"{type(self).__name__}, {counted(self.samples, 'sample')}"
        return table_html([("number", "value"), *rows], caption)


def headlines(result: TaskResult) -> tuple[Headline, ...]:
    """Return the headline numbers of a result, the most important first.

    Numbers that the protocol does not have are left out, such as the precision of released
    accidents.
    """
    numbers = []
    for row in result.rows:
        if not row.is_headline:
            continue
        name = row.name or row.path.rpartition("/")[2]
        for key, value in _numbers_at(result, row.path):
            headline = Headline(
                name=name.replace("*", key),
                value=json_numbers(value),
                unit=row.unit,
                higher_is_better=_HIGHER_IS_BETTER[row.better],
                path=row.path.replace("*", key),
            )
            numbers.append(headline)
    return tuple(numbers)


def value_text(value: float | None, unit: Unit, *, signed: bool = False) -> str:
    """Format a number with its unit, such as `41.20 %`, `0.875` or `1.300 m`; None is `–`.

    With `signed`, the number is a change, such as `+1.300 m`, or `+0.54` for percentage points.
    """
    if value is None:
        return "–"
    sign = "+" if signed else ""
    digits = {"%": 2, "count": 0}.get(unit, 3)
    number = f"{value:{sign}.{digits}f}"
    has_no_unit = unit in ("share", "1 - overlap", "count") or (signed and unit == "%")
    if has_no_unit:
        return number
    return f"{number} {unit}"


def _numbers_at(result: object, path: str) -> Iterator[tuple[str, Any]]:
    """Yield each key that matches the `*` in a path (empty if there is none), with its value."""
    name, _, inner_path = path.partition("/")
    if isinstance(result, Mapping):
        for key, item in result.items():
            text = _key_text(key)
            if name not in ("*", text):
                continue
            if not inner_path:
                yield text, item
                continue
            for inner_key, value in _numbers_at(item, inner_path):
                yield (text if name == "*" else inner_key), value
    elif hasattr(result, name):
        value = getattr(result, name)
        if inner_path:
            yield from _numbers_at(value, inner_path)
        else:
            yield "", value
