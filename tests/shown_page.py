"""A page as its reader sees it: its links, its tables, what it loads and what it says."""

from __future__ import annotations

from html.parser import HTMLParser
from pathlib import Path

VOID = ("br", "hr", "img", "input", "link", "meta", "option", "wbr")
"""Elements without an end; the pages' options have none."""
LOADS = {"img": "src", "script": "src", "iframe": "src", "link": "href"}


class Shown(HTMLParser):
    """Refuses tags that do not match, styles in attributes, and scripts in the page.

    Attributes:
        text: all of it.
        links: addresses and texts.
        loads: addresses of pictures, styles, scripts and frames.
        tables: of each the rows, of each the cells.
        tags: all elements, in their order, with their attributes.
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
        given = {name: value or "" for name, value in attrs}
        self.tags.append((tag, given))
        assert "style" not in given
        assert not any(name.startswith("on") for name in given)
        if tag not in VOID:
            self._open.append(tag)
        if tag in LOADS:
            self.loads.append(given[LOADS[tag]] if tag != "script" or "src" in given else "")
        if tag == "a" and "href" in given:
            self.links.append((given["href"], ""))
        if tag == "table":
            self.tables.append([])
        elif tag == "tr":
            self.tables[-1].append([])
        elif tag in ("td", "th"):
            self.tables[-1][-1].append("")

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data
        if "a" in self._open:
            address, words = self.links[-1]
            self.links[-1] = (address, words + data)
        if "td" in self._open or "th" in self._open:
            self.tables[-1][-1][-1] += data

    def all(self, tag: str) -> list[dict[str, str]]:
        return [given for found, given in self.tags if found == tag]

    def table(self, heading: str) -> list[list[str]]:
        """The rows of the only table whose first column has this heading."""
        (found,) = [table[1:] for table in self.tables if table[0][0] == heading]
        return found

    def address_of(self, words: str) -> str:
        """Where the first link with these words leads."""
        return next(address for address, found in self.links if found == words)


def shown(path: Path) -> Shown:
    return Shown(path.read_text(encoding="utf-8"))
