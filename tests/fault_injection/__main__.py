"""Print all kinds of faults, and bring docs/validation.md up to date.

Usage: `PYTHONPATH=tests python -m fault_injection`.
"""

import re
import tempfile
from pathlib import Path

from fault_injection.run import list_jobs, make_healthy, run
from fault_injection.table import summary, to_markdown

PAGE = Path(__file__).parents[2] / "docs" / "validation.md"


def main() -> None:
    """Plant all faults, print them and write their numbers into the page."""
    with tempfile.TemporaryDirectory() as folder:
        outcomes = run(make_healthy(Path(folder)), list_jobs())
    print(to_markdown(outcomes))
    page = PAGE.read_text(encoding="utf-8")
    block = re.compile("(<!-- faults -->\n).*?(<!-- /faults -->)", re.DOTALL)
    new_page = block.sub(lambda marks: marks[1] + summary(outcomes) + marks[2], page)
    PAGE.write_text(new_page, encoding="utf-8")


if __name__ == "__main__":  # processes that plant faults import this again
    main()
