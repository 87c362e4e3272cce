"""Text for people: aligned columns for a terminal, HTML for a notebook, messages that name what was probably meant."""

import base64
import math
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from difflib import get_close_matches
from html import escape
from typing import ClassVar

_LISTED = 20
"""Words that a message lists at most."""


def columns_text(rows: Sequence[Sequence[str]], *, left: int = 1) -> str:
    """Lines of aligned columns: the first `left` flush left, the others flush right; the first row is the heading."""
    widths = [max(len(word) for word in column) for column in zip(*rows, strict=True)]
    lines = []
    for row in rows:
        cells = [f"{word:<{width}}" for word, width in zip(row[:left], widths, strict=False)]
        cells += [f"{word:>{width}}" for word, width in zip(row[left:], widths[left:], strict=True)]
        lines.append("  ".join(cells).rstrip())
    return "\n".join(lines)


def natural_order(value: str | None) -> tuple[bool, float, str]:
    """A key that sorts words: numbers and those that begin with one (`2 s`) by size, then others; unknown ones last."""
    text = "none" if value is None else value
    try:
        return text == "none", float(text.split(" ")[0]), text
    except ValueError:
        return text == "none", math.inf, text


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


def rows_html(rows: Sequence[Sequence[str]], caption: str = "") -> str:
    """A table for a notebook; the first row is the heading."""
    cells = [
        "".join(f"<{kind}>{escape(word)}</{kind}>" for word in row)
        for kind, row in zip(["th", *["td"] * (len(rows) - 1)], rows, strict=True)
    ]
    return f"<table><caption>{escape(caption)}</caption>{''.join(f'<tr>{each}</tr>' for each in cells)}</table>"


def fixed_text(value: float, digits: int) -> str:
    """A number with so many decimals, and no sign on zero."""
    return f"{round(float(value), digits) + 0.0:.{digits}f}"


def possible_text(wrong: str, possible: Iterable[str]) -> str:
    """The possible words in a line, those most like `wrong` first; of many, the first twenty and how many more."""
    words = list(possible)
    lowered = {word.lower(): word for word in words}
    close = [lowered[word] for word in get_close_matches(wrong.lower(), lowered, n=3)]
    ordered = list(dict.fromkeys([*close, *words]))
    more = f" and {len(ordered) - _LISTED} more" if len(ordered) > _LISTED else ""
    return ", ".join(ordered[:_LISTED]) + more
