"""Text for people and by them: columns, numbers, words in any case, paths, what was probably meant."""

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
# Words that a message lists at most.
_LISTED = 20
# Letters of the shortest word that is meant by a longer one which begins with it, as `val` by `validation`.
_STEM = 3
# Differing values that a message shows at most.
_DIFFERING = 3
_NUMBER: Final = re.compile(
    r"[+-]?((\d+\.?\d*|\.\d+)(e[+-]?\d+)?|nan|inf|infinity)", re.ASCII | re.IGNORECASE
)
_INTEGER: Final = re.compile(r"(-?)0*(\d{1,19})", re.ASCII)


@cache
def warn_once(text: str) -> None:
    """Log a warning once, and not in a worker process, whose parent says it."""
    import multiprocessing

    if multiprocessing.parent_process() is None:
        logging.getLogger(__name__).warning("%s", text)


def columns_text(rows: Sequence[Sequence[str]], *, left: int = 1) -> str:
    """Lines of aligned columns: the first `left` flush left, the others flush right; the first row is the heading."""
    widths = [max(len(word) for word in column) for column in zip(*rows, strict=True)]
    lines = []
    for row in rows:
        cells = map(str.ljust, row[:left], widths), map(str.rjust, row[left:], widths[left:])
        lines.append("  ".join(chain(*cells)).rstrip())
    return "\n".join(lines)


def natural_order(value: str | None) -> tuple[bool, float, str]:
    """A key that sorts words: numbers and those that begin with one (`2 s`) by size, then others; unknown ones last."""
    text = "none" if value is None else value
    number = math.inf
    with suppress(ValueError):
        number = float(text.split(" ")[0])
    return text == "none", number, text


class Pictured:
    """Base of what a notebook shows with a picture above its text; without a picture, it shows the text alone."""

    __slots__ = ()

    png_of: ClassVar[Callable[[object], bytes]]
    """Makes the picture. The package's `__init__` sets it, since who renders is in a layer above."""

    def _repr_html_(self) -> str:
        html = f"<pre>{escape(repr(self))}</pre>"
        with suppress(Exception):  # a picture is an extra
            content = base64.b64encode(Pictured.png_of(self)).decode("ascii")
            html = f'<img src="data:image/png;base64,{content}" alt="seen from above">{html}'
        return html


def number_of(word: str) -> float | None:
    """The number that a word of any length says, NaN and infinity included; None if it says none."""
    return float(word) if _NUMBER.fullmatch(word) else None


def integer_of(word: str) -> int | None:
    """The integer of 64 bits that a word says; None if it says none. Python itself reads no more than 4,300 digits."""
    found = _INTEGER.fullmatch(word)
    value = int(found[1] + found[2]) if found else 2**63
    return value if -(2**63) <= value < 2**63 else None


def fixed_text(value: float, digits: int) -> str:
    """A number with so many decimals, and no sign on zero."""
    return f"{round(float(value), digits) + 0.0:.{digits}f}"


def number_text(value: float | None, digits: int = 1) -> str:
    """A number with so many decimals; a dash for None and NaN, `never` for an infinite one."""
    if value is None or math.isnan(value):
        return "–"
    return "never" if math.isinf(value) else fixed_text(value, digits)


def share_text(count: int, total: int) -> str:
    """A count, and its share in percent: `1,200 ( 12 %)`."""
    return f"{count:,} ({round(100 * count / total) if total else 0:>3} %)"


def counted(count: int, word: str) -> str:
    """A number and what it is of: `1 scenario`, `1,200 scenarios`."""
    return f"{count:,} {word}{'' if count == 1 else 's'}"


def size_text(count: int) -> str:
    """Bytes in GB, or in MB, kB or B if there are few.

    >>> size_text(310_000_000_000), size_text(26_500), size_text(999)
    ('310.0 GB', '26.5 kB', '999 B')
    """
    for unit, name in ((1e9, "GB"), (1e6, "MB"), (1e3, "kB")):
        if count >= unit:
            return f"{count / unit:,.1f} {name}"
    return f"{count} B"


def possible_text(wrong: str, possible: Iterable[str]) -> str:
    """The possible words in a line; of more than twenty, those most like `wrong` first, and how many more there are."""
    words = list(possible)
    if len(words) <= _LISTED:
        return ", ".join(words)
    lowered = {word.lower(): word for word in words}
    close = [lowered[word] for word in get_close_matches(wrong.lower(), lowered, n=3)]
    ordered = list(dict.fromkeys([*close, *words]))
    return f"{', '.join(ordered[:_LISTED])} and {len(ordered) - _LISTED} more"


def meant_text(wrong: object, possible: Iterable[object]) -> str:
    """Such as `; did you mean 'left'?`, the end of a message; empty if no possible word is like the wrong one."""
    lowered = {word.lower(): word for word in possible if isinstance(word, str)}
    if not isinstance(wrong, str) or not wrong:
        return ""
    start = wrong.lower()
    close = get_close_matches(start, lowered, n=1) or [
        word for word in lowered if word.startswith(start)
    ]
    close = close or [word for word in lowered if len(word) >= _STEM and start.startswith(word)]
    return f"; did you mean {lowered[close[0]]!r}?" if close else ""


def spelled(value: Any, words: Iterable[str]) -> Any:
    """The one of some words that a text is, in whatever case of letters; the value itself if no word is like it."""
    lowered = value.lower() if isinstance(value, str) else None
    return next((word for word in words if word.lower() == lowered), value)


def differing_text(there: Mapping[str, Any], asked: Mapping[str, Any]) -> str:
    """`training/steps: 2, asked for 3; …`: which values differ from those asked for, the first ones; empty if none."""
    has, wanted = (
        dict(_leaves(there)),
        dict(_leaves(json.loads(json.dumps(asked)))),
    )  # tuples are lists in a file
    changed = sorted(name for name in {*has, *wanted} if has.get(name) != wanted.get(name))
    differences = [
        f"{name}: {shortened(repr(has.get(name)))}, asked for {shortened(repr(wanted.get(name)))}"
        for name in changed[:_DIFFERING]
    ]
    if len(changed) > _DIFFERING:
        differences.append(f"and {len(changed) - _DIFFERING} more")
    return "; ".join(differences)


def _leaves(values: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, dict) and value:
            yield from _leaves(value, f"{above}{name}/")
        else:
            yield f"{above}{name}", value


def choice(
    name: str,
    value: object,
    words: Collection[AnyText],
    *,
    error: type[DeepAccidentError] = ChoiceError,
    elsewhere: Mapping[str, str] = MappingProxyType({}),
    also: str = "",
) -> AnyText:
    """The one of some words, None perhaps among them, that a caller means, in its own spelling; else ChoiceError.

    Small letters may stand for capital ones. `error` is another kind of error; `elsewhere` says of words that mean
    something in another place what to do with them; `also` says what can be given instead of a word.
    """
    expected = [word for word in words if word is not None]
    chosen: AnyText = spelled(value, expected)
    if any(chosen is word for word in words):
        return chosen
    none = ", or None" if len(expected) < len(words) else ""
    meant = elsewhere.get(str(value).lower()) or meant_text(value, expected)
    raise error(
        f"{name}: expected one of {', '.join(expected)}{none}{also}, found {value!r}{meant}"
    )


def members_of(
    argument: str, given: object, expected: str, *, error: type[DeepAccidentError] = ChoiceError
) -> list[Any]:
    """Return the members of a collection that a caller passes; a single text or record is a collection of one.

    Raises:
        ChoiceError: it is no collection; or another kind of error.
    """
    if isinstance(given, str | Mapping):
        return [given]
    if not isinstance(given, Iterable):
        raise error(f"{argument}: expected {expected}, found {given!r}")
    return list(given)


def choices(
    argument: str,
    given: object,
    words: Collection[AnyText],
    *,
    empty: bool = False,
    error: type[DeepAccidentError] = ChoiceError,
) -> tuple[AnyText, ...]:
    """Return some of the possible words, in the caller's order and in their own spelling; a single one needs no list.

    Raises:
        ChoiceError: a word is not possible, or there is none although `empty` is False; or another kind of error.
    """
    expected = f"some of {', '.join(map(str, words))}"
    members = members_of(argument, given, expected, error=error)
    if not (members or empty):
        raise error(f"{argument}: expected {expected}, found none")
    return tuple(choice(argument, member, words, error=error) for member in members)


def settle_choices(
    record: object,
    words: Mapping[str, Collection[str | None]],
    *,
    error: type[DeepAccidentError] = ChoiceError,
) -> None:
    """Give fields of a frozen dataclass, while it is made, the spelling of their words; the errors are `choice`'s."""
    for name, possible in words.items():
        object.__setattr__(record, name, choice(name, getattr(record, name), possible, error=error))


def path_text(
    given: object,
    expected: str = "expected a path",
    *,
    error: type[DeepAccidentError] = ConfigError,
) -> str:
    """The text of what a caller gives as a path: a text, or a path object of one; else ConfigError, or another kind.

    `expected` is how the message begins, such as `out: expected a folder`. An empty one is refused, and what no file
    can be named.
    """
    with suppress(TypeError, ValueError, RuntimeError):  # no path; half a character; `~` of nobody
        text = os.fspath(given)  # type: ignore[call-overload]
        if isinstance(text, str) and text and b"\0" not in os.fsencode(Path(text).expanduser()):
            return text
    found = "an empty path; give '.' for the current one" if given == "" else shortened(repr(given))
    raise error(f"{expected}, found {found}")


def path_of(
    given: object,
    expected: str = "expected a path",
    *,
    error: type[DeepAccidentError] = ConfigError,
) -> Path:
    """What a caller gives as a path, with `~` for the home folder; takes and raises what `path_text` does."""
    return Path(path_text(given, expected, error=error)).expanduser()
