"""Measure the numbers of the pages again, and write them into the pages: `python
docs/make_tables.py [NAME…]`.

It runs in a checkout; each NAME takes a few minutes, and without a NAME all of them run.
`--release` is used instead of a new synthetic release, if it was made as described in the module in
benchmarks/pages.
"""

import sys
from importlib import import_module
from pathlib import Path

import click

TOP = Path(__file__).parents[1]
DESCRIPTIONS = {
    "baselines": "what constant velocity predicts, by set of cooperating agents",
    "benchmark": "the rows that benchmarks/v1 keeps",
    "facts": "the facts of the real release, compared with a synthetic one or with --release",
    "labels": "cells in which label protocols differ",
    "model": "the studies that benchmarks/studies keeps",
    "real": "the real scenario; needs --release",
    "safety": "outputs of the commands on the page",
    "synth": "what the generator makes; with --release, the real scenario is measured again",
    "warnings": "the numbers of warnings in warnings.json",
}


@click.command(help=__doc__)
@click.argument("names", nargs=-1, metavar=f"[{'|'.join(DESCRIPTIONS)}]…")
@click.option("--release", type=click.Path(exists=True, path_type=Path))
def main(names: tuple[str, ...], release: Path | None) -> None:
    """Run the named modules."""
    default_names = [name for name in DESCRIPTIONS if name != "real"]
    for name in names or default_names:
        if name not in DESCRIPTIONS:
            raise click.BadParameter(f"expected one of {', '.join(DESCRIPTIONS)}, found {name!r}")
        click.echo(f"{name}: {DESCRIPTIONS[name]}")
        import_module(f"benchmarks.pages.{name}").main(release)


if __name__ == "__main__":
    sys.path.insert(0, str(TOP))
    main()
