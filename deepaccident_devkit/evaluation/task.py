"""Common parts of tasks beside `Evaluator`: protocols with switches, and results with rows."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, Final, Literal, NoReturn, TypeVar, cast

import numpy as np

from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.support.arrays import ShortRepr, known
from deepaccident_devkit.support.reports import table_html
from deepaccident_devkit.support.text import choice, counted, meant_text, possible_text

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

_Kind = TypeVar("_Kind")
Rules = TypeVar("Rules", bound="DataclassInstance")
_WORDS: Final[Mapping[type | None, str]] = {
    bool: "true or false",
    float: "a number",
    str: "a word",
    tuple: "a list",
}
# A kind of value → the types that are of it; to Python a bool is an int, so it comes first.
_TYPES_OF_KIND: Final[Mapping[type, tuple[type, ...]]] = {
    bool: (bool,),
    float: (float, int),
    str: (str,),
    tuple: (tuple,),
}
# Number of headlines in a result's text.
_TEXT_HEADLINES: Final = 4
_HIGHER_IS_BETTER: Final = {"higher": True, "lower": False, "neither": None}


def switch_names(rules: DataclassInstance) -> list[str]:
    """Return the names of all choices of a protocol; a part's choices begin with its name."""
    names = []
    for field in fields(rules):
        value = getattr(rules, field.name)
        if is_dataclass(value) and not isinstance(value, type):
            names += [f"{field.name}.{name}" for name in switch_names(value)]
        else:
            names.append(field.name)
    return names


def switched(rules: Rules, switches: Mapping[str, Any]) -> Rules:
    """Return a protocol with some choices changed.

    Args:
        rules: Protocol, a frozen dataclass; parts of it may be others.
        switches: Name from `switch_names` → value; lists stand for tuples, as JSON has them.

    Raises:
        ChoiceError: the protocol has no such choice, or it is of another kind: a number for a word.
        DeepAccidentError: the choice cannot have that value.
    """
    if not switches:
        return rules
    changes: dict[str, Any] = {}
    parts: dict[str, dict[str, Any]] = {}
    names = switch_names(rules)
    for name, value in switches.items():
        if name not in names:
            options = f"there are {possible_text(name, names)}" if names else "it has none"
            raise ChoiceError(
                f"these rules have no switch {name!r}{meant_text(name, names)}; {options}"
            )
        head, _, tail = name.partition(".")
        if tail:
            parts.setdefault(head, {})[tail] = value
        else:
            changes[head] = _of_kind(name, rules, head, as_tuples(value))
    for head, part_switches in parts.items():
        changes[head] = switched(getattr(rules, head), part_switches)
    return replace(rules, **changes)  # all at once, since some are only valid together


def _of_kind(name: str, rules: DataclassInstance, field: str, value: Any) -> Any:
    """Return a value if it is of the kind of a field's own; raises ChoiceError otherwise.

    A field with the value None takes any value.
    """
    current = getattr(rules, field)
    kind: type | None = None
    for candidate in (bool, float, str, tuple):
        if isinstance(current, _TYPES_OF_KIND[candidate]):
            kind = candidate
            break
    if value is None:
        types = [str(item.type) for item in fields(rules) if item.name == field]
        is_allowed = any("None" in text for text in types)
    elif kind is None:
        is_allowed = True
    else:
        is_bool = isinstance(value, bool)
        is_allowed = isinstance(value, _TYPES_OF_KIND[kind]) and (kind is bool or not is_bool)
    if not is_allowed:
        raise ChoiceError(
            f"switch {name}: expected {_WORDS[kind]}, such as {current!r}, found {value!r}"
        )
    return value


def protocol_of(protocol: object, protocols: Mapping[str, _Kind]) -> _Kind:
    """Return a protocol by its name, or the protocol itself if it is of the class of one of them.

    Raises:
        ChoiceError: no protocol has that name.
    """
    if isinstance(protocol, tuple(map(type, protocols.values()))):
        return cast("_Kind", protocol)
    return protocols[choice("protocol", protocol, protocols)]


def as_tuples(value: Any) -> Any:
    """Return lists as tuples, so that protocols can be compared and used as keys."""
    if isinstance(value, list | tuple):
        return tuple(as_tuples(item) for item in value)
    return value


_Key = TypeVar("_Key")
_Value = TypeVar("_Value")


class FrozenDict(dict[_Key, _Value]):
    """A dict that does not change, and so has a hash where its values have one.

    It is a dict and not a view of one, since `dataclasses.asdict`, `copy.deepcopy` and `pickle`
    refuse views.
    """

    def __hash__(self) -> int:  # type: ignore[override]  # dict has none, as it changes
        """Return a hash that is equal for equal dicts."""
        return hash(frozenset(self.items()))

    def __reduce__(self) -> tuple[Any, ...]:
        """Return the arguments for pickle, which would fill an empty dict."""
        return type(self), (dict(self),)

    def _refused(self, *_arguments: Any, **_named: Any) -> NoReturn:
        raise TypeError("the mappings of a result cannot be changed; make a dict of it")

    __setitem__ = __delitem__ = __ior__ = _refused
    clear = pop = popitem = setdefault = update = _refused


class FrozenMappings(ShortRepr):
    """Base of frozen dataclasses with read-only mappings, from the start and in every copy."""

    __slots__ = ()

    def __post_init__(self) -> None:
        """Freeze the mappings."""
        for field in fields(self):  # type: ignore[arg-type]  # its subclasses are dataclasses
            value = getattr(self, field.name)
            if isinstance(value, Mapping):
                object.__setattr__(self, field.name, _frozen(value))

    def as_dict(self) -> dict[str, Any]:
        """Return all fields, as JSON holds them: None for NaN, numbers as keys as text ("5")."""
        names = [field.name for field in fields(self)]  # type: ignore[arg-type]
        return {name: plain(getattr(self, name)) for name in names}


def plain(value: Any) -> Any:
    """Return the contents of a result, as JSON holds them: None for NaN and infinite numbers."""
    if isinstance(value, FrozenMappings):
        return value.as_dict()
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if is_dataclass(value):
        value = {field.name: getattr(value, field.name) for field in fields(value)}
    if isinstance(value, Mapping):
        return {_key_text(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _key_text(key: object) -> str:
    """Return a key as text, floats without needless digits: `5`."""
    return f"{key:g}" if isinstance(key, float) else str(key)


def _frozen(value: Any) -> Any:
    """Return a value with all mappings in it frozen."""
    if not isinstance(value, Mapping):
        return value
    return FrozenDict({key: _frozen(item) for key, item in value.items()})


Unit = Literal["%", "share", "m", "s", "rad", "m/s", "1 - overlap", "1/min"]
# Largest possible number of a unit; other units have no limit.
LIMITS: Final[Mapping[Unit, float]] = MappingProxyType(
    {"%": 100.0, "share": 1.0, "1 - overlap": 1.0}
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Headline:
    """One number of a result.

    Attributes:
        name: Short name, as tables print it: `iou 30x30`, `accuracy@10`, `mAP`.
        value: The number; None where there is nothing to count, or the result has no such number.
        unit: `%` for percent, `share` for a share in [0, 1].
        higher_is_better: Whether more is better; None where neither is.
        path: Path of the number in the result, as in `breakdowns.numbers_of`: `ranges/30x30/iou`.
    """

    name: str
    value: float | None
    unit: Unit
    higher_is_better: bool | None
    path: str

    def text(self) -> str:
        """Return the value with its unit; see `value_text`."""
        return value_text(self.value, self.unit)


@dataclass(frozen=True, slots=True)
class Row:
    """Describes one number of a result, or all numbers with paths that fit a pattern.

    Attributes:
        path: Path of the number in the result; `*` stands for any key.
        unit: Unit of the number.
        better: Which numbers are better.
        name: Short name for tables, in which `*` stands for the key; empty for the last part of the
            path.
        is_signed: Whether the number can be below 0.
        is_headline: Whether the number is a headline; `*` in the path of a headline is exactly one
            key.
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
        rows: Describes every number of the result that is no total and no setting; headlines come
            in this order.
        samples: Number of samples.
    """

    __slots__ = ()

    rows: ClassVar[tuple[Row, ...]] = ()
    samples: int

    def __repr__(self) -> str:
        """Return the number of samples and the first headlines."""
        numbers = headlines(self)
        texts = [f"{number.name} {number.text()}" for number in numbers[:_TEXT_HEADLINES]]
        if len(numbers) > _TEXT_HEADLINES:
            texts.append("…")
        samples = counted(self.samples, "sample")
        return f"{type(self).__name__}({samples}: {', '.join(texts)})"

    def _repr_html_(self) -> str:
        rows = [(number.name, number.text()) for number in headlines(self)]
        return table_html(
            [("number", "value"), *rows],
            f"{type(self).__name__}, {counted(self.samples, 'sample')}",
        )


def headlines(result: TaskResult) -> tuple[Headline, ...]:
    """Return the headline numbers of a result, the most important first.

    A number that the protocol does not have is left out: the released accidents have no precision.
    """
    numbers = []
    for row in result.rows:
        if not row.is_headline:
            continue
        name = row.name or row.path.rpartition("/")[2]
        for key, value in _numbers_at(result, row.path):
            headline = Headline(
                name=name.replace("*", key),
                value=known(value),
                unit=row.unit,
                higher_is_better=_HIGHER_IS_BETTER[row.better],
                path=row.path.replace("*", key),
            )
            numbers.append(headline)
    return tuple(numbers)


def value_text(value: float | None, unit: Unit, *, signed: bool = False) -> str:
    """Return a number with its unit, for people: `41.20 %`, `0.875`, `1.300 m`; `–` for none.

    With `signed` it is a change: `+1.300 m`, and `+0.54` for percent, in percentage points.
    """
    if value is None:
        return "–"
    sign = "+" if signed else ""
    digits = 2 if unit == "%" else 3
    number = f"{value:{sign}.{digits}f}"
    has_no_unit = unit in ("share", "1 - overlap") or (signed and unit == "%")
    return number if has_no_unit else f"{number} {unit}"


def _numbers_at(result: object, path: str) -> Iterator[tuple[str, Any]]:
    """Yield the keys that stand for the `*` of a path (empty without one), and their values."""
    head, _, tail = path.partition("/")
    if isinstance(result, Mapping):
        for key, item in result.items():
            text = _key_text(key)
            if head not in ("*", text):
                continue
            if not tail:
                yield text, item
                continue
            for _, value in _numbers_at(item, tail):
                yield text, value
    elif hasattr(result, head):
        value = getattr(result, head)
        if tail:
            yield from _numbers_at(value, tail)
        else:
            yield "", value
