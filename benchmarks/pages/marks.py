"""Write a generated text between its marks on a page: `<!-- NAME -->`, `<!-- end of NAME -->`."""

import re
from collections.abc import Iterable
from pathlib import Path
from textwrap import fill

TOP = Path(__file__).parents[2]
DOCS = TOP / "docs"
PAGES = (*sorted(DOCS.glob("*.md")), TOP / "benchmarks" / "README.md")


def put(name: str, text: str) -> None:
    """Write a text between the marks of its name."""
    page = find_page(name)
    page.write_text(replaced(page.read_text(encoding="utf-8"), name, text), encoding="utf-8")


def find_page(name: str) -> Path:
    """Return the page that has the marks; raises SystemExit unless exactly one page has them."""
    pages = [page for page in PAGES if f"<!-- {name} -->" in page.read_text(encoding="utf-8")]
    if len(pages) != 1:
        names = [page.name for page in pages]
        raise SystemExit(f"<!-- {name} -->: expected on one page, found on {names}")
    return pages[0]


def replaced(page: str, name: str, text: str) -> str:
    """Return a page with another text between the marks of a name."""
    begin, end = f"<!-- {name} -->", f"<!-- end of {name} -->"
    changed_page, count = re.subn(
        f"{begin}.*?{end}", lambda _: f"{begin}\n{text}\n{end}", page, flags=re.DOTALL
    )
    if count != 1:
        raise SystemExit(f"{begin} … {end}: expected once, found {count} times")
    return changed_page


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Return a Markdown table."""
    columns = list(head)
    lines = (columns, ["---"] * len(columns), *rows)
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def wrapped(text: str) -> str:
    """Return a paragraph of the width of the pages."""
    return fill(text, 120, break_long_words=False, break_on_hyphens=False)
