"""What tasks share beside `Evaluator`: protocols and their switches, and results that know their rows."""

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
# A kind of value → the types that are of it; a bool is an int to Python, so that it comes first.
_LIKE: Final[Mapping[type, tuple[type, ...]]] = {
    bool: (bool,),
    float: (float, int),
    str: (str,),
    tuple: (tuple,),
}


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
    if not switches:
        return rules
    changes: dict[str, Any] = {}
    parts: dict[str, dict[str, Any]] = {}
    names = switch_names(rules)
    for name, value in switches.items():
        if name not in names:
            there = f"there are {possible_text(name, names)}" if names else "it has none"
            raise ChoiceError(
                f"these rules have no switch {name!r}{meant_text(name, names)}; {there}"
            )
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
    kind = next(
        (kind for kind in (bool, float, str, tuple) if isinstance(before, _LIKE[kind])), None
    )
    fits = kind is None or (
        isinstance(value, _LIKE[kind]) and (kind is bool or not isinstance(value, bool))
    )
    takes_none = any("None" in str(each.type) for each in fields(rules) if each.name == field)
    if not (takes_none if value is None else fits):
        raise ChoiceError(
            f"switch {name}: expected {_WORDS[kind]}, such as {before!r}, found {value!r}"
        )
    return value


def protocol_of(protocol: object, protocols: Mapping[str, _Kind]) -> _Kind:
    """Return a protocol by its name, or as given if it is of the class of one of them; raises ChoiceError."""
    if isinstance(protocol, tuple(map(type, protocols.values()))):
        return cast("_Kind", protocol)
    return protocols[choice("protocol", protocol, protocols)]


def as_tuples(value: Any) -> Any:
    """Lists as tuples, so that protocols can be compared and looked up by."""
    return tuple(as_tuples(each) for each in value) if isinstance(value, list | tuple) else value


_Key = TypeVar("_Key")
_Value = TypeVar("_Value")


class FrozenDict(dict[_Key, _Value]):
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
        for each in fields(self):  # type: ignore[arg-type]  # its subclasses are dataclasses
            if isinstance(value := getattr(self, each.name), Mapping):
                object.__setattr__(self, each.name, _frozen(value))

    def as_dict(self) -> dict[str, Any]:
        """All of it, as JSON holds it: None for NaN, numbers as keys as text ("5")."""
        return {each.name: plain(getattr(self, each.name)) for each in fields(self)}  # type: ignore[arg-type]


def plain(value: Any) -> Any:
    """What a result holds, as JSON holds it: None for NaN and infinite numbers."""
    if isinstance(value, FrozenMappings):
        return value.as_dict()
    if is_dataclass(value):
        return {each.name: plain(getattr(value, each.name)) for each in fields(value)}
    if isinstance(value, Mapping):
        return {
            f"{key:g}" if isinstance(key, float) else str(key): plain(each)
            for key, each in value.items()
        }
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [plain(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _frozen(value: Any) -> Any:
    if not isinstance(value, Mapping):
        return value
    return FrozenDict({key: _frozen(each) for key, each in value.items()})


Unit = Literal["%", "share", "m", "s", "rad", "m/s", "1 - overlap", "1/min"]
# The most that a number of a unit can be; others have no limit.
LIMITS: Final[Mapping[Unit, float]] = MappingProxyType(
    {"%": 100.0, "share": 1.0, "1 - overlap": 1.0}
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Headline:
    """One number of a result.

    Attributes:
        name: short, as tables print it: `iou 30x30`, `accuracy@10`, `mAP`.
        value: None where there is nothing to count, or the result has no such number.
        unit: `%` for percent, `share` for a share in [0, 1].
        higher_is_better: whether more is better; None where neither is.
        path: of the number in the result, as `breakdowns.numbers_of` has it: `ranges/30x30/iou`.
    """

    name: str
    value: float | None
    unit: Unit
    higher_is_better: bool | None
    path: str

    def text(self) -> str:
        """The value with its unit; see `value_text`."""
        return value_text(self.value, self.unit)


@dataclass(frozen=True, slots=True)
class Row:
    """Describes one number of a result, or all numbers whose paths fit a pattern.

    Attributes:
        path: Path of the number in the result; `*` stands for any key.
        unit: Unit of the number.
        better: Which numbers are better.
        name: Short name for tables, in which `*` stands for the key; empty for the last part of the path.
        is_signed: Whether the number can be below 0.
        is_headline: Whether the number is a headline; `*` in the path of a headline is exactly one key.
    """

    path: str
    unit: Unit
    better: Literal["higher", "lower", "neither"] = "lower"
    name: str = ""
    is_signed: bool = False
    is_headline: bool = True


# Headlines in a result's text.
_SHOWN: Final = 4
_HIGHER_IS_BETTER: Final = {"higher": True, "lower": False, "neither": None}


class TaskResult(FrozenMappings):
    """Base of the results of evaluators; `repr` and notebooks show the headlines.

    Attributes:
        rows: Describes every number of the result that is no total and no setting; headlines come in this order.
        samples: Number of samples.
    """

    __slots__ = ()

    rows: ClassVar[tuple[Row, ...]] = ()
    samples: int

    def __repr__(self) -> str:
        """Return the number of samples and the first headlines."""
        numbers = headlines(self)
        texts = [f"{number.name} {number.text()}" for number in numbers[:_SHOWN]]
        more = ", …" * (len(numbers) > _SHOWN)
        return f"{type(self).__name__}({counted(self.samples, 'sample')}: {', '.join(texts)}{more})"

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
    return tuple(
        Headline(
            name=(row.name or row.path.rpartition("/")[2]).replace("*", key),
            value=known(value),
            unit=row.unit,
            higher_is_better=_HIGHER_IS_BETTER[row.better],
            path=row.path.replace("*", key),
        )
        for row in result.rows
        if row.is_headline
        for key, value in _found(result, row.path)
    )


def value_text(value: float | None, unit: Unit, *, signed: bool = False) -> str:
    """A number with its unit, for people: `41.20 %`, `0.875`, `1.300 m`; `–` for none.

    With `signed` it is a change: `+1.300 m`, and `+0.54` of percents, in percentage points.
    """
    if value is None:
        return "–"
    number = f"{value:{'+' if signed else ''}.{2 if unit == '%' else 3}f}"
    return (
        number
        if unit in ("share", "1 - overlap") or (signed and unit == "%")
        else f"{number} {unit}"
    )


def _found(result: object, path: str) -> Iterator[tuple[str, Any]]:
    """Keys that stand for the `*` (an empty one without) and the values there."""
    head, _, rest = path.partition("/")
    if isinstance(result, Mapping):
        for name, each in result.items():
            text = f"{name:g}" if isinstance(name, float) else str(name)
            if head in ("*", text):
                yield from (
                    (text, value) for _, value in (_found(each, rest) if rest else [("", each)])
                )
    elif hasattr(result, head):
        value = getattr(result, head)
        yield from _found(value, rest) if rest else [("", value)]
