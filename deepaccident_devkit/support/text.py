"""Texts for people and from people: columns, numbers, words in any case, paths, and suggestions."""

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
from itertools import chain
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar, Final, TypeVar

from deepaccident_devkit.errors import ChoiceError, ConfigError, DeepAccidentError, shortened

AnyText = TypeVar("AnyText", bound=str | None)
# Largest number of words that a message lists.
_MAX_WORDS = 20
# Smallest number of letters of a word that a longer one suggests, as `validation` suggests `val`.
_MIN_STEM_LENGTH = 3
# Largest number of differing values that a message shows.
_MAX_DIFFERENCES = 3
_NUMBER: Final = re.compile(
    r"[+-]?((\d+\.?\d*|\.\d+)(e[+-]?\d+)?|nan|inf|infinity)", re.ASCII | re.IGNORECASE
)
_INTEGER: Final = re.compile(r"(-?)0*(\d{1,19})", re.ASCII)


@cache
def warn_once(text: str) -> None:
    """Log a warning once, and not in a worker process, since its parent logs it."""
    import multiprocessing

    if multiprocessing.parent_process() is None:
        logging.getLogger(__name__).warning("%s", text)


def columns_text(rows: Sequence[Sequence[str]], *, left: int = 1) -> str:
    """Return lines of aligned columns; the first row is the heading.

    The first `left` columns are flush left, the others flush right.
    """
    widths = [max(len(word) for word in column) for column in zip(*rows, strict=True)]
    lines = []
    for row in rows:
        cells = map(str.ljust, row[:left], widths), map(str.rjust, row[left:], widths[left:])
        lines.append("  ".join(chain(*cells)).rstrip())
    return "\n".join(lines)


def natural_order(value: str | None) -> tuple[bool, float, str]:
    """Return a key that sorts words.

    Numbers and words that begin with one (`2 s`) come first, by size, then others; unknown ones
    come last.
    """
    text = "none" if value is None else value
    number = math.inf
    with suppress(ValueError):
        number = float(text.split(" ")[0])
    return text == "none", number, text


class Pictured:
    """Base of objects that a notebook shows with a picture above their text, if there is one."""

    __slots__ = ()

    png_of: ClassVar[Callable[[object], bytes]]
    """Makes the picture. The package's `__init__` sets it, because rendering is a higher layer."""

    def _repr_html_(self) -> str:
        html = f"<pre>{escape(repr(self))}</pre>"
        with suppress(Exception):  # a picture is an extra
            content = base64.b64encode(Pictured.png_of(self)).decode("ascii")
            html = f'<img src="data:image/png;base64,{content}" alt="seen from above">{html}'
        return html


def number_of(word: str) -> float | None:
    """Return the number that a word is, NaN and infinity included; None if it is none."""
    if _NUMBER.fullmatch(word):
        return float(word)
    return None


def integer_of(word: str) -> int | None:
    """Return the 64-bit integer that a word is; None if it is none.

    Python itself reads no more than 4,300 digits.
    """
    match = _INTEGER.fullmatch(word)
    value = int(match[1] + match[2]) if match else 2**63
    if -(2**63) <= value < 2**63:
        return value
    return None


def fixed_text(value: float, digits: int) -> str:
    """Return a number with a number of decimals, and no sign on zero."""
    return f"{round(float(value), digits) + 0.0:.{digits}f}"


def number_text(value: float | None, digits: int = 1) -> str:
    """Return a number with some decimals; a dash for None and NaN, `never` for an infinite one."""
    if value is None or math.isnan(value):
        return "–"
    if math.isinf(value):
        return "never"
    return fixed_text(value, digits)


def share_text(count: int, total: int) -> str:
    """Return a count, and its share in percent: `1,200 ( 12 %)`."""
    percent = round(100 * count / total) if total else 0
    return f"{count:,} ({percent:>3} %)"


def counted(count: int, word: str) -> str:
    """Return a number with its noun: `1 scenario`, `1,200 scenarios`."""
    return f"{count:,} {word}{'' if count == 1 else 's'}"


def size_text(count: int) -> str:
    """Return bytes in GB, or in MB, kB or B if there are few.

    >>> size_text(310_000_000_000), size_text(26_500), size_text(999)
    ('310.0 GB', '26.5 kB', '999 B')
    """
    for unit, name in ((1e9, "GB"), (1e6, "MB"), (1e3, "kB")):
        if count >= unit:
            return f"{count / unit:,.1f} {name}"
    return f"{count} B"


def possible_text(wrong: str, possible: Iterable[str]) -> str:
    """Return the possible words in a line.

    Of more than twenty, it lists the words most similar to `wrong` first, and how many more there
    are.
    """
    words = list(possible)
    if len(words) <= _MAX_WORDS:
        return ", ".join(words)
    word_by_lower = {word.lower(): word for word in words}
    similar = get_close_matches(wrong.lower(), word_by_lower, n=3)
    ordered = list(dict.fromkeys([*(word_by_lower[word] for word in similar), *words]))
    return f"{', '.join(ordered[:_MAX_WORDS])} and {len(ordered) - _MAX_WORDS} more"


def meant_text(wrong: object, possible: Iterable[object]) -> str:
    """Return the end of a message, such as `; did you mean 'left'?`.

    Empty if no possible word is similar to the wrong one.
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


def spelled(value: Any, words: Iterable[str]) -> Any:
    """Return the word that a text is, in whatever case of letters; the value itself if none is."""
    lowered = value.lower() if isinstance(value, str) else None
    return next((word for word in words if word.lower() == lowered), value)


def differing_text(actual: Mapping[str, Any], expected: Mapping[str, Any]) -> str:
    """Return which values differ: `training/steps: 2, asked for 3; …`; empty if none do."""
    expected_json = json.loads(json.dumps(expected))  # tuples are lists in a file
    actual_values, expected_values = dict(_leaves(actual)), dict(_leaves(expected_json))
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


def _leaves(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, dict) and value:
            yield from _leaves(value, f"{prefix}{name}/")
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
    """Return the word that a caller means, in its own spelling; or raise ChoiceError.

    Small letters may stand for capital ones. None may be one of the words.

    Args:
        name: Name of the argument.
        value: Value that the caller passes.
        words: Possible words.
        error: Another kind of error.
        elsewhere: Word with a meaning in another place → what to do with it.
        also: What can be given instead of a word.
    """
    expected = [word for word in words if word is not None]
    spelled_word: AnyText = spelled(value, expected)
    if any(spelled_word is word for word in words):
        return spelled_word
    none = ", or None" if len(expected) < len(words) else ""
    hint = elsewhere.get(str(value).lower()) or meant_text(value, expected)
    raise error(f"{name}: expected one of {', '.join(expected)}{none}{also}, found {value!r}{hint}")


def members_of(
    argument: str, value: object, expected: str, *, error: type[DeepAccidentError] = ChoiceError
) -> list[Any]:
    """Return the members of a collection that a caller passes.

    A single text or record is a collection of one.

    Raises:
        ChoiceError: It is no collection; or another kind of error.
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
    """Return some of the possible words, in the caller's order and in their own spelling.

    A single one needs no list.

    Raises:
        ChoiceError: A word is not possible, or there is none although `empty` is False; or another
            kind of error.
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
    """Set fields of a new frozen dataclass to the spelling of their words; raise as `choice`."""
    for name, possible in words.items():
        word = choice(name, getattr(record, name), possible, error=error)
        object.__setattr__(record, name, word)


def path_text(
    value: object,
    expected: str = "expected a path",
    *,
    error: type[DeepAccidentError] = ConfigError,
) -> str:
    """Return the text of a path that a caller passes: a text, or a path object of one.

    Raises ConfigError, or another kind of error, for an empty text, and for a text that cannot be
    the name of a file. `expected` is how the message begins, such as `out: expected a folder`.
    """
    with suppress(TypeError, ValueError, RuntimeError):  # no path; half a character; `~` of nobody
        text = os.fspath(value)  # type: ignore[call-overload]
        if isinstance(text, str) and text and b"\0" not in os.fsencode(Path(text).expanduser()):
            return text
    actual = (
        "an empty path; give '.' for the current one" if value == "" else shortened(repr(value))
    )
    raise error(f"{expected}, found {actual}")


def path_of(
    value: object,
    expected: str = "expected a path",
    *,
    error: type[DeepAccidentError] = ConfigError,
) -> Path:
    """Return a path that a caller passes, with `~` for the home folder; see `path_text`."""
    return Path(path_text(value, expected, error=error)).expanduser()
