"""A filter on a field: its text, its keyword, and the checked condition."""

import math
import operator
import re
from collections.abc import Collection, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.selection.fields import Field, FieldValue
from deepaccident_devkit.support.text import meant_text, possible_text

FilterValue = FieldValue | Collection[FieldValue]
"""Value of a keyword of `find`: a value, or several values, and one must match."""

_FILTER_TEXT = re.compile(r"\s*(\w+)\s*(!=|>=|<=|=|>|<)(.*)", re.DOTALL)
_NUMBER = r"-?\d{1,18}(?:\.\d{1,18})?"
_RANGE = re.compile(rf"({_NUMBER})?\s*\.\.\s*({_NUMBER})?")
_BOUND = re.compile(rf"(>=|<=|>|<)\s*({_NUMBER})")
_UNKNOWN_WORDS = ("unknown", "none")
_FLAGS = {"true": True, "yes": True, "false": False, "no": False}
# Collections that do not count as several values; of these, only a str can be a single value.
_SINGLE_TYPES = (str, bytes, bytearray, Mapping, np.ndarray)
# Maximum number of characters of an invalid value in a message.
_MAX_QUOTE_LENGTH = 60


@dataclass(frozen=True, slots=True)
class Filter:
    """A field and the values to match, which are not checked yet.

    Attributes:
        name: Name of the field, or its short form.
        values: Values; one must match.
        negated: Whether to match the scenarios with none of the values.
    """

    name: str
    values: tuple[Any, ...]
    negated: bool = False


@dataclass(frozen=True, slots=True)
class Condition:
    """A filter that has been checked against its field.

    Attributes:
        field: Field of the filter.
        values: Single values that match; None for unknown.
        ranges: Lowest and highest number of each range that matches; None for no bound.
        negated: Whether to match the scenarios with none of the values.
    """

    field: Field
    values: frozenset[FieldValue]
    ranges: tuple[tuple[float | None, float | None], ...]
    negated: bool

    def holds(self, value: FieldValue | tuple[FieldValue, ...]) -> bool:
        """Return whether the condition matches a scenario with this value (or these values)."""
        values = value if isinstance(value, tuple) else (value,)
        return any(map(self._matches, values)) != self.negated

    def _matches(self, value: FieldValue) -> bool:
        """Return whether a value is one of the values or lies in one of the ranges."""
        if value in self.values:
            return True
        return any(_is_within(value, *bounds) for bounds in self.ranges)


def parse_where(text: str) -> Filter:
    """Parse a filter such as `town=Town03,Town05`, `weather!=Clear` or `length=40..60`.

    Field and values are checked later, when the filter is used.

    Raises:
        ChoiceError: If the text has no field, no operator or no value.
    """
    if not isinstance(text, str):
        raise ChoiceError(
            f"expected a text such as town=Town03,Town05, found {_quote(text)}; pass other values "
            "as keywords, such as town=['Town03', 'Town05']"
        )
    match = _FILTER_TEXT.fullmatch(text)
    name, sign, value_text = match.groups() if match else ("", "", "")
    values = [value.strip() for value in value_text.split(",")]
    if not all(values):
        raise ChoiceError(
            "expected field=value[,value…] with one of the signs =, !=, >=, <=, > and <, such as "
            f"town=Town03,Town05 or length=40..60, found {_quote(text)}"
        )
    if sign in {"=", "!="}:
        return Filter(name, tuple(values), negated=sign == "!=")
    if len(values) > 1:
        raise ChoiceError(f"{_quote(text)}: {sign} takes one number, found {len(values)}")
    return Filter(name, (f"{sign}{values[0]}",))


def make_filter(name: str, value: FilterValue) -> Filter:
    """Make a filter from a keyword argument of `find`."""
    if isinstance(value, Collection) and not isinstance(value, _SINGLE_TYPES):
        return Filter(name, tuple(value))
    return Filter(name, (value,))


def check_condition(query: Filter, field: Field, release_values: Iterable[FieldValue]) -> Condition:
    """Check a filter against its field; raise ChoiceError if a value is impossible.

    The values that the field has in this release (`release_values`) are always possible.
    """
    release_words = sorted({str(value) for value in release_values if value is not None})
    possible = list(dict.fromkeys(map(str, [*field.known, *release_words])))
    named_field = replace(field, name=query.name)  # messages have the name that the user gave
    singles = set()
    ranges = []
    for item in query.values:
        value = item.item() if isinstance(item, np.generic) else item
        bounds = _parse_range(named_field, value) if isinstance(value, str) else None
        if bounds is not None:
            ranges.append(bounds)
        else:
            singles.add(_parse_value(named_field, value, possible))
    return Condition(field, frozenset(singles), tuple(ranges), query.negated)


def _parse_value(field: Field, value: object, possible: list[str]) -> FieldValue:
    """Convert a value to the field's type; raise ChoiceError if it is impossible."""
    if value is None or (isinstance(value, str) and value.lower() in _UNKNOWN_WORDS):
        return None
    if isinstance(value, Collection) and not isinstance(value, str):
        raise ChoiceError(
            f"{field.name}: expected a value, or a list, tuple or set of values, found "
            f"{_quote(value)}; give an array as a list: array.tolist()"
        )
    if field.kind == "flag":
        flag = _FLAGS.get(value.lower()) if isinstance(value, str) else value
        if isinstance(flag, bool):
            return flag
        raise ChoiceError(f"{field.name}: expected true, false or unknown, found {_quote(value)}")
    if field.kind in {"number", "measure"}:
        return _parse_number(field, value)
    word = _find_word(value, possible) if isinstance(value, str) else None
    if word is not None:
        return word
    text = value if isinstance(value, str) and len(value) <= _MAX_QUOTE_LENGTH else ""
    raise ChoiceError(
        f"{field.name}: expected one of {possible_text(text, possible)}; found {_quote(value)}"
        f"{meant_text(text, possible)}"
    )


def _find_word(value: str, possible: Iterable[str]) -> str | None:
    """Return the possible word that equals `value` but for case, `_`, `-` and blanks, or None."""
    words = {_normalize(word): word for word in possible}
    if value in words.values():
        return value
    return words.get(_normalize(value))


def _normalize(word: str) -> str:
    return re.sub(r"[\s_-]", "", word.casefold())


def _parse_number(field: Field, value: object) -> float:
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
            f"{field.name}: expected a number, a range such as 40..60 or a bound such as >=50, "
            f"found {_quote(value)}"
        )
    if field.known and number not in field.known:
        raise ChoiceError(
            f"{field.name}: expected one of {', '.join(map(str, field.known))}; found "
            f"{_quote(number)}"
        )
    return number


def _read_number(field: Field, digits: str) -> float:
    """Parse a number; raise ChoiceError if the field's numbers are whole and this one is not."""
    if field.kind == "measure":
        return float(digits)
    if "." in digits:
        raise ChoiceError(f"{field.name}: expected a whole number, found {digits}")
    return int(digits)


def _quote(value: object) -> str:
    """Quote an invalid value for a message, shortened if it is long."""
    try:
        text = repr(value)
    except ValueError:  # an int with more than 4300 digits
        text = f"{type(value).__name__} with very many digits"
    if len(text) <= _MAX_QUOTE_LENGTH:
        return text
    return f"{text[:_MAX_QUOTE_LENGTH]}…"


def _parse_range(field: Field, text: str) -> tuple[float | None, float | None] | None:
    """Parse a range such as `40..60` to its ends (None: no bound); None if it is not a range."""
    text = text.strip()
    bound = _BOUND.fullmatch(text)
    interval = _RANGE.fullmatch(text)
    lowest: float | None = None
    highest: float | None = None
    if bound is not None:
        lowest, highest = _parse_bound(bound[1], _read_number(field, bound[2]))
    elif interval is not None:
        lowest = None
        if interval[1]:
            lowest = _read_number(field, interval[1])
        highest = _read_number(field, interval[2]) if interval[2] else None
    else:
        return None
    if field.kind not in {"number", "measure"}:
        raise ChoiceError(f"{field.name}: only numbers have ranges, found {_quote(text)}")
    if lowest is not None and highest is not None and lowest > highest:
        raise ChoiceError(f"{field.name}: '{text}': {lowest} is greater than {highest}; swap them")
    return lowest, highest


def _parse_bound(sign: str, number: float) -> tuple[float | None, float | None]:
    """Return the lowest and highest number (None: no bound) that a bound such as `>50` allows."""
    is_lowest = sign.startswith(">")
    if sign in {">", "<"}:
        if isinstance(number, int):
            number += 1 if is_lowest else -1
        else:
            number = math.nextafter(number, math.inf if is_lowest else -math.inf)
    if is_lowest:
        return (number, None)
    return (None, number)


def _is_within(value: FieldValue, lowest: float | None, highest: float | None) -> bool:
    if not isinstance(value, int | float):
        return False
    return (lowest is None or lowest <= value) and (highest is None or value <= highest)
