"""Run the fault injection and write docs/fault_table.md: `python docs/make_fault_table.py`."""

import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).parent
TABLE = HERE / "fault_table.md"


def main() -> None:
    from fault_injection.run import jobs, make_healthy, run
    from fault_injection.table import to_markdown

    with tempfile.TemporaryDirectory() as folder:
        TABLE.write_text(to_markdown(run(make_healthy(Path(folder)), jobs())), encoding="utf-8")


if __name__ == "__main__":
    sys.path.insert(0, str(HERE.parent / "tests"))
    main()
