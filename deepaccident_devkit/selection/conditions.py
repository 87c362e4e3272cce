"""One filter on one field: as a text, as a keyword's value, and as the test that it comes to."""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Collection, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.selection.fields import Field, FieldValue
from deepaccident_devkit.support.text import meant_text, possible_text

FilterValue = FieldValue | Collection[FieldValue]
"""What a keyword of `find` takes: a value, or several values, one of which must match."""

_TEXT = re.compile(r"\s*(\w+)\s*(!=|>=|<=|=|>|<)(.*)", re.DOTALL)
_NUMBER = r"-?\d{1,18}(?:\.\d{1,18})?"
_RANGE = re.compile(rf"({_NUMBER})?\s*\.\.\s*({_NUMBER})?")
_BOUND = re.compile(rf"(>=|<=|>|<)\s*({_NUMBER})")
_UNKNOWN = ("unknown", "none")
_FLAGS = {"true": True, "yes": True, "false": False, "no": False}
# Types that Python takes for collections and a filter does not; of these only a str can be a value.
_SINGLE = (str, bytes, bytearray, Mapping, np.ndarray)
# Characters of a wrong value that a message shows.
_LONGEST = 60


@dataclass(frozen=True, slots=True)
class Filter:
    """A field and the values that are wanted of it, as given.

    Attributes:
        name: the field's name or its short form.
        values: one of them must match.
        negated: whether the scenarios with none of the values are wanted instead.
    """

    name: str
    values: tuple[Any, ...]
    negated: bool = False


@dataclass(frozen=True, slots=True)
class Condition:
    """A filter that was checked against its field.

    Attributes:
        field: what is looked at.
        values: the single values that will do, None among them for unknown.
        ranges: (lowest, highest) of the numbers that will do; None for no bound.
        negated: as of `Filter`.
    """

    field: Field
    values: frozenset[FieldValue]
    ranges: tuple[tuple[float | None, float | None], ...]
    negated: bool

    def holds(self, value: FieldValue | tuple[FieldValue, ...]) -> bool:
        """Whether a scenario with this value of the field, or with these, is wanted."""
        several = value if isinstance(value, tuple) else (value,)
        met = (
            each in self.values or any(_within(each, *bounds) for bounds in self.ranges)
            for each in several
        )
        return any(met) != self.negated


def parse_where(text: str) -> Filter:
    """Read a filter such as `town=Town03,Town05`, `weather!=Clear`, `length>=50` or `length=40..60`.

    Field and values are checked where the filter is used, as those of keywords are.

    Raises:
        ChoiceError: the text has no field, no sign or no value.
    """
    if not isinstance(text, str):
        raise ChoiceError(
            f"expected a text such as town=Town03,Town05, found {_shown(text)}; other values are given as keywords, "
            "such as town=['Town03', 'Town05']"
        )
    match = _TEXT.fullmatch(text)
    values = [value.strip() for value in match[3].split(",")] if match else []
    if match is None or not all(values):
        raise ChoiceError(
            f"expected field=value[,value…] with one of the signs =, !=, >=, <=, > and <, found {_shown(text)}; "
            "such as town=Town03,Town05 or length=40..60"
        )
    name, sign = match[1], match[2]
    if sign in {"=", "!="}:
        return Filter(name, tuple(values), negated=sign == "!=")
    if len(values) > 1:
        raise ChoiceError(f"{_shown(text)}: {sign} takes one number, found {len(values)}")
    return Filter(name, (f"{sign}{values[0]}",))


def keyword_filter(name: str, value: FilterValue) -> Filter:
    """The filter that a keyword of `find` stands for."""
    several = isinstance(value, Collection) and not isinstance(value, _SINGLE)
    return Filter(name, tuple(value) if several else (value,))  # type: ignore[arg-type]


def condition_of(wanted: Filter, field: Field, here: Iterable[FieldValue]) -> Condition:
    """Check a filter against its field, whose values in this release are always possible; raises ChoiceError."""
    possible = list(
        dict.fromkeys([*field.known, *sorted({str(value) for value in here if value is not None})])
    )
    singles: set[FieldValue] = set()
    ranges = []
    for given in wanted.values:
        value = given.item() if isinstance(given, np.generic) else given
        bounds = _bounds(field, value) if isinstance(value, str) else None
        if bounds is not None:
            ranges.append(bounds)
        else:
            singles.add(_single(field, value, [str(word) for word in possible]))
    return Condition(field, frozenset(singles), tuple(ranges), wanted.negated)


def _single(field: Field, value: object, possible: list[str]) -> FieldValue:
    """One value of a field, in the field's own type."""
    if value is None or (isinstance(value, str) and value.lower() in _UNKNOWN):
        return None
    if isinstance(value, Collection) and not isinstance(value, str):
        raise ChoiceError(
            f"{field.name}: expected a value, or a list, tuple or set of values, found {_shown(value)}; give an array "
            "as a list: array.tolist()"
        )
    if field.kind == "flag":
        flag = _FLAGS.get(value.lower()) if isinstance(value, str) else value
        if isinstance(flag, bool):
            return flag
        raise ChoiceError(f"{field.name}: expected true, false or unknown, found {_shown(value)}")
    if field.kind in {"number", "measure"}:
        return _number(field, value)
    if isinstance(value, str) and (word := _spelt(value, possible)) is not None:
        return word
    meant = value if isinstance(value, str) and len(value) <= _LONGEST else ""
    raise ChoiceError(
        f"{field.name}: found {_shown(value)}; possible are {possible_text(meant, possible)}"
        f"{meant_text(meant, possible)}"
    )


def _spelt(value: str, possible: Iterable[str]) -> str | None:
    """The possible word that a value is; case, `_`, `-` and blanks do not count."""
    words = {_bare(word): word for word in possible}
    return value if value in words.values() else words.get(_bare(value))


def _bare(word: str) -> str:
    return re.sub(r"[\s_-]", "", word.casefold())


def _number(field: Field, value: object) -> float:
    number: float | None = None
    if isinstance(value, str):
        if re.fullmatch(_NUMBER, value) is not None:
            number = _read_number(field, value)
    elif field.kind == "measure" and isinstance(value, float) and math.isfinite(value):
        number = value
    elif not isinstance(value, bool):
        with suppress(TypeError):
            number = operator.index(value)  # type: ignore[arg-type]
    if number is None:
        raise ChoiceError(
            f"{field.name}: expected a number, a range such as 40..60 or a bound such as >=50, found {_shown(value)}"
        )
    if field.known and number not in field.known:
        raise ChoiceError(
            f"{field.name}: found {_shown(number)}; possible are {', '.join(map(str, field.known))}"
        )
    return number


def _read_number(field: Field, digits: str) -> float:
    """The number that a sign and digits stand for."""
    if field.kind == "measure":
        return float(digits)
    if "." in digits:
        raise ChoiceError(f"{field.name}: expected a whole number, found {digits}")
    return int(digits)


def _shown(value: object) -> str:
    """A wrong value as a message shows it: in full if it is short."""
    try:
        text = repr(value)
    except ValueError:  # an int of more than 4300 digits
        text = f"{type(value).__name__} of very many digits"
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}…"


def _bounds(field: Field, text: str) -> tuple[float | None, float | None] | None:
    """The lowest and highest number that a text allows; None if it is no range."""
    text = text.strip()
    if (bound := _BOUND.fullmatch(text)) is not None:
        ends = _ends(bound[1], _read_number(field, bound[2]))
    elif (between := _RANGE.fullmatch(text)) is not None:
        ends = (
            _read_number(field, between[1]) if between[1] else None,
            _read_number(field, between[2]) if between[2] else None,
        )
    else:
        return None
    if field.kind not in {"number", "measure"}:
        raise ChoiceError(f"{field.name}: {_shown(text)} is a range, which only numbers have")
    lowest, highest = ends
    if lowest is not None and highest is not None and lowest > highest:
        raise ChoiceError(f"{field.name}: '{text}': {lowest} is more than {highest}")
    return ends


def _ends(sign: str, number: float) -> tuple[float | None, float | None]:
    """The lowest and highest number, both allowed, that a bound stands for."""
    if sign in {">", "<"}:
        aside = math.inf if sign == ">" else -math.inf
        number = (
            number + int(math.copysign(1, aside))
            if isinstance(number, int)
            else math.nextafter(number, aside)
        )
    return (number, None) if sign.startswith(">") else (None, number)


def _within(value: FieldValue, lowest: float | None, highest: float | None) -> bool:
    if not isinstance(value, int | float):
        return False
    return (lowest is None or lowest <= value) and (highest is None or value <= highest)
