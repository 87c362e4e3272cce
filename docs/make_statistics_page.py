"""Measure the tables of docs/statistics.md: `python docs/make_statistics_page.py`, from a checkout; some minutes."""

import re
import sys
from pathlib import Path

TOP = Path(__file__).parents[1]
PAGE = TOP / "docs" / "statistics.md"


def main() -> None:
    """Write both tables into the page."""
    sys.path.insert(0, str(TOP))
    from benchmarks.coverage import DRAWS, alike, coverage_table, percent, power_table

    page = PAGE.read_text(encoding="utf-8")
    measured = {
        "draws": f"{DRAWS:,}",
        "coverage": coverage_table(),
        "power": power_table(),
        "alike": percent(alike()),
    }
    for name, made in measured.items():
        page = with_block(page, name, made)
    PAGE.write_text(page, encoding="utf-8")


def with_block(page: str, name: str, text: str) -> str:
    """The page with a text between the marks of that name, on the same line if it is one."""
    break_ = "\n" if "\n" in text else ""
    made, count = re.subn(
        rf"(<!-- {name} -->).*?(<!-- /{name} -->)",
        lambda marks: f"{marks[1]}{break_}{text}{break_}{marks[2]}",
        page,
        flags=re.DOTALL,
    )
    assert count == 1, f"{PAGE}: expected one block {name}, found {count}"
    return made


if __name__ == "__main__":
    main()
