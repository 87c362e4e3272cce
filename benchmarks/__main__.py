"""`python -m benchmarks [NAME…] [--json]`: all benchmarks, or those named."""

import importlib
import json

import click

from benchmarks.measure import table

NAMES = (
    "parsing",
    "indexing",
    "scale",
    "validation",
    "geometry",
    "labels",
    "evaluation",
    "coverage",
    "safety",
    "render",
    "synth",
    "export",
    "loader",
    "engine",
    "stores",
    "explore",
    "beside",
)


@click.command()
@click.argument("names", nargs=-1, type=click.Choice(NAMES), metavar="[NAME…]")
@click.option(
    "--json", "as_json", is_flag=True, help="One flat JSON object (name: number) and nothing else."
)
def main(names: tuple[str, ...], as_json: bool) -> None:  # noqa: FBT001 - click's flag
    """Measure the devkit; NAME is one of parsing, indexing, scale, validation, geometry, labels,
    evaluation, coverage, safety, render, synth, export, loader, engine, stores, explore, beside.
    """
    figures = []
    for name in names or NAMES:
        measured = importlib.import_module(f"benchmarks.{name}").measure()
        figures += measured
        if not as_json:
            click.echo(f"{name}\n{table(measured)}\n")
    if as_json:
        click.echo(json.dumps({figure.name: figure.value for figure in figures}))


if __name__ == "__main__":
    main()
