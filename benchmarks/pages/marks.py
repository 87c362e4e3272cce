"""Where a table stands: on the page that has its marks, `<!-- NAME -->` before it and `<!-- end of
NAME -->` after.
"""

import math
import re
from collections.abc import Iterable
from pathlib import Path

TOP = Path(__file__).parents[2]
DOCS, TESTS = TOP / "docs", TOP / "tests"
PAGES = (*sorted(DOCS.glob("*.md")), TOP / "benchmarks" / "README.md")


def put(name: str, text: str) -> None:
    """Write a text between the marks of its name."""
    page = page_of(name)
    page.write_text(replaced(page.read_text(encoding="utf-8"), name, text), encoding="utf-8")


def page_of(name: str) -> Path:
    """The page that has the marks; raises SystemExit if not just one has them."""
    found = [page for page in PAGES if f"<!-- {name} -->" in page.read_text(encoding="utf-8")]
    if len(found) != 1:
        raise SystemExit(
            f"<!-- {name} -->: expected on one page, found on {[page.name for page in found]}"
        )
    return found[0]


def replaced(page: str, name: str, text: str) -> str:
    """A page with another text between the marks of a name."""
    begin, end = f"<!-- {name} -->", f"<!-- end of {name} -->"
    changed, count = re.subn(
        f"{begin}.*?{end}", lambda _: f"{begin}\n{text}\n{end}", page, flags=re.DOTALL
    )
    if count != 1:
        raise SystemExit(f"{begin} … {end}: expected once, found {count} times")
    return changed


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A Markdown table."""
    columns = list(head)
    return "\n".join(f"| {' | '.join(row)} |" for row in (columns, ["---"] * len(columns), *rows))


def number(value: float | None, digits: int = 3) -> str:
    """Of a cell; a dash for none."""
    return "–" if value is None or math.isnan(value) else f"{value:.{digits}f}"
