"""HTML out of plain values: whatever is not `Markup` already is escaped, so that no name can smuggle in tags."""

from __future__ import annotations

import html
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

_VOID: Final = ("img", "meta")
_MOST_DIGITS: Final = 6
_LONG: Final = 40
"""Letters of what is no more a name."""


class Markup(str):
    """Text that is HTML already."""

    __slots__ = ()


def tag(name: str, *content: str, **attributes: str) -> Markup:
    """An element.

    Args:
        name: of the element.
        *content: texts, which are escaped, and `Markup`.
        **attributes: their values are escaped; `class_` is `class`.
    """
    written = "".join(
        f' {key.rstrip("_").replace("_", "-")}="{html.escape(value)}"' for key, value in attributes.items()
    )
    start = f"<{name}{written}>"
    return Markup(start if name in _VOID else f"{start}{joined(content)}</{name}>")


def joined(parts: Iterable[str]) -> Markup:
    """Texts, which are escaped, and `Markup` behind one another."""
    return Markup("".join(part if isinstance(part, Markup) else html.escape(part) for part in parts))


def table(heading: Sequence[str], rows: Iterable[Sequence[str]], caption: str = "") -> Markup:
    """A table in a box that scrolls where it is too wide; the first column is the rows' heading."""
    head = tag("tr", *(tag("th", each, scope="col") for each in heading))
    body = [tag("tr", tag("th", first, scope="row"), *map(_cell, others)) for first, *others in rows]
    above = [tag("caption", caption)] if caption else []
    parts = tag("table", *above, tag("thead", head), tag("tbody", *body))
    return tag("div", parts, class_="wide")


def facts(values: Mapping[str, str]) -> Markup:
    """Names with their values, one below the other."""
    return tag("dl", *(tag("div", tag("dt", name), tag("dd", value)) for name, value in values.items()))


def tree(value: Any) -> Markup:
    """Whatever JSON holds: mappings as tables of names, lists of mappings as tables of columns, the rest as text."""
    if isinstance(value, Mapping):
        if not value:
            return joined(["none"])
        return tag(
            "table",
            *(tag("tr", tag("th", str(name), scope="row"), tag("td", tree(each))) for name, each in value.items()),
            class_="tree",
        )
    if isinstance(value, list | tuple):
        return _list(value)
    return joined([scalar(value)])


def scalar(value: Any) -> str:
    """A value as text: numbers with few digits, a dash for what is not known."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.{_MOST_DIGITS}g}" if isinstance(value, float) else str(value)


def _cell(content: str) -> Markup:
    """Numbers and names stay on a line, sentences do not."""
    is_sentence = "<" not in content and len(content) > _LONG
    return tag("td", content, class_="long") if is_sentence else tag("td", content)


def _list(values: Sequence[Any]) -> Markup:
    if not values:
        return joined(["none"])
    if all(isinstance(each, Mapping) and each for each in values):
        names = list(dict.fromkeys(str(name) for each in values for name in each))
        return table(names, [[tree(each.get(name)) if name in each else "" for name in names] for each in values])
    if any(isinstance(each, Mapping) for each in values):
        return tag("ul", *(tag("li", tree(each)) for each in values))
    rows = [", ".join(map(scalar, each)) if isinstance(each, list | tuple) else scalar(each) for each in values]
    return joined(["; ".join(rows) if any(isinstance(each, list | tuple) for each in values) else ", ".join(rows)])
