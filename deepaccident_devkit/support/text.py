"""Texts to and from users: columns, numbers, words in any case, paths and suggestions."""

import base64
import json
import logging
import math
import os
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from difflib import get_close_matches
from functools import cache
from html import escape
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar, TypeAlias, TypeVar

from deepaccident_devkit.errors import ChoiceError, ConfigError, DeepAccidentError, shortened
from deepaccident_devkit.support.values import ReadOnlyValues

AnyText = TypeVar("AnyText", bound=str | None)
PathType: TypeAlias = str | os.PathLike[str]
"""A path that a caller passes; `path_of` turns it into a Path."""
# Largest number of words that a message lists.
_MAX_WORDS = 20
# Smallest number of letters of a word that a longer one suggests, as `validation` suggests `val`.
_MIN_STEM_LENGTH = 3
# Largest number of differing values that a message shows.
_MAX_DIFFERENCES = 3
_NUMBER = re.compile(
    r"[+-]?((\d+\.?\d*|\.\d+)(e[+-]?\d+)?|nan|inf|infinity)", re.ASCII | re.IGNORECASE
)
_INTEGER = re.compile(r"(-?)0*(\d{1,19})", re.ASCII)
# Hyphen that is the sign of a number.
_HYPHEN_SIGN = re.compile(r"(?<![^\s(\[])-(?=\.?\d)")


@cache
def warn_once(text: str) -> None:
    """Log a warning once, and not in a worker process, since its parent logs it."""
    import multiprocessing

    if multiprocessing.parent_process() is None:
        logging.getLogger(__name__).warning("%s", text)


def columns_text(rows: Sequence[Sequence[str]], *, left: int = 1) -> str:
    """Return lines of aligned columns; the first row is the heading.

    The first `left` columns are flush left, the others flush right. Negative numbers have minus
    signs.
    """
    rows = [[with_minus(cell) for cell in row] for row in rows]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for row in rows:
        left_cells = map(str.ljust, row[:left], widths)
        right_cells = map(str.rjust, row[left:], widths[left:])
        lines.append("  ".join([*left_cells, *right_cells]).rstrip())
    return "\n".join(lines)


def natural_order(value: str | None) -> tuple[bool, float, str]:
    """Return the sort key of a word.

    Numbers, and words that begin with one (`2 s`), come first, by size; then other words; unknown
    values come last.
    """
    text = "none" if value is None else value
    number = math.inf
    with suppress(ValueError):
        number = float(text.split(" ")[0])
    return text == "none", number, text


class PictureRepr:
    """Base of objects that a notebook shows with a picture above their text, if there is one."""

    __slots__ = ()

    png_of: ClassVar[Callable[[object], bytes]]
    """Renders the picture. The package's `__init__` sets it, as rendering is a higher layer."""

    def _repr_html_(self) -> str:
        html = f"<pre>{escape(repr(self))}</pre>"
        with suppress(Exception):  # a picture is an extra
            content = base64.b64encode(PictureRepr.png_of(self)).decode("ascii")
            html = f'<img src="data:image/png;base64,{content}" alt="seen from above">{html}'
        return html


def number_of(word: str) -> float | None:
    """Return the number that a word spells, which may be NaN or infinite; None for other words."""
    if _NUMBER.fullmatch(word):
        return float(word)
    return None


def integer_of(word: str) -> int | None:
    """Return the 64-bit integer that a word spells; None for other words.

    Python itself reads no more than 4,300 digits.
    """
    match = _INTEGER.fullmatch(word)
    if match is None:
        return None
    value = int(match[1] + match[2])
    if -(2**63) <= value < 2**63:
        return value
    return None


def with_minus(text: str) -> str:
    """Return a text for people, in which negative numbers have a minus sign instead of a hyphen.

    >>> with_minus("-0.16 (type1-2)")
    '−0.16 (type1-2)'
    """
    return _HYPHEN_SIGN.sub("−", text)


def distinct_names(paths: Sequence[PathType]) -> list[str]:
    """Return the last part of each path in which the paths differ, or the whole paths.

    >>> distinct_names(["runs/single/accident", "runs/five/accident"])
    ['single', 'five']
    """
    names = [list(path_of(path).parts) for path in paths]
    while all(len(parts) > 1 for parts in names) and len({parts[-1] for parts in names}) == 1:
        for parts in names:
            parts.pop()
    last_parts = [parts[-1] for parts in names if parts]
    if len(set(last_parts)) < len(paths):
        return list(map(str, paths))
    return last_parts


def fixed_text(value: float, digits: int, sign: str = "") -> str:
    """Return a number as text with `digits` decimals, a minus sign, and no sign on zero.

    With `sign="+"`, positive numbers have a plus sign.
    """
    rounded = round(float(value), digits) + 0.0  # adding 0.0 removes a negative zero
    text = with_minus(f"{rounded:.{digits}f}")
    return sign + text if rounded > 0 else text


def number_text(value: float | None, digits: int = 1, sign: str = "") -> str:
    """Return a number like `fixed_text`; a dash for None and NaN, `never` for infinity."""
    if value is None or math.isnan(value):
        return "–"
    if math.isinf(value):
        return "never"
    return fixed_text(value, digits, sign)


def interval_text(low: float | None, high: float | None, digits: int = 3, sign: str = "") -> str:
    """Return an interval, such as `[0.25, 0.50]`; a dash if an end is None or NaN."""
    ends = [number_text(end, digits, sign) for end in (low, high)]
    if "–" in ends:
        return "–"
    return f"[{ends[0]}, {ends[1]}]"


def share_text(count: int, total: int) -> str:
    """Return a count, and its share in percent: `1,200 ( 12 %)`."""
    percent = 0
    if total:
        percent = round(100 * count / total)
    return f"{count:,} ({percent:>3} %)"


def counted(count: int, word: str) -> str:
    """Return a number with its noun: `1 scenario`, `1,200 scenarios`, `3 boxes`."""
    if count == 1:
        return f"1 {word}"
    ending = "es" if word.endswith("x") else "s"
    return f"{count:,} {word}{ending}"


def size_text(count: int) -> str:
    """Return a number of bytes as text, in GB, MB, kB or B, whichever suits its size.

    >>> size_text(310_000_000_000), size_text(26_500), size_text(999)
    ('310.0 GB', '26.5 kB', '999 B')
    """
    for unit, name in ((1e9, "GB"), (1e6, "MB"), (1e3, "kB")):
        if count >= unit:
            return f"{count / unit:,.1f} {name}"
    return f"{count} B"


def possible_text(wrong: str, possible: Iterable[str]) -> str:
    """Return a list of the possible words for a message.

    If there are more than twenty, the words most similar to `wrong` come first, and the list ends
    with the number of further words.
    """
    words = list(possible)
    if len(words) <= _MAX_WORDS:
        return ", ".join(words)
    word_by_lower = {word.lower(): word for word in words}
    similar = get_close_matches(wrong.lower(), word_by_lower, n=3)
    similar_words = [word_by_lower[word] for word in similar]
    ordered = list(dict.fromkeys(similar_words + words))
    return f"{', '.join(ordered[:_MAX_WORDS])} and {len(ordered) - _MAX_WORDS} more"


def meant_text(wrong: object, possible: Iterable[object]) -> str:
    """Return the end of a message that suggests a word, such as `; did you mean 'left'?`.

    It is empty if no possible word is similar to the wrong one.
    """
    word_by_lower = {word.lower(): word for word in possible if isinstance(word, str)}
    if not isinstance(wrong, str) or not wrong:
        return ""
    start = wrong.lower()
    similar = get_close_matches(start, word_by_lower, n=1)
    if not similar:
        similar = [word for word in word_by_lower if word.startswith(start)]
    if not similar:
        similar = [
            word
            for word in word_by_lower
            if len(word) >= _MIN_STEM_LENGTH and start.startswith(word)
        ]
    if similar:
        return f"; did you mean {word_by_lower[similar[0]]!r}?"
    return ""


def match_spelling(value: Any, words: Iterable[str]) -> Any:
    """Return the word that equals a text, ignoring case; the value itself if none does."""
    if isinstance(value, str):
        for word in words:
            if word.lower() == value.lower():
                return word
    return value


def differing_text(actual: ReadOnlyValues, expected: ReadOnlyValues) -> str:
    """Return which values differ, such as `training/steps: 2, asked for 3; …`; empty if none do."""
    expected_json = json.loads(json.dumps(expected))  # tuples are lists in a file
    actual_values = dict(_walk_leaves(actual))
    expected_values = dict(_walk_leaves(expected_json))
    differing = sorted(
        name
        for name in {*actual_values, *expected_values}
        if actual_values.get(name) != expected_values.get(name)
    )
    differences = []
    for name in differing[:_MAX_DIFFERENCES]:
        actual_text = shortened(repr(actual_values.get(name)))
        expected_text = shortened(repr(expected_values.get(name)))
        differences.append(f"{name}: {actual_text}, asked for {expected_text}")
    if len(differing) > _MAX_DIFFERENCES:
        differences.append(f"and {len(differing) - _MAX_DIFFERENCES} more")
    return "; ".join(differences)


def _walk_leaves(values: ReadOnlyValues, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the path and the value of each leaf of nested mappings."""
    for name, value in values.items():
        if isinstance(value, dict) and value:
            yield from _walk_leaves(value, f"{prefix}{name}/")
        else:
            yield f"{prefix}{name}", value


def choice(
    name: str,
    value: object,
    words: Collection[AnyText],
    *,
    error: type[DeepAccidentError] = ChoiceError,
    elsewhere: Mapping[str, str] = MappingProxyType({}),
    also: str = "",
) -> AnyText:
    """Return the word in `words` that `value` matches; raise ChoiceError if there is none.

    Case is ignored, and the result has the spelling in `words`. None may be one of the words.

    Args:
        name: Name of the argument.
        value: Value that the caller passes.
        words: Possible words.
        error: Class of error to raise instead of ChoiceError.
        elsewhere: Word that is valid in another place → hint for it.
        also: Text about what can be passed instead of a word.
    """
    expected = [word for word in words if word is not None]
    spelled_word: AnyText = match_spelling(value, expected)
    if any(spelled_word is word for word in words):
        return spelled_word
    none_text = ", or None" if len(expected) < len(words) else ""
    hint = elsewhere.get(str(value).lower()) or meant_text(value, expected)
    raise error(
        f"{name}: expected one of {', '.join(expected)}{none_text}{also}, found {value!r}{hint}"
    )


def members_of(
    argument: str, value: object, expected: str, *, error: type[DeepAccidentError] = ChoiceError
) -> list[Any]:
    """Return the members of a collection that a caller passes.

    A single text or record is a collection of one.

    Raises:
        ChoiceError: If `value` is not a collection; `error` is raised instead if it is passed.
    """
    if isinstance(value, str | Mapping):
        return [value]
    if not isinstance(value, Iterable):
        raise error(f"{argument}: expected {expected}, found {value!r}")
    return list(value)


def choices(
    argument: str,
    value: object,
    words: Collection[AnyText],
    *,
    empty: bool = False,
    error: type[DeepAccidentError] = ChoiceError,
) -> tuple[AnyText, ...]:
    """Return the words in `words` that the caller's values match, in the caller's order.

    A single word needs no list.

    Raises:
        ChoiceError: If a value matches no word, or there is no value and `empty` is False; `error`
            is raised instead if it is passed.
    """
    expected = f"some of {', '.join(map(str, words))}"
    members = members_of(argument, value, expected, error=error)
    if not (members or empty):
        raise error(f"{argument}: expected {expected}, found none")
    return tuple(choice(argument, member, words, error=error) for member in members)


def settle_choices(
    record: object,
    words: Mapping[str, Collection[str | None]],
    *,
    error: type[DeepAccidentError] = ChoiceError,
) -> None:
    """Replace words in fields of a new frozen dataclass with their canonical spelling.

    The errors are as in `choice`.
    """
    for name, possible in words.items():
        word = choice(name, getattr(record, name), possible, error=error)
        object.__setattr__(record, name, word)


def path_text(
    value: object,
    expected: str = "expected a path",
    *,
    error: type[DeepAccidentError] = ConfigError,
) -> str:
    """Return the text of a path that a caller passes as a text or as a path object.

    Raises `error` for an empty text, and for a text that cannot be the name of a file. `expected`
    is how the message begins, such as `out: expected a folder`.
    """
    with suppress(TypeError, ValueError, RuntimeError):  # not a path; `~` of no user
        text = os.fspath(value)  # type: ignore[call-overload]
        if isinstance(text, str) and text and b"\0" not in os.fsencode(Path(text).expanduser()):
            return text
    actual = shortened(repr(value))
    if value == "":
        actual = "an empty path; give '.' for the current one"
    raise error(f"{expected}, found {actual}")


def path_of(
    value: object,
    expected: str = "expected a path",
    *,
    error: type[DeepAccidentError] = ConfigError,
) -> Path:
    """Return a path that a caller passes, with `~` replaced by the home folder; see `path_text`."""
    return Path(path_text(value, expected, error=error)).expanduser()
