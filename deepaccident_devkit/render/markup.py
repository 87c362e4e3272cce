"""HTML from plain values: all text that is not `Markup` is escaped, so no name can add tags."""

from __future__ import annotations

import base64
import hashlib
import html
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

from deepaccident_devkit.render.theme import LIGHT

_VOID: Final = ("br", "img", "meta")
_MOST_DIGITS: Final = 6
_JOINTS: Final = re.compile(r"(?<=[/_=])(?=\w)|(?=@)")
"""Where a name may be broken."""
_LONG: Final = 40
"""A text with more letters than this is not a name."""


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
    """Texts, which are escaped, and `Markup`, one after another."""
    return Markup("".join(part if isinstance(part, Markup) else html.escape(part) for part in parts))


def breakable(text: str) -> Markup:
    """A text, escaped, whose names may be broken after `/`, `_` and `=` and before `@`; `Markup` as it is."""
    return text if isinstance(text, Markup) else Markup("<wbr>".join(map(html.escape, _JOINTS.split(text))))


def table(heading: Sequence[str], rows: Iterable[Sequence[str]], caption: str = "") -> Markup:
    """A table in a box that scrolls if the table is too wide; the first column has the rows' headings."""
    head = tag("tr", *(tag("th", breakable(each), scope="col") for each in heading))
    body = [tag("tr", tag("th", breakable(first), scope="row"), *map(_cell, others)) for first, *others in rows]
    above = [tag("caption", caption)] if caption else []
    parts = tag("table", *above, tag("thead", head), tag("tbody", *body))
    return tag("div", parts, class_="wide")


def facts(values: Mapping[str, str]) -> Markup:
    """Names with their values, one below the other."""
    return tag(
        "dl", *(tag("div", tag("dt", breakable(name)), tag("dd", breakable(value))) for name, value in values.items())
    )


def tree(value: Any) -> Markup:
    """Any JSON value: mappings as tables of names, lists of mappings as tables of columns, the rest as text."""
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
    """A value as text: numbers with few digits, a dash for an unknown value."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.{_MOST_DIGITS}g}" if isinstance(value, float) else str(value)


def number(value: Any) -> str:
    """A result as text: three decimals, and three digits from 10 on; whole numbers whole; a dash for an unknown one."""
    if isinstance(value, list | tuple):
        return ("; " if any(isinstance(each, list | tuple) for each in value) else ", ").join(map(number, value))
    if isinstance(value, bool | str) or value is None or not math.isfinite(value):
        return scalar(value)
    if value == round(value):
        return f"{value:,.0f}"
    return f"{value:.3f}" if abs(value) < 10 else f"{value:.3g}" if abs(value) < 1000 else f"{value:,.0f}"


def _cell(content: str) -> Markup:
    """Numbers and names stay on one line, sentences may have several."""
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


_POLICY: Final = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
"""A browser loads nothing and runs nothing, even if a name in the results tries to."""
STYLE: Final = (
    LIGHT
    + """
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 1rem 1.25rem 3rem; max-width: 76rem; background: var(--paper); color: var(--ink);
  font: 16px/1.5 system-ui, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; overflow-wrap: break-word; }
h1 { font-size: 1.7rem; line-height: 1.2; margin: .6rem 0 .4rem; }
h2 { font-size: 1.25rem; margin: 2.2rem 0 .6rem; padding-bottom: .2rem; border-bottom: 2px solid var(--rule); }
h3 { font-size: 1rem; margin: 1.4rem 0 .4rem; }
p { margin: .4rem 0; max-width: 46rem; }
nav a { display: inline-block; margin: 0 .9rem .3rem 0; }
a { color: var(--link); }
dl { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 28rem), 1fr)); gap: 0 2rem;
  margin: .6rem 0; }
dl div { display: flex; gap: .8rem; padding: .2rem 0; border-bottom: 1px solid var(--line); min-width: 0; }
dt { flex: 0 0 8.5rem; color: var(--dim); }
dd { margin: 0; min-width: 0; }
.wide { overflow-x: auto; max-width: 100%; }
table { border-collapse: collapse; font-size: .86rem; font-variant-numeric: tabular-nums; }
caption { text-align: left; color: var(--dim); padding: .2rem 0; }
th, td { padding: .28rem .6rem .28rem 0; text-align: right; vertical-align: top; border-bottom: 1px solid var(--line);
  overflow-wrap: normal; }
thead th { border-bottom: 2px solid var(--rule); font-weight: 600; }
th:first-child { text-align: left; font-weight: 500; }
@media (min-width: 700px) { .wide th:first-child { position: sticky; left: 0; background: var(--paper); } }
.text td, .text th, .tree td, .tree th { text-align: left; overflow-wrap: break-word; }
.wide td { white-space: nowrap; }
.wide.text td, .wide .interval { white-space: normal; }
.wide .interval { min-width: 5em; }
.wide td.long { white-space: normal; text-align: left; min-width: 18rem; }
.big td { font-size: 1.02rem; font-weight: 600; }
.big td ~ td { font-weight: 400; color: var(--soft); font-size: .92rem; }
.interval { color: var(--dim); font-size: .82rem; font-weight: 400; }
.figures { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 28rem), 1fr)); gap: 1.4rem; }
figure { margin: 0; }
figure img { width: 100%; height: auto; border: 1px solid var(--line); }
figcaption { font-size: .9rem; color: var(--soft); }
.partial { color: var(--paper); background: var(--warning); font-weight: 600; padding: .35rem .7rem;
  max-width: none; }
.warning { border-left: .3rem solid var(--warning); padding-left: .7rem; }
summary { cursor: pointer; padding: .3rem 0; }
code { font: .9em/1.4 ui-monospace, "DejaVu Sans Mono", Menlo, Consolas, monospace; background: var(--block);
  padding: .1em .3em; }
footer { margin-top: 3rem; color: var(--dim); font-size: .88rem; }
@page { size: A4 landscape; margin: 12mm; }
@media print {
  body { max-width: none; padding: 0; font-size: 10.5pt; }
  nav { display: none; }
  .wide { overflow: visible; }
  .wide td { white-space: normal; }
  table { font-size: 7.5pt; }
  th, td { padding-right: .5rem; }
  figcaption { font-size: 9pt; }
  figure, tr, .partial { break-inside: avoid; }
  h2, h3 { break-after: avoid; }
  .partial { print-color-adjust: exact; -webkit-print-color-adjust: exact; }
  .figures { grid-template-columns: 1fr 1fr; gap: .8rem; }
  .big td, .big td ~ td { font-size: inherit; }
}
"""
)
"""The rules of all pages; light, unless `theme.DARK` follows."""


def picture(png: bytes, alt: str, caption: str) -> Markup:
    """A PNG picture that is part of the page, with words for those who cannot see it and a caption."""
    content = base64.b64encode(png).decode("ascii")
    return tag(
        "figure",
        tag("img", src=f"data:image/png;base64,{content}", alt=alt),
        tag("figcaption", breakable(caption)),
    )


def chapters(parts: Mapping[str, Markup], mark: str = "") -> Markup:
    """Links to all parts, then each under its heading, with a mark (`Markup`) beneath."""
    links = [tag("a", name, href=f"#{_anchor(name)}") for name in parts]
    bodies = (tag("section", tag("h2", name), mark, body, id=_anchor(name)) for name, body in parts.items())
    return joined([tag("nav", *links), *bodies])


def _anchor(name: str) -> str:
    return name.lower().replace(" ", "-")


def source_hash(text: str) -> str:
    """A source in a content security policy that allows only this text."""
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode("ascii")


def document(title: str, *content: Markup, policy: str = _POLICY, style: str = "", script: str = "") -> str:
    """A complete HTML page.

    Args:
        title: of the window.
        *content: of the body.
        policy: the Content-Security-Policy: what a browser may load and run.
        style: rules in addition to those of all pages.
        script: the only one that runs, after the page is read; the policy then allows it too.
    """
    if script:
        policy += f"; script-src '{source_hash(script)}'"
        content = (*content, tag("script", Markup(script)))
    head = tag(
        "head",
        tag("meta", charset="utf-8"),
        tag("meta", http_equiv="Content-Security-Policy", content=policy),
        tag("meta", name_="viewport", content="width=device-width, initial-scale=1"),
        tag("title", title),
        tag("style", Markup(STYLE + style)),
    )
    return f"<!DOCTYPE html>\n{tag('html', head, tag('body', *content), lang='en')}\n"
