"""Measure the numbers of the pages again, and write them where they stand: `python
docs/make_tables.py [NAME…]`.

It runs in a checkout; each NAME takes some minutes, and without a NAME all run. `--release` is a
release that is taken in place of a new synthetic one, if it was made as the module in
benchmarks/pages says.
"""

import sys
from importlib import import_module
from pathlib import Path

import click

TOP = Path(__file__).parents[1]
NAMES = {
    "baselines": "what constant velocity foresees, by who cooperates",
    "benchmark": "the rows that benchmarks/v1 keeps",
    "facts": "the real release's facts beside a synthetic one, or beside --release",
    "labels": "cells in which label protocols differ",
    "model": "the studies that benchmarks/studies keeps",
    "real": "the real scenario; needs --release",
    "safety": "outputs of the commands on the page",
    "synth": "what the generator makes; with --release, the real scenario beside it",
    "warnings": "warning protocols",
}


@click.command(help=__doc__)
@click.argument("names", nargs=-1, metavar=f"[{'|'.join(NAMES)}]…")
@click.option("--release", type=click.Path(exists=True, path_type=Path))
def main(names: tuple[str, ...], release: Path | None) -> None:
    """Run what is named."""
    for name in names or [each for each in NAMES if each != "real"]:
        if name not in NAMES:
            raise click.BadParameter(f"expected one of {', '.join(NAMES)}, found {name!r}")
        click.echo(f"{name}: {NAMES[name]}")
        import_module(f"benchmarks.pages.{name}").main(release)


if __name__ == "__main__":
    sys.path.insert(0, str(TOP))
    main()
