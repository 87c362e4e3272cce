"""Update the table of breakages in testing.md: `python docs/make_testing_page.py`."""

from pathlib import Path

from deepaccident_devkit.testing import BREAKAGES, Breakage

PAGE = Path(__file__).parent / "testing.md"
_START, _END = "<!-- breakages -->\n", "<!-- end of breakages -->\n"
_HEAD = "| name | what it is | `validate` finds | opening raises | reading raises |\n|---|---|---|---|---|\n"


def row_of(breakage: Breakage) -> str:
    """A line of the table."""
    codes = ", ".join(f"`{code}`" for code in breakage.codes) + (" (with `--deep`)" if breakage.deep else "")
    errors = [f"`{error.__name__}`" if error else "" for error in (breakage.opening, breakage.reading)]
    return f"| {' | '.join([f'`{breakage.name}`', breakage.description, codes, *errors])} |\n"


def table() -> str:
    """All breakages, group by group."""
    parts = []
    for group in dict.fromkeys(breakage.group for breakage in BREAKAGES.values()):
        rows = "".join(row_of(breakage) for breakage in BREAKAGES.values() if breakage.group == group)
        parts.append(f"### {group.capitalize()}\n\n{_HEAD}{rows}\n")
    return "".join(parts)


def with_table(page: str) -> str:
    """The page with the table between its two marks."""
    before, _, rest = page.partition(_START)
    _, _, after = rest.partition(_END)
    return f"{before}{_START}\n{table()}{_END}{after}"


if __name__ == "__main__":
    PAGE.write_text(with_table(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
