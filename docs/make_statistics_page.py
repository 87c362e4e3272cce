"""Measure how often intervals and `compare` are right: `python docs/make_statistics_page.py` prints the tables.

Run it from a checkout; it takes some minutes.
"""

import sys
from pathlib import Path


def main() -> None:
    """Print both tables, and how often differences that are alike in all clusters are called real."""
    sys.path.insert(0, str(Path(__file__).parents[1]))
    from benchmarks.coverage import DRAWS, alike, coverage_table, percent, power_table

    print(f"Intervals of 95 %, {DRAWS:,} draws for each setting:\n\n{coverage_table()}\n")
    print(f"How often a difference is called real:\n\n{power_table()}\n")
    print(f"Of differences that are alike in all clusters: {percent(alike())}")


if __name__ == "__main__":
    main()
