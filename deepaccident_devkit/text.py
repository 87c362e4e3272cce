"""Text for people: aligned columns for a terminal, and messages that name what was probably meant."""

from collections.abc import Iterable, Sequence
from difflib import get_close_matches

_LISTED = 20
"""Words that a message lists at most."""


def columns_text(rows: Sequence[Sequence[str]]) -> str:
    """Lines of aligned columns: the first flush left, the others flush right; the first row is the heading."""
    widths = [max(len(word) for word in column) for column in zip(*rows, strict=True)]
    lines = []
    for first, *others in rows:
        cells = [f"{first:<{widths[0]}}", *(f"{word:>{width}}" for word, width in zip(others, widths[1:], strict=True))]
        lines.append("  ".join(cells).rstrip())
    return "\n".join(lines)


def possible_text(wrong: str, possible: Iterable[str]) -> str:
    """The possible words in a line, those most like `wrong` first; of many, the first twenty and how many more."""
    words = list(possible)
    lowered = {word.lower(): word for word in words}
    close = [lowered[word] for word in get_close_matches(wrong.lower(), lowered, n=3)]
    ordered = list(dict.fromkeys([*close, *words]))
    more = f" and {len(ordered) - _LISTED} more" if len(ordered) > _LISTED else ""
    return ", ".join(ordered[:_LISTED]) + more
