"""The page of a report as its reader sees it."""

from html.parser import HTMLParser
from pathlib import Path


class ReportPage(HTMLParser):
    """Parse a page into elements and text; fails where tags do not match.

    Attributes:
        open: Names of the tags that are still open, outermost first.
        elements: Tag name and attributes of each element, in the order of the page.
        text: All text of the page.
    """

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.feed(html)
        self.close()
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag not in ("br", "img", "meta", "wbr"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data

    def all(self, name: str) -> list[dict[str, str | None]]:
        """Return the attributes of all elements with this tag name."""
        return [attributes for tag, attributes in self.elements if tag == name]


def read_report(path: Path) -> ReportPage:
    return ReportPage(path.read_text(encoding="utf-8"))
