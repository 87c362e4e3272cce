"""A parsed HTML page: its text, links, tables and the files that it loads."""

from __future__ import annotations

from html.parser import HTMLParser
from pathlib import Path

VOID_TAGS = ("br", "hr", "img", "input", "link", "meta", "option", "wbr")
"""Elements without an end tag; the pages write options without one, too."""
LOADING_ATTRIBUTES = {"img": "src", "script": "src", "iframe": "src", "link": "href"}


class ParsedPage(HTMLParser):
    """Parse a page, and refuse unbalanced tags, style attributes and scripts in attributes.

    Attributes:
        text: All text of the page.
        links: (address, text) of each link.
        loads: Addresses of pictures, styles, scripts and frames; "" for a script in the page.
        tables: For each table its rows, and for each row its cells.
        tags: (name, attributes) of all elements, in document order.
    """

    def __init__(self, html: str) -> None:
        super().__init__()
        self.text = ""
        self.links: list[tuple[str, str]] = []
        self.loads: list[str] = []
        self.tables: list[list[list[str]]] = []
        self.tags: list[tuple[str, dict[str, str]]] = []
        self._open: list[str] = []
        self.feed(html)
        self.close()
        assert not self._open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        attributes = {name: value or "" for name, value in attrs}
        self.tags.append((tag, attributes))
        assert "style" not in attributes
        assert not any(name.startswith("on") for name in attributes)
        if tag not in VOID_TAGS:
            self._open.append(tag)
        if tag in LOADING_ATTRIBUTES:
            is_inline_script = tag == "script" and "src" not in attributes
            self.loads.append("" if is_inline_script else attributes[LOADING_ATTRIBUTES[tag]])
        if tag == "a" and "href" in attributes:
            self.links.append((attributes["href"], ""))
        if tag == "table":
            self.tables.append([])
        elif tag == "tr":
            self.tables[-1].append([])
        elif tag in ("td", "th"):
            self.tables[-1][-1].append("")

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID_TAGS:
            assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data
        if "a" in self._open:
            address, words = self.links[-1]
            self.links[-1] = (address, words + data)
        if "td" in self._open or "th" in self._open:
            self.tables[-1][-1][-1] += data

    def all(self, tag: str) -> list[dict[str, str]]:
        return [attributes for name, attributes in self.tags if name == tag]

    def table(self, heading: str) -> list[list[str]]:
        """Return the rows of the only table with this heading above its first column."""
        (rows,) = [table[1:] for table in self.tables if table[0][0] == heading]
        return rows

    def address_of(self, words: str) -> str:
        """Return the address of the first link with this text."""
        addresses = [address for address, text in self.links if text == words]
        return addresses[0]


def parse_page(path: Path) -> ParsedPage:
    return ParsedPage(path.read_text(encoding="utf-8"))
