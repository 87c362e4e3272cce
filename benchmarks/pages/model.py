"""The page of the model, from the numbers of the study on cooperation."""

from pathlib import Path

from benchmarks.cooperation import page


def main(_release: Path | None = None) -> None:
    """Write it."""
    page.main()
